import h5py
import numpy as np
import pytest
import xarray as xr

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io import is_field_grid, read, read_field_grid
from napari_shadowinv.io.hdf5_arrays import list_sizes

SHAPE = {"z": 6, "y": 5, "x": 4}
SPACING = {"z": 3.0, "y": 2.0, "x": 1.0}  # µm
ORIGIN = {"z": -10.0, "y": 4.0, "x": 1.0}


def field_at(z, y, x):
    """A field that linear interpolation reproduces, by places in µm."""
    return {"x": x + 2 * y, "y": 3 * z - x, "z": 1 + y - z}


def places(axis, shift=0.0):
    return ORIGIN[axis] + SPACING[axis] * (np.arange(SHAPE[axis]) + shift)


def write_openpmd(path, labels="zyx", order="C", positions=None, iterations=(7,), unit=10.0):
    """Write B, in 10 T, as a simulation would."""
    positions = positions or dict.fromkeys("xyz", (0.0, 0.0, 0.0))
    with h5py.File(path, "w") as file:
        file.attrs.update(openPMD="1.1.0", basePath="/data/%T/", meshesPath="fields/")
        for iteration in iterations:
            record = file.create_group(f"data/{iteration}/fields/B")
            step = -1 if order == "F" else 1
            record.attrs.update({
                "geometry": "cartesian",
                "dataOrder": order,
                "axisLabels": [name.encode() for name in labels[::step]],
                "gridSpacing": [SPACING[name] for name in labels[::step]],
                "gridGlobalOffset": [ORIGIN[name] for name in labels[::step]],
                "gridUnitSI": 1e-6,
            })  # fmt: skip
            for name, position in positions.items():
                shift = dict(zip("zyx", position, strict=True))
                mesh = np.meshgrid(*(places(axis, shift[axis]) for axis in "zyx"), indexing="ij")
                values = field_at(*mesh)[name].transpose(["zyx".index(axis) for axis in labels])
                item = record.create_dataset(name, data=values.astype(np.float32))
                item.attrs["unitSI"] = unit
                item.attrs["position"] = [shift[axis] for axis in labels[::step]]
    return path


def check_grid(grid):
    axes = [
        np.linspace(low, high, n) * 1e6
        for (low, high), n in zip(grid.extent, grid.shape, strict=True)
    ]
    truth = field_at(*np.meshgrid(*axes, indexing="ij"))
    for component, axis in zip(grid.magnetic, "zyx", strict=True):
        np.testing.assert_allclose(component, 10 * truth[axis], rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("labels", ["zyx", "xyz", "yzx"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_openpmd_mesh_is_read_in_the_order_of_its_axes(tmp_path, labels, order):
    grid = read_field_grid(write_openpmd(tmp_path / "b.h5", labels, order))
    assert grid.shape == (6, 5, 4)
    np.testing.assert_allclose(grid.spacing, [3e-6, 2e-6, 1e-6])
    assert grid.extent[0] == pytest.approx((-10e-6, 5e-6))
    check_grid(grid)


def test_staggered_components_are_brought_to_common_nodes(tmp_path):
    positions = {"x": (0.5, 0.5, 0.0), "y": (0.5, 0.0, 0.5), "z": (0.0, 0.5, 0.5)}
    grid = read_field_grid(write_openpmd(tmp_path / "b.h5", positions=positions))
    assert grid.shape == (5, 4, 3)
    check_grid(grid)


def test_iteration_is_chosen_by_its_number(tmp_path):
    path = write_openpmd(tmp_path / "b.h5", iterations=(7, 100))
    with pytest.raises(InputError, match="iterations 7, 100: choose"):
        read_field_grid(path)
    with pytest.raises(InputError, match="iterations 7, 100: choose"):
        read_field_grid(path, iteration=8)
    check_grid(read_field_grid(path, iteration=100))
    # A group that is no number is no iteration.
    path = write_openpmd(tmp_path / "c.h5", iterations=(7, "²"))
    check_grid(read_field_grid(path))
    # A constant component is in attributes.
    with h5py.File(path, "a") as file:
        del file["data/7/fields/B/z"]
        item = file.create_group("data/7/fields/B/z")
        item.attrs.update(value=0.5, shape=[6, 5, 4], unitSI=10.0, position=[0.0, 0.0, 0.0])
    np.testing.assert_allclose(read_field_grid(path).magnetic[0], 5.0)


def test_netcdf_dataset_is_read(tmp_path):
    mesh = np.meshgrid(*(places(axis) for axis in "zyx"), indexing="ij")
    dataset = xr.Dataset(
        {
            f"B{axis}": (("z", "y", "x"), 10 * values, {"units": "T"})
            for axis, values in field_at(*mesh).items()
        },
        {axis: (axis, places(axis), {"units": "um"}) for axis in "zyx"},
    )
    path = tmp_path / "b.nc"
    dataset.to_netcdf(path, engine="h5netcdf")
    assert is_field_grid(path)
    check_grid(read_field_grid(path))


def test_only_files_with_3d_fields_are_recognised(tmp_path):
    assert is_field_grid(write_openpmd(tmp_path / "b.h5"))
    with h5py.File(tmp_path / "image.h5", "w") as file:
        file["image"] = np.ones((4, 4))
    assert not is_field_grid(tmp_path / "image.h5")
    (tmp_path / "text.txt").write_text("1 2")
    assert not is_field_grid(tmp_path / "text.txt")
    assert not is_field_grid(tmp_path / "missing.h5")


@pytest.mark.parametrize(
    ("place", "change", "sentence"),
    [
        ("data/7/fields/B", {"geometry": "thetaMode"}, "expected a cartesian one"),
        ("data/7/fields/B", {"axisLabels": [b"r", b"z"]}, "expected a cartesian one"),
        ("data/7/fields/B", {"gridUnitSI": None}, "gridUnitSI"),
        ("data/7/fields/B/x", {"unitSI": None}, "unitSI"),
    ],
)
def test_other_meshes_and_grids_without_units_are_refused(tmp_path, place, change, sentence):
    path = write_openpmd(tmp_path / "b.h5")
    with h5py.File(path, "a") as file:
        for name, value in change.items():
            del file[place].attrs[name]
            if value is not None:
                file[place].attrs[name] = value
    with pytest.raises((InputError, FileFormatError), match=sentence):
        read_field_grid(path)


def test_files_without_fields_are_refused(tmp_path):
    np.save(tmp_path / "plane.npy", np.ones((4, 4)))
    xr.Dataset({"rho": ("x", np.ones(3))}).to_netcdf(tmp_path / "rho.nc", engine="h5netcdf")
    content = write_openpmd(tmp_path / "b.h5").read_bytes()
    (tmp_path / "b.h5").write_bytes(content[: len(content) // 2])
    for name, error, sentence in (
        ("plane.npy", FileFormatError, "no HDF5 file: expected an openPMD file or a NetCDF"),
        ("rho.nc", InputError, r"rho\.nc"),
        ("b.h5", FileFormatError, "damaged"),
    ):
        with pytest.raises(error, match=sentence):
            read_field_grid(tmp_path / name)


def test_meshes_are_listed_with_their_shapes(tmp_path):
    path = write_openpmd(tmp_path / "b.h5")
    assert dict(list_sizes(path))["data/7/fields/B/x"] == "6×5×4 float32"
    with pytest.raises(FileFormatError, match=r"holds fields on a grid, .* shadowinv forward"):
        read(path)
