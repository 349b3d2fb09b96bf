"""The unknowns of a fit, and their prior.

- all numbers that a fit determines: `Unknowns`; displacements known beforehand: `Fiducials`
- the prior of potentials, instrument, brightness and frames: `Prior`

The prior is quadratic; for the potentials it is

    ½ Σ_m (λ_m |∇⁴φ_m|² + κ_m |∇⁶φ_m|²) + ½ µ Σ_pad (|∇φ|² + φ²/ℓ²)
    + ½ Σ |d(x_k) - d_k|² / σ_k²

and that of all other numbers is a sum ½ Σ (θ / s)². Of a smooth object the data make λ small and
κ large, of one with kinks the other way round.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from scipy.fft import dctn, idctn

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.fitting._ray_kernels import add_ties, spline_tables
from napari_shadowinv.fitting.rays import RayModel, at_rest


class Unknowns(NamedTuple):
    """The unknowns of a fit, or derivatives by them, or changes of them."""

    potentials: FloatArray  # (M, …), B-spline coefficients of the fields' potentials
    common: FloatArray  # (n,), numbers of an `Imperfect` instrument and of its beam
    brightness: FloatArray  # (L,), logarithms
    frames: FloatArray  # (L, 6), as a `RayModel` takes them
    separate: FloatArray  # (L, n), numbers of the instrument and the beam in each image

    def flat(self) -> FloatArray:
        """Return all values as one array."""
        return np.concatenate([block.ravel() for block in self])

    def like(self, flat: FloatArray) -> Unknowns:
        """Return the same unknowns with the values of a flat array."""
        ends = [0, *accumulate(block.size for block in self)]
        parts = (flat[begin:end] for begin, end in pairwise(ends))
        return Unknowns(*(new.reshape(old.shape) for new, old in zip(parts, self, strict=True)))

    def plus(self, other: Unknowns, times: float = 1.0) -> Unknowns:
        """Return the sum with a multiple of another."""
        return Unknowns(*(a + times * b for a, b in zip(self, other, strict=True)))

    def zeros(self) -> Unknowns:
        """Return as many zeros."""
        return Unknowns(*map(np.zeros_like, self))


class Fiducials(NamedTuple):
    """Points whose displacement in the first image is known: crossings of a mesh, say."""

    places: FloatArray  # (n, 2), px from the image's corner
    displacements: FloatArray  # (n, 2), px
    errors: FloatArray  # (n,), standard deviations, px


POWERS = (4, 6)  # of the wave number squared: |∇⁴φ|² and |∇⁶φ|²

_NORMAL = np.array(1.0)  # 1 / s² of the numbers of an instrument


@dataclass(frozen=True, kw_only=True)
class PriorTerms:
    """How far unknowns are held, in pixels of one size."""

    smoothness: FloatArray  # (M, 2), λ and κ of each field
    tie: float = 30.0  # µ
    decay: float = np.inf  # length ℓ in px over which potentials fade in the pad
    fiducials: Fiducials | None = None
    bin: int = 1  # side of a pixel in recorded pixels
    shift_spread: float = 5.0  # standard deviation of an image's shift, px of the recorded image
    stretch_spread: float = 0.05  # of turns, magnifications and shears
    brightness_spread: float = 1.0  # of the logarithm of the brightness


@dataclass(frozen=True, kw_only=True)
class Prior(PriorTerms):
    """Gaussian prior of the unknowns."""

    rays: RayModel
    strengths: FloatArray  # (M,), displacement in the first image by each field's displacement

    def value_and_slope(self, unknowns: Unknowns) -> tuple[float, Unknowns]:
        """Return the sum of all terms, and its derivatives."""
        about_rest = unknowns._replace(frames=unknowns.frames - at_rest())
        slope = self.times(about_rest)
        value = sum(float(np.sum(a * b)) for a, b in zip(slope, about_rest, strict=True)) / 2
        if self.fiducials is None:
            return value, slope
        weights = 1 / self.fiducials.errors[:, None] ** 2
        goal = weights * self.fiducials.displacements
        displacements = self._displacements_there(unknowns.potentials)
        value += float(np.sum(goal * (self.fiducials.displacements / 2 - displacements)))
        self._add_there(slope.potentials, -goal)
        return value, slope

    def times(self, change: Unknowns) -> Unknowns:
        """Return the terms' Hessian times a change."""
        waves = dctn(change.potentials, axes=(1, 2), norm="ortho")
        waves *= self.roughness
        slope = idctn(waves, axes=(1, 2), norm="ortho")
        self.add_ties(change.potentials, slope)
        return Unknowns(slope, *map(np.multiply, self._weights, change[1:]))

    def add_ties(self, potentials: FloatArray, slope: FloatArray) -> None:
        """Add the Hessian of potentials, but for λ and κ, times their change."""
        add_ties(
            potentials, self._within, self.tie, self.tie * (self.rays.knot / self.decay) ** 2, slope
        )
        if self.fiducials is not None:
            weights = 1 / self.fiducials.errors[:, None] ** 2
            self._add_there(slope, weights * self._displacements_there(potentials))

    def flat_weights(self, unknowns: Unknowns) -> FloatArray:
        """Return 1 / s² of all values but the potentials, as one array."""
        pairs = zip(self._weights, unknowns[1:], strict=True)
        return np.concatenate([np.broadcast_to(w, block.shape).ravel() for w, block in pairs])

    def draw(self, like: Unknowns, rng: np.random.Generator) -> Unknowns:
        """Return a random slope whose covariance is the terms' Hessian."""
        shape, fields = self.rays.shape, range(len(self.smoothness))
        rough = [self.root_of_smoothness(m, rng.normal(size=shape)) for m in fields]
        potentials = np.stack(rough)
        root = np.sqrt(self.tie)
        inside = self._within
        within = inside[1:] & inside[:-1], inside[:, 1:] & inside[:, :-1]
        for axis, step_within in enumerate(within, 1):
            steps = rng.normal(size=(len(potentials), *step_within.shape)) * ~step_within
            potentials -= root * np.diff(steps, axis=axis, prepend=0, append=0)
        fading = np.where(inside, 0.0, (self.rays.knot / self.decay) ** 2)
        potentials += root * np.sqrt(fading) * rng.normal(size=potentials.shape)
        if self.fiducials is not None:
            errors = self.fiducials.errors[:, None]
            self._add_there(potentials, rng.normal(size=(len(errors), 2)) / errors)
        slopes = [
            np.sqrt(weights) * rng.normal(size=block.shape)
            for weights, block in zip(self._weights, like[1:], strict=True)
        ]
        return Unknowns(potentials, *slopes)

    def root_of_smoothness(self, field: int, values: FloatArray) -> FloatArray:
        """Return values per cosine times the root of the roughness penalty."""
        waves = np.sqrt(self.roughness[field]) * values
        return np.asarray(idctn(waves, norm="ortho"))

    @cached_property
    def of_rough(self) -> FloatArray:
        """Penalty of each field's cosines by λ and by κ, shape (M, 2, …)."""
        powers = np.stack([self.wave_numbers**power for power in POWERS])
        return self.rays.knot**2 * self.smoothness[:, :, None, None] * powers

    @cached_property
    def roughness(self) -> FloatArray:
        """Penalty of each field's cosines by both, shape (M, …)."""
        return np.asarray(self.of_rough.sum(axis=1))

    @cached_property
    def wave_numbers(self) -> FloatArray:
        """k² of each cosine of the coefficients, px⁻²."""
        waves = [np.pi * np.arange(n) / (n * self.rays.knot) for n in self.rays.shape]
        return np.asarray(waves[0][:, None] ** 2 + waves[1] ** 2)

    @cached_property
    def power_seen(self) -> FloatArray:
        """Power of each cosine of the coefficients that splines and pixels let through."""
        along_y, along_x = (
            np.sinc(np.arange(n) / (2 * n)) ** 8
            * np.sinc(np.arange(n) / (2 * n * self.rays.knot)) ** 2
            for n in self.rays.shape
        )
        return np.asarray(along_y[:, None] * along_x)

    def of_potentials(self) -> FloatArray:
        """Return the approximate penalty of each field's cosines, shape (M, …)."""
        squares = self.wave_numbers
        lowest = (np.pi / (max(self.rays.shape) * self.rays.knot)) ** 2 + (0.2 / self.decay) ** 2
        # A fifth of the coefficients or so lies in the pad.
        tied = self.tie * (0.2 * squares + lowest)
        return np.asarray(self.roughness + self.rays.knot**2 * tied)

    @cached_property
    def _weights(self) -> list[FloatArray]:
        """1 / s² of the values of each block but the potentials."""
        return [_NORMAL, 1 / np.array(self.brightness_spread) ** 2, self.frame_weights, _NORMAL]

    @cached_property
    def frame_weights(self) -> FloatArray:
        """1 / s² of a frame's numbers."""
        shift = self.shift_spread / self.bin
        # Where images lie well, their corners do, too.
        stretch = min(self.stretch_spread, shift / (max(self.rays.size) / 4))
        return 1 / np.array([shift, stretch, stretch, shift, stretch, stretch]) ** 2

    @cached_property
    def _within(self) -> BoolArray:
        lines = [
            np.abs(self.rays.knot * (np.arange(n) - 1.0) - self.rays.pad - side / 2) <= side / 2
            for n, side in zip(self.rays.shape, self.rays.size, strict=True)
        ]
        return np.asarray(lines[0][:, None] & lines[1])

    @cached_property
    def _splines_there(self) -> tuple[IntArray, IntArray, FloatArray]:
        """Rows and columns of coefficients around each fiducial; displacement by each, (y, x)."""
        assert self.fiducials is not None
        place = (self.fiducials.places + self.rays.pad) / self.rays.knot
        cell = np.floor(place).astype(np.int64)
        (value_y, slope_y), (value_x, slope_x) = (
            spline_tables(each, self.rays.knot) for each in (place - cell).T
        )
        each = np.arange(4)
        rows = (cell[:, :1] + each)[:, :, None]
        columns = (cell[:, 1:] + each)[:, None, :]
        along_y = np.einsum("in,jn->nij", slope_y, value_x)
        along_x = np.einsum("in,jn->nij", value_y, slope_x)
        return rows, columns, -np.stack([along_y, along_x], axis=1)

    def _displacements_there(self, potentials: FloatArray) -> FloatArray:
        rows, columns, tables = self._splines_there
        total = np.einsum("m,myx->yx", self.strengths, potentials)
        return np.asarray(np.einsum("ncij,nij->nc", tables, total[rows, columns]))

    def _add_there(self, potentials: FloatArray, pulls: FloatArray) -> None:
        rows, columns, tables = self._splines_there
        total = np.zeros(self.rays.shape)
        np.add.at(total, (rows, columns), np.einsum("ncij,nc->nij", tables, pulls))
        potentials += self.strengths[:, None, None] * total
