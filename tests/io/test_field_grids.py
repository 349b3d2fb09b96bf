import h5py
import numpy as np
import pytest
import xarray as xr

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import is_field_grid, read, read_field_grid
from napari_shadowinv.io.hdf5_arrays import list_sizes

PLACES = {axis: np.arange(n) * 3.0 - 10 for axis, n in (("z", 6), ("y", 5), ("x", 4))}  # µm


@pytest.fixture
def grid_file(tmp_path):
    z, y, x = np.meshgrid(*PLACES.values(), indexing="ij")
    values = {"Bx": x + 2 * y, "By": 3 * z - x, "Bz": 1 + y - z}
    dataset = xr.Dataset(
        {name: (("z", "y", "x"), each, {"units": "T"}) for name, each in values.items()},
        {axis: (axis, places, {"units": "um"}) for axis, places in PLACES.items()},
    )
    path = tmp_path / "b.nc"
    dataset.to_netcdf(path, engine="h5netcdf")
    return path


def test_netcdf_dataset_is_read(grid_file):
    grid = read_field_grid(grid_file)
    axes = [
        np.linspace(low, high, n) * 1e6
        for (low, high), n in zip(grid.extent, grid.shape, strict=True)
    ]
    z, y, x = np.meshgrid(*axes, indexing="ij")
    for component, truth in zip(grid.magnetic, (1 + y - z, 3 * z - x, x + 2 * y), strict=True):
        np.testing.assert_allclose(component, truth, rtol=1e-6, atol=1e-5)


def test_only_files_with_3d_fields_are_recognised(grid_file, tmp_path):
    assert is_field_grid(grid_file)
    with h5py.File(tmp_path / "image.h5", "w") as file:
        file["image"] = np.ones((4, 4))
    assert not is_field_grid(tmp_path / "image.h5")
    (tmp_path / "text.txt").write_text("1 2")
    assert not is_field_grid(tmp_path / "text.txt")
    assert not is_field_grid(tmp_path / "missing.h5")


def test_files_without_fields_are_refused(grid_file, tmp_path):
    np.save(tmp_path / "plane.npy", np.ones((4, 4)))
    xr.Dataset({"rho": ("x", np.ones(3))}).to_netcdf(tmp_path / "rho.nc", engine="h5netcdf")
    content = grid_file.read_bytes()
    grid_file.write_bytes(content[: len(content) // 2])
    for name, error, sentence in (
        ("plane.npy", FileFormatError, "no HDF5 file: expected a NetCDF"),
        ("rho.nc", InputError, r"rho\.nc"),
        ("b.nc", FileFormatError, "damaged"),
    ):
        with pytest.raises(error, match=sentence):
            read_field_grid(tmp_path / name)


def test_meshes_are_listed_with_their_shapes(grid_file):
    assert dict(list_sizes(grid_file))["Bx"] == "6×5×4 float64"
    with pytest.raises(FileFormatError, match=r"holds fields on a grid, .* shadowinv forward"):
        read(grid_file)
