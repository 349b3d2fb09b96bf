"""Aggregation multigrid for the graph Laplacians of power diagrams.

- solve one system, or several with the same matrix: `LaplacianSolver`

A graph Laplacian is a network of conductors. Sites that are tied strongly together have
nearly the same potential, so two rounds of pairing make groups of about four, and the
coarse network has one node per group and the sums of the conductances between groups:
again a graph Laplacian, again planar. One Gauss–Seidel sweep before and its mirror image
after each visit of the coarse network smooth the error. Constants on groups interpolate
poorly; two steps of conjugate gradients at every coarse level (the K-cycle) make up for
it, and the number of iterations hardly depends on the number of sites.

All levels are stored as one network whose nodes are numbered level after level, so each
kernel works on a range of nodes and vectors of all levels are single arrays.

References
----------
Y. Notay, Electron. Trans. Numer. Anal. 37, 123 (2010); A. Napov and Y. Notay, SIAM J.
Sci. Comput. 34, A1079 (2012).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from napari_shadowinv.geometry._threads import in_ranges

__all__ = ["LaplacianSolver"]

Array = NDArray[np.float64]
Indices = NDArray[np.int32]
Offsets = NDArray[np.int64]

_COARSEST = 60
_GOOD_ENOUGH = 0.25
_WORTH_A_THREAD = 100_000


class _Network(NamedTuple):
    """Conductors as rows of (neighbour, conductance), those to lower nodes first."""

    starts: Indices
    middles: Indices
    neighbors: Indices
    conductances: Array
    degrees: Array
    inverse_degrees: Array


class _Vectors(NamedTuple):
    """One value per node; a product is the Laplacian times the vector before it."""

    residual: Array
    correction: Array
    product: Array
    direction: Array
    direction_product: Array


def _empty_network(nodes: int, entries: int) -> _Network:
    return _Network(
        np.zeros(nodes + 1, np.int32),
        np.empty(nodes, np.int32),
        np.empty(entries, np.int32),
        np.empty(entries),
        np.empty(nodes),
        np.empty(nodes),
    )


@njit(nogil=True, cache=True)
def _put_lower_first(network: _Network, node: int, end: int) -> None:
    """Close a node's row at `end`: sort its entries to lower and upper, sum them."""
    neighbors = network.neighbors
    conductances = network.conductances
    begin = network.starts[node]
    middle = begin
    degree = 0.0
    for k in range(begin, end):
        neighbor = neighbors[k]
        conductance = conductances[k]
        degree += conductance
        neighbors[k] = neighbors[middle]
        conductances[k] = conductances[middle]
        neighbors[middle] = neighbor
        conductances[middle] = conductance
        middle += 1 if neighbor < node else 0
    network.middles[node] = middle
    network.degrees[node] = degree
    network.inverse_degrees[node] = 1.0 / degree if degree > 0.0 else 0.0
    network.starts[node + 1] = end


@njit(nogil=True, cache=True)
def _read_laplacian(starts: Indices, columns: Indices, values: Array, network: _Network) -> None:
    """Take the conductors out of a sparse matrix, in any order of columns."""
    end = np.int64(0)
    for i in range(starts.shape[0] - 1):
        for k in range(starts[i], starts[i + 1]):
            if columns[k] != i and values[k] < 0.0:
                network.neighbors[end] = columns[k]
                network.conductances[end] = -values[k]
                end += 1
        _put_lower_first(network, i, end)


@njit(nogil=True, cache=True)
def _closest(network: _Network, node: int, groups: Indices, free: bool) -> int:
    """Find the neighbour, free or grouped, that is tied most strongly to a node, or -1.

    A pair's quality is its conductance relative to the harmonic mean of the two degrees
    (Napov and Notay, Eq. 3.6, for rows that sum to zero).
    """
    inverses = network.inverse_degrees
    best = -1
    highest = 0.0
    for k in range(network.starts[node], network.starts[node + 1]):
        other = network.neighbors[k]
        if (groups[other] < 0) == free:
            tie = network.conductances[k] * (inverses[node] + inverses[other])
            if tie > highest:
                highest = tie
                best = other
    return best


@njit(nogil=True, cache=True)
def _pair(network: _Network, start: int, stop: int, groups: Indices, first: int) -> int:
    """Group each node with a free neighbour, or with a pair; groups count from `first`.

    Returns the number after the last group, or -1 if a node has no neighbour at all.
    """
    for i in range(start, stop):
        groups[i] = -1
    count = first
    for i in range(start, stop):
        if groups[i] >= 0:
            continue
        partner = _closest(network, i, groups, True)
        if partner >= 0:
            groups[i] = count
            groups[partner] = count
            count += 1
        else:
            partner = _closest(network, i, groups, False)
            if partner < 0:
                return -1
            groups[i] = groups[partner]
    return count


