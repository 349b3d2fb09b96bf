"""A triangulation as two flat arrays, and the moves that change it.

Triangle t has the corners ``corners[3 t : 3 t + 3]``, counter-clockwise. The number
``h = 3 t + k`` stands for both that corner and the edge opposite to it;
``twins[h]`` is the same edge seen from the triangle on its other side, or -1.
A move rewrites the triangles that it touches and puts the edges that may have become
irregular on the stack. Points n to n + 3 are the ghosts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.geometry._predicates import turn
from napari_shadowinv.geometry.compiler import kernel

Indices = NDArray[np.int32]

# Places in Mesh.counters.
SIZE = 0  # triangles in use, holes included
FREE = 1  # first of the holes, or -1; a hole's first twin is the next one
TOP = 2  # edges on the stack
OVERFLOW = 3  # 1 when an edge found no room on the stack
FLIPS = 4  # flips made
LIMIT = 5  # flips allowed
LAST = 6  # triangle where the next location starts
RAISES = 7  # weights raised
POLICY = 8  # for vertices that are proven hidden
EVERYWHERE = 9  # 1 to look at all edges around a flip
N_COUNTERS = 10


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
