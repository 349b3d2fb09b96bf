"""The unknowns of a fit, and displacements known beforehand: `Unknowns`, `Fiducials`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from napari_shadowinv._typing import FloatArray

__all__ = ["Fiducials", "Unknowns"]


class Unknowns(NamedTuple):
    """The unknowns of a fit, or derivatives by them, or changes of them.

    `potentials` (M, …) are B-spline coefficients of the fields' potentials, `beam` (n, n) cosine
    coefficients of the beam's logarithm, `brightness` (L,) logarithms, `frames` (L, 6) as a
    `RayModel` takes them.
    """

    potentials: FloatArray
    beam: FloatArray
    brightness: FloatArray
    frames: FloatArray

    def flat(self) -> FloatArray:
        """Return all values as one array."""
        return np.concatenate([part.ravel() for part in self])

    def like(self, flat: FloatArray) -> Unknowns:
        """Return the same unknowns with the values of a flat array."""
        ends = [0, *accumulate(part.size for part in self)]
        parts = (flat[begin:end] for begin, end in pairwise(ends))
        return Unknowns(*(new.reshape(old.shape) for new, old in zip(parts, self, strict=True)))

    def only(self, numbers: Sequence[int]) -> Unknowns:
        """Return the unknowns of some of the images."""
        chosen = list(numbers)
        return self._replace(brightness=self.brightness[chosen], frames=self.frames[chosen])

    def with_those(self, numbers: Sequence[int], found: Unknowns) -> Unknowns:
        """Return the unknowns with those of some images replaced."""
        brightness, frames = self.brightness.copy(), self.frames.copy()
        brightness[list(numbers)], frames[list(numbers)] = found.brightness, found.frames
        return found._replace(brightness=brightness, frames=frames)

    def plus(self, other: Unknowns) -> Unknowns:
        """Return the sum of both."""
        return Unknowns(*(a + b for a, b in zip(self, other, strict=True)))

    def zeros(self) -> Unknowns:
        """Return as many zeros."""
        return Unknowns(*(np.zeros_like(part) for part in self))


class Fiducials(NamedTuple):
    """Points whose displacement in the first image is known: crossings of a mesh, say.

    `places` (n, 2) in px from the image's corner, `displacements` (n, 2) and their standard
    deviations `errors` (n,) in px.
    """

    places: FloatArray
    displacements: FloatArray
    errors: FloatArray
