"""Pictures, one plane each.

- PNG, BMP and JPEG: `read_picture`
- what every format of pictures has in common: `as_picture`, `geometry_of`, `square_cautions`,
  `gamma_caution`
- colour images: reduction to one plane (`to_grey`), signs of a film scan (`film_cautions`)
- scans of film in colour: `read_scan`
"""

from __future__ import annotations

import math
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_size
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import DEFLATE_RATIO, check_promise, sha256
from napari_shadowinv.io.formats import format_of

CHANNELS = ("red", "green", "blue", "mean")

INCH_M = 0.0254
_MODES = {"1", "L", "LA", "P", "PA", "RGB", "RGBA", "I", "I;16", "I;16B", "F"}  # pillow's


def to_grey(array: AnyArray, channel: str | int | None, where: str | Path) -> FloatArray:
    """Reduce an image, which may have channels last, to one plane of float64."""
    if array.ndim == 2:
        return np.ascontiguousarray(array, dtype=np.float64)
    count = array.shape[-1]
    if np.array_equal(array, np.broadcast_to(array[..., :1], array.shape), equal_nan=True):
        return np.ascontiguousarray(array[..., 0], dtype=np.float64)
    if channel is None:
        raise InputError(
            f"{where} is a colour image with {count} channels: if it is a scan of film, which "
            "darkens with dose, convert it to dose first (napari_shadowinv.film); otherwise choose "
            'a channel that is linear in fluence, "red", "green", "blue" or "mean", or its number'
        )
    if channel == "mean":
        return np.ascontiguousarray(array.mean(axis=-1, dtype=np.float64))
    text = str(channel)
    index = CHANNELS.index(text) if text in CHANNELS else int(text) if text.isdecimal() else -1
    if not 0 <= index < count:
        raise InputError(
            f"{where} has no channel {text!r}: expected "
            f'"red", "green", "blue", "mean" or a number from 0 to {count - 1}'
        )
    return np.ascontiguousarray(array[..., index], dtype=np.float64)


def film_cautions(array: AnyArray, channel: str | int | None) -> tuple[Caution, ...]:
    """Warn of a picture in colour, or with a bright rim: it may be a film, dark with dose."""
    from napari_shadowinv.preprocessing.image_checks import is_lit_around

    grey = to_grey(array, "mean", "")
    if array.ndim == 3 and not np.array_equal(grey, to_grey(array, 0, "")):
        sign = f"channel {channel!r} of a colour image was used as the fluence"
    elif array.dtype.kind in "iu" and is_lit_around(grey):
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


class Scan(NamedTuple):
    """A colour scan: pixels of shape (H, W, 3), their size in m if it is known, its checksum."""

    pixels: AnyArray
    pixel_size: float | None
    checksum: str


@as_file_errors
def read_scan(path: Path) -> Scan:
    """Read a colour scan of film in its own dtype; an `InputError` refuses one without colours."""
    file_format = format_of(path)
    content = file_format.read(path) if file_format.is_scan else None
    if not isinstance(content, tuple) or content[0].ndim != 3 or content[0].shape[-1] != 3:
        raise InputError(f"{path} is no picture in colour: expected a scan in red, green and blue")
    pixels, metadata = content
    return Scan(pixels, metadata.get("stated_pixel_size"), sha256(path))


def as_picture(
    path: Path,
    name: str,
    array: AnyArray,
    missing: BoolArray | None,
    orientation: Any,
    notes: tuple[str, ...] = (),
) -> tuple[AnyArray, dict[str, Any]]:
    """Return pixels as they are seen, NaN where they are missing; with their mask and notes.

    The `orientation` is that of Exif and TIFF. Refuses an array that is no picture.
    """
    is_picture = array.ndim == 2 or (array.ndim == 3 and array.shape[-1] in (2, 3, 4))
    if not is_picture or array.size == 0:
        raise FileFormatError(
            f"{path} holds a {name} array of shape {array.shape}: expected one picture, "
            "(height, width) or with 3 or 4 colour channels last; save one plane"
        )
    if missing is not None and missing.any():
        array = array.astype(np.float64)
        array[missing] = np.nan
    if orientation in range(2, 9):
        array = array.swapaxes(0, 1) if orientation >= 5 else array
        down, right = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
        array = array[:: -1 if down else 1, :: -1 if right else 1]
        notes = (*notes, "turned upright as the file says")
    gaps = np.isnan(array) if array.ndim == 2 else np.isnan(array).any(axis=-1)
    if not gaps.any():
        return array, {"notes": notes}
    note = f"{gaps.sum()} pixels without a value in the file are left out"
    return array, {"mask": ~gaps, "notes": (*notes, note)}


