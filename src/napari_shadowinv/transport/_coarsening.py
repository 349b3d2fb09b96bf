"""Levels of the multigrid: ever fewer nodes, each a group of the level before.

- all levels of a Laplacian: `build_hierarchy`, which returns a `Hierarchy` over one `Network`, and
  the `Blocks` of its large levels
- refuse a graph of several parts: `require_connected`

Large levels are cut into blocks of nodes, which threads sweep side by side. Groups do not cross the
cuts, and the conductors that do, the `Cuts`, are few. The number of blocks follows from that of the
nodes, so that results do not depend on the threads.

See `napari_shadowinv.transport.linear`.
"""

from __future__ import annotations

from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import in_ranges
from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.geometry.compiler import kernel, njit
from napari_shadowinv.geometry.triangle_mesh import Indices

_NOT_CONNECTED = (
    "the cells form several groups with no flux between them, so the relative weights of the "
    "groups are undetermined"
)


class Rows(NamedTuple):
    """Rows of a sparse matrix, as kernels take them."""

    starts: Indices
    columns: Indices
    values: FloatArray

    @classmethod
    def of(cls, matrix: csr_array) -> Rows:
        starts, columns = (
            indices.astype(np.int32, copy=False) for indices in (matrix.indptr, matrix.indices)
        )
        return cls(starts, columns, matrix.data.astype(np.float64, copy=False))


class Network(NamedTuple):
    """Conductors as rows of (neighbour, conductance).

    Those to lower nodes of the same block come first, and those to other blocks last.
    """

    starts: Indices
    middles: Indices  # where those to higher nodes begin
    ends: Indices  # where those to other blocks begin
    neighbors: Indices
    conductances: NDArray[np.float32]  # whose sums the degrees are, so nothing leaks
    degrees: FloatArray
    inverse_degrees: FloatArray


class Cuts(NamedTuple):
    """Conductors between blocks of a level: their ends, `first` > `second`."""

    first: Indices
    second: Indices
    conductances: FloatArray
    nodes: Indices  # all ends, each once
    saved: FloatArray  # room for a value of each


class Blocks(NamedTuple):
    """Blocks of a level: block b has the nodes from `bounds[b]` to `bounds[b + 1]`.

    Their groups, nodes of the next level, are `groups[b]` to `groups[b + 1]`.
    """

    bounds: IntArray
    groups: IntArray
    cuts: Cuts


class Hierarchy(NamedTuple):
    """Data of one cycle: the nodes of level k are `bounds[k]` to `bounds[k + 1]`."""

    bounds: IntArray
    twice: BoolArray
    network: Network
    parents: Indices
    inverse: FloatArray


def _empty_network(nodes: int, entries: int) -> Network:
    return Network(
        np.zeros(nodes + 1, np.int32),
        np.empty(nodes, np.int32),
        np.empty(nodes, np.int32),
        np.empty(entries, np.int32),
        np.empty(entries, np.float32),
        np.empty(nodes),
        np.empty(nodes),
    )


@kernel
def _sort_row(
    network: Network, begin: np.uint32, end: np.uint32, node: int | np.uint32, low: int, high: int
) -> None:
    """Sort the row of a node, whose block is from `low` to `high`, and sum its conductances."""
    starts, middles, ends, neighbors, conductances, degrees, inverse_degrees = network
    step = np.uint32(1)
    middle = begin
    crossing = False
    degree = 0.0
    for k in range(begin, end):
        neighbor, conductance = neighbors[k], conductances[k]
        degree += conductance
        neighbors[k], conductances[k] = neighbors[middle], conductances[middle]
        neighbors[middle], conductances[middle] = neighbor, conductance
        middle += step if low <= neighbor < node else np.uint32(0)
        crossing |= neighbor < low or neighbor >= high
    last = end
    if crossing:
        last = middle
        for k in range(middle, end):
            neighbor, conductance = neighbors[k], conductances[k]
            if low <= neighbor < high:
                neighbors[k], conductances[k] = neighbors[last], conductances[last]
                neighbors[last], conductances[last] = neighbor, conductance
                last += step
    starts[node], middles[node], ends[node] = begin, middle, last
    degrees[node] = degree
    inverse_degrees[node] = 1.0 / degree if degree != 0.0 else np.inf


