"""Descent along preconditioned gradients: `minimise`, and linear systems: `solve`.

References
----------
D. C. Liu and J. Nocedal, Math. Prog. 45, 503 (1989); M. R. Hestenes and E. Stiefel, J. Res. Natl.
Bur. Stand. 49, 409 (1952).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from napari_shadowinv._typing import FloatArray

__all__ = ["minimise", "product", "solve"]

_PAIRS = 20  # of steps and changes of the gradient that are kept
_DECREASE, _SLOPE = 1e-4, 0.9  # Wolfe's conditions
_TRIALS = 12  # steps tried along a line

Objective = Callable[[FloatArray], tuple[float, FloatArray]]


def product(first: FloatArray, second: FloatArray) -> float:
    """Scalar product without BLAS, whose idle threads spin and whose sums depend on them."""
    return float(np.einsum("i,i", first, second))


def minimise(
    objective: Objective,
    start: FloatArray,
    *,
    iterations: int,
    least_gain: float,
    after_step: Callable[[int, float], None] | None = None,
) -> tuple[FloatArray, float, int]:
    """Minimise by L-BFGS, starting with the identity as Hessian.

    Parameters
    ----------
    objective : callable
        Returns value and gradient.
    start : ndarray, shape (n,)
        Where to start; scaled so that the Hessian is about the identity.
    iterations : int
        Most steps.
    least_gain : float
        Ends once five steps lower the value by less.
    after_step : callable, optional
        Receives the number of steps and the value.

    Returns
    -------
    point : ndarray
    value : float
    steps : int
    """
    point = start
    value, gradient = objective(point)
    values = [value]
    pairs: deque[tuple[FloatArray, FloatArray, float]] = deque(maxlen=_PAIRS)
    step = 1.0
    for _ in range(iterations):
        direction = -_times_inverse_hessian(gradient, pairs)
        slope = product(direction, gradient)
        if not slope < 0:
            break
        step_taken = _step_along(objective, point, direction, value, slope, step)
        if step_taken is None:
            if not pairs:
                break
            pairs.clear()
            continue
        share, value, after = step_taken
        moved, turned = share * direction, after - gradient
        if (curvature := product(moved, turned)) > 0:
            pairs.append((moved, turned, curvature))
        point, gradient, step = point + moved, after, 1.0
        values.append(value)
        if after_step is not None:
            after_step(len(values) - 1, value)
        if len(values) > 5 and values[-6] - value < least_gain:
            break
    return point, value, len(values) - 1


def _times_inverse_hessian(
    gradient: FloatArray, pairs: deque[tuple[FloatArray, FloatArray, float]]
) -> FloatArray:
    """The two loops over the pairs."""
    result = gradient.copy()
    shares = []
    for moved, turned, curvature in reversed(pairs):
        share = product(moved, result) / curvature
        shares.append(share)
        result -= share * turned
    if pairs:
        _, turned, curvature = pairs[-1]
        result *= curvature / product(turned, turned)
    for (moved, turned, curvature), share in zip(pairs, reversed(shares), strict=True):
        result += (share - product(turned, result) / curvature) * moved
    return result


def _step_along(
    objective: Objective,
    point: FloatArray,
    direction: FloatArray,
    value: float,
    slope: float,
    step: float,
) -> tuple[float, float, FloatArray] | None:
    """A step that lowers the value enough and leaves less slope: bisection."""
    shortest, longest = 0.0, np.inf
    best = None
    for _ in range(_TRIALS):
        trial_value, gradient = objective(point + step * direction)
        if not trial_value <= value + _DECREASE * step * slope:
            longest = step
        else:
            best = step, trial_value, gradient
            if product(gradient, direction) >= _SLOPE * slope:
                return best
            shortest = step
        step = (shortest + longest) / 2 if np.isfinite(longest) else 2 * step
    return best


def solve(
    times: Callable[[FloatArray], FloatArray],
    right: FloatArray,
    *,
    tolerance: float,
    iterations: int,
    after_step: Callable[[int], None] | None = None,
) -> FloatArray:
    """Solve a positive definite system by conjugate gradients, from zero.

    Parameters
    ----------
    times : callable
        The matrix times a vector.
    right : ndarray, shape (n,)
        The right side.
    tolerance : float
        Length of the residual relative to the right side.
    iterations : int
        Most steps.
    after_step : callable, optional
        Receives the number of steps.
    """
    solution = np.zeros_like(right)
    residual, direction = right.copy(), right.copy()
    square = first = product(residual, residual)
    for k in range(iterations):
        if square <= tolerance**2 * first:
            break
        image = times(direction)
        share = square / product(direction, image)
        solution += share * direction
        residual -= share * image
        square, before = product(residual, residual), square
        direction = residual + square / before * direction
        if after_step is not None:
            after_step(k + 1)
    return solution
