"""The unknowns of a fit, and displacements known beforehand: `Unknowns`, `Fiducials`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from napari_shadowinv._typing import FloatArray

__all__ = ["Fiducials", "Unknowns"]


_COMMON = 2  # blocks that the images share; the others have a row for each image


class Unknowns(NamedTuple):
    """The unknowns of a fit, or derivatives by them, or changes of them.

    `potentials` (M, …) are B-spline coefficients of the fields' potentials, `beam` (n, n) cosine
    coefficients of the beam's logarithm, `brightness` (L,) logarithms, `frames` (L, 6) as a
    `RayModel` takes them, `added` the coefficients (L, …) of each `AdditiveBlock`.
    """

    potentials: FloatArray
    beam: FloatArray
    brightness: FloatArray
    frames: FloatArray
    added: tuple[FloatArray, ...] = ()

    @property
    def blocks(self) -> tuple[FloatArray, ...]:
        """All arrays."""
        return self.potentials, self.beam, self.brightness, self.frames, *self.added

    @classmethod
    def from_blocks(cls, blocks: Iterable[FloatArray]) -> Unknowns:
        """Return unknowns with the arrays of `blocks`."""
        potentials, beam, brightness, frames, *added = blocks
        return cls(potentials, beam, brightness, frames, tuple(added))

    def flat(self) -> FloatArray:
        """Return all values as one array."""
        return np.concatenate([block.ravel() for block in self.blocks])

    def like(self, flat: FloatArray) -> Unknowns:
        """Return the same unknowns with the values of a flat array."""
        blocks = self.blocks
        ends = [0, *accumulate(block.size for block in blocks)]
        parts = (flat[begin:end] for begin, end in pairwise(ends))
        return self.from_blocks(
            new.reshape(old.shape) for new, old in zip(parts, blocks, strict=True)
        )

    def only(self, numbers: Sequence[int]) -> Unknowns:
        """Return the unknowns of some of the images."""
        chosen = list(numbers)
        return self.from_blocks(
            [self.potentials, self.beam, *(block[chosen] for block in self.blocks[_COMMON:])]
        )

    def with_those(self, numbers: Sequence[int], found: Unknowns) -> Unknowns:
        """Return the unknowns with those of some images replaced."""
        blocks = [block.copy() for block in self.blocks[_COMMON:]]
        for block, new in zip(blocks, found.blocks[_COMMON:], strict=True):
            block[list(numbers)] = new
        return self.from_blocks([found.potentials, found.beam, *blocks])

    def plus(self, other: Unknowns) -> Unknowns:
        """Return the sum of both."""
        pairs = zip(self.blocks, other.blocks, strict=True)
        return self.from_blocks(first + second for first, second in pairs)

    def zeros(self) -> Unknowns:
        """Return as many zeros."""
        return self.from_blocks(np.zeros_like(block) for block in self.blocks)


class Fiducials(NamedTuple):
    """Points whose displacement in the first image is known: crossings of a mesh, say.

    `places` (n, 2) in px from the image's corner, `displacements` (n, 2) and their standard
    deviations `errors` (n,) in px.
    """

    places: FloatArray
    displacements: FloatArray
    errors: FloatArray
