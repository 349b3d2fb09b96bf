"""Image formation from a displacement.

- the image of a source whose rays are displaced: `synthetic_image`
- how much the map stretches each pixel: `jacobian_determinant`

The source is cut into small tiles, a few per pixel. The corners of a tile are rays;
the tile's flux lands in the quadrilateral between them and is shared among the
pixels by exact overlap of areas. Neighbouring tiles have their corners in common, so
the image has neither gaps nor ripples, and no blur beyond the pixels' own.
"""

from __future__ import annotations

import itertools
import math
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solveh_banded

from napari_shadowinv._system.arrays import PIXELS, VECTOR, plain_array
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics._deposit import deposit_band

__all__ = ["jacobian_determinant", "synthetic_image"]

# A cubic spline without knots next to the border needs four samples.
_MIN_SIDE_PX = 4
# Fixed, so that sums are formed in the same order whatever the number of threads.
_N_BANDS = 32
_BYTES_PER_PIXEL = 72  # displacement, its spline, source and image


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

    samples = _spline_samples(tiles)

    def image_of_band(rows: tuple[int, int]) -> tuple[int, FloatArray]:
        top, bottom = _landing_rows(coefficients[0], *rows)
        window = np.zeros((bottom - top, shape[1]))
        if bottom > top:
            deposit_band(coefficients, *samples, flux, *rows, top, window)
        return top, window

    report = Reporter(on_progress, should_stop)
    bands = _bands(shape[0])
    image = np.zeros(shape)
    report("image", 0, len(bands))
    pool = ThreadPoolExecutor(threads or os.cpu_count())
    try:
        coefficients = np.stack(list(pool.map(_spline_coefficients, field)))
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
    plain = plain_array(displacement, "displacement", VECTOR, unit=PIXELS)
    check_memory(plain.shape[-2:], _BYTES_PER_PIXEL, "an image")
    field = np.asarray(plain, dtype=np.float64)
    if field.ndim != 3 or field.shape[0] != 2:
        raise InputError(
            f"displacement has shape {field.shape}: expected (2, height, width), "
            "the y component first"
        )
    if min(field.shape[1:]) < _MIN_SIDE_PX:
        raise InputError(
            f"displacement has shape {field.shape}: the image must be at least "
            f"{_MIN_SIDE_PX} × {_MIN_SIDE_PX} pixels"
        )
    _refuse_non_finite("displacement", field)
    return field


def _checked_source(source: ArrayLike | None, shape: tuple[int, int]) -> FloatArray:
    if source is None:
        return np.ones(shape)
    plain = plain_array(source, "source")
    if plain.shape != shape:
        raise InputError(
            f"source has shape {plain.shape}, displacement describes {shape}: they must match"
        )
    flux = np.ascontiguousarray(plain, dtype=np.float64)
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
    edges = np.linspace(0, height, min(_N_BANDS, height) + 1).astype(int).tolist()
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


def _spline_samples(tiles: int) -> tuple[IntArray, FloatArray]:
    """First of the four coefficients of each line that cuts a pixel, and their weights."""
    position = np.arange(tiles) / tiles - 0.5
    knot = np.floor(position)
    t = position - knot
    weights = np.stack(
        [(1 - t) ** 3, 4 - 6 * t**2 + 3 * t**3, 1 + 3 * t + 3 * t**2 - 3 * t**3, t**3], axis=1
    )
    return knot.astype(np.int64) + 1, weights / 6