@kernel
def _read_blocks(
    first: int, last: int, blocks: IntArray, rows: Rows, network: Network, spans: IntArray
) -> None:
    """Take the conductors of blocks out of a sparse matrix, in any order of columns."""
    starts, columns, values = rows
    neighbors, conductances = network.neighbors, network.conductances
    step = np.uint32(1)
    end = np.uint32(starts[blocks[first]])
    for b in range(first, last):
        low, high = blocks[b], blocks[b + 1]
        spans[b, 0] = end
        for i in range(np.uint32(low), np.uint32(high)):
            begin = end
            for k in range(np.uint32(starts[i]), np.uint32(starts[i + step])):
                if columns[k] != i and values[k] < 0.0:
                    neighbors[end] = columns[k]
                    conductances[end] = -values[k]
                    end += step
            _sort_row(network, begin, end, i, low, high)
        spans[b, 1] = end


def _close_gaps(network: Network, blocks: IntArray, spans: IntArray) -> None:
    """Move the entries of each block to the end of those of the block before."""
    end = int(spans[0, 1])
    for b, (first, last) in enumerate(spans[1:].tolist(), 1):
        if first > end:
            for entries in (network.neighbors, network.conductances):
                entries[end : end + last - first] = entries[first:last]
            for row_bounds in (network.starts, network.middles, network.ends):
                row_bounds[blocks[b] : blocks[b + 1]] -= first - end
        end += last - first
    network.starts[blocks[-1]] = end


