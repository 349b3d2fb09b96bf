"""Overlap of each pixel with each cell of a power diagram: `pixel_shares`.

With these areas, worked out once, the masses of the cells over any number of images are products
with one sparse matrix.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.density import walk_edge
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangle_mesh import Indices

__all__ = ["pixel_shares"]


@njit(nogil=True, cache=True)
def _extent_between(
    low: float, high: float, a: float, b: float, of_a: float, of_b: float
) -> tuple[float, float]:
    """Return the extent of a segment along one axis between low and high along the other."""
    if not (min(a, b) <= high and max(a, b) >= low):
        return np.inf, -np.inf
    if a != b:
        first = min(max((low - a) / (b - a), 0.0), 1.0)
        last = min(max((high - a) / (b - a), 0.0), 1.0)
        of_a, of_b = of_a + first * (of_b - of_a), of_a + last * (of_b - of_a)
    return min(of_a, of_b), max(of_a, of_b)


@njit(nogil=True, cache=True)
def _pixel_range(low: float, high: float, size: int) -> tuple[int, int]:
    """Return the pixels, first and one beyond the last, that a range of positions touches."""
    if not low <= high:
        return 0, 0
    first, last = min(max(low, 0.0), float(size)), min(max(high, 0.0), float(size))
    return int(first), int(np.ceil(last))


@njit(nogil=True, cache=True)
def _list_shares(
    start: int,
    stop: int,
    shape: tuple[int, int],
    around: Indices,
    borders: FloatArray,
    starts: Indices,
    pixels: Indices,
    shares: FloatArray,
) -> None:
    """List the pixels of each cell; without room for them, only count them in `starts`."""
    height, width = shape
    unit_image, sums = np.ones((1, 1)), np.zeros((3, 1, 2))
    sums[0, 0, 1] = 1.0
    for i in range(start, stop):
        count = 0
        low, high = np.inf, -np.inf
        for k in range(around[i], around[i + 1]):
            low = min(low, borders[k, 0], borders[k, 2])
            high = max(high, borders[k, 0], borders[k, 2])
        top, bottom = _pixel_range(low, high, height)
        for row in range(top, bottom):
            low, high = np.inf, -np.inf
            for k in range(around[i], around[i + 1]):
                ya, xa, yb, xb, _ = borders[k]
                x_min, x_max = _extent_between(row, row + 1.0, ya, yb, xa, xb)
                low, high = min(low, x_min), max(high, x_max)
            first, beyond = _pixel_range(low, high, width)
            if len(pixels) == 0:
                count += beyond - first
                continue
            for column in range(first, beyond):
                share = 0.0
                for k in range(around[i], around[i + 1]):
                    ya, xa, yb, xb, sense = borders[k]
                    integrals = walk_edge(
                        unit_image, sums, ya - row, xa - column, yb - row, xb - column, False
                    )
                    share += sense * integrals[1]
                pixels[starts[i] + count] = row * width + column
                shares[starts[i] + count] = share
                count += 1
        if len(pixels) == 0:
            starts[i + 1] = count


def pixel_shares(
    diagram: PowerDiagram, shape: tuple[int, int], *, threads: int | None = None
) -> csr_array:
    """Return the area of each pixel in each of the n cells, (n, H W), over images of a shape.

    The columns are the pixels row by row. Like `PowerDiagram.cell`, it reads the
    triangulation: call it before the next update. Results do not depend on the number of threads.
    """
    n = diagram.n_sites
    cells, senses = diagram.edges.T.ravel(), np.repeat([1.0, -1.0], len(diagram.edges))
    ends = np.tile(diagram.borders.reshape(-1, 4) + 0.5, (2, 1))
    order = np.argsort(cells, kind="stable")[: np.count_nonzero(cells < n)]
    around = np.searchsorted(cells[order], np.arange(n + 1))
    borders = np.column_stack([ends, senses])[order]
    starts = np.zeros(n + 1, np.int64)
    operands = shape, around, borders, starts
    threads = available_threads(threads)
    in_ranges(_list_shares, n, threads, *operands, np.empty(0, np.int32), np.empty(0))
    starts[:] = np.cumsum(starts)
    pixels, shares = np.empty(starts[-1], np.int32), np.empty(starts[-1])
    in_ranges(_list_shares, n, threads, *operands, pixels, shares)
    return csr_array((shares, pixels, starts.astype(np.int32)), shape=(n, shape[0] * shape[1]))
