"""Structure in the residuals of a fit: `Pattern`, `find_pattern`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.fitting.whiteness import (
    blur_score,
    correlation_length,
    lack_of_noise,
    pattern_strength,
)

__all__ = ["SUSPECT_PATTERN", "Pattern", "find_pattern"]

SUSPECT_PATTERN = 5.0
"""Standard deviations of a smoothed residual beyond which the model is wrong."""
# Of fits with a right model it is -5 to 2, once 4.2: a deep fold at 30 counts a pixel. With a beam
# that is 2 % off it is 31 and more, with absorption of 5 % 5.4 to 12.6.
_MIN_COUNTS = 5.0  # a pixel
_LACKING = 4.0  # standard deviations


@dataclass(frozen=True)
class Pattern:
    """Structure in the residuals of a fit.

    Attributes
    ----------
    strengths : ndarray, shape (L,)
        Of each image, in standard deviations; see `pattern_strength`.
    correlation : float
        Standard deviation in px of the Gaussian that has blurred the noise; 0 for white noise.
    chi2 : float
        The largest of all images.
    blur_score : float
        See `whiteness.blur_score`.
    missing_counts : float
        Share by which the noise is smaller than that of the counts, as a dark level of that share
        makes it.
    counts_deviation : float
        Standard deviation of `missing_counts`.
    cause : str
        The likeliest cause, as a clause; "" if none is likely or none was looked for.
    """

    strengths: FloatArray
    correlation: float = 0.0
    chi2: float = 1.0
    blur_score: float = 0.0
    missing_counts: float = 0.0
    counts_deviation: float = np.inf
    cause: str = ""

    @property
    def largest(self) -> float:
        """The strongest pattern of all images."""
        return float(self.strengths.max())

    @property
    def is_certain(self) -> bool:
        """Whether the pattern shows that the model is wrong."""
        return self.largest > SUSPECT_PATTERN

    @property
    def lacks_counts(self) -> bool:
        """Whether the noise is certainly smaller than that of the counts."""
        return self.missing_counts > _LACKING * self.counts_deviation


def find_pattern(
    scene: Scene, unknowns: Unknowns, size: tuple[int, int], *, is_counted: bool = False
) -> Pattern:
    """Test the residuals of all images, the first `size` pixels of the scene, for structure.

    Of images that `is_counted` calls counts, the noise is tested, too.
    """
    height, width = size
    counts = scene.ray_counts(unknowns)
    roots = np.sqrt(scene.weights[:, :height, :width])
    models = scene.model(unknowns, counts)[:, :height, :width]
    residuals = roots * (scene.images[:, :height, :width] - models)
    used = roots > 0
    correlation = max(map(correlation_length, residuals, used))
    strengths = [
        pattern_strength(residual, use, correlation)
        for residual, use in zip(residuals, used, strict=True)
    ]
    missing, deviation = 0.0, np.inf
    if is_counted and not correlation:
        # The weight of a pixel is one over the variance of its counts in units of the beam.
        missing, deviation = lack_of_noise(residuals, roots * models > np.sqrt(_MIN_COUNTS))
    return Pattern(
        strengths=np.array(strengths),
        correlation=correlation,
        chi2=float(scene.chi2(unknowns, counts).max()),
        blur_score=blur_score(residuals, roots, models),
        missing_counts=missing,
        counts_deviation=deviation,
    )
