"""Structure of HDF5 files; images in them are in `hdf5_arrays`.

- `open_hdf5`; an item, `member`, or all of a file, `items_of`; its values, `load_dataset`, and an
  attribute, `plain_value`
- refuse a file whose arrays are elsewhere or too large: `check_arrays`
- add a checksum, `seal_hdf5`, and compare it, `check_hdf5_seal`

An HDF5 file can point to others: by external links, external storage and virtual arrays. No
reader takes their values, because the content of another file would pass for the file's own pixels.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError

_SEAL = b"\nshadowinv sha256 "


def open_hdf5(path: Path) -> Any:
    """Open an HDF5 file for reading."""
    import h5py

    return h5py.File(path, "r")


def member(group: Any, name: str) -> Any | None:
    """Return an item by its name with groups, or None."""
    import h5py

    return group[name] if isinstance(group, h5py.Group) and name and name in group else None


def plain_value(value: Any) -> Any:
    """Turn an attribute into a Python value; MATLAB writes bytes and arrays of one."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def items_of(file: Any, *, most: int = 10_000) -> list[tuple[str, Any]]:
    """Return names and items of a file, once each and without links."""
    items: list[tuple[str, Any]] = []

    def add(name: str, item: Any) -> bool | None:
        items.append((name, item))
        return len(items) >= most or None

    file.visititems(add)
    return items


def load_dataset(path: Path, dataset: Any, index: tuple[int, ...] = ()) -> AnyArray:
    """Return the values of an array, or of the plane at an index.

    Refuses values that are not written, which HDF5 would replace by zeros.
    """
    check_array(path, dataset, index)
    return np.asarray(dataset[index])


def check_array(path: Path, dataset: Any, index: tuple[int, ...] = (), before: int = 0) -> int:
    """Refuse an array that is elsewhere, incomplete, too large, or packed by a missing filter.

    Returns the bytes in memory of its values at an index, and of what was read `before`.
    """
    if is_elsewhere(dataset) or Path(dataset.file.filename) != path:
        raise FileFormatError(
            f"{path} does not hold {dataset.name!r} itself, but refers to another file: expected "
            "all data in one file; name the file with the data, or save them in this file"
        )
    itemsize = int(dataset.dtype.itemsize)
    # One chunk may be far larger than what is used of it.
    chunk_bytes = int(np.prod(dataset.chunks or (0,), dtype=float)) * itemsize
    count = int(np.prod(dataset.shape[len(index) :], dtype=float))
    total = before + max(chunk_bytes, count * max(8, itemsize))
    check_size(path, total)
    _check_filters(path, dataset)
    if not _is_written(dataset, index):
        frame = f"frame {','.join(map(str, index))} of " if index else "all of "
        raise FileFormatError(
            f"{path} does not hold {frame}{dataset.name!r} yet: wait until it is written, or copy "
            "the file again"
        )
    return total


def _check_filters(path: Path, dataset: Any) -> None:
    import h5py

    layout = dataset.id.get_create_plist()
    filters = [layout.get_filter(k)[0] for k in range(layout.get_nfilters())]
    missing = [code for code in filters if not h5py.h5z.filter_avail(code)]
    try:
        if missing:
            import_module("hdf5plugin")  # adds its filters
    except ImportError:
        raise FileFormatError(
            f"{path} holds {dataset.name!r} compressed by a filter that is not installed "
            f"({missing[0]}): install the package hdf5plugin, or save it with gzip"
        ) from None


def _is_written(dataset: Any, index: tuple[int, ...]) -> bool:
    """Return whether all chunks of an array, or of the plane at an index, are in the file."""
    # The length of a dimension without coordinates is an array without values.
    if dataset.size in (0, None) or "CLASS" in dataset.attrs:
        return True
    if dataset.chunks is None:
        return bool(dataset.id.get_storage_size())
    sides = list(zip(dataset.shape, dataset.chunks, strict=True))[len(index) :]
    places = itertools.product(*(range(0, length, chunk) for length, chunk in sides))
    chunks = (dataset.id.get_chunk_info_by_coord((*index, *place)) for place in places)
    return all(chunk.byte_offset is not None for chunk in chunks)


def is_elsewhere(dataset: Any) -> bool:
    """Return whether the values of an array are in other files."""
    return dataset.is_virtual or bool(dataset.external)


def check_arrays(path: Path) -> None:
    """Refuse a file whose arrays are in other files or do not fit into memory together."""
    import h5py

    total = 0
    with open_hdf5(path) as file:
        for _, item in items_of(file):
            if isinstance(item, h5py.Dataset):
                total = check_array(path, item, before=total)


def seal_hdf5(content: BytesIO) -> None:
    """Add the checksum of all bytes of a file behind its end, where the HDF5 library never looks.

    The checksums of the format leave out texts of variable length, such as attributes, and the
    library may read damaged ones for ever.
    """
    checksum = hashlib.sha256(content.getvalue()).hexdigest()
    content.seek(0, os.SEEK_END)
    content.write(_SEAL + checksum.encode())


def check_hdf5_seal(path: Path) -> None:
    """Refuse a file that has changed since `seal_hdf5`; others pass.

    A program that changes the file by the HDF5 library removes the seal.
    """
    content, seal, checksum = path.read_bytes().rpartition(_SEAL)
    if seal and hashlib.sha256(content).hexdigest().encode() != checksum:
        raise FileFormatError(
            f"{path} is damaged: its content does not match its checksum; copy it again"
        )
