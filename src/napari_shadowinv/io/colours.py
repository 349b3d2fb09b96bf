"""Colour images: reduction to one plane (`to_grey`), signs of a film scan (`film_warnings`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError

CHANNELS = ("red", "green", "blue", "mean")

# Of a picture of film that is exposed in its middle: the rim's width over the shorter side, its
# least brightness over the brightest, and the middle's greatest over the rim's.
_RIM, _AS_BRIGHT, _DARKER = 0.05, 0.9, 0.8


def to_grey(array: AnyArray, channel: str | int | None, where: str | Path) -> FloatArray:
    """Reduce an image, which may have channels and alpha last, to one plane of float64."""
    if array.ndim == 2:
        return np.ascontiguousarray(array, dtype=np.float64)
    colours = array[..., : {2: 1, 4: 3}.get(array.shape[-1], array.shape[-1])]
    if (colours == colours[..., :1]).all():
        return np.ascontiguousarray(colours[..., 0], dtype=np.float64)
    if channel is None:
        raise InputError(
            f"{where} is a colour image with {colours.shape[-1]} channels: if it is a scan of "
            "film, which darkens with dose, convert it to dose first "
            "(napari_shadowinv.film); "
            'otherwise choose a channel that is linear in fluence, "red", "green", "blue" or '
            '"mean", or its number'
        )
    if channel == "mean":
        return np.ascontiguousarray(colours.mean(axis=-1, dtype=np.float64))
    text, count = str(channel), colours.shape[-1]
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
    is_colour = array.ndim == 3 and not np.array_equal(grey, to_grey(array, 0, ""))
    if is_colour:
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
