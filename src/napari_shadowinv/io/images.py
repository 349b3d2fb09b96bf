"""Pictures (TIFF with 8, 16 or 32 bits, PNG, BMP, JPEG) and numpy's arrays, one plane each."""

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
from typing import Any, BinaryIO

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_regular, check_size
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.colours import film_warnings, to_grey
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise

_TIFF_RATIO = 3 * DEFLATE_RATIO  # LZW at its best packs two and a half times as well as zlib


_SMALL_STRIP = 50_000_000  # bytes, which do not matter
_UNPACKERS: dict[str, Callable[[bytes, int], bytes]] = {
    name: lambda packed, most: zlib.decompressobj().decompress(packed, most)
    for name in ("ADOBE_DEFLATE", "DEFLATE")
}
_UNPACKERS["LZMA"] = lambda packed, most: lzma.LZMADecompressor().decompress(packed, most)


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
                f"{path} has {len(tiff.pages)} pages: expected one radiograph per file; save the "
                "page you need separately"
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
    check_regular(path, "a TIFF")
    with _open_tiff(path) as tiff:
        return len(tiff.pages)


@as_file_errors
def read_tiff_page(
    path: Path, number: int, *, channel: str | int | None = None
) -> tuple[FloatArray, tuple[Caution, ...]]:
    """Read page `number`, from 0, of a TIFF that holds many, with warnings as of a `Radiograph`."""
    check_regular(path, "a TIFF")
    with _open_tiff(path) as tiff:
        array, _ = _read_page(path, tiff.pages[number].aspage())
    where = f"page {number} of {path}"
    return to_grey(array, channel, where), film_warnings(array, channel)


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
            unpacked = len(_UNPACKERS[page.compression.name](file.read(count), most + 1))
            if unpacked > most:
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


@as_file_errors
def read_npy(path: Path) -> AnyArray:
    """Read an array of real numbers, of any shape and in its own dtype."""
    # Mapped first: a header that promises too much then fails before memory is asked for.
    try:
        mapped = np.load(path, allow_pickle=False, mmap_mode="r")
    except ValueError as error:
        if "Python objects" not in str(error):
            raise
        raise FileFormatError(
            f"{path} contains Python objects: expected an array of numbers; save it again with "
            "array.astype(float)"
        ) from error
    check_size(path, mapped.size * max(8, mapped.dtype.itemsize))
    array = np.array(mapped)
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} values: expected whole or real numbers; convert them"
        )
    return array


def read_npy_plane(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read an image; arrays of other shapes are refused."""
    array = read_npy(path)
    if array.ndim != 2 or array.size == 0:
        raise FileFormatError(
            f"{path} holds an array of shape {array.shape}: expected an image of shape "
            "(height, width); save one plane of it"
        )
    return array, {}


def write_npy(path: Path, array: AnyArray, pixel_size: float | None = None) -> None:
    """Write an array as it is; the format does not keep the size of a pixel."""
    content = BytesIO()
    np.save(content, array, allow_pickle=False)
    # numpy gives no reason when it cannot write to a file.
    path.write_bytes(content.getbuffer())


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
    path.write_bytes(content.getbuffer())
