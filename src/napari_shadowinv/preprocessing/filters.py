"""Filters for images before an inversion, and for potentials after it.

- keep only small or only large structures: `high_pass`, `low_pass`, `butterworth`
- flatten an uneven beam: `remove_background`
- replace broken pixels: `remove_hot_pixels`
- what the filters and the source estimates have in common: `fit_polynomial`,
  `checked_pixels`, `checked_number`, `checked_integer`

An inversion amplifies low frequencies: a source that is wrong by little on a large scale
makes a large false potential. Filtering the image, the potential, or both is the simple
remedy of Kasim et al., arXiv:1607.04179, section V.

The linear filters multiply the image's discrete cosine transform (type II) by a gain that
depends on the wave number k alone. That mirrors the image at its border, so nothing wraps
around, and each cosine that fits the image is attenuated by exactly its gain.
"""

from __future__ import annotations

import operator
from typing import Literal

import numpy as np
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike, NDArray
from scipy.fft import dctn, idctn
from scipy.ndimage import rank_filter
from scipy.optimize import nnls
from scipy.special import expit

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv.errors import InputError

__all__ = [
    "butterworth",
    "checked_integer",
    "checked_number",
    "checked_pixels",
    "fit_polynomial",
    "high_pass",
    "low_pass",
    "remove_background",
    "remove_hot_pixels",
]

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_HIGHEST_DEGREE = 10
_MOST_REWEIGHTINGS = 50
_NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation, normal noise
_NORMAL_MEAN = 1.2533  # standard deviation over mean absolute deviation, normal noise
_PIXELS_PER_NOISE_BIN = 400
_MOST_NOISE_BINS = 16
_OUTSTANDING = 0.5  # share of the threshold by which a pixel differs from its nearest peers


def low_pass(image: ArrayLike, width: float) -> FloatArray:
    """Blur by a Gaussian; the mean stays.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    width : float
        Standard deviation σ of the Gaussian in px. A wave of wave number k (rad/px) keeps
        exp(-k²σ²/2) of its amplitude: half of it at a wavelength of 5.3 σ.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The blurred image. Never below the least nor above the largest value of `image`,
        apart from rounding and, for σ below 1 px, ringing.

    Raises
    ------
    InputError
        If the image is not two-dimensional and finite, or the width not positive.

    Examples
    --------
    >>> import numpy as np
    >>> wave = np.cos(np.pi * 8 * (np.arange(64) + 0.5) / 64) * np.ones((16, 1))
    >>> float((low_pass(wave, 2.0) / wave).mean()), float(np.exp(-((np.pi / 8 * 2) ** 2) / 2))
    (0.7346, 0.7346)
    """
    values, _ = checked_pixels(image)
    width = checked_number("width", width, above=0, unit="px")
    return _filtered(values, np.exp(-0.5 * (width * _wave_numbers(values.shape)) ** 2))


def high_pass(image: ArrayLike, width: float, *, keep_mean: bool = True) -> FloatArray:
    """Remove the structures that a Gaussian blur would keep.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    width : float
        Standard deviation σ of the Gaussian in px: structures much larger than σ vanish. A
        wave of wave number k keeps 1 - exp(-k²σ²/2) of its amplitude.
    keep_mean : bool, default True
        Put the mean of `image` back, so that the total flux stays. Without it,
        ``high_pass(image, width, keep_mean=False) + low_pass(image, width)`` is the image.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The filtered image.

    Raises
    ------
    InputError
        If the image is not two-dimensional and finite, or the width not positive.

    Notes
    -----
    With the mean kept, a positive image stays positive wherever its blur exceeds it by less
    than its mean. Elsewhere, as in a dark spot near the centre of a strongly peaked beam, the
    result is negative. It is left negative, not clipped: that would add flux without a
    word. `invert` refuses such pixels or clips and counts them, as its option `negative`
    says. For a beam that uneven, dividing (`remove_background`, or a source estimate)
    serves better than subtracting: it keeps the sign.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.linspace(1, 3, 50) * np.ones((50, 1))
    >>> filtered = high_pass(ramp, 5.0)
    >>> float(filtered.mean()), float(np.ptp(filtered)) < 0.5 * float(np.ptp(ramp))
    (2.0, True)
    """
    values, _ = checked_pixels(image)
    kept = values.mean() if keep_mean else 0.0
    return values - low_pass(values, width) + kept


