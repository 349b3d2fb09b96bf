"""An image as a piecewise-constant density, and exact line integrals over it.

Inside a pixel the intensity is constant (paper, section III.A), so Green's theorem
turns the mass and the moments of a polygon into sums over its edges: with

    F(y, x) = ∫_0^x I(y, s) ds,   G = ∫_0^x s I ds,   K = ∫_0^x s² I ds,

the mass is ∮ F dy, the first moments are ∮ y F dy and ∮ G dy, and the moment of inertia
about the origin is ∮ (y² F + K) dy. Each edge is walked through the pixels once; in a
pixel the integrands are polynomials of degree 3 at most, for which Simpson's rule is
exact. Beyond the image the density is zero, so polygons need no clipping.

- make a density of an image: `Density`
- the same density on smaller pixels: `split_pixels`; with slopes inside the pixels, as parts that
  are constant: `Density.resolved`, by `resolve_pixels`
- integrals along one edge: `walk_edge` (a numba kernel)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.machine import LIGHT_ITEMS, available_threads, in_ranges
from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.geometry.compiler import njit

Triple = tuple[float, float, float]
Segment = tuple[float, float, float, float]  # from (ya, xa) to (yb, xb)
Integrals = tuple[float, float, float, float, float]  # as `walk_edge` returns them


@dataclass(frozen=True)
class Density:
    """A piecewise-constant density with the prefix sums that integrals need."""

    # Kernels use corner coordinates: pixel (i, j) covers [i, i+1] × [j, j+1], half a
    # pixel more than the image's own coordinates, in which pixel centres are integers.

    image: FloatArray  # (h, w): flux of each pixel, or of each square of pixels
    # (2, h, w + 1): ∫ I and ∫ s I over each row, from 0 to the left edge of each pixel; the last
    # column holds the whole row's.
    first_sums: FloatArray
    side: float = 1  # of the squares, in px

    @classmethod
    def from_image(cls, image: ArrayLike, *, side: float = 1, threads: int | None = 1) -> Density:
        """Make a density of an image, shape (H / side, W / side), of squares with a side in px."""
        values = np.ascontiguousarray(image, dtype=np.float64)
        if not values.flags.writeable:  # the kernel is compiled for one type
            values = values.copy()
        height, width = values.shape
        sums = np.empty((2, height, width + 1))
        rows = max(1, LIGHT_ITEMS // max(1, width))
        in_ranges(_sum_rows, height, available_threads(threads), values, sums, smallest=rows)
        return cls(values, sums, side)

    def resolved(self, threads: int | None = 1) -> Density:
        """Return the density with slopes inside its pixels."""
        return Density.from_image(resolve_pixels(self.image), side=1 / PARTS, threads=threads)

    @cached_property
    def sums(self) -> FloatArray:
        """The same with ∫ s² I for moments of inertia, shape (3, h, w + 1)."""
        height, width = self.image.shape
        sums = np.empty((3, height, width + 1))
        _sum_rows(0, height, self.image, sums)
        return sums

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (H, W) of the image in pixels."""
        height, width = self.image.shape
        return round(self.side * height), round(self.side * width)

    @property
    def region(self) -> FloatArray:
        """Corners (y, x) of the image, half a pixel beyond the outermost centres, shape (2, 2)."""
        return np.array([[0.0, 0.0], self.shape]) - 0.5


@njit(nogil=True, cache=True)
def _sum_rows(start: int, stop: int, image: FloatArray, sums: FloatArray) -> None:
    for row in range(start, stop):
        for k in range(sums.shape[0]):
            sums[k, row, 0] = 0.0
        for column in range(image.shape[1]):
            value = image[row, column]
            right = column + 1
            # ∫ s ds and ∫ s² ds over the pixel
            sums[0, row, right] = sums[0, row, column] + value
            sums[1, row, right] = sums[1, row, column] + value * (column + 0.5)
            if sums.shape[0] > 2:
                sums[2, row, right] = sums[2, row, column] + value * (column * right + 1 / 3)


def side_of_squares(shape: tuple[int, int], largest: float) -> int:
    """Return the largest power of two, up to a side in px, whose squares tile an image."""
    side = 1
    while 2 * side <= largest and shape[0] % (2 * side) == shape[1] % (2 * side) == 0:
        side *= 2
    return side


def split_pixels(image: FloatArray, factor: int) -> FloatArray:
    """Split each pixel of an image into factor × factor that share its flux evenly."""
    if factor == 1:
        return image
    return np.repeat(np.repeat(image / factor**2, factor, axis=0), factor, axis=1)


PARTS = 3  # of a resolved pixel, along each axis


