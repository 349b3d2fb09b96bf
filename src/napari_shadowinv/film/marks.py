"""Pixels of a film whose dose cannot be trusted.

- writing, scratches, cuts and the rim: `usable_pixels`
- edges that heat or light has darkened: `burnt_edges`
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.film.calibration import Calibration, net_optical_density
from napari_shadowinv.film.scans import checked_scan

__all__ = ["burnt_edges", "usable_pixels"]

_EVERY = 8  # px: of what is smooth, every so many are looked at
_AROUND, _FAR_AROUND = 13, 25  # of these, for what is usual and how much that scatters
_NORMAL_MAD = 1.4826
_UNUSUAL, _LEAST = 6.0, 0.04  # times the scatter, and in optical density
_BLUR = 1.0  # px
_SMALLEST, _GAPS, _MARGIN = 4, 3, 2  # px: marks have an area, close gaps, and are widened

# Burnt edges, measured on real EBT3: 1.6 to 40 times the dose, over in 8 to 38 px.
_MAX_BURNT_DEPTH_PX = 40
_CUT_PX = 3  # the outermost pixels are partly bed
_FALL_PX = 6
_MIN_FALL = 0.35  # of the logarithm of the dose over that length: a factor of 1.4
_MIN_FALL_TO_INSIDE = 3.0  # times the slope further in, so that a beam is not taken for a burn
_MIN_RISE = 0.2  # of the logarithm, everywhere between the edge and the fall
_ALONG_PX = 21  # along the edge, of the median that removes grain and writing
_MIN_BURNT_SHARE = 0.3  # of a side: fire follows edges, fronts of the beam cross them


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
        If the film has no colours, or the rim leaves nothing of it.
    """
    values = checked_scan(film)
    if not 0 <= 2 * rim < min(values.shape[:2]):
        raise InputError(
            f"the rim is {rim} px on a film of {values.shape[0]} × {values.shape[1]} px: expected "
            "a few px"
        )
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


def burnt_edges(dose: ArrayLike) -> BoolArray:
    """Return the pixels along burnt edges of a film, which look like dose.

    Heat and light darken a film as protons do, so colours do not show it. But the dose then falls
    steeply from the edge inwards, along a good part of a side, and hardly any more further in.

    Parameters
    ----------
    dose : array_like, shape (H, W)
        Dose of an upright film, positive.

    Returns
    -------
    ndarray of bool, shape (H, W)
    """
    logarithm = np.log(np.asarray(dose, np.float64))
    burnt = np.zeros(logarithm.shape, dtype=bool)
    for turns in range(4):
        # A view: what is marked on it is marked on the film.
        side = np.rot90(burnt, turns)
        side |= _burnt_top(np.rot90(logarithm, turns))
    return burnt


def _burnt_top(logarithm: FloatArray) -> BoolArray:
    """Burnt pixels along the upper side."""
    height = len(logarithm)
    reach = min(_MAX_BURNT_DEPTH_PX, height // 6)
    burnt = np.zeros(logarithm.shape, dtype=bool)
    if reach <= _CUT_PX or height < reach + 4 * _FALL_PX:
        return burnt
    top = logarithm[_CUT_PX : reach + 4 * _FALL_PX]
    smooth = ndimage.median_filter(top, (3, _ALONG_PX), mode="nearest")
    depths = np.arange(reach - _CUT_PX)
    outside, inside, beyond = (smooth[depths + n * _FALL_PX] for n in (0, 1, 3))
    fall = outside - inside
    is_steep = fall > np.maximum(_MIN_FALL, _MIN_FALL_TO_INSIDE * (inside - beyond) / 2)
    is_higher = np.minimum.accumulate(outside, axis=0) > inside + _MIN_RISE
    burn_ends = is_steep & is_higher
    ends = np.where(burn_ends, depths[:, None] + 1, 0).max(axis=0)
    if (ends > 0).mean() < _MIN_BURNT_SHARE:
        return burnt
    # Under a bright beam the fall is hidden: there the burn is as deep as elsewhere on this side.
    ends = np.where(ends > 0, ends, np.median(ends[ends > 0]))
    ends = ndimage.maximum_filter1d(ends + _CUT_PX + _FALL_PX + _MARGIN, _ALONG_PX)
    return np.asarray(np.arange(height)[:, None] < ends)


def _usual_blue(calibration: Calibration, unexposed: FloatArray, red: FloatArray) -> FloatArray:
    """How dark exposed film is in blue where it is so dark in red."""
    table = np.log10(unexposed / calibration.pixels[np.argsort(calibration.doses)])
    return np.asarray(np.interp(red, np.maximum.accumulate(table[:, 0]), table[:, 2]))


def _in_full(few: FloatArray, like: FloatArray) -> FloatArray:
    places = np.mgrid[: like.shape[0], : like.shape[1]] / _EVERY - 0.5
    return np.asarray(ndimage.map_coordinates(few, places, order=1, mode="nearest"))
