"""Electric and magnetic fields on 3-D grids from files.

- whether a file holds them: `is_field_grid`; read them: `read_field_grid`

Two layouts of HDF5 files are read: openPMD (https://github.com/openPMD/openPMD-standard, version 1
and 2), which most particle-in-cell codes write, and NetCDF 4 as xarray writes a dataset with the
variables Bx, By, Bz or Ex, Ey, Ez.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_memory, check_regular
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.hdf5 import (
    check_arrays,
    load_dataset,
    member,
    open_hdf5,
    plain_value,
)
from napari_shadowinv.physics.field_grid import AXES, FieldGrid, field_grid

_COMPONENT = re.compile(r"[BE]_?[xyz]", re.IGNORECASE)
_EXPECTED = "an openPMD file or a NetCDF 4 file with Bx, By, Bz or Ex, Ey, Ez"
_SAME_PLACE = 1e-6  # of a cell


@as_file_errors
def is_field_grid(path: Path) -> bool:
    """Return whether a file holds fields on a 3-D grid; false for a file that cannot be read."""
    import h5py

    if not path.is_file() or not h5py.is_hdf5(path):
        return False
    with open_hdf5(path) as content:
        return "openPMD" in content.attrs or any(
            getattr(content.get(name), "ndim", 0) >= len(AXES)
            for name in filter(_COMPONENT.fullmatch, content)
        )


@as_file_errors
def read_field_grid(path: Path, *, iteration: str | int | None = None) -> FieldGrid:
    """Read E and B from a file.

    Parameters
    ----------
    path : str or Path
        An openPMD file (HDF5) with Cartesian 3-D meshes E, B or both, or a NetCDF 4 file; see
        `napari_shadowinv.physics.field_grid.field_grid` for its variables.
    iteration : str or int, optional
        Iteration of an openPMD file that holds several.

    Returns
    -------
    FieldGrid
        In the axes of the file, with x, y and z as they are named there; `FieldGrid.turned` brings
        them into the beam's frame. Components of a staggered mesh are averaged to the middle of
        the cells.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged or of another kind.
    InputError
        If it holds no Cartesian 3-D field, several iterations, or no units.
    """
    import h5py

    check_regular(path, _EXPECTED)
    if not h5py.is_hdf5(path):
        raise FileFormatError(f"{path} is no HDF5 file: expected {_EXPECTED}")
    with open_hdf5(path) as content:
        if "openPMD" in content.attrs:
            return _read_openpmd(path, content, iteration)
    if iteration is not None:
        raise InputError(f"received iteration {iteration}, but {path} is no openPMD file")
    import xarray as xr

    check_arrays(path)
    try:
        return field_grid(xr.load_dataset(path, engine="h5netcdf", decode_times=False))
    except InputError as error:
        raise error.about(path) from error


def _read_openpmd(path: Path, content: Any, iteration: str | int | None) -> FieldGrid:
    group = _choose_iteration(path, content, iteration)
    meshes = member(path, group, plain_value(content.attrs.get("meshesPath", "fields/")))
    meshes = {} if meshes is None else meshes
    records = {symbol: meshes[symbol] for symbol in ("B", "E") if symbol in meshes}
    if not records:
        raise InputError(f"{path} has no mesh E or B: expected fields on a grid")
    fields, geometries = {}, []
    for symbol, record in records.items():
        fields[symbol], *geometry = _read_mesh(path, record, symbol)
        geometries.append(geometry)
    if len({field.shape for field in fields.values()}) > 1 or not all(
        np.allclose(geometry, geometries[0], rtol=_SAME_PLACE) for geometry in geometries
    ):
        raise InputError(f"{path} has E and B on different grids: expected one grid for both")
    spacing, centre = geometries[0]
    magnetic, electric = fields.get("B"), fields.get("E")
    return FieldGrid(magnetic, electric, spacing=spacing.tolist(), centre=centre.tolist())


def _choose_iteration(path: Path, content: Any, iteration: str | int | None, most: int = 10) -> Any:
    """Return the group of the only iteration, or of the chosen one."""
    base = plain_value(content.attrs.get("basePath", "/data/%T/"))
    parent = member(path, content, base.partition("%T")[0].strip("/"))
    names = [] if parent is None else [name for name in parent if name.isdecimal()]
    if not names:
        raise InputError(f"{path} has no iteration in {base!r}: expected an openPMD file with data")
    number = names[0] if iteration is None else str(iteration)
    if number not in names or (iteration is None and len(names) > 1):
        listed = ", ".join(sorted(names, key=int)[:most]) + ", …" * (len(names) > most)
        raise InputError(f"{path} has the iterations {listed}: choose one of them")
    return member(path, parent, number)


def _read_mesh(path: Path, record: Any, symbol: str) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return a vector field, components and axes in the order (z, y, x), its spacing and middle."""
    geometry = plain_value(record.attrs.get("geometry", "cartesian"))
    labels = [plain_value(name).lower() for name in np.ravel(record.attrs.get("axisLabels", []))]
    if geometry != "cartesian" or sorted(labels) != sorted(AXES):
        raise InputError(
            f"{path} has {symbol} on a {geometry} mesh with the axes "
            f"{', '.join(labels) or 'none'}: expected a cartesian one with x, y and z; resample it"
        )
    # One number before version 2, then one for each axis.
    unit = np.broadcast_to(np.ravel(record.attrs["gridUnitSI"]).astype(float), len(AXES))
    spacing = np.ravel(record.attrs["gridSpacing"]).astype(float) * unit
    offset = np.ravel(record.attrs["gridGlobalOffset"]).astype(float) * unit
    step = -1 if plain_value(record.attrs.get("dataOrder", "C")) == "F" else 1
    # An array is read with its slowest axis first; the labels of Fortran order begin with the
    # fastest.
    labels, spacing, offset = labels[::step], spacing[::step], offset[::step]
    order = [labels.index(axis) for axis in AXES]
    parts, places = [], []
    for axis in AXES:
        item = record[axis]
        values = _component(path, item) * float(np.ravel(item.attrs["unitSI"])[0])
        # Six components, twice in double precision.
        check_memory(values.shape, 100, "a field")
        place = np.ravel(item.attrs.get("position", [0.0] * 3)).astype(float)[::step]
        parts.append(values.transpose(order))
        places.append(place[order])
    parts, place = _collocate(parts, np.array(places))
    spacing, offset = spacing[order], offset[order]
    middle = offset + spacing * (place + (np.array(parts[0].shape) - 1) / 2)
    return np.stack(parts), spacing, middle


