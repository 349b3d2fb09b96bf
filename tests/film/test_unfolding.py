"""Facts about the response of films, and spectra unfolded from their doses."""

from __future__ import annotations

import csv

import numpy as np
import pytest
from pydantic import ValidationError

from helpers.public_data import public_file
from helpers.srim import TABLES
from napari_shadowinv.errors import InputError
from napari_shadowinv.film import Material, Pack, PackLayer, Slab
from napari_shadowinv.film.unfolding import (
    ResponseMatrix,
    check_increasing,
    relative_strengths,
    unfold,
)
from napari_shadowinv.physics.setup import ProtonSetup


def designed() -> tuple[list[PackLayer], np.ndarray]:
    """The pack as its makers describe it, and the energies that they give."""
    rows = list(csv.reader(public_file("rcf/RCF_Stack_Design.csv").read_text().splitlines()))
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
def test_a_real_pack_sees_the_energies_of_its_design(tables: bool) -> None:
    layers, energies = designed()
    srim = {name: Material(table=public_file(file)) for name, file in TABLES.items()}
    bands = ResponseMatrix.of(Pack(layers=tuple(layers), materials=srim if tables else {})).bands
    check_increasing(bands)
    peaks = np.array([band.peak for band in bands])
    # The design's own filters in front of films 6 to 8 come to somewhat more.
    np.testing.assert_allclose(peaks, energies, rtol=0.045 if tables else 0.06)
    np.testing.assert_allclose(peaks[:5], energies[:5], rtol=0.02 if tables else 0.04)


def test_energy_is_conserved() -> None:
    """What is lost in a pack of one thick film is all that protons have."""
    film = {"film": "thick"}
    kinds = {"thick": {"active": {"material": "Al", "thickness": 0.01}}}
    response = ResponseMatrix.of(
        Pack.model_validate({"layers": [film], "films": kinds}), [1.0, 5.0, 30]
    )
    np.testing.assert_allclose(response.deposits, [[1.0, 5.0, 30.0]], rtol=1e-9)
    # 1 MeV in 1 m² of 27 kg.
    assert response.doses[0, 0] == pytest.approx(1.602e-13 / 26.99, rel=1e-3)


def test_a_band_is_where_half_as_much_is_lost() -> None:
    pack = Pack(layers=tuple(PackLayer(film="EBT3") for _ in range(3)))
    response = ResponseMatrix.of(pack)
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
    bands = ResponseMatrix.of(Pack(layers=(PackLayer(film="HDV2"), PackLayer(film="EBT3")))).bands
    with pytest.raises(InputError, match="expected films in the order in which protons reach them"):
        check_increasing(bands[::-1])


