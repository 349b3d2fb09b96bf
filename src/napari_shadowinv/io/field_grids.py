"""Electric and magnetic fields on 3-D grids from files, NetCDF 4 as xarray writes it.

- whether a file holds them: `is_field_grid`; read them: `read_field_grid`
"""

from __future__ import annotations

from pathlib import Path

from napari_shadowinv._system.safety import as_file_errors, check_regular
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.hdf5 import check_arrays, open_hdf5
from napari_shadowinv.physics.field_grid import AXES, COMPONENT, FieldGrid, field_grid


@as_file_errors
def is_field_grid(path: Path) -> bool:
    """Return whether a file holds fields on a 3-D grid; false for a file that cannot be read."""
    import h5py

    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as content:
        names = filter(COMPONENT.fullmatch, content)
        return any(getattr(content.get(name), "ndim", 0) >= len(AXES) for name in names)


@as_file_errors
def read_field_grid(path: Path) -> FieldGrid:
    """Read E and B from a file.

    Parameters
    ----------
    path : str or Path
        A NetCDF 4 file; see `napari_shadowinv.physics.field_grid.field_grid` for its variables.

    Returns
    -------
    FieldGrid
        In the axes of the file, with x, y and z as they are named there; `FieldGrid.turned` brings
        them into the beam's frame.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged or of another kind.
    InputError
        If it holds no 3-D field, or no units.
    """
    import h5py
    import xarray as xr

    expected = "a NetCDF 4 file with Bx, By, Bz or Ex, Ey, Ez"
    check_regular(path, expected)
    if not h5py.is_hdf5(path):
        raise FileFormatError(f"{path} is no HDF5 file: expected {expected}")
    check_arrays(path)
    try:
        return field_grid(xr.load_dataset(path, engine="h5netcdf", decode_times=False))
    except InputError as error:
        raise error.about(path) from error
