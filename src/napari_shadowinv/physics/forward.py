"""Image formation from a displacement.

- the image of a source whose rays are displaced: `synthetic_image`
- how much the map stretches each pixel: `jacobian_determinant`

The source is cut into small tiles, a few per pixel. The corners of a tile are rays;
the tile's flux lands in the quadrilateral between them and is shared among the
pixels by exact overlap of areas. Neighbouring tiles have their corners in common, so
the image has neither gaps nor ripples, and no blur beyond the pixels' own.

A tile's flux is spread evenly over its quadrilateral. Its share of each pixel follows from its
edges: to the right along a row of pixels, the density rises at an edge by the difference between
its two sides. So an edge, which two tiles share, is processed once, and running sums along the
rows give the image. A tile that is nearly a line, or that a fold crosses, would leave rounding
errors in the rest of its rows; its overlaps are computed pixel by pixel.
"""

from __future__ import annotations

import itertools
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.machine import LIGHT_ITEMS, available_threads, in_ranges
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.physics.arrays import PIXELS, VECTOR, check_finite, check_shape, plain_array

# Of a tile: y0, x0, y1, x1, y2, x2, y3, x3.
Corners = tuple[float, float, float, float, float, float, float, float]

_ONE = np.uint32(1)


@njit(nogil=True, cache=True, error_model="numpy")
def deposit_band(
    coefficients: FloatArray,
    knots: IntArray,
    weights: FloatArray,
    flux: FloatArray,
    first: int,
    last: int,
    top: int,
    window: FloatArray,
) -> None:
    """Add the image of the source's rows ``first`` to ``last`` to a window of the image.

    `knots` and `weights` belong to the spline at each of the lines that cut a pixel.
    """
    # Positions count from the window's corner: its pixel (i, j) covers [i, i + 1] × [j, j + 1].
    tiles = knots.size
    corners = flux.shape[1] * tiles + 1
    upper, lower = np.empty((2, corners)), np.empty((2, corners))
    pixels_above, pixels = np.empty((2, corners), np.int32), np.empty((2, corners), np.int32)
    # Tile b lies between corners b and b + 1; before the first and after the last there is none.
    above, current = np.zeros(corners + 1), np.zeros(corners + 1)
    rises = np.zeros((window.shape[0], window.shape[1] + 1))
    for a in range(first * tiles, last * tiles + 1):
        upper, lower = lower, upper
        pixels_above, pixels = pixels, pixels_above
        _land_corners(coefficients, knots, weights, a, top, lower)
        _find_pixels(lower, window, pixels)
        if a > first * tiles:
            above, current = current, above
            _spread_flux(flux[(a - 1) // tiles], tiles, upper, lower, window, current)
            steps = above[1:-1] - current[1:-1]
            _add_edges(rises, steps, upper, pixels_above, upper, pixels_above, 1)
            _add_edges(rises, current[1:] - current[:-1], upper, pixels_above, lower, pixels, 0)
    _add_edges(rises, current[1:-1].copy(), lower, pixels, lower, pixels, 1)
    _add_sums(rises, window)


@njit(nogil=True, cache=True, error_model="numpy")
def _land_corners(
    coefficients: FloatArray,
    knots: IntArray,
    weights: FloatArray,
    a: int,
    top: int,
    out: FloatArray,
) -> None:
    """Compute the landed corners of line `a` by the spline along y, then along x."""
    tiles = knots.size
    row, phase = a // tiles, a % tiles
    start = row + knots[phase]
    v0, v1, v2, v3 = weights[phase]
    line = np.empty(coefficients.shape[2])
    for component in range(2):
        rows = coefficients[component, start : start + 4]
        for j in range(line.size):
            line[j] = v0 * rows[0, j] + v1 * rows[1, j] + v2 * rows[2, j] + v3 * rows[3, j]
        at = out[component]
        for k in range(tiles):
            w0, w1, w2, w3 = weights[k]
            origin = k / tiles if component else a / tiles - top
            for c in range((at.size - k + tiles - 1) // tiles):
                j = c + knots[k]
                moved = w0 * line[j] + w1 * line[j + 1] + w2 * line[j + 2] + w3 * line[j + 3]
                at[c * tiles + k] = origin + component * c + moved


@njit(nogil=True, cache=True, error_model="numpy")
def _find_pixels(corners: FloatArray, window: FloatArray, out: IntArray) -> None:
    """Row and column of the pixel that holds each corner, -1 outside the window."""
    for component in range(2):
        size = float(window.shape[component])
        for b in range(out.shape[1]):
            at = corners[component, b]
            out[component, b] = np.int32(at) if 0.0 <= at < size else -1


@njit(nogil=True, cache=True, error_model="numpy")
def _spread_flux(
    flux: FloatArray,
    tiles: int,
    upper: FloatArray,
    lower: FloatArray,
    window: FloatArray,
    out: FloatArray,
) -> None:
    """Flux per area of a line of tiles as they land; 0 for those that are deposited right away."""
    thin = 2 * 1e-3 / (tiles * tiles)  # a thousandth of the area in the source
    for b in range(upper.shape[1] - 1):
        share = flux[b // tiles] / (tiles * tiles)
        y0, x0 = upper[0, b], upper[1, b]
        y1, x1 = upper[0, b + 1], upper[1, b + 1]
        y2, x2 = lower[0, b + 1], lower[1, b + 1]
        y3, x3 = lower[0, b], lower[1, b]
        area_012 = (x1 - x0) * (y2 - y0) - (y1 - y0) * (x2 - x0)
        area_023 = (x2 - x0) * (y3 - y0) - (y2 - y0) * (x3 - x0)
        out[b + 1] = 0.0
        if share <= 0:
            continue
        if area_012 * area_023 < 0:
            # A fold crosses it: its two triangles lie on top of each other.
            _deposit(window, share / 2, area_012, (y0, x0, y1, x1, y2, x2, y2, x2))
            _deposit(window, share / 2, area_023, (y0, x0, y2, x2, y3, x3, y3, x3))
        elif abs(area_012 + area_023) < thin:
            _deposit(window, share, area_012 + area_023, (y0, x0, y1, x1, y2, x2, y3, x3))
        else:
            out[b + 1] = 2 * share / (area_012 + area_023)


@njit(nogil=True, cache=True, error_model="numpy")
def _add_edges(
    rises: FloatArray,
    steps: FloatArray,
    starts: FloatArray,
    start_pixels: IntArray,
    ends: FloatArray,
    end_pixels: IntArray,
    ahead: int,
) -> None:
    """Add the rise of the density at edges, from corners b to b + `ahead`, by `steps`."""
    far = np.empty(steps.size, np.int64)
    count = 0
    for b in range(steps.size):
        e = b + ahead
        ia, ja, ib, jb = start_pixels[0, b], start_pixels[1, b], end_pixels[0, e], end_pixels[1, e]
        ya, xa, yb, xb = starts[0, b], starts[1, b], ends[0, e], ends[1, e]
        step = steps[b]
        if min(ia, ja, ib, jb) < 0 or abs(ia - ib) + abs(ja - jb) > 1:
            far[count] = b
            count += 1
        elif ia == ib and ja == jb:
            _add_piece(rises, ia, ja, step * (yb - ya), 0.5 * (xa + xb))
        elif ia == ib:
            # Over the side between two pixels of a row
            x = float(max(ja, jb))
            y = ya + (x - xa) * (yb - ya) / (xb - xa)
            _add_piece(rises, ia, ja, step * (y - ya), 0.5 * (xa + x))
            _add_piece(rises, ib, jb, step * (yb - y), 0.5 * (x + xb))
        else:
            # From one row of pixels to the next
            y = float(max(ia, ib))
            x = xa + (y - ya) * (xb - xa) / (yb - ya)
            _add_piece(rises, ia, ja, step * (y - ya), 0.5 * (xa + x))
            _add_piece(rises, ib, jb, step * (yb - y), 0.5 * (x + xb))
    # Apart, because a call in the loop above slows it down twofold.
    for b in far[:count]:
        if steps[b] != 0:
            e = b + ahead
            _add_long_edge(rises, steps[b], starts[0, b], starts[1, b], ends[0, e], ends[1, e])


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def _add_piece(rises: FloatArray, row: int, column: int, flow: float, x: float) -> None:
    """Add a part of an edge within a pixel; x is the part's middle."""
    i, j = np.uint32(row), np.uint32(column)
    later = flow * (x - column)
    rises[i, j] += flow - later
    rises[i, j + _ONE] += later


@njit(nogil=True, cache=True, error_model="numpy")
def _add_long_edge(
    rises: FloatArray, step: float, ya: float, xa: float, yb: float, xb: float
) -> None:
    """Add an edge that crosses from pixel to pixel, row by row."""
    if ya > yb:
        ya, xa, yb, xb, step = yb, xb, ya, xa, -step
    y, end = max(ya, 0.0), min(yb, float(rises.shape[0]))
    if y >= end:
        return
    slope = (xb - xa) / (yb - ya)
    x = xa + (y - ya) * slope
    for i in range(int(y), math.ceil(end)):
        next_y = min(i + 1.0, end)
        next_x = xb if next_y == yb else xa + (next_y - ya) * slope
        _add_in_row(rises[i], step * (next_y - y), min(x, next_x), max(x, next_x))
        y, x = next_y, next_x


@njit(nogil=True, cache=True, error_model="numpy")
def _add_in_row(row: FloatArray, flow: float, x_min: float, x_max: float) -> None:
    """Add a part of an edge within a row of pixels; left of the image it fills the whole row."""
    width = row.size - 1
    if x_max <= 0:
        row[0] += flow
        return
    if x_min >= width:
        return
    rate = flow / (x_max - x_min) if x_max > x_min else 0.0
    if x_min < 0:
        row[0] -= rate * x_min
        x_min = 0.0
    for j in range(int(x_min), min(int(min(x_max, float(width))) + 1, width)):
        part = flow if rate == 0 else rate * (min(x_max, j + 1.0) - max(x_min, float(j)))
        later = part * (0.5 * (max(x_min, float(j)) + min(x_max, j + 1.0)) - j)
        row[j] += part - later
        row[j + 1] += later


@njit(nogil=True, cache=True, error_model="numpy")
def _add_sums(rises: FloatArray, window: FloatArray) -> None:
    """Add the running sums of the rises, but no rounding errors where no flux landed."""
    brightest = 0.0
    for i in range(window.shape[0]):
        total = 0.0
        for j in range(window.shape[1]):
            total += rises[i, j]
            rises[i, j] = total
            brightest = max(brightest, total)
    for i in range(window.shape[0]):
        for j in range(window.shape[1]):
            if rises[i, j] > 1e-12 * brightest:
                window[i, j] += rises[i, j]


@njit(nogil=True, cache=True, error_model="numpy")
def _deposit(window: FloatArray, share: float, double_area: float, corners: Corners) -> None:
    """Share flux among the pixels by their overlap with a quadrilateral of uniform density."""
    y0, x0, y1, x1, y2, x2, y3, x3 = corners
    height, width = window.shape
    y_min, y_max = min(y0, y1, y2, y3), max(y0, y1, y2, y3)
    x_min, x_max = min(x0, x1, x2, x3), max(x0, x1, x2, x3)
    if y_max <= 0 or y_min >= height or x_max <= 0 or x_min >= width:
        return
    inside = y_min >= 0 and y_max <= height and x_min >= 0 and x_max <= width
    i0 = math.floor(max(y_min, 0.0))
    j0 = math.floor(max(x_min, 0.0))
    i1 = max(math.ceil(min(y_max, height)) - 1, i0)
    j1 = max(math.ceil(min(x_max, width)) - 1, j0)
    if inside and i0 == i1 and j0 == j1:
        window[i0, j0] += share
        return
    # A tile so narrow is a line, and shares of its area are noise.
    if abs(double_area) < 1e-9 * ((y_max - y_min) ** 2 + (x_max - x_min) ** 2):
        _deposit_line(window, share, corners)
        return

    scale = 2 * share / double_area
    remainder = share
    for i in range(i0, i1 + 1):
        before = 0.0
        if x_min < 0:
            before = _area_left(i, 0.0, corners)
        for j in range(j0, j1 + 1):
            if inside and i == i1 and j == j1:
                window[i, j] += remainder
                return
            area = _area_left(i, j + 1.0, corners)
            amount = min(max(scale * (area - before), 0.0), remainder)
            window[i, j] += amount
            remainder -= amount
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


# A cubic spline without knots next to the border needs four samples.
MIN_SIDE_PX = 4


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
    field = _finite_displacement(displacement)
    shape = (field.shape[1], field.shape[2])
    flux = _checked_source(source, shape)
    if rays_per_pixel < 1:
        raise InputError(f"rays per pixel are {rays_per_pixel}: expected 1 or more")
    available = usable_threads(threads)
    tiles = math.isqrt(rays_per_pixel - 1) + 1

    samples = _spline_samples(tiles)

    def image_of_band(rows: tuple[int, int]) -> tuple[int, FloatArray]:
        top, bottom = _landing_rows(coefficients[0], *rows)
        window = np.zeros((bottom - top, shape[1]))
        if bottom > top:
            deposit_band(coefficients, *samples, flux, *rows, top, window)
        return top, window

    report = Reporter(on_progress, should_stop)
    # So that sums are formed in the same order whatever the number of threads.
    count = min(32, max(1, shape[0] // 16))
    bands = list(itertools.pairwise(shape[0] * k // count for k in range(count + 1)))
    image = np.zeros(shape)
    report("image", 0, len(bands))
    pool = ThreadPoolExecutor(available)
    try:
        coefficients = _spline_coefficients(field, available)
        for done, (top, window) in enumerate(pool.map(image_of_band, bands), start=1):
            image[top : top + len(window)] += window
            report("image", done, len(bands))
    finally:
        # On a request to stop, bands that have not begun are skipped.
        pool.shutdown(cancel_futures=True)
    return image


def jacobian_determinant(displacement: ArrayLike, *, threads: int | None = None) -> FloatArray:
    """Area, in the image, of each pixel of the source: det(1 + ∇d), Eq. 4 of the paper.

    Negative where the map has folded the pixel over; small where rays crowd. Made of
    differences that are of second order up to the border. An `InputError` if the shape does not
    fit or a value is not finite.

    Parameters
    ----------
    displacement : array_like, shape (2, H, W)
        Displacement at the pixels' centres in px, axis order (y, x).
    threads : int, optional
        Threads to use. Default: all cores. The result does not depend on it.

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
    field = _finite_displacement(displacement)
    determinant = np.empty((field.shape[1], field.shape[2]))
    rows = max(1, LIGHT_ITEMS // determinant.shape[1])
    threads = available_threads(threads)
    in_ranges(_fill_determinant, len(determinant), threads, field, determinant, smallest=rows)
    return determinant


@njit(nogil=True, cache=True, inline="always")
def _neighbors_in_line(i: int, size: int) -> tuple[int, int, int, float, float, float]:
    """Return three places along a line, and their weights for the derivative at i."""
    if i == 0:
        return 0, 1, 2, -1.5, 2.0, -0.5
    if i == size - 1:
        return i, i - 1, i - 2, 1.5, -2.0, 0.5
    return i + 1, i - 1, i, 0.5, -0.5, 0.0


@njit(nogil=True, cache=True)
def _fill_determinant(start: int, stop: int, field: FloatArray, determinant: FloatArray) -> None:
    """Compute the determinant in rows `start` to `stop`."""
    height, width = determinant.shape
    for y in range(start, stop):
        y0, y1, y2, of_y0, of_y1, of_y2 = _neighbors_in_line(y, height)
        for x in range(width):
            x0, x1, x2, of_x0, of_x1, of_x2 = _neighbors_in_line(x, width)
            dy_dy = of_y0 * field[0, y0, x] + of_y1 * field[0, y1, x] + of_y2 * field[0, y2, x]
            dx_dy = of_y0 * field[1, y0, x] + of_y1 * field[1, y1, x] + of_y2 * field[1, y2, x]
            dy_dx = of_x0 * field[0, y, x0] + of_x1 * field[0, y, x1] + of_x2 * field[0, y, x2]
            dx_dx = of_x0 * field[1, y, x0] + of_x1 * field[1, y, x1] + of_x2 * field[1, y, x2]
            determinant[y, x] = (1 + dy_dy) * (1 + dx_dx) - dy_dx * dx_dy


def usable_threads(threads: int | None) -> int:
    """Return the number of threads to use, or raise an `InputError` if it is not positive."""
    if threads is not None and threads < 1:
        raise InputError(f"threads is {threads}: expected 1 or more, or None for all cores")
    return available_threads(threads)


def checked_shape(shape: tuple[int, int], name: str = "the image") -> tuple[int, int]:
    """Return height and width of an image, or raise an `InputError`."""
    if len(tuple(shape)) != 2 or min(shape) < MIN_SIDE_PX:
        raise InputError(
            f"{name} has shape {tuple(shape)}: expected (height, width), at least {MIN_SIDE_PX} "
            "pixels each way"
        )
    return int(shape[0]), int(shape[1])


def checked_displacement(displacement: ArrayLike) -> FloatArray:
    """Return a displacement as floats, or raise an `InputError` if a spline cannot be fitted."""
    plain = plain_array(displacement, "displacement", VECTOR, unit=PIXELS)
    # Displacement, its spline, source and image.
    check_memory(plain.shape[-2:], 72, "an image")
    field = np.asarray(plain, dtype=np.float64)
    if field.ndim != 3 or field.shape[0] != 2 or min(field.shape[1:]) < MIN_SIDE_PX:
        raise InputError(
            f"displacement has shape {field.shape}: expected (2, height, width), the y component "
            f"first, at least {MIN_SIDE_PX} pixels each way"
        )
    return field


def _finite_displacement(displacement: ArrayLike) -> FloatArray:
    field = np.ascontiguousarray(checked_displacement(displacement))
    check_finite("displacement", field)
    # The kernels are compiled for one type.
    return field if field.flags.writeable else field.copy()


def _checked_source(source: ArrayLike | None, shape: tuple[int, int]) -> FloatArray:
    if source is None:
        return np.ones(shape)
    plain = plain_array(source, "source")
    check_shape("source", plain.shape, shape, "displacement describes")
    flux = np.ascontiguousarray(plain, dtype=np.float64)
    check_finite("source", flux)
    if flux.min() < 0:
        raise InputError(
            f"source has {np.count_nonzero(flux < 0)} negative pixels (lowest {flux.min():g}): "
            "the flux must be 0 or more; clip them or subtract less background"
        )
    if flux.max() == 0:
        raise InputError("source is zero everywhere: at least one pixel must have flux")
    return flux


def _landing_rows(coefficients: FloatArray, first: int, last: int) -> tuple[int, int]:
    """Rows of the image that the rows ``first`` to ``last`` of the source can reach."""
    # A spline never leaves the range of its coefficients.
    height = coefficients.shape[0] - 4
    nearby = coefficients[first : last + 4]
    top = min(max(first + nearby.min() - 1, 0.0), height)
    bottom = min(max(last + nearby.max() + 1, top), height)
    return math.floor(top), math.ceil(bottom)


def _spline_coefficients(field: FloatArray, threads: int = 1) -> FloatArray:
    """Coefficients of bicubic B-splines through all values of planes, two more on each side."""
    count, height, width = field.shape
    along_y = np.empty((height + 4, width))
    coefficients = np.empty((count, height + 4, width + 4))
    columns, rows = max(64, LIGHT_ITEMS // height), max(1, LIGHT_ITEMS // width)
    pivots = _pivots(height), _pivots(width)
    for values, out in zip(field, coefficients, strict=True):
        in_ranges(_filter_columns, width, threads, values, pivots[0], along_y, smallest=columns)
        in_ranges(_filter_rows, height + 4, threads, along_y, pivots[1], out, smallest=rows)
    return coefficients


def _pivots(n: int) -> FloatArray:
    """Inverse pivots of the elimination in a matrix with 4 on the diagonal and 1 beside it."""
    pivots = np.empty(max(n - 4, 1))
    pivots[0] = 0.25
    for i in range(1, len(pivots)):
        pivots[i] = 1 / (4 - pivots[i - 1])
    return pivots


# The first and last polynomial pieces continue across one more knot ("not a knot") and on to the
# rim of the image, half a pixel outside the last centres. One polynomial on both sides of a knot:
# the coefficient is f - f''/6, f'' by differences. Between these the coefficients solve
# c[i - 1] + 4 c[i] + c[i + 1] = 6 f[i]. Along y whole rows are combined, along x numbers.


@njit(nogil=True, cache=True)
def _fill_next_to_ends(f: FloatArray, c: FloatArray) -> None:
    """Compute the coefficients at the second and at the last value but one of a line."""
    n = f.size
    c[3] = (8 * f[1] - f[0] - f[2]) / 6
    c[n] = (8 * f[n - 2] - f[n - 1] - f[n - 3]) / 6


@njit(nogil=True, cache=True)
def _fill_ends(f: FloatArray, c: FloatArray) -> None:
    """Compute the three coefficients at each end of a line from those between them."""
    n = f.size
    c[2] = 6 * f[1] - 4 * c[3] - c[4]
    c[1] = 6 * f[0] - 4 * c[2] - c[3]
    c[0] = 4 * c[1] - 6 * c[2] + 4 * c[3] - c[4]
    c[n + 1] = 6 * f[n - 2] - 4 * c[n] - c[n - 1]
    c[n + 2] = 6 * f[n - 1] - 4 * c[n + 1] - c[n]
    c[n + 3] = 4 * c[n + 2] - 6 * c[n + 1] + 4 * c[n] - c[n - 1]


@njit(nogil=True, cache=True)
def _filter_columns(
    start: int, stop: int, values: FloatArray, pivots: FloatArray, out: FloatArray
) -> None:
    """Compute B-spline coefficients along y, shape (n + 4, m), in columns `start` to `stop`."""
    n = values.shape[0]
    for j in range(start, stop):
        _fill_next_to_ends(values[:, j], out[:, j])
    for i in range(2, n - 2):
        pivot = pivots[i - 2]
        for j in range(start, stop):
            out[i + 2, j] = pivot * (6 * values[i, j] - out[i + 1, j])
    for i in range(n - 3, 1, -1):
        pivot = pivots[i - 2]
        for j in range(start, stop):
            out[i + 2, j] -= pivot * out[i + 3, j]
    for j in range(start, stop):
        _fill_ends(values[:, j], out[:, j])


@njit(nogil=True, cache=True)
def _filter_rows(
    start: int, stop: int, values: FloatArray, pivots: FloatArray, out: FloatArray
) -> None:
    """Compute B-spline coefficients along x, shape (m, n + 4), in rows `start` to `stop`."""
    n = values.shape[1]
    for row in range(start, stop):
        f, c = values[row], out[row]
        _fill_next_to_ends(f, c)
        for i in range(2, n - 2):
            c[i + 2] = pivots[i - 2] * (6 * f[i] - c[i + 1])
        for i in range(n - 3, 1, -1):
            c[i + 2] -= pivots[i - 2] * c[i + 3]
        _fill_ends(f, c)


def _spline_samples(tiles: int) -> tuple[IntArray, FloatArray]:
    """First of the four coefficients of each line that cuts a pixel, and their weights."""
    position = np.arange(tiles) / tiles - 0.5
    knot = np.floor(position)
    t = position - knot
    weights = np.stack(
        [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3], axis=1
    )
    return knot.astype(np.int64) + 1, weights / 6
