"""Fits in files: `Fit.to_dataset`, `Fit.from_dataset`, `write` and `read`."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read, write
from napari_shadowinv.io.formats import kind_of
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

MakeFit = Callable[..., Fit]

LIGHT = OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=12e-6)


def protons(energy: float) -> ProtonSetup:
    return ProtonSetup(
        energy=energy,
        source_object_distance=1.3e-3,
        object_image_distance=2e-2,
        detector_pixel_size=1e-5 / 3,
    )


def assert_same(before: Any, after: Any, name: str = "fit") -> None:
    assert type(before) is type(after), name
    if isinstance(before, np.ndarray):
        assert after.dtype == before.dtype, name
        np.testing.assert_array_equal(after, before, err_msg=name)
    elif isinstance(before, tuple):
        assert len(before) == len(after), name
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


def read_back(path: Path, fit: Fit) -> xr.Dataset:
    write(path, fit)
    dataset = read(path)
    assert isinstance(dataset, xr.Dataset)
    return dataset


@pytest.mark.parametrize("noise", ["images", "pixels"])
def test_file_gives_back_the_noise(tmp_path: Path, make_fit: MakeFit, noise: str) -> None:
    fit = make_fit()
    rng = np.random.default_rng(0)
    shape = fit.images.shape if noise == "pixels" else fit.images.shape[:1]
    values = rng.uniform(0.01, 0.1, shape)
    if noise == "pixels":
        values = np.where(fit.mask, values, np.nan)
    fit = dataclasses.replace(fit, noise=values)
    dataset = read_back(tmp_path / "fit.shadowinv", fit)
    again = Fit.from_dataset(dataset)
    assert_same(fit, again)
    np.testing.assert_array_equal(again.normalised_residual, fit.normalised_residual)


def test_noise_of_another_shape_is_refused(make_fit: MakeFit) -> None:
    dataset = make_fit(noise=np.ones(2)).to_dataset()
    dataset["noise"] = ("field",), np.ones(1)
    with pytest.raises(InputError, match="noise has shape"):
        Fit.from_dataset(dataset)


@pytest.mark.parametrize("names", [("B",), ("B", "E")])
@pytest.mark.parametrize("setups", [(), (protons(14.7), protons(1 / 3)), (LIGHT, LIGHT)])
def test_file_gives_back_every_bit(
    tmp_path: Path, make_fit: MakeFit, names: tuple[str, ...], setups: tuple[Any, ...]
) -> None:
    fit = make_fit(names=names, setups=setups)
    dataset = read_back(tmp_path / "fit.shadowinv", fit)
    assert_same(fit, Fit.from_dataset(dataset))
    assert setup_from_dataset(dataset) == (setups[0] if setups else None)
    xr.testing.assert_identical(
        dataset.drop_attrs(deep=False), fit.to_dataset().drop_attrs(deep=False)
    )


def test_unknown_parts_stay_unknown(tmp_path: Path, make_fit: MakeFit) -> None:
    complete_fit = make_fit(
        strengths=(1.0,), assessment=Assessment(Verdict.AMBIGUOUS, "cannot tell")
    )
    fields = tuple(dataclasses.replace(field, errors=None) for field in complete_fit.fields)
    fit = dataclasses.replace(complete_fit, fields=fields)
    again = Fit.from_dataset(read_back(tmp_path / "fit.shadowinv", fit))
    assert_same(fit, again)
    assert again.fields[0].errors is None
    assert again.verdict is Verdict.AMBIGUOUS


def test_a_file_says_that_it_is_a_fit(tmp_path: Path, make_fit: MakeFit) -> None:
    dataset = read_back(tmp_path / "fit.shadowinv", make_fit())
    assert dataset.attrs["format"] == "shadowinv fit"
    assert kind_of(tmp_path / "fit.shadowinv") == "shadowinv"
    # Read, changed and written again it still is one.
    write(tmp_path / "again.shadowinv", dataset)
    again = read(tmp_path / "again.shadowinv")
    assert isinstance(again, xr.Dataset)
    assert_same(Fit.from_dataset(again), Fit.from_dataset(dataset))


def test_every_variable_has_units_and_a_name(make_fit: MakeFit) -> None:
    dataset = make_fit(names=("B", "E"), setups=(protons(14.7), protons(5.0))).to_dataset()
    for name, variable in dataset.data_vars.items():
        assert variable.attrs["units"], name
        assert variable.attrs["long_name"], name
    assert "path_integrated_b_B" in dataset
    assert "path_integrated_b_E" not in dataset


def test_the_field_of_a_fit_is_written_as_pradformat_with_its_verdict(
    tmp_path: Path, make_fit: MakeFit
) -> None:
    fit = make_fit(setups=(protons(14.7), protons(5.0)), assessment=Assessment(Verdict.SEVERAL, ""))
    write(tmp_path / "fit.h5", fit)
    again = read(tmp_path / "fit.h5")
    assert isinstance(again, xr.Dataset)
    setup = setup_from_dataset(again)
    assert isinstance(setup, ProtonSetup)
    assert setup.energy == pytest.approx(14.7)
    assert setup.object_pixel_size == pytest.approx(protons(14.7).object_pixel_size)
    np.testing.assert_allclose(again["displacement"], fit.fields[0].displacement, rtol=1e-12)
    np.testing.assert_allclose(again["potential"], fit.fields[0].potential, rtol=1e-12)
    with h5py.File(tmp_path / "fit.h5") as file:
        assert file.attrs["description"].endswith(": one of several")


@pytest.mark.parametrize(
    ("ending", "names", "setup", "sentence"),
    [
        ("csv", "B", None, r"ending is '\.csv', expected one of \.h5"),
        ("tif", "B", None, r"ending is '\.tif', expected one of \.h5"),
        ("h5", "BE", None, r"holds one field, received B and E: write \.shadowinv"),
        ("h5", "B", None, "needs a setup of kind 'proton'"),
        ("shadowinv", "B", protons(3.0), "received a setup for a fit"),
    ],
)
def test_fits_that_a_format_cannot_hold_are_refused(
    tmp_path: Path, make_fit: MakeFit, ending: str, names: str, setup: Any, sentence: str
) -> None:
    fit = make_fit(names=tuple(names), setups=(protons(3), protons(5)) if "E" in names else ())
    with pytest.raises((FileFormatError, InputError), match=sentence):
        write(tmp_path / f"fit.{ending}", fit, setup=setup)
    assert not list(tmp_path.iterdir())


def test_an_incomplete_dataset_is_refused(make_fit: MakeFit) -> None:
    dataset = make_fit().to_dataset()
    with pytest.raises(InputError, match="no 'brightness': expected the result of a fit"):
        Fit.from_dataset(dataset.drop_vars("brightness"))
    with pytest.raises(InputError, match="no 'displacement': expected the result of a fit"):
        Fit.from_dataset(dataset.drop_vars("displacement"))
    del dataset.attrs["verdict"]
    with pytest.raises(InputError, match="no 'verdict'"):
        Fit.from_dataset(dataset)
