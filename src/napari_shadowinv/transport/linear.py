"""Newton's linear systems: aggregation multigrid for the graph Laplacians of power diagrams.

- solve systems one after the other whose matrices change little: `SimilarSystems`
- several with the same matrix: `LaplacianSolver`
- many with factors of the matrix, by SuperLU: `FactorisedLaplacian`

Flexible conjugate gradients, preconditioned by one cycle over the levels. One Gauss–Seidel sweep
before and its mirror image after each visit of the next level smooth the error. Constants on
groups of nodes interpolate poorly; two steps of conjugate gradients at every coarse level (the
K-cycle) make up for it, and the number of iterations hardly depends on the number of sites.

The levels: nodes that are tied strongly have nearly the same potential, so two rounds of pairing
make groups of about four, and the coarse network has one node per group and the sums of the
conductances between groups: again a graph Laplacian, again planar. All levels are stored as one
network whose nodes are numbered level after level, so each kernel works on a range of nodes and
the vectors of all levels are single arrays.

References
----------
Y. Notay, Electron. Trans. Numer. Anal. 37, 123 (2010); A. Napov and Y. Notay, SIAM J.
Sci. Comput. 34, A1079 (2012).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from napari_shadowinv._system.machine import LIGHT_ITEMS, available_threads, in_ranges
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import kernel, njit
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.transport._coarsening import (
    Blocks,
    Cuts,
    Hierarchy,
    Network,
    Rows,
    build_hierarchy,
    require_connected,
)


class FactorisedLaplacian:
    """Factors of a Laplacian as `LaplacianSolver` takes it, which threads may share.

    A graph that is not connected, or that rounding makes look so, raises a RuntimeError.
    """

    def __init__(self, laplacian: csr_array, ground: FloatArray | None = None) -> None:
        require_connected(laplacian)
        # Without a ground one unknown is free: all but the first are solved for.
        self._pinned = int(ground is None)
        matrix = _with_ground(laplacian, ground)[self._pinned :, self._pinned :].tocsc()
        self._factors = splu(
            matrix,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve L x = b for each column of b, (n, k).

        Without a ground the mean of b is ignored, and x is zero at the first node.
        """
        solution = np.zeros(right.shape)
        if self._pinned:
            right = (right - right.mean(axis=0))[1:]
        if len(right):
            solution[self._pinned :] = self._factors.solve(right)
        return solution


class _Vectors(NamedTuple):
    """One value per node; a product is the Laplacian times the vector before it."""

    residual: FloatArray
    correction: FloatArray
    product: FloatArray
    direction: FloatArray
    direction_product: FloatArray


# Without reference counting, and with indices that need no test for negative ones, these take
# a little more than half the time.


@kernel
def _multiply(start: int, stop: int, network: Network, x: FloatArray, product: FloatArray) -> None:
    starts, _, _, neighbors, conductances, degrees, _ = network
    for i in range(np.uint32(start), np.uint32(stop)):
        total = degrees[i] * x[i]
        for k in range(np.uint32(starts[i]), np.uint32(starts[i + 1])):
            total -= conductances[k] * x[np.uint32(neighbors[k])]
        product[i] = total


@kernel
def _descend(
    start: int, stop: int, first: int, last: int, hierarchy: Hierarchy, vectors: _Vectors
) -> None:
    """Sweep forward from zero and pass the residual to the groups `first` to `last`."""
    # After such a sweep only the conductors to higher nodes leave a residual, and each is
    # also an entry of the higher node's row: both are done in one walk over half the entries.
    starts, middles, _, neighbors, conductances, _, inverse_degrees = hierarchy.network
    parents, residual, x = hierarchy.parents, vectors.residual, vectors.correction
    for i in range(np.uint32(first), np.uint32(last)):
        residual[i] = 0.0
    for i in range(np.uint32(start), np.uint32(stop)):
        begin, middle = np.uint32(starts[i]), np.uint32(middles[i])
        total = residual[i]
        for k in range(begin, middle):
            total += conductances[k] * x[np.uint32(neighbors[k])]
        value = total * inverse_degrees[i]
        x[i] = value
        for k in range(begin, middle):
            parent = np.uint32(parents[np.uint32(neighbors[k])])
            residual[parent] += conductances[k] * value


@kernel
def _ascend(start: int, stop: int, hierarchy: Hierarchy, vectors: _Vectors) -> None:
    """Add the next level's correction and sweep backward."""
    starts, _, ends, neighbors, conductances, _, inverse_degrees = hierarchy.network
    parents, residual, x = hierarchy.parents, vectors.residual, vectors.correction
    for j in range(np.uint32(start), np.uint32(stop)):
        x[j] += x[np.uint32(parents[j])]
    for node in range(stop - 1, start - 1, -1):
        i = np.uint32(node)
        total = residual[i]
        for k in range(np.uint32(starts[i]), np.uint32(ends[i])):
            total += conductances[k] * x[np.uint32(neighbors[k])]
        x[i] = total * inverse_degrees[i]


