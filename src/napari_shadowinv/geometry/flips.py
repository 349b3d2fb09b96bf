"""Building, repairing and moving a regular triangulation by flips; see `triangulation`."""

from __future__ import annotations

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.geometry import triangle_mesh
from napari_shadowinv.geometry.compiler import kernel, kernel_that_allocates
from napari_shadowinv.geometry.triangle_mesh import (
    FLIP,
    LEGAL,
    LIFT_BOUND,
    REFLEX_A,
    Mesh,
    after,
    around,
    before,
    certain_turn,
    edge_state,
    excess,
    insertion_order,
    precise_excess,
    push,
    turn,
)

# What to do with a vertex that is proven hidden.
REMOVE, STOP, RAISE, KEEP = range(4)

# How a repair ended.
DONE, HIDDEN, EXHAUSTED = range(3)  # exhausted: the limit of flips was reached

# Where a site was found.
INSIDE, ON_EDGE, ON_CORNER, NOWHERE = range(4)


@kernel
def _symmetric_edge_state(mesh: Mesh, h: int, g: int) -> int:
    """Return the state of the edge h with twin g, whose corners are a = after(h), b = before(h)."""
    # Seen from a distant corner the small differences between the others would be lost, so the
    # nearer one looks. The answer must not depend on the side that the edge was reached from.
    points = mesh.points
    p, a, b, q = mesh.corners[h], mesh.corners[after(h)], mesh.corners[before(h)], mesh.corners[g]
    p_far = abs(points[p, 0] - points[a, 0]) + abs(points[p, 1] - points[a, 1])
    q_far = abs(points[q, 0] - points[b, 0]) + abs(points[q, 1] - points[b, 1])
    if p_far < q_far or (p_far == q_far and p < q):
        return edge_state(points, mesh.weights, mesh.scratch, p, a, b, q)
    state = edge_state(points, mesh.weights, mesh.scratch, q, b, a, p)
    return state if state <= FLIP else 5 - state


@kernel
def _raise_vertex(mesh: Mesh, h: int, a: int, b: int, c: int) -> None:
    """Raise the weight of the vertex at corner h to the lifted plane of (a, b, c)."""
    v = mesh.corners[h]
    weight = mesh.weights[v]
    # Close sites that are coplanar but for rounding would chase each other up by single roundings.
    # A wider step now and then (1, 8, 1, 64, 1, 8, 1, 512 ... roundings) ends that soon.
    mesh.counters[triangle_mesh.RAISES] += 1
    raises = mesh.counters[triangle_mesh.RAISES]
    step = min((raises & -raises) ** 3, 1 << 15)
    rounding = np.nextafter(abs(weight), np.inf) - abs(weight)
    height = precise_excess(mesh.points, mesh.weights, a, b, c, v)
    mesh.weights[v] = weight + max(height, 0.0) + step * rounding
    g = h
    while True:
        push(mesh, g)
        push(mesh, after(g))
        g = around(mesh, g)
        if g == h:
            break


@kernel
def _remove_or_raise(mesh: Mesh, h: int, g: int, reflex_a: bool) -> None:
    """Remove or raise the hidden end of the edge h, whose twin is g."""
    v = after(h) if reflex_a else before(h)
    if mesh.counters[triangle_mesh.POLICY] == REMOVE:
        triangle_mesh.remove(mesh, v)
        return
    p, q = mesh.corners[h], mesh.corners[g]
    corner = mesh.corners[before(h) if reflex_a else after(h)]
    if not reflex_a:
        p, q = q, p
    _raise_vertex(mesh, v, p, q, corner)


