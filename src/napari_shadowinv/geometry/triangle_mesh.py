"""A triangulation as two flat arrays, the moves that change it, and signs that can be trusted.

Points are sorted along a Hilbert curve (`hilbert_order`), or along it in random rounds
(`insertion_order`).

Triangle t has the corners ``corners[3 t : 3 t + 3]``, counter-clockwise. The number
``h = 3 t + k`` stands for both that corner and the edge opposite to it;
``twins[h]`` is the same edge seen from the triangle on its other side, or -1.
A move rewrites the triangles that it touches and puts the edges that may have become
irregular on the stack. Points n to n + 3 are the ghosts.

The orientation is exact: where rounding could hide the sign, it is computed again with
sums of floats that lose nothing (Shewchuk 1997, Discrete Comput. Geom. 18, 305). The weighted
in-circle test of an edge only reports signs that its error bound certifies. Together these make
each flip a true descent of the lifted surface, so flipping ends.

A site at r with weight w is lifted to the height (|r|² - w) / 2; the regular
triangulation is the lower convex hull of the lifted sites. Heights are taken relative to
one of the sites, and doubled: |r - r₀|² - (w - w₀).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.geometry.compiler import kernel, kernel_that_allocates

BITS = 16

# A round of insertion has 2³ - 1 times as many points as all before it.
ROUND_BITS = 3


@kernel
def _distance_along(x: int, y: int) -> int:
    """Return the distance of grid cell (x, y) along the curve, without branches to mispredict."""
    distance = 0
    for bit in range(BITS - 1, -1, -1):
        right, up = (x >> bit) & 1, (y >> bit) & 1
        distance = (distance << 2) | ((3 * right) ^ up)
        turned = -(right & (1 - up))
        x, y = x ^ turned, y ^ turned
        swapped = (x ^ y) & (up - 1)
        x, y = x ^ swapped, y ^ swapped
    return distance


@kernel_that_allocates
def _curve_keys(points: FloatArray) -> NDArray[np.uint64]:
    """Return numbers to sort by: a point's distance along the curve, then its row."""
    n = points.shape[0]
    keys = np.arange(n).astype(np.uint64)
    x_low, x_high = points[:, 0].min(), points[:, 0].max()
    y_low, y_high = points[:, 1].min(), points[:, 1].max()
    extent = max(x_high - x_low, y_high - y_low)
    if extent == 0.0:
        return keys
    last = (1 << BITS) - 1
    scale = (1 << BITS) / extent
    for i in range(n):
        x = min(int((points[i, 0] - x_low) * scale), last)
        y = min(int((points[i, 1] - y_low) * scale), last)
        keys[i] |= np.uint64(_distance_along(x, y)) << np.uint64(32)
    return keys


def hilbert_permutation(points: FloatArray) -> Indices:
    """Sort points along a Hilbert curve through 2¹⁶ × 2¹⁶ cells; those in one keep their order."""
    return (np.sort(_curve_keys(points)) & 0xFFFFFFFF).astype(np.int32)


