"""Surfaces through scattered values.

- a C¹ surface through values with gradients: `CloughTocher`; the same for many sets of values at
  the same sites, `WIDTH` at a time: `corner_weights`, with gradients by `with_gradients`
- better gradients from rough ones: `fit_gradients`

Clough and Tocher's triangle: each Delaunay triangle is cut at its centroid into three
cubic Bézier patches. Values and gradients are met at the sites, and the derivative
across each edge is linear along it, so neighbours join with continuous gradients. To
reach beyond the outermost sites, those near the border can be mirrored across it. The surface is
linear in the values, so the geometry of each triangle and edge is computed once for many sets.

References
----------
R. W. Clough and J. L. Tocher, "Finite element stiffness matrices for analysis of plates
in bending" (1965); P. Alfeld, Computer Aided Geometric Design 1, 169 (1984); for the
gradients G. M. Nielson, Mathematics of Computation 40, 253 (1983).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.machine import LIGHT_ITEMS, available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import kernel, njit
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation

BLOCK = 2048  # queries that share one walk; fixed, so that threads change nothing
WIDTH = 8  # numbers in a cache line
_PATCH = 31  # numbers that describe the surface over a triangle
_CACHED_PATCHES = 512  # triangles whose patches are remembered
_EDGE_PX = 1e-6  # beyond a triangle's edges, and still within it
STRIP_PX = 32  # rows whose triangles are looked through together


class _Mesh(NamedTuple):
    """A triangulation, as kernels take it."""

    vertices: Indices
    neighbors: Indices
    points: FloatArray

    @classmethod
    def of(cls, triangulation: RegularTriangulation) -> _Mesh:
        return cls(triangulation.vertices, triangulation.neighbors, triangulation.points)


class _Surface(NamedTuple):
    """Values and gradients at the sites of a mesh."""

    mesh: _Mesh
    values: FloatArray
    gradients: FloatArray


def _in_blocks(
    run: Callable[..., None], queries: FloatArray, threads: int | None, *operands: Any
) -> None:
    """Call a kernel on ranges of the blocks of queries."""
    blocks = -(-len(queries) // BLOCK)
    threads = available_threads(threads)
    in_ranges(run, blocks, threads, queries, *operands, smallest=4, uneven=True)


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
def _minimise_bending(start: int, stop: int, surface: _Surface, fitted: FloatArray) -> None:
    """Make one Jacobi sweep towards the gradients of least bending along the edges.

    For sites `start` to `stop`, with k sets of values (n, k) and gradients (n, 2, k). Both are
    written to `fitted`, (n, 3, k).
    """
    (vertices, neighbors, points), values, gradients = surface
    n, width = values.shape
    system = np.zeros((stop - start, 3))
    for t in range(vertices.shape[0]):
        for k in range(3):
            a, b = vertices[t, (k + 1) % 3], vertices[t, (k + 2) % 3]
            if neighbors[t, k] < t or a >= n or b >= n:
                continue
            if not (start <= a < stop or start <= b < stop):
                continue
            ey, ex = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
            length2 = ey * ey + ex * ex
            stiffness = 1.0 / (length2 * np.sqrt(length2))
            for i, j in ((a, b), (b, a)):
                if not start <= i < stop:
                    continue
                system[i - start, 0] += stiffness * ey * ey
                system[i - start, 1] += stiffness * ey * ex
                system[i - start, 2] += stiffness * ex * ex
                for s in range(width):
                    rise = 3 * (values[b, s] - values[a, s])
                    slope_there = gradients[j, 0, s] * ey + gradients[j, 1, s] * ex
                    pull = stiffness * (rise - slope_there) / 2
                    fitted[i, 1, s] += pull * ey
                    fitted[i, 2, s] += pull * ex
    for i in range(start, stop):
        yy, yx, xx = system[i - start]
        determinant = yy * xx - yx * yx
        is_determined = determinant > 1e-12 * (yy + xx) ** 2
        for s in range(width):
            fitted[i, 0, s] = values[i, s]
            ry, rx = fitted[i, 1, s], fitted[i, 2, s]
            if is_determined:
                fitted[i, 1, s] = (ry * xx - rx * yx) / determinant
                fitted[i, 2, s] = (rx * yy - ry * yx) / determinant
            else:
                fitted[i, 1, s], fitted[i, 2, s] = gradients[i, 0, s], gradients[i, 1, s]


def with_gradients(triangulation: RegularTriangulation, values: FloatArray) -> FloatArray:
    """Return `WIDTH` sets of values at n sites, (n, WIDTH), and their gradients: (n, 3, WIDTH).

    The gradients equal `fit_gradients`, started from the mean of the triangles around each site.
    """
    gradients = np.zeros((len(values), 2, WIDTH))
    _mean_slopes(triangulation.vertices, triangulation.points, values, gradients)
    return _bend_least(_Surface(_Mesh.of(triangulation), values, gradients))


@njit(nogil=True, cache=True)
def _weigh_corners(
    start: int, stop: int, queries: FloatArray, mesh: _Mesh, corners: Indices, weights: FloatArray
) -> None:
    """Do blocks `start` to `stop` of the queries."""
    vertices, _, points = mesh
    n = points.shape[0] - 4  # ghosts come last
    p, f, g, patch = np.empty((3, 2)), np.zeros(3), np.zeros((3, 2)), np.empty(_PATCH)
    for block in range(start, stop):
        t = 0
        for q in range(block * BLOCK, min((block + 1) * BLOCK, queries.shape[0])):
            y, x = queries[q]
            t = _locate(mesh, t, y, x)
            a, b, c = vertices[t]
            if a < n and b < n and c < n:
                p[0], p[1], p[2] = points[a], points[b], points[c]
                corners[q, 0], corners[q, 1], corners[q, 2] = a, b, c
                for k in range(3):
                    f[k] = 1.0
                    _fill_patch(p, f, g, patch)
                    weights[q, k, 0], _ = _value_on_patch(patch, y, x)
                    f[k] = 0.0
                    for axis in range(2):
                        g[k, axis] = 1.0
                        _fill_patch(p, f, g, patch)
                        weights[q, k, 1 + axis], _ = _value_on_patch(patch, y, x)
                        g[k, axis] = 0.0
                continue
            nearest = _nearest_corner(vertices[t], points, n, y, x)
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
    _in_blocks(_weigh_corners, queries, threads, _Mesh.of(triangulation), corners, weights)
    return corners, weights


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


def fit_gradients(
    triangulation: RegularTriangulation,
    values: FloatArray,
    gradients: FloatArray,
    threads: int | None = 1,
) -> FloatArray:
    """Improve gradients at the sites so that the surface bends less along the edges."""
    surface = _Surface(_Mesh.of(triangulation), values[:, None], gradients[:, :, None])
    return np.ascontiguousarray(_bend_least(surface, threads)[:, 1:, 0])


def _bend_least(surface: _Surface, threads: int | None = 1) -> FloatArray:
    n, width = surface.values.shape
    fitted = np.zeros((n, 3, width))
    threads = available_threads(threads)
    in_ranges(_minimise_bending, n, threads, surface, fitted, smallest=LIGHT_ITEMS)
    return fitted


@kernel
def _locate(mesh: _Mesh, start: int, y: float, x: float) -> int:
    """Walk to the triangle that holds (y, x)."""
    vertices, neighbors, points = mesh
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
def _fill_patch(p: FloatArray, f: FloatArray, g: FloatArray, patch: FloatArray) -> None:
    """Compute the coefficients for `_value_on_patch` of the surface over the triangle p.

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


