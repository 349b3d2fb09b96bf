"""A source in register with its image: `align_source`.

The borders of both are compared, where an object displaces least. A shift that is left would be
taken for a field.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from napari_shadowinv._system.arrays import NORMAL_MAD, check_shape
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing.image_checks import ReferencePair, border_ring

_BLUR_PX = 1.5  # makes gradients of noisy images
_MAX_STEPS = 30
_STEP_TOLERANCE_PX = 1e-3
_OUTLIER_DEVIATIONS = 3.0  # an object may reach the border
_MAX_ERROR_PX = 0.5
_SIGNIFICANT_ERRORS = 2.0
_MIN_SHIFT_PX = 0.05  # interpolation would change more than it mends


class AlignedSource(NamedTuple):
    """A source in register with an image.

    Attributes
    ----------
    source : ndarray, shape (H, W)
        Interpolated with cubic splines; at the edges, the nearest pixels.
    shift : ndarray, shape (2,)
        By which it was moved, (y, x) in px.
    error : ndarray, shape (2,)
        Standard deviation of the shift in px, by the noise.
    """

    source: FloatArray
    shift: FloatArray
    error: FloatArray

    @property
    def is_significant(self) -> bool:
        """Whether the shift along an axis is above twice its error, and above 0.05 px."""
        limits = np.maximum(_SIGNIFICANT_ERRORS * self.error, _MIN_SHIFT_PX)
        return bool((np.abs(self.shift) > limits).any())


def align_source(
    image: FloatArray, source: FloatArray, mask: BoolArray | None = None
) -> AlignedSource:
    """Shift a source so that it fits an image at the borders, by least squares.

    Parameters
    ----------
    image, source : ndarray, shape (H, W)
        In any units; their brightness may differ.
    mask : ndarray of bool, shape (H, W), optional
        True at usable pixels.

    Returns
    -------
    AlignedSource

    Raises
    ------
    InputError
        If the shapes differ, or the borders determine the shift to no better than 0.5 px.
    """
    image, source = (np.asarray(plane, dtype=np.float64) for plane in (image, source))
    check_shape("the source", source.shape, image.shape, "the image")
    usable = np.ones(image.shape, dtype=bool) if mask is None else mask
    border = usable & border_ring(image.shape)
    fit = _fit_shift(image, source, border, ReferencePair(image, source, usable).shift or (0, 0))
    if fit is None:
        raise InputError(
            "image and source share too little structure at their borders to be aligned to within "
            f"{_MAX_ERROR_PX:g} px: align the camera by marks in both, or use an estimated source"
        )
    shift, error = fit
    moved = ndimage.shift(source, shift, order=3, mode="nearest")
    return AlignedSource(np.maximum(moved, 0.0), shift, error)


def _fit_shift(
    image: FloatArray, source: FloatArray, border: BoolArray, start: tuple[float, float]
) -> tuple[FloatArray, FloatArray] | None:
    """Return shift and error of a source by Gauss's and Newton's method, None if uncertain."""
    if border.sum() < 16:
        return None
    shot, beam = (
        ndimage.gaussian_filter(plane / plane[border].mean(), _BLUR_PX) for plane in (image, source)
    )
    shift = np.array(start, dtype=np.float64)
    for _ in range(_MAX_STEPS):
        moved = ndimage.shift(beam, shift, order=3, mode="nearest")
        slopes = np.gradient(moved)
        design = np.stack([-slopes[0][border], -slopes[1][border], moved[border]])
        misfit = (shot - moved)[border]
        noise = NORMAL_MAD * float(np.median(np.abs(misfit - np.median(misfit))))
        weights = (np.abs(misfit) <= _OUTLIER_DEVIATIONS * noise).astype(float)
        # Sums instead of products of matrices, whose threads would wait for each other.
        normal = np.array([[(a * b * weights).sum() for b in design] for a in design])
        if not np.linalg.cond(normal) < 1e12:
            return None
        step = np.linalg.solve(normal, [(a * misfit * weights).sum() for a in design])
        shift += step[:2]
        if np.abs(step[:2]).max() < _STEP_TOLERANCE_PX:
            break
    else:
        return None
    # The blur correlates the noise of as many pixels.
    variance = noise**2 * 4 * math.pi * _BLUR_PX**2
    error = np.sqrt(variance * np.diag(np.linalg.inv(normal))[:2])
    return (shift, error) if error.max() <= _MAX_ERROR_PX else None
