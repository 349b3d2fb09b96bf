"""Images as text, one row of pixels per line: `read_text`.

Numbers are separated by spaces, tabs or commas, with a decimal point, or by semicolons, with a
decimal comma or point. Lines that begin with ``#`` or ``%`` are comments; they may contain the
geometry as ``key = value``, ``key: value`` or ``key value``:

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

A unit may follow the value (``1.4 cm``) or end the key (``bin_um``).

PRadReader, which prepares radiographs for other codes, writes several images one below the other
and lists their shapes in the order of the blocks: ``flux2D (rows, columns)``, the shot;
``flux2D_ref``, the undisturbed beam; in some versions ``mask``, 0 where a pixel can be used.
Without that block, ``x-mask 20 % - 80 %`` and ``y-mask`` give the share of the rows (x) and of
the columns (y) that can be used.
"""

from __future__ import annotations

import math
import re
from codecs import BOM_UTF8
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import check_size
from napari_shadowinv._system.tables import is_number
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.errors import FileFormatError

_NAMES = {
    "source_object_distance": "source_object_distance source_object_dist s2r",
    "object_image_distance": "object_image_distance object_image_dist",
    "source_image_distance": "source_image_distance s2d",
    "pixel_size": "pixel_size",
    "detector_pixel_size": "detector_pixel_size pixel_width bin",
    "energy": "energy ep",
}
_KEYS = {key: name for name, keys in _NAMES.items() for key in keys.split()}
# Plain words in other programs' files, where without a unit they mean something else.
_KEYS_WITH_UNIT = {"s2r", "s2d", "bin", "ep"}
_ENTRY = re.compile(
    r"^[#%\s]*(?P<key>[^\W\d][\w\- ()\[\]]*?)\s*(?P<sign>[=:]\s*|\s)(?P<value>[-+.\d].*)$"
)
_UNIT = re.compile(r"[pnµμumckMG]?m|[kMG]?eV")
_BLOCK = re.compile(r"^[#%]\s*(flux2D|flux2D_ref|mask)\s*(?:\(\s*(\d+)\s*,\s*(\d+)\s*\))?\s*$")
_SELECTED = re.compile(r"^[#%]\s*([xy])-mask\s+([\d.]+)\s*%?\s*-\s*([\d.]+)")


def read_text(path: Path) -> tuple[FloatArray, dict[str, Any]]:
    """Read an image with its ``geometry`` (m, MeV), and ``source`` and ``mask`` if present."""
    # A number takes two characters at least, and eight bytes in memory.
    check_size(path, 4 * path.stat().st_size)
    rows: list[bytes] = []
    geometry: dict[str, float] = {}
    blocks: dict[str, tuple[int, int]] = {}
    selected: dict[str, tuple[float, float]] = {}
    with path.open("rb") as file:
        for number, raw in enumerate(file, 1):
            start = raw.removeprefix(BOM_UTF8).lstrip()[:1]
            if start not in {b"#", b"%"}:
                rows += [raw] if start else []
                continue
            line = _decode_comment(raw)
            geometry |= _parse_geometry(path, number, line)
            if block := _BLOCK.match(line):
                first_shape = next(iter(blocks.values()), (0, 0))
                blocks[block[1]] = (int(block[2]), int(block[3])) if block[2] else first_shape
            if part := _SELECTED.match(line):
                selected[part[1]] = float(part[2]), float(part[3])
    image = _parse_rows(path, rows)
    height, width = image.shape
    if "flux2D" in blocks:
        if selected and "mask" not in blocks and height == 3 * blocks["flux2D"][0]:
            # Some versions write the mask without its shape.
            blocks["mask"] = blocks["flux2D"]
        _check_blocks(path, blocks, (height, width))
    metadata: dict[str, Any] = {"bits": 64, "geometry": _complete_distances(geometry)}
    if "flux2D" not in blocks:
        _check_no_coordinates(path, image)
        return image, metadata
    image, parts = _split_blocks(path, image, blocks, selected)
    return image, {**metadata, **parts}


