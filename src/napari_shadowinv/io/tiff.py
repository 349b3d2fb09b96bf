"""TIFF: every frame of a file as one picture, with the values that the file states.

- the only frame, or one of as many as `count_tiff_frames`: `read_tiff`
- a plane as TIFF: `write_tiff`

Thumbnails, pyramids and masks are no frames. Values are turned from white-is-zero, colour tables,
ImageJ's calibrations and the roots of gel scanners into light; pixels that are
transparent or without data become NaN.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tifffile
from tifffile import PHOTOMETRIC

from napari_shadowinv._system.safety import check_regular, check_size
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise
from napari_shadowinv.io.images import (
    INCH_M,
    as_picture,
    gamma_caution,
    geometry_of,
    is_linear_profile,
    square_cautions,
)
from napari_shadowinv.physics.arrays import METRES

_TIFF_RATIO = 3 * DEFLATE_RATIO  # LZW at its best packs two and a half times as well as zlib
_PICTURE_CODECS = {6, 7, 33003, 33004, 33005, 34712, 34892, 34933, 34934, 50001}

_JPEG = {6, 7}
_ALPHA = {1, 2}  # of the tag ExtraSamples
_UNITS_M: dict[Any, float] = {2: INCH_M, 3: 0.01, 4: 1e-3, 5: 1e-6, "inch": INCH_M, **METRES}


class _Layout(NamedTuple):
    """Where the frames of a TIFF are."""

    pages: tuple[int, ...]  # numbers of their directories
    left_out: tuple[str, ...] = ()  # sizes of smaller pictures


@contextmanager
def _open_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF with the decoder's log silenced, because the error says it once."""
    check_regular(path, "a TIFF")
    logger = logging.getLogger("tifffile")
    before = logger.disabled
    logger.disabled = True
    try:
        # Their series may open other files, or take tags for granted.
        kinds: Any = dict.fromkeys(("is_ome", "is_mmstack", "is_ndtiff", "is_mdgel"), False)
        with tifffile.TiffFile(path, **kinds) as tiff:
            yield tiff
    finally:
        logger.disabled = before


def _layout_of(path: Path) -> _Layout:
    check_regular(path, "a TIFF")
    status = path.stat()  # a changed file is opened again
    return _find_frames(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=64)
def _find_frames(path: Path, _modified_ns: int, size: int) -> _Layout:
    with _open_tiff(path) as tiff:
        _check_directories(path, tiff, size)
        series = [level for each in tiff.series for level in each.levels]
        pictures = [s for s in series if not (s.keyframe.is_reduced or s.keyframe.is_subifd)]
        mask = PHOTOMETRIC.MASK
        pictures = [
            s for s in pictures if not (s.keyframe.is_mask or s.keyframe.photometric == mask)
        ]
        if not pictures:
            raise FileFormatError(
                f"{path} holds no picture but thumbnails or masks: expected an image; export it "
                "again as 16-bit TIFF"
            )
        largest = max(pictures, key=lambda series: math.prod(_sides(series)))
        shots = [series for series in pictures if _sides(series) == _sides(largest)]
        others = {_sides(series) for series in pictures} - {_sides(largest)}
        sizes = tuple("×".join(map(str, sides)) for sides in sorted(others))
        if any(2 * math.prod(sides) > math.prod(_sides(largest)) for sides in others):
            raise FileFormatError(
                f"{path} holds pictures of {'×'.join(map(str, _sides(largest)))} and of "
                f"{', '.join(sizes)} pixels: expected shots of one size; save them separately"
            )
        _check_listed(path, tiff, shots)
        pages = tuple(sorted(page.index for series in shots for page in series))
        return _Layout(pages, sizes)


def _sides(series: Any) -> tuple[int, int]:
    height, width = series.keyframe.shaped[2:4]
    return height, width


def _check_directories(path: Path, tiff: Any, size: int) -> None:
    """Refuse a file whose last directory names another that the file does not have."""
    tiff.filehandle.seek(tiff.pages.next_page_offset)
    following = int.from_bytes(
        tiff.filehandle.read(tiff.tiff.offsetsize), "little" if tiff.byteorder == "<" else "big"
    )
    check_promise(path, "TIFF", following, size)


