"""Minimising the convex function of one level.

- by damped Newton steps, from weights whose cells all hold flux: `newton`
- make such weights of any others: `with_full_cells`
- by descent along gradients, as in the paper; slower, for comparison: `descend`

The tolerance is the largest relative flux error of a cell.

References
----------
J. Kitagawa, Q. Mérigot and B. Thibert, J. Eur. Math. Soc. 21, 2603 (2019); paper, section
III.A; D. C. Liu and J. Nocedal, Math. Prog. 45, 503 (1989); A. G. Buckley, Math. Prog. 15,
200 (1978).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.optimize import minimize
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.transport.linear import SimilarSystems
from napari_shadowinv.transport.objective import Solution, TransportObjective

__all__ = ["SHORTEST_STEP", "descend", "newton", "with_full_cells"]

SHORTEST_STEP = 1e-7

_EVENING_STEPS = 3
_EVENING_SHARE = 0.6
_EVEN_RESIDUAL = 1.0  # largest relative flux error of a cell
_HALVING_STEPS = 15  # steps within which the error must halve, or the start was a bad one
_LINEAR_TOLERANCE = 1e-2
_SHARES_OF_START = (0.999, 0.99, 0.9, 0.5)
_MIN_START_FLUX = 1e-12  # of a mean cell's flux

_MATRICES = 4  # n × n matrices that scipy's BFGS holds at once
_METHODS: dict[str, tuple[str, dict[str, float]]] = {
    # maxcor: pairs of steps and gradients that it keeps
    "lbfgs": ("L-BFGS-B", {"maxcor": 20, "ftol": 0.0, "gtol": 0.0, "maxfun": 10**9}),
    "quasi-newton": ("BFGS", {"gtol": 0.0}),
}


def newton(
    objective: TransportObjective,
    weights: FloatArray,
    *,
    tolerance: float,
    max_iterations: int,
    shortest_step: float = SHORTEST_STEP,
    fill: bool = False,
    report: Reporter | None = None,
) -> Solution:
    """Solve T(w) = S by damped Newton steps that never empty a cell.

    With `fill`, empty cells are filled first (`with_full_cells`). The solver stops without
    convergence if the error has not halved in many steps (a bad start), or if less than
    `shortest_step` of Newton's step is possible.
    """
    mass = objective.mass
    if fill:
        weights, diagram = with_full_cells(objective, weights)
    else:
        diagram = objective.diagram(weights)
    weights, diagram = _even_out(objective, weights, diagram)
    residual = objective.residual(diagram)
    keep = 0.5 * min(float(diagram.masses.min() / mass.mean()), float(mass.min() / mass.mean()))
    errors = [_length(mass - diagram.masses)]
    systems = SimilarSystems()
    first = 1.0
    reason = f"the solver used all {max_iterations} iterations allowed"
    while residual > tolerance and len(errors) <= max_iterations:
        message = f"{len(mass):,} sites, residual {residual:.2g}"
        alive = partial(report or Reporter(), "transport", len(errors) - 1, None, message)
        alive()
        gap = mass - diagram.masses
        laplacian = diagram.laplacian()
        del diagram  # the trial steps need its memory
        try:
            step = objective.newton_step(systems, laplacian, weights, gap, _LINEAR_TOLERANCE)
        except RuntimeError as error:
            reason = f"Newton's system cannot be solved: {error}"
            break
        del laplacian
        shares = (first, shortest_step)
        damped = _damped_step(objective, weights, step, gap, keep * mass.mean(), shares, alive)
        if damped is None:
            reason = "no step along Newton's direction lowers the error without emptying a cell"
            break
        weights, diagram, share = damped
        first = min(1.0, (8 if share == first else 2) * share)
        residual = objective.residual(diagram)
        errors.append(_length(mass - diagram.masses))
        if len(errors) > _HALVING_STEPS and errors[-1] > 0.5 * errors[-1 - _HALVING_STEPS]:
            reason = f"the error has not halved in {_HALVING_STEPS} steps"
            break
    converged = residual <= tolerance
    reason = "" if converged else reason
    return Solution(objective.in_gauge(weights), residual, len(errors) - 1, converged, reason)


def _even_out(
    objective: TransportObjective, weights: FloatArray, diagram: PowerDiagram
) -> tuple[FloatArray, PowerDiagram]:
    """Let cells that are almost empty or far too full settle with their neighbours.

    A start from coarser sites has a few such cells near caustics, and they alone would keep
    Newton's steps short for the whole image.
    """
    for _ in range(_EVENING_STEPS):
        if objective.residual(diagram) <= _EVEN_RESIDUAL:
            break
        gap = np.clip(objective.mass - diagram.masses, -objective.mass, objective.mass)
        stiffness = _stiffness(diagram.laplacian())
        if not stiffness.all():
            break
        step = _EVENING_SHARE * gap / stiffness
        trial = objective.diagram_if_full(weights + step)
        if trial is None:
            # The triangulation has followed the trial.
            return weights, objective.diagram(weights)
        weights, diagram = weights + step, trial
    return weights, diagram


def _stiffness(laplacian: csr_array) -> FloatArray:
    """Diagonal of a Laplacian, of nodes with hardly any ties the mean of their neighbours'."""
    diagonal = laplacian.diagonal()
    ties = laplacian.copy()
    ties.data = np.ones_like(ties.data)
    around = (ties @ diagonal) / np.diff(ties.indptr)
    return np.asarray(np.maximum(diagonal, around))


