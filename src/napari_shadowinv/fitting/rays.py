"""Rays through potentials of cubic B-splines, and the images where they land: `RayModel`.

A ray that starts at x lands at x - ∇ψ(x), also where rays have crossed. Pixels are boxes, as those
of a camera: each ray is shared bilinearly between the cells of a grid three times as fine, and a
pixel sums nine of them. The gradient of any function of the image with respect to the spline's
coefficients follows exactly, ray by ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.geometry._kernel import njit

__all__ = ["KNOT", "RayModel"]

KNOT = 2  # px between knots

_FINE = 3  # cells of the fine grid along a pixel's side
_BANDS = 8  # of cells; each has an image of its own, so that threads do not change a sum


@dataclass(frozen=True)
class RayModel:
    """What a beam behind a potential looks like.

    A potential is an array of coefficients with `shape`, in px², of cubic B-splines with a knot
    every 2 px.

    Attributes
    ----------
    source : ndarray, shape (H, W)
        Flux per pixel without the object; the pixels at its edge go on beyond it.
    pad : int
        Width in px, even, of the strip around the image from which rays may enter.
    threads : int or None
        Number of threads. Default: all cores. It does not affect the result.
    """

    source: FloatArray
    pad: int = 12
    threads: int | None = None

    @property
    def cells(self) -> tuple[int, int]:
        """Cells between knots along y and x, those of the strip among them."""
        height, width = self.source.shape
        return math.ceil(height / KNOT) + self.pad, math.ceil(width / KNOT) + self.pad

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a potential's coefficients."""
        rows, columns = self.cells
        return rows + 3, columns + 3

    def ray_counts(self, potential: FloatArray, spacing: float = 0.25) -> IntArray:
        """Return how many rays along y and x, a multiple of 4, each cell needs to land so densely.

        Parameters
        ----------
        potential : ndarray
            The coefficients.
        spacing : float, default 0.25
            Largest distance in px between the landing points of neighbouring rays.

        Returns
        -------
        ndarray of int64, shape `cells`
        """
        middle = potential[1:-1, 1:-1]
        along_y = np.abs(potential[2:, 1:-1] - 2 * middle + potential[:-2, 1:-1])
        along_x = np.abs(potential[1:-1, 2:] - 2 * middle + potential[1:-1, :-2])
        twist = potential[2:, 2:] - potential[2:, :-2] - potential[:-2, 2:] + potential[:-2, :-2]
        bent = (np.maximum(along_y, along_x) + np.abs(twist) / 4) / KNOT**2
        # The curvature within a cell is a mean of that at its four corners.
        most = np.maximum(bent[1:], bent[:-1])
        stretch = 1 + np.maximum(most[:, 1:], most[:, :-1])
        # Multiples of 4: rays at rest then keep off pixels' edges and the kinks of their shares.
        return 4 * np.ceil(KNOT * stretch / spacing / 4).astype(np.int64)

    def image(self, potential: FloatArray, counts: IntArray) -> FloatArray:
        """Return the flux that lands in each pixel.

        Parameters
        ----------
        potential : ndarray
            The coefficients.
        counts : ndarray of int64
            As `ray_counts` returns them.

        Returns
        -------
        ndarray, shape (H, W)
        """
        height, width = self.source.shape
        fine = np.zeros((_BANDS, _FINE * height, _FINE * width))
        self._in_bands(_deposit, potential, counts, self.source, self.pad, fine)
        total = fine.sum(axis=0).reshape(height, _FINE, width, _FINE)
        return np.asarray(total.sum(axis=(1, 3)))

    def gradient(self, potential: FloatArray, counts: IntArray, pull: FloatArray) -> FloatArray:
        """Return the derivative of ``(pull * image(potential, counts)).sum()``.

        Parameters
        ----------
        potential, counts
            As for `image`.
        pull : ndarray, shape (H, W)
            Weight of each pixel.

        Returns
        -------
        ndarray
            With respect to each coefficient, at fixed `counts`.
        """
        fine = np.repeat(np.repeat(pull, _FINE, axis=0), _FINE, axis=1)
        parts = np.zeros((_BANDS, *self.shape))
        self._in_bands(_gather, potential, counts, self.source, self.pad, fine, parts)
        return np.asarray(parts.sum(axis=0))

    def displacement(self, potential: FloatArray) -> FloatArray:
        """Return -∇ψ in px at the pixels' centres, shape (2, H, W), in axis order (y, x)."""
        found = np.empty((2, *self.source.shape))
        _slopes_at_pixels(potential, self.pad, found)
        return -found

    def _in_bands(self, kernel: object, *arguments: object) -> None:
        in_ranges(kernel, _BANDS, available_threads(self.threads), *arguments, smallest=1)  # type: ignore[arg-type]


@njit(nogil=True)
def _splines(place: float, values: FloatArray, slopes: FloatArray) -> None:
    """The four B-splines at a place (0 to 1) of a cell, and their slopes per px."""
    t, s = place, 1 - place
    values[0], slopes[0] = s**3 / 6, -(s**2) / 2 / KNOT
    values[1], slopes[1] = (4 - 6 * t**2 + 3 * t**3) / 6, (3 * t**2 - 4 * t) / 2 / KNOT
    values[2], slopes[2] = (4 - 6 * s**2 + 3 * s**3) / 6, (4 * s - 3 * s**2) / 2 / KNOT
    values[3], slopes[3] = t**3 / 6, t**2 / 2 / KNOT


