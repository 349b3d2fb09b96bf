"""Derivatives of planes, of fourth order in the size of a pixel."""

from __future__ import annotations

import numpy as np

from napari_shadowinv._typing import FloatArray


def laplacian(potential: FloatArray) -> FloatArray:
    """Laplacian of a potential, of fourth order in the size of a pixel.

    Within two pixels of the border it equals the nearest pixel's inside.
    """
    inner = second_derivative(potential, 0)[:, 2:-2] + second_derivative(potential, 1)[2:-2]
    return np.asarray(np.pad(inner, 2, mode="edge"))


def second_derivative(plane: FloatArray, axis: int) -> FloatArray:
    """Second derivative along an axis of fourth order; two pixels shorter at each end."""
    far_low, low, middle, high, far_high = _shifted(plane, axis)
    return np.asarray((16 * (low + high) - far_low - far_high - 30 * middle) / 12)


def first_derivative(plane: FloatArray, axis: int) -> FloatArray:
    """Derivative along an axis of fourth order; two pixels shorter at each end."""
    far_low, low, _, high, far_high = _shifted(plane, axis)
    return np.asarray((8 * (high - low) - far_high + far_low) / 12)


def _shifted(plane: FloatArray, axis: int) -> list[FloatArray]:
    """Return the planes shifted by -2 to 2 px along an axis, without its ends."""
    count = plane.shape[axis] - 4
    along = np.moveaxis(plane, axis, 0)
    return [np.moveaxis(along[start : start + count], 0, axis) for start in range(5)]


def finer_field(potential: FloatArray, displacement: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return potential and displacement at points rather than means over pixels.

    A mean over a pixel takes 1/24 of the second derivative along each axis away. Inversions read
    the displacement out by central differences, of second order, which lack 1 % of a wave of 26 px;
    here derivatives are of fourth order. Both are unchanged within 2 px of the border.
    """
    finer, moved = potential.copy(), displacement.copy()
    if min(potential.shape) > 4:
        finer[2:-2, 2:-2] -= laplacian(potential)[2:-2, 2:-2] / 24
        moved[0, 2:-2] = -first_derivative(finer, 0)
        moved[1, :, 2:-2] = -first_derivative(finer, 1)
    return finer, moved
