"""Structure in the residuals of a fit: `Pattern`, `find_pattern`.

- tests of the residuals: `pattern_strength`, `correlation_length`, `blur_score`
- the noise of counts: `lack_of_noise`

χ² hides structure: a beam that is 2 % wrong adds 0.1 to χ² at 5 % noise, spread over the whole
image, and bends the field by tens of per cent. Smoothed, the same residual stands out of white
noise by many standard deviations. Residuals are images minus models over the standard deviation of
the noise in each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, laplace

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.fitting.measurements import FitData
from napari_shadowinv.fitting.search import (
    FineMinimum,
)


def pattern_strength(
    residual: FloatArray,
    used: BoolArray,
    correlation: float = 0.0,
    widths: Sequence[float] = (2.0, 4.0, 8.0),
) -> float:
    """Return how far a smoothed residual stands out of smoothed noise of its own r.m.s.

    It is the power of the smoothed residual, minus the expected one, in standard deviations of
    that, the largest for Gaussians of all `widths`, px. White noise gives about 0 ± 1, and less
    where the model has absorbed part of it.

    The residual (H, W) is image minus model over the standard deviation of the noise in each pixel,
    on the `used` pixels that were fitted. The noise was blurred by a Gaussian of `correlation` px;
    0 for white noise.
    """
    values = np.where(used, residual, 0.0)
    variance = float((values**2).sum() / max(used.sum(), 1))
    if variance < 1e-12:  # of the noise: rounding
        return 0.0
    inside = used.astype(np.float64)
    pixels = inside.sum()
    strengths = []
    for width in widths:
        smooth = gaussian_filter(values, width, mode="constant")
        power = float((smooth[used] ** 2).sum()) / variance
        # The kernel's square is a Gaussian, too, narrower by √2.
        density = 1 / (4 * np.pi * width**2)
        near = gaussian_filter(inside, width / np.sqrt(2), mode="constant")
        # Power of correlated noise after the Gaussian over the power of white noise.
        squares = width**2 / (width**2 + correlation**2)
        amplified = max(1.0, 4 * np.pi * correlation**2 * squares)
        expected = amplified * density * float(near[used].sum())
        deviation = amplified * np.sqrt(density * pixels)
        strengths.append((power - expected) / deviation)
    return float(max(strengths))


def correlation_length(
    residual: FloatArray, used: BoolArray, apart: tuple[int, int] = (1, 4), most: float = 0.85
) -> float:
    """Return the standard deviation in px of the Gaussian that has blurred white noise.

    Differences of pixels are compared over two distances `apart`, px. Medians are taken, so that
    bright lines that the model misses do not count. 0 if the noise is white: the ratio of the
    variances is at `most` 0.85 for other noise. White noise has 1 ± 0.03 on 64 × 64 px, noise
    blurred by 0.4 px 0.84. For residual and used pixels, (H, W), see `pattern_strength`.
    """
    near, far = (_squared_difference(residual, used, distance) for distance in apart)
    if not far > 0 or near / far > most:
        return 0.0
    # The correlation of blurred noise at a distance d is exp(-d² / 4c²).
    lengths = np.geomspace(0.2, 20.0, 400)
    of_near, of_far = (1 - np.exp(-(distance**2) / (4 * lengths**2)) for distance in apart)
    return float(np.interp(-near / far, -of_near / of_far, lengths))


def noise_amplification(correlation: float) -> float:
    """Return how many times larger correlated noise is than white noise on long waves.

    Noise of one r.m.s. that a Gaussian of c px has blurred has 4πc² times the power of white noise
    there; error bars of a smooth field grow by the root of it.
    """
    return max(1.0, float(np.sqrt(4 * np.pi) * correlation))


def blur_score(residuals: FloatArray, roots: FloatArray, made: FloatArray) -> float:
    """Return how much the residuals look like missing blur, in standard deviations of noise.

    Blur adds the Laplacian of an image to it. The fit has removed the part that fields can imitate
    from the residual, so noise gives less than 1. All have shape (L, H, W): `residuals` in standard
    deviations of the noise; `roots`, one over that deviation, zero where a pixel is not used; and
    `made`, the model.
    """
    change = roots * np.stack([laplace(image, mode="nearest") for image in made])
    size = float(np.sqrt((change**2).sum()))
    return float((residuals * change).sum()) / size if size > 0 else 0.0


def lack_of_noise(
    residuals: FloatArray, used: BoolArray, width: float = 2.0, mostly: float = 0.9
) -> tuple[float, float]:
    """Return by how much the variance of white residuals is below 1, and its standard deviation.

    Structure of more than a few pixels, of which a fit absorbs the noise, is left out; a Gaussian
    of `width` px with at least a share `mostly` on used pixels finds it. `residuals` (L, H, W) are
    image minus model over the standard deviation of the noise.
    """
    inside, around = used.astype(np.float64), (0, width, width)
    near = np.maximum(gaussian_filter(inside, around, mode="nearest"), 1e-9)
    values = np.where(used, residuals, 0.0)
    details = values - gaussian_filter(values, around, mode="nearest") / near
    # Shares of the variance that the Gaussian takes, and that it returns.
    share = 1 / (2 * np.pi * width**2)
    details = details[used & (near > mostly)] / np.sqrt(1 - 2 * share + share / 2)
    if not details.size:
        return 0.0, np.inf
    return 1 - float((details**2).mean()), float(np.sqrt(2 / details.size))


def _squared_difference(values: FloatArray, used: BoolArray, distance: int) -> float:
    """Squared median of the absolute difference of used pixels so far apart on one axis."""
    differences = []
    for moved, both in ((values, used), (values.T, used.T)):
        pair = both[distance:] & both[:-distance]
        differences.append(np.abs(moved[distance:] - moved[:-distance])[pair])
    joined = np.concatenate(differences)
    return float(np.median(joined)) ** 2 if joined.size else 0.0


@dataclass(frozen=True)
class Pattern:
    """Structure in the residuals of a fit.

    A model is wrong beyond a strength of `suspect`. Of fits with a right model it is -5 to 2, once
    4.2: a deep fold at 30 counts a pixel. With a beam that is 2 % off it is 31 and more, with
    absorption of 5 % 5.4 to 12.6.
    """

    strengths: FloatArray  # (L,), see `pattern_strength`
    correlation: float = 0.0  # px, see `correlation_length`
    chi2: float = 1.0  # the largest of all images
    blur_score: float = 0.0
    missing_counts: float = 0.0  # share by which noise is too small, as by a dark level of it
    counts_deviation: float = np.inf  # standard deviation of `missing_counts`
    cause: str = ""  # the likeliest, as a clause; "" if none wins or none was looked for
    tried: str = ""  # all causes that were looked for
    suspect: float = 5.0

    @property
    def largest(self) -> float:
        """The strongest pattern of all images."""
        return float(self.strengths.max())

    @property
    def is_certain(self) -> bool:
        """Whether the pattern shows that the model is wrong."""
        return self.largest > self.suspect

    def lacks_counts(self, deviations: float = 4.0) -> bool:
        """Return whether the noise is smaller than counts make it, by these deviations or more."""
        return self.missing_counts > deviations * self.counts_deviation


def find_pattern(data: FitData, refined: FineMinimum, least_counts: float = 5.0) -> Pattern:
    """Test the residuals of a fit for structure, and for the noise of counts.

    That is where the model has `least_counts` in a pixel. The noise is as correlated as it is
    stated, else as it is measured in the residuals and before.
    """
    height, width = data.size
    scene, seen = refined.scene, refined.seen
    roots = np.sqrt(scene.weights[:, :height, :width])
    models = seen[:, :height, :width]
    residuals = roots * (scene.images[:, :height, :width] - models)
    used = roots > 0
    correlation = data.instrument.noise_correlation
    if correlation is None:
        correlation = max(data.noise.correlation, *map(correlation_length, residuals, used))
    strengths = [
        pattern_strength(residual, use, correlation)
        for residual, use in zip(residuals, used, strict=True)
    ]
    missing, deviation = 0.0, np.inf
    # A fit of one image absorbs too much of its noise for the counts to be tested.
    if data.counted and not data.single and not correlation:
        # The weight of a pixel is one over the variance of its counts in units of the beam.
        expected = np.sqrt(data.noise.expected_chi2)[:, None, None]
        is_bright = roots * models > np.sqrt(least_counts)
        missing, deviation = lack_of_noise(residuals / expected, is_bright)
    return Pattern(
        strengths=np.array(strengths),
        correlation=correlation,
        chi2=float(data.noise.relative_chi2(scene.chi2(seen)).max()),
        blur_score=blur_score(residuals, roots, models),
        missing_counts=missing,
        counts_deviation=deviation,
    )