@njit(nogil=True, cache=True)
def _list_cuts(network: Network, start: int, stop: int) -> Cuts:
    """List the conductors between blocks of the nodes of a level."""
    starts, _, ends, neighbors, conductances, _, _ = network
    count = 0
    for i in range(start, stop):
        count += starts[i + 1] - ends[i]
    first, second = np.empty(count // 2, np.int32), np.empty(count // 2, np.int32)
    values = np.empty(count // 2)
    nodes = np.empty(count, np.int32)
    end = last = 0
    for i in range(start, stop):
        if ends[i] < starts[i + 1]:
            nodes[last] = i
            last += 1
        for k in range(ends[i], starts[i + 1]):
            if neighbors[k] < i:
                first[end], second[end], values[end] = i, neighbors[k], conductances[k]
                end += 1
    return Cuts(first, second, values, nodes[:last], np.empty(last))


class _Pairing(NamedTuple):
    """Groups of the nodes of a level, made along its stronger ties."""

    network: Network
    weakest: float  # of the ties
    inverses: FloatArray  # of the nodes' degrees
    groups: Indices  # of each node, numbered from `first` on
    first: int
    group_inverses: FloatArray


@kernel
def _pair(pairing: _Pairing, start: int, stop: int, count: int) -> int:
    """Group each node of a block with a free neighbour or a group.

    Groups are numbered from `count` on; the number after the last one is returned.
    """
    # A tie is a conductance times the sum of the inverses of the two sides' degrees, where a
    # group's degree is the sum over the nodes of the level it stands for (Napov and Notay,
    # Eq. 3.6, for rows that sum to zero). The inverses are given for the nodes and found for
    # the groups. Nodes without a tie of at least `weakest` stay alone: where both sides are
    # held much more strongly by others, the sweeps do not smooth an error that differs between
    # them.
    network, weakest, inverses, groups, first, group_inverses = pairing
    starts, _, ends, neighbors, conductances, _, _ = network
    for i in range(start, stop):
        groups[i] = -1
    for i in range(np.uint32(start), np.uint32(stop)):
        if groups[i] >= 0:
            continue
        free = taken = -1
        free_tie = taken_tie = weakest
        for k in range(np.uint32(starts[i]), np.uint32(ends[i])):
            neighbour = np.uint32(neighbors[k])
            group = groups[neighbour]
            if group < 0:
                tie = conductances[k] * (inverses[i] + inverses[neighbour])
                if tie > free_tie:
                    free, free_tie = int(neighbour), tie
            else:
                tie = conductances[k] * (inverses[i] + group_inverses[np.uint32(group - first)])
                if tie > taken_tie:
                    taken, taken_tie = group, tie
        if free >= 0:
            groups[i] = groups[free] = count
            group_inverses[count - first] = _join_inverses(inverses[i], inverses[free])
            count += 1
        elif taken >= 0:
            groups[i] = taken
            group_inverses[taken - first] = _join_inverses(
                inverses[i], group_inverses[taken - first]
            )
        else:
            groups[i] = count
            group_inverses[count - first] = inverses[i]
            count += 1
    return count


@kernel
def _join_inverses(a: float, b: float) -> float:
    """Return the inverse of the sum of two numbers from their inverses."""
    return a * b / (a + b)


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


def _contract(
    fine: Network,
    nodes: IntArray,
    groups: Indices,
    coarse: Network,
    blocks: IntArray,
    joined: IntArray,
    threads: int,
) -> None:
    """Make each group one node, with the sums of the conductances between groups.

    Groups stay in the block of their nodes, or in the union of several that has `joined` bounds.
    """
    spans = np.empty((len(nodes) - 1, 2), np.int64)
    unions = joined.searchsorted(blocks[:-1], "right")
    within = np.stack([joined[unions - 1], joined[unions]], axis=1)
    contraction = nodes, fine, groups, coarse, blocks, within, spans
    in_ranges(_contract_blocks, len(spans), threads, *contraction, smallest=1)
    _close_gaps(coarse, blocks, spans)


@njit(nogil=True, cache=True, error_model="numpy")
def _contract_blocks(
    first: int,
    last: int,
    nodes: IntArray,
    fine: Network,
    groups: Indices,
    coarse: Network,
    blocks: IntArray,
    within: IntArray,
    spans: IntArray,
) -> None:
    """Fill the rows of blocks of the coarse network."""
    lowest, highest = blocks[0], blocks[-1]
    place = np.full(highest - lowest, -1, np.int32)
    end = coarse.starts[lowest] + fine.starts[nodes[first]] - fine.starts[nodes[0]]
    for b in range(first, last):
        low, high = blocks[b], blocks[b + 1]
        begins, members = _list_members(nodes[b], nodes[b + 1], groups, low, high)
        spans[b, 0] = end
        end = _sum_conductances(
            fine, groups, begins, members, place, coarse, end, low, lowest, within[b]
        )
        spans[b, 1] = end


@kernel
def _sum_conductances(
    fine: Network,
    groups: Indices,
    begins: Indices,
    members: Indices,
    place: Indices,
    coarse: Network,
    start: int,
    first: int,
    lowest: int,
    within: IntArray,
) -> int:
    """Fill the rows of groups from `first` on with entries from `start` on, and return their end.

    `place` holds an entry before `start`, or -1, for each group from `lowest` on.
    """
    starts, _, _, neighbors, conductances, _, _ = fine
    coarse_neighbors, coarse_conductances = coarse.neighbors, coarse.conductances
    step, offset = np.uint32(1), np.uint32(lowest)
    end = np.int32(start)
    for group in range(np.uint32(begins.size - 1)):
        begin = end
        g = group + np.uint32(first)
        for m in range(np.uint32(begins[group]), np.uint32(begins[group + step])):
            node = np.uint32(members[m])
            for k in range(np.uint32(starts[node]), np.uint32(starts[node + step])):
                adjacent = np.uint32(groups[np.uint32(neighbors[k])])
                if adjacent == g:
                    continue
                at = place[adjacent - offset]
                if at < begin:
                    place[adjacent - offset] = end
                    coarse_neighbors[np.uint32(end)] = adjacent
                    coarse_conductances[np.uint32(end)] = conductances[k]
                    end += 1
                else:
                    coarse_conductances[np.uint32(at)] += conductances[k]
        _sort_row(coarse, np.uint32(begin), np.uint32(end), g, within[0], within[1])
    return int(end)


def build_hierarchy(
    laplacian: csr_array, ground: FloatArray | None, *, nodes_per_block: int, threads: int
) -> tuple[Hierarchy, list[Blocks]]:
    """Group nodes, and groups of nodes, until few are left; see `LaplacianSolver`.

    The levels that are cut into blocks come first.
    """
    n = int(laplacian.shape[0])
    if n >= 2 * nodes_per_block:
        # Where nodes have few neighbours in their block, only all together can be grouped.
        with suppress(RuntimeError):
            return _build_levels(laplacian, ground, nodes_per_block, threads)
    return _build_levels(laplacian, ground, n + 1, threads)


def _join_blocks(bounds: IntArray, nodes_per_block: int) -> IntArray:
    """Return the bounds of as many unions of blocks as pay for a level."""
    blocks = len(bounds) - 1
    count = min(max(int(bounds[-1] - bounds[0]) // nodes_per_block, 1), blocks)
    return bounds[np.arange(count + 1) * blocks // count]


def _build_levels(
    laplacian: csr_array,
    ground: FloatArray | None,
    nodes_per_block: int,
    threads: int,
    *,
    coarsest: int = 60,
    most_blocks: int = 8,
) -> tuple[Hierarchy, list[Blocks]]:
    n = int(laplacian.shape[0])
    # every level has at most three quarters of the nodes of the last, so 4 n are enough;
    # pages that are never touched take no memory
    network = _empty_network(4 * n + coarsest, 2 * int(laplacian.nnz))
    parents: Indices = np.empty(4 * n + coarsest, np.int32)
    count = min(max(n // nodes_per_block, 1), most_blocks)
    block_bounds = np.arange(count + 1) * n // count
    spans = np.empty((count, 2), np.int64)
    operands = block_bounds, Rows.of(laplacian), network, spans
    in_ranges(_read_blocks, count, threads, *operands, smallest=1)
    _close_gaps(network, block_bounds, spans)
    _tie_to_ground(network, 0, ground)
    bounds, blocks = [0, n], []
    while bounds[-1] - bounds[-2] > coarsest:
        network, groups = _add_level(network, parents, block_bounds, nodes_per_block, threads)
        if len(block_bounds) > 2:
            cuts = _list_cuts(network, bounds[-2], bounds[-1])
            blocks.append(Blocks(block_bounds, groups, cuts))
        block_bounds = _join_blocks(groups, nodes_per_block)
        last = int(groups[-1])
        if ground is not None:
            of_group = parents[bounds[-2] : bounds[-1]] - bounds[-1]
            ground = np.bincount(of_group, ground, last - bounds[-1]).astype(np.float64)
            _tie_to_ground(network, bounds[-1], ground)
        bounds.append(last)
    hierarchy = Hierarchy(
        np.array(bounds, np.int64),
        _choose_second_steps(network, bounds),
        network,
        parents,
        _invert_coarsest(network, bounds[-2], bounds[-1], grounded=ground is not None),
    )
    return hierarchy, blocks


def _tie_to_ground(network: Network, start: int, ground: FloatArray | None) -> None:
    """Add conductances to a ground at potential 0; the nodes from `start` on have them."""
    if ground is not None:
        nodes = slice(start, start + len(ground))
        network.degrees[nodes] += ground
        network.inverse_degrees[nodes] = 1.0 / network.degrees[nodes]


def _add_level(
    network: Network,
    parents: Indices,
    blocks: IntArray,
    nodes_per_block: int,
    threads: int,
    *,
    weakest_tie: float = 0.2,
    paired_share: float = 0.75,
) -> tuple[Network, IntArray]:
    """Pair the nodes of each block of the last level, and the pairs; return the groups' bounds."""
    start, stop = int(blocks[0]), int(blocks[-1])
    if stop - start > 1 and not network.degrees[start:stop].min() > 0.0:
        raise RuntimeError(_NOT_CONNECTED)
    inverses = np.empty(stop - start)
    for weakest in (weakest_tie, 0.0):
        pairing = _Pairing(network, weakest, network.inverse_degrees, parents, 0, inverses)
        pair_blocks = _pair_blocks(pairing, blocks, threads)
        count = int(pair_blocks[-1])
        if count <= paired_share * (stop - start):
            break
    else:
        raise RuntimeError("the fluxes between cells are not finite, or underflow")
    pairs = _empty_network(count, network.starts[stop] - network.starts[start])
    _contract(network, blocks, parents, pairs, pair_blocks, pair_blocks, threads)
    groups = np.empty(count, np.int32)
    pairing = _Pairing(pairs, weakest_tie, inverses, groups, stop, np.empty(count))
    ends = _pair_blocks(pairing, pair_blocks, threads)
    network = _grow_network(network, network.starts[stop] + pairs.starts[count])
    joined = _join_blocks(ends, nodes_per_block)
    _contract(pairs, pair_blocks, groups, network, ends, joined, threads)
    parents[start:stop] = groups[parents[start:stop]]
    return network, ends


@njit(nogil=True, cache=True)
def _pair_within_blocks(
    begin: int, end: int, pairing: _Pairing, blocks: IntArray, ends: IntArray
) -> None:
    """Pair blocks `begin` to `end`, as if each node of those before made a group of its own."""
    for b in range(begin, end):
        low, high = blocks[b], blocks[b + 1]
        ends[b] = _pair(pairing, low, high, pairing.first + low - blocks[0])


def _pair_blocks(pairing: _Pairing, blocks: IntArray, threads: int) -> IntArray:
    """Pair the nodes of each block; return the bounds of its groups."""
    first, groups, group_inverses = pairing.first, pairing.groups, pairing.group_inverses
    count = len(blocks) - 1
    begins, ends = first + blocks[:-1] - blocks[0], np.empty(count, np.int64)
    in_ranges(_pair_within_blocks, count, threads, pairing, blocks, ends, smallest=1)
    bounds = np.concatenate([[first], first + np.cumsum(ends - begins)])
    for b in range(1, count):
        groups[blocks[b] : blocks[b + 1]] -= begins[b] - bounds[b]
        moved = group_inverses[begins[b] - first : ends[b] - first]
        group_inverses[bounds[b] - first : bounds[b + 1] - first] = moved
    return bounds


def _grow_network(network: Network, entries: int) -> Network:
    """Make room for a number of entries; a planar network comes with enough."""
    missing = entries - len(network.neighbors)
    if missing <= 0:
        return network
    return network._replace(
        neighbors=np.concatenate([network.neighbors, np.empty(missing, np.int32)]),
        conductances=np.concatenate([network.conductances, np.empty(missing, np.float32)]),
    )


def _choose_second_steps(network: Network, bounds: list[int], *, last: int = 3) -> BoolArray:
    """Choose the levels with two steps a cycle: the first ones, if they cost less than level 0.

    More of them than up to the last one hardly save an iteration.
    """
    entries = np.diff(network.starts[bounds])
    twice = np.zeros(len(entries), np.bool_)
    visits = 2
    for level in range(1, min(last + 1, len(entries) - 1)):
        if visits * entries[level] <= entries[0]:
            twice[level] = True
            visits *= 2
    return twice


def _invert_coarsest(network: Network, start: int, stop: int, *, grounded: bool) -> FloatArray:
    """Invert the last level's Laplacian; without a ground, with constants made regular."""
    entries = slice(network.starts[start], network.starts[stop])
    graph = csr_array(
        (
            network.conductances[entries],
            network.neighbors[entries] - start,
            network.starts[start : stop + 1] - network.starts[start],
        ),
        shape=(stop - start, stop - start),
    )
    require_connected(graph)
    degrees = network.degrees[start:stop]
    regular = np.diag(degrees) - graph.toarray()
    if not grounded:
        regular += (degrees.mean() or 1.0) / (stop - start)
    inverse: FloatArray = np.linalg.inv(regular)
    return inverse


def require_connected(graph: csr_array) -> None:
    """Raise a RuntimeError if a symmetric matrix falls into several blocks."""
    starts, columns, _ = Rows.of(graph)
    if _count_reached(starts, columns) < graph.shape[0]:
        raise RuntimeError(_NOT_CONNECTED)


@njit(nogil=True, cache=True)
def _count_reached(starts: Indices, columns: Indices) -> int:
    """Count the nodes that are connected with the first."""
    n = starts.size - 1
    is_reached = np.zeros(n, np.bool_)
    queue = np.zeros(n, np.int32)
    count = min(n, 1)
    is_reached[:count] = True
    done = 0
    while done < count:
        node = queue[done]
        done += 1
        for k in range(starts[node], starts[node + 1]):
            neighbor = columns[k]
            if not is_reached[neighbor]:
                is_reached[neighbor] = True
                queue[count] = neighbor
                count += 1
    return count