@kernel
def restore(mesh: Mesh) -> int:
    """Flip until the stack is empty."""
    # After an insertion into a regular triangulation only edges opposite to the new vertex can
    # be irregular; with EVERYWHERE all four edges around a flip are looked at.
    counters, twins, corners = mesh.counters, mesh.twins, mesh.corners
    while counters[triangle_mesh.TOP] > 0:
        counters[triangle_mesh.TOP] -= 1
        h = mesh.stack[counters[triangle_mesh.TOP]]
        if corners[h - h % 3] < 0:
            continue
        g = twins[h]
        if g < 0:
            continue
        state = _symmetric_edge_state(mesh, h, g)
        if state == LEGAL:
            continue
        if (
            counters[triangle_mesh.FLIPS] + counters[triangle_mesh.RAISES]
            >= counters[triangle_mesh.LIMIT]
        ):
            counters[triangle_mesh.TOP] = 0
            return EXHAUSTED
        if state == FLIP:
            triangle_mesh.flip(mesh, h, g)
            if counters[triangle_mesh.EVERYWHERE] == 1:
                push(mesh, before(h))
                push(mesh, g)
            push(mesh, h)
            push(mesh, before(g))
            continue
        if counters[triangle_mesh.POLICY] == KEEP:
            continue
        if counters[triangle_mesh.POLICY] == STOP:
            counters[triangle_mesh.TOP] = 0
            return HIDDEN
        counters[triangle_mesh.EVERYWHERE] = 1
        _remove_or_raise(mesh, h, g, state == REFLEX_A)
    return DONE


@kernel
def _irregular_edges(mesh: Mesh, t: int) -> int:
    """Find which edges of an inner triangle may be irregular: bit k for the one opposite to k."""
    # Edges that the neighbour has to look at are left out. The triangle's own part of the
    # determinant serves for its three edges.
    corners, twins, points, weights = mesh.corners, mesh.twins, mesh.points, mesh.weights
    e = np.uint32(3 * t)
    second, third = np.uint32(1), np.uint32(2)
    i, j, k = np.uint32(corners[e]), np.uint32(corners[e + second]), np.uint32(corners[e + third])
    irregular = 0
    x0, y0, w0 = points[i, 0], points[i, 1], weights[i]
    ax, ay, a_gain = points[j, 0] - x0, points[j, 1] - y0, weights[j] - w0
    bx, by, b_gain = points[k, 0] - x0, points[k, 1] - y0, weights[k] - w0
    a_square, b_square = ax * ax + ay * ay, bx * bx + by * by
    a_lift, b_lift = a_square - a_gain, b_square - b_gain
    a_size, b_size = a_square + abs(a_gain), b_square + abs(b_gain)
    area, area_size = ax * by - ay * bx, abs(ax * by) + abs(ay * bx)
    for side in range(3):
        h = e + np.uint32(side)
        g = twins[h]
        if g > h:
            q = np.uint32(corners[np.uint32(g)])
            qx, qy, q_gain = points[q, 0] - x0, points[q, 1] - y0, weights[q] - w0
            q_square = qx * qx + qy * qy
            height = (
                (q_square - q_gain) * area
                - a_lift * (qx * by - qy * bx)
                - b_lift * (ax * qy - ay * qx)
            )
            size = (
                (q_square + abs(q_gain)) * area_size
                + a_size * (abs(qx * by) + abs(qy * bx))
                + b_size * (abs(ax * qy) + abs(ay * qx))
            )
            if height < LIFT_BOUND * size:
                irregular |= 1 << side
    return irregular


@kernel
def _is_inner(mesh: Mesh, t: int) -> bool:
    n = mesh.hidden.size
    i, j, k = mesh.corners[3 * t], mesh.corners[3 * t + 1], mesh.corners[3 * t + 2]
    return bool(i < n and j < n and k < n)


@kernel
def _mark_irregular(mesh: Mesh, t: int) -> bool:
    """Push the edges of triangle t that may be irregular, unless the neighbour looks at them."""
    marked = False
    edges = _irregular_edges(mesh, t) if _is_inner(mesh, t) else 7
    for h in range(3 * t, 3 * t + 3):
        if edges >> (h - 3 * t) & 1:
            g = mesh.twins[h]
            if g > h and (_is_inner(mesh, t) or _symmetric_edge_state(mesh, h, g) != LEGAL):
                push(mesh, h)
                marked = True
    return marked


@kernel
def look_for_irregular(start: int, stop: int, mesh: Mesh, suspects: BoolArray) -> None:
    """Mark the triangles that may have an irregular edge; those at the ghosts always may."""
    for t in range(start, stop):
        suspects[t] = not _is_inner(mesh, t) or _irregular_edges(mesh, t) != 0