@kernel
def _solve_coarsest(start: int, stop: int, inverse: FloatArray, vectors: _Vectors) -> None:
    x = vectors.correction
    for i in range(start, stop):
        x[i] = 0.0
    for j in range(stop - start):
        value = vectors.residual[start + j]
        for i in range(stop - start):
            x[start + i] += inverse[j, i] * value


@kernel
def _dot(start: int, stop: int, a: FloatArray, b: FloatArray) -> float:
    total = 0.0
    for i in range(start, stop):
        total += a[i] * b[i]
    return total


@kernel
def _first_step(start: int, stop: int, vectors: _Vectors) -> tuple[float, float]:
    """Minimise along the level's first correction; return its energy and the step's length."""
    residual, x = vectors.residual, vectors.correction
    energy = _dot(start, stop, x, vectors.direction_product)
    if not energy > 0.0:
        energy = 1.0
    length = _dot(start, stop, x, residual) / energy
    for i in range(start, stop):
        residual[i] -= length * vectors.direction_product[i]
        vectors.direction[i] = x[i]
    return energy, length


@kernel
def _second_step(start: int, stop: int, vectors: _Vectors, energy: float, length: float) -> None:
    """Minimise over the plane of the level's first and second corrections."""
    x = vectors.correction
    mixed = _dot(start, stop, x, vectors.direction_product) / energy
    second_energy = _dot(start, stop, x, vectors.product) - mixed * mixed * energy
    second = 0.0
    if second_energy > 0.0:
        second = _dot(start, stop, x, vectors.residual) / second_energy
    first = length - second * mixed
    for i in range(start, stop):
        x[i] = first * vectors.direction[i] + second * x[i]


@njit(nogil=True, cache=True)
def _cycle(hierarchy: Hierarchy, top: int, vectors: _Vectors) -> None:
    """Turn the residual of level `top` into its correction by one K-cycle."""
    # What the first step of each level has found waits in arrays, because a cached kernel
    # must not call itself.
    bounds, twice, network, _, inverse = hierarchy
    deepest = bounds.shape[0] - 2
    energies, lengths = np.zeros(deepest + 1), np.zeros(deepest + 1)
    halfway = np.zeros(deepest + 1, np.bool_)
    level = top
    while True:
        while level < deepest:
            start, stop, end = bounds[level], bounds[level + 1], bounds[level + 2]
            _descend(start, stop, stop, end, hierarchy, vectors)
            level += 1
        _solve_coarsest(bounds[level], bounds[level + 1], inverse, vectors)
        again = False
        while level > top and not again:
            level -= 1
            start, stop = bounds[level], bounds[level + 1]
            _ascend(start, stop, hierarchy, vectors)
            x = vectors.correction
            if twice[level] and halfway[level]:
                _multiply(start, stop, network, x, vectors.product)
                _second_step(start, stop, vectors, energies[level], lengths[level])
                halfway[level] = False
            elif twice[level]:
                _multiply(start, stop, network, x, vectors.direction_product)
                energies[level], lengths[level] = _first_step(start, stop, vectors)
                halfway[level] = again = True
        if not again:
            return


@njit(nogil=True, cache=True)
def _descend_blocks(
    start: int, stop: int, blocks: Blocks, hierarchy: Hierarchy, vectors: _Vectors
) -> None:
    """Sweep blocks `start` to `stop` of a level forward."""
    bounds, groups = blocks.bounds, blocks.groups
    for b in range(start, stop):
        _descend(bounds[b], bounds[b + 1], groups[b], groups[b + 1], hierarchy, vectors)


@njit(nogil=True, cache=True)
def _ascend_blocks(
    start: int, stop: int, blocks: Blocks, hierarchy: Hierarchy, vectors: _Vectors
) -> None:
    """Sweep blocks `start` to `stop` of a level backward."""
    for b in range(start, stop):
        _ascend(blocks.bounds[b], blocks.bounds[b + 1], hierarchy, vectors)


# The sweep of a block uses the values that the other blocks had before: zero, and then those that
# the coarser levels have corrected.


@kernel
def _complete_descent(cuts: Cuts, parents: Indices, vectors: _Vectors) -> None:
    """Complete the forward sweep where blocks meet."""
    residual, x = vectors.residual, vectors.correction
    for k in range(cuts.first.size):
        i, j, conductance = cuts.first[k], cuts.second[k], cuts.conductances[k]
        residual[parents[i]] += conductance * x[j]
        residual[parents[j]] += conductance * x[i]


