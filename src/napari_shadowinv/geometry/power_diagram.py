"""Power diagrams over an image: the contents of each cell and the flux between cells.

The power diagram of sites r_i with weights w_i gives site i the cell

    P_i = { r : |r - r_i|² - w_i ≤ |r - r_j|² - w_j for all j }

(paper, sections II.B and III.A). It is the dual of the regular triangulation: a triangle's power
centre is a corner of three cells, an edge of the triangulation crosses the border of
two. Each border is walked once through the pixels and added with opposite signs to its two
cells, so the cells tile the image to rounding.

- the cells' masses, centroids and moments of inertia, and the flux through every
  border: `PowerDiagram`
- the corners of one cell as a polygon: `PowerDiagram.cell`
- overlap of each pixel with each cell: `pixel_shares`; with these areas the masses of the cells
  over any number of images are products with one sparse matrix
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import LIGHT_ITEMS, available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import kernel, njit
from napari_shadowinv.geometry.density import (
    Density,
    Integrals,
    walk_edge,
    walk_inside,
)
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation


@kernel
def _power_centres(
    start: int,
    stop: int,
    points: FloatArray,
    weights: FloatArray,
    n: int,
    vertices: Indices,
    centres: FloatArray,
) -> None:
    """Find the point of equal power distance to the three sites of each triangle."""
    # Indices without a sign need no test for negative ones.
    first_ghost = np.uint32(n)
    for t in range(np.uint32(start), np.uint32(stop)):
        a, b = np.uint32(vertices[t, 0]), np.uint32(vertices[t, 1])
        c = np.uint32(vertices[t, 2])
        # Seen from a ghost far away, two sites that are close together differ in few digits.
        if a >= first_ghost:
            a, b, c = b, c, a
        if a >= first_ghost:
            a, b, c = b, c, a
        by, bx = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
        cy, cx = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1]
        double_area = by * cx - bx * cy
        if double_area == 0.0:
            double_area = 1e-300
        b_lift = 0.5 * (by * by + bx * bx - weights[b] + weights[a])
        c_lift = 0.5 * (cy * cy + cx * cx - weights[c] + weights[a])
        centres[t, 0] = points[a, 0] + (b_lift * cx - c_lift * bx) / double_area
        centres[t, 1] = points[a, 1] + (c_lift * by - b_lift * cy) / double_area


class _Borders(NamedTuple):
    """Borders between cells: the triangles of their two ends, over a density."""

    sides: Indices
    centres: FloatArray
    image: FloatArray
    sums: FloatArray


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _walk_border(
    a: int, b: int, centres: FloatArray, image: FloatArray, sums: FloatArray, with_moments: bool
) -> Integrals:
    """Walk a border as `walk_edge` does, without inertia; most lie inside the image."""
    height, width = float(image.shape[0]), float(image.shape[1])
    first, last = np.uint32(a), np.uint32(b)
    ya, xa = centres[first, 0] + 0.5, centres[first, 1] + 0.5
    yb, xb = centres[last, 0] + 0.5, centres[last, 1] + 0.5
    if min(ya, yb, xa, xb) >= 0 and max(ya, yb) < height and max(xa, xb) < width:
        walk = walk_inside(image, sums, (ya, xa, yb, xb), with_moments, False)
    else:
        walk = walk_edge(image, sums, (ya, xa, yb, xb), with_moments, False)
    return walk


@njit(nogil=True, cache=True, error_model="numpy")
def _integrate_edges(start: int, stop: int, borders: _Borders, integrals: FloatArray) -> None:
    """Walk each border; columns of `integrals`: flux and mass."""
    sides, centres, image, sums = borders
    for e in range(start, stop):
        walk = _walk_border(sides[e, 0], sides[e, 1], centres, image, sums, False)
        integrals[e, 0], integrals[e, 1] = walk[0], walk[1]


@njit(nogil=True, cache=True, error_model="numpy")
def _integrate_moments(start: int, stop: int, borders: _Borders, integrals: FloatArray) -> None:
    """Walk each border; columns of `integrals`: flux, mass, moments y and x."""
    sides, centres, image, sums = borders
    for e in range(start, stop):
        walk = _walk_border(sides[e, 0], sides[e, 1], centres, image, sums, True)
        integrals[e, 0], integrals[e, 1] = walk[0], walk[1]
        integrals[e, 2], integrals[e, 3] = walk[2], walk[3]


@njit(nogil=True, cache=True, error_model="numpy")
def _integrate_inertia(start: int, stop: int, borders: _Borders, integrals: FloatArray) -> None:
    """Walk each border for the moment of inertia, the only column of `integrals`."""
    sides, centres, image, sums = borders
    for e in range(start, stop):
        ya, xa = centres[sides[e, 0], 0] + 0.5, centres[sides[e, 0], 1] + 0.5
        yb, xb = centres[sides[e, 1], 0] + 0.5, centres[sides[e, 1], 1] + 0.5
        integrals[e, 0] = walk_edge(image, sums, (ya, xa, yb, xb), True, True)[4]


@kernel
def _sum_over_cells(edges: Indices, integrals: FloatArray, column: int, sums: FloatArray) -> None:
    """Add one column of the edges' integrals to the two cells of each edge."""
    n = np.uint32(sums.shape[0])
    for e in range(edges.shape[0]):
        a, b = np.uint32(edges[e, 0]), np.uint32(edges[e, 1])
        value = integrals[e, column]
        if a < n:
            sums[a] += value
        if b < n:
            sums[b] -= value


