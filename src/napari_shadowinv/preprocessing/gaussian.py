"""A Gaussian beam fitted to the shot: `gaussian_source`; in a recipe: `GaussianEstimate`."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution, OnCaution, warn_of
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.estimates import Estimate, uniform_source

_MOST_FITTED_PIXELS = 2**16
_MOST_FITS = 10
_NOTABLE_EXTRAPOLATION = 1.5  # times the brightest pixel seen
# Of a fitted Gaussian: height over the image's mean, and sides from the image's middle.
_MAX_HEIGHT = 1e3
_MAX_DISTANCE = 3.0


class GaussianEstimate(Estimate):
    """A fitted elliptical spot."""

    title = "fitted Gaussian"
    place = 30
    method: Literal["gaussian"] = "gaussian"

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        should_stop: ShouldStop | None,
        on_caution: OnCaution | None,
    ) -> FloatArray:
        return gaussian_source(image, mask=mask, should_stop=should_stop, on_caution=on_caution)


def gaussian_source(
    image: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
    on_caution: OnCaution | None = None,
) -> FloatArray:
    """Elliptical Gaussian plus a constant, fitted to the image.

    It is an estimate as in `napari_shadowinv.preprocessing.estimates`.

    Parameters
    ----------
    image : array_like, shape (H, W)
    mask, should_stop : optional
    on_caution : callable, optional
        Receives a `Caution` if the fit is doubtful. Default: `warnings.warn` with its text.

    Returns
    -------
    ndarray of float64, shape (H, W)
        Uniform if the fit rises under the mask to ten times the brightest usable pixel.

    Notes
    -----
    Least squares with the soft L1 loss, whose unit is the median absolute deviation of the
    residuals, found by fitting again until it stays: modulation stronger than that counts
    in proportion, not squared. Centre, both widths, tilt, height and constant are free; the
    last two are not negative. Large images are averaged in blocks for the fit. A Gaussian
    narrower than 1/256 of the image, higher than 1000 times the mean, or more than three sides
    away from the middle of the usable pixels is not considered.
    """
    values, usable = pixels.beam_pixels(image, mask)
    side, mean = max(values.shape), values[usable].mean()
    y, x, sample = _block_samples(values / mean, usable)
    report = Reporter(None, should_stop)
    parameters = _fit_gaussian(y / side, x / side, sample, report)
    rows, columns = (np.arange(n) / side for n in values.shape)
    beam = _gaussian(parameters, rows[:, None], columns)
    rise = float(beam.max() / sample.max())
    report_caution = on_caution or warn_of
    if rise > pixels.MOST_EXTRAPOLATION:
        text = (
            "no Gaussian beam can be fitted to the unmasked pixels, so the source is assumed "
            "uniform: mask less, or choose another estimate"
        )
        report_caution(Caution("source", text))
        return uniform_source(image, mask=mask)
    if rise > _NOTABLE_EXTRAPOLATION:
        text = (
            f"the Gaussian beam rises to {rise:.2g} times the fitted data under the mask: "
            "compare it with another estimate, or mask less"
        )
        report_caution(Caution("source", text))
    return pixels.with_flux_of(mean * beam, values, usable)


def _block_samples(
    values: FloatArray, usable: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return positions y, x and means of blocks of usable pixels, few enough for a fit."""
    block = int(np.ceil(np.sqrt(values.size / _MOST_FITTED_PIXELS)))
    share = pixels.block_means(usable.astype(np.float64), block)
    means = pixels.block_means(np.where(usable, values, 0.0), block)
    # A block is used only if it is complete, since a part of it has another middle.
    # Under a mask so fine that no block is complete, the fullest are used.
    y, x = np.nonzero(share >= share.max())
    middle = (block - 1) / 2
    rows, columns = (np.asarray(axis * block + middle, dtype=np.float64) for axis in (y, x))
    return rows, columns, np.asarray(means[y, x] / share[y, x])


def _fit_gaussian(y: FloatArray, x: FloatArray, sample: FloatArray, report: Reporter) -> FloatArray:
    """Fit the parameters of `_gaussian` to samples, by repeated robust least squares."""
    bounds = _bounds(y, x)

    def excess(p: FloatArray) -> FloatArray:
        report("source", 0)
        return _gaussian(p, y, x) - sample

    def fitted(start: FloatArray, loss: str, scale: float) -> FloatArray:
        fit = scipy.optimize.least_squares(
            excess, start, lambda p: _gaussian_slopes(p, y, x), bounds,
            loss=loss, f_scale=scale, x_scale="jac", max_nfev=200,
        )  # fmt: skip
        return np.asarray(fit.x)

    # A plain fit first: the robust loss, from far away, would call the whole beam an outlier.
    parameters = fitted(np.clip(_guess_gaussian(y, x, sample), *bounds), "linear", 1.0)
    scale = 0.0
    for _ in range(_MOST_FITS):
        residual = _gaussian(parameters, y, x) - sample
        previous, scale = scale, max(pixels.NORMAL_MAD * float(np.median(np.abs(residual))), 1e-6)
        if abs(scale - previous) < 1e-2 * scale:
            break
        parameters = fitted(parameters, "soft_l1", scale)
    return parameters


def _bounds(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return bounds of the parameters of `_gaussian`, without which it may hide behind a mask."""
    steepest = math.sqrt(_MOST_FITTED_PIXELS)  # one over the width of a block of pixels
    ranges = [
        (0, _MAX_HEIGHT),
        (0, _MAX_HEIGHT),
        *((axis.mean() - _MAX_DISTANCE, axis.mean() + _MAX_DISTANCE) for axis in (y, x)),
        *[(-steepest, steepest)] * 3,
    ]
    least, most = np.transpose(ranges)
    return least, most


def _guess_gaussian(y: FloatArray, x: FloatArray, sample: FloatArray) -> FloatArray:
    """Return parameters of `_gaussian` by the moments of the image above its dark corners."""
    constant, peak = (float(level) for level in np.percentile(sample, [2, 98]))
    weights = np.maximum(sample - constant, 0) + 1e-9
    centre_y, centre_x = np.average(y, weights=weights), np.average(x, weights=weights)
    widths = [
        max(float(np.sqrt(np.average((axis - centre) ** 2, weights=weights))), 1e-3)
        for axis, centre in ((y, centre_y), (x, centre_x))
    ]
    height = max(peak - constant, 1e-3)
    return np.array(
        [height, max(constant, 1e-3), centre_y, centre_x, 1 / widths[0], 0.0, 1 / widths[1]]
    )


def _gaussian(parameters: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Return height · exp(-½(u² + v²)) + constant, with u = a·dy + b·dx and v = c·dx."""
    # The factors of the inverse covariance, unlike its entries, may take any value.
    height, constant, centre_y, centre_x, a, b, c = parameters
    u = a * (y - centre_y) + b * (x - centre_x)
    v = c * (x - centre_x)
    return np.asarray(height * np.exp(-0.5 * (u**2 + v**2)) + constant)


def _gaussian_slopes(parameters: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Return the derivatives of `_gaussian` by its parameters, shape (samples, 7)."""
    height, _, centre_y, centre_x, a, b, c = parameters
    dy, dx = y - centre_y, x - centre_x
    u, v = a * dy + b * dx, c * dx
    bell = np.exp(-0.5 * (u**2 + v**2))
    slopes = [
        bell,
        np.ones_like(bell),
        height * bell * u * a,
        height * bell * (u * b + v * c),
        -height * bell * u * dy,
        -height * bell * u * dx,
        -height * bell * v * dx,
    ]
    return np.stack(slopes, axis=1)
