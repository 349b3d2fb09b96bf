"""MATLAB's own layout, MAT-files of version 5 to 7: `variables_5`.

scipy's reader asks for the memory that a damaged length names, and a damaged type crashes
it together with the whole program; so planes of numbers, all that is needed, are read here.

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
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.safety import check_size
from napari_shadowinv.io.size_checks import DEFLATE_RATIO, check_promise

__all__ = ["Variable", "variables_5"]

_HEADER = 128
_MATRIX, _COMPRESSED = 14, 15
_COMPLEX, _LOGICAL = 0x0800, 0x0200
# Enough for a variable's flags, dimensions and name.
_PREAMBLE = 1024

_CLASSES = {
    1: "cell",
    2: "struct",
    3: "object",
    4: "char",
    5: "sparse",
    6: "double",
    7: "single",
    8: "int8",
    9: "uint8",
    10: "int16",
    11: "uint16",
    12: "int32",
    13: "uint32",
    14: "int64",
    15: "uint64",
    16: "function handle",
}
_DTYPES = {"double": "f8", "single": "f4", "logical": "?"}
# Types of the values as they are kept.
_STORED = {
    1: "i1",
    2: "u1",
    3: "i2",
    4: "u2",
    5: "i4",
    6: "u4",
    7: "f4",
    9: "f8",
    12: "i8",
    13: "u8",
}
_Bytes: TypeAlias = bytes | memoryview
_NUMERIC = {name for number, name in _CLASSES.items() if 6 <= number <= 15} | {"logical"}


@dataclass(frozen=True)
class Variable:
    """An array in a MAT-file, read when `load` is called; the shape is as MATLAB shows it."""

    name: str
    shape: tuple[int, ...]
    type: str
    load: Callable[[], NDArray[Any]]

    @property
    def is_image(self) -> bool:
        return self.type in _NUMERIC and len(self.shape) == 2 and min(self.shape) >= 2

    def __str__(self) -> str:
        return f"'{self.name}' ({'×'.join(map(str, self.shape))} {self.type})"


def variables_5(path: Path) -> list[Variable]:
    """List the variables of a MAT-file of version 5 to 7, without their values.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    list of Variable
        In the file's order.

    Raises
    ------
    FileFormatError
        If the file promises more than it holds; other damage raises whatever comes.
    """
    with path.open("rb") as file:
        return list(_elements(path, file))


def _elements(path: Path, file: BinaryIO) -> Iterator[Variable]:
    """Walk over the variables' headers without reading their values."""
    size = path.stat().st_size
    order = _order(file)
    start = _HEADER
    while start < size:
        file.seek(start)
        kind, count = struct.unpack(f"{order}II", file.read(8))
        check_promise(path, "MATLAB", start + 8 + count, size)
        body = file.read(min(count, _PREAMBLE))
        if kind == _COMPRESSED:
            body = zlib.decompressobj().decompress(body, _PREAMBLE)
            kind, inner = struct.unpack(f"{order}II", body[:8])
            check_promise(path, "MATLAB", inner, DEFLATE_RATIO * count)
            body = body[8:]
        if kind == _MATRIX:
            name, shape, type_name, _ = _preamble(body, order)
            check_promise(path, "MATLAB", math.prod(shape), DEFLATE_RATIO * count)
            if name:
                yield Variable(name, shape, type_name, _loader(path, start, count, shape))
        start += 8 + count


def _order(file: BinaryIO) -> str:
    order = {b"IM": "<", b"MI": ">"}.get(file.read(_HEADER)[126:])
    if order is None:
        raise ValueError("no byte order in its header")
    return order


def _preamble(body: _Bytes, order: str) -> tuple[str, tuple[int, ...], str, int]:
    """Name, shape and class of a variable, and where its values begin."""
    flags = struct.unpack_from(f"{order}I", body, 8)[0]
    type_name = "logical" if flags & _LOGICAL else _CLASSES.get(flags & 0xFF, "object")
    if type_name == "object":
        # Opaque objects have no dimensions here.
        return "an object", (), type_name, 0
    if flags & _COMPLEX:
        type_name = f"complex {type_name}"
    _, dims, after = _field(body, 16, order)
    shape = struct.unpack(f"{order}{len(dims) // 4}i", dims)
    if len(shape) < 2 or min(shape) < 0:
        raise ValueError("shape")
    _, name, after = _field(body, after, order)
    return bytes(name).decode("latin-1"), shape, type_name, after


def _field(body: _Bytes, start: int, order: str) -> tuple[int, _Bytes, int]:
    """Type and content of a data element, and where the next begins."""
    (kind,) = struct.unpack_from(f"{order}I", body, start)
    # Short elements share their tag.
    short = kind >> 16
    count = short or struct.unpack_from(f"{order}I", body, start + 4)[0]
    start += 4 if short else 8
    if (short > 4) or start + count > len(body):
        raise ValueError("element beyond its place")
    return kind & 0xFFFF, body[start : start + count], start + (4 if short else -(-count // 8) * 8)


def _loader(
    path: Path, start: int, count: int, shape: tuple[int, ...]
) -> Callable[[], NDArray[Any]]:
    def load() -> NDArray[Any]:
        check_size(path, 8 * math.prod(shape))
        with path.open("rb") as file:
            order = _order(file)
            file.seek(start)
            (kind,) = struct.unpack(f"{order}I4x", file.read(8))
            body = file.read(count)
        return _values(_unpacked(path, body, order) if kind == _COMPRESSED else body, order)

    return load


def _unpacked(path: Path, packed: bytes, order: str) -> bytes:
    unpacker = zlib.decompressobj()
    count = struct.unpack(f"{order}4xI", unpacker.decompress(packed, 8))[0]
    check_size(path, count)
    body = unpacker.decompress(unpacker.unconsumed_tail, max(count, 1))
    check_promise(path, "MATLAB", count, len(body))
    return body


def _values(body: bytes, order: str) -> NDArray[Any]:
    """Read a plane of numbers, which MATLAB keeps column after column."""
    view = memoryview(body)
    _, shape, type_name, start = _preamble(view, order)
    kind, content, _ = _field(view, start, order)
    stored = np.frombuffer(content, dtype=np.dtype(f"{order}{_STORED[kind]}"))
    # Whole numbers are kept in as few bytes as they need.
    return stored.reshape(shape, order="F").astype(_DTYPES.get(type_name, type_name), copy=False)
