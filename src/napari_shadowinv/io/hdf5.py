"""Structure of HDF5 files; images in them are in `hdf5_arrays`.

- `open_hdf5`; an item, `member`, or all of a file, `walk`; its values, `load_dataset`, and an
  attribute, `plain_value`
- refuse a file whose arrays are elsewhere or too large: `check_arrays`
- add a checksum, `seal_hdf5`, and compare it, `check_hdf5_seal`

An HDF5 file can point to others: by external links, external storage and virtual arrays. No
reader follows them, because the content of another file would pass for the file's own pixels.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise

_SEAL = b"\nshadowinv sha256 "
MAX_LINKS = 16  # that lead to one item


def open_hdf5(path: Path) -> Any:
    """Open an HDF5 file for reading."""
    import h5py

    return h5py.File(path, "r")


def member(path: Path, group: Any, name: str, depth: int = 0) -> Any | None:
    """Return an item by its name with groups, or None; refuse an item in another file."""
    import h5py

    item = group.file if name.startswith("/") else group
    for part in filter(None, name.split("/")):
        key = part.encode()
        if not isinstance(item, h5py.Group) or not item.id.links.exists(key):
            return None
        kind = item.id.links.get_info(key).type
        if kind == h5py.h5l.TYPE_EXTERNAL:
            _refuse_other_file(path, name, f"links to {item.id.links.get_val(key)[0].decode()!r}")
        if kind == h5py.h5l.TYPE_SOFT:
            if depth > MAX_LINKS:
                raise ValueError(f"the links of {name!r} form a loop")
            item = member(path, item, item.id.links.get_val(key).decode(), depth + 1)
        else:
            item = item[part]
    return item


def _refuse_other_file(path: Path, name: str, origin: str) -> None:
    raise FileFormatError(
        f"{path} does not hold {name!r} itself but {origin}: expected all data in one file; save "
        "the data as an array in this file"
    )


def plain_value(value: Any) -> Any:
    """Turn an attribute into a Python value; MATLAB writes bytes and arrays of one."""
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.reshape(-1)[0]
    if isinstance(value, bytes):
        return value.decode("utf-8", errors="replace")
    return value.item() if isinstance(value, np.generic) else value


def walk(file: Any, most_visits: float = math.inf) -> Iterator[tuple[str, Any]]:
    """Yield names and items of a file once each, from the top down.

    An item in another file is the name of that file.
    """
    import h5py

    groups, addresses, visited = deque([("", file)]), set(), 0
    while groups:
        prefix, group = groups.popleft()
        for name in group:
            visited += 1
            if visited > most_visits:
                return
            link = group.id.links.get_info(name.encode())
            if link.type == h5py.h5l.TYPE_EXTERNAL:
                target = group.id.links.get_val(name.encode())[0]
                yield f"{prefix}{name}", target.decode(errors="replace")
            if link.type != h5py.h5l.TYPE_HARD:
                continue
            item = group[name]
            address = h5py.h5o.get_info(item.id).addr
            if address not in addresses:
                addresses.add(address)
                yield f"{prefix}{name}", item
                if isinstance(item, h5py.Group) and name[:1] != "#":  # of MATLAB's own
                    groups.append((f"{prefix}{name}/", item))


def load_dataset(path: Path, dataset: Any) -> AnyArray:
    """Return the values of an array, refusing missing ones, which HDF5 would replace by zeros."""
    check_array(path, dataset, dataset.size)
    _check_promise(path, dataset)
    return np.asarray(dataset[()])


def check_array(path: Path, dataset: Any, count: int, before: int = 0) -> int:
    """Refuse an array in other files, one compressed by a filter that is missing, or too large.

    Returns the bytes in memory of `count` values of it, and of what was read `before`.
    """
    import h5py

    if origin := stored_elsewhere(dataset):
        _refuse_other_file(path, dataset.name, origin)
    itemsize = int(dataset.dtype.itemsize)
    # One chunk may be far larger than what is used of it.
    chunk_bytes = int(np.prod(dataset.chunks or (0,), dtype=float)) * itemsize
    total = before + int(max(chunk_bytes, count * max(8, itemsize)))
    check_size(path, total)
    layout = dataset.id.get_create_plist()
    for code, _, _, title in map(layout.get_filter, range(layout.get_nfilters())):
        with suppress(ImportError):
            if not h5py.h5z.filter_avail(code):
                import_module("hdf5plugin")  # adds its filters
        if not h5py.h5z.filter_avail(code):
            label = f"{code} {title.decode(errors='replace')}".strip()
            raise FileFormatError(
                f"{path} holds {dataset.name!r} compressed by a filter that is not installed "
                f"({label}): install the package hdf5plugin, or save it with gzip"
            )
    return total


def _check_promise(path: Path, dataset: Any) -> None:
    stored = int(dataset.id.get_storage_size())
    is_packed = dataset.id.get_create_plist().get_nfilters() > 0
    check_promise(path, "HDF5", dataset.nbytes, DEFLATE_RATIO * stored if is_packed else stored)


def stored_elsewhere(dataset: Any) -> str:
    """Say in which other files the values of an array are; empty if they are in its own."""
    layout = dataset.id.get_create_plist()
    if layout.get_external_count():
        external_file = layout.get_external(0)[0].decode(errors="replace")
        return f"in the raw file {external_file!r}"
    if dataset.is_virtual:
        source_files = sorted({source.file_name for source in dataset.virtual_sources()})
        return f"as a virtual array from {', '.join(map(repr, source_files))}"
    return ""


def check_arrays(path: Path) -> None:
    """Refuse a file whose arrays are in other files or do not fit into memory together."""
    import h5py

    total = 0
    with open_hdf5(path) as file:
        for name, item in walk(file):
            if isinstance(item, str):
                _refuse_other_file(path, name, f"links to {item!r}")
            if isinstance(item, h5py.Dataset):
                total = check_array(path, item, item.size, total)
                # The length of a dimension without coordinates is an array without values.
                if item.id.get_storage_size() or "CLASS" not in item.attrs:
                    _check_promise(path, item)


def seal_hdf5(content: BytesIO) -> None:
    """Add the checksum of all bytes of a file behind its end, where the HDF5 library never looks.

    The checksums of the format leave out texts of variable length, such as attributes.
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