def resolve_pixels(image: FloatArray, parts: int = PARTS, *, least: float = 0.5) -> FloatArray:
    """Divide each pixel of a positive image into parts × parts, as its surroundings suggest.

    Each pixel keeps its flux. Along each axis the flux follows the polynomial of degree 4 with the
    flux of five pixels; beyond the border the image continues as a straight line. Where a part
    would have less than the `least` share of the pixel's mean, the pixel's parts become more alike.
    """

    def fluxes(borders: AnyArray) -> AnyArray:
        """Return the flux of x⁰ to x⁴ between borders, one row for each interval."""
        return np.diff(borders[:, None] ** np.arange(1, 6) / np.arange(1, 6), axis=0)

    weights = fluxes(np.linspace(-0.5, 0.5, parts + 1)) @ np.linalg.inv(fluxes(np.arange(6) - 2.5))
    fine = image
    for axis in (0, 1):
        along = np.moveaxis(fine, axis, 0)
        padded = np.pad(along, ((2, 2), (0, 0)), mode="reflect", reflect_type="odd")
        rows = np.empty((len(along), parts, along.shape[1]))
        for part, of_pixels in enumerate(weights):
            rows[:, part] = sum(
                weight * padded[first : first + len(along)]
                for first, weight in enumerate(of_pixels)
            )
        fine = np.moveaxis(rows.reshape(-1, along.shape[1]), 0, axis)
    (height, width), mean = image.shape, image / parts**2
    blocks = fine.reshape(height, parts, width, parts)
    drop = np.maximum(mean - blocks.min(axis=(1, 3)), 1e-300)
    slopes = np.minimum(1.0, (1 - least) * mean / drop)[:, None, :, None]
    mean = mean[:, None, :, None]
    return np.asarray((mean + slopes * (blocks - mean)).reshape(fine.shape))


@njit(nogil=True, cache=True, inline="always")
def _moments(f: Triple, g: float, k: Triple, y0: float, y1: float) -> Triple:
    """Return ∫ y F dy, ∫ G dy and ∫ (y² F + K) dy by Simpson's rule; g is the sum for G."""
    (f0, f_mid, f1), (k0, k_mid, k1) = f, k
    y_mid, sixth = 0.5 * (y0 + y1), (y1 - y0) / 6
    return (
        sixth * (y0 * f0 + 4 * y_mid * f_mid + y1 * f1),
        sixth * g,
        sixth * (y0 * y0 * f0 + k0 + 4 * (y_mid * y_mid * f_mid + k_mid) + y1 * y1 * f1 + k1),
    )


@njit(nogil=True, cache=True, inline="always")
def _moments_in_pixel(
    sums: FloatArray, value: float, row: int, column: int, segment: Segment, with_inertia: bool
) -> Triple:
    """Return ∫ y F dy, ∫ G dy and ∫ (y² F + K) dy, if wanted, over a segment inside one pixel."""
    y0, x0, y1, x1 = segment
    x_left = float(column)
    x_left2 = x_left * x_left
    x_mid = 0.5 * (x0 + x1)
    i, j = np.uint64(row), np.uint64(column)
    f_base = sums[0, i, j] - value * x_left
    g_base = sums[1, i, j] - value * x_left2 / 2
    g = 6 * g_base + value * (x0 * x0 + 4 * x_mid * x_mid + x1 * x1) / 2
    f = f_base + value * x0, f_base + value * x_mid, f_base + value * x1
    if not with_inertia:
        y_mid, sixth = 0.5 * (y0 + y1), (y1 - y0) / 6
        return sixth * (y0 * f[0] + 4 * y_mid * f[1] + y1 * f[2]), sixth * g, 0.0
    k_base = sums[2, i, j] - value * (x_left2 * x_left) / 3
    third = value / 3
    k = (
        k_base + third * x0 * x0 * x0,
        k_base + third * x_mid * x_mid * x_mid,
        k_base + third * x1 * x1 * x1,
    )
    return _moments(f, g, k, y0, y1)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def walk_inside(
    image: FloatArray, sums: FloatArray, segment: Segment, with_moments: bool, with_inertia: bool
) -> Integrals:
    """Integrate along a segment inside the image, as `walk_edge` does."""
    ya, xa, yb, xb = segment
    last_y, last_x = image.shape[0] - 1, image.shape[1] - 1
    row, column = min(int(ya), last_y), min(int(xa), last_x)
    last_row, last_column = min(int(yb), last_y), min(int(xb), last_x)
    dy, dx = yb - ya, xb - xa
    down, right = 1 if last_row > row else 0, 1 if last_column > column else 0
    # shares of the segment where it next leaves its row and its column of pixels
    per_y = 1.0 / dy if dy != 0.0 else 0.0  # then it stays in its row, and likewise in its column
    per_x = 1.0 / dx if dx != 0.0 else 0.0
    t_y = (row + down - ya) * per_y if row != last_row else 2.0
    t_x = (column + right - xa) * per_x if column != last_column else 2.0
    flux = mass = moment_y = moment_x = inertia = 0.0
    t, y, x = 0.0, ya, xa
    for _ in range(abs(last_row - row) + abs(last_column - column)):
        t_next = min(t_y, t_x)
        y_next, x_next = ya + t_next * dy, xa + t_next * dx
        i, j = np.uint64(row), np.uint64(column)  # without a test for negative indices
        value = image[i, j]
        flux += value * (t_next - t)
        mass += (sums[0, i, j] + value * (0.5 * (x + x_next) - column)) * (y_next - y)
        if with_moments:
            part = y, x, y_next, x_next
            of_y, of_x, of_both = _moments_in_pixel(sums, value, row, column, part, with_inertia)
            moment_y += of_y
            moment_x += of_x
            inertia += of_both
        if t_x <= t_y:
            column += 2 * right - 1
            t_x = (column + right - xa) * per_x if column != last_column else 2.0
        else:
            row += 2 * down - 1
            t_y = (row + down - ya) * per_y if row != last_row else 2.0
        t, y, x = t_next, y_next, x_next
    i, j = np.uint64(row), np.uint64(column)
    value = image[i, j]
    flux += value * (1.0 - t)
    mass += (sums[0, i, j] + value * (0.5 * (x + xb) - column)) * (yb - y)
    if with_moments:
        part = y, x, yb, xb
        of_y, of_x, of_both = _moments_in_pixel(sums, value, row, column, part, with_inertia)
        moment_y += of_y
        moment_x += of_x
        inertia += of_both
    return flux * math.sqrt(dy * dy + dx * dx), mass, moment_y, moment_x, inertia