@kernel
def _insertion_round(k: int) -> int:
    """Return how many rounds before the last point k is inserted, by a hash of k."""
    z = (np.uint64(k) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    rounds = 0
    while rounds < 31 and z & np.uint64((1 << ROUND_BITS) - 1) == 0:
        z >>= np.uint64(ROUND_BITS)
        rounds += 1
    return rounds


@kernel_that_allocates
def insertion_order(n: int) -> IntArray:
    """Permute sorted sites into ever larger random samples, each in order; always the same way."""
    # Biased randomized insertion order, which no arrangement of the sites can spoil: Amenta,
    # Choi and Rote 2003, Proc. 19th Symp. Computational Geometry, 211.
    starts = np.zeros(33, dtype=np.int64)
    for k in range(n):
        starts[32 - _insertion_round(k)] += 1
    total = 0
    for r in range(33):
        total, starts[r] = total + starts[r], total
    order = np.empty(n, dtype=np.int64)
    for k in range(n):
        r = 32 - _insertion_round(k)
        order[starts[r]] = k
        starts[r] += 1
    return order


Twofold = tuple[float, float]

# What to do with the edge a-b between the triangles (p, a, b) and (q, b, a).
# LEGAL: it is locally regular, or so close to it that rounding decides. FLIP: p-q must replace it.
# REFLEX_A: a is hidden, in the triangle (p, q, b), above its lifted plane. REFLEX_B: b likewise.
LEGAL, FLIP, REFLEX_A, REFLEX_B = range(4)

# Error bounds in units of the permanent: (3 + 16 ε) ε for the cross product of two
# differences, 12 ε (+ O(ε²)) for the lifted determinant, ε = 2⁻⁵³; both rounded up.
CROSS_BOUND = 4 * 2.0**-53
LIFT_BOUND = 16 * 2.0**-53

# Veltkamp's constant: splits a float into two halves of 26 bits.
SPLITTER = 2.0**27 + 1.0


@kernel
def _two_difference(a: float, b: float) -> tuple[float, float]:
    """Return a - b rounded, and the rounding error."""
    difference = a - b
    b_virtual = a - difference
    a_virtual = difference + b_virtual
    return difference, (a - a_virtual) + (b_virtual - b)


@kernel
def _two_sum(a: float, b: float) -> tuple[float, float]:
    """Return a + b rounded, and the rounding error."""
    total = a + b
    b_virtual = total - a
    a_virtual = total - b_virtual
    return total, (a - a_virtual) + (b - b_virtual)


@kernel
def _two_product(a: float, b: float) -> tuple[float, float]:
    """Return a·b rounded, and the rounding error."""
    product = a * b
    scaled = SPLITTER * a
    a_high = scaled - (scaled - a)
    a_low = a - a_high
    scaled = SPLITTER * b
    b_high = scaled - (scaled - b)
    b_low = b - b_high
    error = product - a_high * b_high - a_low * b_high - a_high * b_low
    return product, a_low * b_low - error


@kernel
def _grow(terms: FloatArray, count: int, value: float) -> int:
    """Add a float to a sum of non-overlapping terms, smallest first, without loss."""
    for k in range(count):
        value, terms[k] = _two_sum(value, terms[k])
    terms[count] = value
    return count + 1


@kernel
def _grow_product(terms: FloatArray, count: int, a: float, b: float) -> int:
    high, low = _two_product(a, b)
    return _grow(terms, _grow(terms, count, low), high)


@kernel
def _sign(value: float) -> int:
    if value > 0.0:
        return 1
    return -1 if value < 0.0 else 0


@kernel
def _exact_turn(points: FloatArray, terms: FloatArray, a: int, b: int, c: int) -> int:
    ux, ux_tail = _two_difference(points[b, 0], points[a, 0])
    uy, uy_tail = _two_difference(points[b, 1], points[a, 1])
    vx, vx_tail = _two_difference(points[c, 0], points[a, 0])
    vy, vy_tail = _two_difference(points[c, 1], points[a, 1])
    if ux_tail == 0.0 and uy_tail == 0.0 and vx_tail == 0.0 and vy_tail == 0.0:
        x_term, x_tail = _two_product(ux, vy)
        y_term, y_tail = _two_product(uy, vx)
        return _sign(x_term - y_term) if x_term != y_term else _sign(x_tail - y_tail)
    count = _grow_product(terms, 0, ux_tail, vy_tail)
    count = _grow_product(terms, count, -uy_tail, vx_tail)
    count = _grow_product(terms, count, ux_tail, vy)
    count = _grow_product(terms, count, ux, vy_tail)
    count = _grow_product(terms, count, -uy_tail, vx)
    count = _grow_product(terms, count, -uy, vx_tail)
    count = _grow_product(terms, count, ux, vy)
    count = _grow_product(terms, count, -uy, vx)
    for k in range(count - 1, -1, -1):
        if terms[k] != 0.0:
            return _sign(terms[k])
    return 0


@kernel
def certain_turn(points: FloatArray, a: int, b: int, c: int) -> int:
    """Return the sign of cross(b - a, c - a), or 0 where rounding may decide it."""
    x_term = (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1])
    y_term = (points[b, 1] - points[a, 1]) * (points[c, 0] - points[a, 0])
    cross = x_term - y_term
    bound = CROSS_BOUND * (abs(x_term) + abs(y_term))
    if cross > bound:
        return 1
    if cross < -bound:
        return -1
    return 0


