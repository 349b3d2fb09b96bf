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
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation

__all__ = [
    "BLOCK",
    "PATCH",
    "CloughTocher",
    "fill_patch",
    "fit_gradients",
    "locate",
    "mesh_arrays",
    "nearest_corner",
    "value_on_patch",
    "with_mirror_images",
]

BLOCK = 2048  # queries that share one walk; fixed, so that threads change nothing
PATCH = 31  # numbers that describe the surface over a triangle
_CACHED_PATCHES = 512  # triangles whose patches are remembered


def with_mirror_images(
    sites: FloatArray, shape: tuple[int, int], band: float
) -> tuple[FloatArray, NDArray[np.intp], FloatArray]:
    """Append to the sites the mirror images of those closer than `band` px to the border.

    A site near a corner has three. Returns the k points, the site that each comes from, and the
    sense, shape (k, 2): -1 for the axes along which a point was mirrored, else 1. A mirrored
    gradient is multiplied by it.
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
        gradients = _sweep(*mesh_arrays(triangulation), values, gradients, len(values))
    return gradients


def mesh_arrays(triangulation: RegularTriangulation) -> tuple[Indices, Indices, FloatArray]:
    """Return vertices, neighbours and points of a triangulation, as kernels take them."""
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
            neighbour = neighbors[t, k]
            if neighbour < 0 or neighbour == came_from:
                continue
            a, b = vertices[t, (k + 1) % 3], vertices[t, (k + 2) % 3]
            ey, ex = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            if ey * (x - points[a, 1]) - ex * (y - points[a, 0]) < 0:
                came_from, t = t, neighbour
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
def fill_patch(p: FloatArray, f: FloatArray, g: FloatArray, patch: FloatArray) -> None:
    """Compute the coefficients for `value_on_patch` of the surface over the triangle p.

    Three barycentric coordinates as a y + b x + c; then ordinates: at each vertex, along the edge
    opposite to it near its two ends, inside that edge's patch, on the way from the vertex to
    the centre, next to the centre; and at the centre.
    """
    cy = (p[0, 0] + p[1, 0] + p[2, 0]) / 3
    cx = (p[0, 1] + p[1, 1] + p[2, 1]) / 3
    double_area = (p[1, 0] - p[0, 0]) * (p[2, 1] - p[0, 1]) - (p[1, 1] - p[0, 1]) * (
        p[2, 0] - p[0, 0]
    )
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        patch[k] = (p[i, 1] - p[j, 1]) / double_area
        patch[3 + k] = (p[j, 0] - p[i, 0]) / double_area
        patch[6 + k] = p[i, 0]
        patch[9 + k] = p[i, 1]
        patch[12 + k] = f[k]
        patch[15 + k], patch[18 + k], patch[21 + k] = _edge_ordinates(p, f, g, i, j, cy, cx)
        patch[24 + k] = f[k] + (g[k, 0] * (cy - p[k, 0]) + g[k, 1] * (cx - p[k, 1])) / 3
    for k in range(3):
        inside = patch[21 + (k + 1) % 3] + patch[21 + (k + 2) % 3]
        patch[27 + k] = (patch[24 + k] + inside) / 3
    patch[30] = (patch[27] + patch[28] + patch[29]) / 3


@njit(nogil=True, cache=True)
def value_on_patch(patch: FloatArray, y: float, x: float) -> tuple[float, float]:
    """Return the value at (y, x) of the surface over a triangle, and the point's least coordinate.

    That is negative where the triangle does not hold the point.
    """
    b0 = patch[0] * (y - patch[6]) + patch[3] * (x - patch[9])
    b1 = patch[1] * (y - patch[7]) + patch[4] * (x - patch[10])
    b2 = patch[2] * (y - patch[8]) + patch[5] * (x - patch[11])
    # k is the part that holds the point.
    if b0 <= b1 and b0 <= b2:
        i, j, k, least, u, v = 1, 2, 0, b0, b1 - b0, b2 - b0
    elif b1 <= b2:
        i, j, k, least, u, v = 2, 0, 1, b1, b2 - b1, b0 - b1
    else:
        i, j, k, least, u, v = 0, 1, 2, b2, b0 - b2, b1 - b2
    w = 3 * least
    first, second, inside = patch[15 + k], patch[18 + k], patch[21 + k]
    centre_i, centre_j = patch[24 + i], patch[24 + j]
    beside_i, beside_j = patch[27 + i], patch[27 + j]
    uu, vv, ww, uv, uw, vw = u * u, v * v, w * w, 2 * u * v, 2 * u * w, 2 * v * w
    # de Casteljau: quadratics towards i, j and the centre, then their blend
    to_i = patch[12 + i] * uu + first * uv + second * vv
    to_i += centre_i * uw + inside * vw + beside_i * ww
    to_j = first * uu + second * uv + patch[12 + j] * vv
    to_j += inside * uw + centre_j * vw + beside_j * ww
    to_c = centre_i * uu + inside * uv + centre_j * vv
    to_c += beside_i * uw + beside_j * vw + patch[30] * ww
    return u * to_i + v * to_j + w * to_c, least


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
    """Evaluate blocks `start` to `stop` of the queries."""
    n = values.shape[0]
    p, f, g = np.empty((3, 2)), np.empty(3), np.empty((3, 2))
    patches = np.empty((_CACHED_PATCHES, PATCH))
    triangle_of_slot = np.empty(_CACHED_PATCHES, np.int64)
    for block in range(start, stop):
        # Nothing is left from the block before, so that it does not matter who has worked on it.
        t, patch = 0, patches[0]
        triangle_of_slot[:] = -1
        for q in range(block * BLOCK, min((block + 1) * BLOCK, queries.shape[0])):
            y, x = queries[q]
            if triangle_of_slot[t % _CACHED_PATCHES] == t:
                out[q], least = value_on_patch(patch, y, x)
                if least >= 0:
                    continue
            t = locate(vertices, neighbors, points, t, y, x)
            slot = t % _CACHED_PATCHES
            patch = patches[slot]
            if triangle_of_slot[slot] == t:
                out[q], _ = value_on_patch(patch, y, x)
                continue
            outside = False
            for k in range(3):
                a = vertices[t, k]
                if a >= n:
                    outside = True
                    break
                f[k] = values[a]
                for axis in range(2):
                    p[k, axis], g[k, axis] = points[a, axis], gradients[a, axis]
            if not outside:
                fill_patch(p, f, g, patch)
                triangle_of_slot[slot] = t
                out[q], _ = value_on_patch(patch, y, x)
                continue
            nearest = nearest_corner(vertices[t], points, n, y, x)
            if nearest >= 0:
                out[q] = (
                    values[nearest]
                    + gradients[nearest, 0] * (y - points[nearest, 0])
                    + gradients[nearest, 1] * (x - points[nearest, 1])
                )


@njit(nogil=True, cache=True)
def nearest_corner(corners: Indices, points: FloatArray, n: int, y: float, x: float) -> int:
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
    >>> surface(np.array([[1.0, 2.0], [-1.0, 1.0]]))
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

    def __call__(self, queries: FloatArray) -> FloatArray:
        """Return values, shape (m,), at points (y, x).

        Neighbours in the list should be neighbours in the plane. Outside the sites' hull the
        nearest hull site is continued linearly.
        """
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        if not queries.flags.writeable:  # the kernel is compiled for one type
            queries = queries.copy()
        out = np.zeros(len(queries))
        surface = (*mesh_arrays(self._triangulation), self._values, self._gradients)
        blocks = -(-len(queries) // BLOCK)
        in_ranges(_evaluate_blocks, blocks, self._threads, queries, *surface, out, smallest=2)
        return out