@njit(nogil=True, cache=True, inline="always")
def _patch_coordinates(patch: FloatArray, y: float, x: float) -> tuple[float, float, float]:
    """Return the barycentric coordinates of (y, x) in the triangle of a patch."""
    return (
        patch[0] * (y - patch[6]) + patch[3] * (x - patch[9]),
        patch[1] * (y - patch[7]) + patch[4] * (x - patch[10]),
        patch[2] * (y - patch[8]) + patch[5] * (x - patch[11]),
    )


@njit(nogil=True, cache=True)
def _value_on_patch(patch: FloatArray, y: float, x: float) -> tuple[float, float]:
    """Return the value at (y, x) of the surface over a triangle, and the point's least coordinate.

    That is negative where the triangle does not hold the point.
    """
    b0, b1, b2 = _patch_coordinates(patch, y, x)
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
    start: int, stop: int, queries: FloatArray, surface: _Surface, out: FloatArray
) -> None:
    """Evaluate blocks `start` to `stop` of the queries."""
    mesh, values, _ = surface
    vertices, n = mesh.vertices, values.shape[0]
    p, f, g = np.empty((3, 2)), np.empty(3), np.empty((3, 2))
    patches = np.empty((_CACHED_PATCHES, _PATCH))
    triangle_of_slot = np.empty(_CACHED_PATCHES, np.int64)
    for block in range(start, stop):
        # Nothing is left from the block before, so that it does not matter who has worked on it.
        t, patch = 0, patches[0]
        triangle_of_slot[:] = -1
        for q in range(block * BLOCK, min((block + 1) * BLOCK, queries.shape[0])):
            y, x = queries[q]
            if triangle_of_slot[t % _CACHED_PATCHES] == t:
                out[q], least = _value_on_patch(patch, y, x)
                if least >= 0:
                    continue
            t = _locate(mesh, t, y, x)
            slot = t % _CACHED_PATCHES
            patch = patches[slot]
            if triangle_of_slot[slot] == t:
                out[q], _ = _value_on_patch(patch, y, x)
                continue
            if max(vertices[t, 0], vertices[t, 1], vertices[t, 2]) < n:
                _gather_corners(surface, t, p, f, g)
                _fill_patch(p, f, g, patch)
                triangle_of_slot[slot] = t
                out[q], _ = _value_on_patch(patch, y, x)
            else:
                out[q] = _value_beyond(surface, t, y, x)


