"""Pictures: TIFF with 8, 16 or 32 bits, PNG, BMP and JPEG.

- read one of these, or a plane of another family of formats: `read_picture`
- a page of a TIFF that holds many: `tiff_pages`, `read_tiff_page`
- write a plane: `write_tiff`, `write_png`
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.safety import check_regular, check_size, refusing_damage
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.camera import read_b16, read_spe
from napari_shadowinv.io.colours import film_warnings, to_grey
from napari_shadowinv.io.matlab import read_mat
from napari_shadowinv.io.size_checks import DEFLATE_RATIO, check_promise
from napari_shadowinv.io.text import read_text

__all__ = ["PICTURES", "read_picture", "read_tiff_page", "tiff_pages", "write_png", "write_tiff"]

PICTURES = ("tiff", "png", "bmp", "jpeg")
"""Kinds of `kind_of` that a scanner may have written."""


@refusing_damage
def read_picture(path: Path, kind: str) -> tuple[NDArray[Any], dict[str, Any]]:
    """Read a picture as it is stored.

    Parameters
    ----------
    path : Path
        The file.
    kind : str
        What `kind_of` said.

    Returns
    -------
    array : ndarray, shape (H, W) or (H, W, C)
        Pixels in the file's own dtype.
    metadata : dict
        ``bits``: bits per sample.

    Raises
    ------
    FileFormatError
        If the file is damaged or holds anything else than one picture.
    """
    array, metadata = _reader(kind)(path)
    _check(path, kind, array)
    return array, metadata


# LZW at its best packs two and a half times as well as zlib.
_TIFF_RATIO = 3 * DEFLATE_RATIO


def _reader(kind: str) -> Callable[[Path], tuple[NDArray[Any], dict[str, Any]]]:
    readers: dict[str, Callable[[Path], tuple[NDArray[Any], dict[str, Any]]]] = {
        "tiff": _read_tiff,
        "png": _read_png,
        "mat": read_mat,
        "text": read_text,
        "b16": read_b16,
        "spe": read_spe,
    }
    return readers.get(kind, _read_eight_bits)


def _check(path: Path, kind: str, array: NDArray[Any]) -> None:
    is_picture = array.ndim == 2 or (array.ndim == 3 and array.shape[-1] in (2, 3, 4))
    if not is_picture or array.size == 0:
        raise FileFormatError(
            f"{path} holds a {kind.upper()} array of shape {array.shape}: expected one picture, "
            "(height, width) or with 3 or 4 colour channels last; save one plane"
        )
    if array.dtype.kind not in "buif":
        raise FileFormatError(
            f"{path} holds {array.dtype} pixels: expected whole or real numbers; convert them"
        )


@contextmanager
def _silent(name: str) -> Iterator[None]:
    """Keep a decoder's own log lines off the terminal: the error says it once."""
    logger = logging.getLogger(name)
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


def _read_tiff(path: Path) -> tuple[NDArray[Any], dict[str, Any]]:
    import tifffile

    with _silent("tifffile"), tifffile.TiffFile(path) as tiff:
        if len(tiff.pages) != 1:
            raise FileFormatError(
                f"{path} has {len(tiff.pages)} pages: expected one radiograph per file; save the "
                "page you need separately"
            )
        return _read_page(path, tiff.pages[0].aspage())


def _read_page(path: Path, page: Any) -> tuple[NDArray[Any], dict[str, Any]]:
    import tifffile

    _check_complete(path, page)
    array = _decode(path, page)
    if page.photometric == tifffile.PHOTOMETRIC.PALETTE and page.colormap is not None:
        array = _apply_palette(array, page.colormap)
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE and array.dtype.kind == "u":
        # The format says that 0 is the brightest value here.
        array = (2**page.bitspersample - 1 - array).astype(array.dtype)
    if array.ndim == 3 and page.axes in ("SYX", "CYX"):
        array = np.moveaxis(array, 0, -1)
    return array, {"bits": int(page.bitspersample)}


@refusing_damage
def tiff_pages(path: Path) -> int:
    """Return how many pages a TIFF has.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    int
        1 for an ordinary picture.

    Raises
    ------
    FileFormatError
        If the chain of pages is damaged.
    """
    import tifffile

    with _silent("tifffile"), tifffile.TiffFile(path) as tiff:
        return len(tiff.pages)


