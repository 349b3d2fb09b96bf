"""A C¹ surface as a linear map of the values at its sites, for many sets of values.

The same surface as `napari_shadowinv.geometry.interpolation` makes, whose geometry is worked out
once: its gradients and its values anywhere are then sums over the values of a few sites.

- gradients at the sites, by values there: `gradient_map`
- the surface anywhere, by values and gradients at the corners of triangles: `corner_weights`
- triangles between sites and what makes gradients of values on them: `triangles_of`, `normals`
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import block_array, csr_array, diags_array, vstack

from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry._kernel import njit
from napari_shadowinv.geometry._mesh import Indices
from napari_shadowinv.geometry.interpolation import (
    BLOCK,
    PATCH,
    arrays_of,
    fill_patch,
    locate,
    nearest_corner,
    value_on_patch,
)
from napari_shadowinv.geometry.triangulation import RegularTriangulation

__all__ = ["corner_weights", "gradient_map", "normals", "triangles_of"]


def triangles_of(triangulation: RegularTriangulation) -> tuple[Indices, FloatArray, FloatArray]:
    """Corners of the triangles between sites, the edges opposite to them, and double areas."""
    corners = triangulation.vertices
    corners = corners[(corners < len(triangulation.sites)).all(axis=1)]
    points = triangulation.sites[corners]
    edges = np.roll(points, -2, axis=1) - np.roll(points, -1, axis=1)
    return corners, edges, edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]


def normals(edges: FloatArray) -> FloatArray:
    """Edges turned by a right angle: each corner's value times that sums to the gradient."""
    return np.stack([-edges[..., 1], edges[..., 0]], axis=-1)


def gradient_map(triangulation: RegularTriangulation) -> csr_array:
    """Return what makes gradients, (2 n,), of values at the n sites: all along y, then along x.

    They are those of `fit_gradients`, begun with the mean of the triangles around each site.
    """
    begin = _mean_gradients(triangulation)
    n = len(triangulation.sites)
    corners, edges, _ = triangles_of(triangulation)
    # Each edge between two sites, in both directions and once.
    first, second = np.roll(corners, -1, axis=1).ravel(), np.roll(corners, -2, axis=1).ravel()
    pairs = np.concatenate([first * np.int64(n) + second, second * np.int64(n) + first])
    here, there = np.divmod(np.unique(pairs), n)
    edges = triangulation.sites[there] - triangulation.sites[here]
    stiff = edges * ((edges**2).sum(axis=1) ** -1.5)[:, None]
    yy, yx, xx = (
        np.bincount(here, stiff[:, i] * edges[:, j], n) for i, j in ((0, 0), (0, 1), (1, 1))
    )
    determinant = yy * xx - yx * yx
    fitted = determinant > 1e-12 * (yy + xx) ** 2
    scale = np.where(fitted, 0.5 / np.where(fitted, determinant, 1.0), 0.0)
    pull_y = scale[here] * (xx[here] * stiff[:, 0] - yx[here] * stiff[:, 1])
    pull_x = scale[here] * (yy[here] * stiff[:, 1] - yx[here] * stiff[:, 0])

    def between(pulls: FloatArray) -> csr_array:
        return csr_array((pulls, (here, there)), shape=(n, n))

    by_values = vstack(
        [3 * between(p) - diags_array(3 * np.bincount(here, p, n)) for p in (pull_y, pull_x)]
    )
    kept = diags_array(np.where(fitted, 0.0, 1.0))
    by_gradients = block_array(
        [
            [kept - between(pull_y * edges[:, 0]), -between(pull_y * edges[:, 1])],
            [-between(pull_x * edges[:, 0]), kept - between(pull_x * edges[:, 1])],
        ],
        format="csr",
    )
    return csr_array(by_values + by_gradients @ begin)


def _mean_gradients(triangulation: RegularTriangulation) -> csr_array:
    """Return what makes the mean gradient of the triangles around each site, by their areas."""
    n = len(triangulation.sites)
    corners, edges, double = triangles_of(triangulation)
    total = np.bincount(corners.ravel(), np.repeat(np.abs(double), 3), n)
    # The gradient times the double area, at each corner of a triangle by the value at each.
    slopes = normals(edges) * np.sign(double)[:, None, None]
    rows, columns = np.repeat(corners, 3, axis=1).ravel(), np.tile(corners, 3).ravel()
    shares = 1 / np.maximum(total, 1e-300)[rows]
    parts = [np.tile(slopes[..., axis], 3).ravel() * shares for axis in (0, 1)]
    return csr_array(
        (np.concatenate(parts), (np.concatenate([rows, rows + n]), np.tile(columns, 2))),
        shape=(2 * n, n),
    )


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
    """Return which three sites make the surface at each of m points, (m, 3), and how.

    The weights, (m, 3, 3), are for each site those of its value and its gradient along y and x.
    Neighbours in the list should be neighbours in the plane.
    """
    corners, weights = np.zeros((len(queries), 3), np.int32), np.zeros((len(queries), 3, 3))
    mesh = *arrays_of(triangulation), len(triangulation.sites)
    blocks = -(-len(queries) // BLOCK)
    operands = queries, *mesh, corners, weights
    in_ranges(_weigh_corners, blocks, available_threads(threads), *operands, smallest=2)
    return corners, weights
