"""MATLAB's own MAT-files, version 5 to 7, by scipy; those of 7.3 are HDF5, see `hdf5_arrays`.

- an image by its name: `read_mat`; its frames: `count_mat`; the names of all: `list_images`
- MATLAB's own layout or HDF5: `is_matlab`

References
----------
MathWorks, MAT-File Format (2019).
"""

from __future__ import annotations

import math
import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_shadowinv._system.safety import check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.arrays import (
    ONE_AXIS,
    ArrayEntry,
    find_array,
    frame_number,
    list_arrays,
)
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise

_DTYPES = {"double": "f8", "single": "f4", "logical": "?"}
_DTYPES |= {
    f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_MATRIX, _COMPRESSED = 14, 15  # elements of a file
_STORED = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}  # types of numbers
_NUMERIC_CLASSES = range(6, 16)


class _Variable(NamedTuple):
    """A variable of a file."""

    name: str
    shape: tuple[int, ...]
    type: str

    @property
    def entry(self) -> ArrayEntry:
        """Its description; scalars, vectors and pictures in colour are no images."""
        reason = ""
        if self.type not in _DTYPES:
            reason = "no numbers"
        elif min(self.shape[:2], default=0) < 2:
            reason = "empty" if 0 in self.shape else ONE_AXIS
        elif self.type == "uint8" and self.shape[2:] == (3,):
            reason = "a picture in colour"
        return ArrayEntry(self.name, f"{'×'.join(map(str, self.shape))} {self.type}", reason)


def is_matlab(path: Path) -> bool:
    """Return whether a file that begins like a MAT-file has MATLAB's own layout."""
    import h5py

    with path.open("rb") as file:
        is_73 = file.read(10) == b"MATLAB 7.3"
    return not is_73 and not h5py.is_hdf5(path)


def read_mat(path: Path, name: str, number: int = 0) -> tuple[AnyArray, dict[str, Any]]:
    """Read an image, or frame `number` over the axes after the first two."""
    from scipy.io import loadmat

    chosen, frame_in_name = _find_image(path, name)
    axes = chosen.shape[2:]
    number = number if frame_in_name is None else frame_in_name
    promised = 8 * math.prod(chosen.shape)
    check_promise(path, "MATLAB", promised, 8 * DEFLATE_RATIO * path.stat().st_size)
    check_size(path, promised)
    array = np.asarray(loadmat(path, variable_names=[chosen.name])[chosen.name])
    if array.dtype.kind not in "buif" or array.shape != chosen.shape:
        raise FileFormatError(
            f"{path} holds {chosen.entry} as {array.dtype} values of shape {array.shape}: expected "
            "a plane of whole or real numbers; take its real part or modulus, and save that"
        )
    place: Any = (slice(None), slice(None), *np.unravel_index(number, axes)) if axes else ...
    # Whole numbers are stored in as few bytes as they need.
    image = array[place].astype(_DTYPES[chosen.type], copy=False)
    return image, {"variable": chosen.name, "bits": 8 * image.dtype.itemsize, "geometry": {}}


def count_mat(path: Path, name: str) -> tuple[int, ...]:
    """Return the lengths of the axes after the first two of an array; none for one frame of it."""
    chosen, number = _find_image(path, name)
    return chosen.shape[2:] if number is None else ()


def list_images(path: Path) -> tuple[list[str], list[ArrayEntry]]:
    """Return the names of all images, and all arrays."""
    entries = [each.entry for each in _variables(path)]
    return [each.name for each in entries if not each.reason], entries


def _variables(path: Path) -> list[_Variable]:
    from scipy.io import whosmat

    _check_elements(path)
    return [_Variable(*each) for each in whosmat(path)]


def _find_image(path: Path, name: str) -> tuple[_Variable, int | None]:
    """Return an image by its name, and the number of the frame that the name ends with."""
    variables = {each.name: each for each in _variables(path)}
    entries = [each.entry for each in variables.values()]
    chosen, frame = find_array(path, name, lambda text: variables.get(text.lstrip("/")), entries)
    if chosen.entry.reason:
        raise InputError(
            f"{path} holds {chosen.name!r} as {chosen.entry.reason}: expected an image of real "
            f"numbers; the file holds {list_arrays(entries)}"
        )
    return chosen, frame_number(path, frame, chosen.shape[2:])


def _check_elements(path: Path, preamble: int = 1024) -> None:
    """Refuse lengths beyond the file, and types of numbers that crash scipy.

    The flags, dimensions and name of a variable are in the bytes of the preamble.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        order = {b"IM": "<", b"MI": ">"}.get(file.read(128)[126:])
        if order is None:
            raise ValueError("no byte order in its header")
        while head := file.read(8):
            kind, count = struct.unpack(f"{order}II", head)
            end = file.tell() + count
            check_promise(path, "MATLAB", end, size)
            body = file.read(min(count, preamble))
            if kind == _COMPRESSED:
                body = zlib.decompressobj().decompress(body, preamble)
                kind, unpacked = struct.unpack_from(f"{order}II", body)
                check_promise(path, "MATLAB", unpacked, DEFLATE_RATIO * count)
                body, count = body[8:], unpacked
            if kind == _MATRIX:
                _check_numbers(path, body, count, order)
            file.seek(end)


def _check_numbers(path: Path, body: bytes, count: int, order: str) -> None:
    (flags,) = struct.unpack_from(f"{order}I", body, 8)
    if flags & 0xFF not in _NUMERIC_CLASSES:
        return
    start, tag = 16, 0
    for _ in ("dimensions", "name", "values"):
        tag, length = struct.unpack_from(f"{order}II", body, start)
        # Short elements share their tag; others are filled up to 8 bytes.
        end = start + 4 + (tag >> 16) if tag >> 16 else start + 8 + length
        check_promise(path, "MATLAB", end, count)
        start = -(-end // 8) * 8
    if tag & 0xFFFF not in _STORED:
        raise ValueError(f"unknown type {tag & 0xFFFF} of numbers")
