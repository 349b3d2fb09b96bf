"""MATLAB's MAT-files, version 5 to 7 (its own layout) and 7.3 (HDF5).

- the one image of a file, or the variable that the user names: `read_mat`; its frames: `count_mat`
- the variables of a file: `mat_variables`; the names of its images: `image_names`
- MATLAB 7.3 or other HDF5: `is_matlab`

scipy's reader of MATLAB's own layout asks for the memory that a damaged length names, and a damaged
type crashes it together with the whole program; so planes of numbers, all that is needed, are read
here.

References
----------
MathWorks, MAT-File Format (2019).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.arrays import FRAME_INDEX, check_one_frame
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise
from napari_shadowinv.io.hdf5 import load_dataset, member, members, open_hdf5

# Attributes of pradformat and of .shadowinv, which MATLAB's save does not write.
_FOREIGN_MARKS = {"object_type", "format"}
_HEADER = 128
_Element = IntEnum("_Element", {"MATRIX": 14, "COMPRESSED": 15})
_Flag = IntFlag("_Flag", {"LOGICAL": 0x0200, "COMPLEX": 0x0800})

# By their number, from 1.
_PLAIN = "cell struct object char sparse double single int8 uint8 int16 uint16 int32 uint32"
_PLAIN += " int64 uint64"
_CLASSES = {**dict(enumerate(_PLAIN.split(), start=1)), 16: "function handle"}
_NUMERIC = {*_PLAIN.split()[5:], "logical"}
_DTYPES = {"double": "f8", "single": "f4", "logical": "?"}
# Types of the values as they are kept.
_STORED = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8"}
_STORED |= {12: "i8", 13: "u8"}
_Bytes: TypeAlias = bytes | memoryview


@dataclass(frozen=True)
class MatlabArray:
    """An array in a MAT-file, read when `load` is called; the shape is as MATLAB shows it."""

    name: str
    shape: tuple[int, ...]
    type: str
    load: Callable[[], AnyArray]

    @property
    def is_image(self) -> bool:
        # Scalars and vectors beside the image do not count, nor do pictures in colour.
        is_colour = self.type == "uint8" and self.shape[2:] == (3,)
        return self.type in _NUMERIC and min(self.shape[:2], default=0) >= 2 and not is_colour

    def __str__(self) -> str:
        return f"'{self.name}' ({'×'.join(map(str, self.shape))} {self.type})"


def is_matlab(path: Path) -> bool:
    """Return whether a file that begins like a MAT-file or HDF5 is a MAT-file."""
    import h5py

    with path.open("rb") as file:
        is_named = file.read(6) == b"MATLAB"
    if is_named and not h5py.is_hdf5(path):
        return True
    with open_hdf5(path) as file:
        # By name: walking all attributes of a damaged file may never end.
        if any(mark in file.attrs for mark in _FOREIGN_MARKS):
            return False
        return is_named or any("MATLAB_class" in item.attrs for _, item in members(file))


def read_mat(
    path: Path, variable: str | None = None, number: int | None = None
) -> tuple[AnyArray, dict[str, Any]]:
    """Read the only image of a MAT-file, or the named one, rows first as MATLAB shows it.

    Axes after the first two count frames; ``name[3]`` is one of them, and `number` counts over all.
    """
    chosen, index = _choose_image(path, variable)
    array, axes = chosen.load(), chosen.shape[2:]
    if array.dtype.kind not in "buif" or array.shape != chosen.shape:
        raise FileFormatError(
            f"{path} holds {chosen} as {array.dtype} values of shape {array.shape}: expected a "
            "plane of whole or real numbers; take its real part or modulus, and save that"
        )
    if number is not None:
        index = tuple(map(int, np.unravel_index(number, axes)))
    if index is None:
        check_one_frame(path, axes, chosen.name)
        index = (0,) * len(axes)
    facts = {"variable": chosen.name, "bits": 8 * array.dtype.itemsize, "geometry": {}}
    place: Any = (slice(None), slice(None), *index)
    return array[place], facts


@as_file_errors
def count_mat(path: Path, variable: str | None = None) -> tuple[int, ...]:
    """Return the lengths of the axes after the first two of an array; none for one frame of it."""
    chosen, index = _choose_image(path, variable)
    return chosen.shape[2:] if index is None else ()


@as_file_errors
def mat_variables(path: Path) -> list[MatlabArray]:
    """List the variables of a MAT-file in its order, without their values."""
    with path.open("rb") as file:
        head = file.read(516)
        # MATLAB writes a text before the HDF5.
        if b"\x89HDF" not in (head[:4], head[512:]) and head[:10] != b"MATLAB 7.3":
            file.seek(0)
            return list(_variables_5(path, file))
    with open_hdf5(path) as content:
        # Names that begin with # are MATLAB's own.
        names = [name for name in content if not name.startswith("#")]
        return [_describe_variable(path, name, member(path, content, name)) for name in names]


def image_names(path: Path) -> list[str]:
    """Return the names of all images in a MAT-file."""
    return [variable.name for variable in mat_variables(path) if variable.is_image]


def _choose_image(path: Path, name: str | None) -> tuple[MatlabArray, tuple[int, ...] | None]:
    """Return the only image or the named one, and the index of a frame that the name ends with."""
    variables, index = mat_variables(path), None
    if name is not None and (match := FRAME_INDEX.fullmatch(name)):
        name, index = match["name"], tuple(map(int, match["index"].split(",")))
    name = name and name.lstrip("/")
    content = ", ".join(map(str, variables)) or "nothing"
    images = [item for item in variables if item.is_image and name in (None, "", item.name)]
    if name and not images:
        raise InputError(f"{path} has no numeric plane {name!r}: it holds {content}")
    if not images:
        raise FileFormatError(
            f"{path} holds {content}: expected a numeric array (height, width); save the image as "
            "a variable of its own"
        )
    if len(images) > 1:
        raise InputError(
            f"{path} holds {len(images)} images: expected one, or the name of one, as "
            f"{path.name}::{images[0].name}; it holds {', '.join(map(str, images))}"
        )
    axes = images[0].shape[2:]
    if index is not None and (len(index) != len(axes) or any(map(int.__ge__, index, axes))):
        raise InputError(f"{path} has no {name}{list(index)}: it holds {images[0]}")
    return images[0], index


def _describe_variable(path: Path, name: str, item: Any) -> MatlabArray:
    import h5py

    mark = item.attrs.get("MATLAB_class", b"")
    type_name = mark.decode() if isinstance(mark, bytes) else str(mark)
    if not isinstance(item, h5py.Dataset) or "MATLAB_empty" in item.attrs:
        shape: tuple[int, ...] = (0, 0) if isinstance(item, h5py.Dataset) else (1, 1)
        return MatlabArray(name, shape, type_name or "struct", lambda: np.empty(shape))
    if item.dtype.names is not None:
        type_name = f"complex {type_name}".rstrip()
    if not type_name:
        type_name = "double" if item.dtype.kind in "buif" else str(item.dtype)

    def load() -> AnyArray:
        with open_hdf5(path) as file:
            return load_dataset(path, member(path, file, name)).T

    # HDF5 counts its axes from the other end than MATLAB does.
    return MatlabArray(name, item.shape[::-1], type_name, load)


def _variables_5(path: Path, file: BinaryIO, preamble: int = 1024) -> Iterator[MatlabArray]:
    """Variables of MATLAB's own layout: their headers are read, not yet their values.

    Flags, dimensions and name of a variable are in the bytes of the preamble.
    """
    size = path.stat().st_size
    order = _byte_order(file)
    start = _HEADER
    while start < size:
        file.seek(start)
        kind, count = struct.unpack(f"{order}II", file.read(8))
        check_promise(path, "MATLAB", start + 8 + count, size)
        body = file.read(min(count, preamble))
        if kind == _Element.COMPRESSED:
            body = zlib.decompressobj().decompress(body, preamble)
            kind, inner = struct.unpack(f"{order}II", body[:8])
            check_promise(path, "MATLAB", inner, DEFLATE_RATIO * count)
            body = body[8:]
        if kind == _Element.MATRIX:
            name, shape, type_name, _ = _read_preamble(body, order)
            check_promise(path, "MATLAB", math.prod(shape), DEFLATE_RATIO * count)
            if name:
                yield MatlabArray(
                    name, shape, type_name, partial(_load_5, path, start, count, shape)
                )
        start += 8 + count


def _byte_order(file: BinaryIO) -> str:
    order = {b"IM": "<", b"MI": ">"}.get(file.read(_HEADER)[126:])
    if order is None:
        raise ValueError("no byte order in its header")
    return order


def _read_preamble(body: _Bytes, order: str) -> tuple[str, tuple[int, ...], str, int]:
    """Name, shape and class of a variable, and where its values begin."""
    flags = struct.unpack_from(f"{order}I", body, 8)[0]
    type_name = "logical" if flags & _Flag.LOGICAL else _CLASSES.get(flags & 0xFF, "object")
    if type_name == "object":
        # Opaque objects have no dimensions here.
        return "an object", (), type_name, 0
    if flags & _Flag.COMPLEX:
        type_name = f"complex {type_name}"
    _, dims, after = _read_field(body, 16, order)
    shape = struct.unpack(f"{order}{len(dims) // 4}i", dims)
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError("shape")
    _, name, after = _read_field(body, after, order)
    return bytes(name).decode("latin-1"), shape, type_name, after


def _read_field(body: _Bytes, start: int, order: str) -> tuple[int, _Bytes, int]:
    """Type and content of a data element, and where the next begins."""
    (kind,) = struct.unpack_from(f"{order}I", body, start)
    # Short elements share their tag.
    short = kind >> 16
    count = short or struct.unpack_from(f"{order}I", body, start + 4)[0]
    start += 4 if short else 8
    if (short > 4) or start + count > len(body):
        raise ValueError("element beyond its place")
    return kind & 0xFFFF, body[start : start + count], start + (4 if short else -(-count // 8) * 8)


def _load_5(path: Path, start: int, count: int, shape: tuple[int, ...]) -> AnyArray:
    check_size(path, 8 * math.prod(shape))
    with path.open("rb") as file:
        order = _byte_order(file)
        file.seek(start)
        (kind,) = struct.unpack(f"{order}I4x", file.read(8))
        body = file.read(count)
    if kind == _Element.COMPRESSED:
        unpacker = zlib.decompressobj()
        count = struct.unpack(f"{order}4xI", unpacker.decompress(body, 8))[0]
        check_size(path, count)
        body = unpacker.decompress(unpacker.unconsumed_tail, max(count, 1))
        check_promise(path, "MATLAB", count, len(body))
    # A plane of numbers, which MATLAB keeps column after column.
    view = memoryview(body)
    _, shape, type_name, start = _read_preamble(view, order)
    kind, content, _ = _read_field(view, start, order)
    stored = np.frombuffer(content, dtype=np.dtype(f"{order}{_STORED[kind]}"))
    # Whole numbers are kept in as few bytes as they need.
    return stored.reshape(shape, order="F").astype(_DTYPES.get(type_name, type_name), copy=False)
