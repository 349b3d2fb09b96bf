"""`read_dual` as a linear map, for many weights of one level with a geometry computed once.

- potential and displacement at every pixel, and sums over many samples of them: `LinearReadout`
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.linear_surface import WIDTH, corner_weights, with_gradients
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.transport.sites import Level, SitePlan

__all__ = ["LinearReadout"]


@njit(nogil=True, cache=True)
def _add_rows(
    start: int,
    stop: int,
    corners: Indices,
    weights: FloatArray,
    values: FloatArray,
    sums: FloatArray,
    squares: FloatArray,
) -> None:
    """Add to the sums over samples of potential and displacement in rows `start` to `stop`."""
    width = corners.shape[1]
    potential = np.empty((3, width, WIDTH))  # of three rows, in turns
    for row in range(start, stop + 2):
        current = potential[row % 3]
        for column in range(width):
            for s in range(WIDTH):
                current[column, s] = 0.0
            for k in range(3):
                corner = corners[row, column, k]
                of_value, of_y, of_x = weights[row, column, k]
                for s in range(WIDTH):
                    current[column, s] += (
                        of_value * values[corner, 0, s]
                        + of_y * values[corner, 1, s]
                        + of_x * values[corner, 2, s]
                    )
        y = row - 2
        if y < start:
            continue
        above, level, below = potential[y % 3], potential[(y + 1) % 3], current
        for x in range(width - 2):
            p = p2 = dy = dy2 = dx = dx2 = 0.0
            for s in range(WIDTH):
                at = level[x + 1, s]
                along_y = 0.5 * (above[x + 1, s] - below[x + 1, s])
                along_x = 0.5 * (level[x, s] - level[x + 2, s])
                p += at
                p2 += at * at
                dy += along_y
                dy2 += along_y * along_y
                dx += along_x
                dx2 += along_x * along_x
            sums[0, y, x] += p
            sums[1, y, x] += dy
            sums[2, y, x] += dx
            squares[0, y, x] += p2
            squares[1, y, x] += dy2
            squares[2, y, x] += dx2


class LinearReadout:
    """Read-out of a level at the pixels of a plan's image."""

    def __init__(self, plan: SitePlan, level: Level, threads: int | None = None) -> None:
        n = len(level.sites)
        self._triangulation = level.triangulation
        # One pixel more at each side; beyond the level's border the potential is its mirror image.
        beyond = [
            np.clip(np.arange(-1, size + 1) + plan.margin_width, 0, padded_size - 1)
            for size, padded_size in zip(plan.source.shape, level.shape, strict=True)
        ]
        pixels = np.stack(np.meshgrid(*beyond, indexing="ij"), axis=-1)
        mirrored = level.mirrored()
        queries = pixels.reshape(-1, 2).astype(np.float64)
        corners, weights = corner_weights(mirrored.triangulation, queries, threads)
        weights[..., 1:] *= mirrored.sense[corners]
        self._corners = mirrored.origin[corners].reshape(*pixels.shape[:2], 3)
        self._weights = weights.reshape(*pixels.shape[:2], 3, 3)
        border = np.ones(plan.source.shape, bool)
        border[1:-1, 1:-1] = False
        border = np.pad(border, 1)
        columns = 3 * self._corners[border][..., None] + np.arange(3)
        mean = np.bincount(columns.ravel(), self._weights[border].ravel(), 3 * n) / border.sum()
        self._border_mean = csr_array(mean[None])

    def at_sites(self, weights: FloatArray) -> FloatArray:
        """Return the potential's values and gradients, (n, 3, WIDTH), for weights (n, WIDTH)."""
        # Half the weights are the potential.
        at_sites = with_gradients(self._triangulation, 0.5 * weights)
        at_sites[:, 0] -= self._border_mean @ at_sites.reshape(-1, WIDTH)
        return at_sites

    def add(
        self, values: FloatArray, sums: FloatArray, squares: FloatArray, start: int, rows: int
    ) -> None:
        """Add potential and displacement, and their squares, to sums (3, H, W) in some rows."""
        stop = min(start + rows, sums.shape[1])
        _add_rows(start, stop, self._corners, self._weights, values, sums, squares)

    def field(self, values: FloatArray) -> FloatArray:
        """Return potential and displacement, (3, H, W), of one sample's values at sites, (n, 3)."""
        padded = np.einsum("yxkc,yxkc->yx", self._weights, values[self._corners])
        return np.stack([padded, *-np.array(np.gradient(padded))])[:, 1:-1, 1:-1]
