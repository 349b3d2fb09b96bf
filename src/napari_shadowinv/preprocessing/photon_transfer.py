"""An offset that was left in an image, from its noise: `dark_level`.

The variance of counts is proportional to the signal, so it vanishes where the signal does (photon
transfer). Noise of reading moves that point below the offset, never above. Noise in proportion to
the signal, as from uneven pixels, moves it above; only deep shadows distinguish it from an offset.
A recorded source has the same uneven pixels as the image, so their common pattern limits such
noise, and shadows need not be deep.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import nnls

from napari_shadowinv._system.arrays import order_by_value
from napari_shadowinv._typing import BoolArray, FloatArray

__all__ = ["dark_level"]

_NORMAL_MAD = 1.4826
_SAMPLES = 120_000
_BINS = 20
_BRIGHTEST_LEFT_OUT = 0.05  # share of the pixels: bright lines are not smooth
_CLIPPED_AT, _CLIPPED_VARIANCE = 3.0, 0.9733  # standard deviations; variance of a clipped normal
_MIN_PIXELS = 4000
_INDEPENDENT = 1 / 3  # of the differences, which share pixels
_WIDE_RANGE, _MIN_RANGE = 2.0, 1.3  # brightest over dimmest bin
_MIN_DARK = 0.05  # of the mean
# Difference of χ² without and with an offset, over χ² per degree of freedom: of one image, of
# image and source, of either if the range is narrow, and if any noise in proportion to the signal
# is allowed.
_MIN_GAIN, _MIN_SHARED_GAIN, _MIN_GAIN_NARROW, _MIN_GAIN_FREE = 8.0, 11.0, 40.0, 3.0
_MAX_CHI2 = 3.0  # per degree of freedom
_PATTERN_DEVIATIONS = 2.0


def dark_level(
    image: FloatArray, mask: BoolArray | None = None, source: FloatArray | None = None
) -> float:
    """Estimate an offset that was left in an image, as a share of its mean, from its noise.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        In any unit.
    mask : ndarray of bool, shape (H, W), optional
        True at usable pixels.
    source : ndarray, shape (H, W), optional
        The recorded beam, in the same unit. It has an offset of its own, or shares the image's.

    Returns
    -------
    float
        0 unless the noise cannot be explained without an offset, by any sum of a constant
        variance, one in proportion to the signal, and one to its square.
    """
    planes = [_NoisyPlane(plane, mask) for plane in (image, source) if plane is not None]
    if any(plane.brightness.size < _MIN_PIXELS for plane in planes):
        return 0.0
    mean = float(planes[0].brightness.mean())
    if not mean > 0:
        return 0.0
    offsets = [_offset(plane.bins / mean, math.inf, _MIN_GAIN) for plane in planes]
    if len(planes) > 1:
        both = np.concatenate([plane.bins for plane in planes], axis=1) / mean
        offsets.append(_offset(both, _common_pattern(*planes), _MIN_SHARED_GAIN))
    return max(offsets)


@dataclass(frozen=True, eq=False)
class _NoisyPlane:
    """An image with a measure of its noise at each pixel."""

    image: FloatArray
    mask: BoolArray | None

    @cached_property
    def _local(self) -> tuple[FloatArray, FloatArray]:
        """Means of 3 × 3 usable pixels, and differences in which all but noise cancels."""
        image, mask = self.image, self.mask
        rows = max(1, image.size // _SAMPLES)  # of long images, lines far apart
        starts = np.arange(0, image.shape[0] - 2, rows)
        above, middle, below = (image[starts + shift] for shift in range(3))
        column_sums, bends = above + middle + below, above - 2 * middle + below
        means = (column_sums[:, 2:] + column_sums[:, 1:-1] + column_sums[:, :-2]) / 9
        differences = (bends[:, 2:] - 2 * bends[:, 1:-1] + bends[:, :-2]) / 6
        if mask is None or mask.all():
            return means.ravel(), differences.ravel()
        inside = np.asarray(sliding_window_view(mask, (3, 3)).all(axis=(2, 3)))[starts]
        return means[inside], differences[inside]

    @property
    def brightness(self) -> FloatArray:
        """Mean around each pixel."""
        return self._local[0]

    @cached_property
    def bins(self) -> FloatArray:
        """Brightness, noise and its uncertainty by brightness, shape (3, bins).

        The noise is a standard deviation; its uncertainty is the variance's, divided by the noise.
        """
        brightness, differences = self._local
        order = order_by_value(brightness)
        order = order[: int((1 - _BRIGHTEST_LEFT_OUT) * order.size)]
        parts = np.array_split(order, _BINS)
        levels = np.array([brightness[part].mean() for part in parts])
        noise = np.sqrt([_clipped_variance(differences[part]) for part in parts])
        counts = np.array([len(part) for part in parts]) * _INDEPENDENT
        return np.array([levels, noise, noise / np.sqrt(counts)])

    @cached_property
    def relative(self) -> FloatArray:
        """Differences over the brightness, clipped."""
        brightness, differences = self._local
        values = differences / np.maximum(brightness, _MIN_DARK * abs(float(brightness.mean())))
        limit = _CLIPPED_AT * _NORMAL_MAD * float(np.median(np.abs(values)))
        return np.clip(values, -limit, limit)


def _clipped_variance(differences: FloatArray) -> float:
    sizes = np.abs(differences)
    limit = _CLIPPED_AT * _NORMAL_MAD * float(np.median(sizes))
    return float((sizes[sizes <= limit] ** 2).mean()) / _CLIPPED_VARIANCE


def _common_pattern(first: _NoisyPlane, second: _NoisyPlane) -> float:
    """Most relative variance that two images may have in common, as by uneven pixels."""
    product = first.relative * second.relative
    error = float(product.std()) / math.sqrt(_INDEPENDENT * len(product))
    return max(float(product.mean()), 0.0) + _PATTERN_DEVIATIONS * error


def _offset(bins: FloatArray, max_pattern: float, min_gain: float) -> float:
    """Return the brightness where the noise vanishes; 0 if zero is as likely.

    `max_pattern` is the largest variance in proportion to the square of the brightness.
    """
    levels, noise, uncertainty = bins
    lowest, highest = float(levels.min()), float(levels.max())
    if not (lowest > _MIN_DARK and highest >= _MIN_RANGE * lowest and (noise > 0).all()):
        return 0.0
    variances, weights = noise**2, 1 / (noise * uncertainty)
    powers = np.stack([np.ones_like(levels), levels, levels**2], axis=1) * weights[:, None]
    weighted = variances * weights
    terms, freely = nnls(powers, weighted)
    distance = freely
    if terms[2] > max_pattern:
        distance = nnls(powers[:, :2], weighted - max_pattern * powers[:, 2])[1]
    # Weighted least squares of v = g (m - D).
    line = powers[:, [1, 0]] * [1.0, -1.0]
    (gain, offset), *_ = np.linalg.lstsq(line, weighted, rcond=None)
    if not gain > 0:
        return 0.0
    with_offset = float(((gain * line[:, 0] + offset * line[:, 1] - weighted) ** 2).sum())
    dark = float(offset / gain)
    chi2 = max(1.0, with_offset / (len(levels) - 2))
    least = (min_gain if highest > _WIDE_RANGE * lowest else _MIN_GAIN_NARROW) * chi2
    # Noise in proportion to the signal that differs between shots, as of speckle, has no line.
    explained = chi2 < _MAX_CHI2 and freely**2 - with_offset > _MIN_GAIN_FREE * chi2
    explained &= distance**2 - with_offset > least
    return dark if explained and dark > _MIN_DARK else 0.0
