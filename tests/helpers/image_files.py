"""Files that no library writes: frames of cameras, and what MATLAB's save -v7.3 does."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import h5py
import numpy as np

Array = np.ndarray[Any, Any]


def save_b16(path: Path, pixels: Array, comment: bytes = b"", **entries: int) -> Path:
    start, (height, width) = 128 + len(comment), pixels.shape
    fields = {"size": start + pixels.nbytes, "start": start, "width": width, "height": height}
    header = struct.pack("<6i", *(fields | {"extended": -1, "colour": 0} | entries).values())
    path.write_bytes(
        (b"PCO-" + header).ljust(128, b"\0") + comment + pixels.astype("<u2").tobytes()
    )
    return path


def save_spe(
    path: Path,
    pixels: Array,
    code: int = 3,
    footer: bytes = b"",
    marked: bool = True,
    **entries: int,
) -> Path:
    """Write version 2, or 3 with a footer; `entries` of the header may lie."""
    version = 3.0 if footer else 2.5
    fields = {"width": pixels.shape[-1], "height": pixels.shape[-2], "frames": 1}
    fields |= {"offset": 4100 + pixels.nbytes if footer else 0} | entries
    places = {"width": ("<H", 42), "height": ("<H", 656), "frames": ("<i", 1446)}
    places["offset"] = ("<Q", 678)
    header = bytearray(4100)
    for name, (form, place) in places.items():
        struct.pack_into(form, header, place, fields[name])
    struct.pack_into("<h", header, 108, code)
    struct.pack_into("<f", header, 1992, version)
    if marked:
        struct.pack_into("<i", header, 2996, 0x01234567)
        struct.pack_into("<H", header, 4098, 0x5555)
    path.write_bytes(bytes(header) + pixels.tobytes() + footer)
    return path


def save_pradformat(path: Path, image: Array | None, **attributes: object) -> Path:
    """Write a radiograph, or one without its image."""
    with h5py.File(path, "w") as file:
        file.attrs.update(object_type="radiograph", **attributes)
        if image is not None:
            file["image"] = image
    return path


def save_mat73(path: Path, arrays: dict[str, Array], userblock: int = 512) -> Path:
    """Write columns first and marked arrays, with MATLAB's name in front."""
    with h5py.File(path, "w", userblock_size=userblock) as file:
        for name, array in arrays.items():
            stored = array.astype(np.uint8) if array.dtype == bool else array
            file[name] = stored.T
            native = str(array.dtype.newbyteorder("="))
            names = {"float64": "double", "float32": "single", "bool": "logical"}
            file[name].attrs["MATLAB_class"] = np.bytes_(names.get(native, native))
    if userblock:
        head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
        path.write_bytes(head.ljust(userblock, b"\0") + path.read_bytes()[userblock:])
    return path
