"""Every way to pass shots gives the same fields, with the options of a new user."""

from __future__ import annotations

import pickle
from pathlib import Path

import dask.array as da
import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
import zarr

from helpers.stacks import inverted_stack
from napari_shadowinv import (
    InversionOptions,
    Recipe,
    invert,
    read,
    run_stack,
    synthetic_image,
)
from napari_shadowinv.io.store import DONE
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import RunOptions, rerun
from napari_shadowinv.stack._shots import find_shots

SHAPE, COUNT = (32, 36), 4


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    """Shots of a blob that moves, as a camera would store them."""
    blobs = [gaussian_blob(SHAPE, 4.0, 5.0, (14, 14 + 2 * shot)) for shot in range(COUNT)]
    return np.stack([synthetic_image(blob.displacement) for blob in blobs]).astype(np.float32)


def write_files(images: np.ndarray, folder: Path) -> list[Path]:
    paths = [folder / f"shot_{shot}.tif" for shot in range(len(images))]
    for path, image in zip(paths, images, strict=True):
        tifffile.imwrite(path, image)
    return paths


def write_table(images: np.ndarray, folder: Path) -> Path:
    names = [path.name for path in write_files(images, folder)]
    path = folder / "shots.csv"
    path.write_text("\n".join(["file", *names]) + "\n", encoding="utf-8")
    return path


def write_hdf5(images: np.ndarray, folder: Path) -> Path:
    path = folder / "run.h5"
    with h5py.File(path, "w") as file:
        file["entry/data/data"] = images.reshape(2, -1, *SHAPE)
        file["flat"] = images
    return path


def write_folder(images: np.ndarray, folder: Path) -> Path:
    return write_files(images, folder)[0].parent


KINDS = {
    "numpy": lambda images, _: images,
    "dask of one shot": lambda images, _: da.from_array(images, chunks=(1, -1, -1)),
    "dask of many shots": lambda images, _: da.from_array(images, chunks=(3, 20, -1)),
    "xarray": lambda images, _: xr.DataArray(images, dims=("shot", "y", "x")),
    "xarray of dask": lambda images, _: xr.DataArray(images, dims=("shot", "y", "x")).chunk(),
    "dataset": lambda images, _: xr.Dataset({"image": (("shot", "y", "x"), images)}),
    "files": write_files,
    "glob": lambda images, folder: str(write_files(images, folder)[0].parent / "shot_*.tif"),
    "table": write_table,
    "array of HDF5": lambda images, folder: f"{write_hdf5(images, folder)}::/entry/data/data",
    "folder": write_folder,
    "lazy frames": lambda images, folder: read(f"{write_hdf5(images, folder)}::flat"),
    "h5py": lambda images, folder: h5py.File(write_hdf5(images, folder))["flat"],
    "zarr": lambda images, _: zarr.array(images),
}


@pytest.fixture(scope="module")
def reference(images, tmp_path_factory):
    return inverted_stack(images, tmp_path_factory.mktemp("reference"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_stack_of_any_kind_runs_with_default_options(kind, images, reference, tmp_path):
    shots = KINDS[kind](images, tmp_path)
    stored = inverted_stack(shots, tmp_path)
    assert (stored.status == DONE).all()
    np.testing.assert_array_equal(stored.potential, reference.potential)
    if kind != "table":
        part = find_shots(shots).items[1:3]
        assert len(part) == 2
        for shot, image in zip(part, images[1:3], strict=True):
            np.testing.assert_array_equal(shot.load()[0].image, image)


def test_a_shot_has_the_mask_of_its_own_file_and_that_of_all(images, tmp_path):
    shots, common = images.astype(np.float64), np.random.default_rng(4).random(SHAPE) > 0.02
    tifffile.imwrite(tmp_path / "mask.tif", common.astype(np.uint8))
    for index, path in enumerate(write_files(shots, tmp_path)):
        shots[index, : index + 1] = np.nan
        tifffile.imwrite(path, shots[index])
    recipe = Recipe(mask=tmp_path / "mask.tif", options=InversionOptions(n_sites=150))
    chosen = RunOptions(variables=("potential", "mask"), dtype="float64")
    out = tmp_path / "a.shadowinv.zarr"
    stored = run_stack(str(tmp_path / "shot_*.tif"), out, recipe, run=chosen)

    def assert_close(potential, expected, usable) -> None:
        assert np.ptp((potential - expected)[usable]) < 1e-3 * np.ptp(expected[usable])

    for index, image in enumerate(images):
        usable = common & (np.arange(SHAPE[0]) > index)[:, None]
        np.testing.assert_array_equal(stored["mask"][index], usable)
        alone = invert(image, mask=usable, options=recipe.options)
        assert_close(stored["potential"][index].values, alone.potential, usable)
    again = rerun(read(out).isel(shot=1), tmp_path / "shot_1.tif").dataset
    np.testing.assert_array_equal(again["mask"], stored["mask"][1])
    assert_close(again["potential"].values, stored["potential"][1].values, stored["mask"][1].values)


@pytest.mark.parametrize("kind", ["numpy", "dask"])
def test_a_shot_of_an_array_is_sent_to_a_process_without_the_others(images, kind):
    """The bytes of one image, which is the same there."""
    array = images if kind == "numpy" else da.from_array(images, chunks=(1, *SHAPE))
    for number, shot in enumerate(find_shots(array).items):
        sent = pickle.dumps(shot)
        assert len(sent) < 2 * images[0].nbytes
        np.testing.assert_array_equal(pickle.loads(sent).load()[0].image, images[number])
