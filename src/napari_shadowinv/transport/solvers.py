"""Finding the weights of all levels, coarse to fine.

- with the solver, tolerance and limits that the options name: `solve`

References
----------
Paper, section III.A ("multi-stage approach"); Q. Mérigot, Computer Graphics Forum 30, 1583
(2011).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from napari_shadowinv.geometry.density import Density
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.progress import Reporter
from napari_shadowinv.transport.descent import lbfgs, quasi_newton
from napari_shadowinv.transport.newton import newton, with_full_cells
from napari_shadowinv.transport.objective import Solution, TransportObjective
from napari_shadowinv.transport.potential import potential_surface
from napari_shadowinv.transport.sites import Level

__all__ = ["LevelSolution", "solve"]

Array = NDArray[np.float64]

_COARSE_TOLERANCE = 3e-2
_BLURS = (4.0, 2.0, 1.0, 0.5)
_WARM_STEPS = 10
_SHORTEST_WARM_STEP = 0.1  # where steps must be shorter, starting afresh is faster


@dataclass(frozen=True, kw_only=True)
class LevelSolution(Solution):
    """A solution and where it moves the sites of its level.

    Attributes
    ----------
    displacement : ndarray, shape (n, 2)
        Centroid of each cell in the image minus that of the same site's cell in the
        source, px. (The paper subtracts the site, which is the same after enough Lloyd
        steps; with the centroid an image that equals its source gives exactly zero.)

    References
    ----------
    Paper, lines 21–23 of its algorithm.
    """

    displacement: Array

    @classmethod
    def of_level(
        cls, level: Level, objective: TransportObjective, solution: Solution
    ) -> LevelSolution:
        """Add the displacement of the sites to a solution that `objective` has arrived at."""
        diagram = objective.diagram(solution.weights, with_moments=True)
        return cls(**vars(solution), displacement=diagram.centroids - level.centroids)


def solve(
    levels: tuple[Level, ...],
    image: Array,
    options: InversionOptions,
    report: Reporter | None = None,
    *,
    start: Array | None = None,
) -> list[LevelSolution]:
    """Solve on the coarsest level, carry the potential to the next, and so on.

    With a `start` it solves on the finest level alone, if that converges.

    Parameters
    ----------
    levels : tuple of Level
        Coarse to fine.
    image : ndarray, shape (H, W)
        Positive everywhere, with the flux of the source.
    options : InversionOptions
        Solver, stages, tolerance, most iterations, threads.
    report : Reporter, optional
        Told of each step.
    start : ndarray, shape (n,), optional
        Weights of the finest level that solve a similar image, px². Where they lead nowhere
        they have no influence on the answer.

    Returns
    -------
    list of LevelSolution
        One for each level that was solved; the last is the answer.

    Raises
    ------
    InputError
        If the solver does not fit in memory.
    """
    if options.stages == "single":
        levels = levels[-1:]
    density = Density.from_image(image)
    if start is not None:
        nearby = _solve_from(start, levels[-1], density, options, report)
        if nearby is not None:
            return [nearby]
    solutions: list[LevelSolution] = []
    for number, level in enumerate(levels):
        if number > 0:
            weights = _prolong(levels[number - 1], solutions[-1], level, options.threads)
        elif options.solver == "newton":
            weights = _coarsest_start(level, image, options, report)
        else:
            weights = np.zeros(len(level.sites))
        objective = _objective(level, density, options)
        finest = level is levels[-1]
        tolerance = options.tolerance if finest else max(options.tolerance, _COARSE_TOLERANCE)
        solution = _solve_level(objective, weights, options, tolerance, report)
        solutions.append(LevelSolution.of_level(level, objective, solution))
    return solutions


def _solve_from(
    start: Array,
    level: Level,
    image: Density,
    options: InversionOptions,
    report: Reporter | None,
) -> LevelSolution | None:
    """Solve one level from given weights, or return None where that gets nowhere soon."""
    objective = _objective(level, image, options)
    if options.solver == "newton":
        solution = newton(
            objective,
            with_full_cells(objective, start, unchanged_first=True),
            tolerance=options.tolerance,
            max_iterations=min(_WARM_STEPS, options.max_iterations),
            shortest_step=_SHORTEST_WARM_STEP,
            report=report,
        )
    else:
        solution = _solve_level(objective, start, options, options.tolerance, report)
    return LevelSolution.of_level(level, objective, solution) if solution.converged else None


def _objective(level: Level, image: Density, options: InversionOptions) -> TransportObjective:
    return TransportObjective(
        level.triangulation.copy(), level.mass, image, threads=options.threads
    )


def _solve_level(
    objective: TransportObjective,
    weights: Array,
    options: InversionOptions,
    tolerance: float,
    report: Reporter | None,
) -> Solution:
    """Run the solver that the options name on one level."""
    method = {"newton": newton, "lbfgs": lbfgs, "quasi-newton": quasi_newton}[options.solver]
    if options.solver == "newton":
        weights = with_full_cells(objective, weights)
    return method(
        objective,
        weights,
        tolerance=tolerance,
        max_iterations=options.max_iterations,
        report=report,
    )


def _coarsest_start(
    level: Level, image: Array, options: InversionOptions, report: Reporter | None
) -> Array:
    """Follow the solution from a blurred image to a sharp one."""
    weights = np.zeros(len(level.sites))
    for blur in _BLURS:
        blurred = Density.from_image(_blurred(image, blur * level.spacing))
        objective = _objective(level, blurred, options)
        weights = _solve_level(objective, weights, options, _COARSE_TOLERANCE, report).weights
    return weights


def _blurred(image: Array, width: float) -> Array:
    """Blur by a Gaussian, mirrored at the border, so that the flux stays."""
    spectrum = dctn(image)
    for axis in (0, 1):
        waves = np.pi * np.arange(image.shape[axis]) / image.shape[axis]
        damping = np.exp(-0.5 * (width * waves) ** 2)
        spectrum *= np.expand_dims(damping, 1 - axis)
    blurred: Array = idctn(spectrum)
    return blurred


def _prolong(coarse: Level, solution: LevelSolution, fine: Level, threads: int | None) -> Array:
    """Evaluate the coarse potential at the fine sites."""
    surface = potential_surface(coarse, solution.weights, solution.displacement, threads=threads)
    return 2 * surface(fine.sites)[0]
