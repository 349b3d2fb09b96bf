"""Regular triangulations that follow their weights: the dual of a power diagram.

- triangulate weighted sites, or repair for new weights or places: `RegularTriangulation`
- sort sites so that neighbours are close in memory: `hilbert_order`

A site at r with weight w owns the points x where |x - r|² - w is smallest: its power cell.
Two sites are joined by an edge where their cells touch; a site with an empty cell is
hidden and no vertex. Equivalently, the triangles are the lower convex hull of the sites
lifted to the heights (|r|² - w) / 2.

After a change of weights or places, each edge that has become irregular is flipped; if it
cannot be, then one of its ends is hidden. So flipping finishes or proves an empty cell, and
costs little when little has changed.

References
----------
H. Edelsbrunner and N. R. Shah, "Incremental topological flipping works for regular
triangulations", Algorithmica 15, 223 (1996).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._system.machine import LIGHT_ITEMS, in_ranges
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry import flips
from napari_shadowinv.geometry.triangle_mesh import (
    COUNTERS,
    LIMIT,
    SIZE,
    Indices,
    Mesh,
    hilbert_permutation,
    insertion_order,
    list_edges,
)

STACK_SIZE = 1 << 14

T = TypeVar("T", bound=np.generic)


def hilbert_order(points: ArrayLike) -> Indices:
    """Return the permutation that sorts points along a Hilbert curve, so that neighbours stay near.

    >>> hilbert_order([[0.0, 0.0], [1.0, 1.0], [0.0, 1.0], [1.0, 0.0]])
    array([0, 2, 1, 3], dtype=int32)
    """
    return hilbert_permutation(_checked_points(points))


def _checked_points(points: ArrayLike) -> FloatArray:
    array = np.ascontiguousarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 2 or array.shape[0] == 0:
        raise InputError(f"sites have shape {array.shape}: expected (n, 2) with at least one site")
    if not np.all(np.isfinite(array)):
        raise InputError("sites contain NaN or infinity: all coordinates must be finite")
    return array


def _checked_weights(weights: ArrayLike, n: int) -> FloatArray:
    array = np.asarray(weights, dtype=np.float64)
    if array.shape != (n,):
        raise InputError(f"weights have shape {array.shape}, there are {n} sites: expected ({n},)")
    if not np.all(np.isfinite(array)):
        raise InputError("weights contain NaN or infinity: all weights must be finite")
    return array


def _with_ghosts(sites: FloatArray, region: ArrayLike | None) -> tuple[FloatArray, float]:
    """Append the corners of a distant square around sites and region; return half its side too."""
    # Column by column, because numpy takes ten times as long for both together.
    low = np.array([column.min() for column in sites.T])
    high = np.array([column.max() for column in sites.T])
    if region is not None:
        corners = np.asarray(region, np.float64)
        low = np.minimum(low, corners.min(axis=0))
        high = np.maximum(high, corners.max(axis=0))
    extent = float((high - low).max())
    if extent == 0.0:
        extent = max(1.0, float(np.abs(sites).max()))
    # From 3.5 on a ghost that weighs no more than any site has its cell outside three times the
    # bounding box.
    distance = 10.0 * extent
    corners = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return np.concatenate([sites, low + (high - low) / 2 + distance * corners]), distance


def _mark(search: Callable[..., None], mesh: Mesh, suspects: BoolArray, threads: int) -> None:
    """Search the triangles in threads, and mark those that a search suspects."""
    in_ranges(search, suspects.size, threads, mesh, suspects, smallest=LIGHT_ITEMS)


def _read_only(array: NDArray[T]) -> NDArray[T]:
    view = array.view()
    view.flags.writeable = False
    return view


class RegularTriangulation:
    """Regular (weighted Delaunay) triangulation of sites in the plane.

    Sites, shape (n, 2), are (y, x) in any unit, fastest in `hilbert_order`; weights, shape (n,),
    are in its square. The region, two opposite corners of a box that matters such as an image, is
    only needed where it reaches much further than the sites. `alive` is called before each `part`
    of the sites is put in, and may raise to end that. Four ghost sites, the corners of a square far
    outside, close the plane: their cells stay outside three times the bounding box of sites and
    region. Cells of sites may end at them out there.

    Shapes that do not match and values that are not finite raise an `InputError`, here and in the
    methods; reaching the limit of flips raises a RuntimeError.

    Of sites at the same place the heaviest is a vertex, the first one if they weigh the same; the
    others are hidden. A cell whose area is zero within rounding may count as empty or not.

    The arrays are read-only and valid until the next `update` or `lower_hidden`.

    >>> triangulation = RegularTriangulation([[0, 0], [0, 4], [4, 0], [4, 4], [1, 2]])
    >>> triangulation.vertices.shape
    (12, 3)
    >>> triangulation.update([9, 9, 9, 9, 0])
    True
    >>> triangulation.hidden
    array([False, False, False, False,  True])
    """

    def __init__(
        self,
        sites: ArrayLike,
        weights: ArrayLike | None = None,
        *,
        region: ArrayLike | None = None,
        alive: Callable[[], None] | None = None,
        part: int = 1 << 17,
    ) -> None:
        positions = _checked_points(sites)
        n = positions.shape[0]
        order = hilbert_permutation(positions)
        self._order = None if np.array_equal(order, np.arange(n)) else order
        points, self._ghost_distance = _with_ghosts(
            positions if self._order is None else positions[order], region
        )
        self._region = region
        self._mesh = Mesh(
            points=points,
            weights=np.zeros(n + 4),
            corners=np.empty(6 * n + 6, np.int32),
            twins=np.empty(6 * n + 6, np.int32),
            hidden=np.zeros(n, np.bool_),
            stack=np.empty(STACK_SIZE, np.int64),
            counters=np.zeros(len(COUNTERS), np.int64),
            scratch=np.empty(16),
        )
        self._is_regular = False  # for the weights of the mesh
        self._set_weights(np.zeros(n) if weights is None else _checked_weights(weights, n))
        self._build(alive, part)

    @cached_property
    def points(self) -> FloatArray:
        """Positions of the sites, then of the four ghosts, shape (n + 4, 2)."""
        return _read_only(self._in_given_order(self._mesh.points))

    @property
    def sites(self) -> FloatArray:
        """Positions of the sites, shape (n, 2)."""
        return self.points[:-4]

    @cached_property
    def weights(self) -> FloatArray:
        """Weights of the sites, then of the four ghosts, shape (n + 4,)."""
        return _read_only(self._in_given_order(self._mesh.weights))

    @cached_property
    def hidden(self) -> BoolArray:
        """True for sites with an empty cell, which are no vertex, shape (n,)."""
        return _read_only(self._in_given_order(self._mesh.hidden))

    @cached_property
    def vertices(self) -> Indices:
        """Rows of `points` at the corners of each triangle, shape (m, 3).

        Counter-clockwise in that cross(p₁ - p₀, p₂ - p₀) > 0, cross(a, b) = a₀ b₁ - a₁ b₀.
        """
        corners = self._mesh.corners[: 3 * self._mesh.counters[SIZE]]
        if self._order is not None:
            n = self._order.size
            corners = np.append(self._order, np.arange(n, n + 4, dtype=np.int32))[corners]
        return _read_only(corners.reshape(-1, 3))

    @cached_property
    def neighbors(self) -> Indices:
        """Triangle across the edge opposite to each corner, shape (m, 3); -1 if there is none."""
        twins = self._mesh.twins[: 3 * self._mesh.counters[SIZE]]
        return _read_only((twins // 3).reshape(-1, 3))  # -1 stays -1

    @cached_property
    def edges(self) -> tuple[Indices, Indices]:
        """Rows of `points` at the ends of each inner edge ab, and its triangles, shape (k, 2) each.

        Of the triangles the first lies to the left of ab.
        """
        twins = self._mesh.twins[: self.vertices.size]
        pairs, sides = list_edges(self.vertices.reshape(-1), twins)
        return _read_only(pairs), _read_only(sides)

    def update(
        self, weights: ArrayLike, *, stop_when_hidden: bool = False, threads: int = 1
    ) -> bool:
        """Repair the triangulation for new weights; return False if it was stopped.

        With `stop_when_hidden` it stops as soon as a site of the triangulation is proven hidden.
        The triangulation is then valid and contains the same sites, but is irregular until the
        next update. Irregular edges are searched for in parallel; flips run in one thread.
        """
        checked = _checked_weights(weights, self._mesh.hidden.size)
        if self._is_regular and np.array_equal(checked, self.weights[:-4]):
            return True
        self._set_weights(checked)
        self._is_regular = False
        self.forget()
        suspects = np.empty(self._mesh.counters[SIZE], np.bool_)
        _mark(flips.look_for_irregular, self._mesh, suspects, threads)
        policy = flips.STOP if stop_when_hidden else flips.REMOVE
        status = flips.repair(self._mesh, policy, suspects)
        if status != flips.EXHAUSTED:
            self._is_regular = bool(status == flips.DONE)
            return self._is_regular
        fresh = self.copy()
        fresh._build()
        if stop_when_hidden and np.any(fresh._mesh.hidden & ~self._mesh.hidden):
            return False
        self._mesh, self._is_regular = fresh._mesh, True
        return True

    def move(self, sites: ArrayLike, *, threads: int = 1) -> None:
        """Repair the triangulation for new places of the sites; their weights stay.

        Cheap where the neighbours of most sites stay the same, as in a Lloyd step; else as slow
        as a new triangulation. Copies made before keep the old places. Of sites that come to the
        same place with the same weight any one may become the vertex.
        """
        positions = _checked_points(sites)
        n = self._mesh.hidden.size
        if len(positions) != n:
            raise InputError(f"got {len(positions)} sites to move {n} sites to: expected as many")
        targets = positions if self._order is None else positions[self._order]
        points, self._ghost_distance = _with_ghosts(targets, self._region)
        same_ghosts = np.array_equal(points[n:], self._mesh.points[n:])
        self._is_regular = False
        self.forget()
        if same_ghosts and self._relocate(targets, threads):
            return
        self._mesh = self._mesh._replace(points=points)
        self._weigh_ghosts()
        self._build()

    def _relocate(self, targets: FloatArray, threads: int) -> bool:
        """Move all sites at once; return False where building a new mesh is faster."""
        # Corners of triangles that this would turn over are taken out, and put in again where
        # they belong.
        n = len(targets)
        origins, points = self._mesh.points, self._mesh.points.copy()
        points[:n] = targets
        mesh = self._mesh = self._mesh._replace(points=points)
        strays = np.zeros(n, np.bool_)
        suspects = np.empty(mesh.counters[SIZE], np.bool_)
        overturned = True
        while overturned:
            _mark(flips.look_for_overturned, mesh, suspects, threads)
            overturned = flips.return_overturned(mesh, suspects, origins, strays)
        if np.count_nonzero(strays) > 0.1 * n:
            return False
        _mark(flips.look_for_irregular, mesh, suspects, threads)
        if flips.repair(mesh, flips.REMOVE, suspects) != flips.DONE:
            return False
        return bool(flips.put_strays(mesh, targets, strays) == flips.DONE)

    def lower_hidden(self, weights: ArrayLike, *, threads: int = 1) -> FloatArray:
        """Raise the weights of hidden sites by the least that makes their cells count.

        The lifted heights (|r|² - w) / 2 of hidden sites are lowered to the convex hull of the
        others. The triangulation then belongs to the new weights and contains every site; the
        cells of the raised sites have no area within rounding. In clusters so tight that the
        weights' rounding exceeds the distance of the cells, such sites may hide again in the next
        `update`. Sites at the same place get the weight of the heaviest; only one of them can be
        in the triangulation. Returns the new weights.
        """
        self.update(weights, threads=threads)
        ghosts = np.inf
        while self._mesh.hidden.any() and ghosts != self._mesh.weights[-1]:
            ghosts = self._mesh.weights[-1]
            if flips.raise_hidden(self._mesh) == flips.EXHAUSTED:
                raise RuntimeError(self._exhaustion_text())
            self._is_regular = False
            self.forget()
            # The ghosts follow if the lightest sites were raised; then a site may hide again.
            self._weigh_ghosts()
            if ghosts != self._mesh.weights[-1]:
                self.update(self.weights[:-4], threads=threads)
        return self.weights[:-4].copy()

    def copy(self) -> RegularTriangulation:
        """Return an independent copy."""
        twin = object.__new__(RegularTriangulation)
        twin._order, twin._region = self._order, self._region
        twin._ghost_distance, twin._is_regular = self._ghost_distance, self._is_regular
        # `move` copies the points before it changes them
        twin._mesh = Mesh._make([self._mesh.points, *(array.copy() for array in self._mesh[1:])])
        return twin

    def with_more(self, sites: ArrayLike) -> RegularTriangulation:
        """Return a triangulation of these sites and, after them, others that weigh nothing.

        It takes time for the others alone. They must not lie far outside the region.
        """
        if not np.size(sites):
            return self.copy()
        positions = _checked_points(sites)
        count, n = len(positions), self._mesh.hidden.size
        order = hilbert_permutation(positions)
        old = self._mesh
        size = 6 * (n + count) + 6
        used = 3 * old.counters[SIZE]

        def lengthen(values: Indices, spare: int) -> Indices:
            larger = np.empty(size, np.int32)
            larger[:used] = values[:used] + np.where(values[:used] >= spare, count, 0)
            return larger

        twin = object.__new__(RegularTriangulation)
        twin._region, twin._ghost_distance = self._region, self._ghost_distance
        twin._is_regular = False
        old_order = np.arange(n, dtype=np.int32) if self._order is None else self._order
        twin._order = np.append(old_order, n + order).astype(np.int32)
        counters = old.counters.copy()
        counters[LIMIT] += 100 * count
        twin._mesh = Mesh(
            points=np.concatenate([old.points[:n], positions[order], old.points[n:]]),
            weights=np.concatenate([old.weights[:n], np.zeros(count), old.weights[n:]]),
            corners=lengthen(old.corners, n),
            twins=lengthen(old.twins, size),
            hidden=np.append(old.hidden, np.ones(count, np.bool_)),
            stack=np.empty(STACK_SIZE, np.int64),
            counters=counters,
            scratch=np.empty(16),
        )
        if flips.add(twin._mesh, n + insertion_order(count)) == flips.EXHAUSTED:
            raise RuntimeError(twin._exhaustion_text())
        return twin

    def _build(self, alive: Callable[[], None] | None = None, part: int = 1 << 17) -> None:
        order = insertion_order(self._mesh.hidden.size)
        for first in range(0, order.size, part):
            if alive is not None:
                alive()
            last = min(first + part, order.size)
            if flips.build(self._mesh, order, first, last) == flips.EXHAUSTED:
                raise RuntimeError(self._exhaustion_text())

    def _exhaustion_text(self) -> str:
        return (
            f"the triangulation of {self._mesh.hidden.size} sites was not finished within "
            f"{self._mesh.counters[LIMIT]} flips: please report it with the sites and weights"
        )

    def _set_weights(self, weights: FloatArray) -> None:
        self._mesh.weights[:-4] = weights if self._order is None else weights[self._order]
        self._weigh_ghosts()

    def _weigh_ghosts(self) -> None:
        ghosts = -(self._ghost_distance**2)
        lightest = float(self._mesh.weights[:-4].min())
        # In steps: to follow each change of the smallest weight would flip edges at the border.
        while ghosts > lightest:
            ghosts *= 1024.0
        self._mesh.weights[-4:] = ghosts

    def _in_given_order(self, values: NDArray[T]) -> NDArray[T]:
        if self._order is None:
            return values
        reordered = values.copy()
        reordered[self._order] = values[: self._order.size]
        return reordered

    def forget(self) -> None:
        """Drop the cached arrays, which are computed on demand."""
        for name in ("points", "weights", "hidden", "vertices", "neighbors", "edges"):
            self.__dict__.pop(name, None)
