"""A result's dataset as one NetCDF4 file, ``.shadowinv``, or its sites alone as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.labels import FORMAT, is_fit, is_pack, update_labels
from napari_shadowinv.io.hdf5 import check_arrays, hdf5_in_memory

if TYPE_CHECKING:
    import xarray

_SITE_COLUMNS = "y_px,x_px,weight_px2,mass,flux,displacement_y_px,displacement_x_px"


def write_result(path: Path, dataset: xarray.Dataset) -> None:
    """Write a dataset as NetCDF4, moderately compressed."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        packed = {"zlib": True, "shuffle": True, "complevel": 4} if variable.size > 64 else {}
        if variable.dtype.kind in "fiub":
            encoding[str(name)] = {**packed, "_FillValue": None}
    # A field that was read from a file of another format still says so.
    says_so = is_fit(dataset.attrs) or is_pack(dataset.attrs)
    marked = dataset if says_so else dataset.assign_attrs(format=FORMAT)
    with hdf5_in_memory(path) as content, h5netcdf.File(content, "w") as file:
        marked.dump_to_store(H5NetCDFStore(file), encoding=encoding)


def read_result(path: Path) -> xarray.Dataset:
    """Read a dataset that `write_result` wrote, all of it into memory."""
    import xarray as xr

    check_arrays(path)
    # Nothing in it is a time, whatever its units look like.
    return update_labels(xr.load_dataset(path, engine="h5netcdf", decode_times=False))


def write_sites(path: Path, dataset: xarray.Dataset) -> None:
    """Write the sites of a result as comma-separated values, one in each row."""
    names = ("sites", "weights", "site_mass", "site_flux", "site_displacement")
    require(dataset, names)
    columns = np.column_stack([dataset[name].values for name in names])
    np.savetxt(path, columns, delimiter=",", header=_SITE_COLUMNS, comments="", fmt="%.17g")


def require(dataset: xarray.Dataset, names: tuple[str, ...]) -> None:
    """Refuse a dataset without some variables."""
    missing = [name for name in names if name not in dataset.variables]
    if missing:
        raise InputError(
            f"dataset has no {', '.join(map(repr, missing))}: expected the result of an inversion"
        )
