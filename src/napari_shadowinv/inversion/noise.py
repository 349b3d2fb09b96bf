"""The noise of an image, from differences between neighbouring pixels: `ImageNoise`.

Structures that the beam's path makes are smooth over a few pixels, noise is not: in
(a - b - c + d) / 2 over four neighbours a smooth image cancels, and white noise keeps its
variance. Noise that a filter has correlated is smaller there than it is.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls

from napari_shadowinv._typing import FloatArray

if TYPE_CHECKING:
    from napari_shadowinv.inversion.normalise import Prepared
    from napari_shadowinv.options import InversionOptions

__all__ = ["ImageNoise"]

_CLIPPED_AT = 4.0  # in standard deviations of normal noise
_NORMAL_MAD = 1.4826
_DEVIATIONS = 5.0
_BINS, _SAMPLES = 24, 20_000  # of brightness, and the pixels that are looked at


class ImageNoise:
    """The noise of an image, and of its source, as shares of the source's mean.

    Attributes
    ----------
    largest, typical : float
        Standard deviation with hot pixels and the finest structure, and without.
    """

    def __init__(self, prepared: Prepared, options: InversionOptions | None = None) -> None:
        image, mask = prepared.image, prepared.mask  # in units of `prepared.unit`
        self.shape = mask.shape[0], mask.shape[1]
        mean = prepared.source[mask].mean()
        excess = (image - prepared.source) / mean
        finest = (excess[1:, 1:] - excess[1:, :-1] - excess[:-1, 1:] + excess[:-1, :-1]) / 2
        used = mask[1:, 1:] & mask[1:, :-1] & mask[:-1, 1:] & mask[:-1, :-1]
        differences = np.abs(finest[used]) if used.any() else np.zeros(1)
        self.largest = _rms(differences)
        self.typical = _clipped(differences)
        bright = (image[1:, 1:] + image[1:, :-1] + image[:-1, 1:] + image[:-1, :-1]) / (4 * mean)
        # The source's mean, in units of the recorded image.
        quantum = prepared.flux_scale * prepared.unit * mean
        # Of the variance: what is constant, in proportion to the brightness, and to its square.
        self._terms = np.zeros(3)
        if options is not None and options.noise_level is not None:
            self._terms[0] = (options.noise_level / quantum) ** 2
        elif options is not None and options.quantum is not None:
            self._terms[1] = options.quantum / quantum
        elif used.any():
            self._terms = _terms(bright[used], differences)

    def variance(self, brightness: FloatArray) -> FloatArray:
        """Return the variance of pixels that are so bright, in units of the source's mean."""
        constant, linear, square = self._terms
        return np.asarray(constant + brightness * (linear + square * brightness))

    def displacements(self, level: float) -> tuple[float, float]:
        """R.m.s. displacement of so much noise, px, and the most that chance leaves likely."""
        mean, deviation = _response(self.shape)
        return level * math.sqrt(mean), level * math.sqrt(mean + _DEVIATIONS * deviation)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _clipped(differences: FloatArray) -> float:
    """Standard deviation without what noise does not explain."""
    limit = _CLIPPED_AT * _NORMAL_MAD * float(np.median(differences))
    return _rms(np.minimum(differences, limit)) if limit > 0 else _rms(differences)


def _terms(bright: FloatArray, differences: FloatArray) -> FloatArray:
    """Fit what detectors have: noise of reading, of counting, and of uneven response."""
    step = -(-len(bright) // _SAMPLES)
    bright, differences = bright[::step], differences[::step]
    order = np.argsort(bright, kind="stable")
    parts = np.array_split(order, min(_BINS, max(1, len(order) // 20)))
    found = [(float(bright[part].mean()), _clipped(differences[part]) ** 2) for part in parts]
    places, variances = np.array(found).T
    if not variances.any():
        return np.zeros(3)
    # Relative deviations count: of bins on bright lines, whose structure looks like noise, little.
    weights = 1 / np.maximum(variances, 1e-6 * variances.max())
    powers = np.stack([np.ones_like(places), places, places**2], axis=1)
    return np.asarray(nnls(weights[:, None] * powers, weights * variances)[0])


@lru_cache(maxsize=8)
def _response(shape: tuple[int, int]) -> tuple[float, float]:
    """Mean and standard deviation of the mean square displacement by white noise of 1, px²."""
    wave_y, wave_x = (np.pi * np.arange(length) / length for length in shape)
    square = wave_y[:, None] ** 2 + wave_x**2
    square[0, 0] = np.inf
    power = 1 / square
    return float(power.mean()), float(np.sqrt(2 * (power**2).sum()) / power.size)
