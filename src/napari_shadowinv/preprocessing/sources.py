"""Estimates of the undisturbed beam, from an image that the object has already modulated.

An inversion needs the source: the image that the beam would make without the object. Where
none was recorded, or the beam changes from shot to shot, it must be estimated from the shot.

- the beam is flat, or nothing is known: `uniform_source`; whether it can be: `uniform_warnings`
- a point shines evenly in all directions: `isotropic_source`; how far away: `point_distance`
- the beam is a Gaussian spot: `gaussian_source`
- the beam varies slowly, in no known way: `polynomial_source`, `low_pass_source`
- the beam has edges that matter: `total_variation_source`
- the object covers a known part of the image: `interpolated_source`

Each takes an image ``[y, x]`` and returns one of the same shape that is positive everywhere
and has the same flux over the usable pixels. A `mask` is True where a pixel is usable; the
others (dead areas, handwriting, a shadow) may hold anything, NaN too, and are filled in.
An estimate that rises there to ten times the brightest pixel it saw is refused.
Those that take long ask `should_stop` at each of their steps.

Structure that an estimate attributes to the beam is lost from the object, and vice versa. The
choice decides most of the error on large scales: Kasim et al., arXiv:1607.04179, section V.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import gaussian_filter
from scipy.optimize import least_squares
from scipy.sparse.linalg import LinearOperator, cg

from napari_shadowinv._system.progress import OnWarning, Reporter, ShouldStop
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing._total_variation import least_variation
from napari_shadowinv.preprocessing.filters import (
    checked_integer,
    checked_number,
    checked_pixels,
    fit_polynomial,
    low_pass,
)

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

__all__ = [
    "gaussian_source",
    "interpolated_source",
    "isotropic_source",
    "low_pass_source",
    "point_distance",
    "polynomial_source",
    "total_variation_source",
    "uniform_source",
    "uniform_warnings",
]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# As a share of the mean: the floor to which an inversion raises an image's dark pixels.
_FLOOR = 1e-3
_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation, normal noise
_MOST_FITTED_PIXELS = 2**16
_MOST_FITS = 10
_LEAST_SUPPORT = 1e-6
_COARSEST_SIDE = 32
_FILL_WIDTH = 5.0
_NARROWEST_WAVES = 2.0  # px; a Gaussian that is narrower has waves too short for the pixels
_FILL_TOLERANCE = 1e-6
_MOST_EXTRAPOLATION = 10.0  # times the brightest pixel seen
_NOTABLE_EXTRAPOLATION = 1.5  # likewise
# Of a fitted Gaussian: height over the image's mean, and sides from the image's middle.
_HIGHEST, _FARTHEST = 1e3, 3.0
_NOTABLE_FALL = 0.01  # of the fluence, from the brightest pixel to the dimmest


def uniform_source(image: ArrayLike, *, mask: ArrayLike | None = None) -> FloatArray:
    """Flat beam with the mean of the image.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The same number everywhere, in the unit of `image`.

    Raises
    ------
    InputError
        If image and mask cannot be used, or the image has no flux.

    Examples
    --------
    >>> uniform_source([[1, 2], [3, 6]])
    array([[3., 3.], [3., 3.]])
    """
    values, usable = _beam_pixels(image, mask)
    return np.full(values.shape, values[usable].mean())


def uniform_warnings(
    shape: tuple[int, int],
    setup: Setup | None,
    *,
    centre: tuple[float, float] | None = None,
) -> tuple[str, ...]:
    """Say whether a point source would light an image too unevenly to be taken as uniform.

    Parameters
    ----------
    shape : tuple of int
        Height and width of the image.
    setup : Setup, optional
        The experiment. Default: not known, and nothing is said.
    centre : tuple of float, optional
        See `isotropic_source`, there `centre_y` and `centre_x`.

    Returns
    -------
    tuple of str
        Empty where the fluence of an isotropic point source varies by 1 % at most.

    Examples
    --------
    >>> from napari_shadowinv.physics.phantoms import paper_setup
    >>> uniform_warnings((60, 60), paper_setup())
    ()
    >>> len(uniform_warnings((400, 400), paper_setup()))
    1
    """
    if setup is None or setup.collimated:
        return ()
    distance = point_distance(setup)
    axis = [(side - 1) / 2 for side in shape] if centre is None else centre
    near = [max(0.0, place - (side - 1), -place) for place, side in zip(axis, shape, strict=True)]
    far = [max(place, side - 1 - place) for place, side in zip(axis, shape, strict=True)]
    highest, lowest = ((1 + (math.hypot(*r) / distance) ** 2) ** -1.5 for r in (near, far))
    fall = 1 - lowest / highest
    if fall <= _NOTABLE_FALL:
        return ()
    return (
        f"the source is assumed uniform, but a point source {setup.source_object_distance:.3g} m "
        f"from the object lights this image unevenly, by {fall:.1%} between brightest and "
        "dimmest pixel: if yours emits isotropically, choose the source 'isotropic'",
    )


def isotropic_source(
    image: ArrayLike,
    setup: Setup,
    *,
    centre_y: float | None = None,
    centre_x: float | None = None,
    mask: ArrayLike | None = None,
) -> FloatArray:
    """Beam of a point that shines evenly in all directions, on a flat detector.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; only its flux is used.
    setup : Setup
        The experiment: distance of the point, and side of a pixel.
    centre_y, centre_x : float, optional
        Pixel in which the detector faces the point. Default: the middle of the image.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The beam, in the unit of `image`.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, the beam of the setup is
        collimated, or the centre is not finite.

    Notes
    -----
    A pixel receives its share of the solid angle; for small pixels that is proportional to
    cos³θ, with θ the angle between its line of sight to the point and the detector's normal.

    Examples
    --------
    >>> from napari_shadowinv.physics.phantoms import paper_setup
    >>> beam = isotropic_source(np.ones((201, 201)), paper_setup())
    >>> float(round(beam[0, 0] / beam[100, 100], 3))  # the corner, 9.3 degrees from the axis
    0.961
    """
    values, usable = _beam_pixels(image, mask)
    distance = point_distance(setup)
    y, x = (
        _edges(side, "centre_" + axis, centre) / distance
        for side, axis, centre in zip(values.shape, "yx", (centre_y, centre_x), strict=True)
    )
    y = y[:, None]
    # Solid angle of the rectangle between the axis and each corner of the pixels.
    angles = np.arctan2(y * x, np.sqrt(1 + y**2 + x**2))
    beam = np.diff(np.diff(angles, axis=0), axis=1)
    return np.asarray(beam * (values[usable].mean() / beam[usable].mean()))


def point_distance(setup: Setup) -> float:
    """Return how far the point source is from the detector, in px of the detector.

    Raises
    ------
    InputError
        If the beam is collimated.
    """
    if setup.collimated:
        raise InputError(
            "got the source 'isotropic' and a setup with a collimated beam "
            "(source_object_distance is inf): give the distance of the point source, or choose "
            "the source 'uniform'"
        )
    # The magnification enlarges distance and pixel alike.
    return setup.source_object_distance / setup.object_pixel_size


def gaussian_source(
    image: ArrayLike,
    *,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
    on_warning: OnWarning | None = None,
) -> FloatArray:
    """Elliptical Gaussian plus a constant, fitted to the image.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.
    on_warning : callable, optional
        Receives a sentence where the fit has to be doubted. Default: `warnings.warn`.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The fitted beam, in the unit of `image`; the same everywhere if the fit rises, where
        nothing is seen, to ten times what is seen.

    Raises
    ------
    InputError
        If image and mask cannot be used, or the image has no flux.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    Least squares with the soft L1 loss, whose unit is the median absolute deviation of the
    residuals, found by fitting again until it stays: modulation stronger than that counts
    in proportion, not squared. Centre, both widths, tilt, height and constant are free; the
    last two are not negative. Large images are averaged in blocks for the fit. A Gaussian
    narrower than 1/256 of the image, higher than 1000 times the mean, or more than three sides
    away from the middle of what is seen is not considered.

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:40, :50]
    >>> beam = 3 + 7 * np.exp(-((y - 18) ** 2) / 200 - (x - 30) ** 2 / 300)
    >>> float(abs(gaussian_source(beam) / beam - 1).max()) < 1e-4
    True
    """
    values, usable = _beam_pixels(image, mask)
    side, mean = max(values.shape), values[usable].mean()
    y, x, sample = _samples(values / mean, usable)
    report = Reporter(None, should_stop)
    parameters = _fitted_gaussian(y / side, x / side, sample, report)
    rows, columns = (np.arange(n) / side for n in values.shape)
    beam = _gaussian(parameters, rows[:, None], columns)
    rise = float(beam.max() / sample.max())
    tell = _python_warning if on_warning is None else on_warning
    if rise > _MOST_EXTRAPOLATION:
        tell(
            "no Gaussian beam can be fitted to the unmasked pixels, so the source is assumed "
            "uniform: mask less, or choose another estimate"
        )
        return uniform_source(image, mask=mask)
    if rise > _NOTABLE_EXTRAPOLATION:
        tell(
            f"the Gaussian beam rises to {rise:.2g} times the fitted data under the mask: "
            "compare it with another estimate, or mask less"
        )
    return _with_flux_of(mean * beam, values, usable)


def polynomial_source(
    image: ArrayLike,
    *,
    degree: int = 2,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Polynomial in y and x, fitted to the image and little moved by its modulation.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    degree : int, default 2
        Total degree of the polynomial in y and x, from 0 to 10.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The fitted beam in the unit of `image`; where the polynomial falls below 0.001 of the
        image's mean, it is that.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, the degree is out of range,
        or there are fewer usable pixels than coefficients.
    InversionCancelled
        If `should_stop` returned true.

    See Also
    --------
    napari_shadowinv.preprocessing.filters.remove_background : flatten an image by the same fit.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.linspace(1, 3, 50) * np.ones((50, 1))
    >>> float(abs(polynomial_source(ramp, degree=1) - ramp).max()) < 1e-12
    True
    """
    values, usable = _beam_pixels(image, mask)
    fit = fit_polynomial(values, degree, mask=usable, should_stop=should_stop)
    return _with_flux_of(fit, values, usable)


