"""Signs that can be trusted: orientation, and the weighted in-circle test of an edge.

The orientation is exact: where rounding could hide the sign, it is computed again with
sums of floats that lose nothing (Shewchuk 1997, Discrete Comput. Geom. 18, 305). The
in-circle test only reports signs that its error bound certifies. Together these make each
flip a true descent of the lifted surface, so flipping ends.

A site at r with weight w is lifted to the height (|r|² - w) / 2; the regular
triangulation is the lower convex hull of the lifted sites. Heights are taken relative to
one of the sites, and doubled: |r - r₀|² - (w - w₀).
"""

from __future__ import annotations

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import kernel

Twofold = tuple[float, float]

# What to do with the edge a-b between the triangles (p, a, b) and (q, b, a).
LEGAL = 0  # it is locally regular, or so close to it that rounding decides
FLIP = 1  # p-q must replace it
REFLEX_A = 2  # a is hidden: it lies in the triangle (p, q, b), above its lifted plane
REFLEX_B = 3  # b is hidden likewise

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
def turn(points: FloatArray, scratch: FloatArray, a: int, b: int, c: int) -> int:
    """Return the exact sign of cross(b - a, c - a): 1 where a, b, c turn counter-clockwise."""
    x_term = (points[b, 0] - points[a, 0]) * (points[c, 1] - points[a, 1])
    y_term = (points[b, 1] - points[a, 1]) * (points[c, 0] - points[a, 0])
    cross = x_term - y_term
    bound = CROSS_BOUND * (abs(x_term) + abs(y_term))
    if cross > bound:
        return 1
    if cross < -bound:
        return -1
    return _exact_turn(points, scratch, a, b, c)


@kernel
def _lifted(
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
    height, size, _ = _lifted(points, weights, q, a, b, p)
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
    height, size, area = _lifted(points, weights, a, b, c, v)
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