def _component(path: Path, item: Any) -> AnyArray:
    """Return the values of a component, which may be constant."""
    if hasattr(item, "dtype"):
        return load_dataset(path, item).astype(np.float64)
    shape = tuple(int(count) for count in np.ravel(item.attrs["shape"]))
    # A view of one number takes no memory, whatever shape the file claims.
    return np.broadcast_to(np.float64(np.ravel(item.attrs["value"])[0]), shape)


def _collocate(parts: Sequence[AnyArray], places: FloatArray) -> tuple[list[AnyArray], FloatArray]:
    """Bring components to common nodes, by linear interpolation along each axis that differs."""
    parts = list(parts)
    place = places[0].copy()
    for axis in range(len(AXES)):
        if np.ptp(places[:, axis]) < _SAME_PLACE:
            continue
        place[axis] = 0.5
        for k, part in enumerate(parts):
            share = 0.5 - places[k, axis]
            low, high = (
                part.take(range(first, part.shape[axis] - 1 + first), axis=axis) for first in (0, 1)
            )
            if share >= 0:
                parts[k] = (1 - share) * low + share * high
            else:
                raise InputError(
                    f"a component lies at {places[k, axis]:g} of a cell: expected a position from "
                    "0 to 0.5, as in a staggered mesh"
                )
    return parts, place