@kernel
def turn(points: FloatArray, scratch: FloatArray, a: int, b: int, c: int) -> int:
    """Return the exact sign of cross(b - a, c - a): 1 where a, b, c turn counter-clockwise."""
    sign = certain_turn(points, a, b, c)
    return sign if sign != 0 else _exact_turn(points, scratch, a, b, c)


@kernel
def _lift(
    points: FloatArray, weights: FloatArray, a: int, b: int, c: int, v: int
) -> tuple[float, float, float]:
    """Return the determinant of the lifted a, b, c seen from v, its permanent, and the area."""
    x, y, weight = points[v, 0], points[v, 1], weights[v]
    ax, ay, a_gain = points[a, 0] - x, points[a, 1] - y, weights[a] - weight
    bx, by, b_gain = points[b, 0] - x, points[b, 1] - y, weights[b] - weight
    cx, cy, c_gain = points[c, 0] - x, points[c, 1] - y, weights[c] - weight
    a_square, b_square, c_square = ax * ax + ay * ay, bx * bx + by * by, cx * cx + cy * cy
    bc, ca, ab = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
    height = (a_square - a_gain) * bc + (b_square - b_gain) * ca + (c_square - c_gain) * ab
    size = (
        (a_square + abs(a_gain)) * (abs(bx * cy) + abs(by * cx))
        + (b_square + abs(b_gain)) * (abs(cx * ay) + abs(cy * ax))
        + (c_square + abs(c_gain)) * (abs(ax * by) + abs(ay * bx))
    )
    return height, size, bc + ca + ab


@kernel
def edge_state(
    points: FloatArray, weights: FloatArray, scratch: FloatArray, p: int, a: int, b: int, q: int
) -> int:
    """Classify the edge a-b; p, a, q, b go around it counter-clockwise."""
    height, size, _ = _lift(points, weights, q, a, b, p)
    if height >= -LIFT_BOUND * size:
        return LEGAL
    if turn(points, scratch, p, a, q) <= 0:
        return REFLEX_A
    if turn(points, scratch, p, q, b) <= 0:
        return REFLEX_B
    return FLIP


@kernel
def excess(
    points: FloatArray, weights: FloatArray, a: int, b: int, c: int, v: int
) -> tuple[float, float]:
    """Return by how much the weight of v must rise to touch (a, b, c), and a bound of the error."""
    height, size, area = _lift(points, weights, a, b, c, v)
    if area <= 0.0:
        return 0.0, np.inf
    return -height / area, LIFT_BOUND * size / area


@kernel
def _sum(a: Twofold, b: Twofold) -> Twofold:
    total, error = _two_sum(a[0], b[0])
    return _two_sum(total, error + (a[1] + b[1]))


@kernel
def _product(a: Twofold, b: Twofold) -> Twofold:
    product, error = _two_product(a[0], b[0])
    return _two_sum(product, error + (a[0] * b[1] + a[1] * b[0]))


@kernel
def _cross(ax: Twofold, ay: Twofold, bx: Twofold, by: Twofold) -> Twofold:
    right = _product(ay, bx)
    return _sum(_product(ax, by), (-right[0], -right[1]))


@kernel
def _relative(
    points: FloatArray, weights: FloatArray, a: int, v: int
) -> tuple[Twofold, Twofold, Twofold]:
    """Return the coordinates and doubled height of a, seen from v."""
    x = _two_difference(points[a, 0], points[v, 0])
    y = _two_difference(points[a, 1], points[v, 1])
    loss = _two_difference(weights[v], weights[a])
    return x, y, _sum(_sum(_product(x, x), _product(y, y)), loss)


@kernel
def precise_excess(
    points: FloatArray, weights: FloatArray, a: int, b: int, c: int, v: int
) -> float:
    """Return the height of `excess` in twofold precision: right for slivers, too."""
    ax, ay, a_lift = _relative(points, weights, a, v)
    bx, by, b_lift = _relative(points, weights, b, v)
    cx, cy, c_lift = _relative(points, weights, c, v)
    bc, ca, ab = _cross(bx, by, cx, cy), _cross(cx, cy, ax, ay), _cross(ax, ay, bx, by)
    plane = _sum(_product(a_lift, bc), _sum(_product(b_lift, ca), _product(c_lift, ab)))
    area = _sum(bc, _sum(ca, ab))
    return -plane[0] / area[0] if area[0] > 0.0 else 0.0


