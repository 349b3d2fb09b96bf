"""A C¹ surface through scattered values with gradients.

- interpolate: `CloughTocher`
- better gradients from rough ones: `fit_gradients`

Clough and Tocher's triangle: each Delaunay triangle is cut at its centroid into three
cubic Bézier patches. Values and gradients are met at the sites, and the derivative
across each edge is linear along it, so neighbours join with continuous gradients. To
reach beyond the outermost sites, those near the border can be mirrored across it.

References
----------
R. W. Clough and J. L. Tocher, "Finite element stiffness matrices for analysis of plates
in bending" (1965); P. Alfeld, Computer Aided Geometric Design 1, 169 (1984); for the
gradients G. M. Nielson, Mathematics of Computation 40, 253 (1983).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.machine import available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry._kernel import njit
from napari_shadowinv.geometry._mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation

__all__ = ["BLOCK", "CloughTocher", "arrays_of", "fit_gradients", "locate", "with_mirror_images"]

BLOCK = 2048  # queries that share one walk; fixed, so that threads change nothing


def with_mirror_images(
    sites: FloatArray, shape: tuple[int, int], band: float
) -> tuple[FloatArray, NDArray[np.intp], FloatArray]:
    """Append to the sites the images of those closer than `band` px to the border, across it.

    A site near a corner has three. Returns the k points, the site that each comes from, and the
    sense, shape (k, 2): -1 for the axes along which a point was mirrored, else 1, which is what a
    mirrored gradient is multiplied by.
    """
    points, origin, sense = sites, np.arange(len(sites)), np.ones_like(sites)
    for axis in (0, 1):
        images, origins, senses = [points], [origin], [sense]
        for wall in (-0.5, shape[axis] - 0.5):
            near = np.abs(points[:, axis] - wall) < band
            image = points[near].copy()
            image[:, axis] = 2 * wall - image[:, axis]
            images.append(image)
            origins.append(origin[near])
            senses.append(sense[near] * (1 - 2 * np.eye(2)[axis]))
        points, origin = np.concatenate(images), np.concatenate(origins)
        sense = np.concatenate(senses)
    return points, origin, sense


@njit(nogil=True, cache=True)
def _sweep(
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    values: FloatArray,
    gradients: FloatArray,
    n: int,
) -> FloatArray:
    """Make one Jacobi sweep towards the gradients of least bending along the edges."""
    system = np.zeros((n, 5))
    for t in range(vertices.shape[0]):
        for k in range(3):
            a, b = vertices[t, (k + 1) % 3], vertices[t, (k + 2) % 3]
            if neighbors[t, k] < t or a >= n or b >= n:
                continue
            ey, ex = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            length2 = ey * ey + ex * ex
            stiffness = 1.0 / (length2 * np.sqrt(length2))
            rise = 3 * (values[b] - values[a])
            for i, j in ((a, b), (b, a)):
                slope_there = gradients[j, 0] * ey + gradients[j, 1] * ex
                pull = stiffness * (rise - slope_there) / 2
                system[i, 0] += stiffness * ey * ey
                system[i, 1] += stiffness * ey * ex
                system[i, 2] += stiffness * ex * ex
                system[i, 3] += pull * ey
                system[i, 4] += pull * ex
    fitted = gradients.copy()
    for i in range(n):
        yy, yx, xx, ry, rx = system[i]
        determinant = yy * xx - yx * yx
        if determinant > 1e-12 * (yy + xx) ** 2:
            fitted[i, 0] = (ry * xx - rx * yx) / determinant
            fitted[i, 1] = (rx * yy - ry * yx) / determinant
    return fitted


def fit_gradients(
    triangulation: RegularTriangulation, values: FloatArray, gradients: FloatArray, sweeps: int = 1
) -> FloatArray:
    """Improve gradients at the sites so that the surface bends least along the edges."""
    for _ in range(sweeps):
        gradients = _sweep(*arrays_of(triangulation), values, gradients, len(values))
    return gradients


def arrays_of(triangulation: RegularTriangulation) -> tuple[Indices, Indices, FloatArray]:
    """Return what kernels want to know of a triangulation."""
    return triangulation.vertices, triangulation.neighbors, triangulation.points


@njit(nogil=True, cache=True)
def locate(
    vertices: Indices, neighbors: Indices, points: FloatArray, start: int, y: float, x: float
) -> int:
    """Walk to the triangle that holds (y, x)."""
    t, came_from = start, -1
    for _ in range(2 * vertices.shape[0] + 10):
        moved = False
        for k in range(3):
            other = neighbors[t, k]
            if other < 0 or other == came_from:
                continue
            a, b = vertices[t, (k + 1) % 3], vertices[t, (k + 2) % 3]
            ey, ex = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            if ey * (x - points[a, 1]) - ex * (y - points[a, 0]) < 0:
                came_from, t = t, other
                moved = True
                break
        if not moved:
            break
    return t


@njit(nogil=True, cache=True)
def _edge_ordinates(
    p: FloatArray, f: FloatArray, g: FloatArray, i: int, j: int, cy: float, cx: float
) -> tuple[float, float, float]:
    """Return the Bézier ordinates on edge i-j, near i and near j, and inside its patch."""
    ey, ex = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1]
    near_i = f[i] + (g[i, 0] * ey + g[i, 1] * ex) / 3
    near_j = f[j] - (g[j, 0] * ey + g[j, 1] * ex) / 3
    s = ((cy - p[i, 0]) * ey + (cx - p[i, 1]) * ex) / (ey * ey + ex * ex)
    ny, nx = cy - p[i, 0] - s * ey, cx - p[i, 1] - s * ex
    across = ((g[i, 0] + g[j, 0]) * ny + (g[i, 1] + g[j, 1]) * nx) / 6
    return near_i, near_j, across + (1 - s) * near_i + s * near_j


@njit(nogil=True, cache=True)
def _patch(
    p: FloatArray, f: FloatArray, g: FloatArray, y: float, x: float
) -> tuple[float, float, float]:
    """Return value and gradient at (y, x) of the surface over the triangle p."""
    cy = (p[0, 0] + p[1, 0] + p[2, 0]) / 3
    cx = (p[0, 1] + p[1, 1] + p[2, 1]) / 3
    double_area = (p[1, 0] - p[0, 0]) * (p[2, 1] - p[0, 1]) - (p[1, 1] - p[0, 1]) * (
        p[2, 0] - p[0, 0]
    )
    bary = np.empty(3)
    slope = np.empty((3, 2))  # gradient of each barycentric coordinate
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        bary[k] = ((p[i, 0] - y) * (p[j, 1] - x) - (p[i, 1] - x) * (p[j, 0] - y)) / double_area
        slope[k, 0] = (p[i, 1] - p[j, 1]) / double_area
        slope[k, 1] = (p[j, 0] - p[i, 0]) / double_area

    # ordinates: along edge k (opposite vertex k) near its two ends, and inside its patch
    near_first, near_second, inside = np.empty(3), np.empty(3), np.empty(3)
    to_centre, by_centre = np.empty(3), np.empty(3)
    for k in range(3):
        near_first[k], near_second[k], inside[k] = _edge_ordinates(
            p, f, g, (k + 1) % 3, (k + 2) % 3, cy, cx
        )
        to_centre[k] = f[k] + (g[k, 0] * (cy - p[k, 0]) + g[k, 1] * (cx - p[k, 1])) / 3
    for k in range(3):
        by_centre[k] = (to_centre[k] + inside[(k + 1) % 3] + inside[(k + 2) % 3]) / 3
    centre = (by_centre[0] + by_centre[1] + by_centre[2]) / 3

    k = int(np.argmin(bary))  # the patch that holds the point
    i, j = (k + 1) % 3, (k + 2) % 3
    u, v, w = bary[i] - bary[k], bary[j] - bary[k], 3 * bary[k]
    # de Casteljau: quadratics towards i, j and the centre, then their blend
    to_i = (
        f[i] * u * u
        + 2 * near_first[k] * u * v
        + near_second[k] * v * v
        + 2 * to_centre[i] * u * w
        + 2 * inside[k] * v * w
        + by_centre[i] * w * w
    )
    to_j = (
        near_first[k] * u * u
        + 2 * near_second[k] * u * v
        + f[j] * v * v
        + 2 * inside[k] * u * w
        + 2 * to_centre[j] * v * w
        + by_centre[j] * w * w
    )
    to_c = (
        to_centre[i] * u * u
        + 2 * inside[k] * u * v
        + to_centre[j] * v * v
        + 2 * by_centre[i] * u * w
        + 2 * by_centre[j] * v * w
        + centre * w * w
    )
    value = u * to_i + v * to_j + w * to_c
    dy = 3 * (
        (slope[i, 0] - slope[k, 0]) * to_i
        + (slope[j, 0] - slope[k, 0]) * to_j
        + 3 * slope[k, 0] * to_c
    )
    dx = 3 * (
        (slope[i, 1] - slope[k, 1]) * to_i
        + (slope[j, 1] - slope[k, 1]) * to_j
        + 3 * slope[k, 1] * to_c
    )
    return value, dy, dx


@njit(nogil=True, cache=True)
def _evaluate_blocks(
    start: int,
    stop: int,
    queries: FloatArray,
    vertices: Indices,
    neighbors: Indices,
    points: FloatArray,
    values: FloatArray,
    gradients: FloatArray,
    out: FloatArray,
) -> None:
    """Evaluate blocks `start` to `stop` of the queries: value, ∂/∂y, ∂/∂x."""
    n = values.shape[0]
    p, f, g = np.empty((3, 2)), np.empty(3), np.empty((3, 2))
    for block in range(start, stop):
        t = 0
        for q in range(block * BLOCK, min((block + 1) * BLOCK, queries.shape[0])):
            y, x = queries[q]
            t = locate(vertices, neighbors, points, t, y, x)
            outside = -1
            for k in range(3):
                a = vertices[t, k]
                if a >= n:
                    outside = k
                    continue
                p[k], f[k], g[k] = points[a], values[a], gradients[a]
            if outside < 0:
                out[q, 0], out[q, 1], out[q, 2] = _patch(p, f, g, y, x)
                continue
            nearest = _nearest_corner(vertices[t], points, n, y, x)
            if nearest >= 0:
                out[q, 1] = gradients[nearest, 0]
                out[q, 2] = gradients[nearest, 1]
                out[q, 0] = (
                    values[nearest]
                    + out[q, 1] * (y - points[nearest, 0])
                    + out[q, 2] * (x - points[nearest, 1])
                )


@njit(nogil=True, cache=True)
def _nearest_corner(corners: Indices, points: FloatArray, n: int, y: float, x: float) -> int:
    """Return the corner nearest to (y, x) that is a site, or -1 between ghosts alone."""
    nearest, least = -1, np.inf
    for a in corners:
        if a < n:
            distance = (points[a, 0] - y) ** 2 + (points[a, 1] - x) ** 2
            if distance < least:
                nearest, least = a, distance
    return nearest


class CloughTocher:
    """C¹ interpolant of values, shape (n,), and gradients, shape (n, 2), at the sites of a mesh.

    The mesh is a Delaunay triangulation. A plane is met exactly, also beyond the sites:

    >>> sites = np.array([[0.0, 0.0], [0.0, 3.0], [3.0, 0.0], [3.0, 4.0]])
    >>> upwards = np.tile([1.0, 0.0], (4, 1))
    >>> surface = CloughTocher(RegularTriangulation(sites), sites[:, 0], upwards)
    >>> surface(np.array([[1.0, 2.0], [-1.0, 1.0]]))[0]
    array([ 1., -1.])
    """

    def __init__(
        self,
        triangulation: RegularTriangulation,
        values: FloatArray,
        gradients: FloatArray,
        *,
        threads: int | None = None,
    ) -> None:
        self._triangulation = triangulation
        self._values = np.ascontiguousarray(values, dtype=np.float64)
        self._gradients = np.ascontiguousarray(gradients, dtype=np.float64)
        self._threads = available_threads(threads)

    def __call__(self, queries: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return values, shape (m,), and gradients, shape (m, 2), at points (y, x).

        Neighbours in the list should be neighbours in the plane. Outside the sites' hull the
        nearest hull site is continued linearly.
        """
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        out = np.zeros((len(queries), 3))
        surface = (*arrays_of(self._triangulation), self._values, self._gradients)
        blocks = -(-len(queries) // BLOCK)
        in_ranges(_evaluate_blocks, blocks, self._threads, queries, *surface, out, smallest=2)
        return out[:, 0], out[:, 1:]
