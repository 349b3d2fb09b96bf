"""Images as text, one row of pixels per line: `read_text`.

Numbers are separated by spaces, tabs or commas, with a decimal point, or by semicolons, with a
decimal comma or point. Lines that begin with ``#`` or ``%`` are comments, which are not read.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import check_size
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError

_SEVERAL_IMAGES = re.compile(r"[#%]\s*flux2D")  # of PRadReader


def read_text(path: Path) -> tuple[FloatArray, dict[str, Any]]:
    """Read an image."""
    # A number takes two characters at least, and eight bytes in memory.
    check_size(path, 4 * path.stat().st_size)
    lines = []
    # Windows writes comments in other encodings; numbers look the same in all.
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for line in map(str.strip, file):
            if _SEVERAL_IMAGES.match(line):
                raise FileFormatError(
                    f"{path} is PRadReader's, which may write image, reference and mask one below "
                    "the other: expected one image; split it, as by "
                    "numpy.split(numpy.loadtxt(path, delimiter=','), 3), and save each as .npy"
                )
            if line and line[0] not in "#%":
                lines.append(line)
    image = _parse_rows(path, lines)
    _check_no_coordinates(path, image)
    return image, {"bits": 64}


def _parse_rows(path: Path, lines: list[str]) -> FloatArray:
    if len(lines) < 2:
        raise FileFormatError(
            f"{path} holds {len(lines)} row{'s' * (len(lines) != 1)} of numbers: expected at least "
            "two, one row of pixels per line; export the image again"
        )
    separator = next((sign for sign in ";," if sign in lines[0]), None)
    if separator == ";":
        lines = [line.replace(",", ".") for line in lines]
    try:
        image = np.loadtxt(
            [line.rstrip(separator) for line in lines], delimiter=separator, comments=None, ndmin=2
        )
    except ValueError as error:
        reason = str(error).partition(";")[0][:120]
        raise FileFormatError(
            f"{path} is no table of numbers ({reason}): expected rows of equal length, numbers "
            "with a decimal point, separated by spaces, commas or semicolons; start lines of text "
            "with #"
        ) from None
    if image.shape[1] < 2:
        raise FileFormatError(
            f"{path} holds one number a row: expected an image with at least two columns; export "
            "the image again"
        )
    return image


def _check_no_coordinates(path: Path, image: FloatArray, least_places: int = 16) -> None:
    """Refuse a table whose outer column or row counts, or that lists x, y and value of places."""
    sides = {"first column": image, "first row": image.T}
    sides |= {"last column": image[:, ::-1], "last row": image[::-1].T}
    for name, table in sides.items():
        # The first number may belong to the other axis.
        if _is_axis(table[1:, 0]) and not _is_axis(table[1:, 1]):
            raise FileFormatError(
                f"{path} has coordinates or numbers of pixels in its {name} "
                f"({', '.join(f'{number:g}' for number in table[1:4, 0])}, …): expected pixels "
                f"only; delete this {name.split()[1]}, "
                "or export the image as a matrix without axes"
            )
    height, width = image.shape
    if width in (3, 4) and height >= least_places:
        counts = [np.unique(image[:, column]).size for column in (0, 1)]
        if math.prod(counts) == height and min(counts) > 1:
            raise FileFormatError(
                f"{path} lists coordinates and values of {counts[0]} × {counts[1]} pixels in "
                "columns: expected one row of pixels per line; export the image as a matrix"
            )


def _is_axis(numbers: FloatArray, least_steps: int = 4, deviation: float = 0.3) -> bool:
    """Return whether numbers rise or fall by steps of nearly one size."""
    steps = np.diff(numbers)
    if len(steps) < least_steps or not np.isfinite(steps).all():
        return False
    usual = float(np.median(steps))
    return usual != 0 and bool((np.abs(steps / usual - 1) < deviation).all())