def butterworth(
    image: ArrayLike,
    cutoff: float,
    order: int = 2,
    *,
    kind: Literal["high", "low"] = "high",
    keep_mean: bool = True,
) -> FloatArray:
    """Butterworth filter: flat up to the cutoff, then as steep as the order says.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    cutoff : float
        Wavelength in px at which the amplitude falls by 1/√2.
    order : int, default 2
        Order n; the amplitude falls as the n-th power of the wavelength. High orders ring.
    kind : {"high", "low"}, default "high"
        Which wave numbers k pass, k_c being 2π / cutoff: "high" with a gain of
        (1 + (k_c/k)^2n)^-½, "low" with (1 + (k/k_c)^2n)^-½.
    keep_mean : bool, default True
        Put the mean of `image` back after a high pass; a low pass always keeps it.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The filtered image; it can be negative, see `high_pass`.

    Raises
    ------
    InputError
        If the image is not two-dimensional and finite, the cutoff not positive, the order no
        integer of at least 1, or the kind unknown.

    References
    ----------
    S. Butterworth, "On the theory of filter amplifiers", Experimental Wireless and the
    Wireless Engineer 7, 536 (1930).

    Examples
    --------
    >>> import numpy as np
    >>> wave = np.cos(np.pi * 8 * (np.arange(64) + 0.5) / 64) * np.ones((16, 1))
    >>> float((butterworth(wave, 16.0, 3) / wave).mean())
    0.7071
    """
    values, _ = checked_pixels(image)
    cutoff = checked_number("cutoff", cutoff, above=0, unit="px")
    order = checked_integer("order", order, least=1)
    if kind not in ("high", "low"):
        raise InputError(f"kind is {kind!r}, expected 'high' or 'low'")
    wave_numbers = _wave_numbers(values.shape)
    octaves = np.full(wave_numbers.shape, -np.inf)
    np.log(wave_numbers * (cutoff / (2 * np.pi)), out=octaves, where=wave_numbers > 0)
    # The logistic function gives 1 / (1 + x^2n) for any order without overflow.
    gain = np.sqrt(expit(2 * order * (octaves if kind == "high" else -octaves)))
    if kind == "high" and keep_mean:
        gain[0, 0] = 1.0
    return _filtered(values, gain)