def _check_blocks(path: Path, blocks: dict[str, tuple[int, int]], shape: tuple[int, int]) -> None:
    rows = sum(height for height, _ in blocks.values())
    if len(set(blocks.values())) > 1 or shape != (rows, blocks["flux2D"][1]):
        shapes = ", ".join(f"{name} {block}" for name, block in blocks.items())
        raise FileFormatError(
            f"{path} holds {shape[0]} rows of {shape[1]} numbers, but its header gives {shapes}: "
            "expected blocks of the same shape, one below the other, as listed in the header; "
            "write the file again"
        )


def _split_blocks(
    path: Path,
    stacked: FloatArray,
    blocks: dict[str, tuple[int, int]],
    selected: dict[str, tuple[float, float]],
) -> tuple[FloatArray, dict[str, AnyArray]]:
    planes = dict(zip(blocks, np.split(stacked, len(blocks)), strict=True))
    image, parts = planes["flux2D"], {}
    if "flux2D_ref" in planes:
        parts["source"] = planes["flux2D_ref"]
    if "mask" in planes:
        if not np.isin(planes["mask"], (0, 1)).all():
            raise FileFormatError(
                f"{path} has numbers other than 0 (use) and 1 (do not use) in its mask: "
                "write the file again"
            )
        parts["mask"] = planes["mask"] == 0
    elif any(share != (0, 100) for share in selected.values()):
        shares = (selected.get(axis, (0.0, 100.0)) for axis in "xy")
        part = tuple(
            slice(*(round(end * length / 100) for end in share))
            for share, length in zip(shares, image.shape, strict=True)
        )
        parts["mask"] = np.zeros(image.shape, dtype=bool)
        parts["mask"][part] = True
    return image, parts


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


def _decode_comment(raw: bytes) -> str:
    try:
        return raw.decode("utf-8-sig").strip()
    except UnicodeDecodeError:
        return raw.decode("latin-1").strip()  # as Windows wrote it


def _parse_rows(path: Path, rows: list[bytes]) -> FloatArray:
    if len(rows) < 2:
        raise FileFormatError(
            f"{path} holds {len(rows)} row{'s' * (len(rows) != 1)} of numbers: expected at least "
            "two, one row of pixels per line; export the image again"
        )
    # Numbers look the same in every encoding.
    lines = [row.removeprefix(BOM_UTF8).decode("latin-1").strip() for row in rows]
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


def _parse_geometry(
    path: Path, number_of_line: int, line: str, most: int = 200
) -> dict[str, float]:
    """Return the geometry in the setup's units that a comment, no prose, states: one or none."""
    from napari_shadowinv.physics.beam import number_in_unit
    from napari_shadowinv.physics.setup import beam_quantities

    entry = _ENTRY.match(line) if len(line) <= most else None
    if entry is None:
        return {}
    words = [word for word in re.split(r"[\W_]+", entry["key"]) if word]
    unit = words.pop() if len(words) > 1 and _UNIT.fullmatch(words[-1]) else ""
    key, text, quantities = "_".join(words).lower(), entry["value"].strip(), beam_quantities()
    name = key if key in quantities else _KEYS.get(key)
    needs_unit = key in _KEYS_WITH_UNIT or (key in quantities and quantities[key].unit == "m")
    if name is None or (needs_unit and not unit and is_number(text)):
        return {}
    expected = quantities[name].unit if name in quantities else "m"
    try:
        number = f"{text} {unit or expected}" if is_number(text) else text
        return {name: number_in_unit(number, expected)}
    except ValueError as error:
        if entry["sign"].isspace():  # prose that happens to begin with a key and a number
            return {}
        raise FileFormatError(
            f"{path}, line {number_of_line} has {text[:30]!r} for {name}: {error}"
        ) from None


def _complete_distances(geometry: dict[str, float]) -> dict[str, float]:
    total = geometry.pop("source_image_distance", None)
    near, far = geometry.get("source_object_distance"), geometry.get("object_image_distance")
    if total is not None and near is not None and far is None:
        geometry["object_image_distance"] = total - near
    elif total is not None and far is not None and near is None:
        geometry["source_object_distance"] = total - far
    return geometry