Indices = NDArray[np.int32]

# Places in Mesh.counters.
COUNTERS = range(10)
(
    SIZE,  # triangles in use, holes included
    FREE,  # first of the holes, or -1; a hole's first twin is the next one
    TOP,  # edges on the stack
    OVERFLOW,  # 1 when an edge found no room on the stack
    FLIPS,  # flips made
    LIMIT,  # flips allowed
    LAST,  # triangle where the next location starts
    RAISES,  # weights raised
    POLICY,  # for vertices that are proven hidden
    EVERYWHERE,  # 1 to look at all edges around a flip
) = COUNTERS


class Mesh(NamedTuple):
    """State of a triangulation of n sites, as the kernels see it."""

    points: FloatArray  # (n + 4, 2): sites, then the ghosts
    weights: FloatArray  # (n + 4,)
    corners: Indices  # (6 n + 6,); -1 at the first corner of a hole
    twins: Indices  # (6 n + 6,)
    hidden: BoolArray  # (n,): sites that are not in the triangulation
    stack: IntArray  # edges to be looked at
    counters: IntArray
    scratch: FloatArray  # (16,): room for exact sums


@kernel
def after(h: int) -> int:
    """Return the next corner of the same triangle, counter-clockwise."""
    return h - 2 if h % 3 == 2 else h + 1


@kernel
def before(h: int) -> int:
    """Return the previous corner of the same triangle."""
    return h + 2 if h % 3 == 0 else h - 1


@kernel
def around(mesh: Mesh, h: int) -> int:
    """Return the same corner in the next triangle of its star, counter-clockwise."""
    return after(mesh.twins[after(h)])


@kernel
def push(mesh: Mesh, h: int) -> None:
    """Put an edge on the stack."""
    top = mesh.counters[TOP]
    if top < mesh.stack.size:
        mesh.stack[top] = h
        mesh.counters[TOP] = top + 1
    else:
        mesh.counters[OVERFLOW] = 1


@kernel
def _join(mesh: Mesh, h: int, twin: int) -> None:
    mesh.twins[h] = twin
    if twin >= 0:
        mesh.twins[twin] = h


@kernel
def _set_triangle(mesh: Mesh, t: int, a: int, b: int, c: int) -> None:
    mesh.corners[3 * t], mesh.corners[3 * t + 1], mesh.corners[3 * t + 2] = a, b, c


@kernel
def push_triangle(mesh: Mesh, t: int) -> None:
    """Put the edges of a triangle on the stack of edges to check."""
    for h in range(3 * t, 3 * t + 3):
        push(mesh, h)


@kernel
def _new_triangle(mesh: Mesh) -> int:
    t: int = mesh.counters[FREE]
    if t >= 0:
        mesh.counters[FREE] = mesh.twins[3 * t]
        return t
    t = mesh.counters[SIZE]
    mesh.counters[SIZE] = t + 1
    return t


@kernel
def _drop_triangle(mesh: Mesh, t: int) -> None:
    mesh.corners[3 * t] = -1
    mesh.twins[3 * t] = mesh.counters[FREE]
    mesh.counters[FREE] = t


@kernel
def flip(mesh: Mesh, h: int, g: int) -> None:
    """Replace the edge h = a-b of (p, a, b) and (q, b, a) by p-q; g is the twin of h."""
    # Afterwards h is the corner p of (p, a, q), g the corner q of (q, b, p).
    h1, h2, g1, g2 = after(h), before(h), after(g), before(g)
    h_outer, g_outer = mesh.twins[g1], mesh.twins[h1]
    mesh.corners[h2] = mesh.corners[g]
    mesh.corners[g2] = mesh.corners[h]
    _join(mesh, h, h_outer)
    _join(mesh, g, g_outer)
    _join(mesh, h1, g1)
    mesh.counters[FLIPS] += 1


