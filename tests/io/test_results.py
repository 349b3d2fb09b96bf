"""Results in files: every bit comes back, with units, and damage is refused."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read, write
from napari_shadowinv.io.formats import kind_of
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

LIGHT = OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=1e-5 / 3)
COLLIMATED = ProtonSetup(
    energy=1 / 3,
    source_object_distance=np.inf,
    object_image_distance=0.1,
    detector_pixel_size=1e-5 / 3,
    species="alpha",
)
PROTONS = ProtonSetup.example()
PAIR = PROTONS, PROTONS.model_copy(update={"energy": 1 / 3})
Make = Callable[[Inversion, Callable[..., Fit]], Any]


def inverted(setup: Any, inversion: Inversion, _: Any) -> Inversion:
    potential = inversion.potential.copy()
    potential[3, 4] = np.nan
    report = dataclasses.replace(inversion.report, residual=np.inf)
    return dataclasses.replace(inversion, potential=potential, report=report).in_units(setup)


def fitted(keywords: dict[str, Any], _: Any, make_fit: Callable[..., Fit]) -> Fit:
    return make_fit(**keywords)


def with_noise_of_pixels(_: Any, make_fit: Callable[..., Fit]) -> Fit:
    fit = make_fit()
    noise = np.random.default_rng(0).uniform(0.01, 0.1, fit.images.shape)
    return dataclasses.replace(fit, noise=np.where(fit.mask, noise, np.nan))


def without_errors(_: Any, make_fit: Callable[..., Fit]) -> Fit:
    ambiguous = Assessment(Verdict.AMBIGUOUS, "cannot tell")
    fit = make_fit(strengths=(1.0,), assessment=ambiguous)
    fields = tuple(dataclasses.replace(field, errors=None) for field in fit.fields)
    return dataclasses.replace(fit, fields=fields)


RESULTS: dict[str, Make] = {
    "inversion": partial(inverted, None),
    "inversion, protons": partial(inverted, PROTONS),
    "inversion, light": partial(inverted, LIGHT),
    "inversion, collimated": partial(inverted, COLLIMATED),
    "fit, noise of pixels": with_noise_of_pixels,
    "fit, unknown errors": without_errors,
    **{
        f"fit of {names}, {kind}": partial(fitted, {"names": tuple(names), "setups": setups})
        for names in ("B", "BE")
        for kind, setups in (("none", ()), ("protons", PAIR), ("light", (LIGHT, LIGHT)))
    },
}


@pytest.fixture
def result(request: Any, inversion: Inversion, make_fit: Callable[..., Fit]) -> Any:
    return RESULTS[request.param](inversion, make_fit)


def assert_same(before: Any, after: Any, name: str = "result") -> None:
    assert type(before) is type(after), name
    if isinstance(before, np.ndarray):
        assert after.dtype == before.dtype, name
        np.testing.assert_array_equal(after, before, err_msg=name)
    elif isinstance(before, tuple):
        for number, (first, second) in enumerate(zip(before, after, strict=True)):
            assert_same(first, second, f"{name}[{number}]")
    elif dataclasses.is_dataclass(before):
        for field in dataclasses.fields(before):
            values = getattr(before, field.name), getattr(after, field.name)
            assert_same(*values, f"{name}.{field.name}")
    elif isinstance(before, float):
        np.testing.assert_equal(after, before, err_msg=name)  # NaN is NaN
    else:
        assert before == after, name


@pytest.mark.parametrize("result", RESULTS, indirect=True)
def test_a_file_gives_back_every_bit(tmp_path: Path, result: Any) -> None:
    dataset = read(write(tmp_path / "a.shadowinv", result))
    again = type(result).from_dataset(dataset)
    assert_same(result, again)
    expected = result.to_dataset()
    xr.testing.assert_identical(dataset.drop_attrs(deep=False), expected.drop_attrs(deep=False))
    setups = result.setups[:1] if isinstance(result, Fit) else (result.setup,)
    assert setup_from_dataset(dataset) == next(iter(setups), None)
    assert kind_of(tmp_path / "a.shadowinv") == "shadowinv"
    if isinstance(result, Fit):
        assert dataset.attrs["format"] == "shadowinv fit"
        np.testing.assert_array_equal(again.normalised_residual, result.normalised_residual)
    # Read and written again, it still is one.
    assert_same(result, type(result).from_dataset(read(write(tmp_path / "b.shadowinv", dataset))))
    described = dataset.data_vars if isinstance(result, Fit) else dataset.variables
    for name, variable in described.items():
        assert variable.attrs.get("units"), name
        assert variable.attrs.get("long_name"), name
    if "setups" in vars(result) and result.setups == PAIR and len(result.fields) == 2:
        assert "path_integrated_b_B" in dataset
        assert "path_integrated_b_E" not in dataset


def test_a_result_is_read_as_xarray_reads_it(tmp_path: Path, inversion: Inversion) -> None:
    names = xr.Variable("name", np.array(["Größe", "µm", ""], dtype=object), {"why": "nötig"})
    written = inversion.to_dataset().assign_attrs(note="grün").assign(names=names)
    path = write(tmp_path / "a.shadowinv", written)
    expected = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    again = read(path)
    xr.testing.assert_identical(again, expected)
    assert list(again["names"].values) == ["Größe", "µm", ""]
    assert {name: again.sizes[name] for name in ("y", "x", "component", "site")} == {
        **{"y": 24, "x": 32, "component": 2, "site": 17}
    }
    assert again["displacement"].dims == ("component", "y", "x")
    assert again["component"].values.tolist() == ["y", "x"]


def test_si_values_follow_from_the_setup(
    inversion: Inversion, proton_setup: ProtonSetup, optical_setup: OpticalSetup
) -> None:
    dataset = inversion.in_units(proton_setup).to_dataset()
    slope = 1.5e-6 * proton_setup.magnification / 2e-2
    np.testing.assert_allclose(dataset["deflection_angle"], inversion.displacement * slope)
    np.testing.assert_allclose(dataset["potential_si"], inversion.potential * slope * 1.5e-6)
    for name in ("path_integrated_b", "path_integrated_e"):
        expected = getattr(proton_setup, name)(inversion.displacement)
        np.testing.assert_array_equal(dataset[name], expected)
    np.testing.assert_allclose(dataset["x"], np.arange(32) * 1.5e-6)
    assert "x_si" not in dataset
    units = {name: dataset[name].attrs["units"] for name in ("potential_si", "path_integrated_b")}
    assert units == {"potential_si": "m", "path_integrated_b": "T m"}

    dataset = inversion.in_units(optical_setup).to_dataset()
    density = optical_setup.line_integrated_density(inversion.potential)
    np.testing.assert_array_equal(dataset["line_integrated_density"], density)
    np.testing.assert_allclose(dataset["line_integrated_log_index"], -dataset["potential_si"])
    assert "path_integrated_b" not in dataset


def without(*attributes: str, **report: Any) -> Callable[[xr.Dataset], xr.Dataset]:
    """Remove attributes, and change entries of the report, of which None is removed."""

    def change(dataset: xr.Dataset) -> xr.Dataset:
        entries = {**json.loads(dataset.attrs["report"]), **report}
        filled = {name: value for name, value in entries.items() if value is not None}
        changed = dataset.assign_attrs(report=json.dumps(filled))
        return changed.drop_attrs(deep=False).assign_attrs(
            {name: text for name, text in changed.attrs.items() if name not in attributes}
        )

    return change


def with_one_noise(dataset: xr.Dataset) -> xr.Dataset:
    return dataset.assign(noise=(("field",), np.ones(1)))


DAMAGED: list[tuple[type[Any], Callable[[xr.Dataset], xr.Dataset], str]] = [
    (Inversion, lambda _: xr.Dataset(), r"'potential'.*'options', 'instrument', 'report'"),
    (Inversion, without(levels=None), r"\(levels: Field required\)"),
    (Inversion, without(cautions=None), r"\('cautions' is missing\)"),
    (Inversion, without(iterations="many"), r"\(iterations: Input should be a valid integer"),
    (Fit, lambda data: data.drop_vars("brightness"), "no 'brightness': expected the result of a"),
    (Fit, lambda data: data.drop_vars("displacement"), "no 'displacement': expected the result"),
    (Fit, without("verdict"), "no 'verdict'"),
    (Fit, with_one_noise, "noise has shape"),
]


@pytest.mark.parametrize(("kind", "change", "words"), DAMAGED)
def test_an_incomplete_dataset_is_refused(
    inversion: Inversion, make_fit: Callable[..., Fit], kind: Any, change: Any, words: str
) -> None:
    dataset = (inversion if kind is Inversion else make_fit()).to_dataset()
    with pytest.raises(InputError, match=words):
        kind.from_dataset(change(dataset))


def test_a_provenance_of_another_version_is_none(inversion: Inversion) -> None:
    dataset = inversion.to_dataset()
    for text in ("{}", "nonsense", '{"version": "9", "recipe": {"steps": [{"step": "dance"}]}}'):
        again = Inversion.from_dataset(dataset.assign_attrs(provenance=text))
        assert again.provenance is None


def test_the_field_of_a_fit_is_written_as_pradformat_with_its_verdict(
    tmp_path: Path, make_fit: Callable[..., Fit]
) -> None:
    fit = make_fit(setups=PAIR, assessment=Assessment(Verdict.SEVERAL, ""))
    with h5py.File(write(tmp_path / "fit.h5", fit)) as file:
        assert file.attrs["spec_energy"] == pytest.approx(1e6 * PROTONS.energy)
        potential = -PROTONS.normalized_potential(file["phi"][()])
        np.testing.assert_allclose(potential, fit.fields[0].potential, rtol=1e-12)
        assert file.attrs["description"].endswith(": one of several")


@pytest.mark.parametrize(
    ("name", "result", "setup", "sentence"),
    [
        ("a.csv", "fit of B, none", None, r"ending is '\.csv', expected one of \.h5"),
        ("a.tif", "fit of B, none", None, r"ending is '\.tif', expected one of \.h5"),
        ("a.tif", "inversion", None, r"ending is '\.tif', expected one of .*\.h5"),
        ("a.h5", "fit of BE, protons", None, r"one field, received B and E: write \.shadowinv"),
        ("a.h5", "fit of B, none", None, "needs a setup of kind 'proton'"),
        ("a.h5", "inversion", None, "needs a setup of kind 'proton', received.*none"),
        ("a.h5", "inversion", LIGHT, "needs a setup of kind 'proton', received.*'optical'"),
        ("a.shadowinv", "fit of B, none", PROTONS, "received a setup for a fit"),
    ],
    indirect=["result"],
)
def test_what_a_format_cannot_hold_is_refused(
    tmp_path: Path, name: str, result: Any, setup: Any, sentence: str
) -> None:
    with pytest.raises((FileFormatError, InputError), match=sentence):
        write(tmp_path / name, result, setup=setup)
    assert not list(tmp_path.iterdir())


# Damage


@pytest.fixture
def path(tmp_path: Path, inversion: Inversion, proton_setup: ProtonSetup) -> Path:
    return write(tmp_path / "a.shadowinv", inversion, setup=proton_setup)


def test_flipped_bits_of_a_result_are_refused(path: Path) -> None:
    content = path.read_bytes()
    places = np.random.default_rng(5).integers(0, 8 * len(content) - 8 * 81, 40)
    for place in [*places, 8 * content.index(b'"energy"') + 2]:
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError):
            read(path)


def test_result_changed_by_another_program_is_read(path: Path, inversion: Inversion) -> None:
    before = read(path)
    path.write_bytes(path.read_bytes()[:-81])  # without its checksum
    assert read(path).identical(before)
    write(path, inversion, overwrite=True)
    with h5py.File(path, "r+") as file:
        file.attrs["note"] = "mine"
    assert read(path).attrs["note"] == "mine"