def geometry_of(
    sides: tuple[float, ...],
    is_length: bool,
    is_drawn: bool = False,
    *,
    least_printed: float = 80e-6,
) -> dict[str, Any]:
    """Return a file's size of a pixel (m) as metadata, and as geometry unless it may be a default.

    Picture programs write resolutions up to 300 per inch, `least_printed`, without knowing it; not
    so if the file means a length, or is drawn by this package, for pixels at the object.
    """
    if not sides or square_cautions(sides):
        return {}
    metres = sides[0]
    name = "pixel_size" if is_drawn else "detector_pixel_size"
    is_measured = is_length or is_drawn or metres < least_printed
    return {"stated_pixel_size": metres, **({"geometry": {name: metres}} if is_measured else {})}


def square_cautions(sides: tuple[float, ...]) -> tuple[Caution, ...]:
    """Warn of pixels whose width and height (m) differ by their file."""
    if not sides or max(sides) <= 1.01 * min(sides):
        return ()
    width, height = (f"{side / 1e-6:.4g}" for side in sides)
    text = (
        f"pixels are {width} µm wide and {height} µm high by the file: fields come out wrong "
        "along one axis; resample the image to square pixels"
    )
    return (Caution("file", text),)


def gamma_caution(kind: str) -> Caution:
    """Return the caution for pixels that are a power of the light."""
    text = (
        f"the image is {kind}, whose values are not proportional to the light (gamma of about "
        "2.2): fields come out up to two times too weak; record 16-bit TIFF with gamma 1"
    )
    return Caution("gamma", text)


def is_linear_profile(profile: bytes) -> bool:
    """Return whether a colour profile calls itself linear."""
    return b"linear" in profile.replace(b"\0", b"").lower()


def read_picture(path: Path) -> tuple[AnyArray, dict[str, Any]]:
    """Read a PNG, BMP or JPEG: upright, with NaN at transparent pixels."""
    from PIL import ExifTags, Image

    # A file object, because pillow may believe the name.
    with path.open("rb") as file, Image.open(file) as picture:
        area = math.prod(picture.size)
        # A pixel has one bit at least.
        check_promise(path, "picture", area // 8, DEFLATE_RATIO * path.stat().st_size)
        check_size(path, 8 * area * len(picture.getbands()))
        if picture.mode not in _MODES:
            raise FileFormatError(
                f"{path} holds pixels of the kind {picture.mode}, which are not proportional to "
                "the light: expected grey or RGB; export it as 16-bit TIFF"
            )
        has_16_bits = ";16B" in str(picture.tile[0][3])  # of a PNG
        if has_16_bits and len(picture.getbands()) > 1:
            raise FileFormatError(
                f"{path} is a colour PNG with 16 bits per channel, which would be reduced to 8 "
                "bits: expected a greyscale PNG or a TIFF; save it as TIFF"
            )
        orientation = picture.getexif().get(ExifTags.Base.Orientation, 1)
        pixels, missing = _pixels_and_gaps(picture)
        array, metadata = as_picture(path, "picture's", pixels, missing, orientation)
        sides = _printed_sides(picture.info)
        cautions = _light_cautions(picture.format, picture.info) + square_cautions(sides)
    bits = 16 if has_16_bits else 8 * array.dtype.itemsize
    size = geometry_of(sides, is_length=False)
    return array, {**metadata, "bits": bits, "cautions": cautions, **size}


def _pixels_and_gaps(picture: Any) -> tuple[AnyArray, BoolArray | None]:
    """Return grey levels or colours, and where they are transparent."""
    colour = picture.info.get("transparency")
    if picture.mode in ("P", "PA") or isinstance(colour, tuple):
        picture = picture.convert("RGBA")
    array = np.asarray(picture)
    if picture.mode == "LA":
        return array[..., 0], array[..., 1] == 0
    if picture.mode == "RGBA":
        return array[..., :3], array[..., 3] == 0
    return array, None if colour is None else array == colour


def _light_cautions(
    form: str | None, info: dict[Any, Any], gamma_tolerance: float = 0.01
) -> tuple[Caution, ...]:
    """Warn of pixels that are no linear measure of the light by their format."""
    profile = info.get("icc_profile")
    if form in ("JPEG", "MPO"):
        kind = "a JPEG"
    elif "srgb" in info or abs(info.get("gamma", 1.0) - 1.0) > gamma_tolerance:
        kind = f"a {form} for screens"
    elif profile and not is_linear_profile(profile):
        kind = f"a {form} with a colour profile"
    else:
        return ()
    return (gamma_caution(kind),)


def _printed_sides(info: dict[Any, Any]) -> tuple[float, ...]:
    """Return width and height of a pixel (m) by the dots per inch of a picture, if it has them."""
    dots = tuple(map(float, info.get("dpi", (0, 0))))
    return tuple(INCH_M / each for each in dots) if min(dots) > 1 else ()


def write_png(content: BytesIO, plane: AnyArray, pixel_size: float | None = None) -> None:
    """Write a plane with 16 bits, its largest value white, negative ones black."""
    from PIL import Image

    level = max(float(np.max(plane)), 0.0) / 65535 or 1.0
    grey = np.clip(np.rint(np.asarray(plane) / level), 0, 65535).astype(np.uint16)
    Image.fromarray(grey).save(content, "PNG")