def test_a_pack_that_stops_all_is_refused() -> None:
    wall = Slab(material="Ta", thickness=0.1)
    pack = Pack(layers=(PackLayer(film="HDV2", filters=(wall,)),))
    with pytest.raises(InputError, match="reaches film 1: check the thicknesses"):
        _ = ResponseMatrix.of(pack).bands


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        ({"film": "HD-V2"}, "has no entry under [films]: did you mean 'HDV2'?"),
        ({"film": "EBT3", "filters": [{"material": "Wood", "thickness": 1e-4}]}, "has 'Wood'"),
        ({"film": "EBT3", "filters": [{"material": "Al", "thickness": 25}]}, "must be at most"),
    ],
)
def test_unknown_films_and_materials_are_refused(layer: dict, message: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Pack.model_validate({"layers": [layer]})
    assert message in str(refused.value)


SHAPE = (6, 7)


@pytest.fixture(scope="module")
def response() -> ResponseMatrix:
    filters = ["40 um Al", *["150 um Mylar"] * 3, "300 um Mylar", *["250 um Fe"] * 3]
    layers = [{"film": "HDV2", "filters": stack} for stack in filters]
    return ResponseMatrix.of(Pack.model_validate({"layers": layers}))


def doses_of(response: ResponseMatrix, spectrum: np.ndarray) -> np.ndarray:
    """Of a spectrum (protons per m² and MeV) in every pixel."""
    dose = np.trapezoid(spectrum * response.doses, response.energies, axis=1)
    return dose[:, None, None] * np.ones(SHAPE)


def falling(response: ResponseMatrix, temperature: float) -> np.ndarray:
    """Protons per m² and MeV, exponential to the last."""
    return 1e14 * np.exp(-response.energies / temperature)


@pytest.mark.parametrize(("temperature", "within"), [(8.0, 0.01), (12.0, 0.01), (40.0, 0.03)])
def test_a_falling_spectrum_comes_back(
    response: ResponseMatrix, temperature: float, within: float
) -> None:
    spectrum = falling(response, temperature)
    doses = doses_of(response, spectrum)
    spectra = unfold(doses, np.full(doses.shape, 0.01), response)
    truth = np.interp([band.peak for band in response.bands], response.energies, spectrum)
    np.testing.assert_allclose(spectra.fluence[:, 2, 3], truth, rtol=within)
    np.testing.assert_allclose(spectra.fluence, spectra.fluence[:, :1, :1] * np.ones(SHAPE))


def test_each_layer_shows_protons_of_its_reported_energy(response: ResponseMatrix) -> None:
    spectrum = falling(response, 10.0)
    # What a magnetic and an electric field add in a pixel, to the first order.
    for power in (0.5, 1.0):
        bent = spectrum * (1 + 0.3 * (response.energies / 3) ** -power)
        doses = np.stack([doses_of(response, s)[:, 0, 0] for s in (spectrum, bent)], axis=1)
        doses = np.repeat(doses[:, None], 5, axis=1)
        spectra = unfold(doses, np.full(doses.shape, 0.01), response)
        excess = spectra.fluence[:, 0, 1] / spectra.fluence[:, 0, 0] - 1
        np.testing.assert_allclose(excess, 0.3 * (spectra.energies / 3) ** -power, rtol=0.06)


def test_the_last_film_shows_faster_protons_than_stop_in_it(response: ResponseMatrix) -> None:
    doses = doses_of(response, falling(response, 10.0))
    spectra = unfold(doses, np.full(doses.shape, 0.01), response)
    peaks = np.array([band.peak for band in response.bands])
    np.testing.assert_allclose(spectra.energies[:-2], peaks[:-2], rtol=0.03)
    assert spectra.energies[-1] > 1.03 * peaks[-1]


def test_errors_are_those_of_noisy_doses(response: ResponseMatrix) -> None:
    doses = doses_of(response, falling(response, 15.0))[:, :1, :1] * np.ones((1, 50, 60))
    noise = 1 + 0.03 * np.random.default_rng(0).normal(size=doses.shape)
    errors = np.full(doses.shape, 0.03)
    spectra = unfold(doses * noise, errors, response, curvature=10)
    truth = unfold(doses, errors, response, curvature=10).fluence
    away = (spectra.fluence - truth) / spectra.error
    np.testing.assert_allclose(away.std(axis=(1, 2)), 1, atol=0.15)
    assert abs(away.mean(axis=(1, 2))).max() < 0.15


def test_nothing_is_negative(response: ResponseMatrix) -> None:
    doses = np.random.default_rng(1).uniform(0, 10, (8, *SHAPE))
    spectra = unfold(doses, np.full(doses.shape, 0.05), response)
    assert (spectra.fluence >= 0).all()
    assert (spectra.error > 0).all()


def test_an_unknown_dose_is_bridged(response: ResponseMatrix) -> None:
    doses = doses_of(response, falling(response, 15.0))
    errors = np.full(doses.shape, 0.01)
    errors[3, 2, 2] = np.inf
    spectra = unfold(doses, errors, response)
    assert spectra.fluence[3, 2, 2] == pytest.approx(spectra.fluence[3, 0, 0], rel=0.02)
    assert spectra.error[3, 2, 2] > 3 * spectra.error[3, 0, 0]


def test_a_bridged_film_keeps_its_bend(response: ResponseMatrix) -> None:
    spectrum = falling(response, 8.0)
    bent = spectrum * (1 + 0.3 * (response.energies / 3) ** -0.75)
    # A pixel whose protons are displaced, among 99 plain ones that set the usual spectrum.
    pixels = [bent] + 99 * [spectrum]
    doses = np.stack([doses_of(response, s)[:, 0, 0] for s in pixels], axis=1)
    doses = doses.reshape(len(doses), 10, 10)
    errors = np.full(doses.shape, 0.01)
    for film in range(1, len(doses) - 1):
        bridged = errors.copy()
        bridged[film, 0, 0] = np.inf
        spectra = unfold(doses, bridged, response)
        excess = spectra.fluence[film, 0, 0] / spectra.fluence[film, 5, 5] - 1
        assert excess == pytest.approx(0.3 * (spectra.energies[film] / 3) ** -0.75, rel=0.06)


def test_fluence_of_a_pixel_grows_with_its_dose_where_a_film_is_bridged(
    response: ResponseMatrix,
) -> None:
    factors = np.array([1.0, 0.05, 20.0])
    bent = falling(response, 8.0) * (1 + 0.3 * (response.energies / 3) ** -0.75)
    # Three pixels of the same spectrum, among 97 plain ones that set the usual one.
    spectra = [*(factor * bent for factor in factors), *[falling(response, 8.0)] * 97]
    doses = np.stack([doses_of(response, spectrum)[:, 0, 0] for spectrum in spectra], axis=1)
    doses = doses.reshape(len(doses), 10, 10)
    errors = np.full(doses.shape, 0.1)
    errors[3, 0, :3] = np.inf
    fluence = unfold(doses, errors, response).fluence[:, 0, :3]
    np.testing.assert_allclose(fluence / factors, fluence[:, :1] * np.ones(3), rtol=1e-6)


@pytest.mark.parametrize(
    ("doses", "message"),
    [
        (
            np.ones((7, 3, 3)),
            r"doses have shape \(7, 3, 3\).*expected both as \(8, height, width\)",
        ),
        (-np.ones((8, 3, 3)), "doses are negative"),
    ],
)
def test_other_doses_are_refused(response: ResponseMatrix, doses: np.ndarray, message: str) -> None:
    with pytest.raises(InputError, match=message):
        unfold(doses, np.full(doses.shape, 0.1), response)
