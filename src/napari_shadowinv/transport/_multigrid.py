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
    degrees = network.degrees
    best = -1
    highest = 0.0
    for k in range(network.starts[node], network.starts[node + 1]):
        other = network.neighbors[k]
        if (groups[other] < 0) == free:
            tie = network.conductances[k] * (1.0 / degrees[node] + 1.0 / degrees[other])
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
        value = total / network.degrees[i]
        x[i] = value
        for k in range(network.starts[i], network.middles[i]):
            residual[parents[network.neighbors[k]]] += network.conductances[k] * value


@njit(nogil=True, cache=True)
def _ascend(
    start: int, stop: int, network: _Network, parents: Indices, vectors: _Vectors
) -> None:
    """Add the next level's correction and sweep backward."""
    x = vectors.correction
    for i in range(start, stop):
        x[i] += x[parents[i]]
    for i in range(stop - 1, start - 1, -1):
        total = vectors.residual[i]
        for k in range(network.starts[i], network.starts[i + 1]):
            total += network.conductances[k] * x[network.neighbors[k]]
        x[i] = total / network.degrees[i]


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
            _descend(
                bounds[level], bounds[level + 1], bounds[level + 2], network, parents, vectors
            )
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


