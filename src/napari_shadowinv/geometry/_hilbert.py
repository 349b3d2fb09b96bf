"""Orders of points: along a Hilbert curve, and along it in random rounds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.geometry.compiler import kernel, kernel_that_allocates
from napari_shadowinv.geometry.triangle_mesh import Indices

BITS = 16

# A round of insertion has 2³ - 1 times as many points as all before it.
ROUND_BITS = 3


@kernel
def _distance_along(x: int, y: int) -> int:
    """Return the distance of grid cell (x, y) along the curve, without branches to mispredict."""
    distance = 0
    for bit in range(BITS - 1, -1, -1):
        right, up = (x >> bit) & 1, (y >> bit) & 1
        distance = (distance << 2) | ((3 * right) ^ up)
        turned = -(right & (1 - up))
        x, y = x ^ turned, y ^ turned
        swapped = (x ^ y) & (up - 1)
        x, y = x ^ swapped, y ^ swapped
    return distance


@kernel_that_allocates
def _curve_keys(points: FloatArray) -> NDArray[np.uint64]:
    """Return numbers to sort by: a point's distance along the curve, then its row."""
    n = points.shape[0]
    keys = np.arange(n).astype(np.uint64)
    x_low, x_high = points[:, 0].min(), points[:, 0].max()
    y_low, y_high = points[:, 1].min(), points[:, 1].max()
    extent = max(x_high - x_low, y_high - y_low)
    if extent == 0.0:
        return keys
    last = (1 << BITS) - 1
    scale = (1 << BITS) / extent
    for i in range(n):
        x = min(int((points[i, 0] - x_low) * scale), last)
        y = min(int((points[i, 1] - y_low) * scale), last)
        keys[i] |= np.uint64(_distance_along(x, y)) << np.uint64(32)
    return keys


def hilbert_permutation(points: FloatArray) -> Indices:
    """Sort points along a Hilbert curve through 2¹⁶ × 2¹⁶ cells; those in one keep their order."""
    return (np.sort(_curve_keys(points)) & 0xFFFFFFFF).astype(np.int32)


@kernel
def _insertion_round(k: int) -> int:
    """Return how many rounds before the last point k is inserted, by a hash of k."""
    z = (np.uint64(k) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    rounds = 0
    while rounds < 31 and z & np.uint64((1 << ROUND_BITS) - 1) == 0:
        z >>= np.uint64(ROUND_BITS)
        rounds += 1
    return rounds


@kernel_that_allocates
def insertion_order(n: int) -> IntArray:
    """Permute sorted sites into ever larger random samples, each in order; always the same way."""
    # Biased randomized insertion order, which no arrangement of the sites can spoil: Amenta,
    # Choi and Rote 2003, Proc. 19th Symp. Computational Geometry, 211.
    starts = np.zeros(33, dtype=np.int64)
    for k in range(n):
        starts[32 - _insertion_round(k)] += 1
    total = 0
    for r in range(33):
        total, starts[r] = total + starts[r], total
    order = np.empty(n, dtype=np.int64)
    for k in range(n):
        r = 32 - _insertion_round(k)
        order[starts[r]] = k
        starts[r] += 1
    return order
