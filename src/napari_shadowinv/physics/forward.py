"""From a displacement to the image that it makes.

- the image of a source whose rays are displaced: `synthetic_image`
- how much the map stretches each pixel: `jacobian_determinant`

The source is cut into small tiles, a few per pixel. The corners of a tile are rays;
the tile's flux lands in the quadrilateral between them and is shared among the
pixels by exact overlap of areas. Neighbouring tiles have their corners in common, so
the image has neither gaps nor ripples, and no blur beyond that of the pixels.
"""

from __future__ import annotations

import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solveh_banded

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry._kernel import njit

__all__ = ["jacobian_determinant", "synthetic_image"]

# Of a tile: y0, x0, y1, x1, y2, x2, y3, x3.
Corners = tuple[float, float, float, float, float, float, float, float]

# A cubic spline without knots next to the border needs four samples.
_SMALLEST_SIDE = 4
# Fixed, so that sums are formed in the same order whatever the number of threads.
_BANDS = 32
# Area relative to squared diameter below which a tile is a line and shares of its area are noise.
_SLIVER = 1e-9


def synthetic_image(
    displacement: ArrayLike,
    source: ArrayLike | None = None,
    *,
    rays_per_pixel: int = 16,
    threads: int | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Image that a displaced source makes on the detector.

    Flux that lands inside the image is kept to rounding; flux that leaves it is lost.
    Where the map folds, the flux of all its branches adds up.

    Parameters
    ----------
    displacement : array_like, shape (2, H, W)
        Displacement in px, axis order (y, x), of the ray that starts at each pixel's centre;
        interpolated by cubic splines, exact for cubic polynomials up to the border.
    source : array_like, shape (H, W), optional
        Flux of each pixel without the object, constant within a pixel. Default: 1.
    rays_per_pixel : int, default 16
        Tiles that each pixel of the source is cut into; the next square number is used.
    threads : int, optional
        Threads to use. Default: all cores. The result does not depend on it.
    on_progress, should_stop : callable, optional
        Receives a `Progress` for each band of rows; ends the work when it returns true after one.

    Returns
    -------
    ndarray of float64, shape (H, W)
        Flux of each pixel of the image, in the unit of the source.

    Raises
    ------
    InputError
        If a shape does not fit, a value is not finite, or the source is negative or
        zero everywhere.
    InversionCancelled
        If `should_stop` returned true.

    References
    ----------
    Kasim et al., arXiv:1607.04179, Eqs. 3 and 4.

    Examples
    --------
    >>> import numpy as np
    >>> displacement = np.zeros((2, 5, 5))
    >>> displacement[1] = 2.0
    >>> synthetic_image(displacement)[0]
    array([0., 0., 1., 1., 1.])
    """
    field = _checked_displacement(displacement)
    shape = (field.shape[1], field.shape[2])
    flux = _checked_source(source, shape)
    if rays_per_pixel < 1:
        raise InputError(f"rays_per_pixel is {rays_per_pixel}: expected 1 or more")
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}: expected 1 or more, or None for all cores")
    tiles = math.isqrt(rays_per_pixel - 1) + 1

    coefficients = np.stack([_spline_coefficients(component) for component in field])
    samples = _spline_samples(shape[0], tiles), _spline_samples(shape[1], tiles)

    def image_of_band(rows: tuple[int, int]) -> tuple[int, FloatArray]:
        top, bottom = _landing_rows(coefficients[0], *rows)
        window = np.zeros((bottom - top, shape[1]))
        if bottom > top:
            _deposit_band(coefficients, *samples[0], *samples[1], flux, tiles, *rows, top, window)
        return top, window

    report = Reporter(on_progress, should_stop)
    bands = _bands(shape[0])
    image = np.zeros(shape)
    report("image", 0, len(bands))
    pool = ThreadPoolExecutor(threads or os.cpu_count())
    try:
        for done, (top, window) in enumerate(pool.map(image_of_band, bands), start=1):
            image[top : top + len(window)] += window
            report("image", done, len(bands))
    finally:
        # On a request to stop, bands that have not begun are skipped.
        pool.shutdown(cancel_futures=True)
    return image


def jacobian_determinant(displacement: ArrayLike) -> FloatArray:
    """Area, in the image, of each pixel of the source: det(1 + ∇d), Eq. 4 of the paper.

    Negative where the map has folded the pixel over; small where rays crowd. Made of
    differences that are of second order up to the border. An `InputError` if the shape does not
    fit or a value is not finite.

    Parameters
    ----------
    displacement : array_like, shape (2, H, W)
        Displacement at the pixels' centres in px, axis order (y, x).

    Returns
    -------
    ndarray of float64, shape (H, W)

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:5, :5]
    >>> float(jacobian_determinant([0.5 * y, 1.0 * x])[2, 2])
    3.0
    """
    field = _checked_displacement(displacement)
    (dy_dy, dy_dx), (dx_dy, dx_dx) = (np.gradient(component, edge_order=2) for component in field)
    determinant: FloatArray = (1 + dy_dy) * (1 + dx_dx) - dy_dx * dx_dy
    return determinant


def _checked_displacement(displacement: ArrayLike) -> FloatArray:
    field = np.asarray(displacement, dtype=np.float64)
    if field.ndim != 3 or field.shape[0] != 2:
        raise InputError(
            f"displacement has shape {field.shape}: expected (2, height, width), "
            "the y component first"
        )
    if min(field.shape[1:]) < _SMALLEST_SIDE:
        raise InputError(
            f"displacement has shape {field.shape}: the image must be at least "
            f"{_SMALLEST_SIDE} × {_SMALLEST_SIDE} pixels"
        )
    _refuse_non_finite("displacement", field)
    return field


def _checked_source(source: ArrayLike | None, shape: tuple[int, int]) -> FloatArray:
    if source is None:
        return np.ones(shape)
    flux = np.ascontiguousarray(source, dtype=np.float64)
    if flux.shape != shape:
        raise InputError(
            f"source has shape {flux.shape}, displacement describes {shape}: they must match"
        )
    _refuse_non_finite("source", flux)
    if flux.min() < 0:
        raise InputError(
            f"source has {np.count_nonzero(flux < 0)} negative pixels (lowest {flux.min():g}): "
            "the flux must be 0 or more; clip them or subtract less background"
        )
    if flux.max() == 0:
        raise InputError("source is zero everywhere: at least one pixel must have flux")
    return flux


def _refuse_non_finite(name: str, values: FloatArray) -> None:
    bad = values.size - np.count_nonzero(np.isfinite(values))
    if bad:
        raise InputError(f"{name} has {bad} values that are NaN or infinite: all must be finite")


def _bands(height: int) -> list[tuple[int, int]]:
    """Cut the rows of the source into bands, always the same ones for a height."""
    edges = np.linspace(0, height, min(_BANDS, height) + 1).astype(int).tolist()
    return list(itertools.pairwise(edges))


def _landing_rows(coefficients: FloatArray, first: int, last: int) -> tuple[int, int]:
    """Rows of the image that the rows ``first`` to ``last`` of the source can reach."""
    # A spline never leaves the range of its coefficients.
    height = coefficients.shape[0] - 4
    nearby = coefficients[first : last + 4]
    top = min(max(first + nearby.min() - 1, 0.0), height)
    bottom = min(max(last + nearby.max() + 1, top), height)
    return math.floor(top), math.ceil(bottom)


def _spline_coefficients(values: FloatArray) -> FloatArray:
    """Coefficients of the bicubic B-spline through all values, two more on each side."""
    along_y = _line_coefficients(values)
    return np.ascontiguousarray(_line_coefficients(along_y.T).T)


def _line_coefficients(values: FloatArray) -> FloatArray:
    """B-spline coefficients along the first axis, shape (n + 4, m)."""
    # The first and last polynomial pieces continue across one more knot ("not a knot") and on
    # to the rim of the image, half a pixel outside the last centres.
    n = values.shape[0]
    coefficients = np.empty((n + 4, values.shape[1]))
    inner = coefficients[2:-2]
    # One polynomial on both sides of a knot: the coefficient is f - f''/6, f'' by differences.
    inner[1] = (8 * values[1] - values[0] - values[2]) / 6
    inner[-2] = (8 * values[-2] - values[-1] - values[-3]) / 6
    if n > 4:
        right = 6 * values[2:-2]
        right[0] -= inner[1]
        right[-1] -= inner[-2]
        matrix = np.ones((2, n - 4))
        matrix[1] = 4
        inner[2:-2] = solveh_banded(matrix, right, lower=False) if n > 5 else right / 4
    for end in (coefficients, coefficients[::-1]):
        f = values if end is coefficients else values[::-1]
        end[2] = 6 * f[1] - 4 * end[3] - end[4]
        end[1] = 6 * f[0] - 4 * end[2] - end[3]
        end[0] = 4 * end[1] - 6 * end[2] + 4 * end[3] - end[4]
    return coefficients


def _spline_samples(n: int, tiles: int) -> tuple[IntArray, FloatArray]:
    """First of the four coefficients of each corner of a line's tiles, and their weights."""
    position = np.arange(n * tiles + 1) / tiles - 0.5
    knot = np.floor(position)
    t = position - knot
    weights = np.stack(
        [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3], axis=1
    )
    return knot.astype(np.int64) + 1, weights / 6