@njit(nogil=True, cache=True)
def _list_members(
    start: int, stop: int, groups: Indices, first: int, last: int
) -> tuple[Indices, Indices]:
    """Sort the nodes by group: the places where each group begins, and the nodes."""
    begins = np.zeros(last - first + 1, np.int32)
    for i in range(start, stop):
        begins[groups[i] - first + 1] += 1
    for g in range(last - first):
        begins[g + 1] += begins[g]
    filled = begins[:-1].copy()
    members = np.empty(stop - start, np.int32)
    for i in range(start, stop):
        g = groups[i] - first
        members[filled[g]] = i
        filled[g] += 1
    return begins, members


@njit(nogil=True, cache=True)
def _contract(
    fine: _Network,
    start: int,
    stop: int,
    groups: Indices,
    coarse: _Network,
    first: int,
    last: int,
) -> None:
    """Make each group one node, with the sums of the conductances between groups."""
    begins, members = _list_members(start, stop, groups, first, last)
    neighbors = coarse.neighbors
    conductances = coarse.conductances
    place = np.full(last - first, -1, np.int32)
    for g in range(first, last):
        begin = end = coarse.starts[g]
        for m in range(begins[g - first], begins[g - first + 1]):
            node = members[m]
            for k in range(fine.starts[node], fine.starts[node + 1]):
                other = groups[fine.neighbors[k]]
                if other == g:
                    continue
                at = place[other - first]
                if at < begin:
                    place[other - first] = end
                    neighbors[end] = other
                    conductances[end] = fine.conductances[k]
                    end += 1
                else:
                    conductances[at] += fine.conductances[k]
        _put_lower_first(coarse, g, end)


@njit(nogil=True, cache=True)
def _compose(start: int, stop: int, groups: Indices, parents: Indices) -> None:
    """Replace each node's group by that group's parent."""
    for i in range(start, stop):
        groups[i] = parents[groups[i]]


@njit(nogil=True, cache=True)
def _multiply(start: int, stop: int, network: _Network, x: Array, product: Array) -> None:
    """Multiply by the Laplacian."""
    for i in range(start, stop):
        total = network.degrees[i] * x[i]
        for k in range(network.starts[i], network.starts[i + 1]):
            total -= network.conductances[k] * x[network.neighbors[k]]
        product[i] = total


@njit(nogil=True, cache=True)
def _descend(
    start: int, stop: int, end: int, network: _Network, parents: Indices, vectors: _Vectors
) -> None:
    """Sweep forward from zero and hand what is left to the next level, up to `end`.

    After such a sweep only the conductors to higher nodes leave a residual, and each is
    also an entry of the higher node's row: both are done in one walk over half the entries.
    """
    residual = vectors.residual
    x = vectors.correction
    for i in range(stop, end):
        residual[i] = 0.0
    for i in range(start, stop):
        total = residual[i]
        for k in range(network.starts[i], network.middles[i]):
            total += network.conductances[k] * x[network.neighbors[k]]
        value = total * network.inverse_degrees[i]
        x[i] = value
        for k in range(network.starts[i], network.middles[i]):
            residual[parents[network.neighbors[k]]] += network.conductances[k] * value


@njit(nogil=True, cache=True)
def _ascend(start: int, stop: int, network: _Network, parents: Indices, vectors: _Vectors) -> None:
    """Add the next level's correction and sweep backward."""
    x = vectors.correction
    for i in range(start, stop):
        x[i] += x[parents[i]]
    for i in range(stop - 1, start - 1, -1):
        total = vectors.residual[i]
        for k in range(network.starts[i], network.starts[i + 1]):
            total += network.conductances[k] * x[network.neighbors[k]]
        x[i] = total * network.inverse_degrees[i]


@njit(nogil=True, cache=True)
def _solve_coarsest(start: int, stop: int, inverse: Array, vectors: _Vectors) -> None:
    x = vectors.correction
    for i in range(start, stop):
        x[i] = 0.0
    for j in range(stop - start):
        value = vectors.residual[start + j]
        for i in range(stop - start):
            x[start + i] += inverse[j, i] * value


@njit(nogil=True, cache=True)
def _dot(start: int, stop: int, a: Array, b: Array) -> float:
    total = 0.0
    for i in range(start, stop):
        total += a[i] * b[i]
    return total


@njit(nogil=True, cache=True)
def _first_step(
    start: int, stop: int, network: _Network, vectors: _Vectors
) -> tuple[bool, float, float]:
    """Minimise along the level's first correction.

    Returns whether that is good enough (then `correction` is final), the direction's energy
    and the length of the step.
    """
    residual = vectors.residual
    x = vectors.correction
    _multiply(start, stop, network, x, vectors.direction_product)
    energy = _dot(start, stop, x, vectors.direction_product)
    if not energy > 0.0:
        return True, 0.0, 0.0
    before = _dot(start, stop, residual, residual)
    length = _dot(start, stop, x, residual) / energy
    for i in range(start, stop):
        residual[i] -= length * vectors.direction_product[i]
        vectors.direction[i] = x[i]
    if _dot(start, stop, residual, residual) > _GOOD_ENOUGH**2 * before:
        return False, energy, length
    for i in range(start, stop):
        x[i] *= length
    return True, energy, length