def remove_background(
    image: ArrayLike,
    degree: int = 2,
    *,
    kind: Literal["divide", "subtract"] = "divide",
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Flatten an image by a polynomial fitted to it; the mean stays.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    degree : int, default 2
        Total degree of the polynomial in y and x, from 0 to 10.
    kind : {"divide", "subtract"}, default "divide"
        "divide" for images: an uneven beam multiplies the object's modulation. "subtract"
        for potentials, whose zero is arbitrary.
    mask : array_like of bool, shape (H, W), optional
        True where the fit may look; leave the object out if it is large. The pixels left out
        are flattened as well. Their values must be finite.
    should_stop : callable, optional
        Asked at each step; when it returns true the fit ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The flattened image, of the same mean. Divided, each pixel keeps its sign.

    Raises
    ------
    InputError
        If the image is not two-dimensional and finite, the mask of another shape or without
        enough pixels, the degree or kind unknown, or the polynomial to divide by is not
        positive all over the image.
    InversionCancelled
        If `should_stop` returned true.

    See Also
    --------
    polynomial_source : the same fit, as the source of an inversion.

    Examples
    --------
    >>> import numpy as np
    >>> ramp = np.linspace(1, 3, 50) * np.ones((50, 1))
    >>> float(abs(remove_background(ramp, 1) - 2.0).max()) < 1e-12
    True
    """
    if kind not in ("divide", "subtract"):
        raise InputError(f"kind is {kind!r}, expected 'divide' or 'subtract'")
    values, _ = checked_pixels(image)
    background = fit_polynomial(values, degree, mask=mask, should_stop=should_stop)
    if kind == "subtract":
        return np.asarray(values - background + background.mean())
    if background.min() <= 0 or values.mean() <= 0:
        raise InputError(
            f"background of degree {degree} falls to {background.min():.4g} for an image of mean "
            f"{values.mean():.4g}, expected both to be positive for division: use a lower "
            "degree, or kind='subtract'"
        )
    flat = values / background
    return np.asarray(flat * (values.mean() / flat.mean()))


def remove_hot_pixels(
    image: ArrayLike,
    *,
    threshold: float = 6.0,
    size: int = 3,
    should_stop: ShouldStop | None = None,
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Replace outlying pixels by the median of their neighbourhood.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    threshold : float, default 6
        How many standard deviations of the noise a pixel may differ from the median of its
        neighbours.
    size : int, default 3
        Side of the neighbourhood in px, odd. Clusters of up to an eighth of its area plus one
        are found: pairs with 3, four pixels with 5.
    should_stop : callable, optional
        Asked at each step; when it returns true the search ends.

    Returns
    -------
    image : ndarray of float64, shape (H, W)
        The image with those pixels replaced, all others untouched.
    hot, dead : ndarray of bool, shape (H, W)
        Which pixels were too bright, which too dark.

    Raises
    ------
    InputError
        If the image is not two-dimensional and finite, the threshold not positive, or the
        size not an odd number of at least 3.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    The noise is read off the image: the differences to the local median are sorted by
    brightness into groups of equal number, each group's variance is estimated by the median
    absolute deviation, and a + b·brightness with a, b ≥ 0 (read-out and Poisson-like noise)
    is fitted to them. The estimate includes the noise of the median itself, some 10 %; in
    a slope of several deviations per pixel, the slope as well.

    Caustics and foci also stand out, but span several pixels. A broken pixel must therefore
    also differ, by half the threshold, from all of its neighbours except as many as could
    be broken with it. The peak of a focus or line of less than some 4 px is still replaced,
    if its brightness is many deviations: compare `hot` with the image, raise the threshold.

    A dead pixel among N counts stands out by √N standard deviations: below threshold² counts
    it cannot be distinguished from noise.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.random.default_rng(0).normal(100, 2, (40, 40))
    >>> image[3, 5], image[20, 0] = 200, 0
    >>> clean, hot, dead = remove_hot_pixels(image)
    >>> np.argwhere(hot).tolist(), np.argwhere(dead).tolist()
    ([[3, 5]], [[20, 0]])
    """
    values, _ = checked_pixels(image)
    threshold = checked_number("threshold", threshold, above=0, unit="deviations")
    size = checked_integer("size", size, least=3)
    if size % 2 == 0:
        raise InputError(
            f"size is {size}, expected an odd number, so that the window is centred on a pixel"
        )
    local, bright, dark = _neighbours(values, size, Reporter(None, should_stop))
    difference = values - local
    limit = threshold * _noise(difference, local)
    hot = (difference > limit) & (values - bright > _OUTSTANDING * limit)
    dead = (difference < -limit) & (dark - values > _OUTSTANDING * limit)
    return np.where(hot | dead, local, values), hot, dead


def _neighbours(
    values: FloatArray, size: int, report: Reporter
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Median of the pixels around each, and the brightest and darkest that may be sound.

    The pixel itself does not count: with it, the noise would seem smaller than it is.
    """
    footprint = np.ones((size, size), dtype=np.bool_)
    footprint[size // 2, size // 2] = False
    n = size * size - 1
    broken = n // 8

    def ranked(rank: int, mode: Literal["mirror", "reflect"]) -> FloatArray:
        report("hot pixels", 0)
        return np.asarray(rank_filter(values, rank, footprint=footprint, mode=mode))

    # 'reflect' lets no neighbour of a corner pixel fill half of its neighbourhood; 'mirror'
    # does not make a pixel at the border its own peer.
    median = (ranked(n // 2 - 1, "reflect") + ranked(n // 2, "reflect")) / 2
    return median, ranked(n - 1 - broken, "mirror"), ranked(broken, "mirror")


def _noise(difference: FloatArray, brightness: FloatArray) -> FloatArray:
    """Standard deviation of each pixel's difference, by its brightness."""
    n_bins = min(max(difference.size // _PIXELS_PER_NOISE_BIN, 1), _MOST_NOISE_BINS)
    groups = np.array_split(np.argsort(brightness, axis=None, kind="stable"), n_bins)
    flat, positive = difference.ravel(), np.maximum(brightness, 0).ravel()
    variance = np.array([_deviation(flat[group]) ** 2 for group in groups])
    if not variance.any():
        return np.zeros_like(difference)
    levels = np.array([positive[group].mean() for group in groups])
    # A variance is known to a share of itself: weighing by its inverse keeps the dark
    # pixels' noise from drowning in the bright ones'. Units drop out of both columns.
    share = 1 / np.maximum(variance, 1e-3 * variance.max())
    unit, scale = variance.mean(), levels.mean() or 1.0
    columns = np.stack([np.ones_like(levels), levels / scale], axis=1) * unit
    constant, slope = nnls(columns * share[:, None], variance * share)[0] * unit
    fitted: FloatArray = np.sqrt(constant + slope * np.maximum(brightness, 0) / scale)
    return fitted


def _deviation(difference: FloatArray) -> float:
    """Robust standard deviation about zero."""
    size = np.abs(difference)
    # In few-bit images more than half the pixels can equal their median.
    return float(_NORMAL_MAD * np.median(size)) or float(_NORMAL_MEAN * size.mean())


def fit_polynomial(
    image: ArrayLike,
    degree: int,
    *,
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Fit a polynomial in y and x to an image, robust against outliers.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    degree : int
        Total degree of the polynomial, from 0 to 10.
    mask : array_like of bool, shape (H, W), optional
        True where the fit may look. Default: everywhere.
    should_stop : callable, optional
        Asked at each step; when it returns true the fit ends.

    Returns
    -------
    ndarray of float64, shape (H, W)
        The polynomial at all pixels, also where the mask is false.

    Raises
    ------
    InputError
        If image and mask cannot be used, the degree is out of range, or there are fewer
        usable pixels than coefficients.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    Iteratively reweighted least squares of the soft L1 loss: residuals count squared within
    the noise (the median absolute deviation of the residuals), in proportion beyond.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.linspace(1, 3, 50) * np.ones((50, 1))
    >>> image[20:30, 20:30] *= 5
    >>> float(abs(fit_polynomial(image, 1)[0] - image[0]).max()) < 1e-3
    True
    """
    values, usable = checked_pixels(image, mask)
    degree = checked_integer("degree", degree, least=0, most=_HIGHEST_DEGREE)
    terms = (degree + 1) * (degree + 2) // 2
    if usable.sum() < terms:
        raise InputError(
            f"degree {degree} has {terms} coefficients, image has {int(usable.sum())} usable "
            "pixels: use a lower degree or mask fewer pixels"
        )
    rows, columns = (_basis(side, degree) for side in values.shape)
    fit = _weighted_fit(values, usable.astype(np.float64), rows, columns)
    rounding = 1e-12 * float(np.abs(values).max())
    report = Reporter(None, should_stop)
    for step in range(_MOST_REWEIGHTINGS):
        report("fit", step)
        residual = values - fit
        scale = _NORMAL_MAD * float(np.median(np.abs(residual[usable])))
        if scale <= rounding:
            break
        weights = usable / np.sqrt(1 + (residual / scale) ** 2)
        previous, fit = fit, _weighted_fit(values, weights, rows, columns)
        if np.abs(fit - previous).max() < 1e-6 * scale:
            break
    return fit


def _basis(side: int, degree: int) -> FloatArray:
    """Legendre polynomials along an axis, shape (side, degree + 1)."""
    return np.asarray(legvander(np.linspace(-1, 1, side), degree), dtype=np.float64)


def _weighted_fit(
    values: FloatArray, weights: FloatArray, rows: FloatArray, columns: FloatArray
) -> FloatArray:
    """Polynomial of least weighted squares, from bases along y and x.

    The normal equations need sums of the weights over products of the bases only; those
    separate into y and x, so no matrix of pixels × coefficients is formed.
    """
    n = rows.shape[1]
    pairs = [
        (basis[:, :, None] * basis[:, None, :]).reshape(-1, n * n) for basis in (rows, columns)
    ]
    gram = (pairs[0].T @ weights @ pairs[1]).reshape(n, n, n, n).transpose(0, 2, 1, 3)
    moments = (rows.T @ (weights * values) @ columns).ravel()
    kept = np.flatnonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
    coefficients = np.zeros(n * n)
    square = gram.reshape(n * n, n * n)[np.ix_(kept, kept)]
    coefficients[kept] = np.linalg.lstsq(square, moments[kept], rcond=None)[0]
    fit: FloatArray = rows @ coefficients.reshape(n, n) @ columns.T
    return fit


def _wave_numbers(shape: tuple[int, ...]) -> FloatArray:
    """Wave number k in rad/px of each coefficient of the discrete cosine transform."""
    k_y, k_x = (np.pi * np.arange(side) / side for side in shape)
    return np.asarray(np.hypot(k_y[:, None], k_x))


def _filtered(values: FloatArray, gain: FloatArray) -> FloatArray:
    return np.asarray(idctn(gain * dctn(values, norm="ortho"), norm="ortho"))


def checked_pixels(
    image: ArrayLike, mask: ArrayLike | None = None, *, name: str = "image"
) -> tuple[FloatArray, BoolArray]:
    """Return an image as floats and its usable pixels, or say what is wrong with them.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel is usable. Default: everywhere.
    name : str, optional
        What the error messages call the image.

    Returns
    -------
    values : ndarray of float64, shape (H, W)
        A copy; masked pixels, which may be NaN, are set to the mean of the usable ones.
    usable : ndarray of bool, shape (H, W)
        The mask.

    Raises
    ------
    InputError
        If the image is not two-dimensional, has no pixels, is not real, or a usable pixel is
        not finite; if the mask has another shape, is not boolean, or leaves no pixel.

    Examples
    --------
    >>> checked_pixels([[1.0, 3.0]], [[True, False]])[0]
    array([[1., 1.]])
    """
    array = np.asarray(image)
    if array.ndim != 2 or array.size == 0:
        raise InputError(
            f"{name} has shape {array.shape}, expected two dimensions (y, x): "
            "choose one channel or one shot"
        )
    if array.dtype.kind not in "buif":
        raise InputError(f"{name} has values of type {array.dtype}, expected real numbers")
    values = np.array(array, dtype=np.float64)
    usable = _checked_mask(mask, values.shape, name)
    bad = int((~np.isfinite(values[usable])).sum())
    if bad:
        raise InputError(
            f"{name} has {bad} usable pixels that are NaN or infinite, expected none: replace or "
            "mask them"
        )
    values[~usable] = values[usable].mean()
    return values, usable


def _checked_mask(mask: ArrayLike | None, shape: tuple[int, ...], name: str) -> BoolArray:
    if mask is None:
        return np.ones(shape, dtype=np.bool_)
    usable = np.asarray(mask)
    if usable.dtype != np.bool_:
        raise InputError(
            f"mask has values of type {usable.dtype}, expected booleans that are True where "
            "a pixel is usable: compare it with a number, as in mask > 0"
        )
    if usable.shape != shape:
        raise InputError(f"mask has shape {usable.shape}, {name} {shape}: they must match")
    if not usable.any():
        raise InputError("mask leaves no usable pixel, expected True where a pixel is usable")
    return usable


def checked_number(name: str, value: float, *, above: float, unit: str) -> float:
    """Return a finite number above a limit, or say what was received instead.

    Raises
    ------
    InputError
        If the value is no finite number above the limit.
    """
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not (np.isfinite(number) and number > above):
        raise InputError(f"{name} is {value!r}, expected a number of {unit} above {above:g}")
    return number


def checked_integer(name: str, value: int, *, least: int, most: int | None = None) -> int:
    """Return an integer within limits, or say what was received instead.

    Raises
    ------
    InputError
        If the value is no integer or out of range.
    """
    try:
        number = operator.index(value)
    except TypeError:
        number = least - 1
    if number < least or (most is not None and number > most):
        wanted = f"at least {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{name} is {value!r}, expected an integer {wanted}")
    return number
