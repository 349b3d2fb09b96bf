"""Pictures, one plane each.

- TIFF with 8, 16 or 32 bits, PNG, BMP, JPEG
- colour images: reduction to one plane (`to_grey`), signs of a film scan (`film_warnings`)
- scans of film in colour: `read_scan`
"""

from __future__ import annotations

import logging
import lzma
import math
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_regular, check_size
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise, sha256
from napari_shadowinv.io.formats import format_of

CHANNELS = ("red", "green", "blue", "mean")

# Of a picture of film that is exposed in its middle: the rim's width over the shorter side, its
# least brightness over the brightest, and the middle's greatest over the rim's.
_RIM, _AS_BRIGHT, _DARKER = 0.05, 0.9, 0.8


def to_grey(array: AnyArray, channel: str | int | None, where: str | Path) -> FloatArray:
    """Reduce an image, which may have channels and alpha last, to one plane of float64."""
    if array.ndim == 2:
        return np.ascontiguousarray(array, dtype=np.float64)
    colours = array[..., : {2: 1, 4: 3}.get(array.shape[-1], array.shape[-1])]
    count = colours.shape[-1]
    if (colours == colours[..., :1]).all():
        return np.ascontiguousarray(colours[..., 0], dtype=np.float64)
    if channel is None:
        raise InputError(
            f"{where} is a colour image with {count} channels: if it is a scan of film, which "
            "darkens with dose, convert it to dose first (napari_shadowinv.film); otherwise choose "
            'a channel that is linear in fluence, "red", "green", "blue" or "mean", or its number'
        )
    if channel == "mean":
        return np.ascontiguousarray(colours.mean(axis=-1, dtype=np.float64))
    text = str(channel)
    index = CHANNELS.index(text) if text in CHANNELS else int(text) if text.isdecimal() else -1
    if not 0 <= index < count:
        raise InputError(
            f"{where} has no channel {text!r}: expected "
            f'"red", "green", "blue", "mean" or a number from 0 to {count - 1}'
        )
    return np.ascontiguousarray(colours[..., index], dtype=np.float64)


def film_warnings(array: AnyArray, channel: str | int | None) -> tuple[Caution, ...]:
    """Warn of a picture in colour, or with a bright rim: it may be a film, dark with dose."""
    grey = to_grey(array, "mean", "")
    if array.ndim == 3 and not np.array_equal(grey, to_grey(array, 0, "")):
        sign = f"channel {channel!r} of a colour image was used as the fluence"
    elif array.dtype.kind in "iu" and _is_lit_around(grey):
        sign = (
            "the rim is as bright as anything in the image and the centre is darker, which "
            "suggests a film scan"
        )
    else:
        return ()
    text = (
        f"{sign}: film darkens with dose, so a scan gives a field of the wrong sign unless it is "
        "converted to dose first (napari_shadowinv.film)"
    )
    return (Caution("film-scan", text),)


