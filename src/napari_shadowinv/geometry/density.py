"""An image as a piecewise-constant density, and exact line integrals over it.

Inside a pixel the intensity is constant (paper, section III.A), so Green's theorem
turns the mass and the moments of a polygon into sums over its edges: with

    F(y, x) = ∫_0^x I(y, s) ds,   G = ∫_0^x s I ds,   K = ∫_0^x s² I ds,

the mass is ∮ F dy, the first moments are ∮ y F dy and ∮ G dy, and the moment of inertia
about the origin is ∮ (y² F + K) dy. Each edge is walked through the pixels once; in a
pixel the integrands are polynomials of degree 3 at most, for which Simpson's rule is
exact. Beyond the image the density is zero, so polygons need no clipping.

- make a density of an image: `Density`
- integrals along one edge: `walk_edge` (a numba kernel)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

__all__ = ["Density", "walk_edge"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Density:
    """A piecewise-constant density with the prefix sums that integrals need.

    Kernels use corner coordinates: pixel (i, j) covers [i, i+1] × [j, j+1], half a
    pixel more than the image's own coordinates, in which pixel centres are integers.

    Attributes
    ----------
    padded : ndarray, shape (H, W + 2)
        The image between two columns of zeros.
    sums : ndarray, shape (3, H, W + 2)
        ∫ I, ∫ s I and ∫ s² I from 0 to the left edge of each padded column.
    """

    padded: Array
    sums: Array

    @classmethod
    def from_image(cls, image: ArrayLike) -> Density:
        """Make a density of an image of shape (H, W)."""
        values = np.asarray(image, dtype=np.float64)
        height, width = values.shape
        padded = np.zeros((height, width + 2))
        padded[:, 1:-1] = values
        left = np.arange(width, dtype=np.float64)
        right = left + 1
        sums = np.zeros((3, height, width + 2))
        for power in range(3):
            of_pixel = values * (right ** (power + 1) - left ** (power + 1)) / (power + 1)
            np.cumsum(of_pixel, axis=1, out=sums[power, :, 2:])
        return cls(padded, sums)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of the image."""
        return self.padded.shape[0], self.padded.shape[1] - 2

    @property
    def total(self) -> float:
        """The image's flux."""
        return float(self.sums[0, :, -1].sum())


@njit(nogil=True, cache=True, inline="always")
def _piece(
    padded: Array,
    sums: Array,
    row: int,
    column: int,
    y0: float,
    x0: float,
    y1: float,
    x1: float,
    with_moments: bool,
) -> tuple[float, float, float, float]:
    """∫ F dy, ∫ y F dy, ∫ G dy and ∫ (y² F + K) dy over a segment inside one pixel."""
    value = padded[row, column]
    base = sums[0, row, column]
    left = max(column - 1.0, 0.0)
    dy = y1 - y0
    x_mid = 0.5 * (x0 + x1)
    f_mid = base + value * (x_mid - left)
    if not with_moments:
        return f_mid * dy, 0.0, 0.0, 0.0
    f0 = base + value * (x0 - left)
    f1 = base + value * (x1 - left)
    y_mid = 0.5 * (y0 + y1)
    g_base = sums[1, row, column]
    k_base = sums[2, row, column]
    left2 = left * left
    left3 = left2 * left
    g0 = g_base + value * (x0 * x0 - left2) / 2
    g1 = g_base + value * (x1 * x1 - left2) / 2
    g_mid = g_base + value * (x_mid * x_mid - left2) / 2
    k0 = k_base + value * (x0 * x0 * x0 - left3) / 3
    k1 = k_base + value * (x1 * x1 * x1 - left3) / 3
    k_mid = k_base + value * (x_mid * x_mid * x_mid - left3) / 3
    sixth = dy / 6
    return (
        f_mid * dy,
        sixth * (y0 * f0 + 4 * y_mid * f_mid + y1 * f1),
        sixth * (g0 + 4 * g_mid + g1),
        sixth * (y0 * y0 * f0 + k0 + 4 * (y_mid * y_mid * f_mid + k_mid) + y1 * y1 * f1 + k1),
    )


@njit(nogil=True, cache=True)
def walk_edge(
    padded: Array,
    sums: Array,
    ya: float,
    xa: float,
    yb: float,
    xb: float,
    with_moments: bool,
) -> tuple[float, float, float, float, float]:
    """Integrate along the segment from (ya, xa) to (yb, xb), in corner coordinates.

    Returns
    -------
    tuple of float
        ∫ I ds, then ∫ F dy, ∫ y F dy, ∫ G dy and ∫ (y² F + K) dy; the last three
        are 0 unless `with_moments`.
    """
    height = padded.shape[0]
    last = padded.shape[1] - 1
    dy = yb - ya
    dx = xb - xa
    flux = 0.0
    mass = 0.0
    moment_y = 0.0
    moment_x = 0.0
    inertia = 0.0

    t = 0.0
    end = 1.0
    if dy > 0:
        t = max(t, -ya / dy)
        end = min(end, (height - ya) / dy)
    elif dy < 0:
        t = max(t, (height - ya) / dy)
        end = min(end, -ya / dy)
    elif ya < 0 or ya >= height:
        return flux, mass, moment_y, moment_x, inertia
    if t >= end:
        return flux, mass, moment_y, moment_x, inertia

    y = ya + t * dy
    x = xa + t * dx
    row = min(max(math.floor(y), 0), height - 1)
    if dy < 0 and row == y and row > 0:
        row -= 1
    column = min(max(math.floor(min(max(x, -1.0), last)) + 1, 0), last)
    if dx < 0 and column - 1 == x and column > 0:
        column -= 1
    length = math.sqrt(dy * dy + dx * dx)
    inverse_y = 1.0 / dy if dy != 0 else 0.0
    inverse_x = 1.0 / dx if dx != 0 else 0.0

    while True:
        t_y = math.inf
        if dy > 0:
            t_y = (row + 1 - ya) * inverse_y
        elif dy < 0:
            t_y = (row - ya) * inverse_y
        t_x = math.inf
        if dx > 0 and column < last:
            t_x = (column - xa) * inverse_x
        elif dx < 0 and column > 0:
            t_x = (column - 1 - xa) * inverse_x
        t_next = max(t, min(t_x, t_y, end))
        y_next = ya + t_next * dy if t_next < 1 else yb
        x_next = xa + t_next * dx if t_next < 1 else xb
        flux += padded[row, column] * (t_next - t)
        if column > 0:
            d_mass, d_y, d_x, d_inertia = _piece(
                padded, sums, row, column, y, x, y_next, x_next, with_moments
            )
            mass += d_mass
            moment_y += d_y
            moment_x += d_x
            inertia += d_inertia
        if t_next >= end:
            break
        if t_x <= t_y:
            column += 1 if dx > 0 else -1
        else:
            row += 1 if dy > 0 else -1
            if row < 0 or row >= height:
                break
        t = t_next
        y = y_next
        x = x_next
    return flux * length, mass, moment_y, moment_x, inertia
