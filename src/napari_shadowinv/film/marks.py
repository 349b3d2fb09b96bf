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

_SAMPLE_STEP_PX = 8  # between the samples of the smooth background
_BACKGROUND_SAMPLES = 13  # side of the median that gives the background
_SCATTER_SAMPLES = 25  # side of the median that gives its scatter
_NORMAL_MAD = 1.4826
_MIN_SCATTERS = 6.0  # by which a mark differs from the background
_MIN_DENSITY = 0.04  # by which it differs, too, in optical density
_BLUR_PX = 1.0
_MIN_MARK_PX = 4  # area
_GAP_PX = 3  # that is closed
_MARGIN_PX = 2  # by which marks are widened

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
    """Return the pixels whose dose can be trusted.

    The darkening of exposed film in blue follows from its darkening in red. At ink, scratches,
    notches, dust and burnt edges, the blue differs from its surroundings. A scratch that only
    removes part of the active layer looks like less dose, a grey mark on nearly black film like
    more.

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
    excess = ndimage.gaussian_filter(blue - _expected_blue(calibration, unexposed, red), _BLUR_PX)
    first = _SAMPLE_STEP_PX // 2
    samples = excess[first::_SAMPLE_STEP_PX, first::_SAMPLE_STEP_PX]
    usual = ndimage.median_filter(samples, _BACKGROUND_SAMPLES, mode="nearest")
    scatter = ndimage.median_filter(np.abs(samples - usual), _SCATTER_SAMPLES, mode="nearest")
    least = np.maximum(_resample(_MIN_SCATTERS * _NORMAL_MAD * scatter, excess), _MIN_DENSITY)
    marked = np.abs(excess - _resample(usual, excess)) > least
    labels, count = ndimage.label(marked)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    marked &= sizes[labels] >= _MIN_MARK_PX
    disc = ndimage.iterate_structure(ndimage.generate_binary_structure(2, 1), _GAP_PX)
    border = 2 * _GAP_PX
    closed = ndimage.binary_closing(np.pad(marked, border), disc)[border:-border, border:-border]
    usable = ~ndimage.binary_dilation(closed, iterations=_MARGIN_PX)
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
        # A view: marks on it are marks on the film.
        side = np.rot90(burnt, turns)
        side |= _burnt_top(np.rot90(logarithm, turns))
    return burnt


def _burnt_top(logarithm: FloatArray) -> BoolArray:
    """Mark the burnt pixels along the upper side."""
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
    ends = ndimage.maximum_filter1d(ends + _CUT_PX + _FALL_PX + _MARGIN_PX, _ALONG_PX)
    return np.asarray(np.arange(height)[:, None] < ends)


def _expected_blue(calibration: Calibration, unexposed: FloatArray, red: FloatArray) -> FloatArray:
    """Return the density of exposed film in blue by its density in red."""
    table = np.log10(unexposed / calibration.pixels[np.argsort(calibration.doses)])
    return np.asarray(np.interp(red, np.maximum.accumulate(table[:, 0]), table[:, 2]))


def _resample(samples: FloatArray, image: FloatArray) -> FloatArray:
    """Interpolate samples to the pixels of an image."""
    places = np.mgrid[: image.shape[0], : image.shape[1]] / _SAMPLE_STEP_PX - 0.5
    return np.asarray(ndimage.map_coordinates(samples, places, order=1, mode="nearest"))