@njit(nogil=True, cache=True, error_model="numpy")
def _deposit_band(
    coefficients: FloatArray,
    start_y: IntArray,
    weights_y: FloatArray,
    start_x: IntArray,
    weights_x: FloatArray,
    flux: FloatArray,
    tiles: int,
    first: int,
    last: int,
    top: int,
    window: FloatArray,
) -> None:
    """Add the image of the source's rows ``first`` to ``last`` to a window of the image."""
    # Positions count from the window's corner: its pixel (i, j) covers [i, i + 1] × [j, j + 1].
    corners = start_x.size
    upper = np.empty((2, corners))
    lower = np.empty((2, corners))
    line = np.empty((2, coefficients.shape[2]))
    columns = np.arange(corners) / tiles
    for a in range(first * tiles, last * tiles + 1):
        upper, lower = lower, upper
        _land(coefficients, start_y[a], weights_y[a], start_x, weights_x, line, lower)
        at = a / tiles - top
        for b in range(corners):
            lower[0, b] += at
            lower[1, b] += columns[b]
        if a == first * tiles:
            continue
        row = (a - 1) // tiles
        for column in range(flux.shape[1]):
            share = flux[row, column] / (tiles * tiles)
            if share > 0:
                for b in range(column * tiles, (column + 1) * tiles):
                    _deposit_tile(window, share, upper, lower, b)