@kernel
def _prepare_ascent(cuts: Cuts, parents: Indices, vectors: _Vectors) -> None:
    """Save the residual where blocks meet, and prepare it for the backward sweep."""
    residual, x = vectors.residual, vectors.correction
    for k in range(cuts.nodes.size):
        cuts.saved[k] = residual[cuts.nodes[k]]
    for k in range(cuts.first.size):
        i, j, conductance = cuts.first[k], cuts.second[k], cuts.conductances[k]
        residual[i] += conductance * (x[j] + x[parents[j]])
        residual[j] += conductance * (x[i] + x[parents[i]])


@kernel
def _restore(nodes: Indices, saved: FloatArray, residual: FloatArray) -> None:
    for k in range(nodes.size):
        residual[nodes[k]] = saved[k]


@kernel
def _turn(n: int, share: float, grounded: bool, vectors: _Vectors) -> None:
    """Make the next direction from the correction and a share of the last direction."""
    total = 0.0
    if not grounded:
        for i in range(n):
            total += vectors.correction[i]
    # without a ground the Laplacian forgets a constant, but only up to rounding
    mean = total / n
    for i in range(n):
        vectors.direction[i] = vectors.correction[i] - mean - share * vectors.direction[i]


@kernel
def _advance(n: int, length: float, solution: FloatArray, vectors: _Vectors) -> None:
    for i in range(n):
        solution[i] += length * vectors.direction[i]
        vectors.residual[i] -= length * vectors.direction_product[i]


class LaplacianSolver:
    """Conjugate gradients for a connected graph Laplacian, with a multigrid set up once.

    One object must not be used by several threads at the same time. The Laplacian is symmetric,
    with nothing positive off the diagonal and rows that sum to zero; its columns may come in any
    order, but neighbours should be near in the numbering for speed. A ground at potential 0, if
    any, is tied to each node by a conductance, added to the diagonal. A graph that is not
    connected raises a RuntimeError. Large levels are cut into blocks of about as many nodes as pay,
    which are swept side by side; solutions do not depend on the number of threads.
    """

    def __init__(
        self,
        laplacian: csr_array,
        ground: FloatArray | None = None,
        *,
        nodes_per_block: int = 25_000,
        threads: int | None = 1,
    ) -> None:
        self._threads = available_threads(threads)
        self._n = int(laplacian.shape[0])
        self._grounded = ground is not None
        self._rows = Rows.of(_with_ground(laplacian, ground))
        self._hierarchy, self._blocks = build_hierarchy(
            laplacian, ground, nodes_per_block=nodes_per_block, threads=self._threads
        )
        nodes = int(self._hierarchy.bounds[-1])
        self._vectors = _Vectors(*(np.zeros(nodes) for _ in _Vectors._fields))

    def solve(
        self,
        right: FloatArray,
        tolerance: float = 1e-2,
        max_iterations: int = 200,
        *,
        laplacian: csr_array | None = None,
        ground: FloatArray | None = None,
    ) -> tuple[FloatArray, int, float]:
        """Solve L x = b; return x, the number of iterations, and the residual.

        Tolerance and residual are relative to the norm of b. Without a ground the mean of b is
        ignored, and x has zero mean. A `laplacian` with its ground, if passed, replaces the matrix
        of the setup, and should be similar to it.
        """
        if laplacian is not None:
            self._rows = Rows.of(_with_ground(laplacian, ground))
        right = self._centre(right)
        scale = self._norm(right)
        solution: FloatArray = np.zeros(self._n)
        if scale == 0.0:
            return solution, 0, 0.0
        self._vectors.residual[: self._n] = right
        self._vectors.direction[: self._n] = 0.0
        self._vectors.direction_product[: self._n] = 0.0
        energy = relative = 1.0
        iterations = 0
        while relative > tolerance and iterations < max_iterations:
            energy = self._iterate(solution, energy)
            iterations += 1
            relative = self._norm(self._vectors.residual) / scale
            if relative <= tolerance or iterations == max_iterations or not energy > 0.0:
                # the residual was only updated so far, and rounding errors add up
                residual = self._vectors.residual[: self._n]
                self._multiply(solution, residual)
                np.subtract(right, residual, out=residual)
                relative = self._norm(residual) / scale
            if not energy > 0.0:
                break
        return self._centre(solution), iterations, relative

    def _centre(self, values: FloatArray) -> FloatArray:
        """Subtract the mean, to which a network without a ground is insensitive."""
        return values if self._grounded else values - values.mean()

    def _iterate(self, solution: FloatArray, energy: float) -> float:
        """Do one step of flexible conjugate gradients; return its direction's energy."""
        n, vectors = self._n, self._vectors
        self._correct(0)
        share = _dot(0, n, vectors.correction, vectors.direction_product) / energy
        _turn(n, share, self._grounded, vectors)
        self._multiply(vectors.direction, vectors.direction_product)
        energy = _dot(0, n, vectors.direction, vectors.direction_product)
        if energy > 0.0:
            length = _dot(0, n, vectors.direction, vectors.residual) / energy
            _advance(n, length, solution, vectors)
        return energy

    def _correct(self, level: int) -> None:
        """Turn the residual of a level into its correction by one K-cycle."""
        hierarchy, vectors = self._hierarchy, self._vectors
        if level == len(self._blocks):
            _cycle(hierarchy, level, vectors)
            return
        start, stop = hierarchy.bounds[level : level + 2]
        self._sweep(level)
        if hierarchy.twice[level]:
            _multiply(start, stop, hierarchy.network, vectors.correction, vectors.direction_product)
            energy, length = _first_step(start, stop, vectors)
            self._sweep(level)
            _multiply(start, stop, hierarchy.network, vectors.correction, vectors.product)
            _second_step(start, stop, vectors, energy, length)

    def _sweep(self, level: int) -> None:
        """Sweep the blocks of a level forward, correct by the next level, and sweep backward."""
        blocks, vectors = self._blocks[level], self._vectors
        cuts, parents = blocks.cuts, self._hierarchy.parents
        sweep = blocks, self._hierarchy, vectors
        count = len(blocks.bounds) - 1
        in_ranges(_descend_blocks, count, self._threads, *sweep, smallest=1)
        _complete_descent(cuts, parents, vectors)
        self._correct(level + 1)
        _prepare_ascent(cuts, parents, vectors)
        in_ranges(_ascend_blocks, count, self._threads, *sweep, smallest=1)
        _restore(cuts.nodes, cuts.saved, vectors.residual)

    def _multiply(self, x: FloatArray, product: FloatArray) -> None:
        # Not with the hierarchy's rounded conductances.
        operands = self._rows, x, product
        in_ranges(_multiply_rows, self._n, self._threads, *operands, smallest=LIGHT_ITEMS)

    def _norm(self, x: FloatArray) -> float:
        return float(np.sqrt(_dot(0, self._n, x, x)))