@kernel
def _sum_moments(edges: Indices, integrals: FloatArray, sums: FloatArray) -> None:
    """Add the masses and moments of `_integrate_moments` to the two cells of each edge."""
    n = np.uint32(sums.shape[0])
    for e in range(edges.shape[0]):
        a, b = np.uint32(edges[e, 0]), np.uint32(edges[e, 1])
        if a < n:
            for k in range(3):
                sums[a, k] += integrals[e, k + 1]
        if b < n:
            for k in range(3):
                sums[b, k] -= integrals[e, k + 1]


@njit(nogil=True, cache=True, error_model="numpy")
def _find_centroids(
    start: int, stop: int, sites: FloatArray, sums: FloatArray, centroids: FloatArray
) -> None:
    """Divide the moments of cells, about the corner of the image, by their masses."""
    for i in range(start, stop):
        mass = sums[i, 0]
        for axis in range(2):
            moment = sums[i, 1 + axis] - 0.5 * mass
            centroids[i, axis] = moment / mass if mass > 0 else sites[i, axis]


@kernel
def _count_ties(
    start: int, stop: int, n: int, edges: Indices, integrals: FloatArray, counts: Indices
) -> None:
    """Count the neighbours of sites `start` to `stop`."""
    first, end, ghosts = np.uint32(start), np.uint32(stop), np.uint32(n)
    for e in range(edges.shape[0]):
        a, b = np.uint32(edges[e, 0]), np.uint32(edges[e, 1])
        if a < ghosts and b < ghosts and integrals[e, 0] > 0:
            if first <= a < end:
                counts[a] += 1
            if first <= b < end:
                counts[b] += 1


@kernel
def _fill_laplacian(
    start: int,
    stop: int,
    points: FloatArray,
    edges: Indices,
    integrals: FloatArray,
    starts: Indices,
    filled: Indices,
    columns: Indices,
    values: FloatArray,
) -> None:
    """Fill the rows of sites `start` to `stop`; `filled` holds the next place of each row."""
    first, end, ghosts = np.uint32(start), np.uint32(stop), np.uint32(filled.size)
    for i in range(start, stop):
        columns[starts[i]] = i
    for e in range(edges.shape[0]):
        a, b = np.uint32(edges[e, 0]), np.uint32(edges[e, 1])
        has_a, has_b = first <= a < end, first <= b < end
        if (has_a or has_b) and a < ghosts and b < ghosts and integrals[e, 0] > 0:
            dy, dx = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
            conductance = integrals[e, 0] / (2 * np.sqrt(dy * dy + dx * dx))
            if has_a:
                place = np.uint32(filled[a])
                columns[place], values[place] = b, -conductance
                filled[a] += 1
                values[np.uint32(starts[a])] += conductance
            if has_b:
                place = np.uint32(filled[b])
                columns[place], values[place] = a, -conductance
                filled[b] += 1
                values[np.uint32(starts[b])] += conductance


