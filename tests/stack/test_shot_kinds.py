"""Every way to pass shots gives the same fields, with the options of a new user."""

from __future__ import annotations

from pathlib import Path

import dask.array as da
import h5py
import numpy as np
import pytest
import tifffile
import xarray as xr
import zarr

from napari_shadowinv import (
    InversionOptions,
    Recipe,
    invert,
    invert_stack,
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


def write_pages(images: np.ndarray, folder: Path) -> Path:
    path = folder / "shots.tif"
    tifffile.imwrite(path, images, photometric="minisblack")
    return path


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


def open_netcdf(images: np.ndarray, folder: Path) -> xr.DataArray:
    xr.Dataset({"image": (("shot", "y", "x"), images)}).to_netcdf(folder / "run.nc")
    return xr.open_dataset(folder / "run.nc").image


KINDS = {
    "numpy": lambda images, _: images,
    "dask of one shot": lambda images, _: da.from_array(images, chunks=(1, -1, -1)),
    "dask of many shots": lambda images, _: da.from_array(images, chunks=(3, 20, -1)),
    "xarray": lambda images, _: xr.DataArray(images, dims=("shot", "y", "x")),
    "xarray of dask": lambda images, _: xr.DataArray(images, dims=("shot", "y", "x")).chunk(),
    "dataset": lambda images, _: xr.Dataset({"image": (("shot", "y", "x"), images)}),
    "pages": write_pages,
    "files": write_files,
    "glob": lambda images, folder: str(write_files(images, folder)[0].parent / "shot_*.tif"),
    "table": write_table,
    "array of HDF5": lambda images, folder: f"{write_hdf5(images, folder)}::/entry/data/data",
    "folder": write_folder,
    "lazy frames": lambda images, folder: read(f"{write_hdf5(images, folder)}::flat"),
    "xarray of a file": open_netcdf,
    "h5py": lambda images, folder: h5py.File(write_hdf5(images, folder))["flat"],
    "zarr": lambda images, _: zarr.array(images),
}


@pytest.fixture(scope="module")
def reference(images):
    return invert_stack(images).compute()


@pytest.mark.parametrize("kind", KINDS)
def test_stack_of_any_kind_runs_with_default_options(kind, images, reference, tmp_path):
    stack = invert_stack(KINDS[kind](images, tmp_path))
    np.testing.assert_array_equal(stack.potential.compute(), reference.potential)


@pytest.mark.parametrize("kind", ["dask of many shots", "table", "array of HDF5"])
def test_store_of_any_kind_runs_with_default_options(kind, images, reference, tmp_path):
    stored = run_stack(KINDS[kind](images, tmp_path), tmp_path / "out.shadowinv.zarr")
    assert (stored.status == DONE).all()
    np.testing.assert_allclose(stored.potential, reference.potential, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "table"])
def test_slice_of_shots_holds_its_shots(kind, images, tmp_path):
    items = find_shots(KINDS[kind](images, tmp_path)).items
    part = items[1:3]
    assert len(part) == 2
    for shot, image in zip(part, images[1:3], strict=True):
        np.testing.assert_array_equal(shot.read()[0], image)


def test_each_shot_has_the_mask_of_its_own_file(images: np.ndarray, tmp_path: Path) -> None:
    shots = images.copy()
    for index, path in enumerate(write_files(shots, tmp_path)):
        shots[index, : index + 1] = -9999  # no light: the file says that it is no value
        tifffile.imwrite(path, shots[index], extratags=[(42113, "s", 0, "-9999", True)])
    options = InversionOptions(n_sites=150)
    run_stack(
        str(tmp_path / "shot_*.tif"),
        tmp_path / "a.shadowinv.zarr",
        Recipe(options=options),
        run=RunOptions(variables=("potential", "mask"), dtype="float64"),
    )
    stored = read(tmp_path / "a.shadowinv.zarr")
    for index, image in enumerate(images):
        usable = np.ones(SHAPE, bool)
        usable[: index + 1] = False
        alone = invert(image, mask=usable, options=options)
        np.testing.assert_array_equal(stored["mask"][index], usable)
        potential = alone.potential - stored["potential"][index].values
        assert np.ptp(potential[usable]) < 1e-3 * np.ptp(alone.potential)
    again = rerun(stored.isel(shot=1), tmp_path / "shot_1.tif")
    np.testing.assert_array_equal(again.dataset["mask"], stored["mask"][1])
    potential = (again.dataset["potential"] - stored["potential"][1]).values[usable]
    assert np.ptp(potential) < 1e-3 * np.ptp(again.dataset["potential"].values[usable])
