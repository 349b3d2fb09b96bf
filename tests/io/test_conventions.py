"""Values in HDF5 files mean what CF and NeXus say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from helpers.stacks import inverted_stack
from napari_shadowinv import FileFormatError, InversionOptions, Recipe, read
from napari_shadowinv.io import read_shot

COUNTS = np.arange(15, dtype=np.int16).reshape(3, 5)


@pytest.fixture
def file(tmp_path: Path) -> Iterator[Any]:
    with h5py.File(tmp_path / "run.h5", "w") as content:
        yield content


def shot_in(file: Any, name: str = "data") -> Any:
    """Return what is read from a file that is still open for writing."""
    path = file.filename
    file.close()
    return read_shot(f"{path}::{name}")


def test_packed_values_of_netcdf_are_those_of_xarray(tmp_path: Path) -> None:
    path = tmp_path / "shot.nc"
    image = np.array([[0.5, 1.0], [np.nan, 10.0]])
    packing = {"dtype": "int16", "scale_factor": 0.5, "add_offset": 3.0, "_FillValue": -99}
    xr.Dataset({"image": (("y", "x"), image)}).to_netcdf(
        path, engine="h5netcdf", encoding={"image": packing}
    )
    shot = read(path)
    np.testing.assert_array_equal(shot.image, image)
    np.testing.assert_array_equal(shot.mask, np.isfinite(image))
    assert shot.metadata["dtype"] == "int16"


@pytest.mark.parametrize("prefix", ["", "data_"])
def test_offset_of_nexus_is_added_before_its_factor(file: Any, prefix: str) -> None:
    file["entry/data"] = COUNTS
    file[f"entry/{prefix}offset"], file[f"entry/{prefix}scaling_factor"] = 5.0, 2.0
    np.testing.assert_array_equal(shot_in(file, "entry/data").image, (COUNTS + 5) * 2)


def test_several_factors_are_refused(file: Any) -> None:
    file["one"], file["one_scaling_factor"] = COUNTS, np.ones(7)
    with pytest.raises(FileFormatError, match="7 numbers in 'one_scaling_factor'"):
        shot_in(file, "one")


def nexus(file: Any, frames: Any) -> Any:
    """Write frames as a detector does, its description elsewhere in the entry."""
    file["entry/data/data"] = frames
    detector = file.create_group("entry/instrument/detector")
    detector.attrs["NX_class"] = "NXdetector"
    return detector


def test_pixels_that_a_nexus_detector_rejects_are_left_out(file: Any) -> None:
    detector = nexus(file, COUNTS)
    flags = np.zeros((3, 5), np.uint32)
    flags[0, 1], flags[2, 2] = 1, 1 << 31  # a gap; interpolated, but good
    detector["pixel_mask"] = flags
    shot = shot_in(file, "entry/data/data")
    expected = np.ones((3, 5), bool)
    expected[0, 1] = False
    np.testing.assert_array_equal(shot.mask, expected)
    assert np.isnan(shot.image[0, 1])
    assert any("1 pixels left out, pixel_mask" in note for note in shot.notes)


def test_pixel_mask_of_each_frame_is_its_own(file: Any) -> None:
    flags = np.zeros((2, 3, 5), np.uint32)
    flags[1, 2, 0] = 1
    nexus(file, np.stack([COUNTS, COUNTS]))["pixel_mask"] = flags
    path = file.filename
    assert shot_in(file, "entry/data/data[0]").mask is None
    assert not read_shot(f"{path}::entry/data/data[1]").mask[2, 0]


@pytest.mark.parametrize("as_dataset", [True, False])
def test_a_stack_leaves_out_the_pixels_of_the_file(tmp_path: Path, as_dataset: bool) -> None:
    path = tmp_path / "run.h5"
    frames = np.full((2, 24, 24), 2**32 - 1, np.uint32)
    usable = np.ones((24, 24), bool)
    usable[10:13] = False
    frames[:, usable] = 100
    with h5py.File(path, "w") as content:
        nexus(content, frames)["pixel_mask"] = (~usable).astype(np.uint32)
    shots = read(path) if as_dataset else path
    results = inverted_stack(shots, tmp_path, Recipe(options=InversionOptions(n_sites=100)))
    np.testing.assert_array_equal(results["mask"], [usable, usable])
    assert float(np.abs(results["displacement"]).max()) < 0.5
