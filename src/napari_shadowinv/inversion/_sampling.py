"""Noisy copies of an image, each inverted: `Resolving` solves anew, `Responding` is linear.

The linear response of the solved transport to a small change of the image costs one linear system
with a matrix that all samples share; to solve the transport again costs a few, each with its own.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.inversion._drawing import Draw
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.inversion.readout import read_dual, read_out
from napari_shadowinv.inversion.response import site_gradients
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.linear import LaplacianSolver
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target, solve

__all__ = ["Resolving", "Responding", "Sample"]

_SAMPLE_SHARE = 0.2  # of the noise's flux errors that a sample may leave unsolved
_LOOSEST_TOLERANCE = 0.1
_LINEAR_TOLERANCE = 0.02


class Sample(NamedTuple):
    """One noisy image, inverted."""

    potential: FloatArray
    displacement: FloatArray
    solution: LevelSolution


@dataclass(frozen=True)
class Resolving:
    """Solves the transport of each sample on the finest level of a plan, from given weights."""

    plan: SitePlan
    start: FloatArray
    draw: Draw
    options: InversionOptions

    def sample(self, seed: np.random.SeedSequence, report: Reporter) -> Sample:
        """Invert one noisy image, without what the image alone needs (re-projection, caustics)."""
        image = self.image(seed)
        plan = self.plan
        solution = solve(
            plan.levels, image, self.options, report, start=self.start, margin=plan.margin
        )[-1]
        potential, displacement = (
            plan.within(values) for values in read_out(solution, self.options)
        )
        return Sample(potential - border_mean(potential), displacement, solution)

    def to_tolerance_of_noise(self, seed: np.random.SeedSequence) -> Resolving:
        """Ask of the solver no more than what matters beside the flux errors that noise makes."""
        # What it leaves unsolved is white, and moves the field far less than the flux that it
        # did move: where a fifth is left in the worst cell, a sample's field is within 3 % of
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

    def image(self, seed: np.random.SeedSequence) -> FloatArray:
        """Draw a noisy image, as the transport sees it."""
        noisy = self.draw(np.random.default_rng(seed))
        return prepare(noisy, self.plan.source, self.options, self.plan.mask).floored_image


class Responding:
    """Adds to an inversion its linear response to what each sample changes in the image."""

    def __init__(self, samples: Resolving, inversion: Inversion, image: FloatArray) -> None:
        self._samples, self._inversion, self._image = samples, inversion, image
        plan, options = samples.plan, samples.options
        level = plan.levels[-1]
        self._objective = Target.of(image, plan.margin, options).objective(level)
        self._laplacian = self._objective.diagram(samples.start).laplacian()
        self._ground = self._objective.ground(samples.start)
        self._solvers = threading.local()  # each has vectors of its own

    def sample(self, seed: np.random.SeedSequence, report: Reporter) -> Sample:
        """Invert one noisy image to first order."""
        report("samples", 0)
        samples, plan = self._samples, self._samples.plan
        level, threads = plan.levels[-1], samples.options.threads
        change = np.zeros(level.shape)
        plan.within(change)[:] = samples.image(seed) - self._image
        triangulation = self._objective.triangulation
        gained = PowerDiagram(triangulation, Density.from_image(change), threads=threads).masses
        weights, steps, residual = self._solver.solve(-gained, _LINEAR_TOLERANCE)
        solution = LevelSolution(
            weights,
            residual,
            steps,
            residual <= _LINEAR_TOLERANCE,
            level=level,
            threads=threads,
            flux=gained,
            displacement=-site_gradients(level.triangulation, 0.5 * weights),
        )
        potential, displacement = (
            plan.within(values) for values in read_dual(solution.surface, level.shape)
        )
        potential = self._inversion.potential + potential - border_mean(potential)
        return Sample(potential, self._inversion.displacement + displacement, solution)

    @property
    def _solver(self) -> LaplacianSolver:
        if not hasattr(self._solvers, "one"):
            threads = available_threads(self._samples.options.threads)
            self._solvers.one = LaplacianSolver(self._laplacian, self._ground, threads=threads)
        solver: LaplacianSolver = self._solvers.one
        return solver
