"""Beams that were recorded for a fit, without the noise that rays would carry along."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.preprocessing.noise import NORMAL_MAD, estimated_noise


def smooth_references(
    beams: FloatArray,
    images: FloatArray,
    deviations: FloatArray,
    used: BoolArray,
    widths: Sequence[float] = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0),
    calm_share: float = 0.25,
    least_gain: float = 10.0,
    least_certain: float = 5.0,
) -> tuple[FloatArray, FloatArray]:
    """Blur recorded beams as much as their structure allows, which leaves less of their noise.

    A fit would use that noise: a beam that is moved by half a pixel is an average of pixels, with
    less noise, so that such displacements explain images best, true or not.

    Gaussians of the `widths` in px are tried. The one whose beams are nearest to the images is
    taken, as these have noise of their own. Only a `calm_share` of the pixels is compared: those
    where image and beam differ least on average. The sum of the squared normalised differences must
    fall by `least_gain`. An error of less than `least_certain` of the variance, times the root of
    the number of pixels, is chance.

    All have shape (L, H, W); the deviations are about as large as the images' noise. Returns the
    blurred beams, and the standard deviation of their errors beyond differences of neighbouring
    pixels of image and blurred beam, (L,), in units of the deviations; 0 where a beam was not
    blurred.
    """
    if not np.ptp(beams, axis=(1, 2)).any():
        return beams, np.zeros(len(beams))
    inside = used.any(axis=0).astype(np.float64)
    excess = (images - beams) / deviations
    contrast = _surroundings(_surroundings(excess, used) ** 2, used)
    levels = [
        np.quantile(plane[use], calm_share) for plane, use in zip(contrast, used, strict=True)
    ]
    calm = used & (contrast <= np.array(levels)[:, None, None])
    best, least = None, float((excess[calm] ** 2).sum()) - least_gain
    for width in widths:
        around = (0, width, width)
        reach = np.maximum(gaussian_filter(inside, width, mode="nearest"), 1e-9)
        blurred = gaussian_filter(beams * inside, around, mode="nearest") / reach
        trial = np.where(inside > 0, blurred, beams)
        squares = float((((images - trial) / deviations)[calm] ** 2).sum())
        if squares < least:
            best, least = trial, squares
    if best is None:
        return beams, np.zeros(len(beams))
    excess = (images - best) / deviations
    details = excess - _surroundings(excess, used)
    remaining = np.array(
        [
            (NORMAL_MAD * np.median(np.abs(plane[where]))) ** 2 - estimated_noise(whole, use) ** 2
            for plane, where, whole, use in zip(details, calm, excess, used, strict=True)
        ]
    )
    is_certain = remaining > least_certain / np.sqrt(calm.sum(axis=(1, 2)))
    return best, np.sqrt(np.where(is_certain, remaining, 0.0))


def _surroundings(planes: FloatArray, used: BoolArray, width: float = 4.0) -> FloatArray:
    """Means around each pixel, over more than noise is correlated."""
    return np.asarray(gaussian_filter(np.where(used, planes, 0.0), (0, width, width)))
