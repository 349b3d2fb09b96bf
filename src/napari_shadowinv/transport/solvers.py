"""Solution for the weights of all levels, coarse to fine.

- with the solver, tolerance and limits of the options: `solve`
- an answer of one level, with a smooth potential everywhere: `LevelSolution`
- the problem of one level: `Target`

References
----------
Paper, section III.A ("multi-stage approach"); Q. Mérigot, Computer Graphics Forum 30, 1583
(2011).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.density import Density, split_pixels
from napari_shadowinv.geometry.interpolation import CloughTocher, fit_gradients
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.transport.minimise import (
    OpenObjective,
    Solution,
    TransportObjective,
    blur_image,
    blur_to_density,
    descend,
    newton,
    sharpen,
)
from napari_shadowinv.transport.sites import RATIO, Levels, Margin, SiteLevel


@dataclass(frozen=True, eq=False, kw_only=True)
class LevelSolution(Solution):
    """A solution and where it moves the n sites of its level."""

    level: SiteLevel
    threads: int | None
    flux: FloatArray  # (n,): the image's flux in each cell
    # (n, 2), px: centroid of each cell in the image minus that of the same site's cell in the
    # source. (The paper, in lines 21–23 of its algorithm, subtracts the site, which is the same
    # after enough Lloyd steps; with the centroid an image that equals its source gives zero.)
    displacement: FloatArray

    @classmethod
    def of_level(
        cls, level: SiteLevel, objective: TransportObjective, solution: Solution
    ) -> LevelSolution:
        """Add flux and centroids of the cells to a solution of `objective`."""
        diagram = objective.diagram(solution.weights, with_moments=True)
        return cls(
            **vars(solution),
            level=level,
            threads=objective.threads,
            flux=diagram.masses,
            displacement=diagram.centroids - level.centroids,
        )

    def forget_surface(self) -> None:
        """Drop the surface, which is large; it is computed again on demand."""
        vars(self).pop("surface", None)

    @cached_property
    def surface(self) -> CloughTocher:
        """A C¹ surface through the potential at the sites (px²).

        In the optimum the image of site i lies at r_i - ½ ∇w, so half the weights are the
        normalised deflection potential at the sites, and minus the displacements of the cells'
        centroids (px) are, nearly, its gradients. No flux crosses the border of the image, so the
        potential is level across it, and its mirror image continues it smoothly.
        """
        mirrored = self.level.mirrored
        potential = 0.5 * self.weights
        gradient = fit_gradients(
            self.level.triangulation, potential, -self.displacement, threads=self.threads
        )
        return CloughTocher(
            mirrored.triangulation,
            potential[mirrored.origin],
            mirrored.sense * gradient[mirrored.origin],
            threads=self.threads,
        )


@dataclass(frozen=True)
class LevelLimits:
    """When a coarser level has done its work."""

    tolerance: float = 3e-2
    stalled: float = 0.1  # residual above which it counts as unsolved
    prepared: int = 20_000  # sites: levels up to this size are needed for almost any accuracy
    kept: int = 50_000  # sites: larger surfaces are computed again rather than kept


# From the solutions so far: the factor on the number of sites that would suffice.
Needed = Callable[[Sequence[LevelSolution]], float]


def solve(
    levels: Levels,
    target: Target,
    report: Reporter | None = None,
    *,
    start: FloatArray | None = None,
    needed: Needed | None = None,
    solved: Sequence[LevelSolution] = (),
    restarts: bool = True,
) -> list[LevelSolution]:
    """Solve on the coarsest level, carry the potential to the next, and so on.

    With a `start` (weights of the finest level that solve a similar image) it solves on the finest
    level alone, if that converges. After each coarser level, `needed` returns the factor on the
    number of sites that would suffice; at 1 or less the solution ends there. Levels that are
    already `solved` are not solved again. Returns one solution for each level that was tried. If a
    level stalls, the finest one is solved from zero weights, unless it `restarts` not. The last one
    counts.
    """
    if target.options.stages == "single":
        levels = levels[-1:]
    if start is not None:
        nearby = _solve_from(start, levels[-1], target, report)
        if nearby is not None:
            return [nearby]
    with levels.in_background(target.options.threads) as begin:
        return _solve_levels(levels, target, report, needed, solved, begin, restarts)


def _solve_levels(
    levels: Levels,
    target: Target,
    report: Reporter | None,
    needed: Needed | None,
    solved: Sequence[LevelSolution],
    begin: Callable[[Sequence[int]], None],
    restarts: bool,
    *,
    limits: LevelLimits = LevelLimits(),
) -> list[LevelSolution]:
    """Solve level after level; `begin` prepares the next ones in the background."""
    options = target.options
    by_newton = options.solver == "newton"
    solutions = list(solved)
    coarse = max(options.tolerance, limits.tolerance)
    fewest = len(solutions[-1].weights) if solutions else 0
    finer = [count for count in levels.counts if count > fewest]
    times = math.inf  # as many sites are needed as there are
    begin(finer[::-1] if needed is None else [count for count in finer if count <= limits.prepared])
    while finer:
        level = levels.at(finer.pop(0))
        finest = not finer
        # The level that is expected to be enough is solved as well as it has to be in the end.
        tolerance = options.tolerance if finest or times <= RATIO else coarse
        objective = target.objective(level)
        if not solutions and by_newton:
            solution = target.solve_blurred_first(level, tolerance, report)
        else:
            weights = None
            if solutions:
                weights = 2 * solutions[-1].surface(level.sites)
                if len(solutions[-1].weights) > limits.kept:
                    solutions[-1].forget_surface()
            solution = _solve_level(objective, weights, options, tolerance, report)
        solutions.append(LevelSolution.of_level(level, objective, solution))
        if by_newton and solution.residual > limits.stalled and len(levels) > 1:
            if not restarts:
                return solutions
            return [*solutions, _restart(levels[-1], target, solution if finest else None, report)]
        if needed is None or finest:
            continue
        times = needed(solutions)
        if times > RATIO:
            begin(finer[1:2])
        elif times <= 1:
            if solution.residual <= options.tolerance:
                return solutions
            final = newton(
                objective, solution.weights, options.tolerance, options.max_iterations, report
            )
            if final.converged:
                final = replace(final, iterations=solution.iterations + final.iterations)
                return [*solutions[:-1], LevelSolution.of_level(level, objective, final)]
    return solutions


def _restart(
    level: SiteLevel, target: Target, stalled: Solution | None, report: Reporter | None
) -> LevelSolution:
    """Solve the finest level from zero weights, because a coarser one stalled."""
    solution = target.solve_blurred_first(level, target.options.tolerance, report)
    if stalled is not None and stalled.residual < solution.residual:
        solution = replace(stalled, iterations=solution.iterations)
    return LevelSolution.of_level(level, target.objective(level), solution)


def _solve_from(
    start: FloatArray, level: SiteLevel, target: Target, report: Reporter | None
) -> LevelSolution | None:
    """Solve one level from similar weights; return None if that does not converge quickly.

    A few cells of a similar image that are not even do not keep steps short. Where they must be
    shorter than a tenth, or many, starting afresh is faster.
    """
    options = target.options
    objective = target.objective(level)
    if options.solver == "newton":
        threads = available_threads(options.threads)
        is_full = objective.triangulation.update(start, stop_when_hidden=True, threads=threads)
        solution = newton(
            objective,
            start,
            options.tolerance,
            min(10, options.max_iterations),
            report,
            shortest_step=0.1,
            fill=not is_full,
            even=3.0,
        )
    else:
        solution = _solve_level(objective, start, options, options.tolerance, report)
    return LevelSolution.of_level(level, objective, solution) if solution.converged else None


@dataclass(frozen=True)
class Target:
    """The image and its margin, in which the flux arrives."""

    density: Density  # image, positive; with the flux of the source unless there is a margin
    margin: Margin | None
    options: InversionOptions

    @classmethod
    def of(
        cls, image: FloatArray, options: InversionOptions, margin: Margin | None = None
    ) -> Target:
        return cls(Density.from_image(image, threads=options.threads), margin, options)

    @cached_property
    def resolved(self) -> Density:
        """The image with slopes inside its pixels."""
        return self.density.resolved(self.options.threads)

    def objective(self, level: SiteLevel) -> TransportObjective:
        """Pose the problem for the sites of a level."""
        return self._objective(level, self.resolved if level.is_of_pixels else self.density)

    def _objective(self, level: SiteLevel, density: Density) -> TransportObjective:
        threads = self.options.threads
        if self.margin is not None:
            decay_length = self.options.decay_length or self.margin.width
            return OpenObjective(level, density, self.margin, decay_length, threads=threads)
        triangulation = level.triangulation.copy()
        return TransportObjective(triangulation, level.mass, density, threads=threads)

    def blurred_objective(self, level: SiteLevel, blur: float, factor: int) -> TransportObjective:
        """Pose it for pixels split by a factor along each side, then blurred by `blur` of them."""
        pixels = split_pixels(self.density.image, factor)
        margin = self.margin and self.margin.split(factor)
        decay_length = self.options.decay_length and factor * self.options.decay_length
        options = self.options.model_copy(update={"decay_length": decay_length})
        if margin is None:
            target = Target(blur_to_density(pixels, blur, options.threads), margin, options)
        else:
            target = Target.of(blur_image(pixels, blur, options.threads), options, margin)
        return target._objective(level, target.density)

    def solve_blurred_first(
        self, level: SiteLevel, tolerance: float, report: Reporter | None
    ) -> Solution:
        """Solve a level from zero weights, by way of blurred images."""
        sharp, most = self.objective(level), self.options.max_iterations
        return sharpen(level, sharp, self.blurred_objective, tolerance, most, report)


def _solve_level(
    objective: TransportObjective,
    weights: FloatArray | None,
    options: InversionOptions,
    tolerance: float,
    report: Reporter | None,
) -> Solution:
    """Run the solver of the options on one level, from zero weights by default."""
    most = options.max_iterations
    if weights is None:
        weights = np.zeros(len(objective.mass))
    if options.solver == "newton":
        return newton(objective, weights, tolerance, most, report, fill=True)
    return descend(objective, weights, tolerance, most, report)
