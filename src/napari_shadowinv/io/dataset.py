"""A result's dataset as one NetCDF4 file, ``.shadowinv``, or its sites alone as a table."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.inversion.variables import update_labels
from napari_shadowinv.io.hdf5 import check_arrays, check_hdf5_seal, hdf5_in_memory

if TYPE_CHECKING:
    import xarray

_SITE_COLUMNS = "y_px,x_px,weight_px2,mass,flux,displacement_y_px,displacement_x_px"


def write_result(path: Path, dataset: xarray.Dataset) -> None:
    """Write a dataset as NetCDF4, moderately compressed and with checksums."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        packed = {"zlib": True, "shuffle": True, "complevel": 4} if variable.size > 64 else {}
        kind = variable.dtype.kind
        if kind in "fiub":
            # What the index loses is read as NaN, not as 0.
            fill = {"_FillValue": np.nan if kind == "f" else None}
            checked = {"fletcher32": True} if variable.ndim else {}
            encoding[str(name)] = {**packed, **checked, **fill}
    # A field that was read from a file of another format still says so.
    marked = dataset.assign_attrs(format=ResultKind.of(dataset.attrs).value)
    # From this version of the format on, the file's own structures have checksums.
    with (
        hdf5_in_memory(path, seal=True) as content,
        h5netcdf.File(content, "w", libver=("v110", "v110")) as file,
    ):
        marked.dump_to_store(H5NetCDFStore(file), encoding=encoding)


def read_result(path: Path) -> xarray.Dataset:
    """Read a dataset that `write_result` wrote, all of it into memory."""
    import xarray as xr

    check_hdf5_seal(path)
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