def _with_ground(laplacian: csr_array, ground: FloatArray | None) -> csr_array:
    return laplacian if ground is None else csr_array(laplacian + diags_array(ground))


@kernel
def _multiply_rows(start: int, stop: int, rows: Rows, x: FloatArray, product: FloatArray) -> None:
    starts, columns, values = rows
    for i in range(np.uint32(start), np.uint32(stop)):
        total = 0.0
        for k in range(np.uint32(starts[i]), np.uint32(starts[i + np.uint32(1)])):
            total += values[k] * x[np.uint32(columns[k])]
        product[i] = total


@dataclass(eq=False)
class SimilarSystems:
    """Solver of consecutive systems that reuses its setup.

    Reuse costs nothing if the matrices change little, as Newton's do once their right-hand sides
    have become short.
    """

    threads: int | None = 1
    direct_nodes: int = 200  # fewer are solved for directly
    extra_iterations: int = 3  # that cost less than a new setup
    reuse_length: float = 0.4  # of right-hand sides that reuse a setup, relative to its own's
    kept_nodes: int = 500_000  # a setup of more takes the memory that trial steps need
    _solver: LaplacianSolver | None = field(default=None, init=False)
    _most: int = field(default=0, init=False)
    _longest: float = field(default=0.0, init=False)

    def solve(
        self,
        laplacian: csr_array,
        right: FloatArray,
        tolerance: float = 1e-2,
        *,
        ground: FloatArray | None = None,
    ) -> FloatArray:
        """Solve L x = b as `LaplacianSolver` does, or by factors if small or too hard for it."""
        if len(right) < self.direct_nodes:
            return _solve_by_factors(laplacian, right, ground)
        length = float(np.sqrt(np.sum(right * right)))
        if self._solver is not None and length < self._longest:
            solution, _, residual = self._solver.solve(
                right, tolerance, self._most, laplacian=laplacian, ground=ground
            )
            if residual <= tolerance:
                return solution
        self._solver = None  # one at a time: they are large
        solver = LaplacianSolver(laplacian, ground, threads=self.threads)
        solution, iterations, residual = solver.solve(right, tolerance)
        if residual > tolerance:
            return _solve_by_factors(laplacian, right, ground)
        if len(right) < self.kept_nodes:
            self._solver, self._most = solver, iterations + self.extra_iterations
            self._longest = self.reuse_length * length
        return solution


def _solve_by_factors(
    laplacian: csr_array, right: FloatArray, ground: FloatArray | None
) -> FloatArray:
    solution = FactorisedLaplacian(laplacian, ground).solve(right[:, None])[:, 0]
    return solution - solution.mean() if ground is None else solution
