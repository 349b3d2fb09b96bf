"""Images as text, one row of pixels per line: `read_text`.

Numbers are separated by spaces, tabs or commas, with a decimal point. Lines that begin with
``#`` or ``%`` are comments; they may tell the geometry as ``key = value``, ``key: value`` or
``key value``:

===========================  ==========================================================
key                          meaning
===========================  ==========================================================
``source_object_distance``   in m; ``s2r_cm`` in pradreader's files
``object_image_distance``    in m
``source_image_distance``    in m, the sum of both; ``s2d_cm`` in pradreader's files
``pixel_size``               in m, in the object plane
``detector_pixel_size``      in m; ``bin_um`` in pradreader's files
``energy``                   in MeV; ``Ep_MeV`` in pradreader's files
===========================  ==========================================================

A unit may follow the value (``1.4 cm``) or end the key (``bin_um``). pradreader, the reader
of the code PRaLine, stacks an image and its reference: it tells ``flux2D (rows, columns)``.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import FileFormatError

__all__ = ["read_text"]

# A row of 100 000 pixels with all their digits has 2.5 MB.
_LONGEST_LINE = 4_000_000

_UNITS = {
    "m": 1.0,
    "cm": 1e-2,
    "mm": 1e-3,
    "um": 1e-6,
    "µm": 1e-6,
    "μm": 1e-6,
    "micron": 1e-6,
    "microns": 1e-6,
    "mev": 1.0,
    "kev": 1e-3,
    "ev": 1e-6,
}
_ENERGY_UNITS = {"mev", "kev", "ev"}

_KEYS = {
    "source_object_distance": "source_object_distance",
    "source_object_dist": "source_object_distance",
    "s2r": "source_object_distance",
    "object_image_distance": "object_image_distance",
    "object_image_dist": "object_image_distance",
    "source_image_distance": "source_image_distance",
    "s2d": "source_image_distance",
    "pixel_size": "pixel_size",
    "detector_pixel_size": "detector_pixel_size",
    "pixel_width": "detector_pixel_size",
    "bin": "detector_pixel_size",
    "energy": "energy",
    "ep": "energy",
}
# Plain words in other programs' files, where without a unit they mean something else.
_KEYS_WITH_UNIT = {"s2r", "s2d", "bin", "ep"}
# Longer comments are prose.
_LONGEST_ENTRY = 200
_ENTRY = re.compile(
    r"^[#%\s]*(?P<key>[^\W\d][\w\- ()\[\]]*?)\s*(?P<sign>[=:]\s*|\s)(?P<value>[-+.\d].*)$"
)
_VALUE = re.compile(r"^(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\W\d]*)\s*$")
_ROWS = re.compile(r"^[#%]\s*flux2D\s*\((\d+)")


def read_text(path: Path) -> tuple[NDArray[np.float64], dict[str, Any]]:
    """Read an image from lines of numbers.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    array : ndarray of float64, shape (H, W)
        The numbers, the first line on top.
    metadata : dict
        ``bits``; ``geometry``, the fields of `ProtonSetup` that the comments tell; and, where
        the file holds it, ``source``, the image without the object.

    Raises
    ------
    FileFormatError
        If a line is no row of numbers or longer or shorter than the first; the message
        tells which.
    """
    # Once to find mistakes, once to keep: a bad file never fills the memory.
    height = 0
    width: int | None = None
    half: int | None = None
    told: dict[str, float] = {}
    for number, line in _lines(path):
        if line[0] in "#%":
            told |= _geometry_of(path, number, line)
            found = _ROWS.match(line)
            half = int(found[1]) if found else half
        else:
            width = _row(path, number, line, width).size
            height += 1
    image = _filled(path, height, width or 0)
    metadata: dict[str, Any] = {"bits": 64, "geometry": _complete(told)}
    if half is not None and 2 * half == height:
        metadata["source"] = image[half:]
        image = image[:half]
    return image, metadata


def _filled(path: Path, height: int, width: int) -> NDArray[np.float64]:
    if not height:
        raise FileFormatError(
            f"{path} holds no numbers: expected one row of pixels per line; export the image again"
        )
    if min(height, width) < 2:
        raise FileFormatError(
            f"{path} holds {height} rows of {width} numbers: expected an image with two rows and "
            "two columns at least; export the image again"
        )
    image = np.empty((height, width))
    rows = ((number, line) for number, line in _lines(path) if line[0] not in "#%")
    for row, (number, line) in zip(image, rows, strict=True):
        row[:] = _row(path, number, line, width)
    return image


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines that are not blank, with their numbers from 1."""
    with path.open("rb") as file:
        for number in itertools.count(1):
            raw = file.readline(_LONGEST_LINE)
            if not raw:
                return
            if len(raw) == _LONGEST_LINE and not raw.endswith(b"\n"):
                raise FileFormatError(
                    f"{path}, line {number} is longer than {_LONGEST_LINE} bytes: expected one row "
                    "of pixels per line; break it up"
                )
            text = _decoded(raw.removeprefix(b"\xef\xbb\xbf") if number == 1 else raw).strip()
            if text:
                yield number, text


def _decoded(raw: bytes) -> str:
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        # Comments that Windows wrote; numbers look the same in both.
        return raw.decode("latin-1")


def _row(path: Path, number: int, line: str, width: int | None) -> NDArray[np.float64]:
    words = line.rstrip(",").split("," if "," in line else None)
    if width is not None and len(words) != width:
        raise FileFormatError(
            f"{path}, line {number} has {len(words)} numbers, the first row {width}: expected rows "
            "of equal length; export the image again"
        )
    try:
        return np.fromiter(map(float, words), dtype=np.float64, count=len(words))
    except ValueError:
        word = next(word for word in words if not _is_number(word)).strip()
        shown = word if len(word) <= 30 else f"{word[:30]}…"
        raise FileFormatError(
            f"{path}, line {number} has {shown!r}: expected numbers with a decimal point, "
            "separated by spaces or commas; put # before a line of text"
        ) from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _geometry_of(path: Path, number: int, line: str) -> dict[str, float]:
    """What a comment tells of the geometry, in m and MeV: one entry or none."""
    entry = _ENTRY.match(line) if len(line) <= _LONGEST_ENTRY else None
    if entry is None:
        return {}
    words = [word for word in re.split(r"[\W_]+", entry["key"].lower()) if word]
    unit = words.pop() if len(words) > 1 and words[-1] in _UNITS else ""
    name = _KEYS.get("_".join(words))
    value = _VALUE.match(entry["value"])
    unit = (value["unit"].lower() if value else "") or unit
    if name is None or ("_".join(words) in _KEYS_WITH_UNIT and not unit):
        return {}
    unit = unit or ("mev" if name == "energy" else "m")
    fits = unit in _UNITS and (unit in _ENERGY_UNITS) == (name == "energy")
    if value is not None and fits and _is_number(value["number"]):
        return {name: float(value["number"]) * _UNITS[unit]}
    if entry["sign"].isspace():
        # Prose that happens to begin with a key and a number.
        return {}
    raise FileFormatError(
        f"{path}, line {number} has {entry['value'][:30]!r} for {name}: expected a number and "
        f"a unit such as {'14.7 MeV' if name == 'energy' else '1.4 cm'}; correct it"
    )


def _complete(told: dict[str, float]) -> dict[str, float]:
    whole = told.pop("source_image_distance", None)
    near, far = told.get("source_object_distance"), told.get("object_image_distance")
    if whole is not None and near is not None and far is None:
        told["object_image_distance"] = whole - near
    elif whole is not None and far is not None and near is None:
        told["source_object_distance"] = whole - far
    return told
