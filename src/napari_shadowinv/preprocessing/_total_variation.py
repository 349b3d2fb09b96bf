"""The image of least total variation near another: `least_variation`."""

from __future__ import annotations

import math

import numpy as np

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import njit

_STEP = 0.25  # the largest for which the iteration is known to converge in two dimensions


def least_variation(
    image: FloatArray, weight: float, iterations: int, report: Reporter, tolerance: float = 1e-7
) -> FloatArray:
    """Return the u that minimises ½∑(u - image)² + weight·∑|∇u|, with forward differences.

    Chambolle's fixed-point iteration for the dual field p, u being the image plus the divergence
    of p: Journal of Mathematical Imaging and Vision 20, 89 (2004), equation (9). The tolerance is a
    change of the energy in one step, as a share of the energy at the start.
    """
    image = np.ascontiguousarray(image)
    dual_y, dual_x = np.zeros_like(image), np.zeros_like(image)
    first = previous = math.inf
    for step in range(iterations):
        report("source", step, iterations)
        energy = float(_step(image, dual_y, dual_x, weight))
        if step == 0:
            first = energy
        elif abs(previous - energy) < tolerance * first:
            break
        previous = energy
    smooth = np.empty_like(image)
    for row in range(len(image)):
        _smooth_row(image, dual_y, dual_x, row, smooth[row])
    return smooth


# Sums in any order, so that several pixels are dealt with at once.
_FASTMATH = {"reassoc", "contract", "nsz"}


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_FASTMATH)
def _step(image: FloatArray, dual_y: FloatArray, dual_x: FloatArray, weight: float) -> float:
    """Iterate once in place; return the energy before."""
    # A single pass: the two smooth rows come from rows that have not changed yet.
    height, width = image.shape
    upper, lower = np.empty(width), np.empty(width)
    energy = 0.0
    _smooth_row(image, dual_y, dual_x, 0, upper)
    for row in range(height):
        if row + 1 < height:
            _smooth_row(image, dual_y, dual_x, row + 1, lower)
        else:
            for column in range(width):  # a slice would take 8 s to compile
                lower[column] = upper[column]
        energy += _step_row(image[row], dual_y[row], dual_x[row], upper, lower, weight)
        upper, lower = lower, upper
    return energy


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_FASTMATH)
def _step_row(
    image: FloatArray,
    dual_y: FloatArray,
    dual_x: FloatArray,
    upper: FloatArray,
    lower: FloatArray,
    weight: float,
) -> float:
    """Iterate one row, from its smooth row and the next lower one; return its energy."""
    last = len(upper) - 1
    rate = _STEP / weight
    energy: float = 0.0
    for column in range(last):
        slope_y, slope_x = lower[column] - upper[column], upper[column + 1] - upper[column]
        size = math.sqrt(slope_y * slope_y + slope_x * slope_x)
        change = upper[column] - image[column]
        energy += change * change + weight * size
        shrunk = 1.0 / (1.0 + rate * size)
        dual_y[column] = shrunk * (dual_y[column] + _STEP * slope_y)
        dual_x[column] = shrunk * (dual_x[column] + _STEP * slope_x)
    # The last column has no neighbour on its right.
    slope_y, change = lower[last] - upper[last], upper[last] - image[last]
    energy += change * change + weight * abs(slope_y)
    dual_y[last] = (dual_y[last] + _STEP * slope_y) / (1.0 + rate * abs(slope_y))
    return energy


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth_row(
    image: FloatArray, dual_y: FloatArray, dual_x: FloatArray, row: int, smooth: FloatArray
) -> None:
    """Compute one row of the image plus the divergence of the dual field."""
    for column in range(image.shape[1]):
        smooth[column] = image[row, column] + dual_y[row, column] + dual_x[row, column]
    for column in range(1, image.shape[1]):
        smooth[column] -= dual_x[row, column - 1]
    if row > 0:
        for column in range(image.shape[1]):
            smooth[column] -= dual_y[row - 1, column]