@njit(nogil=True, cache=True, error_model="numpy")
def _land(
    coefficients: FloatArray,
    start: int,
    weights: FloatArray,
    start_x: IntArray,
    weights_x: FloatArray,
    line: FloatArray,
    out: FloatArray,
) -> None:
    """Displacement of one row of corners: the spline along y, then along x."""
    for component in range(2):
        for j in range(line.shape[1]):
            line[component, j] = (
                weights[0] * coefficients[component, start, j]
                + weights[1] * coefficients[component, start + 1, j]
                + weights[2] * coefficients[component, start + 2, j]
                + weights[3] * coefficients[component, start + 3, j]
            )
        for b in range(start_x.size):
            j = start_x[b]
            out[component, b] = (
                weights_x[b, 0] * line[component, j]
                + weights_x[b, 1] * line[component, j + 1]
                + weights_x[b, 2] * line[component, j + 2]
                + weights_x[b, 3] * line[component, j + 3]
            )


@njit(nogil=True, cache=True, error_model="numpy")
def _deposit_tile(
    window: FloatArray, share: float, upper: FloatArray, lower: FloatArray, b: int
) -> None:
    """Add one tile; where a fold crosses it, its two triangles lie on top of each other."""
    y0, x0 = upper[0, b], upper[1, b]
    y1, x1 = upper[0, b + 1], upper[1, b + 1]
    y2, x2 = lower[0, b + 1], lower[1, b + 1]
    y3, x3 = lower[0, b], lower[1, b]
    height, width = window.shape
    inside = min(y0, y1, y2, y3) > 0 and max(y0, y1, y2, y3) < height
    if inside and min(x0, x1, x2, x3) > 0 and max(x0, x1, x2, x3) < width:
        # Half of the tiles lie in one pixel.
        i, j = int(y0), int(x0)
        within = i == int(y1) and i == int(y2) and i == int(y3)
        if within and j == int(x1) and j == int(x2) and j == int(x3):
            window[i, j] += share
            return
    one = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
    other = (x2 - x0) * (y3 - y0) - (y2 - y0) * (x3 - x0)
    if one * other >= 0:
        _deposit(window, share, one + other, (y0, x0, y1, x1, y2, x2, y3, x3))
    else:
        _deposit(window, share / 2, one, (y0, x0, y1, x1, y2, x2, y2, x2))
        _deposit(window, share / 2, other, (y0, x0, y2, x2, y3, x3, y3, x3))


