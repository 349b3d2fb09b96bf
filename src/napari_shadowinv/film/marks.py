"""Where a film does not tell its dose: writing, scratches, cuts and rims: `usable_pixels`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.film.calibration import Calibration, net_optical_density
from napari_shadowinv.film.scans import checked_scan

__all__ = ["usable_pixels"]

_EVERY = 8  # px: of what is smooth, every so many are looked at
_AROUND, _FAR_AROUND = 13, 25  # of these, for what is usual and how much that scatters
_NORMAL_MAD = 1.4826
_UNUSUAL, _LEAST = 6.0, 0.04  # times the scatter, and in optical density
_BLUR = 1.0  # px
_SMALLEST, _GAPS, _MARGIN = 4, 3, 2  # px: marks have an area, close gaps, and are widened


def usable_pixels(
    film: ArrayLike,
    calibration: Calibration,
    *,
    background: Sequence[float] | ArrayLike | None = None,
    rim: int = 6,
) -> BoolArray:
    """Return where a film tells its dose.

    Exposed film is as dark in blue as follows from how dark it is in red. Ink, scratches, notches,
    dust and burnt edges are not: there the blue differs from what it is around them. A scratch
    that only takes some of the active layer away looks like less dose, and a grey mark on film that
    is nearly black like more.

    Parameters
    ----------
    film : array_like, shape (H, W, 3)
        A film alone, upright.
    calibration : Calibration
        For its kind of film.
    background : array_like, shape (3,), optional
        Pixel of unexposed film. Default: the calibration's.
    rim : int, default 6
        Pixels along the edges that do not count.

    Returns
    -------
    ndarray of bool, shape (H, W)
        False on marks and along the rim.

    Raises
    ------
    InputError
        If the film has no colours.
    """
    values = checked_scan(film)
    unexposed = np.asarray(calibration.background if background is None else background, float)
    red, blue = (
        net_optical_density(np.maximum(values, 1), unexposed, channel)
        for channel in ("red", "blue")
    )
    odd = ndimage.gaussian_filter(blue - _usual_blue(calibration, unexposed, red), _BLUR)
    few = odd[_EVERY // 2 :: _EVERY, _EVERY // 2 :: _EVERY]
    usual = ndimage.median_filter(few, _AROUND, mode="nearest")
    scatter = ndimage.median_filter(np.abs(few - usual), _FAR_AROUND, mode="nearest")
    least = _UNUSUAL * _NORMAL_MAD * scatter
    marked = np.abs(odd - _in_full(usual, odd)) > np.maximum(_in_full(least, odd), _LEAST)
    labels, count = ndimage.label(marked)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    marked &= sizes[labels] >= _SMALLEST
    disc = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), _GAPS)
    wide = np.pad(marked, 2 * _GAPS)
    closed = ndimage.binary_closing(wide, disc)[2 * _GAPS : -2 * _GAPS, 2 * _GAPS : -2 * _GAPS]
    usable = ~ndimage.binary_dilation(closed, iterations=_MARGIN)
    if rim > 0:
        inner = np.zeros_like(usable)
        inner[rim:-rim, rim:-rim] = True
        usable &= inner
    return np.asarray(usable)


def _usual_blue(calibration: Calibration, unexposed: FloatArray, red: FloatArray) -> FloatArray:
    """How dark exposed film is in blue where it is so dark in red."""
    table = np.log10(unexposed / calibration.pixels[np.argsort(calibration.doses)])
    return np.asarray(np.interp(red, np.maximum.accumulate(table[:, 0]), table[:, 2]))


def _in_full(few: FloatArray, like: FloatArray) -> FloatArray:
    places = np.mgrid[: like.shape[0], : like.shape[1]] / _EVERY - 0.5
    return np.asarray(ndimage.map_coordinates(few, places, order=1, mode="nearest"))
