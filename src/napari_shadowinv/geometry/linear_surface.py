"""A C¹ surface for many sets of values at the same sites, `WIDTH` at a time.

The surface is the same as in `napari_shadowinv.geometry.interpolation`. It is linear in the
values, so the geometry of each triangle and edge is computed once for all sets.

- gradients at the sites, by values there: `with_gradients`
- the surface anywhere, by values and gradients at the corners of triangles: `corner_weights`
"""

from __future__ import annotations

import numpy as np

from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.interpolation import (
    BLOCK,
    PATCH,
    fill_patch,
    locate,
    mesh_arrays,
    nearest_corner,
    value_on_patch,
)
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation

__all__ = ["WIDTH", "corner_weights", "with_gradients"]

WIDTH = 8  # numbers in a cache line; a constant, so that loops are unrolled


@njit(nogil=True, cache=True)
def _mean_slopes(
    vertices: Indices, points: FloatArray, values: FloatArray, gradients: FloatArray
) -> None:
    """Find the mean gradient of the triangles around each site, by their areas."""
    n = values.shape[0]
    areas = np.zeros(n)
    slope = np.empty((2, WIDTH))
    for a, b, c in vertices:
        if a >= n or b >= n or c >= n:
            continue
        by, bx = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        cy, cx = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
        area = by * cx - bx * cy
        sign = 1.0 if area > 0 else -1.0
        for s in range(WIDTH):
            to_b, to_c = values[b, s] - values[a, s], values[c, s] - values[a, s]
            slope[0, s] = sign * (to_b * cx - to_c * bx)
            slope[1, s] = sign * (to_c * by - to_b * cy)
        for i in (a, b, c):
            areas[i] += abs(area)
            for s in range(WIDTH):
                gradients[i, 0, s] += slope[0, s]
                gradients[i, 1, s] += slope[1, s]
    for i in range(n):
        share = 1.0 / max(areas[i], 1e-300)
        for s in range(WIDTH):
            gradients[i, 0, s] *= share
            gradients[i, 1, s] *= share


@njit(nogil=True, cache=True)
def _minimise_bending(
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    values: FloatArray,
    gradients: FloatArray,
    surface: FloatArray,
) -> None:
    """Do the sweep of `fit_gradients`, starting from `gradients`; write values and gradients."""
    n = values.shape[0]
    system = np.zeros((n, 3))
    for t in range(vertices.shape[0]):
        for k in range(3):
            a, b = vertices[t, (k + 1) % 3], vertices[t, (k + 2) % 3]
            if neighbors[t, k] < t or a >= n or b >= n:
                continue
            ey, ex = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            length2 = ey * ey + ex * ex
            stiffness = 1.0 / (length2 * np.sqrt(length2))
            for i, j in ((a, b), (b, a)):
                system[i, 0] += stiffness * ey * ey
                system[i, 1] += stiffness * ey * ex
                system[i, 2] += stiffness * ex * ex
                for s in range(WIDTH):
                    rise = 3 * (values[b, s] - values[a, s])
                    slope_there = gradients[j, 0, s] * ey + gradients[j, 1, s] * ex
                    pull = stiffness * (rise - slope_there) / 2
                    surface[i, 1, s] += pull * ey
                    surface[i, 2, s] += pull * ex
    for i in range(n):
        yy, yx, xx = system[i]
        determinant = yy * xx - yx * yx
        fitted = determinant > 1e-12 * (yy + xx) ** 2
        for s in range(WIDTH):
            surface[i, 0, s] = values[i, s]
            ry, rx = surface[i, 1, s], surface[i, 2, s]
            if fitted:
                surface[i, 1, s] = (ry * xx - rx * yx) / determinant
                surface[i, 2, s] = (rx * yy - ry * yx) / determinant
            else:
                surface[i, 1, s], surface[i, 2, s] = gradients[i, 0, s], gradients[i, 1, s]


def with_gradients(triangulation: RegularTriangulation, values: FloatArray) -> FloatArray:
    """Return `WIDTH` sets of values at n sites, (n, WIDTH), and their gradients: (n, 3, WIDTH).

    The gradients equal `fit_gradients`, started from the mean of the triangles around each site.
    """
    vertices, neighbors, points = mesh_arrays(triangulation)
    gradients = np.zeros((len(values), 2, WIDTH))
    _mean_slopes(vertices, points, values, gradients)
    surface = np.zeros((len(values), 3, WIDTH))
    _minimise_bending(vertices, neighbors, points, values, gradients, surface)
    return surface


@njit(nogil=True, cache=True)
def _weigh_corners(
    start: int,
    stop: int,
    queries: FloatArray,
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    n: int,
    corners: Indices,
    weights: FloatArray,
) -> None:
    """Do blocks `start` to `stop` of the queries."""
    p, f, g, patch = np.empty((3, 2)), np.zeros(3), np.zeros((3, 2)), np.empty(PATCH)
    for block in range(start, stop):
        t = 0
        for q in range(block * BLOCK, min((block + 1) * BLOCK, queries.shape[0])):
            y, x = queries[q]
            t = locate(vertices, neighbors, points, t, y, x)
            a, b, c = vertices[t]
            if a < n and b < n and c < n:
                p[0], p[1], p[2] = points[a], points[b], points[c]
                corners[q, 0], corners[q, 1], corners[q, 2] = a, b, c
                for k in range(3):
                    f[k] = 1.0
                    fill_patch(p, f, g, patch)
                    weights[q, k, 0], _ = value_on_patch(patch, y, x)
                    f[k] = 0.0
                    for axis in range(2):
                        g[k, axis] = 1.0
                        fill_patch(p, f, g, patch)
                        weights[q, k, 1 + axis], _ = value_on_patch(patch, y, x)
                        g[k, axis] = 0.0
                continue
            nearest = nearest_corner(vertices[t], points, n, y, x)
            if nearest >= 0:
                corners[q] = nearest
                weights[q, 0, 0] = 1.0
                weights[q, 0, 1] = y - points[nearest, 0]
                weights[q, 0, 2] = x - points[nearest, 1]


def corner_weights(
    triangulation: RegularTriangulation, queries: FloatArray, threads: int | None = None
) -> tuple[Indices, FloatArray]:
    """Return the three sites that determine the surface at each of m points, and their weights.

    The sites have shape (m, 3). The weights, (m, 3, 3), multiply each site's value and its
    gradient along y and x. Neighbours in the list should be neighbours in the plane.
    """
    corners, weights = np.zeros((len(queries), 3), np.int32), np.zeros((len(queries), 3, 3))
    mesh = *mesh_arrays(triangulation), len(triangulation.sites)
    blocks = -(-len(queries) // BLOCK)
    operands = queries, *mesh, corners, weights
    in_ranges(_weigh_corners, blocks, available_threads(threads), *operands, smallest=2)
    return corners, weights
