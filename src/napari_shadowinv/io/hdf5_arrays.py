"""Images in any HDF5 file, by the names of their arrays.

- an array, or one of its frames: `read_hdf5`; as an image with all that the file says of it:
  `read_plane`
- the number of frames: `count_frames`
- the names of images: `list_images`; of all arrays: `list_sizes`
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_regular
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.arrays import (
    ONE_AXIS,
    ArrayEntry,
    find_array,
    frame_axes,
    frame_number,
    list_arrays,
)
from napari_shadowinv.io.conventions import (
    decode_values,
    is_of_matlab,
    read_meaning,
)
from napari_shadowinv.io.field_grids import is_field_grid
from napari_shadowinv.io.hdf5 import (
    is_elsewhere,
    items_of,
    load_dataset,
    member,
    open_hdf5,
    plain_value,
)

_DEFAULTS = ("signal", "default")  # attributes of a NeXus group: its array, or the group to look in
_KINDS = {"c": "complex", "S": "text", "U": "text", "O": "text or references", "V": "compound"}


@as_file_errors
def read_hdf5(path: Path, name: str) -> AnyArray:
    """Read the values of an array of any shape, ``shots/3/image``, NaN where it has none."""
    with open_hdf5(path) as file:
        dataset, number = _find_array(path, file, name)
        stored = _stored(path, dataset, number)
        return decode_values(path, dataset, stored)


def read_plane(path: Path, name: str, number: int = 0) -> tuple[AnyArray, dict[str, Any]]:
    """Read one array as an image, or frame `number` of it over the axes before the last two."""
    with open_hdf5(path) as file:
        dataset, frame_in_name = _find_array(path, file, name)
        frame_axes(path, repr(name), dataset.shape)
        number = number if frame_in_name is None else frame_in_name
        stored = _stored(path, dataset, number)
        image, metadata = read_meaning(path, dataset, stored, number)
        return image, {"kind": "hdf5", "variable": name, **metadata}


def count_frames(path: Path, name: str) -> tuple[int, ...]:
    """Return the lengths of the axes before the last two of an array; none if it is one image."""
    with open_hdf5(path) as file:
        dataset, number = _find_array(path, file, name)
        axes = frame_axes(path, repr(name), dataset.shape)
        return axes if number is None else ()


def list_images(path: Path) -> tuple[list[str], list[ArrayEntry]]:
    """Return the names of all images, or of the one that NeXus shows by default; and all arrays."""
    check_regular(path, "an HDF5 file")
    if is_field_grid(path):
        raise FileFormatError(
            f"{path} holds fields on a grid, not an image: trace particles through them with "
            "shadowinv forward, or name one array of it"
        )
    with open_hdf5(path) as file:
        entries = list(_entries(file))
        default = _member_or_default(file, "/")
        if default is not None and not _reason(default):
            return [str(default.name)], entries
    names = [entry.name for entry in entries if not entry.reason]
    return [name for name in names if not name.endswith("pixel_mask")], entries


def _stored(path: Path, dataset: Any, number: int | None) -> AnyArray:
    """Return all values of an array or one frame, rows first: MATLAB stores columns first."""
    is_frame = number is not None and dataset.ndim > 2
    index = np.unravel_index(number or 0, dataset.shape[:-2]) if is_frame else ()
    values = load_dataset(path, dataset, tuple(map(int, index)))
    return values.swapaxes(-1, -2) if is_of_matlab(dataset) else values


def _find_array(path: Path, file: Any, name: str) -> tuple[Any, int | None]:
    """Return an array by its name, and the number of the frame that the name ends with."""
    item, frame = find_array(
        path, name, lambda text: _member_or_default(file, text), _entries(file)
    )
    if item.dtype.kind not in "buif" or not item.shape:
        raise InputError(
            f"{path} holds {name!r} as {_KINDS.get(item.dtype.kind, 'one number')}: expected an "
            f"array of real numbers; the file holds {list_arrays(_entries(file))}"
        )
    return item, frame_number(path, frame, item.shape[:-2])


def _member_or_default(file: Any, name: str) -> Any | None:
    """Return an array by its name, or that which a NeXus group of this name shows by default."""
    import h5py

    item = member(file, name)
    for _ in range(16):
        if not isinstance(item, h5py.Group):
            break
        default = next((plain_value(item.attrs[k]) for k in _DEFAULTS if k in item.attrs), None)
        item = member(item, default) if isinstance(default, str) else None
    return item if isinstance(item, h5py.Dataset) else None


@as_file_errors
def list_sizes(path: Path, *, most: int = 40) -> list[tuple[str, str]]:
    """Return the names of the first arrays, and their shapes and types."""
    with open_hdf5(path) as file:
        return [(each.name, each.size) for each in _entries(file)][:most]


def _entries(file: Any) -> Iterator[ArrayEntry]:
    """Yield the arrays of a file."""
    for name, item in items_of(file):
        if name[:1] == "#":  # MATLAB's own
            continue
        if getattr(item, "shape", ()):
            yield ArrayEntry(name, _size_text(item), _reason(item))


def _size_text(dataset: Any) -> str:
    shape = "×".join(map(str, dataset.shape[::-1] if is_of_matlab(dataset) else dataset.shape))
    return f"{shape} {dataset.dtype}" if dataset.dtype.kind in "buif" else shape


def _reason(dataset: Any) -> str:
    """Say why an array is no image; empty if it is one."""
    if dataset.ndim < 2:
        return ONE_AXIS
    if dataset.dtype.kind in _KINDS:
        return _KINDS[dataset.dtype.kind]
    if 0 in dataset.shape or "MATLAB_empty" in dataset.attrs:
        return "empty"
    if is_of_matlab(dataset) and min(dataset.shape[-2:]) < 2:
        return ONE_AXIS
    is_triple = dataset.ndim == 3 and dataset.shape[0] == 3
    if is_of_matlab(dataset) and is_triple and dataset.dtype == np.uint8:
        return "a picture in colour"
    return "in another file" if is_elsewhere(dataset) else ""