@njit(nogil=True, cache=True)
def _walk_right_of_image(
    image: FloatArray, sums: FloatArray, ya: float, yb: float, with_inertia: bool
) -> tuple[float, float, float, float]:
    """Integrate from row position ya to yb beyond the right edge, where F is the row's sum."""
    height, width = image.shape
    low, high = min(ya, yb), max(ya, yb)
    sign = 1.0 if yb > ya else -1.0
    mass = moment_y = moment_x = inertia = 0.0
    for row in range(min(int(low), height - 1), min(int(high), height - 1) + 1):
        y0, y1 = max(low, float(row)), min(high, row + 1.0)
        f, g = sums[0, row, width], sums[1, row, width]
        k = sums[2, row, width] if with_inertia else 0.0
        of_y, of_x, of_both = _moments((f, f, f), 6 * g, (k, k, k), y0, y1)
        mass += sign * f * (y1 - y0)
        moment_y += sign * of_y
        moment_x += sign * of_x
        inertia += sign * of_both
    return mass, moment_y, moment_x, inertia


@njit(nogil=True, cache=True, error_model="numpy")
def walk_edge(
    image: FloatArray, sums: FloatArray, segment: Segment, with_moments: bool, with_inertia: bool
) -> Integrals:
    """Integrate along a segment, in corner coordinates.

    Returns ∫ I ds, ∫ F dy, and where they are wanted, else 0, the moments ∫ y F dy and ∫ G dy, and
    the inertia ∫ (y² F + K) dy, which alone needs the third of the sums.
    """
    ya, xa, yb, xb = segment
    height, width = image.shape
    if min(ya, yb, xa, xb) >= 0 and max(ya, yb) < height and max(xa, xb) < width:
        return walk_inside(image, sums, segment, with_moments, with_inertia)

    start, end = _inside_share(ya, yb - ya, height)
    if start >= end:
        return 0.0, 0.0, 0.0, 0.0, 0.0
    t_enter, t_leave = _inside_share(xa, xb - xa, width)
    t_enter = min(max(t_enter, start), end)
    t_leave = max(min(t_leave, end), t_enter)
    flux = mass = moment_y = moment_x = inertia = 0.0
    if t_leave > t_enter:
        y0, x0 = _point(segment, t_enter, height, width)
        y1, x1 = _point(segment, t_leave, height, width)
        flux, mass, moment_y, moment_x, inertia = walk_inside(
            image, sums, (y0, x0, y1, x1), with_moments, with_inertia
        )
    # the parts before and after the image count where they are to its right
    for t0, t1 in ((start, t_enter), (t_leave, end)):
        if t1 > t0 and xa + 0.5 * (t0 + t1) * (xb - xa) > 0.5 * width:
            y0, _ = _point(segment, t0, height, width)
            y1, _ = _point(segment, t1, height, width)
            of_mass, of_y, of_x, of_both = _walk_right_of_image(image, sums, y0, y1, with_inertia)
            mass += of_mass
            if with_moments:
                moment_y += of_y
                moment_x += of_x
                inertia += of_both
    return flux, mass, moment_y, moment_x, inertia


@njit(nogil=True, cache=True)
def _inside_share(position: float, step: float, size: int) -> tuple[float, float]:
    """Return the range of t in [0, 1] for which position + t·step lies in [0, size]."""
    if step == 0:
        return (0.0, 1.0) if 0 <= position < size else (1.0, 1.0)
    first = -position / step
    second = (size - position) / step
    return max(0.0, min(first, second)), min(1.0, max(first, second))


@njit(nogil=True, cache=True)
def _point(segment: Segment, t: float, height: int, width: int) -> tuple[float, float]:
    """Return the point at share t of a segment, not beyond the image's border."""
    ya, xa, yb, xb = segment
    y = ya + t * (yb - ya) if t < 1 else yb
    x = xa + t * (xb - xa) if t < 1 else xb
    return min(max(y, 0.0), float(height)), min(max(x, 0.0), float(width))