@kernel
def split_triangle(mesh: Mesh, t: int, v: int) -> None:
    """Put v, which lies strictly inside triangle t, into it and push the three edges of t."""
    a, b, c = mesh.corners[3 * t], mesh.corners[3 * t + 1], mesh.corners[3 * t + 2]
    b_outer, c_outer = mesh.twins[3 * t + 1], mesh.twins[3 * t + 2]
    u, s = _new_triangle(mesh), _new_triangle(mesh)
    mesh.corners[3 * t] = v
    _set_triangle(mesh, u, v, c, a)
    _set_triangle(mesh, s, v, a, b)
    _join(mesh, 3 * u, b_outer)
    _join(mesh, 3 * s, c_outer)
    _join(mesh, 3 * t + 1, 3 * u + 2)
    _join(mesh, 3 * u + 1, 3 * s + 2)
    _join(mesh, 3 * s + 1, 3 * t + 2)
    for triangle in (u, s, t):
        push(mesh, 3 * triangle)


@kernel
def split_edge(mesh: Mesh, h: int, v: int) -> None:
    """Put v, which lies strictly inside edge h, into it and push the four edges around it."""
    g = mesh.twins[h]
    t, u = h // 3, g // 3
    p, a, b, q = mesh.corners[h], mesh.corners[after(h)], mesh.corners[before(h)], mesh.corners[g]
    pa, bp = mesh.twins[before(h)], mesh.twins[after(h)]
    qb, aq = mesh.twins[before(g)], mesh.twins[after(g)]
    s, r = _new_triangle(mesh), _new_triangle(mesh)
    _set_triangle(mesh, t, v, p, a)
    _set_triangle(mesh, s, v, a, q)
    _set_triangle(mesh, u, v, q, b)
    _set_triangle(mesh, r, v, b, p)
    _join(mesh, 3 * t, pa)
    _join(mesh, 3 * s, aq)
    _join(mesh, 3 * u, qb)
    _join(mesh, 3 * r, bp)
    _join(mesh, 3 * t + 1, 3 * s + 2)
    _join(mesh, 3 * s + 1, 3 * u + 2)
    _join(mesh, 3 * u + 1, 3 * r + 2)
    _join(mesh, 3 * r + 1, 3 * t + 2)
    for triangle in (t, s, u, r):
        push(mesh, 3 * triangle)


@kernel
def replace(mesh: Mesh, h: int, v: int) -> None:
    """Let v take the place of its duplicate at corner h and push the edges around it."""
    mesh.hidden[mesh.corners[h]] = True
    mesh.hidden[v] = False
    g = h
    while True:
        mesh.corners[g] = v
        push(mesh, g)
        g = around(mesh, g)
        if g == h:
            break


@kernel
def _degree(mesh: Mesh, h: int) -> int:
    degree = 1
    g = around(mesh, h)
    while g != h:
        degree += 1
        g = around(mesh, g)
    return degree