@njit(nogil=True, cache=True)
def _second_step(
    start: int, stop: int, network: _Network, vectors: _Vectors, energy: float, length: float
) -> None:
    """Minimise over the plane of the level's first and second corrections."""
    x = vectors.correction
    _multiply(start, stop, network, x, vectors.product)
    mixed = _dot(start, stop, x, vectors.direction_product)
    second_energy = _dot(start, stop, x, vectors.product) - mixed * mixed / energy
    second = 0.0
    if second_energy > 0.0:
        second = _dot(start, stop, x, vectors.residual) / second_energy
    first = length - second * mixed / energy
    for i in range(start, stop):
        x[i] = first * vectors.direction[i] + second * x[i]


@njit(nogil=True, cache=True)
def _cycle(
    bounds: Offsets, network: _Network, parents: Indices, inverse: Array, vectors: _Vectors
) -> None:
    """Turn the residual of level 0 into its correction by one K-cycle.

    The levels are walked with a stack of what the first step of each has found, because
    a cached kernel cannot call itself.
    """
    deepest = bounds.shape[0] - 2
    energies = np.zeros(deepest + 1)
    lengths = np.zeros(deepest + 1)
    returning = np.zeros(deepest + 1, np.bool_)
    level = 0
    while True:
        while level < deepest:
            _descend(bounds[level], bounds[level + 1], bounds[level + 2], network, parents, vectors)
            level += 1
            returning[level] = False
        _solve_coarsest(bounds[level], bounds[level + 1], inverse, vectors)
        done = True
        while done and level > 0:
            level -= 1
            start = bounds[level]
            stop = bounds[level + 1]
            _ascend(start, stop, network, parents, vectors)
            if level == 0:
                return
            if returning[level]:
                _second_step(start, stop, network, vectors, energies[level], lengths[level])
            else:
                done, energies[level], lengths[level] = _first_step(start, stop, network, vectors)
                returning[level] = True
        if done:
            return


@njit(nogil=True, cache=True)
def _turn(n: int, share: float, vectors: _Vectors) -> None:
    """Make the next direction from the correction and a share of the last direction."""
    for i in range(n):
        vectors.direction[i] = vectors.correction[i] - share * vectors.direction[i]


@njit(nogil=True, cache=True)
def _advance(n: int, length: float, solution: Array, vectors: _Vectors) -> None:
    for i in range(n):
        solution[i] += length * vectors.direction[i]
        vectors.residual[i] -= length * vectors.direction_product[i]


