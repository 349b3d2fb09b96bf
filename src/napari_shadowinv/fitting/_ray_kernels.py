"""Kernels of `RayModel`: rays of a cell between knots, their landing points, and the derivatives.

A cell's side is two pixels of the beam. Its rays start at the middles of n × m equal parts. Each
row of them is traced at once; the spline's values along y, which a row shares, are evaluated once.
"""

from __future__ import annotations

import math

import numpy as np

from napari_shadowinv._typing import AnyArray, FloatArray, IntArray
from napari_shadowinv.geometry.compiler import njit

__all__ = [
    "KNOT",
    "MOST_RAYS",
    "boxes",
    "collect",
    "deposit",
    "gather",
    "rows_times",
    "spline_tables",
    "transpose_times",
]

KNOT = 2  # px between knots
MOST_RAYS = 64  # along a cell's side

_ONE = np.uint32(1)  # unsigned, for which no index counts from the end
_FAST = {"contract", "reassoc", "nsz"}  # sums in an order that suits the processor
# A part that is compiled by itself, too, may sum in another order there, and which of both a
# process calls depends on whether it compiled them or found them compiled.
_PART = {"nogil": True, "error_model": "numpy", "fastmath": _FAST, "inline": "always"}


def spline_tables(places: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The four B-splines at places (0 to 1) of a cell, and their slopes per px; shape (4, n)."""
    t, s = places, 1 - places
    values = [s**3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6, (4 - 6 * s**2 + 3 * s**3) / 6, t**3 / 6]
    slopes = [-(s**2) / 2, (3 * t**2 - 4 * t) / 2, (4 * s - 3 * s**2) / 2, t**2 / 2]
    return np.stack(values), np.stack(slopes) / KNOT


@njit(**_PART)
def _slopes_of_row(
    potential: FloatArray,
    row: int,
    column: int,
    tables: FloatArray,
    a: int,
    n: int,
    m: int,
    out: FloatArray,
) -> None:
    """Gradient of a potential, (y, x), at row `a` of a cell's n rows of m rays."""
    s0 = s1 = s2 = s3 = p0 = p1 = p2 = p3 = 0.0
    for i in range(4):
        plain, steep = tables[n, 0, i, a], tables[n, 1, i, a]
        c0, c1 = potential[row + i, column], potential[row + i, column + 1]
        c2, c3 = potential[row + i, column + 2], potential[row + i, column + 3]
        s0, s1, s2, s3 = s0 + steep * c0, s1 + steep * c1, s2 + steep * c2, s3 + steep * c3
        p0, p1, p2, p3 = p0 + plain * c0, p1 + plain * c1, p2 + plain * c2, p3 + plain * c3
    for b in range(m):
        out[0, b] = (
            tables[m, 0, 0, b] * s0
            + tables[m, 0, 1, b] * s1
            + tables[m, 0, 2, b] * s2
            + tables[m, 0, 3, b] * s3
        )
        out[1, b] = (
            tables[m, 1, 0, b] * p0
            + tables[m, 1, 1, b] * p1
            + tables[m, 1, 2, b] * p2
            + tables[m, 1, 3, b] * p3
        )


@njit(**_PART)
def _share(place: float, steepness: float) -> tuple[float, float]:
    """Share of a ray between two pixels' centres that goes to the next pixel, and its slope."""
    t = min(max((place - 0.5) * steepness + 0.5, 0.0), 1.0)
    nearer = min(t, 1 - t)
    part = 2 * nearer * nearer
    return (part if t < 0.5 else 1 - part), 4 * nearer * steepness


@njit(**_PART)
def _land(
    slopes: FloatArray,
    m: int,
    y: float,
    x: float,
    frame: FloatArray,
    steepness: float,
    size: tuple[int, int],
    pixels: AnyArray,
    shares: FloatArray,
) -> None:
    """The pixel at or before each ray of a row, and the share of the next one, with its slope."""
    last_row, last_column = size[0] - 2.0, size[1] - 2.0
    for b in range(m):
        down = y - slopes[0, b]
        right = x + (b + 0.5) * (KNOT / m) - slopes[1, b]
        v = frame[0] + frame[1] * down + frame[2] * right
        u = frame[3] + frame[4] * down + frame[5] * right
        # Rays that miss land in the outermost pixels, which nobody looks at.
        v = min(max(v, 0.0), last_row)
        u = min(max(u, 0.0), last_column)
        i, j = math.floor(v), math.floor(u)
        pixels[0, b], pixels[1, b] = np.uint32(i), np.uint32(j)
        shares[0, b], shares[2, b] = _share(v - i, steepness)
        shares[1, b], shares[3, b] = _share(u - j, steepness)


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
    for b in range(m):
        first = _first_pixels_share(b, m)
        out[b] = first * at_left + (1 - first) * at_right


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def deposit(
    start: int,
    stop: int,
    potential: FloatArray,
    counts: IntArray,
    beam: FloatArray,
    tables: FloatArray,
    frame: FloatArray,
    pad: int,
    steepness: float,
    images: FloatArray,
) -> None:
    """Share the rays of bands of cells among the pixels of each band's image."""
    rows, columns = counts.shape[1:]
    bands, size = images.shape[0], (images.shape[1], images.shape[2])
    slopes, shares = np.empty((2, MOST_RAYS)), np.empty((4, MOST_RAYS))
    pixels, flux = np.empty((2, MOST_RAYS), np.uint32), np.empty(MOST_RAYS)
    for band in range(start, stop):
        image = images[band]
        for row in range(rows * band // bands, rows * (band + 1) // bands):
            for column in range(columns):
                n, m = counts[0, row, column], counts[1, row, column]
                for a in range(n):
                    y, x = (row + (a + 0.5) / n) * KNOT - pad, column * KNOT - pad
                    _slopes_of_row(potential, row, column, tables, a, n, m, slopes)
                    _land(slopes, m, y, x, frame, steepness, size, pixels, shares)
                    _flux_of_row(beam, row, column, a, n, m, flux)
                    for b in range(m):
                        i, j = pixels[0, b], pixels[1, b]
                        i1, j1 = i + _ONE, j + _ONE
                        down, right = shares[0, b], shares[1, b]
                        below = flux[b] * down
                        above = flux[b] - below
                        image[i, j] += above - above * right
                        image[i, j1] += above * right
                        image[i1, j] += below - below * right
                        image[i1, j1] += below * right


@njit(**_PART)
def _add_moments(
    to_y: FloatArray,
    to_x: FloatArray,
    slopes: FloatArray,
    m: int,
    y: float,
    x: float,
    moments: FloatArray,
) -> None:
    """Add the contribution of a row of rays to the derivatives of a frame."""
    for b in range(m):
        in_v, in_u = to_y[b], to_x[b]
        landed_y = y - slopes[0, b]
        landed_x = x + (b + 0.5) * (KNOT / m) - slopes[1, b]
        moments[0] += in_v
        moments[1] += in_v * landed_y
        moments[2] += in_v * landed_x
        moments[3] += in_u
        moments[4] += in_u * landed_y
        moments[5] += in_u * landed_x


@njit(**_PART)
def _add_to_beam(
    bright: FloatArray, row: int, column: int, a: int, n: int, m: int, of_beam: FloatArray
) -> None:
    """Add the contribution of a row of rays to the beam's derivatives in its cell's four pixels."""
    upper = _first_pixels_share(a, n) / (n * m) * KNOT**2
    lower = KNOT**2 / (n * m) - upper
    pull_left = pull_right = 0.0
    for b in range(m):
        share = _first_pixels_share(b, m)
        pull_left += share * bright[b]
        pull_right += (1 - share) * bright[b]
    i, j = KNOT * row, KNOT * column
    of_beam[i, j] += upper * pull_left
    of_beam[i, j + 1] += upper * pull_right
    of_beam[i + 1, j] += lower * pull_left
    of_beam[i + 1, j + 1] += lower * pull_right


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def gather(
    start: int,
    stop: int,
    potential: FloatArray,
    counts: IntArray,
    beam: FloatArray,
    tables: FloatArray,
    frame: FloatArray,
    pad: int,
    steepness: float,
    pull: FloatArray,
    gradients: FloatArray,
    of_beam: FloatArray,
    beam_is_free: bool,
    of_frame: FloatArray,
    frame_is_free: bool,
) -> None:
    """Gradients with respect to coefficients, beam and frame, from the pull where rays land."""
    rows, columns = counts.shape[1:]
    bands = len(gradients)
    size = pull.shape[0], pull.shape[1]
    slopes, shares = np.empty((2, MOST_RAYS)), np.empty((4, MOST_RAYS))
    pixels, flux = np.empty((2, MOST_RAYS), np.uint32), np.empty(MOST_RAYS)
    to_y, to_x, bright = np.empty(MOST_RAYS), np.empty(MOST_RAYS), np.empty(MOST_RAYS)
    lifted, shifted = np.empty(4), np.empty(4)
    for band in range(start, stop):
        gradient, moments = gradients[band], of_frame[band]
        for row in range(rows * band // bands, rows * (band + 1) // bands):
            for column in range(columns):
                n, m = counts[0, row, column], counts[1, row, column]
                for a in range(n):
                    y, x = (row + (a + 0.5) / n) * KNOT - pad, column * KNOT - pad
                    _slopes_of_row(potential, row, column, tables, a, n, m, slopes)
                    _land(slopes, m, y, x, frame, steepness, size, pixels, shares)
                    _flux_of_row(beam, row, column, a, n, m, flux)
                    for b in range(m):
                        i, j = pixels[0, b], pixels[1, b]
                        i1, j1 = i + _ONE, j + _ONE
                        down, right = shares[0, b], shares[1, b]
                        above, beside = pull[i, j], pull[i, j1]
                        below, across = pull[i1, j], pull[i1, j1]
                        twist = across - beside - below + above
                        if beam_is_free:
                            at_left = above + down * (below - above)
                            bright[b] = at_left + right * (beside - above + down * twist)
                        to_y[b] = flux[b] * shares[2, b] * (below - above + right * twist)
                        to_x[b] = flux[b] * shares[3, b] * (beside - above + down * twist)
                    if frame_is_free:
                        _add_moments(to_y, to_x, slopes, m, y, x, moments)
                    for s in range(4):
                        to_lift = to_shift = 0.0
                        for b in range(m):
                            along = frame[1] * to_y[b] + frame[4] * to_x[b]
                            across = frame[2] * to_y[b] + frame[5] * to_x[b]
                            to_lift += along * tables[m, 0, s, b]
                            to_shift += across * tables[m, 1, s, b]
                        lifted[s], shifted[s] = to_lift, to_shift
                    for r in range(4):
                        for s in range(4):
                            gradient[row + r, column + s] -= (
                                tables[n, 1, r, a] * lifted[s] + tables[n, 0, r, a] * shifted[s]
                            )
                    if beam_is_free:
                        _add_to_beam(bright, row, column, a, n, m, of_beam)


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def boxes(
    start: int,
    stop: int,
    potential: FloatArray,
    counts: IntArray,
    beam: FloatArray,
    tables: FloatArray,
    frame: FloatArray,
    pad: int,
    steepness: float,
    size: tuple[int, int],
    found: IntArray,
) -> None:
    """First row and column of the pixels that each cell reaches, and those after the last."""
    columns = counts.shape[2]
    slopes, shares = np.empty((2, MOST_RAYS)), np.empty((4, MOST_RAYS))
    pixels = np.empty((2, MOST_RAYS), np.uint32)
    for row in range(start, stop):
        for column in range(columns):
            n, m = counts[0, row, column], counts[1, row, column]
            first_row, first_column, last_row, last_column = size[0], size[1], 0, 0
            for a in range(n):
                y, x = (row + (a + 0.5) / n) * KNOT - pad, column * KNOT - pad
                _slopes_of_row(potential, row, column, tables, a, n, m, slopes)
                _land(slopes, m, y, x, frame, steepness, size, pixels, shares)
                for b in range(m):
                    i, j = int(pixels[0, b]), int(pixels[1, b])
                    first_row, last_row = min(first_row, i), max(last_row, i + 2)
                    first_column, last_column = min(first_column, j), max(last_column, j + 2)
            found[row, column] = first_row, first_column, last_row, last_column


@njit(nogil=True, error_model="numpy", fastmath=_FAST)
def collect(
    start: int,
    stop: int,
    potential: FloatArray,
    counts: IntArray,
    beam: FloatArray,
    tables: FloatArray,
    frame: FloatArray,
    pad: int,
    steepness: float,
    size: tuple[int, int],
    boxes: IntArray,
    begins: IntArray,
    width: int,
    middle: tuple[float, float],
    free: tuple[bool, bool],
    places: IntArray,
    values: FloatArray,
) -> None:
    """Derivatives of the pixels in each cell's box by its coefficients, its beam and the frame.

    `places` are numbers of pixels in lines of `width`, and of coefficients, beam and frame.
    """
    columns = counts.shape[2]
    slopes, shares = np.empty((2, MOST_RAYS)), np.empty((4, MOST_RAYS))
    pixels = np.empty((2, MOST_RAYS), np.uint32)
    flux, first = np.empty(MOST_RAYS), np.empty(4)
    beam_is_free, frame_is_free = free
    last = potential.size + beam.size
    for row in range(start, stop):
        for column in range(columns):
            n, m = counts[0, row, column], counts[1, row, column]
            first_row, first_column, last_row, last_column = boxes[row, column]
            wide = last_column - first_column
            block = np.zeros((max(last_row - first_row, 0) * max(wide, 0), 26))
            if not block.size:
                continue
            for a in range(n):
                y, x = (row + (a + 0.5) / n) * KNOT - pad, column * KNOT - pad
                _slopes_of_row(potential, row, column, tables, a, n, m, slopes)
                _land(slopes, m, y, x, frame, steepness, size, pixels, shares)
                _flux_of_row(beam, row, column, a, n, m, flux)
                upper = _first_pixels_share(a, n) / (n * m) * KNOT**2
                lower = KNOT**2 / (n * m) - upper
                for b in range(m):
                    landed_y = y - slopes[0, b] - middle[0]
                    landed_x = x + (b + 0.5) * (KNOT / m) - slopes[1, b] - middle[1]
                    part = _first_pixels_share(b, m)
                    first[:] = upper * part, upper * (1 - part), lower * part, lower * (1 - part)
                    for q in range(4):
                        i, j = int(pixels[0, b]) + q // 2, int(pixels[1, b]) + q % 2
                        if not (first_row <= i < last_row and first_column <= j < last_column):
                            continue
                        p = (i - first_row) * wide + j - first_column
                        in_v = shares[0, b] if q // 2 else 1 - shares[0, b]
                        in_u = shares[1, b] if q % 2 else 1 - shares[1, b]
                        to_v = flux[b] * in_u * (shares[2, b] if q // 2 else -shares[2, b])
                        to_u = flux[b] * in_v * (shares[3, b] if q % 2 else -shares[3, b])
                        if beam_is_free:
                            for s in range(4):
                                block[p, 16 + s] += in_v * in_u * first[s]
                        if to_v == 0 and to_u == 0:  # half of the pairs of a ray and a pixel
                            continue
                        along = frame[1] * to_v + frame[4] * to_u
                        across = frame[2] * to_v + frame[5] * to_u
                        for r in range(4):
                            steep = tables[n, 1, r, a] * along
                            plain = tables[n, 0, r, a] * across
                            for s in range(4):
                                block[p, 4 * r + s] -= (
                                    steep * tables[m, 0, s, b] + plain * tables[m, 1, s, b]
                                )
                        if frame_is_free:
                            block[p, 20] += to_v
                            block[p, 21] += to_v * landed_y
                            block[p, 22] += to_v * landed_x
                            block[p, 23] += to_u
                            block[p, 24] += to_u * landed_y
                            block[p, 25] += to_u * landed_x
            entry = begins[row, column]
            coefficient = row * potential.shape[1] + column
            beam_pixel = potential.size + KNOT * (row * beam.shape[1] + column)
            for p in range(len(block)):
                pixel = (first_row + p // wide) * width + first_column + p % wide
                for r in range(4):
                    for s in range(4):
                        places[0, entry] = pixel
                        places[1, entry] = coefficient + r * potential.shape[1] + s
                        values[entry] = block[p, 4 * r + s]
                        entry += 1
                if beam_is_free:
                    for s in range(4):
                        places[0, entry] = pixel
                        places[1, entry] = beam_pixel + s // 2 * beam.shape[1] + s % 2
                        values[entry] = block[p, 16 + s]
                        entry += 1
                if frame_is_free:
                    for s in range(6):
                        places[0, entry], places[1, entry] = pixel, last + s
                        values[entry] = block[p, 20 + s]
                        entry += 1


@njit(nogil=True, error_model="numpy")
def rows_times(
    start: int,
    stop: int,
    begins: IntArray,
    columns: IntArray,
    values: FloatArray,
    vector: FloatArray,
    out: FloatArray,
) -> None:
    """Rows of a sparse matrix times a vector, while other threads run."""
    for row in range(start, stop):
        total = 0.0
        for entry in range(begins[row], begins[row + 1]):
            total += values[entry] * vector[columns[entry]]
        out[row] = total


@njit(nogil=True, error_model="numpy")
def transpose_times(
    begins: IntArray,
    columns: IntArray,
    values: FloatArray,
    vector: FloatArray,
    out: FloatArray,
) -> None:
    """Add the transpose of a sparse matrix times a vector, while other threads run."""
    for row in range(len(begins) - 1):
        for entry in range(begins[row], begins[row + 1]):
            out[columns[entry]] += values[entry] * vector[row]