@kernel
def _gather_corners(surface: _Surface, t: int, p: FloatArray, f: FloatArray, g: FloatArray) -> None:
    """Copy positions, values and gradients at the corners of a triangle."""
    (vertices, _, points), values, gradients = surface
    for k in range(3):
        a = vertices[t, k]
        f[k] = values[a]
        for axis in range(2):
            p[k, axis], g[k, axis] = points[a, axis], gradients[a, axis]


@kernel
def _value_beyond(surface: _Surface, t: int, y: float, x: float) -> float:
    """Return the value outside the sites' hull, by the gradient at the nearest corner of t."""
    (vertices, _, points), values, gradients = surface
    nearest = _nearest_corner(vertices[t], points, values.shape[0], y, x)
    if nearest < 0:
        return 0.0
    rise_y = gradients[nearest, 0] * (y - points[nearest, 0])
    rise_x = gradients[nearest, 1] * (x - points[nearest, 1])
    return float(values[nearest] + rise_y + rise_x)


@njit(nogil=True, cache=True)
def _triangles_by_strip(
    vertices: Indices, points: FloatArray, n: int, shape: tuple[int, int]
) -> tuple[Indices, Indices]:
    """Sort triangles by the strips of rows that they reach: where each strip begins, and them."""
    height, width = shape
    strips = -(-height // STRIP_PX)
    starts = np.zeros(strips + 1, np.int32)
    members = np.empty(0, np.int32)
    for listing in range(2):
        for t in range(vertices.shape[0]):
            a, b, c = vertices[t, 0], vertices[t, 1], vertices[t, 2]
            if a >= n or b >= n or c >= n:
                continue
            xa, xb, xc = points[a, 1], points[b, 1], points[c, 1]
            if max(xa, xb, xc) < -_EDGE_PX or min(xa, xb, xc) > width - 1 + _EDGE_PX:
                continue
            ya, yb, yc = points[a, 0], points[b, 0], points[c, 0]
            top = math.ceil(max(min(ya, yb, yc) - _EDGE_PX, 0.0))
            bottom = math.floor(min(max(ya, yb, yc) + _EDGE_PX, height - 1.0))
            if top > bottom:
                continue
            for strip in range(top // STRIP_PX, bottom // STRIP_PX + 1):
                if listing:
                    members[starts[strip]] = t
                starts[strip] += 1
        total = 0
        for strip in range(strips + 1):
            # Listing moves each start to the next strip's.
            if listing:
                total, starts[strip] = starts[strip], total
            else:
                total, starts[strip] = total + starts[strip], total
        if not listing:
            members = np.empty(total, np.int32)
    return starts, members


@njit(nogil=True, cache=True)
def _evaluate_strips(
    start: int,
    stop: int,
    first: int,
    starts: Indices,
    members: Indices,
    surface: _Surface,
    out: FloatArray,
) -> None:
    """Evaluate strips `start` to `stop`, counted from the `first`, on their triangles."""
    # A pixel on an edge takes the value of the last triangle that holds it.
    mesh = surface.mesh
    vertices, points = mesh.vertices, mesh.points
    height, width = out.shape
    p, f, g, patch = np.empty((3, 2)), np.empty(3), np.empty((3, 2)), np.empty(_PATCH)
    for strip in range(first + start, first + stop):
        begin, end = strip * STRIP_PX, min((strip + 1) * STRIP_PX, height)
        for row in range(begin, end):
            for column in range(width):
                out[row, column] = np.nan
        for t in members[starts[strip] : starts[strip + 1]]:
            a, b, c = vertices[t, 0], vertices[t, 1], vertices[t, 2]
            ya, yb, yc = points[a, 0], points[b, 0], points[c, 0]
            top = math.ceil(max(min(ya, yb, yc) - _EDGE_PX, float(begin)))
            bottom = math.floor(min(max(ya, yb, yc) + _EDGE_PX, end - 1.0))
            xa, xb, xc = points[a, 1], points[b, 1], points[c, 1]
            leftmost = math.ceil(max(min(xa, xb, xc) - _EDGE_PX, 0.0))
            rightmost = math.floor(min(max(xa, xb, xc) + _EDGE_PX, width - 1.0))
            if top > bottom or leftmost > rightmost:
                continue
            _gather_corners(surface, t, p, f, g)
            _fill_patch(p, f, g, patch)
            for row in range(top, bottom + 1):
                for column in range(leftmost, rightmost + 1):
                    b0, b1, b2 = _patch_coordinates(patch, row, column)
                    if min(b0, b1, b2) >= -1e-9:
                        out[row, column], _ = _value_on_patch(patch, row, column)
        t = 0
        for row in range(begin, end):
            for column in range(width):
                if np.isnan(out[row, column]):
                    t = _locate(mesh, t, row, column)
                    out[row, column] = _value_beyond(surface, t, row, column)


@kernel
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
    """C¹ interpolant of values, (n,), and gradients, (n, 2), at the sites of a Delaunay mesh.

    A plane is met exactly, also beyond the sites:

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
        self.threads = available_threads(threads)

    def __call__(self, queries: FloatArray) -> FloatArray:
        """Return values, shape (m,), at points (y, x).

        Neighbours in the list should be neighbours in the plane. Outside the sites' hull the
        nearest hull site is continued linearly.
        """
        queries = np.ascontiguousarray(queries, dtype=np.float64)
        if not queries.flags.writeable:  # the kernel is compiled for one type
            queries = queries.copy()
        out = np.zeros(len(queries))
        _in_blocks(_evaluate_blocks, queries, self.threads, self._surface, out)
        return out

    def at_pixels(
        self, shape: tuple[int, int], on_share: Callable[[float], None] | None = None
    ) -> FloatArray:
        """Return values at the pixels (0, 0) to (H - 1, W - 1), shape (H, W).

        It is faster than a call with all pixels. `on_share` receives the progress, 0 to 1, and may
        raise to end the work.
        """
        out = np.empty(shape)
        (vertices, _, points), values, _ = surface = self._surface
        starts, members = _triangles_by_strip(vertices, points, len(values), shape)
        for first in range(0, len(starts) - 1, 4):
            strips = min(4, len(starts) - 1 - first)
            operands = first, starts, members, surface, out
            in_ranges(_evaluate_strips, strips, self.threads, *operands, smallest=1, uneven=True)
            if on_share is not None:
                on_share(min((first + strips) * STRIP_PX / shape[0], 1.0))
        return out

    @property
    def _surface(self) -> _Surface:
        return _Surface(_Mesh.of(self._triangulation), self._values, self._gradients)