@kernel
def _sweep(mesh: Mesh, suspects: BoolArray) -> int:
    """Make every edge locally regular, without inserting hidden sites."""
    # Triangles known to be no suspects are passed over at first; those that a flip makes have
    # their edges looked at anyway.
    counters = mesh.counters
    n_screened = suspects.size
    counters[triangle_mesh.OVERFLOW] = 1
    while counters[triangle_mesh.OVERFLOW] == 1:
        counters[triangle_mesh.OVERFLOW] = 0
        t = 0
        while t < counters[triangle_mesh.SIZE]:
            if mesh.corners[3 * t] < 0 or (t < n_screened and not suspects[t]):
                marked = False
            elif counters[triangle_mesh.POLICY] == RAISE:
                triangle_mesh.push_triangle(mesh, t)
                marked = True
            else:
                marked = _mark_irregular(mesh, t)
            if marked:
                counters[triangle_mesh.EVERYWHERE] = 1
                status = restore(mesh)
                if status != DONE:
                    return status
            t += 1
        n_screened = 0
    return DONE


@kernel
def _locate(mesh: Mesh, v: int) -> tuple[int, int]:
    """Walk to site v; return where it is, and that triangle's corner, edge or first corner."""
    corners, twins, points = mesh.corners, mesh.twins, mesh.points
    h = 3 * mesh.counters[triangle_mesh.LAST]
    side = turn(points, mesh.scratch, corners[h + 1], corners[h + 2], v)
    if side < 0:
        h, side = twins[h], 1
    noise = v + 1  # visiting the other two edges in random order, it cannot go in circles
    steps = 0
    while steps < 4 * mesh.counters[triangle_mesh.SIZE] + 1000:
        steps += 1
        noise = (noise * 1103515245 + 12345) & 0x7FFFFFFF
        swap = (noise >> 16) & 1
        first, second = after(h), before(h)
        if swap:
            first, second = second, first
        first_side = turn(points, mesh.scratch, corners[after(first)], corners[before(first)], v)
        if first_side < 0:
            h, side = twins[first], 1
            if h < 0:
                break
            continue
        second_side = turn(points, mesh.scratch, corners[after(second)], corners[before(second)], v)
        if second_side < 0:
            h, side = twins[second], 1
            if h < 0:
                break
            continue
        zeros = (side == 0) + (first_side == 0) + (second_side == 0)
        if zeros == 0:
            return INSIDE, h
        if zeros == 1:
            return ON_EDGE, h if side == 0 else (first if first_side == 0 else second)
        # The corner that two edges meet at is opposite to the third.
        return ON_CORNER, h if side != 0 else (first if first_side != 0 else second)
    return NOWHERE, 0