def low_pass_source(
    image: ArrayLike,
    width: float,
    *,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """The image, blurred until the object is gone.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    width : float
        Standard deviation of the Gaussian blur in px; a few times the size of the object.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The blurred image in its own unit: at each pixel the mean of the usable pixels around
        it, weighted by the Gaussian. Its border is mirrored.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, or the width is not positive.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    Where no usable pixel is within reach, the width is doubled until there is one.

    Examples
    --------
    >>> import numpy as np
    >>> shot = 5 + np.random.default_rng(0).normal(size=(60, 60))
    >>> float(low_pass_source(shot, 10.0).std()) < 0.05
    True
    """
    values, usable = _beam_pixels(image, mask)
    width = checked_number("width", width, above=0, unit="px")
    report = Reporter(None, should_stop)
    beam, support = _masked_blur(values, usable, width, report)
    while not support.all():
        width *= 2
        wider, reached = _masked_blur(values, usable, width, report)
        beam, support = np.where(support, beam, wider), support | reached
    return _with_flux_of(beam, values, usable)


def total_variation_source(
    image: ArrayLike,
    *,
    weight: float = 2.0,
    iterations: int = 1000,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """The image without small structures, but with its edges.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    weight : float, default 2
        Strength of the smoothing, in px: a disc of radius r px is lowered by 2·weight/r of the
        image's mean. So it takes c·r/2 to remove a disc of contrast c.
    iterations : int, default 1000
        Maximum iterations; an object of radius r px needs about r².
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere. The others are first filled as by
        `interpolated_source`.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The smoothed image, in its own unit.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, or the weight or the number
        of iterations is not positive.
    InversionCancelled
        If `should_stop` returned true.

    References
    ----------
    A. Chambolle, "An algorithm for total variation minimization and applications", Journal
    of Mathematical Imaging and Vision 20, 89 (2004).

    Examples
    --------
    >>> import numpy as np
    >>> shot = np.where(np.arange(60) < 30, 2.0, 4.0) + np.zeros((60, 1))
    >>> shot[10:14, 10:14] = 3.0
    >>> beam = total_variation_source(shot, weight=0.5)
    >>> bool(abs(beam[10:14, 10:14] - 2).max() < 0.1), bool(beam[40, 30] - beam[40, 29] > 1.8)
    (True, True)
    """
    values, usable = _beam_pixels(image, mask)
    weight = checked_number("weight", weight, above=0, unit="px")
    iterations = checked_integer("iterations", iterations, least=1)
    report = Reporter(None, should_stop)
    filled = values if usable.all() else _filled(values, usable, _FILL_WIDTH, 2, report)
    mean = values[usable].mean()
    beam = mean * least_variation(filled / mean, weight, iterations, report)
    return _with_flux_of(beam, values, usable)


def interpolated_source(
    image: ArrayLike,
    mask: ArrayLike,
    *,
    width: float = _FILL_WIDTH,
    kind: Literal["biharmonic", "laplace"] = "biharmonic",
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """The image itself, with the part that the object covers filled in from around it.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot; counts or any linear measure of fluence.
    mask : array_like of bool, shape (H, W)
        True where the image shows the bare beam, False where the object is.
    width : float, default 5
        Standard deviation in px of the blur applied to the surroundings before they are
        extrapolated, so that noise does not spread into the gap. Wider gaps need more blur.
    kind : {"biharmonic", "laplace"}, default "biharmonic"
        "biharmonic" continues slope and curvature of the beam: for gaps inside the image.
        "laplace" never leaves the range of the surroundings: for gaps at the image's edge.
    should_stop : callable, optional
        Asked at each step; when it returns true the estimate ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The beam in the unit of `image`; where the mask is true, the image itself.

    Raises
    ------
    InputError
        If image and mask cannot be used, the image has no flux, the width is not positive, or
        the kind unknown.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    The filling u minimises ∑(u - image)² over the usable pixels + width²ᵖ ∑ u(-Δ)ᵖu over
    all, with p = 2 (a thin plate) or p = 1 (a membrane) and mirrored borders, by conjugate
    gradients preconditioned with the discrete cosine transform, from coarse to fine.

    References
    ----------
    D. Garcia, "Robust smoothing of gridded data in one and higher dimensions with missing
    values", Computational Statistics & Data Analysis 54, 1167 (2010).

    Examples
    --------
    >>> import numpy as np
    >>> y, x = np.mgrid[:48, :64]
    >>> beam = 100 * np.exp(-((y - 20) ** 2 + (x - 30) ** 2) / 2000)
    >>> mask = np.hypot(y - 24, x - 34) > 8
    >>> shot = np.where(mask, beam, 0)
    >>> float(abs(interpolated_source(shot, mask, width=2.0) / beam - 1).max()) < 0.01
    True
    """
    if kind not in ("biharmonic", "laplace"):
        raise InputError(f"kind is {kind!r}, expected 'biharmonic' or 'laplace'")
    values, usable = _beam_pixels(image, mask)
    width = checked_number("width", width, above=0, unit="px")
    power = 2 if kind == "biharmonic" else 1
    report = Reporter(None, should_stop)
    beam = np.where(usable, values, _filled(values, usable, width, power, report))
    return _with_flux_of(beam, values, usable)


def _beam_pixels(image: ArrayLike, mask: ArrayLike | None) -> tuple[FloatArray, BoolArray]:
    """Values and usable pixels of an image that has flux."""
    values, usable = checked_pixels(image, mask)
    flux = values[usable].sum()
    if flux <= 0:
        raise InputError(
            f"image has a flux of {flux:.4g} over its usable pixels, expected a positive one: "
            "check the file and its background"
        )
    return values, usable


def _edges(side: int, name: str, centre: float | None) -> FloatArray:
    """Edges of so many pixels, relative to the centre of one, or to the middle of all."""
    if centre is not None and not math.isfinite(centre):
        raise InputError(f"{name} is {centre!r}, expected a finite number of px")
    return np.arange(-0.5, side) - ((side - 1) / 2 if centre is None else centre)


def _with_flux_of(beam: FloatArray, values: FloatArray, usable: BoolArray) -> FloatArray:
    """A beam made positive and given the flux of an image over its usable pixels."""
    mean = values[usable].mean()
    positive = np.maximum(beam, _FLOOR * mean)
    source = np.asarray(positive * (mean / positive[usable].mean()))
    seen = float(values[usable].max())
    if not source.max() <= _MOST_EXTRAPOLATION * seen:
        raise InputError(
            f"the estimated source rises to {source.max():.3g} under the mask, while the image "
            f"is at most {seen:.3g} elsewhere: mask less, or choose another estimate"
        )
    return source


def _python_warning(text: str) -> None:
    warnings.warn(text, stacklevel=3)


def _samples(values: FloatArray, usable: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Positions y, x and means of blocks of usable pixels, few enough for a fit."""
    block = int(np.ceil(np.sqrt(values.size / _MOST_FITTED_PIXELS)))
    share = _block_means(usable.astype(np.float64), block)
    means = _block_means(np.where(usable, values, 0.0), block)
    # A block is taken only if it is whole: the middle of a part of it lies elsewhere.
    # A mask so fine that no block is whole leaves the fullest.
    y, x = np.nonzero(share >= share.max())
    middle = (block - 1) / 2
    rows, columns = (np.asarray(axis * block + middle, dtype=np.float64) for axis in (y, x))
    return rows, columns, np.asarray(means[y, x] / share[y, x])


def _block_means(values: FloatArray, block: int) -> FloatArray:
    """Means over square blocks; incomplete ones at the far edges are padded by mirroring."""
    padding = [(0, -side % block) for side in values.shape]
    padded = np.pad(values, padding, mode="symmetric")
    height, width = padded.shape
    blocks = padded.reshape(height // block, block, width // block, block)
    return np.asarray(blocks.mean(axis=(1, 3)))


def _fitted_gaussian(
    y: FloatArray, x: FloatArray, sample: FloatArray, report: Reporter
) -> FloatArray:
    """Parameters of `_gaussian` that fit samples, by repeated robust least squares."""
    bounds = _bounds(y, x)
    parameters = np.clip(_first_gaussian(y, x, sample), *bounds)
    # A plain fit first: the robust loss, from far away, would call the whole beam an outlier.
    parameters = _refitted(parameters, y, x, sample, report, bounds, loss="linear", scale=1.0)
    scale = 0.0
    for _ in range(_MOST_FITS):
        residual = _gaussian(parameters, y, x) - sample
        previous, scale = scale, max(_NORMAL_MAD * float(np.median(np.abs(residual))), 1e-6)
        if abs(scale - previous) < 1e-2 * scale:
            break
        parameters = _refitted(
            parameters, y, x, sample, report, bounds, loss="soft_l1", scale=scale
        )
    return parameters


def _bounds(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and greatest parameters of `_gaussian`: without them it may hide behind a mask."""
    steepest = math.sqrt(_MOST_FITTED_PIXELS)  # one over the width of a block of pixels
    ranges = [
        (0, _HIGHEST),
        (0, _HIGHEST),
        *((axis.mean() - _FARTHEST, axis.mean() + _FARTHEST) for axis in (y, x)),
        *[(-steepest, steepest)] * 3,
    ]
    least, most = np.transpose(ranges)
    return least, most


def _refitted(
    parameters: FloatArray,
    y: FloatArray,
    x: FloatArray,
    sample: FloatArray,
    report: Reporter,
    bounds: tuple[FloatArray, FloatArray],
    *,
    loss: Literal["linear", "soft_l1"],
    scale: float,
) -> FloatArray:
    """Parameters of `_gaussian` nearest to samples, in the sense of a loss of some scale."""

    def excess(p: FloatArray) -> FloatArray:
        report("source", 0)
        return _gaussian(p, y, x) - sample

    fit = least_squares(
        excess,
        parameters,
        jac=lambda p: _gaussian_slopes(p, y, x),
        bounds=bounds,
        loss=loss,
        f_scale=scale,
        x_scale="jac",
        max_nfev=200,
    )
    return np.asarray(fit.x)


def _first_gaussian(y: FloatArray, x: FloatArray, sample: FloatArray) -> FloatArray:
    """Parameters of `_gaussian` from the moments of what rises above the dark corners."""
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
    """Height · exp(-½(u² + v²)) + constant, with u = a·dy + b·dx and v = c·dx.

    The factors of the inverse covariance, unlike its entries, may take any value.
    """
    height, constant, centre_y, centre_x, a, b, c = parameters
    u = a * (y - centre_y) + b * (x - centre_x)
    v = c * (x - centre_x)
    return np.asarray(height * np.exp(-0.5 * (u**2 + v**2)) + constant)


def _gaussian_slopes(parameters: FloatArray, y: FloatArray, x: FloatArray) -> FloatArray:
    """Derivatives of `_gaussian` with respect to its parameters, shape (samples, 7)."""
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


def _masked_blur(
    values: FloatArray, usable: BoolArray, width: float, report: Reporter
) -> tuple[FloatArray, BoolArray]:
    """Blur of the usable pixels, and where there was enough of them to tell."""
    report("source", 0, 2)
    support = _blurred(usable.astype(np.float64), width)
    report("source", 1, 2)
    blurred = _blurred(np.where(usable, values, 0.0), width)
    return blurred / np.maximum(support, _LEAST_SUPPORT), support >= _LEAST_SUPPORT


def _blurred(values: FloatArray, width: float) -> FloatArray:
    """Gaussian blur with a mirrored border."""
    if width < _NARROWEST_WAVES:
        return np.asarray(gaussian_filter(values, width, mode="reflect"))
    # Takes no longer for a wide Gaussian than for a narrow one.
    return low_pass(values, width)


def _filled(
    values: FloatArray, usable: BoolArray, width: float, power: int, report: Reporter
) -> FloatArray:
    """Smoothing spline through the usable pixels, continued over the others."""
    mean = values[usable].mean()
    known = np.where(usable, values / mean, 0.0)
    share = usable.astype(np.float64)
    return np.asarray(_spline(known, share, width, power, report) * mean)


def _spline(
    known: FloatArray, share: FloatArray, width: float, power: int, report: Reporter
) -> FloatArray:
    """Minimise ∑ share·(u - value)² + width^2p ∑ u(-Δ)ᵖu, `known` being share·value."""
    squares = [4 * np.sin(0.5 * np.pi * np.arange(side) / side) ** 2 for side in known.shape]
    roughness = (width**2 * np.add.outer(*squares)) ** power

    def stiffness(flat: FloatArray) -> FloatArray:
        report("source", 0)
        u = flat.reshape(known.shape)
        bent = idctn(roughness * dctn(u, norm="ortho"), norm="ortho")
        return np.asarray(share * u + bent).ravel()

    typical = float(share.mean())

    def nearly_inverse(flat: FloatArray) -> FloatArray:
        coefficients = dctn(flat.reshape(known.shape), norm="ortho") / (typical + roughness)
        return np.asarray(idctn(coefficients, norm="ortho")).ravel()

    shape = (known.size, known.size)
    solution, _ = cg(
        LinearOperator(shape, matvec=stiffness, dtype=np.float64),
        known.ravel(),
        x0=_coarse_spline(known, share, width, power, report).ravel(),
        M=LinearOperator(shape, matvec=nearly_inverse, dtype=np.float64),
        rtol=_FILL_TOLERANCE,
        maxiter=500,
    )
    return np.asarray(solution.reshape(known.shape))


def _coarse_spline(
    known: FloatArray, share: FloatArray, width: float, power: int, report: Reporter
) -> FloatArray:
    """First guess of `_spline`, from pixels twice as large."""
    if min(known.shape) < _COARSEST_SIDE:
        return np.full(known.shape, known.sum() / share.sum())
    coarse = _spline(_block_means(known, 2), _block_means(share, 2), width / 2, power, report)
    height, length = known.shape
    return _doubled(_doubled(coarse, height).T, length).T


def _doubled(coarse: FloatArray, side: int) -> FloatArray:
    """Rows twice as many, cut to `side`, linear between the middles of the coarse ones."""
    padded = np.pad(coarse, [(1, 1), (0, 0)], mode="edge")
    near, before, after = padded[1:-1], padded[:-2], padded[2:]
    rows = np.stack([0.75 * near + 0.25 * before, 0.75 * near + 0.25 * after], axis=1)
    return np.asarray(rows.reshape(-1, coarse.shape[1])[:side])
