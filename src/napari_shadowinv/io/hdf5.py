"""Arrays of any HDF5 file, by name.

- the array that the user names: `read_hdf5`, as an image `read_plane`; the choice: `list_arrays`
- for callers that know the layout: an item, `member`; its values, `load_dataset`; `check_arrays`
- write one: `hdf5_in_memory`; compare its checksum: `check_hdf5_seal`

An HDF5 file can point to others: by external links, external storage and virtual arrays. No
reader follows them, because the content of another file would pass for the file's own pixels.
"""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise

_MAX_LISTED = 30
_SEAL = b"\nshadowinv sha256 "
_BLOCK_BYTES = 1 << 20
_MAX_LINKS = 16


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
            if depth > _MAX_LINKS:
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


def members(path: Path, group: Any) -> Iterator[tuple[str, Any]]:
    """Yield names and items of a group, except items in other files."""
    import h5py

    for name in group:
        if group.id.links.get_info(name.encode()).type == h5py.h5l.TYPE_HARD:
            yield name, group[name]


def load_dataset(path: Path, dataset: Any) -> AnyArray:
    """Return the values of an array, refusing missing ones, which HDF5 would replace by zeros."""
    check_size(path, _memory_bytes(path, dataset))
    _check_promise(path, dataset)
    return np.asarray(dataset[()])


def _check_promise(path: Path, dataset: Any) -> None:
    stored = int(dataset.id.get_storage_size())
    is_packed = dataset.id.get_create_plist().get_nfilters() > 0
    check_promise(path, "HDF5", dataset.nbytes, DEFLATE_RATIO * stored if is_packed else stored)


def _memory_bytes(path: Path, dataset: Any) -> int:
    """Return the bytes in memory of an array, which must be in the file itself."""
    layout = dataset.id.get_create_plist()
    if layout.get_external_count():
        external_file = layout.get_external(0)[0].decode(errors="replace")
        _refuse_other_file(path, dataset.name, f"in the raw file {external_file!r}")
    if dataset.is_virtual:
        source_files = sorted({source.file_name for source in dataset.virtual_sources()})
        names = ", ".join(map(repr, source_files))
        _refuse_other_file(path, dataset.name, f"as a virtual array from {names}")
    # One chunk may be far larger than what is used of it.
    chunk = int(np.prod(dataset.chunks or (0,), dtype=float)) * dataset.dtype.itemsize
    return int(max(chunk, dataset.size * max(8, dataset.dtype.itemsize)))


def check_arrays(path: Path) -> None:
    """Refuse a file whose arrays are in other files or do not fit into memory together."""
    import h5py

    total = 0
    with h5py.File(path, "r") as file:
        for dataset in _iterate_datasets(path, file):
            total += _memory_bytes(path, dataset)
            check_size(path, total)
            # The length of a dimension without coordinates is an array without values.
            if dataset.id.get_storage_size() or "CLASS" not in dataset.attrs:
                _check_promise(path, dataset)


def _iterate_datasets(path: Path, group: Any) -> Iterator[Any]:
    import h5py

    for name in group:
        item = member(path, group, name)
        if isinstance(item, h5py.Dataset):
            yield item
        elif isinstance(item, h5py.Group):
            yield from _iterate_datasets(path, item)


@contextmanager
def hdf5_in_memory(path: Path, *, seal: bool = False) -> Iterator[BytesIO]:
    """Make an HDF5 file in memory, and write it to the disk in one go when the block ends well.

    With `seal`, the checksum of all its bytes follows its end, where the HDF5 library never looks:
    the checksums of the format leave out texts of variable length, such as attributes.
    """
    content = BytesIO()  # on a full disk, the HDF5 library would end the process
    yield content
    if seal:
        checksum = hashlib.sha256(content.getvalue()).hexdigest()
        content.seek(0, os.SEEK_END)
        content.write(_SEAL + checksum.encode())
    path.write_bytes(content.getvalue())


def check_hdf5_seal(path: Path) -> None:
    """Refuse a file that has changed since `hdf5_in_memory` sealed it; others pass.

    A program that changes the file by the HDF5 library removes the seal.
    """
    length = len(_SEAL) + 2 * hashlib.sha256().digest_size
    remaining = path.stat().st_size - length
    if remaining <= 0:
        return
    with path.open("rb") as file:
        file.seek(remaining)
        end = file.read(length)
        if not end.startswith(_SEAL):
            return
        file.seek(0)
        checksum = hashlib.sha256()
        while remaining > 0 and (block := file.read(min(_BLOCK_BYTES, remaining))):
            checksum.update(block)
            remaining -= len(block)
    if checksum.hexdigest().encode() != end.removeprefix(_SEAL):
        raise FileFormatError(
            f"{path} is damaged: its content does not match its checksum; copy it again"
        )


@as_file_errors
def read_hdf5(path: Path, name: str) -> AnyArray:
    """Read one array by its name with groups: ``shots/3/image``."""
    import h5py

    with h5py.File(path, "r") as file:
        item = member(path, file, name)
        if isinstance(item, h5py.Dataset) and _is_numeric(item):
            return load_dataset(path, item)
        content = ", ".join(list_arrays(path, file)) or "none"
    raise InputError(f"{path} has no array {name!r}: it holds {content}")


def read_plane(path: Path, name: str) -> tuple[AnyArray, dict[str, Any]]:
    """Read one array as an image, whatever else the file is."""
    array = read_hdf5(path, name)
    if array.ndim != 2 or array.size == 0:
        raise FileFormatError(
            f"{path} holds {name!r} with shape {array.shape}: expected an image of shape "
            "(height, width); choose or save one plane"
        )
    return array, {"kind": "hdf5", "variable": name}


def list_arrays(path: Path, file: Any) -> list[str]:
    """List the first images of an open file and its groups, with shape and type."""
    images = [
        f"{name!r} ({'×'.join(map(str, item.shape))} {item.dtype})"
        for name, item in itertools.islice(_iterate_shallow_datasets(path, file), 10 * _MAX_LISTED)
        if _is_numeric(item) and item.ndim in (2, 3)
    ]
    return images if len(images) <= _MAX_LISTED else [*images[:_MAX_LISTED], "…"]


def _iterate_shallow_datasets(path: Path, file: Any) -> Iterator[tuple[str, Any]]:
    """Yield the datasets of the file and of its groups."""
    import h5py

    for name, item in members(path, file):
        if isinstance(item, h5py.Dataset):
            yield name, item
        elif isinstance(item, h5py.Group):
            for inner, dataset in members(path, item):
                if isinstance(dataset, h5py.Dataset):
                    yield f"{name}/{inner}", dataset


def _is_numeric(item: Any) -> bool:
    return bool(np.dtype(item.dtype).kind in "buif" and item.shape)
