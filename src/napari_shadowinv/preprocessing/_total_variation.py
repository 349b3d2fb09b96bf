"""The image of least total variation near another: `least_variation`."""

from __future__ import annotations

import math

import numpy as np

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry._kernel import njit

__all__ = ["least_variation"]

_STEP = 0.25  # the largest for which the iteration is known to converge in two dimensions
_TOLERANCE = 1e-7  # change of the energy in one step, as a share of the energy at the start


def least_variation(
    image: FloatArray, weight: float, iterations: int, report: Reporter
) -> FloatArray:
    """The u that minimises ½∑(u - image)² + weight·∑|∇u|, differences forward up to the border.

    Chambolle's fixed-point iteration for the dual field p, u being the image plus the divergence
    of p: Journal of Mathematical Imaging and Vision 20, 89 (2004), equation (9).
    """
    image = np.ascontiguousarray(image)
    dual_y, dual_x = np.zeros_like(image), np.zeros_like(image)
    first = previous = math.inf
    for step in range(iterations):
        report("source", step, iterations)
        energy = float(_step(image, dual_y, dual_x, weight))
        if step == 0:
            first = energy
        elif abs(previous - energy) < _TOLERANCE * first:
            break
        previous = energy
    smooth = np.empty_like(image)
    for row in range(len(image)):
        _smooth_row(image, dual_y, dual_x, row, smooth[row])
    return smooth


# Sums in any order, so that several pixels are dealt with at once.
_FAST = {"reassoc", "contract", "nsz"}


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_FAST)
def _step(image: FloatArray, dual_y: FloatArray, dual_x: FloatArray, weight: float) -> float:
    """One step of the iteration in place; returns the energy before it."""
    # A single pass: the smooth rows here and below are made of what is not changed yet.
    height, width = image.shape
    here, below = np.empty(width), np.empty(width)
    energy = 0.0
    _smooth_row(image, dual_y, dual_x, 0, here)
    for row in range(height):
        if row + 1 < height:
            _smooth_row(image, dual_y, dual_x, row + 1, below)
        else:
            below[:] = here
        energy += _step_row(image[row], dual_y[row], dual_x[row], here, below, weight)
        here, below = below, here
    return energy


@njit(nogil=True, cache=True, error_model="numpy", fastmath=_FAST)
def _step_row(
    image: FloatArray,
    dual_y: FloatArray,
    dual_x: FloatArray,
    here: FloatArray,
    below: FloatArray,
    weight: float,
) -> float:
    """One row of a step, from the smooth row and the one below it; returns its energy."""
    last = len(here) - 1
    rate = _STEP / weight
    energy: float = 0.0
    for column in range(last):
        slope_y, slope_x = below[column] - here[column], here[column + 1] - here[column]
        size = math.sqrt(slope_y * slope_y + slope_x * slope_x)
        change = here[column] - image[column]
        energy += change * change + weight * size
        shrunk = 1.0 / (1.0 + rate * size)
        dual_y[column] = shrunk * (dual_y[column] + _STEP * slope_y)
        dual_x[column] = shrunk * (dual_x[column] + _STEP * slope_x)
    # Nothing lies to the right of the last column.
    slope_y, change = below[last] - here[last], here[last] - image[last]
    energy += change * change + weight * abs(slope_y)
    dual_y[last] = (dual_y[last] + _STEP * slope_y) / (1.0 + rate * abs(slope_y))
    return energy


@njit(nogil=True, cache=True, error_model="numpy")
def _smooth_row(
    image: FloatArray, dual_y: FloatArray, dual_x: FloatArray, row: int, smooth: FloatArray
) -> None:
    """One row of the image plus the divergence of the dual field."""
    for column in range(image.shape[1]):
        smooth[column] = image[row, column] + dual_y[row, column] + dual_x[row, column]
    for column in range(1, image.shape[1]):
        smooth[column] -= dual_x[row, column - 1]
    if row > 0:
        for column in range(image.shape[1]):
            smooth[column] -= dual_y[row - 1, column]