@kernel
def insert(mesh: Mesh, v: int, certainty: float) -> int:
    """Insert site v where its power cell is not empty."""
    # The certainty in units of the error bound: 1 lets in a site that may touch the lower hull
    # (zero area), -1 only one that lies certainly below it, infinity any.
    where, h = _locate(mesh, v)
    if where == NOWHERE:
        return EXHAUSTED
    mesh.counters[triangle_mesh.LAST] = h // 3
    if where == ON_CORNER:
        u, weights = mesh.corners[h], mesh.weights
        if weights[u] > weights[v] or (weights[u] == weights[v] and u < v):
            return DONE
        triangle_mesh.replace(mesh, h, v)
    else:
        a, b, c = mesh.corners[h], mesh.corners[after(h)], mesh.corners[before(h)]
        height, bound = excess(mesh.points, mesh.weights, a, b, c, v)
        if height > certainty * bound:
            return DONE
        mesh.hidden[v] = False
        if where == INSIDE:
            triangle_mesh.split_triangle(mesh, h // 3, v)
        else:
            triangle_mesh.split_edge(mesh, h, v)
    mesh.counters[triangle_mesh.EVERYWHERE] = 0
    return restore(mesh)


@kernel_that_allocates
def _return_hidden(mesh: Mesh) -> int:
    """Insert the hidden sites that lie below the lower hull."""
    # One pass is enough: an insertion lowers the hull, so a site above it stays hidden.
    for v in range(mesh.hidden.size):
        if mesh.hidden[v]:
            status = insert(mesh, v, -1.0)
            if status != DONE:
                return status
    return DONE


@kernel
def _reset_counters(mesh: Mesh, policy: int) -> None:
    for counter in (triangle_mesh.TOP, triangle_mesh.FLIPS, triangle_mesh.RAISES):
        mesh.counters[counter] = 0
    mesh.counters[triangle_mesh.POLICY] = policy


@kernel_that_allocates
def repair(mesh: Mesh, policy: int, suspects: BoolArray) -> int:
    """Make any valid triangulation regular; `suspects` are `look_for_irregular`'s, or empty."""
    _reset_counters(mesh, policy)
    status = _sweep(mesh, suspects)
    if status == DONE:
        status = _return_hidden(mesh)
    if status == DONE and mesh.counters[triangle_mesh.OVERFLOW] == 1:
        status = _sweep(mesh, suspects[:0])
    triangle_mesh.compact(mesh)
    return status


@kernel
def _insert_on_hull(mesh: Mesh, v: int) -> int:
    """Raise the weight of site v to the lower hull and insert it."""
    where, h = _locate(mesh, v)
    if where == NOWHERE:
        return EXHAUSTED
    mesh.counters[triangle_mesh.LAST] = h // 3
    a, b, c = mesh.corners[h], mesh.corners[after(h)], mesh.corners[before(h)]
    if where == ON_CORNER:
        mesh.weights[v] = max(mesh.weights[v], mesh.weights[a])
        return DONE
    height = precise_excess(mesh.points, mesh.weights, a, b, c, v)
    mesh.weights[v] += max(height, 0.0)
    return insert(mesh, v, np.inf)


@kernel_that_allocates
def raise_hidden(mesh: Mesh) -> int:
    """Raise the weights of hidden sites to the lower hull and insert all but duplicates."""
    # Rounding leaves some of them a trace above the hull; these are raised a trace more, until
    # none is hidden. Where the weights' own rounding exceeds the squared distance of sites times
    # the relative rounding (tight clusters), that may not end; then the trace is left.
    _reset_counters(mesh, KEEP)
    for v in insertion_order(mesh.hidden.size):
        if mesh.hidden[v] and _insert_on_hull(mesh, v) == EXHAUSTED:
            return EXHAUSTED
    on_hull = mesh.weights.copy()
    mesh.counters[triangle_mesh.POLICY] = RAISE
    if _sweep(mesh, np.empty(0, np.bool_)) == EXHAUSTED:
        for v in range(on_hull.size):
            mesh.weights[v] = on_hull[v]
    triangle_mesh.compact(mesh)
    return DONE


@kernel
def _start_with_ghosts(mesh: Mesh) -> None:
    """Make two triangles of ghosts, with no site."""
    n = mesh.hidden.size
    mesh.counters[:] = 0
    mesh.counters[triangle_mesh.SIZE], mesh.counters[triangle_mesh.FREE] = 2, -1
    mesh.counters[triangle_mesh.POLICY], mesh.counters[triangle_mesh.LIMIT] = REMOVE, 100 * n + 1000
    mesh.hidden[:] = True
    for h, corner in enumerate((n, n + 1, n + 2, n + 2, n + 3, n)):
        mesh.corners[h] = corner
    mesh.twins[:6] = -1
    mesh.twins[1], mesh.twins[4] = 4, 1


@kernel_that_allocates
def _sort_triangles(mesh: Mesh) -> None:
    """Store the triangles in the order of their smallest corner: neighbours close in memory."""
    m, n = mesh.counters[triangle_mesh.SIZE], mesh.hidden.size
    starts = np.zeros(n + 5, dtype=np.int32)
    smallest = np.empty(m, dtype=np.int32)
    for t in range(m):
        smallest[t] = min(mesh.corners[3 * t], mesh.corners[3 * t + 1], mesh.corners[3 * t + 2])
        starts[smallest[t] + 1] += 1
    for k in range(n + 4):
        starts[k + 1] += starts[k]
    places = smallest
    for t in range(m):
        k = smallest[t]
        places[t] = starts[k]
        starts[k] += 1
    corners = mesh.corners[: 3 * m].copy()
    twins = mesh.twins[: 3 * m].copy()
    for t in range(m):
        s = places[t]
        for k in range(3):
            g = twins[3 * t + k]
            mesh.corners[3 * s + k] = corners[3 * t + k]
            mesh.twins[3 * s + k] = 3 * places[g // 3] + g % 3 if g >= 0 else -1
    mesh.counters[triangle_mesh.LAST] = places[mesh.counters[triangle_mesh.LAST]]


@kernel_that_allocates
def build(mesh: Mesh, order: IntArray, first: int, last: int) -> int:
    """Insert the sites `order[first:last]`; the first part starts a mesh, the last finishes it."""
    if first == 0:
        _start_with_ghosts(mesh)
    status = DONE
    for v in order[first:last]:
        status = insert(mesh, v, 1.0)
        if status != DONE:
            break
    if status == DONE and last < order.size:
        return DONE
    if status == DONE and mesh.counters[triangle_mesh.OVERFLOW] == 1:
        status = _sweep(mesh, np.empty(0, np.bool_))
    triangle_mesh.compact(mesh)
    _sort_triangles(mesh)
    return status


@kernel_that_allocates
def add(mesh: Mesh, order: IntArray) -> int:
    """Insert sites that are in the arrays of the mesh, but not yet in its triangles."""
    _reset_counters(mesh, REMOVE)
    status = DONE
    for v in order:
        status = insert(mesh, v, 1.0)
        if status != DONE:
            break
    if status == DONE and mesh.counters[triangle_mesh.OVERFLOW] == 1:
        status = _sweep(mesh, np.empty(0, np.bool_))
    triangle_mesh.compact(mesh)
    return status


@kernel
def look_for_overturned(start: int, stop: int, mesh: Mesh, suspects: BoolArray) -> None:
    """Mark the triangles that may be overturned."""
    corners = mesh.corners
    for t in range(start, stop):
        i, j, k = corners[3 * t], corners[3 * t + 1], corners[3 * t + 2]
        suspects[t] = certain_turn(mesh.points, i, j, k) <= 0


@kernel
def return_overturned(
    mesh: Mesh, suspects: BoolArray, origins: FloatArray, strays: BoolArray
) -> bool:
    """Move corners of overturned suspects back to their origins; return if there were any."""
    overturned = False
    for t in range(suspects.size):
        if not suspects[t]:
            continue
        i, j, k = mesh.corners[3 * t], mesh.corners[3 * t + 1], mesh.corners[3 * t + 2]
        if turn(mesh.points, mesh.scratch, i, j, k) <= 0:
            overturned = True
            for v in (i, j, k):
                if v < strays.size:
                    mesh.points[v, 0], mesh.points[v, 1] = origins[v, 0], origins[v, 1]
                    strays[v] = True
    return overturned


@kernel
def _remove_strays(mesh: Mesh, strays: BoolArray) -> int:
    """Remove the strays that are in the triangulation."""
    removed = True
    while removed:  # flips may move a stray to a triangle that the pass has left behind
        removed = False
        for h in range(3 * mesh.counters[triangle_mesh.SIZE]):
            v = mesh.corners[h]
            if mesh.corners[h - h % 3] >= 0 and v < strays.size and strays[v]:
                removed = True
                triangle_mesh.remove(mesh, h)
                mesh.counters[triangle_mesh.EVERYWHERE] = 1
                if restore(mesh) != DONE:
                    return EXHAUSTED
    return DONE


@kernel_that_allocates
def put_strays(mesh: Mesh, targets: FloatArray, strays: BoolArray) -> int:
    """Move strays to their targets in a regular mesh, and insert what is hidden."""
    n = targets.shape[0]
    status = _remove_strays(mesh, strays)
    # By single numbers: numba takes two seconds to compile assignments of arrays.
    for v in range(n):
        if strays[v]:
            mesh.points[v, 0], mesh.points[v, 1] = targets[v, 0], targets[v, 1]
    for v in range(n):
        if mesh.hidden[v] and status == DONE:
            status = insert(mesh, v, 1.0 if strays[v] else -1.0)
    triangle_mesh.compact(mesh)
    return status
