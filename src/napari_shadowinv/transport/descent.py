"""Descent along gradients, as in the paper: slower than Newton, for comparison.

References
----------
Paper, section III.A; D. C. Liu and J. Nocedal, Math. Prog. 45, 503 (1989); A. G. Buckley,
Math. Prog. 15, 200 (1978).
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.transport.objective import Solution, TransportObjective

__all__ = ["descend"]

_CORRECTIONS = 20  # pairs of steps and gradients that L-BFGS keeps
_MATRICES = 4  # n × n matrices that scipy's BFGS holds at once
_METHODS: dict[str, tuple[str, dict[str, float]]] = {
    "lbfgs": ("L-BFGS-B", {"maxcor": _CORRECTIONS, "ftol": 0.0, "gtol": 0.0, "maxfun": 10**9}),
    "quasi-newton": ("BFGS", {"gtol": 0.0}),
}


def descend(
    objective: TransportObjective,
    start: FloatArray,
    solver: str,
    *,
    tolerance: float,
    max_iterations: int,
    report: Reporter | None = None,
) -> Solution:
    """Minimise the convex function by one of scipy's methods until every cell holds its flux.

    The solver is ``"lbfgs"``, or ``"quasi-newton"``, which keeps n × n matrices. Cells may be
    empty at the start. The tolerance is the largest relative flux error of a cell.

    Raises
    ------
    InputError
        If the matrices do not fit in memory.
    """
    if solver == "quasi-newton":
        _check_memory(len(start))
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


def _check_memory(n: int) -> None:
    needed = 8 * _MATRICES * n**2
    memory = physical_memory()
    if memory is not None and needed > memory:
        most = int((memory / (8 * _MATRICES)) ** 0.5)
        raise InputError(
            f"quasi-newton keeps n × n matrices: {n:,} sites need {needed / 1e9:.3g} GB, this "
            f"machine has {memory / 1e9:.3g} GB: use lbfgs, or at most {most:,} sites"
        )
