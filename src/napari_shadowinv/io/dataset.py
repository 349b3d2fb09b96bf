"""A result's dataset as one NetCDF4 file, ``.shadowinv``.

- write and read: `write_result`, `read_result`
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv._system.safety import refusing_damage
from napari_shadowinv.inversion.labels import FORMAT
from napari_shadowinv.io.hdf5 import check_arrays, hdf5_in_memory

if TYPE_CHECKING:
    import xarray

__all__ = ["read_result", "write_result"]


def write_result(path: Path, dataset: xarray.Dataset) -> None:
    """Write a dataset as NetCDF4, moderately compressed.

    Parameters
    ----------
    path : Path
        The file.
    dataset : xarray.Dataset
        What to write.

    Raises
    ------
    OSError
        If there is no room for it.
    """
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    encoding: dict[str, dict[str, Any]] = {}
    for name, variable in dataset.variables.items():
        numeric = variable.dtype.kind in "fiub"
        packed = {"zlib": True, "shuffle": True, "complevel": 4} if variable.size > 64 else {}
        if numeric:
            encoding[str(name)] = {**packed, "_FillValue": None}
    # A field that was read from a file of another format still says so.
    marked = dataset.assign_attrs(format=FORMAT)
    with hdf5_in_memory(path) as content, h5netcdf.File(content, "w") as file:
        marked.dump_to_store(H5NetCDFStore(file), encoding=encoding)


@refusing_damage
def read_result(path: Path) -> xarray.Dataset:
    """Read a dataset that `write_result` wrote, all of it into memory.

    Parameters
    ----------
    path : Path
        A ``.shadowinv`` file.

    Returns
    -------
    xarray.Dataset
        The same variables, coordinates and attributes.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    import xarray as xr

    check_arrays(path)
    # Nothing in it is a time, whatever its units look like.
    return xr.load_dataset(path, engine="h5netcdf", decode_times=False)