def _add_level(network: _Network, parents: Indices, start: int, stop: int) -> tuple[_Network, int]:
    """Pair the nodes of the last level, pair the pairs, append what results.

    Returns the network, which may have moved to make room, and its new number of nodes.
    """
    pairs = _empty_network((stop - start) // 2 + 1, network.starts[stop] - network.starts[start])
    count = _pair(network, start, stop, parents, 0)
    if count < 0:
        raise _not_connected()
    _contract(network, start, stop, parents, pairs, 0, count)
    groups = np.empty(count, np.int32)
    last = _pair(pairs, 0, count, groups, stop)
    if last < 0:
        raise _not_connected()
    network = _with_room(network, network.starts[stop] + pairs.starts[count])
    _contract(pairs, 0, count, groups, network, stop, last)
    _compose(start, stop, parents, groups)
    return network, last


def _with_room(network: _Network, entries: int) -> _Network:
    """Make room for that many entries; a planar network comes with enough."""
    missing = entries - len(network.neighbors)
    if missing <= 0:
        return network
    return network._replace(
        neighbors=np.concatenate([network.neighbors, np.empty(missing, np.int32)]),
        conductances=np.concatenate([network.conductances, np.empty(missing)]),
    )


def _not_connected() -> RuntimeError:
    return RuntimeError(
        "the cells form several groups with no flux between them: "
        "the weights of one group relative to another are not determined"
    )


def _invert_coarsest(network: _Network, start: int, stop: int) -> Array:
    """Invert the last level's Laplacian, with constants made regular."""
    entries = slice(network.starts[start], network.starts[stop])
    graph = csr_array(
        (
            network.conductances[entries],
            network.neighbors[entries] - start,
            network.starts[start : stop + 1] - network.starts[start],
        ),
        shape=(stop - start, stop - start),
    )
    if connected_components(graph, directed=False, return_labels=False) > 1:
        raise _not_connected()
    degrees = network.degrees[start:stop]
    regular = np.diag(degrees) - graph.toarray() + (degrees.mean() or 1.0) / (stop - start)
    inverse: Array = np.linalg.inv(regular)
    return inverse


class LaplacianSolver:
    """Conjugate gradients for a connected graph Laplacian, with a multigrid set up once.

    One object must not be used by several threads at the same time.

    Parameters
    ----------
    laplacian : csr_array, shape (n, n)
        Symmetric, nothing positive off the diagonal, rows sum to zero. Columns may come in
        any order; neighbours should be near in the numbering for speed.
    threads : int
        Most threads to use. Results do not depend on it.

    Raises
    ------
    RuntimeError
        The graph is not connected.

    Examples
    --------
    >>> from scipy.sparse import csr_array
    >>> chain = csr_array(np.array([[1.0, -1, 0], [-1, 3, -2], [0, -2, 2]]))
    >>> solution, iterations, residual = LaplacianSolver(chain).solve(np.array([1.0, 0, -1]))
    >>> solution - solution[2]
    array([1.5, 0.5, 0. ])
    """

    def __init__(self, laplacian: csr_array, *, threads: int = 1) -> None:
        n = int(laplacian.shape[0])
        network = _empty_network(2 * n, 2 * int(laplacian.nnz))
        parents: Indices = np.empty(2 * n, np.int32)
        _read_laplacian(
            laplacian.indptr.astype(np.int32, copy=False),
            laplacian.indices.astype(np.int32, copy=False),
            laplacian.data.astype(np.float64, copy=False),
            network,
        )
        bounds = [0, n]
        while bounds[-1] - bounds[-2] > _COARSEST:
            network, stop = _add_level(network, parents, bounds[-2], bounds[-1])
            bounds.append(stop)
        self._n = n
        self._threads = threads
        self._network = network
        self._parents = parents
        self._inverse = _invert_coarsest(network, bounds[-2], bounds[-1])
        self._bounds: Offsets = np.array(bounds, np.int64)
        self._vectors = _Vectors(*(np.zeros(bounds[-1]) for _ in _Vectors._fields))

    def solve(
        self, right: Array, tolerance: float = 1e-2, max_iterations: int = 200
    ) -> tuple[Array, int, float]:
        """Solve L x = b.

        Parameters
        ----------
        right : ndarray, shape (n,)
            Right side; its mean is ignored.
        tolerance : float
            Norm of the residual to reach, relative to the right side's.
        max_iterations : int
            Most iterations.

        Returns
        -------
        solution : ndarray, shape (n,)
            Of mean zero.
        iterations : int
            Iterations done.
        residual : float
            Relative norm of the residual, more than `tolerance` if it was not reached.
        """
        right = right - right.mean()
        scale = self._norm(right)
        solution: Array = np.zeros(self._n)
        if scale == 0.0:
            return solution, 0, 0.0
        self._vectors.residual[: self._n] = right
        self._vectors.direction[: self._n] = 0.0
        self._vectors.direction_product[: self._n] = 0.0
        energy = 1.0
        iterations = 0
        relative = 1.0
        while relative > tolerance and iterations < max_iterations:
            energy = self._iterate(solution, energy)
            iterations += 1
            relative = self._norm(self._vectors.residual) / scale
            if relative <= tolerance or iterations == max_iterations or not energy > 0.0:
                # the residual was only updated so far, and rounding errors add up
                relative = self._renew_residual(right, solution) / scale
            if not energy > 0.0:
                break
        return solution - solution.mean(), iterations, relative

    def _iterate(self, solution: Array, energy: float) -> float:
        """Do one step of flexible conjugate gradients; return its direction's energy."""
        n = self._n
        vectors = self._vectors
        _cycle(self._bounds, self._network, self._parents, self._inverse, vectors)
        share = _dot(0, n, vectors.correction, vectors.direction_product) / energy
        _turn(n, share, vectors)
        self._multiply(vectors.direction, vectors.direction_product)
        energy = _dot(0, n, vectors.direction, vectors.direction_product)
        if energy > 0.0:
            length = _dot(0, n, vectors.direction, vectors.residual) / energy
            _advance(n, length, solution, vectors)
        return energy

    def _renew_residual(self, right: Array, solution: Array) -> float:
        residual = self._vectors.residual[: self._n]
        self._multiply(solution, residual)
        np.subtract(right, residual, out=residual)
        return self._norm(residual)

    def _multiply(self, x: Array, product: Array) -> None:
        in_ranges(
            _multiply,
            self._n,
            self._threads,
            self._network,
            x,
            product,
            smallest=_WORTH_A_THREAD,
        )

    def _norm(self, x: Array) -> float:
        return float(np.sqrt(_dot(0, self._n, x, x)))