@refusing_damage
def read_tiff_page(
    path: Path, number: int, *, channel: str | int | None = None
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """Read one page of a TIFF that holds many.

    Parameters
    ----------
    path : Path
        The file.
    number : int
        Which page, from 0.
    channel : {"red", "green", "blue", "mean"} or int, optional
        What to take of a colour image.

    Returns
    -------
    image : ndarray, shape (H, W)
        Its pixels.
    warnings : tuple of str
        See `Radiograph`.

    Raises
    ------
    FileFormatError, InputError
        If the page is damaged, or has colours.
    """
    import tifffile

    check_regular(path, "a TIFF")
    with _silent("tifffile"), tifffile.TiffFile(path) as tiff:
        array, _ = _read_page(path, tiff.pages[number].aspage())
    _check(path, "tiff", array)
    where = f"page {number} of {path}"
    return to_grey(array, channel, where), film_warnings(array, channel)


def _decode(path: Path, page: Any) -> NDArray[Any]:
    try:
        return np.asarray(page.asarray())
    except ValueError as error:
        if "imagecodecs" not in str(error):
            raise
    # Pillow brings some codecs, LZW among them, but not for every pixel type.
    array = _read_with_pillow(path, page.index)
    same = array.dtype == page.dtype.newbyteorder("=") and array.shape == page.shape
    if not same or page.photometric.name not in ("MINISBLACK", "RGB"):
        raise FileFormatError(
            f"{path} is compressed with {page.compression.name}, which is not supported: save it "
            "without compression, or install the package imagecodecs"
        )
    return array


def _check_complete(path: Path, page: Any) -> None:
    # tifffile fills missing strips with zeros, which would pass for a void in the beam.
    size = path.stat().st_size
    ends = [
        offset + count
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True)
        if count
    ]
    if not ends or max(ends) > size:
        raise FileFormatError(
            f"{path} is truncated: its TIFF header implies {max(ends, default=0)} bytes, found "
            f"{size}; copy it again"
        )
    held = sum(page.databytecounts)
    packing = 1 if page.compression.name == "NONE" else _TIFF_RATIO
    check_promise(path, "TIFF", page.size * page.bitspersample // 8, packing * held)
    # One tile may be far larger than what is used of it.
    check_size(path, max(page.size, math.prod(page.chunks)) * max(8, page.dtype.itemsize))


def _apply_palette(array: NDArray[Any], palette: NDArray[np.uint16]) -> NDArray[np.uint16]:
    return np.moveaxis(palette[:, array], 0, -1)


def _read_png(path: Path) -> tuple[NDArray[Any], dict[str, Any]]:
    with path.open("rb") as file:
        bits = file.read(25)[24]
    array = _read_with_pillow(path)
    if bits == 16 and array.dtype.itemsize == 1:
        raise FileFormatError(
            f"{path} is a colour PNG with 16 bits per channel, which would be reduced to 8 bits: "
            "expected a greyscale PNG or a TIFF; save it as TIFF"
        )
    return array, {"bits": bits}


def _read_eight_bits(path: Path) -> tuple[NDArray[Any], dict[str, Any]]:
    return _read_with_pillow(path), {"bits": 8}


def _read_with_pillow(path: Path, index: int = 0) -> NDArray[Any]:
    import imageio.v3 as iio

    # A file object, because imageio would believe the name.
    with path.open("rb") as file, iio.imopen(file, "r", plugin="pillow") as picture:
        shape = picture.properties(index=index).shape
        # A pixel has one bit at least.
        check_promise(path, "picture", math.prod(shape) // 8, DEFLATE_RATIO * path.stat().st_size)
        check_size(path, 8 * math.prod(shape))
        return np.asarray(picture.read(index=index))


def write_tiff(path: Path, plane: NDArray[Any], pixel_size: float | None = None) -> None:
    """Write a plane as float32 TIFF.

    Parameters
    ----------
    path : Path
        The file.
    plane : ndarray, shape (H, W)
        The values, kept as they are.
    pixel_size : float, optional
        Width of a pixel in metres, stored as the resolution.
    """
    import tifffile

    options: dict[str, Any] = {}
    if pixel_size is not None:
        per_centimetre = 0.01 / pixel_size
        options = {"resolution": (per_centimetre, per_centimetre), "resolutionunit": "CENTIMETER"}
    tifffile.imwrite(path, np.asarray(plane, dtype=np.float32), photometric="minisblack", **options)


def write_png(path: Path, plane: NDArray[Any]) -> float:
    """Write a plane as a grey PNG with 16 bits, its largest value white.

    Parameters
    ----------
    path : Path
        The file.
    plane : ndarray, shape (H, W)
        The values; negative ones become black.

    Returns
    -------
    float
        What one grey level stands for.
    """
    import imageio.v3 as iio

    level = max(float(np.max(plane)), 0.0) / 65535 or 1.0
    grey = np.clip(np.rint(np.asarray(plane) / level), 0, 65535).astype(np.uint16)
    # A file that imageio cannot write to complains once more when Python clears up.
    path.write_bytes(iio.imwrite("<bytes>", grey, extension=".png", plugin="pillow"))
    return level
