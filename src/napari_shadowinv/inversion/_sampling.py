"""Inversion of noisy copies of an image, solved anew or by the linear response.

- solve the transport of each copy: `FullResampling`
- apply the linear response of the image's own transport: `LinearResampling`

The linear response of the solved transport to a small change of the image costs one linear system
with a matrix that all samples share; to solve the transport again costs a few, each with its own.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.linear_surface import WIDTH
from napari_shadowinv.geometry.overlaps import pixel_shares
from napari_shadowinv.inversion._linear_readout import LinearReadout
from napari_shadowinv.inversion.normalise import floored_by
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.factorised import FactorisedLaplacian
from napari_shadowinv.transport.linear import LaplacianSolver
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target, solve

__all__ = ["FullResampling", "LinearResampling", "Sample", "Scatter", "Seed"]

Seed = np.random.SeedSequence

_SAMPLE_SHARE = 0.2  # of the noise's flux errors that a sample may leave unsolved
_LOOSEST_TOLERANCE = 0.1
_MOST_FACTORISED = 300_000  # sites; their factors take 0.2 GB and two seconds
_LINEAR_TOLERANCE = 0.02
_ROWS = 64  # read out between two calls of `should_stop`


class Sample(NamedTuple):
    """One noisy image, inverted."""

    field: FloatArray  # potential and displacement, (3, H, W)
    solution: LevelSolution


@dataclass(frozen=True)
class FullResampling:
    """Solution of the transport of each sample on a plan's finest level, from start weights."""

    plan: SitePlan
    start: FloatArray
    draw: Callable[[np.random.Generator], FloatArray]
    options: InversionOptions

    def sample(self, seeds: list[Seed], report: Reporter) -> Sample:
        """Invert the noisy image of one seed, without caustics and other results."""
        (seed,) = seeds
        image = self.image(seed)
        plan = self.plan
        solution = solve(
            plan.levels, image, self.options, report, start=self.start, margin=plan.margin
        )[-1]
        potential, displacement = (
            plan.within(values) for values in read_out(solution, self.options)
        )
        return Sample(np.stack([potential - border_mean(potential), *displacement]), solution)

    def to_tolerance_of_noise(self, seed: Seed) -> FullResampling:
        """Loosen the tolerance to a share of the flux errors by noise."""
        # The remaining error is white, and moves the field far less than the flux that the solver
        # has moved: where a fifth remains in the worst cell, a sample's field is within 3 % of
        # its change, and the deviation of many within 0.2 %.
        level = self.plan.levels[-1]
        objective = TransportObjective(
            level.triangulation.copy(),
            level.mass,
            Density.from_image(self.image(seed)),
            threads=self.options.threads,
        )
        by_noise = objective.residual(objective.diagram(self.start))
        loosest = min(_SAMPLE_SHARE * by_noise, _LOOSEST_TOLERANCE)
        tolerance = max(loosest, self.options.tolerance)
        return replace(self, options=self.options.model_copy(update={"tolerance": tolerance}))

    def image(self, seed: Seed) -> FloatArray:
        """Draw a noisy image, as the transport sees it."""
        return self._floored(self.draw(np.random.default_rng(seed)))

    @cached_property
    def _floored(self) -> Callable[[FloatArray], FloatArray]:
        return floored_by(self.plan.source, self.options, self.plan.mask)


@dataclass(frozen=True)
class Scatter:
    """Sums over samples of changes of (potential, displacement), (3, H, W)."""

    # Changes are relative to the image's field, so sums of squares lose no digits.
    count: int
    sums: FloatArray
    squares: FloatArray

    @classmethod
    def of(cls, change: FloatArray) -> Scatter:
        return cls(1, change, change**2)

    def __add__(self, other: Scatter) -> Scatter:
        return Scatter(
            self.count + other.count, self.sums + other.sums, self.squares + other.squares
        )

    @property
    def mean(self) -> FloatArray:
        return self.sums / self.count

    @property
    def std(self) -> FloatArray:
        variance = (self.squares - self.sums * self.mean) / (self.count - 1)
        return np.sqrt(np.maximum(variance, 0))


class LinearResampling:
    """Linear response of an inversion to the changes of the image in its samples."""

    def __init__(self, samples: FullResampling, image: FloatArray, threads: int | None) -> None:
        self._samples, self._image = samples, image
        plan, level = samples.plan, samples.plan.levels[-1]
        objective = Target.of(image, plan.margin, samples.options).objective(level)
        diagram = objective.diagram(samples.start)
        self._shares = pixel_shares(diagram, level.shape, threads=threads)
        self._network = diagram.laplacian(), objective.ground(samples.start)
        self._factors = None
        if len(level.sites) <= _MOST_FACTORISED:
            with suppress(RuntimeError):  # the multigrid reports it if it fails as well
                self._factors = FactorisedLaplacian(*self._network)
        self._readout = LinearReadout(plan, level, threads)
        self._solvers = threading.local()  # each has vectors of its own

    def scatter(self, seeds: list[Seed], report: Reporter) -> Scatter:
        """Sum the changes by up to `WIDTH` noisy images, in order."""
        values = self._at_sites(seeds, report)
        sums, squares = np.zeros((2, 3, *self._image.shape))
        for start in range(0, len(self._image), _ROWS):
            report("samples", 0)
            self._readout.add(values, sums, squares, start, _ROWS)
        return Scatter(len(seeds), sums, squares)

    def changes(self, seeds: list[Seed]) -> FloatArray:
        """Return changes of potential and displacement by up to `WIDTH` images, (k, 3, H, W)."""
        values = self._at_sites(seeds, Reporter())
        return np.array([self._readout.field(values[..., k]) for k in range(len(seeds))])

    def _at_sites(self, seeds: list[Seed], report: Reporter) -> FloatArray:
        plan = self._samples.plan
        change = np.zeros(plan.levels[-1].shape)
        lacking = np.zeros((self._shares.shape[0], WIDTH))
        for sample, seed in enumerate(seeds):
            report("samples", 0)
            plan.within(change)[:] = self._image - self._samples.image(seed)
            lacking[:, sample] = self._shares @ change.ravel()
        return self._readout.at_sites(self._solve(lacking, report))

    def _solve(self, right: FloatArray, report: Reporter) -> FloatArray:
        if self._factors is not None:
            return self._factors.solve(right)
        if not hasattr(self._solvers, "multigrid"):
            self._solvers.multigrid = LaplacianSolver(*self._network)
        weights = np.zeros_like(right)
        for sample in np.flatnonzero(right.any(axis=0)):
            report("samples", 0)
            weights[:, sample], _, _ = self._solvers.multigrid.solve(
                right[:, sample].copy(), _LINEAR_TOLERANCE
            )
        return weights
