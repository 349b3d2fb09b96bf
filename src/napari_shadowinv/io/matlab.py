"""MATLAB's MAT-files, version 5 to 7 (its own layout) and 7.3 (HDF5).

- the one image of a file, or the variable that the user names: `read_mat`; its frames: `count_mat`
- the variables of a file: `mat_variables`; the names of its images: `image_names`
- MATLAB 7.3 or other HDF5: `is_matlab`

scipy reads MATLAB's own layout, h5py the other.

References
----------
MathWorks, MAT-File Format (2019).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_size
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.arrays import FRAME_INDEX, check_one_frame
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise
from napari_shadowinv.io.hdf5 import load_dataset, member, members, open_hdf5

# Attributes of pradformat and of .shadowinv, which MATLAB's save does not write.
_FOREIGN_MARKS = {"object_type", "format"}
_DTYPES = {"double": "f8", "single": "f4", "logical": "?"}
_DTYPES |= {
    f"{sign}int{bits}": f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)
}
_MATRIX, _COMPRESSED = 14, 15  # elements of a file
_STORED = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13}  # types of numbers
_NUMERIC_CLASSES, _LAST_CLASS = range(6, 16), 17
_IS_COMPLEX = 0x0800  # among the flags


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
        return self.type in _DTYPES and min(self.shape[:2], default=0) >= 2 and not is_colour

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
            return _variables_5(path)
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


def _variables_5(path: Path) -> list[MatlabArray]:
    """List the variables of MATLAB's own layout."""
    from scipy.io import whosmat

    complex_names = _check_elements(path)
    variables = []
    for name, shape, type_name in whosmat(path):
        prefix = "complex " if name in complex_names else ""
        load = partial(_load_5, path, name, shape, type_name)
        variables.append(MatlabArray(name, shape, prefix + type_name, load))
    return variables


def _check_elements(path: Path, preamble: int = 1024) -> set[str]:
    """Refuse lengths beyond the file, and types that crash scipy; return the complex variables.

    The flags, dimensions and name of a variable are in the bytes of the preamble.
    """
    size = path.stat().st_size
    names = set()
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
                names.add(_check_numbers(path, body, count, order))
            file.seek(end)
    return names


def _check_numbers(path: Path, body: bytes, count: int, order: str) -> str:
    """Return the name of a complex variable, an empty one of another kind."""
    (flags,) = struct.unpack_from(f"{order}I", body, 8)
    if flags & 0xFF > _LAST_CLASS:
        raise ValueError(f"unknown class {flags & 0xFF}")
    if flags & 0xFF not in _NUMERIC_CLASSES:
        return ""
    start, tag, fields = 16, 0, []
    for _ in ("dimensions", "name", "values"):
        tag, length = struct.unpack_from(f"{order}II", body, start)
        # Short elements share their tag; others are filled up to 8 bytes.
        first, length = (start + 4, tag >> 16) if tag >> 16 else (start + 8, length)
        fields.append(body[first : first + length])
        check_promise(path, "MATLAB", first + length, count)
        start = -(-(first + length) // 8) * 8
    if tag & 0xFFFF not in _STORED:
        raise ValueError(f"unknown type {tag & 0xFFFF} of numbers")
    return fields[1].decode("latin-1") if flags & _IS_COMPLEX else ""


def _load_5(path: Path, name: str, shape: tuple[int, ...], type_name: str) -> AnyArray:
    from scipy.io import loadmat

    promised = 8 * math.prod(shape)
    check_promise(path, "MATLAB", promised, 8 * DEFLATE_RATIO * path.stat().st_size)
    check_size(path, promised)
    values = np.asarray(loadmat(path, variable_names=[name])[name])
    # Whole numbers are stored in as few bytes as they need; sparse ones are refused later.
    return values if values.dtype == object else values.astype(_DTYPES[type_name], copy=False)
