"""Kernels of `RayModel`: rays of a cell between knots, their landing points, and the derivatives.

A cell's side is two pixels of the beam. Its rays start at the middles of n × m equal parts. Each
row of them is traced at once; the spline's values along y, which a row shares, are evaluated once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray, IntArray
from napari_shadowinv.geometry.compiler import njit

KNOT = 2  # px between knots
MOST_RAYS = 64  # along a cell's side

_TABLE = 8 * MOST_RAYS  # numbers of splines and slopes for cells with one number of rays
# Places in flat arrays, of 64 rays each.
_ROWS = 8 * MOST_RAYS
_V, _U, _SHARE_V, _SHARE_U, _SLOPE_V, _SLOPE_U, _DOWN, _RIGHT = range(0, 8 * MOST_RAYS, MOST_RAYS)
_LANDED = 8 * MOST_RAYS
Entries = tuple[IntArray, IntArray, AnyArray]  # begins of a sparse matrix's rows, columns, values
_OfSplines = tuple[float, float, float, float]  # sums for the four splines along x
_FAST = {"contract", "reassoc", "nsz"}  # sums in an order that suits the processor
# A part that is compiled by itself, too, may sum in another order there, and which of both a
# process calls depends on whether it compiled them or found them compiled.
_PART = {"nogil": True, "error_model": "numpy", "fastmath": _FAST, "inline": "always"}


class Rays(NamedTuple):
    """A `TracedBeam` of a `RayModel`, as kernels trace its rays."""

    potential: FloatArray
    counts: IntArray
    beam: FloatArray
    tables: FloatArray  # values and slopes of splines by the rays along a cell's side, flat
    frame: FloatArray  # about the corner of a detector of `size`, with the guard around it
    pad: int
    steepness: float  # rise of a ray's share in the next pixel in a px
    size: tuple[int, int]


def spline_tables(places: FloatArray, knot: int = KNOT) -> tuple[FloatArray, FloatArray]:
    """The four B-splines at places (0 to 1) of a cell, and their slopes per px; shape (4, n)."""
    t, s = places, 1 - places
    values = [s**3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * s**2 + 3 * s**3) / 6, t**3 / 6]
    slopes = [-(s**2) / 2, (3 * t**2 - 4 * t) / 2, (4 * s - 3 * s**2) / 2, t**2 / 2]
    return np.stack(values), np.stack(slopes) / knot


@njit(**_PART)
def _misses(rays: Rays, row: int, column: int) -> bool:
    """Whether a cell of the strip is certain to send no ray to a pixel inside the guard.

    Slopes of a spline lie between the least and the largest difference of its coefficients.
    """
    potential, frame, size = rays.potential, rays.frame, rays.size
    y, x = KNOT * row - rays.pad, KNOT * column - rays.pad
    strip = (rays.pad + 1) // KNOT
    rows, columns = rays.counts.shape[1], rays.counts.shape[2]
    if strip <= row < rows - strip and strip <= column < columns - strip:
        return False
    least_y = most_y = potential[row + 1, column] - potential[row, column]
    least_x = most_x = potential[row, column + 1] - potential[row, column]
    for i in range(4):
        for j in range(3):
            rise = potential[row + j + 1, column + i] - potential[row + j, column + i]
            least_y, most_y = min(least_y, rise), max(most_y, rise)
            rise = potential[row + i, column + j + 1] - potential[row + i, column + j]
            least_x, most_x = min(least_x, rise), max(most_x, rise)
    # The middle of the rectangle in which rays land, and half of its sides.
    y, x = y + (KNOT - (most_y + least_y) / KNOT) / 2, x + (KNOT - (most_x + least_x) / KNOT) / 2
    tall, wide = (KNOT + (most_y - least_y) / KNOT) / 2, (KNOT + (most_x - least_x) / KNOT) / 2
    v = frame[0] + frame[1] * y + frame[2] * x
    u = frame[3] + frame[4] * y + frame[5] * x
    of_v = abs(frame[1]) * tall + abs(frame[2]) * wide
    of_u = abs(frame[4]) * tall + abs(frame[5]) * wide
    misses_v = v + of_v < 0.5 or v - of_v > size[0] - 1.5
    return bool(misses_v or u + of_u < 0.5 or u - of_u > size[1] - 1.5)


# Arrays of the parts below are flat, and each part writes one, so that the compiler need not
# suspect that what it writes changes what it reads; loops go on to a multiple of 8, where tables
# are zero.
@njit(**_PART)
def _evaluate_rows(rays: Rays, row: int, column: int, n: int, out: FloatArray) -> None:
    """Slopes along y, then values, of the four columns of splines at a cell's n rows of rays."""
    potential, at = rays.potential, rays.tables[_TABLE * n : _TABLE * (n + 1)]
    for s in range(4):
        c0, c1 = potential[row, column + s], potential[row + 1, column + s]
        c2, c3 = potential[row + 2, column + s], potential[row + 3, column + s]
        for a in range((n + 7) // 8 * 8):
            out[64 * s + a] = (
                at[256 + a] * c0 + at[320 + a] * c1 + at[384 + a] * c2 + at[448 + a] * c3
            )
            out[64 * (4 + s) + a] = (
                at[a] * c0 + at[64 + a] * c1 + at[128 + a] * c2 + at[192 + a] * c3
            )


@njit(**_PART)
def _land(
    rays: Rays,
    rows: FloatArray,
    row: int,
    column: int,
    a: int,
    n: int,
    m: int,
    with_slopes: bool,
    out: FloatArray,
) -> None:
    """The pixel at or before each ray of row `a`, and the share of the next one, with its slope."""
    at = rays.tables[_TABLE * m : _TABLE * (m + 1)]
    frame, steepness, size = rays.frame, rays.steepness, rays.size
    y, x = (row + (a + 0.5) / n) * KNOT - rays.pad, column * KNOT - rays.pad
    s0, s1, s2, s3 = rows[a], rows[64 + a], rows[128 + a], rows[192 + a]
    p0, p1, p2, p3 = rows[256 + a], rows[320 + a], rows[384 + a], rows[448 + a]
    f0, f1, f2, f3, f4, f5 = frame[0], frame[1], frame[2], frame[3], frame[4], frame[5]
    last_row, last_column = size[0] - 2.0, size[1] - 2.0
    step = KNOT / m
    for b in range((m + 7) // 8 * 8):
        down = y - (at[b] * s0 + at[64 + b] * s1 + at[128 + b] * s2 + at[192 + b] * s3)
        right = at[256 + b] * p0 + at[320 + b] * p1 + at[384 + b] * p2 + at[448 + b] * p3
        right = x + (b + 0.5) * step - right
        # Rays that miss land in the outermost pixels, which nobody looks at; NaN in the first.
        v, u = f0 + f1 * down + f2 * right, f3 + f4 * down + f5 * right
        v, u = v if v > 0.0 else 0.0, u if u > 0.0 else 0.0
        v, u = v if v < last_row else last_row, u if u < last_column else last_column
        i, j = np.floor(v), np.floor(u)
        out[_V + b], out[_U + b] = i, j
        # Between two pixels' centres the share rises from 0 to 1 as two parabolas.
        t = min(max((v - i - 0.5) * steepness + 0.5, 0.0), 1.0)
        nearer = min(t, 1 - t)
        out[_SHARE_V + b] = 2 * nearer * nearer if t < 0.5 else 1 - 2 * nearer * nearer
        if with_slopes:
            out[_SLOPE_V + b] = 4 * nearer * steepness
        t = min(max((u - j - 0.5) * steepness + 0.5, 0.0), 1.0)
        nearer = min(t, 1 - t)
        out[_SHARE_U + b] = 2 * nearer * nearer if t < 0.5 else 1 - 2 * nearer * nearer
        if with_slopes:
            out[_SLOPE_U + b] = 4 * nearer * steepness
            out[_DOWN + b], out[_RIGHT + b] = down, right


@njit(**_PART)
def _first_pixels_share(a: int, n: int) -> float:
    """How much of part `a` of `n` of a cell's side lies in the first of its two pixels."""
    return min(max(n / 2 - a, 0.0), 1.0)


@njit(**_PART)
def _flux_of_row(
    beam: FloatArray, row: int, column: int, a: int, n: int, m: int, out: FloatArray
) -> None:
    upper = _first_pixels_share(a, n) / (n * m) * KNOT**2
    lower = KNOT**2 / (n * m) - upper
    i, j = KNOT * row, KNOT * column
    at_left = upper * beam[i, j] + lower * beam[i + 1, j]
    at_right = upper * beam[i, j + 1] + lower * beam[i + 1, j + 1]
    half = m / 2
    for b in range((m + 7) // 8 * 8):
        first = min(max(half - b, 0.0), 1.0)
        out[b] = first * at_left + (1 - first) * at_right


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def deposit(start: int, stop: int, rays: Rays, corners: FloatArray, reached: IntArray) -> None:
    """Add the rays of bands of cells up at the pixel at or before each, by the pixel they go to.

    `corners` has the shape (bands, pixels × 4): for the pixel itself, that to its right, that below
    it, and that below to the right. `reached` are the first row of each band, and that after the
    last.
    """
    counts, cells = rays.counts, (rays.counts.shape[1], rays.counts.shape[2])
    bands, width = len(corners), np.uint32(rays.size[1])
    rows, landed, flux = np.zeros(_ROWS), np.zeros(_LANDED), np.zeros(MOST_RAYS)
    for band in range(start, stop):
        sums = corners[band]
        first, last = np.uint32(rays.size[0]), np.uint32(0)
        for row in range(cells[0] * band // bands, cells[0] * (band + 1) // bands):
            for column in range(cells[1]):
                if _misses(rays, row, column):
                    continue
                n, m = counts[0, row, column], counts[1, row, column]
                _evaluate_rows(rays, row, column, n, rows)
                for a in range(n):
                    _land(rays, rows, row, column, a, n, m, False, landed)
                    _flux_of_row(rays.beam, row, column, a, n, m, flux)
                    for b in range(m):
                        i, j = np.uint32(landed[_V + b]), np.uint32(landed[_U + b])
                        first, last = min(first, i), max(last, i)
                        below = flux[b] * landed[_SHARE_V + b]
                        above = flux[b] - below
                        right = landed[_SHARE_U + b]
                        to_right, to_corner = above * right, below * right
                        pixel = (i * width + j) * np.uint32(4)
                        sums[pixel] += above - to_right
                        sums[pixel + np.uint32(1)] += to_right
                        sums[pixel + np.uint32(2)] += below - to_corner
                        sums[pixel + np.uint32(3)] += to_corner
        reached[band, 0], reached[band, 1] = first, last + np.uint32(1)


@njit(nogil=True, error_model="numpy")
def add_corners(
    start: int,
    stop: int,
    corners: FloatArray,
    reached: IntArray,
    width: int,
    guard: int,
    image: FloatArray,
) -> None:
    """Add the sums of `deposit` up in rows of an image, which lies within a guard."""
    for row in range(start, stop):
        for band in range(len(corners)):
            sums = corners[band]
            for k in range(2):
                i = row + guard - k
                if reached[band, 0] <= i < reached[band, 1]:
                    first = 4 * (i * width + guard) + 2 * k
                    for column in range(image.shape[1]):
                        pixel = first + 4 * column
                        image[row, column] += sums[pixel] + sums[pixel - 3]


@njit(**_PART)
def _add_moments(pulls: FloatArray, landed: FloatArray, m: int, moments: FloatArray) -> None:
    """Add the contribution of a row of rays to the derivatives of a frame."""
    for b in range(m):
        in_v, in_u = pulls[b], pulls[64 + b]
        moments[0] += in_v
        moments[1] += in_v * landed[_DOWN + b]
        moments[2] += in_v * landed[_RIGHT + b]
        moments[3] += in_u
        moments[4] += in_u * landed[_DOWN + b]
        moments[5] += in_u * landed[_RIGHT + b]


@njit(**_PART)
def _add_to_beam(
    pulls: FloatArray, row: int, column: int, a: int, n: int, m: int, of_beam: FloatArray
) -> None:
    """Add the contribution of a row of rays to the beam's derivatives in its cell's four pixels."""
    upper = _first_pixels_share(a, n) / (n * m) * KNOT**2
    lower = KNOT**2 / (n * m) - upper
    pull_left = pull_right = 0.0
    for b in range(m):
        share = _first_pixels_share(b, m)
        pull_left += share * pulls[128 + b]
        pull_right += (1 - share) * pulls[128 + b]
    i, j = KNOT * row, KNOT * column
    of_beam[i, j] += upper * pull_left
    of_beam[i, j + 1] += upper * pull_right
    of_beam[i + 1, j] += lower * pull_left
    of_beam[i + 1, j + 1] += lower * pull_right


@njit(**_PART)
def _add_row(rays: Rays, pulls: FloatArray, a: int, n: int, m: int, sums: FloatArray) -> None:
    """Add the pull on row `a` of rays to sums over a cell's rows, for each spline along y."""
    frame, at = rays.frame, rays.tables[_TABLE * n : _TABLE * (n + 1)]
    p0, p1, p2, p3 = at[a], at[64 + a], at[128 + a], at[192 + a]
    s0, s1, s2, s3 = at[256 + a], at[320 + a], at[384 + a], at[448 + a]
    f1, f2, f4, f5 = frame[1], frame[2], frame[4], frame[5]
    for b in range((m + 7) // 8 * 8):
        along = f1 * pulls[b] + f4 * pulls[64 + b]
        across = f2 * pulls[b] + f5 * pulls[64 + b]
        sums[b] += s0 * along
        sums[64 + b] += s1 * along
        sums[128 + b] += s2 * along
        sums[192 + b] += s3 * along
        sums[256 + b] += p0 * across
        sums[320 + b] += p1 * across
        sums[384 + b] += p2 * across
        sums[448 + b] += p3 * across


@njit(**_PART)
def _subtract_sums(
    sums: FloatArray, tables: FloatArray, m: int, row: int, column: int, gradient: FloatArray
) -> None:
    """Subtract a cell's sums from the derivatives by its coefficients."""
    at = tables[_TABLE * m : _TABLE * (m + 1)]
    for r in range(4):
        g0 = g1 = g2 = g3 = 0.0
        for b in range((m + 7) // 8 * 8):
            along, across = sums[64 * r + b], sums[256 + 64 * r + b]
            g0 += along * at[b] + across * at[256 + b]
            g1 += along * at[64 + b] + across * at[320 + b]
            g2 += along * at[128 + b] + across * at[384 + b]
            g3 += along * at[192 + b] + across * at[448 + b]
        gradient[row + r, column] -= g0
        gradient[row + r, column + 1] -= g1
        gradient[row + r, column + 2] -= g2
        gradient[row + r, column + 3] -= g3


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def gather(
    start: int,
    stop: int,
    rays: Rays,
    slopes: FloatArray,
    gradients: FloatArray,
    of_beam: FloatArray,
    beam_is_free: bool,
    of_frame: FloatArray,
    frame_is_free: bool,
) -> None:
    """Gradients with respect to coefficients, beam and frame, from the pull where rays land.

    `slopes` are the pull at each pixel, how much more it is to the right, and below, and how much
    the latter grows to the right; flat.
    """
    counts, cells = rays.counts, (rays.counts.shape[1], rays.counts.shape[2])
    bands, width = len(gradients), np.uint32(rays.size[1])
    rows, landed, flux = np.zeros(_ROWS), np.zeros(_LANDED), np.zeros(MOST_RAYS)
    pulls, sums = np.zeros(3 * MOST_RAYS), np.zeros(8 * MOST_RAYS)
    for band in range(start, stop):
        gradient, moments = gradients[band], of_frame[band]
        for row in range(cells[0] * band // bands, cells[0] * (band + 1) // bands):
            for column in range(cells[1]):
                if _misses(rays, row, column):
                    continue
                n, m = counts[0, row, column], counts[1, row, column]
                _evaluate_rows(rays, row, column, n, rows)
                sums[:] = 0.0
                for a in range(n):
                    _land(rays, rows, row, column, a, n, m, True, landed)
                    _flux_of_row(rays.beam, row, column, a, n, m, flux)
                    for b in range(m):
                        i, j = np.uint32(landed[_V + b]), np.uint32(landed[_U + b])
                        pixel = (i * width + j) * np.uint32(4)
                        below, right = landed[_SHARE_V + b], landed[_SHARE_U + b]
                        to_right = slopes[pixel + np.uint32(1)]
                        to_below = slopes[pixel + np.uint32(2)]
                        twist = slopes[pixel + np.uint32(3)]
                        to_right += below * twist
                        pulls[b] = flux[b] * landed[_SLOPE_V + b] * (to_below + right * twist)
                        pulls[64 + b] = flux[b] * landed[_SLOPE_U + b] * to_right
                        if beam_is_free:
                            pulls[128 + b] = slopes[pixel] + below * to_below + right * to_right
                    _add_row(rays, pulls, a, n, m, sums)
                    if frame_is_free:
                        _add_moments(pulls, landed, m, moments)
                    if beam_is_free:
                        _add_to_beam(pulls, row, column, a, n, m, of_beam)
                _subtract_sums(sums, rays.tables, m, row, column, gradient)


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def boxes(start: int, stop: int, rays: Rays, found: IntArray) -> None:
    """First row and column of the pixels that each cell reaches, and those after the last."""
    counts, cells = rays.counts, (rays.counts.shape[1], rays.counts.shape[2])
    rows, landed = np.zeros(_ROWS), np.zeros(_LANDED)
    for row in range(start, stop):
        for column in range(cells[1]):
            found[row, column] = 0
            if _misses(rays, row, column):
                continue
            n, m = counts[0, row, column], counts[1, row, column]
            _evaluate_rows(rays, row, column, n, rows)
            first_row, first_column, last_row, last_column = rays.size[0], rays.size[1], 0, 0
            for a in range(n):
                _land(rays, rows, row, column, a, n, m, False, landed)
                for b in range(m):
                    i, j = int(landed[_V + b]), int(landed[_U + b])
                    first_row, last_row = min(first_row, i), max(last_row, i + 2)
                    first_column, last_column = min(first_column, j), max(last_column, j + 2)
            found[row, column] = first_row, first_column, last_row, last_column


@njit(**_PART)
def _subtract(
    block: FloatArray, c: int, steep: float, plain: float, u: _OfSplines, v: _OfSplines
) -> None:
    block[c] -= steep * u[0] + plain * v[0]
    block[c + 1] -= steep * u[1] + plain * v[1]
    block[c + 2] -= steep * u[2] + plain * v[2]
    block[c + 3] -= steep * u[3] + plain * v[3]


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def collect(
    start: int,
    stop: int,
    rays: Rays,
    boxes: IntArray,
    begins: IntArray,
    guard: int,
    middle: tuple[float, float],
    free: tuple[bool, bool],
    used: IntArray,
    pixels: IntArray,
    of_splines: FloatArray,
    of_instrument: FloatArray,
) -> None:
    """Derivatives of the pixels that each cell reaches by its coefficients, its beam and the frame.

    A cell's lines begin at `begins`; `used` says how many there are. A line is a pixel's number
    without the guard, its derivatives by the 16 coefficients, and by 4 pixels of the beam and the
    frame, of which there may be none.
    """
    counts, cells = rays.counts, (rays.counts.shape[1], rays.counts.shape[2])
    rows, landed = np.zeros(_ROWS), np.zeros(_LANDED)
    flux = np.zeros(MOST_RAYS)
    beam_is_free, frame_is_free = free
    instrument_columns = of_instrument.shape[1]
    frame, tables, width = rays.frame, rays.tables, rays.size[1] - 2 * guard
    for row in range(start, stop):
        for column in range(cells[1]):
            n, m = counts[0, row, column], counts[1, row, column]
            first_row, first_column, last_row, last_column = boxes[row, column]
            wide = last_column - first_column
            area = max(last_row - first_row, 0) * max(wide, 0)
            if area == 0:
                continue
            block, instrument = np.zeros(16 * area), np.zeros((area, instrument_columns))
            is_reached, sums = np.zeros(area, np.bool_), np.zeros(8 * area)
            last_seen, touched = np.full(area, -1), np.empty(area, np.int64)
            of_y = tables[_TABLE * n : _TABLE * (n + 1)]
            of_x = tables[_TABLE * m : _TABLE * (m + 1)]
            _evaluate_rows(rays, row, column, n, rows)
            for a in range(n):
                _land(rays, rows, row, column, a, n, m, True, landed)
                _flux_of_row(rays.beam, row, column, a, n, m, flux)
                upper = _first_pixels_share(a, n) / (n * m) * KNOT**2
                lower = KNOT**2 / (n * m) - upper
                plain0, plain1, plain2, plain3 = of_y[a], of_y[64 + a], of_y[128 + a], of_y[192 + a]
                steep0, steep1 = of_y[256 + a], of_y[320 + a]
                steep2, steep3 = of_y[384 + a], of_y[448 + a]
                n_touched = 0
                for b in range(m):
                    landed_y = landed[_DOWN + b] - middle[0]
                    landed_x = landed[_RIGHT + b] - middle[1]
                    part = _first_pixels_share(b, m)
                    p0, p1, p2, p3 = of_x[b], of_x[64 + b], of_x[128 + b], of_x[192 + b]
                    s0, s1, s2, s3 = of_x[256 + b], of_x[320 + b], of_x[384 + b], of_x[448 + b]
                    for q in range(4):
                        i, j = int(landed[_V + b]) + q // 2, int(landed[_U + b]) + q % 2
                        if not (first_row <= i < last_row and first_column <= j < last_column):
                            continue
                        p = (i - first_row) * wide + j - first_column
                        below, right = landed[_SHARE_V + b], landed[_SHARE_U + b]
                        in_v, in_u = below if q // 2 else 1 - below, right if q % 2 else 1 - right
                        to_v, to_u = flux[b] * in_u * landed[_SLOPE_V + b], flux[b] * in_v
                        to_v = to_v if q // 2 else -to_v
                        to_u *= landed[_SLOPE_U + b] if q % 2 else -landed[_SLOPE_U + b]
                        if beam_is_free and in_v * in_u > 0:
                            is_reached[p] = True
                            instrument[p, 0] += in_v * in_u * upper * part
                            instrument[p, 1] += in_v * in_u * upper * (1 - part)
                            instrument[p, 2] += in_v * in_u * lower * part
                            instrument[p, 3] += in_v * in_u * lower * (1 - part)
                        if to_v == 0 and to_u == 0:  # half of the pairs of a ray and a pixel
                            continue
                        is_reached[p] = True
                        along = frame[1] * to_v + frame[4] * to_u
                        across = frame[2] * to_v + frame[5] * to_u
                        k = 8 * p
                        if last_seen[p] != a:
                            last_seen[p] = a
                            touched[n_touched] = p
                            n_touched += 1
                            sums[k : k + 8] = 0.0
                        t0, t1, t2, t3 = sums[k], sums[k + 1], sums[k + 2], sums[k + 3]
                        t4, t5, t6, t7 = sums[k + 4], sums[k + 5], sums[k + 6], sums[k + 7]
                        sums[k], sums[k + 1] = t0 + along * p0, t1 + along * p1
                        sums[k + 2], sums[k + 3] = t2 + along * p2, t3 + along * p3
                        sums[k + 4], sums[k + 5] = t4 + across * s0, t5 + across * s1
                        sums[k + 6], sums[k + 7] = t6 + across * s2, t7 + across * s3
                        if frame_is_free:
                            instrument[p, -6] += to_v
                            instrument[p, -5] += to_v * landed_y
                            instrument[p, -4] += to_v * landed_x
                            instrument[p, -3] += to_u
                            instrument[p, -2] += to_u * landed_y
                            instrument[p, -1] += to_u * landed_x
                for q in range(n_touched):
                    k, c = 8 * touched[q], 16 * touched[q]
                    u = sums[k], sums[k + 1], sums[k + 2], sums[k + 3]
                    v = sums[k + 4], sums[k + 5], sums[k + 6], sums[k + 7]
                    _subtract(block, c, steep0, plain0, u, v)
                    _subtract(block, c + 4, steep1, plain1, u, v)
                    _subtract(block, c + 8, steep2, plain2, u, v)
                    _subtract(block, c + 12, steep3, plain3, u, v)
            line = begins[row, column]
            for p in range(area):
                if is_reached[p]:
                    pixel = (first_row + p // wide - guard) * width
                    pixels[line] = pixel + first_column + p % wide - guard
                    for c in range(16):
                        of_splines[line, c] = block[16 * p + c]
                    for c in range(instrument_columns):
                        of_instrument[line, c] = instrument[p, c]
                    line += 1
            used[row, column] = line - begins[row, column]


@njit(nogil=True, error_model="numpy")
def merge(
    begins: IntArray,
    used: IntArray,
    pixels: AnyArray,
    of_splines: FloatArray,
    of_instrument: FloatArray,
    has_beam: bool,
    rows: AnyArray,
    columns: AnyArray,
    values: AnyArray,
) -> None:
    """Add the lines of `collect` up in a sparse matrix: begins of its rows, columns and values."""
    cells, instrument_columns = begins.shape, of_instrument.shape[1]
    coefficients, beam = cells[1] + 3, KNOT * cells[1]
    first_of_beam = (cells[0] + 3) * coefficients
    first_of_frame = first_of_beam + KNOT * cells[0] * beam
    # Lines in the order of their pixels.
    rows[:] = 0
    for row in range(cells[0]):
        for column in range(cells[1]):
            for line in range(begins[row, column], begins[row, column] + used[row, column]):
                rows[pixels[line] + 1] += 1
    ends = np.cumsum(rows)
    order = np.empty((ends[-1], 3), np.int64)
    for row in range(cells[0]):
        for column in range(cells[1]):
            for line in range(begins[row, column], begins[row, column] + used[row, column]):
                place = ends[pixels[line]]
                order[place, 0], order[place, 1], order[place, 2] = line, row, column
                ends[pixels[line]] += 1
    places = np.full(first_of_frame + 6, -1, np.int64)
    entry = place = 0
    for pixel in range(len(rows) - 1):
        first = entry
        while place < ends[pixel]:
            line, row, column = order[place]
            place += 1
            for c in range(16):
                number = (row + c // 4) * coefficients + column + c % 4
                value = of_splines[line, c]
                entry = _add_entry(number, value, first, entry, places, columns, values)
            for c in range(instrument_columns):
                number = first_of_frame + c - 4 * has_beam
                if c < 4 * has_beam:
                    number = first_of_beam + (KNOT * row + c // 2) * beam + KNOT * column + c % 2
                value = of_instrument[line, c]
                if value != 0:  # no ray of most pixels of the beam lands here
                    entry = _add_entry(number, value, first, entry, places, columns, values)
        rows[pixel + 1] = entry
    rows[0] = 0


@njit(**_PART)
def _add_entry(
    number: int,
    value: float,
    first: int,
    entry: int,
    places: IntArray,
    columns: AnyArray,
    values: AnyArray,
) -> int:
    place = places[number]
    if place >= first:
        values[place] += value
        return entry
    places[number], columns[entry], values[entry] = entry, number, value
    return entry + 1


@njit(nogil=True, error_model="numpy")
def rows_times(start: int, stop: int, matrix: Entries, vector: FloatArray, out: FloatArray) -> None:
    """Rows of a sparse matrix times a vector, while other threads run."""
    begins, columns, values = matrix
    for row in range(start, stop):
        total = 0.0
        for entry in range(begins[row], begins[row + 1]):
            total += values[entry] * vector[columns[entry]]
        out[row] = total


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def normal_times(
    start: int,
    stop: int,
    matrix: Entries,
    vector: FloatArray,
    weights: FloatArray,
    slopes: FloatArray,
    light: FloatArray,
    pulls: FloatArray,
    out: FloatArray,
) -> None:
    """Add Jᵀ s w (s J v + l) for rows of a sparse matrix J; `pulls` are w (s J v + l)."""
    begins, columns, values = matrix
    for row in range(start, stop):
        total = 0.0
        for entry in range(begins[row], begins[row + 1]):
            total += values[entry] * vector[columns[entry]]
        pulls[row] = weights[row] * (slopes[row] * total + light[row])
        pull = slopes[row] * pulls[row]
        for entry in range(begins[row], begins[row + 1]):
            out[columns[entry]] += values[entry] * pull


@njit(nogil=True, error_model="numpy")
def transpose_times(matrix: Entries, vector: FloatArray, out: FloatArray) -> None:
    """Add the transpose of a sparse matrix times a vector, while other threads run."""
    begins, columns, values = matrix
    for row in range(len(begins) - 1):
        for entry in range(begins[row], begins[row + 1]):
            out[columns[entry]] += values[entry] * vector[row]


@njit(nogil=True, error_model="numpy")
def add_ties(
    potentials: FloatArray, is_inside: BoolArray, tie: float, fading: float, slope: FloatArray
) -> None:
    """Add the pull by which the strip's `potentials` (M, …) are tied to neighbours and to zero."""
    fields, height, width = potentials.shape
    for m in range(fields):
        for row in range(height):
            for column in range(width):
                inside, here = is_inside[row, column], potentials[m, row, column]
                if not inside:
                    slope[m, row, column] += fading * here
                if row + 1 < height and not (inside and is_inside[row + 1, column]):
                    pull = tie * (potentials[m, row + 1, column] - here)
                    slope[m, row, column] -= pull
                    slope[m, row + 1, column] += pull
                if column + 1 < width and not (inside and is_inside[row, column + 1]):
                    pull = tie * (potentials[m, row, column + 1] - here)
                    slope[m, row, column] -= pull
                    slope[m, row, column + 1] += pull
