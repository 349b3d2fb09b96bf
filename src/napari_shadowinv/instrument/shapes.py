"""Random changes of a beam, without a plane for each of their numbers: `Shapes`.

- a smooth field, whose correlation falls with distance as a Gaussian: `Shapes.of_length`
- differences of beams and sources, by a prior: `beam_shapes`; of the beams of several images:
  `shapes_between`
- smooth fields at places that are no grid: `random_waves`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import map_coordinates

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics.arrays import complete_block_means

VARIANCE = 0.999
"""Share of the variance of a smooth field that its shapes hold, where they are drawn."""

Around = tuple[tuple[int, int], tuple[int, int]]
"""Pixels by which shapes reach beyond an image: above, below, left and right."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """Relative changes of a beam by one standard deviation of each number.

    The first numbers change planes, the others products (a_i(y) b_j(x) - c) e(y, x).
    """

    key: str  # name of their cause
    planes: FloatArray  # (n, H, W)
    modes: tuple[FloatArray, FloatArray]  # the functions a (n, H) and b (m, W)
    places: IntArray  # (2, k), their numbers i and j for each shape
    means: FloatArray  # (k,), the constants c
    envelope: FloatArray | None = None  # (H, W), the factor e; None for 1
    is_common: bool = True  # to the beams of all images, or each has its own change

    @classmethod
    def of_planes(cls, key: str, planes: FloatArray, *, is_common: bool = True) -> Shapes:
        """Return planes alone."""
        modes = np.empty((0, planes.shape[1])), np.empty((0, planes.shape[2]))
        places, means = np.empty((2, 0), np.int64), np.empty(0)
        return cls(key, planes, modes, places, means, is_common=is_common)

    @classmethod
    def of_length(
        cls,
        key: str,
        length: float,
        weights: FloatArray | BoolArray,
        rms: float = 1.0,
        share: float = VARIANCE,
    ) -> Shapes:
        """Return a smooth field, whose correlation is a Gaussian with a standard deviation in px.

        By the `weights` (H, W) of the pixels, the weighted mean of each shape is 0, and the root of
        the expected weighted square of their sum is `rms`. The shapes hold a `share` of the
        variance.
        """
        along_y, along_x = (_line_modes(size, length, share) for size in weights.shape)
        shares = weights / weights.sum()
        means = along_y @ shares @ along_x.T
        squares = along_y**2 @ shares @ (along_x**2).T - means**2
        # Those along y and x are equal in a square but for rounding, which must not order them.
        order = np.argsort(-np.round(squares / squares.max(), 9), axis=None, kind="stable")
        held = np.cumsum(squares.ravel()[order]) / squares.sum()
        chosen = order[: int(np.searchsorted(held, share)) + 1]
        places = np.stack(np.unravel_index(chosen, squares.shape))
        size = rms * float(1 / np.sqrt(squares.ravel()[chosen].sum()))
        planes, modes = np.empty((0, *weights.shape)), (size * along_y, along_x)
        return cls(key, planes, modes, places, size * means.ravel()[chosen])

    def __len__(self) -> int:
        return len(self.planes) + len(self.means)

    def sum(self, numbers: FloatArray) -> FloatArray:
        """Return the change by numbers, shape (H, W)."""
        of_planes, of_modes = np.split(numbers, [len(self.planes)])
        along_y, along_x = self.modes
        strengths = np.zeros((len(along_y), len(along_x)))
        strengths[tuple(self.places)] = of_modes
        lines = np.einsum("nm,mx->nx", strengths, along_x)
        total = np.einsum("ny,nx->yx", along_y, lines) - np.einsum("k,k", self.means, of_modes)
        total = total if self.envelope is None else self.envelope * total
        if len(of_planes):  # a sum of none takes its time, too
            total += np.einsum("k,kyx->yx", of_planes, self.planes)
        return np.asarray(total)

    def pull(self, image: FloatArray) -> FloatArray:
        """Return the transpose of `sum` times an image."""
        of_planes = np.einsum("yx,kyx->k", image, self.planes)
        image = image if self.envelope is None else self.envelope * image
        of_modes = self._along(image, self.modes) - image.sum() * self.means
        return np.append(of_planes, of_modes)

    def squares(self, weights: FloatArray) -> FloatArray:
        """Return the weighted sum of the square of each number's change."""
        of_planes = np.einsum("yx,kyx->k", weights, self.planes**2)
        weights = weights if self.envelope is None else self.envelope**2 * weights
        along_y, along_x = self.modes
        squares = self._along(weights, (along_y**2, along_x**2))
        mixed = self._along(weights, self.modes)
        of_modes = squares - 2 * self.means * mixed + self.means**2 * weights.sum()
        return np.append(of_planes, of_modes)

    @property
    def mean_squares(self) -> FloatArray:
        """Mean square of the change by each number."""
        shape = self.planes.shape[1:]
        return self.squares(np.full(shape, 1 / np.prod(shape)))

    def cosines(self, lines: Sequence[FloatArray], at: Sequence[FloatArray]) -> FloatArray:
        """Return products of cosines along y and x with each smooth shape at places, (k, n, m)."""
        along_y, along_x = (
            np.array([line @ np.interp(places, np.arange(len(mode)), mode) for mode in modes])
            for line, places, modes in zip(lines, at, self.modes, strict=True)
        )
        rows, columns = self.places
        waves = along_y[rows][:, :, None] * along_x[columns][:, None, :]
        constant = np.multiply.outer(*(line.sum(axis=1) for line in lines))
        return np.asarray(waves - self.means[:, None, None] * constant)

    def pad(self, around: Around) -> Shapes:
        """Return shapes that go on beyond their pixels as at the edge; an envelope ends there."""
        along_y, along_x = (
            np.pad(functions, ((0, 0), beyond), mode="edge")
            for functions, beyond in zip(self.modes, around, strict=True)
        )
        planes = np.pad(self.planes, ((0, 0), *around), mode="edge")
        outer = None if self.envelope is None else np.pad(self.envelope, around)
        return replace(self, planes=planes, modes=(along_y, along_x), envelope=outer)

    def coarsen(self, factor: int) -> Shapes:
        """Return the same in larger pixels."""
        along_y, along_x = (
            functions.reshape(len(functions), functions.shape[1] // factor, factor).mean(axis=2)
            for functions in self.modes
        )
        planes, envelope = complete_block_means(self.planes, factor), self.envelope
        outer = None if envelope is None else complete_block_means(envelope, factor)
        return replace(self, planes=planes, modes=(along_y, along_x), envelope=outer)

    def _along(self, image: FloatArray, modes: tuple[FloatArray, FloatArray]) -> FloatArray:
        along_y, along_x = modes
        lines = np.einsum("ny,yx->nx", along_y, image)
        table = np.einsum("nx,mx->nm", lines, along_x)
        return np.asarray(table[tuple(self.places)])


def _line_modes(size: int, length: float, share: float, most_places: int = 256) -> FloatArray:
    """Return principal components of a random field along a line of pixels, (k, size)."""
    places = np.linspace(0, size - 1, min(size, most_places))
    squares = (places[:, None] - places) ** 2
    variances, vectors = np.linalg.eigh(np.exp(-squares / (2 * length**2)))
    variances, vectors = np.maximum(variances[::-1], 0), vectors[:, ::-1]
    held = np.cumsum(variances) / variances.sum()
    count = int(np.searchsorted(held, 1 - (1 - share) / 10)) + 1
    modes = (np.sqrt(variances) * vectors).T[:count]
    modes *= np.where(modes[:, :1] < 0, -1.0, 1.0)  # the algorithm leaves the signs open
    return np.array([np.interp(np.arange(size), places, mode) for mode in modes])


def beam_shapes(
    beam: BeamPrior, weights: FloatArray | BoolArray, share: float = VARIANCE
) -> Shapes:
    """Return the differences of beams and sources: the shapes of a prior, and a smooth rest.

    A smooth field has the `weights` (H, W) of pixels and the `share` of the variance.
    """
    rest = beam.rms if beam.components is None else beam.components.rest
    shapes = Shapes.of_length("beam", beam.length * min(weights.shape), weights, rest, share)
    if beam.components is None:
        return shapes
    places = (np.indices(weights.shape) + 0.5) / beam.components.block - 0.5
    patterns = [
        map_coordinates(pattern, places, order=1, mode="nearest")
        for pattern in beam.components.patterns
    ]
    return replace(shapes, planes=np.array(patterns).reshape(-1, *weights.shape))


def shapes_between(beam: BeamPrior, weights: FloatArray | BoolArray, share: float) -> Shapes:
    """Return the differences of each image's beam and the common one, as `beam_shapes`."""
    between = beam_shapes(BeamPrior(rms=beam.between, length=beam.length), weights, share)
    return replace(between, key="beam_between", is_common=False)


def random_waves(
    places: FloatArray, length: float, count: int, rng: np.random.Generator, waves: int = 16
) -> FloatArray:
    """Return smooth fields at places (n, 2), (count, n), of random waves, with an r.m.s. near 1."""
    fields = np.empty((count, len(places)))
    for field in fields:
        numbers = rng.normal(size=(2, waves)) / length
        phases = rng.uniform(0, 2 * np.pi, waves)
        field[:] = np.cos((places @ numbers + phases).astype(np.float32)).sum(axis=1)
    return np.asarray(fields * np.sqrt(2 / waves))