def _is_lit_around(image: FloatArray) -> bool:
    """Return whether all four sides are as bright as the brightest part, the middle darker."""
    # Light or particles that are deflected out of the middle make something else brighter.
    height, width = image.shape
    rim = max(1, round(_RIM * min(height, width)))
    sides = (image[:rim], image[-rim:], image[:, :rim], image[:, -rim:])
    dimmest = min(float(np.median(side)) for side in sides)
    middle = image[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return bool(
        np.median(middle) < _DARKER * dimmest and _AS_BRIGHT * np.percentile(image, 99) < dimmest
    )


_TO_METRES = {2: 0.0254, 3: 0.01}  # by TIFF's unit of resolution


class Scan(NamedTuple):
    """A colour scan: pixels of shape (H, W, 3), their size in m if it is known, its checksum."""

    pixels: AnyArray
    pixel_size: float | None
    checksum: str


@as_file_errors
def read_scan(path: Path) -> Scan:
    """Read a colour scan of film in its own dtype.

    Raises
    ------
    FileFormatError
        If the file is missing or cannot be read.
    InputError
        If it has no colours.
    """
    file_format = format_of(path)
    content = file_format.read(path) if file_format.is_scan else None
    if not isinstance(content, tuple) or content[0].ndim != 3 or content[0].shape[-1] not in (3, 4):
        raise InputError(f"{path} is no picture in colour: expected a scan in red, green and blue")
    return Scan(content[0][..., :3], _pixel_size(path), sha256(path))


def _pixel_size(path: Path) -> float | None:
    """Return the pixel size by a TIFF's resolution; scanners set none in other formats."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as tiff:
            tags = tiff.pages[0].aspage().tags
            count, per = tags["XResolution"].value
            unit = _TO_METRES[int(tags["ResolutionUnit"].value)]
    except (tifffile.TiffFileError, KeyError):
        return None
    return unit * per / count if count > 0 and count / per > 1 else None


_TIFF_RATIO = 3 * DEFLATE_RATIO  # LZW at its best packs two and a half times as well as zlib


_SMALL_STRIP = 50_000_000  # bytes, which do not matter
_UNPACKERS: dict[str, Callable[[], Any]] = {
    **dict.fromkeys(("ADOBE_DEFLATE", "DEFLATE"), zlib.decompressobj),
    "LZMA": lzma.LZMADecompressor,
}


def _check_picture(path: Path, name: str, array: AnyArray) -> None:
    is_picture = array.ndim == 2 or (array.ndim == 3 and array.shape[-1] in (2, 3, 4))
    if not is_picture or array.size == 0:
        raise FileFormatError(
            f"{path} holds a {name} array of shape {array.shape}: expected one picture, "
            "(height, width) or with 3 or 4 colour channels last; save one plane"
        )
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} pixels: expected whole or real numbers; convert them"
        )


@contextmanager
def _open_tiff(path: Path) -> Iterator[Any]:
    """Open a TIFF with the decoder's log silenced, because the error says it once."""
    import tifffile

    check_regular(path, "a TIFF")
    logger = logging.getLogger("tifffile")
    before = logger.disabled
    logger.disabled = True
    try:
        with tifffile.TiffFile(path) as tiff:
            yield tiff
    finally:
        logger.disabled = before


def read_tiff(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read a TIFF with one page."""
    with _open_tiff(path) as tiff:
        if len(tiff.pages) != 1:
            raise FileFormatError(
                f"{path} has {len(tiff.pages)} pages: expected one image; invert all of them as a "
                "stack of shots, or save the page you need separately"
            )
        return _read_page(path, tiff.pages[0].aspage())


def _read_page(path: Path, page: Any) -> tuple[AnyArray, dict[str, Any]]:
    _check_complete(path, page)
    array = _decode(path, page)
    if page.photometric.name == "PALETTE" and page.colormap is not None:
        array = np.moveaxis(page.colormap[:, array], 0, -1)
    if page.photometric.name == "MINISWHITE" and array.dtype.kind == "u":
        # The format says that 0 is the brightest value here.
        array = (2**page.bitspersample - 1 - array).astype(array.dtype)
    if array.ndim == 3 and page.axes in ("SYX", "CYX"):
        array = np.moveaxis(array, 0, -1)
    _check_picture(path, "TIFF", array)
    return array, {"bits": int(page.bitspersample)}


@as_file_errors
def tiff_pages(path: Path) -> int:
    """Return how many pages a TIFF has."""
    with _open_tiff(path) as tiff:
        return len(tiff.pages)


@as_file_errors
def read_tiff_page(
    path: Path, number: int, *, channel: str | int | None = None
) -> tuple[FloatArray, tuple[Caution, ...]]:
    """Read page `number`, from 0, of a TIFF that holds many, with warnings as of a `Radiograph`."""
    with _open_tiff(path) as tiff:
        array, _ = _read_page(path, tiff.pages[number].aspage())
    return to_grey(array, channel, f"page {number} of {path}"), film_warnings(array, channel)


def _decode(path: Path, page: Any) -> AnyArray:
    try:
        return np.asarray(page.asarray())
    except ValueError as error:
        if "imagecodecs" not in str(error):
            raise
    # Pillow brings some codecs, LZW among them, but not for every pixel type.
    array = _read_with_pillow(path, page.index)
    is_same_type = array.dtype == page.dtype.newbyteorder("=") and array.shape == page.shape
    if not is_same_type or page.photometric.name not in ("MINISBLACK", "RGB"):
        raise FileFormatError(
            f"{path} is compressed with {page.compression.name}, which is not supported: save it "
            "without compression, or install the package imagecodecs"
        )
    return array


def _check_complete(path: Path, page: Any) -> None:
    # tifffile fills missing strips with zeros, which would pass for a void in the beam.
    size = path.stat().st_size
    places = zip(page.dataoffsets, page.databytecounts, strict=True)
    end = max((offset + count for offset, count in places if count), default=0)
    if not 0 < end <= size:
        raise FileFormatError(
            f"{path} is truncated: its TIFF header implies {end} bytes, found {size}; copy it again"
        )
    packed_bytes = sum(page.databytecounts)
    packing = 1 if page.compression.name == "NONE" else _TIFF_RATIO
    check_promise(path, "TIFF", page.size * page.bitspersample // 8, packing * packed_bytes)
    # One tile may be far larger than what is used of it.
    check_size(path, max(page.size, math.prod(page.chunks)) * max(8, page.dtype.itemsize))
    if page.compression.name in _UNPACKERS:
        _check_strips(path, page)


def _check_strips(path: Path, page: Any) -> None:
    """Refuse a strip or tile that unpacks to far more than its pixels; the decoder accepts it."""
    pixels = math.prod(page.chunks) * page.dtype.itemsize
    most = max(2 * pixels, _SMALL_STRIP)
    with path.open("rb") as file:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            if count * _TIFF_RATIO <= most:
                continue
            file.seek(offset)
            unpacker = _UNPACKERS[page.compression.name]()
            if len(unpacker.decompress(file.read(count), most + 1)) > most:
                raise FileFormatError(
                    f"{path} is damaged: a strip of {count} bytes unpacks to more than {most} "
                    f"bytes, expected {pixels}; save it again"
                )


def read_png(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read a PNG; colours with 16 bits are refused."""
    with path.open("rb") as file:
        bits = file.read(25)[24]
    array = _read_with_pillow(path)
    if bits == 16 and array.dtype.itemsize == 1:
        raise FileFormatError(
            f"{path} is a colour PNG with 16 bits per channel, which would be reduced to 8 bits: "
            "expected a greyscale PNG or a TIFF; save it as TIFF"
        )
    _check_picture(path, "PNG", array)
    return array, {"bits": bits}


def read_eight_bits(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read a picture whose format has 8 bits per sample."""
    array = _read_with_pillow(path)
    _check_picture(path, "picture's", array)
    return array, {"bits": 8}


_PILLOW_LIMIT = threading.Lock()


def _open_picture(file: BinaryIO) -> Any:
    """Open a picture without pillow's limit of pixels; ours on memory follows."""
    import imageio.v3 as iio
    from PIL import Image

    with _PILLOW_LIMIT:
        before, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return iio.imopen(file, "r", plugin="pillow")
        finally:
            Image.MAX_IMAGE_PIXELS = before


def _read_with_pillow(path: Path, index: int = 0) -> AnyArray:
    # A file object, because imageio would believe the name.
    with path.open("rb") as file, _open_picture(file) as picture:
        shape = picture.properties(index=index).shape
        # A pixel has one bit at least.
        check_promise(path, "picture", math.prod(shape) // 8, DEFLATE_RATIO * path.stat().st_size)
        check_size(path, 8 * math.prod(shape))
        return np.asarray(picture.read(index=index))


def write_tiff(path: Path, plane: AnyArray, pixel_size: float | None = None) -> None:
    """Write a plane as float32 TIFF, the width of a pixel (m) as its resolution."""
    import tifffile

    options: dict[str, Any] = {}
    if pixel_size is not None:
        per_centimetre = 0.01 / pixel_size
        options = {"resolution": (per_centimetre, per_centimetre), "resolutionunit": "CENTIMETER"}
    tifffile.imwrite(path, np.asarray(plane, dtype=np.float32), photometric="minisblack", **options)


def write_png(path: Path, plane: AnyArray, pixel_size: float | None = None) -> None:
    """Write a plane with 16 bits, its largest value white, negative ones black."""
    from PIL import Image

    level = max(float(np.max(plane)), 0.0) / 65535 or 1.0
    grey = np.clip(np.rint(np.asarray(plane) / level), 0, 65535).astype(np.uint16)
    content = BytesIO()
    Image.fromarray(grey).save(content, "PNG")
    # Only when all of it is there: a full disk then gives one plain error.
    path.write_bytes(content.getvalue())