def _check_listed(path: Path, tiff: Any, shots: list[Any]) -> None:
    """Refuse a stack with fewer directories than frames: they do not say where the others are."""
    stated = tiff.imagej_metadata or {}
    listed = [sum(series.size // series.keyframe.size for series in shots)]
    if shots[0].keyframe.samplesperpixel == 1:
        listed += [stated.get("images", 1)]
        listed += [math.prod(stated.get(axis, 1) for axis in ("frames", "slices", "channels"))]
    if max(listed) > len(tiff.pages):
        raise FileFormatError(
            f"{path} lists {max(listed)} frames and has {len(tiff.pages)} directories: it is "
            "truncated, or larger than 4 GB, where ImageJ leaves them out; copy it again, or save "
            "it as BigTIFF or in one file for each frame"
        )


def count_tiff_frames(path: Path) -> int:
    """Return how many frames a TIFF has."""
    return len(_layout_of(path).pages)


def read_tiff(path: Path, number: int = 0) -> tuple[AnyArray, dict[str, Any]]:
    """Read frame `number`, from 0, of a TIFF."""
    layout = _layout_of(path)
    with _open_tiff(path) as tiff:
        page = tiff.pages[layout.pages[number]].aspage()
        _check_kind(path, page)
        _check_complete(path, page)
        array = page.asarray()
        if "S" in page.axes:
            array = np.moveaxis(array, page.axes.index("S"), -1)
        missing = _missing_pixels(page, array)
        values, notes = _convert_values(path, tiff, page, _without_alpha(page, array))
        array, metadata = as_picture(path, "TIFF", values, missing, _tag(tiff, page, 274), notes)
        sides, is_length = _pixel_sides(tiff, page)
        return array, {
            **metadata,
            "bits": int(np.max(page.bitspersample)),
            "cautions": _cautions(page, layout) + square_cautions(sides),
            **geometry_of(sides, is_length, is_drawn=page.software.startswith("shadowinv")),
        }


def _tag(tiff: Any, page: Any, number: int, default: Any = None, *, among: int = 1) -> Any:
    """Return the value of a tag of a page, or of the first ones: programs write some only there."""
    pages = (page, *(tiff.pages[index].aspage() for index in range(min(among, len(tiff.pages)))))
    values = (each.tags.valueof(number) for each in pages)
    return next((value for value in values if value is not None), default)


def _check_kind(path: Path, page: Any) -> None:
    colours, grey = page.photometric, (PHOTOMETRIC.MINISWHITE, PHOTOMETRIC.MINISBLACK)
    is_decoded = colours == PHOTOMETRIC.YCBCR and page.compression in _PICTURE_CODECS
    is_known = colours in (*grey, PHOTOMETRIC.RGB, PHOTOMETRIC.PALETTE)
    if 262 in page.tags and not (is_known or is_decoded):
        raise FileFormatError(
            f"{path} holds pixels of the photometric kind {_name(colours)}, which are not "
            "proportional to the light: expected grey or RGB; export it as greyscale TIFF"
        )
    if page.dtype is None or page.dtype.kind not in "buif":
        kind = f"{page.bitspersample} bits in sample format {_name(page.sampleformat)}"
        raise FileFormatError(
            f"{path} holds pixels of {kind}: expected whole or real numbers; export it as 16-bit "
            "TIFF"
        )


def _name(value: int) -> str:
    """Return the name of a tag's value with its number, or the number alone."""
    return f"{value.name} ({int(value)})" if hasattr(value, "name") else str(value)


def _check_complete(path: Path, page: Any) -> None:
    # tifffile fills missing strips with zeros, which would pass for a void in the beam.
    size = path.stat().st_size
    places = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    end = max((offset + count for offset, count in places), default=0)
    if not 0 < end <= size or not all(count for _, count in places):
        raise FileFormatError(
            f"{path} is truncated: its TIFF header implies {end} bytes in {len(places)} parts, "
            f"found {size}, or a part without data; copy it again"
        )
    packed_bytes = sum(page.databytecounts)
    packing = 1 if page.compression == 1 else _TIFF_RATIO
    bits = int(np.max(page.bitspersample))
    check_promise(path, "TIFF", page.size * bits // 8, packing * packed_bytes)
    # One tile may be far larger than what is used of it.
    check_size(path, max(page.size, math.prod(page.chunks)) * max(8, page.dtype.itemsize))


def _without_alpha(page: Any, array: AnyArray) -> AnyArray:
    is_alpha = page.extrasamples and page.extrasamples[-1] in _ALPHA
    if not is_alpha or array.ndim != 3:
        return array
    return array[..., 0] if array.shape[-1] == 2 else array[..., :-1]


def _missing_pixels(page: Any, array: AnyArray) -> BoolArray | None:
    """Return where a frame is transparent; None if it is nowhere."""
    is_opaque = array.ndim < 3 or _without_alpha(page, array) is array
    return None if is_opaque else np.asarray(array[..., -1] == 0)


def _convert_values(
    path: Path, tiff: Any, page: Any, array: AnyArray
) -> tuple[AnyArray, tuple[str, ...]]:
    """Turn stored values into those that the file means, and say how."""
    kind = _tag(tiff, page, 33445, among=2)
    if kind in (2, 128):  # a gel scanner's square roots, or values in proportion
        counts, per = _tag(tiff, page, 33446, (1, 1), among=2)
        power = 2 if kind == 2 else 1
        values = array.astype(np.float64) ** power * (counts / per if counts and per else 1.0)
        return values, (f"values of a gel scanner, to the power {power}, as the file says",)
    stated = tiff.imagej_metadata or {}
    if tiff.is_imagej:
        # ImageJ shows tables of colours and inverted greys, and leaves the pixels as they are.
        return _calibrate(path, array, stated)
    if 262 in page.tags and page.photometric == PHOTOMETRIC.MINISWHITE:
        if array.dtype.kind not in "bu":
            raise FileFormatError(
                f"{path} says that 0 is white, but holds {array.dtype} pixels, which have no "
                "black: expected black is zero; save it so"
            )
        if array.dtype.kind == "b":
            return ~array, ("0 is white, inverted as the file says",)
        white = 2**page.bitspersample - 1
        return (white - array).astype(array.dtype), ("0 is white, inverted as the file says",)
    if page.photometric == PHOTOMETRIC.PALETTE and page.colormap is not None and array.ndim == 2:
        return np.moveaxis(page.colormap[:, array.astype(np.intp)], 0, -1), ()
    return array, ()


def _calibrate(
    path: Path, array: AnyArray, stated: dict[str, Any]
) -> tuple[AnyArray, tuple[str, ...]]:
    """Apply the calibration of ImageJ, which has one for whole numbers of 8 and 16 bits."""
    function = int(stated.get("cf", 20))  # 20 is none, 0 to 3 are polynomials
    if function == 20 or array.dtype.kind != "u" or array.dtype.itemsize > 2:
        return array, ()
    if function not in range(4):
        raise FileFormatError(
            f"{path} has ImageJ's calibration function {function} of unit "
            f"{stated.get('vunit', 'none')!r}: expected a straight line or a polynomial; choose "
            "the function None in Analyze > Calibrate, or save pixels proportional to the light"
        )
    powers = [float(stated.get(f"c{power}", 0.0)) for power in range(function + 2)]
    values = np.polynomial.polynomial.polyval(array.astype(np.float64), powers)
    text = " + ".join(f"{factor:g}·v^{power}" for power, factor in enumerate(powers) if factor)
    return values, (f"values calibrated by ImageJ: {text or 0}",)


def _cautions(page: Any, layout: _Layout) -> tuple[Caution, ...]:
    profile = page.tags.valueof(34675)
    cautions = []
    if profile is not None and not is_linear_profile(bytes(profile)):
        cautions.append(gamma_caution("a TIFF with a colour profile"))
    elif page.photometric == PHOTOMETRIC.YCBCR or (
        page.compression in _JPEG and page.dtype == np.uint8
    ):
        cautions.append(gamma_caution("a JPEG in a TIFF"))
    if layout.left_out:
        text = (
            f"pictures of {', '.join(layout.left_out)} pixels in the same file were taken for "
            "thumbnails and left out: save them separately if they are shots"
        )
        cautions.append(Caution("file", text))
    return tuple(cautions)


def _pixel_sides(tiff: Any, page: Any) -> tuple[tuple[float, ...], bool]:
    """Return width and height of a pixel (m) if stated, and whether their unit is a length's."""
    ratios = [page.tags.valueof(number) for number in (282, 283)]
    unit = (tiff.imagej_metadata or {}).get("unit", page.tags.valueof(296, default=2))
    length = _UNITS_M.get(unit.replace("\\u00B5", "µ") if isinstance(unit, str) else unit, 0.0)
    if not length or not all(isinstance(ratio, tuple) and all(ratio) for ratio in ratios):
        return (), False
    sides = [per / count for count, per in ratios]
    if sides == [1.0, 1.0]:  # of programs that do not know it
        return (), False
    return tuple(side * length for side in sides), length <= 1e-3


def write_tiff(content: BytesIO, plane: AnyArray, pixel_size: float | None = None) -> None:
    """Write a plane as float32 TIFF, the width of a pixel (m) as its resolution."""
    options: dict[str, Any] = {}
    if pixel_size is not None:
        per_centimetre = 0.01 / pixel_size
        options = {"resolution": (per_centimetre, per_centimetre), "resolutionunit": "CENTIMETER"}
    values = np.asarray(plane, dtype=np.float32)
    tifffile.imwrite(content, values, photometric="minisblack", software="shadowinv", **options)