class PowerDiagram:
    """The power diagram that is dual to a regular triangulation of n sites, over a density.

    It holds for the weights that the triangulation has now. Where the sites cover only a part
    of the image, the triangulation must know of it as its `region`. Centroids and moments of
    inertia need `with_moments`. Results do not depend on the number of threads.

    >>> image = Density.from_image(np.ones((4, 4)))
    >>> sites = np.array([[0.5, 0.5], [0.5, 2.5], [2.5, 0.5], [2.5, 2.5]])
    >>> diagram = PowerDiagram(RegularTriangulation(sites), image)
    >>> diagram.masses
    array([4., 4., 4., 4.])
    """

    def __init__(
        self,
        triangulation: RegularTriangulation,
        density: Density,
        *,
        with_moments: bool = False,
        threads: int | None = None,
    ) -> None:
        self._triangulation = triangulation
        self._with_moments = with_moments
        self.n_sites = len(triangulation.sites)
        self.sites = triangulation.sites
        self.vertices: FloatArray = np.empty((len(triangulation.vertices), 2))
        threads = available_threads(threads)
        points, triangles = triangulation.points, triangulation.vertices
        dual = points, triangulation.weights, self.n_sites, triangles, self.vertices
        in_ranges(_power_centres, len(triangles), threads, *dual, smallest=LIGHT_ITEMS)
        # pairs of neighbouring sites, shape (e, 2); indices ≥ n are ghosts outside
        self.edges, sides = triangulation.edges
        self._sides, self._density, self._threads = sides, density, threads
        integrate = _integrate_moments if with_moments else _integrate_edges
        powers = np.array([-1, 0, 1, 1] if with_moments else [-1, 0])
        self._integrals = self._integrate(integrate, density.first_sums, powers)

    def _integrate(
        self, walk: Callable[..., None], sums: FloatArray, powers: NDArray[np.int64]
    ) -> FloatArray:
        """Integrate along the borders; each column has a power of the length in its unit."""
        density, sides = self._density, self._sides
        side = float(density.side)
        integrals = np.empty((len(sides), len(powers)))
        # seen in units of the density's squares
        ends = self.vertices if side == 1 else (self.vertices + 0.5) / side - 0.5
        borders = _Borders(sides, ends, density.image, sums)
        squares_per_side = math.sqrt(density.image.size / self.n_sites)
        smallest = math.ceil(LIGHT_ITEMS / max(squares_per_side, 1.0))
        operands = borders, integrals
        in_ranges(walk, len(sides), self._threads, *operands, smallest=smallest, uneven=True)
        if side != 1:
            integrals *= side**powers
        return integrals

    def _cell_sums(self, integrals: FloatArray, column: int) -> FloatArray:
        sums = np.zeros(self.n_sites)
        _sum_over_cells(self.edges, integrals, column, sums)
        return sums

    @cached_property
    def masses(self) -> FloatArray:
        """Flux in each cell, shape (n,): S(V_i) or T(P_i) of the paper."""
        if self._with_moments:
            return np.ascontiguousarray(self._moments[:, 0])
        return self._cell_sums(self._integrals, 1)

    @cached_property
    def _moments(self) -> FloatArray:
        """Masses of the cells, and their moments y and x about the image's corner, (n, 3)."""
        if not self._with_moments:
            raise ValueError("this diagram was made without moments: pass with_moments=True")
        sums = np.zeros((self.n_sites, 3))
        _sum_moments(self.edges, self._integrals, sums)
        return sums

    @cached_property
    def centroids(self) -> FloatArray:
        """Centre of mass of each cell, shape (n, 2); the site where a cell is empty."""
        centroids = np.empty((self.n_sites, 2))
        cells = self.sites, self._moments, centroids
        in_ranges(_find_centroids, self.n_sites, self._threads, *cells, smallest=1 << 15)
        return centroids

    @cached_property
    def inertia(self) -> FloatArray:
        """∫ |r - r_i|² I dr over each cell about its site, shape (n,)."""
        site = self.sites + 0.5  # from the image's corner
        corner = self._moments[:, 1:]
        shifted = (site**2).sum(axis=1) * self.masses - 2 * (site * corner).sum(axis=1)
        integrals = self._integrate(_integrate_inertia, self._density.sums, np.array([2]))
        inertia: FloatArray = self._cell_sums(integrals, 0) + shifted
        return inertia

    def laplacian(self) -> csr_array:
        """Return ∂T_i/∂w_j, shape (n, n): the Hessian of the paper's Eq. 6.

        A graph Laplacian: off the diagonal it is -∫ I ds / (2 |r_i - r_j|) over the border of two
        cells; rows sum to zero.
        """
        n, threads = self.n_sites, self._threads
        borders = self.edges, self._integrals
        starts = np.ones(n + 1, np.int32)
        starts[0] = 0
        in_ranges(_count_ties, n, threads, n, *borders, starts[1:], smallest=LIGHT_ITEMS)
        np.cumsum(starts, out=starts)
        columns, values = np.empty(starts[-1], np.int32), np.zeros(starts[-1])
        rows = starts, starts[:-1] + 1, columns, values
        operands = self._triangulation.points, *borders, *rows
        in_ranges(_fill_laplacian, n, threads, *operands, smallest=LIGHT_ITEMS)
        return csr_array((values, columns, starts), shape=(n, n))

    @property
    def borders(self) -> FloatArray:
        """Ends (y, x) of the border between each pair of `edges`, shape (e, 2, 2).

        The first of the pair lies to its left. Read it before the triangulation is updated.
        """
        _, sides = self._triangulation.edges
        return np.asarray(self.vertices[sides])

    def cell(self, site: int) -> FloatArray:
        """Return the corners of a site's cell, counter-clockwise in (y, x), shape (k, 2).

        Cells at the rim reach far beyond the image. An empty cell has no corners. Call it before
        the triangulation is updated.
        """
        pairs, sides = self._triangulation.edges
        around = {}
        for k in np.flatnonzero((pairs == site).any(axis=1)):
            t_left, t_right = sides[k]
            around.update({t_right: t_left} if pairs[k, 0] == site else {t_left: t_right})
        if not around:
            return np.empty((0, 2))
        first = triangle = next(iter(around))
        corners = []
        while True:
            corners.append(self.vertices[triangle])
            triangle = around[triangle]
            if triangle == first:
                return np.array(corners)


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
                    segment = ya - row, xa - column, yb - row, xb - column
                    share += sense * walk_edge(unit_image, sums, segment, False, False)[1]
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
