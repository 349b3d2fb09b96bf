"""Facts about packs of films: which protons each film sees, and when they cross the object."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from helpers.srim import TABLES
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import Material, Pack, PackLayer, Response, Slab
from napari_shadowinv.film.unfolding import check_increasing, relative_strengths
from napari_shadowinv.physics.setup import ProtonSetup


def designed(folder: Path) -> tuple[list[PackLayer], np.ndarray]:
    """The pack as its makers describe it, and the energies that they give."""
    rows = list(csv.reader((folder / "RCF_Stack_Design.csv").read_text().splitlines()))
    films, energies, materials, thicknesses = (row[1:] for row in rows[1:5])
    layers = [
        PackLayer(
            film=film,
            filters=tuple(
                Slab(material=name, thickness=float(thick) * 1e-6)
                for name, thick in zip(names.split("/"), thick_ones.split("/"), strict=True)
            ),
        )
        for film, names, thick_ones in zip(films, materials, thicknesses, strict=True)
    ]
    return layers, np.array(energies, float)


@pytest.mark.parametrize("tables", [True, False])
def test_a_real_pack_sees_the_energies_of_its_design(shared_data: Path, tables: bool) -> None:
    folder = shared_data / "rcf"
    layers, energies = designed(folder)
    srim = {
        name: Material(table=folder / "stopping" / f"SRIM_{file}.txt")
        for name, file in TABLES.items()
    }
    bands = Response.of(Pack(layers=tuple(layers), materials=srim if tables else {})).bands
    check_increasing(bands)
    peaks = np.array([band.peak for band in bands])
    # The design's own filters in front of films 6 to 8 come to somewhat more.
    np.testing.assert_allclose(peaks, energies, rtol=0.045 if tables else 0.06)
    np.testing.assert_allclose(peaks[:5], energies[:5], rtol=0.02 if tables else 0.04)


def test_energy_is_conserved() -> None:
    """What is lost in a pack of one thick film is all that protons have."""
    film = {"film": "thick"}
    kinds = {"thick": {"active": {"material": "Al", "thickness": 0.01}}}
    response = Response.of(Pack.model_validate({"layers": [film], "films": kinds}), [1.0, 5.0, 30])
    np.testing.assert_allclose(response.deposits, [[1.0, 5.0, 30.0]], rtol=1e-9)
    # 1 MeV in 1 m² of 27 kg.
    assert response.doses[0, 0] == pytest.approx(1.602e-13 / 26.99, rel=1e-3)


def test_a_band_is_where_half_as_much_is_lost() -> None:
    pack = Pack(layers=tuple(PackLayer(film="EBT3") for _ in range(3)))
    response = Response.of(pack)
    for band, deposit in zip(response.bands, response.deposits, strict=True):
        assert band.low < band.peak < band.high
        at = np.interp([band.low, band.peak, band.high], response.energies, deposit)
        assert at[1] == deposit.max()
        np.testing.assert_allclose(at[[0, 2]] / at[1], 0.5, atol=0.05)


def test_faster_protons_come_earlier() -> None:
    setup = ProtonSetup(
        energy=10, source_object_distance=0.01, object_image_distance=0.1, pixel_size=1e-5
    )
    slow, fast = (setup.model_copy(update={"energy": energy}) for energy in (5.0, 938.27209))
    # At an energy like its mass, a proton has √3/2 of the speed of light.
    assert fast.time_of_flight == pytest.approx(0.01 / (0.8660254 * 299792458), rel=1e-6)
    assert slow.time_of_flight > fast.time_of_flight
    small, large = relative_strengths([5.0, 938.27209]) * [1.0, 1.0]
    assert small == 1
    assert large == pytest.approx(slow.momentum / fast.momentum, rel=1e-6)


def test_films_in_the_wrong_order_are_refused() -> None:
    bands = Response.of(Pack(layers=(PackLayer(film="HDV2"), PackLayer(film="EBT3")))).bands
    with pytest.raises(InputError, match="expected films in the order in which protons reach them"):
        check_increasing(bands[::-1])


def test_a_pack_that_stops_all_is_refused() -> None:
    wall = Slab(material="Ta", thickness=0.1)
    pack = Pack(layers=(PackLayer(film="HDV2", filters=(wall,)),))
    with pytest.raises(InputError, match="reaches film 1: check the thicknesses"):
        _ = Response.of(pack).bands


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        ({"film": "HD-V2"}, "has no entry under [films]: did you mean 'HDV2'?"),
        ({"film": "EBT3", "filters": [{"material": "Wood", "thickness": 1e-4}]}, "has 'Wood'"),
        ({"film": "EBT3", "filters": [{"material": "Al", "thickness": 25}]}, "less than or equal"),
    ],
)
def test_unknown_films_and_materials_are_refused(layer: dict, message: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Pack.model_validate({"layers": [layer]})
    assert message in str(refused.value)
