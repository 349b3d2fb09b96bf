"""Filters for images before an inversion, and for potentials after it.

- keep only small or only large structures: `high_pass`, `low_pass`, `butterworth`
- flatten an uneven beam: `remove_background`
- replace broken pixels: `remove_hot_pixels`
- each with its parameters, to be one step of a recipe: `LowPassFilter`, `HighPassFilter`,
  `ButterworthFilter`, `BackgroundFilter`, `HotPixelFilter`; their base class: `Filter`

All take an image or a potential ``[y, x]``, in any unit, and return float64 of the same shape
and unit. An `InputError` refuses an image that is not two-dimensional and finite, and a parameter
out of range.

An inversion amplifies low frequencies: a source that is wrong by little on a large scale
makes a large false potential. Filtering the image, the potential, or both is the simple
remedy of Kasim et al., arXiv:1607.04179, section V.

The linear filters multiply the image's discrete cosine transform (type II), or the Fourier
transform of its mirrored double, by a gain that depends on the wave number k alone. That mirrors
the image at its border, so nothing wraps around, and each cosine that fits the image is attenuated
by exactly its gain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._system.arrays import NORMAL_MAD
from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.steps import Step, degree_field, width_field
from napari_shadowinv.shot import Shot


class Filter(Step):
    """A step that changes the values of the image, and of a measured source alike."""

    moves_pixels = False
    function: ClassVar[Callable[..., FloatArray]]
    """Filters an image by the parameters; may take ``mask`` and ``should_stop``."""

    def filter_image(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
    ) -> FloatArray:
        """Apply the filter, so that masked pixels, even NaN, do not affect the others."""
        values = np.asarray(image, dtype=np.float64)
        if mask is not None and mask.any() and not mask.all():
            filled = pixels.interpolated_source(values, mask, should_stop=should_stop)
            values = np.where(mask, values, filled)
        return self._filter(values, mask, should_stop)

    def _filter(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None
    ) -> FloatArray:
        return self.call(self.function, image, mask=mask, should_stop=should_stop)

    def note(self, before: FloatArray, after: FloatArray, mask: BoolArray | None) -> str:
        """Return a note on the changes by the filter."""
        return self.summary

    def apply(self, shot: Shot, should_stop: ShouldStop | None = None) -> Shot:
        image = self.filter_image(shot.image, shot.mask, should_stop)
        source = shot.source
        if source is not None:
            source = self.filter_image(source, shot.mask, should_stop)
        note = self.note(shot.image, image, shot.mask)
        return replace(shot, image=image, source=source).add_notes(note)


def low_pass(image: ArrayLike, width: float) -> FloatArray:
    """Blur by a Gaussian; the mean stays.

    Parameters
    ----------
    image : array_like, shape (H, W)
    width : float
        Standard deviation σ of the Gaussian in px. A wave of wave number k (rad/px) keeps
        exp(-k²σ²/2) of its amplitude: half of it at a wavelength of 5.3 σ.

    Returns
    -------
    ndarray of float64, shape (H, W)
        Never below the least nor above the largest value of `image`, apart from rounding and,
        for σ below 1 px, ringing.

    Examples
    --------
    >>> import numpy as np
    >>> wave = np.cos(np.pi * 8 * (np.arange(64) + 0.5) / 64) * np.ones((16, 1))
    >>> float((low_pass(wave, 2.0) / wave).mean()), float(np.exp(-((np.pi / 8 * 2) ** 2) / 2))
    (0.7346, 0.7346)
    """
    values, _ = pixels.checked_pixels(image)
    width = pixels.checked_number("width", width, above=0, unit="px")
    return _apply_gain(values, np.exp(-0.5 * (width * _wave_numbers(values.shape)) ** 2))


class LowPassFilter(Filter):
    """Take away small structures."""

    title = "low-pass (smooth)"
    function = staticmethod(low_pass)
    primary = "width"
    place = 80
    smooths: ClassVar[bool] = True
    step: Literal["low-pass"] = "low-pass"
    width: float = width_field(1.0, "Standard deviation of the Gaussian blur in px.", 0.1, 20.0)


def high_pass(image: ArrayLike, width: float, *, keep_mean: bool = True) -> FloatArray:
    """Remove the structures that a Gaussian blur would keep.

    Parameters
    ----------
    image : array_like, shape (H, W)
    width : float
        Standard deviation σ of the Gaussian in px: structures much larger than σ vanish. A
        wave of wave number k keeps 1 - exp(-k²σ²/2) of its amplitude.
    keep_mean : bool, default True
        Put the mean of `image` back, so that the total flux stays. Without it,
        ``high_pass(image, width, keep_mean=False) + low_pass(image, width)`` is the image.

    Notes
    -----
    Where its blur exceeds an image by more than its mean, as in a dark spot near the centre of a
    strongly peaked beam, the result is negative. It is not clipped: that would add flux without a
    word. `invert` treats such pixels as its option `negative` says. For a beam that uneven,
    dividing (`remove_background`, or a source estimate) serves better: it keeps the sign.
    """
    values, _ = pixels.checked_pixels(image)
    mean = values.mean() if keep_mean else 0.0
    return values - low_pass(values, width) + mean


class HighPassFilter(Filter):
    """Take away large structures."""

    title = "high-pass"
    function = staticmethod(high_pass)
    primary = "width"
    place = 60
    flattens: ClassVar[bool] = True
    step: Literal["high-pass"] = "high-pass"
    width: float = width_field(
        50.0, "Structures much larger than this standard deviation, in px, are removed.", 1.0, 200.0
    )


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
    cutoff : float
        Wavelength in px, above 2, at which the amplitude falls by 1/√2.
    order : int, default 2
        Order n, up to 20; the amplitude falls as the n-th power of the wavelength. High orders
        ring.
    kind : {"high", "low"}, default "high"
        Which wave numbers k pass, k_c being 2π / cutoff: "high" with a gain of
        (1 + (k_c/k)^2n)^-½, "low" with (1 + (k/k_c)^2n)^-½.
    keep_mean : bool, default True
        Put the mean of `image` back after a high pass; a low pass always keeps it.

    Returns
    -------
    ndarray of float64, shape (H, W)
        It can be negative, see `high_pass`.

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
    from skimage.filters import butterworth as passed_by_butterworth

    values, _ = pixels.checked_pixels(image)
    cutoff = pixels.checked_number("cutoff", cutoff, above=2, unit="px")
    order = pixels.checked_integer("order", order, least=1, most=20)
    pixels.check_kind(kind, "high", "low")
    # Doubled by its mirror image, as by a discrete cosine transform: nothing wraps around.
    mirrored = np.pad(values, [(0, side) for side in values.shape], mode="symmetric")
    frequency = 1 / min(cutoff, 1e6)  # of waves too long for any image
    filtered: FloatArray = passed_by_butterworth(  # type: ignore[no-untyped-call]
        mirrored, frequency, kind == "high", order, squared_butterworth=False
    )
    mean = values.mean() if kind == "high" and keep_mean else 0.0
    return filtered[: values.shape[0], : values.shape[1]] + mean


class ButterworthFilter(Filter):
    """Take away large or small structures, with a chosen steepness."""

    title = "Butterworth"
    function = staticmethod(butterworth)
    primary = "cutoff"
    place = 70
    step: Literal["butterworth"] = "butterworth"
    cutoff: float = Field(
        default=100.0,
        gt=2,
        title="Cutoff (px)",
        description="Wavelength in px at which the amplitude drops to 1/√2.",
        json_schema_extra={"slider": [3.0, 500.0]},
    )
    order: int = Field(
        default=2,
        ge=1,
        le=20,
        description="Beyond the cutoff the amplitude falls as this power of the wavelength; high "
        "orders ring.",
        json_schema_extra={"slider": [1, 20]},
    )
    kind: Literal["high", "low"] = Field(
        default="high",
        title="Keeps",
        description="'high' removes structures larger than the cutoff, 'low' removes smaller ones.",
    )

    @property
    def flattens(self) -> bool:
        return self.kind == "high"

    @property
    def smooths(self) -> bool:
        return self.kind == "low"


def remove_background(
    image: ArrayLike,
    degree: int = 2,
    *,
    kind: Literal["divide", "subtract"] = "divide",
    mask: ArrayLike | None = None,
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """Flatten an image by a polynomial fitted to it as by `fit_polynomial`; the mean stays.

    Parameters
    ----------
    image : array_like, shape (H, W)
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
        Also if the mask leaves too few pixels, or the polynomial to divide by is not positive
        all over the image.
    InversionCancelled
        If `should_stop` returned true.
    """
    pixels.check_kind(kind, "divide", "subtract")
    values, _ = pixels.checked_pixels(image)
    background = pixels.fit_polynomial(values, degree, mask=mask, should_stop=should_stop)
    if kind == "subtract":
        return np.asarray(values - background + background.mean())
    if background.min() <= 0 or values.mean() <= 0:
        raise InputError(
            f"background of degree {degree} falls to {background.min():.4g} for an image of mean "
            f"{values.mean():.4g}, expected both to be positive for division: use a lower "
            "degree, or the kind 'subtract'"
        )
    flat = values / background
    return np.asarray(flat * (values.mean() / flat.mean()))


class BackgroundFilter(Filter):
    """Flatten by a polynomial."""

    title = "flatten (polynomial)"
    function = staticmethod(remove_background)
    place = 50
    flattens: ClassVar[bool] = True
    step: Literal["background"] = "background"
    degree: int = degree_field(" that is divided out or subtracted.")
    kind: Literal["divide", "subtract"] = Field(
        default="divide",
        title="How",
        description="'divide' by the polynomial (uneven beam) or 'subtract' it (stray light).",
    )


def _wave_numbers(shape: tuple[int, ...]) -> FloatArray:
    """Wave number k in rad/px of each coefficient of the discrete cosine transform."""
    k_y, k_x = (np.pi * np.arange(side) / side for side in shape)
    return np.asarray(np.hypot(k_y[:, None], k_x))


def _apply_gain(values: FloatArray, gain: FloatArray) -> FloatArray:
    return np.asarray(scipy.fft.idctn(gain * scipy.fft.dctn(values, norm="ortho"), norm="ortho"))


class HotPixelFilter(Filter):
    """Replace broken pixels."""

    title = "remove hot pixels"
    primary = "threshold"
    place = 30
    step: Literal["hot-pixels"] = "hot-pixels"
    threshold: float = Field(
        default=6.0,
        gt=0,
        description="Replace pixels that differ from the median of their neighbours by more than "
        "this many standard deviations of the noise.",
        json_schema_extra={"slider": [2.0, 20.0]},
    )

    def _filter(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None
    ) -> FloatArray:
        return remove_hot_pixels(image, threshold=self.threshold, should_stop=should_stop)[0]

    def note(self, before: FloatArray, after: FloatArray, mask: BoolArray | None) -> str:
        usable = True if mask is None else mask
        hot, dead = (int((changed & usable).sum()) for changed in (after < before, after > before))
        return (
            f"{hot} hot and {dead} dead pixels replaced (beyond {self.threshold:g} standard "
            "deviations)"
        )


def remove_hot_pixels(
    image: ArrayLike,
    *,
    threshold: float = 6.0,
    size: int = 3,
    peers: float = 0.5,
    should_stop: ShouldStop | None = None,
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Replace outlying pixels by the median of their neighbourhood.

    Parameters
    ----------
    image : array_like, shape (H, W)
        An image or a potential, any unit.
    threshold : float, default 6
        Standard deviations of the noise from the median of the neighbours.
    size : int, default 3
        Side of the neighbourhood in px, odd. Clusters of up to an eighth of its area plus one
        are found: pairs with 3, four pixels with 5.
    peers : float, default 0.5
        Share of the threshold by which a pixel differs from its neighbours, see the notes.
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
        If the image is not two-dimensional and finite, or a parameter out of range.
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
    values, _ = pixels.checked_pixels(image)
    threshold = pixels.checked_number("threshold", threshold, above=0, unit="deviations")
    size = pixels.checked_integer("size", size, least=3)
    if size % 2 == 0:
        raise InputError(
            f"size is {size}, expected an odd number, so that the window is centred on a pixel"
        )
    local, bright, dark = _neighbours(values, size, Reporter(None, should_stop))
    difference = values - local
    limit = threshold * _noise(difference, local)
    hot = (difference > limit) & (values - bright > peers * limit)
    dead = (difference < -limit) & (dark - values > peers * limit)
    return np.where(hot | dead, local, values), hot, dead


def _neighbours(
    values: FloatArray, size: int, report: Reporter
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return each pixel's median neighbour, and its brightest and darkest sound ones."""
    # The pixel itself does not count: with it, the noise would seem smaller than it is.
    footprint = np.ones((size, size), dtype=np.bool_)
    footprint[size // 2, size // 2] = False
    n = size * size - 1
    broken = n // 8

    def rank_filter(rank: int, mode: Literal["mirror", "reflect"]) -> FloatArray:
        report("hot pixels", 0)
        return np.asarray(scipy.ndimage.rank_filter(values, rank, footprint=footprint, mode=mode))

    # 'reflect' lets no neighbour of a corner pixel fill half of its neighbourhood; 'mirror'
    # does not make a pixel at the border its own peer.
    median = (rank_filter(n // 2 - 1, "reflect") + rank_filter(n // 2, "reflect")) / 2
    return median, rank_filter(n - 1 - broken, "mirror"), rank_filter(broken, "mirror")


def _noise(
    difference: FloatArray, brightness: FloatArray, least: int = 400, most: int = 16
) -> FloatArray:
    """Return the deviation of each pixel's difference, by groups of `least` pixels or more."""
    n_bins = min(max(difference.size // least, 1), most)
    groups = np.array_split(np.argsort(brightness, axis=None, kind="stable"), n_bins)
    flat, positive = difference.ravel(), np.maximum(brightness, 0).ravel()
    sizes = (np.abs(flat[group]) for group in groups)
    # In few-bit images more than half the pixels can equal their median: by the mean, √(π/2).
    deviations = [NORMAL_MAD * np.median(size) or 1.2533 * size.mean() for size in sizes]
    variance = np.array([float(deviation) ** 2 for deviation in deviations])
    if not variance.any():
        return np.zeros_like(difference)
    levels = np.array([positive[group].mean() for group in groups])
    # A variance is known to a share of itself: weighing by its inverse keeps the dark
    # pixels' noise from drowning in the bright ones'. Units drop out of both columns.
    share = 1 / np.maximum(variance, 1e-3 * variance.max())
    unit, scale = variance.mean(), levels.mean() or 1.0
    columns = np.stack([np.ones_like(levels), levels / scale], axis=1) * unit
    terms, _ = pixels.nonnegative_fit(columns * share[:, None], variance * share)
    constant, slope = terms * unit
    return np.asarray(np.sqrt(constant + slope * np.maximum(brightness, 0) / scale))
