"""Finding the weights: damped Newton on a hierarchy of levels.

- the weights of all levels by the solver that the options name: `solve`
- the weights of the finest level, from nothing: `solve_multilevel`
- the weights of one level from a good start: `newton`

References
----------
Paper, section III ("multi-stage approach"); J. Kitagawa, Q. Mérigot and B. Thibert,
J. Eur. Math. Soc. 21, 2603 (2019) for the damped Newton method.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn
from scipy.optimize import minimize

from napari_shadowinv.geometry._threads import available_threads
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.progress import Reporter
from napari_shadowinv.transport.linear import solve_laplacian
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.potential import potential_surface
from napari_shadowinv.transport.sites import Level

__all__ = ["LevelSolution", "Solution", "newton", "solve", "solve_multilevel"]

Array = NDArray[np.float64]

_SHORTEST_STEP = 1e-7
_LINEAR_TOLERANCE = 1e-2
_COARSE_TOLERANCE = 3e-2
_BLURS = (4.0, 2.0, 1.0, 0.5)
_SHARES_OF_START = (0.999, 0.99, 0.9, 0.5)
_LEAST_START = 1e-12  # of a mean cell's flux


@dataclass(frozen=True)
class Solution:
    """Weights of one level and how they were reached.

    Attributes
    ----------
    weights : ndarray, shape (n,)
        Of mean zero, px².
    residual : float
        Largest relative flux error of a cell.
    iterations : int
        Newton steps.
    converged : bool
        Whether the residual is within the tolerance.
    reason : str
        Why it did not converge; empty if it did.
    """

    weights: Array
    residual: float
    iterations: int
    converged: bool
    reason: str = ""


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


def newton(
    objective: TransportObjective,
    weights: Array,
    *,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
) -> Solution:
    """Solve T(w) = S by damped Newton steps that never empty a cell.

    Parameters
    ----------
    objective : TransportObjective
        The problem.
    weights : ndarray, shape (n,)
        Start; every cell must hold flux.
    tolerance : float
        Largest relative flux error allowed in any cell.
    max_iterations : int
        Most steps.
    report : Reporter, optional
        Told of each step.

    Returns
    -------
    Solution
    """
    mass = objective.mass
    diagram = objective.diagram(weights)
    residual = objective.residual(diagram)
    keep = 0.5 * min(float(diagram.masses.min() / mass.mean()), float(mass.min() / mass.mean()))
    iterations = 0
    reason = f"the solver used all {max_iterations} iterations allowed"
    while residual > tolerance and iterations < max_iterations:
        message = f"{len(mass):,} sites, residual {residual:.2g}"
        alive = partial(report or Reporter(), "transport", iterations, None, message)
        alive()
        gap = mass - diagram.masses
        laplacian = diagram.laplacian()
        del diagram  # the trial steps need its memory
        try:
            step = solve_laplacian(
                laplacian, gap, _LINEAR_TOLERANCE, available_threads(objective.threads)
            )
        except RuntimeError as error:
            reason = f"Newton's system cannot be solved: {error}"
            break
        del laplacian
        damped = _damped_step(objective, weights, step, gap, keep * mass.mean(), alive)
        if damped is None:
            reason = "no step along Newton's direction lowers the error without emptying a cell"
            break
        weights, diagram = damped
        residual = objective.residual(diagram)
        iterations += 1
    converged = residual <= tolerance
    return Solution(
        weights - weights.mean(), residual, iterations, converged, "" if converged else reason
    )


def _damped_step(
    objective: TransportObjective,
    weights: Array,
    step: Array,
    gap: Array,
    least: float,
    alive: Callable[[], None],
) -> tuple[Array, PowerDiagram] | None:
    """Halve the step until all cells keep some flux and the error falls."""
    error = np.linalg.norm(gap)
    share = 1.0
    while share > _SHORTEST_STEP:
        diagram = None  # one at a time: they are large
        alive()
        trial = weights + share * step
        diagram = objective.diagram_if_full(trial)
        if diagram is not None and diagram.masses.min() > least:
            now = np.linalg.norm(objective.mass - diagram.masses)
            if now < (1 - 0.1 * share) * error:
                return trial, diagram
        share /= 2
    return None


def solve(
    levels: tuple[Level, ...],
    image: Array,
    options: InversionOptions,
    report: Reporter | None = None,
) -> list[LevelSolution]:
    """Find the weights with the solver, tolerance and limits that `options` name.

    Parameters
    ----------
    levels : tuple of Level
        Coarse to fine.
    image : ndarray, shape (H, W)
        Positive everywhere, with the flux of the source.
    options : InversionOptions
        Choices.
    report : Reporter, optional
        Told of each step.

    Returns
    -------
    list of LevelSolution
        One for each level that was solved; the last is the answer.
    """
    if options.solver == "lbfgs":
        return [lbfgs(levels[-1], image, options, report)]
    return solve_multilevel(
        levels,
        image,
        tolerance=options.tolerance,
        max_iterations=options.max_iterations,
        threads=options.threads,
        report=report,
    )


def solve_multilevel(
    levels: tuple[Level, ...],
    image: Array,
    *,
    tolerance: float,
    max_iterations: int,
    threads: int | None = None,
    report: Reporter | None = None,
) -> list[LevelSolution]:
    """Solve on the coarsest level, carry the potential to the next, and so on.

    Parameters
    ----------
    levels : tuple of Level
        Coarse to fine.
    image : ndarray, shape (H, W)
        Positive everywhere, with the flux of the source.
    tolerance, max_iterations, threads, report
        See `newton`.

    Returns
    -------
    list of LevelSolution
        One for each level; the last is the answer.
    """
    density = Density.from_image(image)
    solutions: list[LevelSolution] = []
    for number, level in enumerate(levels):
        objective = TransportObjective(
            level.triangulation.copy(), level.mass, density, threads=threads
        )
        if number == 0:
            weights = _coarsest_start(level, image, max_iterations, threads, report)
        else:
            weights = _prolong(levels[number - 1], solutions[-1], level, threads)
        finest = number == len(levels) - 1
        solution = newton(
            objective,
            _with_full_cells(objective, weights),
            tolerance=tolerance if finest else max(tolerance, _COARSE_TOLERANCE),
            max_iterations=max_iterations,
            report=report,
        )
        solutions.append(LevelSolution.of_level(level, objective, solution))
    return solutions


def _with_full_cells(objective: TransportObjective, weights: Array) -> Array:
    """Find weights near the given ones for which every cell holds some flux.

    Hidden sites are lowered to where they just show; then a little of the zero weights,
    for which every cell is round and full, is mixed in.
    """
    shown = objective.triangulation.lower_hidden(weights)
    for share in _SHARES_OF_START:
        diagram = objective.diagram_if_full(share * shown)
        if diagram is not None and diagram.masses.min() > _LEAST_START * objective.mass.mean():
            return share * shown
    return np.zeros(len(weights))


def _coarsest_start(
    level: Level,
    image: Array,
    max_iterations: int,
    threads: int | None,
    report: Reporter | None,
) -> Array:
    """Follow the solution from a blurred image to a sharp one."""
    weights = np.zeros(len(level.sites))
    for blur in _BLURS:
        objective = TransportObjective(
            level.triangulation.copy(),
            level.mass,
            Density.from_image(_blurred(image, blur * level.spacing)),
            threads=threads,
        )
        weights = newton(
            objective,
            _with_full_cells(objective, weights),
            tolerance=_COARSE_TOLERANCE,
            max_iterations=max_iterations,
            report=report,
        ).weights
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


def lbfgs(
    level: Level, image: Array, options: InversionOptions, report: Reporter | None = None
) -> LevelSolution:
    """Minimise the convex function by limited-memory BFGS from zero weights.

    Parameters
    ----------
    level : Level
        The sites.
    image : ndarray, shape (H, W)
        Positive everywhere, with the flux of the source.
    options : InversionOptions
        Tolerance, most iterations, threads.
    report : Reporter, optional
        Told of each step.

    Returns
    -------
    LevelSolution

    References
    ----------
    Paper, section III.A; D. C. Liu and J. Nocedal, Math. Prog. 45, 503 (1989).
    """
    objective = TransportObjective(
        level.triangulation.copy(), level.mass, Density.from_image(image), threads=options.threads
    )
    # weights in units of the cells' area and flux in units of a cell's make a well-scaled problem
    area = level.spacing**2
    flux = float(level.mass.mean())

    residual = np.inf
    steps = 0

    def scaled(weights: Array) -> tuple[float, Array]:
        nonlocal residual
        value, gradient = objective.value_and_gradient(area * weights)
        residual = float(np.max(np.abs(gradient) / level.mass))
        return value / (area * flux), gradient / flux

    def after_step(_: Array) -> None:
        nonlocal steps
        steps += 1
        if report is not None:
            report("transport", steps, None, f"{len(level.mass):,} sites, residual {residual:.2g}")
        if residual <= options.tolerance:
            raise StopIteration

    result = minimize(
        scaled,
        np.zeros(len(level.mass)),
        jac=True,
        method="L-BFGS-B",
        callback=after_step,
        options={"maxiter": options.max_iterations, "maxcor": 20, "ftol": 0.0, "gtol": 0.0},
    )
    weights = area * result.x
    residual = objective.residual(objective.diagram(weights))
    converged = residual <= options.tolerance
    reason = "" if converged else f"limited-memory BFGS ended after {steps} iterations"
    solution = Solution(weights - weights.mean(), residual, steps, converged, reason)
    return LevelSolution.of_level(level, objective, solution)
