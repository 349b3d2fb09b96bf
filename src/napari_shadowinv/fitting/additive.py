"""Unknown light that adds to an image, such as a background: `AdditiveBlock`, `additive_blocks`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Self

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.options import FitOptions

__all__ = ["ADDITIVE", "AdditiveBlock", "additive_blocks"]


class AdditiveBlock(ABC):
    """Unknown coefficients of each image, to which its light is proportional.

    A fit finds the coefficients of each image together with all other unknowns, and reports
    them with their standard deviations. They start at zero, where their Gaussian prior has its
    mean, and are the same in pixels of any size. Image k is exp(γ_k) times the light of the rays
    plus this light, in units of the beam.
    """

    title: ClassVar[str]
    """Name in the result."""

    @classmethod
    @abstractmethod
    def from_options(cls, options: FitOptions) -> Self | None:
        """Return the block that the options ask for; None if its light is known to be zero."""

    @abstractmethod
    def spreads(self) -> FloatArray:
        """Return the standard deviation of each coefficient before the fit, shape (n,)."""

    @abstractmethod
    def patterns(self, size: tuple[int, int]) -> FloatArray:
        """Return the light of each coefficient of 1, in beams, shape (n, H, W)."""

    def image(self, coefficients: FloatArray, size: tuple[int, int]) -> FloatArray:
        """Return the light of coefficients, shape (H, W)."""
        return np.asarray(np.einsum("n,nyx->yx", coefficients, self.patterns(size)))

    def pull(self, image: FloatArray) -> FloatArray:
        """Return the transpose of `image` times an image, shape (n,)."""
        size = image.shape[0], image.shape[1]
        return np.asarray(np.einsum("yx,nyx->n", image, self.patterns(size)))

    def prior_weights(self) -> FloatArray:
        """Return 1 / s² of each coefficient."""
        return np.asarray(1 / np.asarray(self.spreads()) ** 2)

    def scales(self, weights: FloatArray) -> FloatArray:
        """Return approximate standard deviations by the fit, (L, n), for weights 1 / σ²."""
        size = weights.shape[1], weights.shape[2]
        curvature = np.einsum("lyx,nyx->ln", weights, self.patterns(size) ** 2)
        return np.asarray(1 / np.sqrt(curvature + self.prior_weights()))


ADDITIVE: Sequence[type[AdditiveBlock]] = ()


def additive_blocks(options: FitOptions) -> tuple[AdditiveBlock, ...]:
    """Return the blocks of `ADDITIVE` that the options ask for."""
    blocks = (kind.from_options(options) for kind in ADDITIVE)
    return tuple(block for block in blocks if block is not None)