@njit(nogil=True, cache=True, error_model="numpy")
def _deposit(window: FloatArray, share: float, double_area: float, corners: Corners) -> None:
    """Share flux among the pixels by their overlap with a quadrilateral of uniform density."""
    y0, x0, y1, x1, y2, x2, y3, x3 = corners
    height, width = window.shape
    top, bottom = min(y0, y1, y2, y3), max(y0, y1, y2, y3)
    left, right = min(x0, x1, x2, x3), max(x0, x1, x2, x3)
    if bottom <= 0 or top >= height or right <= 0 or left >= width:
        return
    inside = top >= 0 and bottom <= height and left >= 0 and right <= width
    i0 = math.floor(max(top, 0.0))
    j0 = math.floor(max(left, 0.0))
    i1 = max(math.ceil(min(bottom, height)) - 1, i0)
    j1 = max(math.ceil(min(right, width)) - 1, j0)
    if inside and i0 == i1 and j0 == j1:
        window[i0, j0] += share
        return
    if abs(double_area) < _SLIVER * ((bottom - top) ** 2 + (right - left) ** 2):
        _deposit_line(window, share, corners)
        return

    scale = 2 * share / double_area
    rest = share
    for i in range(i0, i1 + 1):
        before = 0.0
        if left < 0:
            before = _area_left(i, 0.0, corners)
        for j in range(j0, j1 + 1):
            if inside and i == i1 and j == j1:
                window[i, j] += rest
                return
            area = _area_left(i, j + 1.0, corners)
            amount = min(max(scale * (area - before), 0.0), rest)
            window[i, j] += amount
            rest -= amount
            before = area


@njit(nogil=True, cache=True, error_model="numpy")
def _deposit_line(window: FloatArray, share: float, corners: Corners) -> None:
    """Add a quadrilateral without area as four points, halfway from its corners to its middle."""
    y0, x0, y1, x1, y2, x2, y3, x3 = corners
    height, width = window.shape
    middle_y, middle_x = (y0 + y1 + y2 + y3) / 4, (x0 + x1 + x2 + x3) / 4
    for corner_y, corner_x in ((y0, x0), (y1, x1), (y2, x2), (y3, x3)):
        y, x = (corner_y + middle_y) / 2, (corner_x + middle_x) / 2
        if 0 <= y <= height and 0 <= x <= width:
            window[min(int(y), height - 1), min(int(x), width - 1)] += share / 4


@njit(nogil=True, cache=True, error_model="numpy")
def _area_left(row: int, cut: float, corners: Corners) -> float:
    """Signed area of a quadrilateral within a row of pixels, left of ``x = cut``."""
    # Green's theorem: it is ∮ min(x - cut, 0) dy along the boundary within the row.
    y0, x0, y1, x1, y2, x2, y3, x3 = corners
    return (
        _edge_integral(row, cut, y0, x0, y1, x1)
        + _edge_integral(row, cut, y1, x1, y2, x2)
        + _edge_integral(row, cut, y2, x2, y3, x3)
        + _edge_integral(row, cut, y3, x3, y0, x0)
    )


@njit(nogil=True, cache=True, error_model="numpy")
def _edge_integral(row: int, cut: float, ya: float, xa: float, yb: float, xb: float) -> float:
    """Integral of min(x - cut, 0) dy along an edge, where it is within the row."""
    u, v = xa - cut, xb - cut
    if u >= 0 and v >= 0:
        return 0.0
    start = min(max(ya, row), row + 1.0)
    end = min(max(yb, row), row + 1.0)
    if start == end:
        return 0.0
    if start != ya or end != yb:
        slope = (xb - xa) / (yb - ya)
        u += (start - ya) * slope
        v = xa + (end - ya) * slope - cut
        if u >= 0 and v >= 0:
            return 0.0
    if u <= 0 and v <= 0:
        return 0.5 * (u + v) * (end - start)
    return 0.5 * min(u, v) ** 2 / -abs(u - v) * (end - start)