@njit(nogil=True)
def _tables(n: int) -> tuple[FloatArray, FloatArray]:
    """B-splines and their slopes at the rays of a cell."""
    values, slopes = np.empty((n, 4)), np.empty((n, 4))
    for k in range(n):
        _splines((k + 0.5) / n, values[k], slopes[k])
    return values, slopes


@njit(nogil=True)
def _slope(
    potential: FloatArray,
    corner: tuple[int, int],
    along_y: tuple[FloatArray, FloatArray],
    along_x: tuple[FloatArray, FloatArray],
) -> tuple[float, float]:
    """Gradient of a potential, from the splines (values, slopes) at a place of a cell."""
    in_y = in_x = 0.0
    for i in range(4):
        plain = steep = 0.0
        for j in range(4):
            coefficient = potential[corner[0] + i, corner[1] + j]
            plain += along_x[0][j] * coefficient
            steep += along_x[1][j] * coefficient
        in_y += along_y[1][i] * plain
        in_x += along_y[0][i] * steep
    return in_y, in_x


@njit(nogil=True)
def _fine_cell(place: float) -> tuple[int, float]:
    """The fine cell at or before a place in px, and how far the place is towards the next."""
    fine = place * _FINE - 0.5
    cell = math.floor(fine)
    return cell, fine - cell


@njit(nogil=True)
def _flux_of(source: FloatArray, y: float, x: float) -> float:
    height, width = source.shape
    row = min(max(math.floor(y), 0), height - 1)
    column = min(max(math.floor(x), 0), width - 1)
    return float(source[row, column])


@njit(nogil=True)
def _deposit(
    start: int,
    stop: int,
    potential: FloatArray,
    counts: IntArray,
    source: FloatArray,
    pad: int,
    images: FloatArray,
) -> None:
    """Share the rays of bands of cells among the fine cells of each band's image."""
    rows, columns = counts.shape
    bands, height, width = images.shape
    for band in range(start, stop):
        image = images[band]
        for row in range(rows * band // bands, rows * (band + 1) // bands):
            for column in range(columns):
                n = counts[row, column]
                values, slopes = _tables(n)
                share = (KNOT / n) ** 2
                for a in range(n):
                    y = (row + (a + 0.5) / n) * KNOT - pad
                    along_y = (values[a], slopes[a])
                    for b in range(n):
                        x = (column + (b + 0.5) / n) * KNOT - pad
                        along_x = (values[b], slopes[b])
                        slope = _slope(potential, (row, column), along_y, along_x)
                        i, down = _fine_cell(y - slope[0])
                        j, right = _fine_cell(x - slope[1])
                        flux = _flux_of(source, y, x) * share
                        for di in range(2):
                            if not 0 <= i + di < height:
                                continue
                            part = flux * (down if di else 1 - down)
                            for dj in range(2):
                                if 0 <= j + dj < width:
                                    image[i + di, j + dj] += part * (right if dj else 1 - right)


@njit(nogil=True)
def _at(plane: FloatArray, row: int, column: int) -> float:
    """Value of a plane that is zero outside."""
    height, width = plane.shape
    if not (0 <= row < height and 0 <= column < width):
        return 0.0
    return float(plane[row, column])


@njit(nogil=True)
def _gather(
    start: int,
    stop: int,
    potential: FloatArray,
    counts: IntArray,
    source: FloatArray,
    pad: int,
    pull: FloatArray,
    gradients: FloatArray,
) -> None:
    """Gradients that bands of cells give the coefficients, from the pull where their rays land."""
    rows, columns = counts.shape
    bands = len(gradients)
    for band in range(start, stop):
        gradient = gradients[band]
        for row in range(rows * band // bands, rows * (band + 1) // bands):
            for column in range(columns):
                n = counts[row, column]
                values, slopes = _tables(n)
                share = (KNOT / n) ** 2 * _FINE
                for a in range(n):
                    y = (row + (a + 0.5) / n) * KNOT - pad
                    along_y = (values[a], slopes[a])
                    for b in range(n):
                        x = (column + (b + 0.5) / n) * KNOT - pad
                        along_x = (values[b], slopes[b])
                        slope = _slope(potential, (row, column), along_y, along_x)
                        i, down = _fine_cell(y - slope[0])
                        j, right = _fine_cell(x - slope[1])
                        above, beside = _at(pull, i, j), _at(pull, i, j + 1)
                        below, across = _at(pull, i + 1, j), _at(pull, i + 1, j + 1)
                        flux = -_flux_of(source, y, x) * share
                        to_y = flux * ((1 - right) * (below - above) + right * (across - beside))
                        to_x = flux * ((1 - down) * (beside - above) + down * (across - below))
                        for r in range(4):
                            plain, steep = to_x * values[a, r], to_y * slopes[a, r]
                            for s in range(4):
                                gradient[row + r, column + s] += (
                                    steep * values[b, s] + plain * slopes[b, s]
                                )


@njit(nogil=True)
def _slopes_at_pixels(potential: FloatArray, pad: int, found: FloatArray) -> None:
    """Gradient of a potential at the pixels' centres."""
    _, height, width = found.shape
    values, slopes = _tables(KNOT)
    for y in range(height):
        for x in range(width):
            row, a = divmod(y + pad, KNOT)
            column, b = divmod(x + pad, KNOT)
            found[0, y, x], found[1, y, x] = _slope(
                potential, (row, column), (values[a], slopes[a]), (values[b], slopes[b])
            )
