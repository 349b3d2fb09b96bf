"""Sibson's natural-neighbour interpolation: `natural_neighbor`.

A point that is added to a Voronoi diagram takes its cell from its neighbours; the shares
of the area that each of them gives are the weights of their values. The result is
continuous, smooth but at the sites, and exact for linear functions.

References
----------
R. Sibson, "A brief description of natural neighbour interpolation" (1981); paper,
section III.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.interpolation import BLOCK, locate, mesh_arrays
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation

__all__ = ["natural_neighbor"]

_LARGEST_CAVITY = 256


@njit(nogil=True, cache=True)
def _circumcentre(
    ay: float, ax: float, by: float, bx: float, cy: float, cx: float
) -> tuple[float, float]:
    """Return the circumcentre relative to a; far away where the points are in line."""
    by, bx, cy, cx = by - ay, bx - ax, cy - ay, cx - ax
    double_area = by * cx - bx * cy
    if double_area == 0.0:
        double_area = 1e-300
    b2 = 0.5 * (by * by + bx * bx)
    c2 = 0.5 * (cy * cy + cx * cx)
    return (b2 * cx - c2 * bx) / double_area, (c2 * by - b2 * cy) / double_area


@njit(nogil=True, cache=True)
def _circle_holds(points: FloatArray, corners: Indices, y: float, x: float) -> bool:
    """Return whether (y, x) lies inside the circumcircle of a counter-clockwise triangle."""
    a, b, c = corners[0], corners[1], corners[2]
    ay, ax = points[a, 0] - y, points[a, 1] - x
    by, bx = points[b, 0] - y, points[b, 1] - x
    cy, cx = points[c, 0] - y, points[c, 1] - x
    a2, b2, c2 = ay * ay + ax * ax, by * by + bx * bx, cy * cy + cx * cx
    signed = a2 * (by * cx - bx * cy) + b2 * (cy * ax - cx * ay) + c2 * (ay * bx - ax * by)
    return bool(signed > 0)


@njit(nogil=True, cache=True)
def _cavity(
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    start: int,
    y: float,
    x: float,
    cavity: Indices,
) -> int:
    """List the triangles whose circumcircles hold (y, x), from the one around it."""
    cavity[0] = start
    count, done = 1, 0
    while done < count and count < cavity.shape[0]:
        t = cavity[done]
        done += 1
        for k in range(3):
            neighbour = neighbors[t, k]
            if neighbour < 0 or _index_of(cavity, count, neighbour) >= 0:
                continue
            if count < cavity.shape[0] and _circle_holds(points, vertices[neighbour], y, x):
                cavity[count] = neighbour
                count += 1
    return count


@njit(nogil=True, cache=True)
def _index_of(items: Indices, count: int, item: int) -> int:
    for i in range(count):
        if items[i] == item:
            return i
    return -1


@njit(nogil=True, cache=True)
def _stolen_area(
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    cavity: Indices,
    count: int,
    t: int,
    k: int,
    y: float,
    x: float,
) -> tuple[int, float]:
    """Return the end b of a rim edge of the cavity, and the area that it gives to (y, x)."""
    # The edge is the one opposite corner k of triangle t. Around b lie the centre of the new
    # triangle on this edge, those of the cavity's triangles at b, and the centre of the new
    # triangle on the next rim edge.
    a, b = vertices[t, (k + 1) % 3], vertices[t, (k + 2) % 3]
    by, bx = points[b, 0], points[b, 1]
    first_y, first_x = _circumcentre(by, bx, y, x, points[a, 0], points[a, 1])
    last_y, last_x = first_y, first_x
    double_area = 0.0
    pivot = (k + 2) % 3
    while True:
        i, j = (pivot + 1) % 3, (pivot + 2) % 3
        c, d = vertices[t, i], vertices[t, j]
        centre_y, centre_x = _circumcentre(
            by, bx, points[c, 0], points[c, 1], points[d, 0], points[d, 1]
        )
        double_area += last_y * centre_x - last_x * centre_y
        last_y, last_x = centre_y, centre_x
        # cross the edge from b to corner i, towards the rest of b's cavity triangles
        neighbour = neighbors[t, j]
        if neighbour < 0 or _index_of(cavity, count, neighbour) < 0:
            break
        t = neighbour
        pivot = 0
        while vertices[t, pivot] != b:
            pivot += 1
    new_y, new_x = _circumcentre(by, bx, y, x, points[c, 0], points[c, 1])
    double_area += last_y * new_x - last_x * new_y
    double_area += new_y * first_x - new_x * first_y
    return b, abs(double_area)


@njit(nogil=True, cache=True)
def _interpolate_blocks(
    start: int,
    stop: int,
    queries: FloatArray,
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    values: FloatArray,
    out: FloatArray,
) -> None:
    """Interpolate blocks `start` to `stop` of the queries."""
    n = values.shape[0]
    cavity = np.empty(_LARGEST_CAVITY, np.int32)
    for block in range(start, stop):
        t = 0
        for q in range(block * BLOCK, min((block + 1) * BLOCK, queries.shape[0])):
            y, x = queries[q]
            t = locate(vertices, neighbors, points, t, y, x)
            met = -1
            for k in range(3):
                corner = vertices[t, k]
                if corner < n and points[corner, 0] == y and points[corner, 1] == x:
                    met = corner
            if met >= 0:
                out[q] = values[met]
                continue
            count = _cavity(vertices, neighbors, points, t, y, x, cavity)
            total = 0.0
            out[q] = 0.0
            for c in range(count):
                for k in range(3):
                    neighbour = neighbors[cavity[c], k]
                    if neighbour >= 0 and _index_of(cavity, count, neighbour) >= 0:
                        continue
                    site, area = _stolen_area(
                        vertices, neighbors, points, cavity, count, cavity[c], k, y, x
                    )
                    if site < n:
                        total += area
                        out[q] += area * values[site]
            if total > 0:
                out[q] /= total


def natural_neighbor(
    triangulation: RegularTriangulation,
    values: ArrayLike,
    queries: ArrayLike,
    *,
    threads: int | None = None,
) -> FloatArray:
    """Interpolate values, shape (n, ...), at the sites of a mesh, at points (y, x) in their hull.

    The mesh is a Delaunay triangulation.

    >>> corners = np.array([[0.0, 0.0], [0.0, 4.0], [4.0, 0.0], [4.0, 4.0]])
    >>> natural_neighbor(RegularTriangulation(corners), corners[:, 0], [[1.0, 2.5]])
    array([1.])
    """
    at_sites = np.asarray(values, dtype=np.float64)
    points = np.ascontiguousarray(queries, dtype=np.float64)
    columns = at_sites.reshape(len(at_sites), -1)
    out = np.empty((len(points), columns.shape[1]))
    for column in range(columns.shape[1]):
        result = np.empty(len(points))
        surface = (*mesh_arrays(triangulation), np.ascontiguousarray(columns[:, column]))
        work = -(-len(points) // BLOCK), available_threads(threads), points
        in_ranges(_interpolate_blocks, *work, *surface, result, smallest=2)
        out[:, column] = result
    return out.reshape(len(points), *at_sites.shape[1:])