@kernel
def _cut_ears(mesh: Mesh, h: int, degree: int) -> tuple[int, int]:
    """Flip edges away from the vertex at corner h until three are left, or four in a cross."""
    # A star of more than four triangles always has an ear that leaves the vertex strictly
    # inside. One of four has none if and only if the vertex lies on a diagonal.
    refused = 0
    v = mesh.corners[h]
    while degree > 3 and refused < degree:
        e = after(h)
        g = mesh.twins[e]
        p, a, q = mesh.corners[e], mesh.corners[after(e)], mesh.corners[g]
        points, scratch = mesh.points, mesh.scratch
        if turn(points, scratch, p, a, q) > 0 and turn(points, scratch, v, p, q) > 0:
            flip(mesh, e, g)
            push_triangle(mesh, e // 3)
            # Going round instead of staying gives each neighbour its turn: no fans.
            h = around(mesh, after(g))
            degree -= 1
            refused = 0
        else:
            h = around(mesh, h)
            refused += 1
    return h, degree


@kernel
def _merge_three(mesh: Mesh, h: int) -> int:
    g = around(mesh, h)
    f = around(mesh, g)
    t = h // 3
    a, b, c = mesh.corners[after(h)], mesh.corners[after(g)], mesh.corners[after(f)]
    ab, bc, ca = mesh.twins[h], mesh.twins[g], mesh.twins[f]
    _set_triangle(mesh, t, a, b, c)
    _join(mesh, 3 * t, bc)
    _join(mesh, 3 * t + 1, ca)
    _join(mesh, 3 * t + 2, ab)
    _drop_triangle(mesh, g // 3)
    _drop_triangle(mesh, f // 3)
    push_triangle(mesh, t)
    return t


@kernel
def _merge_four(mesh: Mesh, h: int) -> int:
    """Remove a vertex of degree four that lies on a diagonal of its neighbours."""
    v, neighbour = mesh.corners[h], mesh.corners[after(h)]
    opposite = mesh.corners[before(around(mesh, h))]
    if turn(mesh.points, mesh.scratch, neighbour, v, opposite) != 0:
        h = around(mesh, h)
    g = around(mesh, h)
    f = around(mesh, g)
    e = around(mesh, f)
    t, u = h // 3, f // 3
    a, b = mesh.corners[after(h)], mesh.corners[after(g)]
    c, d = mesh.corners[after(f)], mesh.corners[after(e)]
    ab, bc, cd, da = mesh.twins[h], mesh.twins[g], mesh.twins[f], mesh.twins[e]
    _set_triangle(mesh, t, a, b, c)
    _set_triangle(mesh, u, c, d, a)
    _join(mesh, 3 * t, bc)
    _join(mesh, 3 * t + 2, ab)
    _join(mesh, 3 * u, da)
    _join(mesh, 3 * u + 2, cd)
    _join(mesh, 3 * t + 1, 3 * u + 1)
    _drop_triangle(mesh, g // 3)
    _drop_triangle(mesh, e // 3)
    push_triangle(mesh, t)
    push_triangle(mesh, u)
    return t


@kernel
def remove(mesh: Mesh, h: int) -> None:
    """Take the vertex at corner h out of the triangulation and push every edge it leaves."""
    mesh.hidden[mesh.corners[h]] = True
    h, degree = _cut_ears(mesh, h, _degree(mesh, h))
    mesh.counters[LAST] = _merge_three(mesh, h) if degree == 3 else _merge_four(mesh, h)


@kernel
def compact(mesh: Mesh) -> None:
    """Move the last triangles into the holes."""
    corners, twins, counters = mesh.corners, mesh.twins, mesh.counters
    size = counters[SIZE]
    hole = counters[FREE]
    while hole >= 0:
        following = twins[3 * hole]
        while size > 0 and corners[3 * size - 3] < 0:
            size -= 1
        if hole < size:
            size -= 1
            for k in range(3):
                corners[3 * hole + k] = corners[3 * size + k]
                _join(mesh, 3 * hole + k, twins[3 * size + k])
        hole = following
    while size > 0 and corners[3 * size - 3] < 0:
        size -= 1
    counters[SIZE] = size
    counters[FREE] = -1
    counters[LAST] = min(counters[LAST], size - 1)


@kernel_that_allocates
def list_edges(corners: Indices, twins: Indices) -> tuple[Indices, Indices]:
    """List each inner edge once: its two sites a and b; the triangle left of ab and the other."""
    most = corners.size // 2 + 3
    pairs, sides = np.empty((most, 2), np.int32), np.empty((most, 2), np.int32)
    count = _fill_edges(corners, twins, pairs, sides)
    return pairs[:count], sides[:count]


@kernel
def _fill_edges(corners: Indices, twins: Indices, pairs: Indices, sides: Indices) -> int:
    # Written for each side and kept for every second: without branches to mispredict.
    count = np.uint32(0)
    second, third, sides_each = np.uint32(1), np.uint32(2), np.uint32(3)
    for t in range(np.uint32(corners.size // 3)):
        e = sides_each * t
        for side in range(3):
            h = e + np.uint32(side)
            g = twins[h]
            pairs[count, 0] = corners[e + second if side == 0 else (e + third if side == 1 else e)]
            pairs[count, 1] = corners[e + third if side == 0 else (e if side == 1 else e + second)]
            sides[count, 0], sides[count, 1] = t, np.uint32(g) // sides_each
            count += np.uint32(1) if g > h else np.uint32(0)
    return int(count)
