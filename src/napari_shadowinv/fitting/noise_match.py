"""Noise that is given or estimated, against the images: `match_noise`, `NoiseMatch`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.inversion.noise import measure_correlation


@dataclass(frozen=True)
class NoiseMatch:
    """Noise that is given or estimated, against that of the images' calm parts.

    Weights are made for the power of the noise on long waves, where it bends fields: correlated
    noise has more of it than white noise of the same pixels, smoothed counts less per pixel.
    """

    factors: FloatArray  # (L,), variance as used over that given or estimated from single pixels
    expected_chi2: FloatArray  # (L,), variance of a pixel over the one that is used
    correlation: float  # of the Gaussian that has blurred the noise, px; 0 for white noise
    is_estimated: bool

    def relative_chi2(self, chi2: FloatArray) -> FloatArray:
        """Return χ² over the expected one; residuals below the stated noise are no misfit."""
        relative = chi2 / self.expected_chi2
        if self.is_estimated:
            return relative
        return np.maximum(self.factors * chi2, np.minimum(relative, 1.0))

    def with_long_waves(self, more: FloatArray) -> NoiseMatch:
        """Return the match with noise that is seen on long waves alone.

        Its variance, (L,), is in pixels of white noise as noisy on long waves, as a share of the
        other's.
        """
        factors, expected = self.factors * (1 + more), self.expected_chi2 / (1 + more)
        return replace(self, factors=factors, expected_chi2=expected)

    @property
    def stated_times(self) -> float:
        """How many times the noise was stated too large; 1 if it was not."""
        return float(np.sqrt(1 / self.factors.min(initial=1.0)))


def match_noise(
    deviations: FloatArray,
    excess: FloatArray,
    brightness: FloatArray,
    used: BoolArray,
    width: float | None,
    *,
    is_estimated: bool,
    too_large: float = 2.5,
) -> NoiseMatch:
    """Compare the noise of images with its standard deviations, all in units of the beams.

    All have shape (L, H, W): `excess` is images less beams, `brightness` the images. `width` is the
    standard deviation of the blur that correlates the noise, px, if it is stated. A variance is too
    large beyond `too_large` times the variance of the calm parts. The deviations of noise that
    `is_estimated` are from differences between neighbouring pixels.
    """
    factors, expected = np.ones((2, len(excess)))
    correlation = 0.0
    for k, planes in enumerate(zip(excess, brightness, used, strict=True)):
        noise = measure_correlation(*planes, width)
        variance = float(np.median(deviations[k][used[k]] ** 2))
        if noise.is_bound:
            continue
        is_too_large = variance > too_large * noise.variance > 0
        if noise.blurred and noise.white < variance / 2 and (is_estimated or not is_too_large):
            factors[k] = noise.white_variance / variance
        elif is_too_large:
            factors[k] = min(noise.white_variance / variance, 1.0)
        else:
            continue
        expected[k] = noise.variance / (factors[k] * variance)
        correlation = max(correlation, noise.width)
    return NoiseMatch(factors, expected, correlation, is_estimated)