def _damped_step(
    objective: TransportObjective,
    weights: FloatArray,
    step: FloatArray,
    gap: FloatArray,
    least: float,
    shares: tuple[float, float],
    alive: Callable[[], None],
) -> tuple[FloatArray, PowerDiagram, float] | None:
    """Halve the share of the step until all cells keep some flux and the error falls."""
    error = _length(gap)
    share, shortest = shares
    while share > shortest:
        diagram = None  # one at a time: they are large
        alive()
        trial = weights + share * step
        diagram = objective.diagram_if_full(trial)
        if diagram is not None and diagram.masses.min() > least:
            now = _length(objective.mass - diagram.masses)
            if now < (1 - 0.1 * share) * error:
                return trial, diagram, share
        share /= 2
    return None


def _length(vector: FloatArray) -> float:
    """Return the length without BLAS, whose idle threads spin and whose sums depend on them."""
    return float(np.sqrt(np.sum(vector * vector)))


def with_full_cells(
    objective: TransportObjective, weights: FloatArray
) -> tuple[FloatArray, PowerDiagram]:
    """Find nearby weights for which every cell holds some flux, and their diagram.

    Hidden sites are lowered to where they just show; then a little of the zero weights,
    for which every cell is round and full, is mixed in.
    """
    visible = objective.triangulation.lower_hidden(weights)
    for share in _SHARES_OF_START:
        diagram = objective.diagram_if_full(share * visible)
        if diagram is not None and diagram.masses.min() > _MIN_START_FLUX * objective.mass.mean():
            return share * visible, diagram
    weights = np.zeros(len(weights))
    return weights, objective.diagram(weights)


def descend(
    objective: TransportObjective,
    start: FloatArray,
    solver: str,
    *,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
) -> Solution:
    """Minimise by one of scipy's methods; cells may be empty at the start."""
    memory, needed = physical_memory(), 8 * _MATRICES * len(start) ** 2
    if solver == "quasi-newton" and memory is not None and needed > memory:
        most = int((memory / (8 * _MATRICES)) ** 0.5)
        raise InputError(
            f"quasi-newton keeps n × n matrices: {len(start):,} sites need {needed / 1e9:.3g} GB, "
            f"this machine has {memory / 1e9:.3g} GB: use lbfgs, or at most {most:,} sites"
        )
    method, options = _METHODS[solver]
    mass = objective.mass
    flux = float(mass.mean())
    # weights in units of the cells' area and flux in units of a cell's make a well-scaled problem
    height, width = objective.image.shape
    area = height * width / len(mass)
    residual = np.inf
    steps = 0

    def scaled(weights: FloatArray) -> tuple[float, FloatArray]:
        nonlocal residual
        value, gradient = objective.value_and_gradient(area * weights)
        residual = float(np.max(np.abs(gradient) / mass))
        return value / (area * flux), gradient / flux

    def after_step(_: FloatArray) -> None:
        nonlocal steps
        steps += 1
        if report is not None:
            report("transport", steps, None, f"{len(mass):,} sites, residual {residual:.2g}")
        if residual <= tolerance:
            raise StopIteration

    result = minimize(
        scaled,
        start / area,
        jac=True,
        method=method,
        callback=after_step,
        options={"maxiter": max_iterations, **options},
    )
    weights = area * result.x
    residual = objective.residual(objective.diagram(weights))
    converged = residual <= tolerance
    reason = "" if converged else f"{method} ended after {steps} iterations: {result.message}"
    return Solution(weights - weights.mean(), residual, steps, converged, reason)
