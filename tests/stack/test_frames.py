"""Stacks whose shots are frames of one file: no run reads more than a shot at a time."""

from __future__ import annotations

from pathlib import Path

import dask.array as da
import h5py
import numpy as np
import pytest
import xarray as xr

from helpers.command_line import done, shadowinv
from napari_shadowinv import InputError, read
from napari_shadowinv.io.store import DONE, FAILED


class LoggedArray:
    """An array whose parts are read from a file, such as h5py's; it counts the frames of each."""

    def __init__(self, images: np.ndarray) -> None:
        self._images, self.counts = images, []
        self.shape, self.dtype, self.ndim = images.shape, images.dtype, images.ndim

    def __getitem__(self, key: object) -> np.ndarray:
        part = self._images[key]
        self.counts.append(part.shape[0] if part.size else 0)
        return part


@pytest.fixture
def run_file(tmp_path: Path, any_night) -> Path:
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "entry/data/data", data=any_night.images, maxshape=(None, 24, 28), chunks=(1, 24, 28)
        )
    return path


def append_frame(path: Path, frame: np.ndarray) -> None:
    with h5py.File(path, "r+") as file:
        data = file["entry/data/data"]
        data.resize(len(data) + 1, axis=0)
        data[-1] = frame


@pytest.mark.parametrize("chunk", [None, 1, 4])
def test_array_of_a_file_is_read_shot_by_shot(any_night, out, chunk):
    logged = LoggedArray(any_night.images)
    shots = logged if chunk is None else da.from_array(logged, chunks=(chunk, -1, -1))
    stored = any_night.run(out, shots=shots)
    assert (stored.status == DONE).all()
    assert max(logged.counts) == 1


def test_dataset_of_a_file_is_never_loaded_whole(any_night, tmp_path, out):
    path = tmp_path / "run.nc"
    xr.Dataset({"image": (("pulse", "y", "x"), any_night.images)}).to_netcdf(path)
    with xr.open_dataset(path) as dataset:
        assert any_night.run(out, shots=dataset).potential[3].notnull().all()
        assert not dataset.image.variable._in_memory


def test_frames_appended_to_a_file_are_inverted_later(any_night, run_file, out):
    address = f"{run_file}::/entry/data/data"
    stored = any_night.run(out, shots=address)
    assert list(stored.name.values) == [f"run.h5[{i}]" for i in range(6)]
    append_frame(run_file, any_night.images[2])
    again = any_night.run(out, shots=address)
    assert again.sizes["shot"] == 7
    np.testing.assert_array_equal(again.potential[6], again.potential[2])
    with h5py.File(run_file, "r+") as file:
        file["entry/data/data"][1] *= 2
    with pytest.raises(InputError, match=r"shot 1 \(run.h5\[1\]\) has changed since"):
        any_night.run(out, shots=address)


def test_another_array_of_the_same_files_is_another_shot(any_night, out, tmp_path):
    for index in (0, 1):
        with h5py.File(tmp_path / f"{index}.h5", "w") as file:
            file["a"], file["b"] = any_night.images[index], any_night.images[2]
    any_night.run(out, shots=f"{tmp_path}/*.h5::a")
    any_night.run(out, shots=f"{tmp_path}/*.h5::a")
    with pytest.raises(InputError, match=r"shot 0 \(0.h5\) has changed since"):
        any_night.run(out, shots=f"{tmp_path}/*.h5::b")


def test_frame_that_is_missing_fails_alone(any_night, run_file, out):
    with h5py.File(run_file, "r+") as file:
        file["entry/data/data"].resize(8, axis=0)
    stored = any_night.run(out, shots=f"{run_file}::/entry/data/data")
    assert list(stored.status.values) == [DONE] * 6 + [FAILED] * 2
    assert "does not hold frame 6" in str(stored.report.values[6])


def test_batch_and_info_take_arrays_of_hdf5(any_night, run_file, out, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    usable = np.ones(any_night.source.shape, np.uint8)
    usable[:3] = 0
    data = "run.h5::/entry/data/data"
    with h5py.File(run_file, "r+") as file:
        file["entry/beam"], file["entry/usable"] = any_night.source, usable
    (tmp_path / "table.csv").write_text(f"file, mask\n{data}[1], run.h5::/entry/usable\n")
    common = ("--source", "run.h5::/entry/beam", "--set=options.n_sites=100", "--out", out)
    shadowinv("batch", "table.csv", *common)
    row = read(out)
    expected = any_night.run(out.with_name("expected.shadowinv.zarr"), mask=usable > 0)
    np.testing.assert_array_equal(row.displacement[0], expected.displacement[1])
    np.testing.assert_array_equal(row.mask, [usable != 0])
    assert list(row.name.values) == [f"{data}[1]"]

    listed = done("info", data)
    assert "6 frames, run.h5[0] to run.h5[5]" in listed
    assert "(6, 24, 28), [shot, y, x]" in listed
    assert "such as 'entry/data/data[0]'" in done("invert", "run.h5::entry/data/data", code=2)
