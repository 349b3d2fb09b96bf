"""Filters for images before an inversion, and for potentials after it.

- keep only small or only large structures: `high_pass`, `low_pass`, `butterworth`
- flatten an uneven beam: `remove_background`
- each with its parameters, to be one step of a recipe: `LowPassFilter`, `HighPassFilter`,
  `ButterworthFilter`, `BackgroundFilter`; their base class: `Filter`

All take an image or a potential ``[y, x]``, in any unit, and return float64 of the same shape
and unit. An `InputError` refuses an image that is not two-dimensional and finite, and a parameter
out of range.

An inversion amplifies low frequencies: a source that is wrong by little on a large scale
makes a large false potential. Filtering the image, the potential, or both is the simple
remedy of Kasim et al., arXiv:1607.04179, section V.

The linear filters multiply the image's discrete cosine transform (type II) by a gain that
depends on the wave number k alone. That mirrors the image at its border, so nothing wraps
around, and each cosine that fits the image is attenuated by exactly its gain.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.pixels import fill_masked_pixels
from napari_shadowinv.preprocessing.steps import Step, degree_field, width_field

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import ShouldStop
    from napari_shadowinv.preprocessing.radiograph import Radiograph

__all__ = [
    "BackgroundFilter",
    "ButterworthFilter",
    "Filter",
    "HighPassFilter",
    "LowPassFilter",
    "butterworth",
    "high_pass",
    "low_pass",
    "remove_background",
]


class Filter(Step):
    """A step that changes the values of the image, and of a measured source alike."""

    function: ClassVar[Callable[..., FloatArray]]
    """Filters an image by the parameters."""

    @property
    def moves_pixels(self) -> bool:
        return False

    def filter_image(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
    ) -> FloatArray:
        """Apply the filter, so that masked pixels, even NaN, do not affect the others."""
        values = np.asarray(image, dtype=np.float64)
        return self._filter(fill_masked_pixels(values, mask, should_stop), mask, should_stop)

    def _filter(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None
    ) -> FloatArray:
        return self.function(image, **self.values())

    def note(self, before: FloatArray, after: FloatArray, mask: BoolArray | None) -> str:
        """Return a note on the changes by the filter."""
        return self.summary

    def apply(self, shot: Radiograph, should_stop: ShouldStop | None = None) -> Radiograph:
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
    step: Literal["low-pass"] = "low-pass"
    width: float = width_field(1.0, "Standard deviation of the Gaussian blur in px.", 0.1, 20.0)

    @property
    def smooths(self) -> bool:
        return True


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
    step: Literal["high-pass"] = "high-pass"
    width: float = width_field(
        50.0, "Structures much larger than this standard deviation, in px, are removed.", 1.0, 200.0
    )

    @property
    def flattens(self) -> bool:
        return True


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
    values, _ = pixels.checked_pixels(image)
    cutoff = pixels.checked_number("cutoff", cutoff, above=0, unit="px")
    order = pixels.checked_integer("order", order, least=1)
    if kind not in ("high", "low"):
        raise InputError(f"kind is {kind!r}, expected 'high' or 'low'")
    wave_numbers = _wave_numbers(values.shape)
    octaves = np.full(wave_numbers.shape, -np.inf)
    np.log(wave_numbers * (cutoff / (2 * np.pi)), out=octaves, where=wave_numbers > 0)
    # The logistic function gives 1 / (1 + x^2n) for any order without overflow.
    gain = np.sqrt(scipy.special.expit(2 * order * (octaves if kind == "high" else -octaves)))
    if kind == "high" and keep_mean:
        gain[0, 0] = 1.0
    return _apply_gain(values, gain)


class ButterworthFilter(Filter):
    """Take away large or small structures, with a chosen steepness."""

    title = "Butterworth"
    function = staticmethod(butterworth)
    primary = "cutoff"
    place = 70
    step: Literal["butterworth"] = "butterworth"
    cutoff: float = Field(
        default=100.0,
        gt=0,
        title="Cutoff (px)",
        description="Wavelength in px at which the amplitude drops to 1/√2.",
        json_schema_extra={"slider": [2.0, 500.0]},
    )
    order: int = Field(
        default=2,
        ge=1,
        le=20,
        title="Order",
        description=(
            "Beyond the cutoff the amplitude falls as this power of the wavelength; high orders "
            "ring."
        ),
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
    if kind not in ("divide", "subtract"):
        raise InputError(f"kind is {kind!r}, expected 'divide' or 'subtract'")
    values, _ = pixels.checked_pixels(image)
    background = pixels.fit_polynomial(values, degree, mask=mask, should_stop=should_stop)
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


class BackgroundFilter(Filter):
    """Flatten by a polynomial."""

    title = "flatten (polynomial)"
    place = 50
    step: Literal["background"] = "background"
    degree: int = degree_field(" that is divided out or subtracted.")
    kind: Literal["divide", "subtract"] = Field(
        default="divide",
        title="How",
        description="'divide' by the polynomial (uneven beam) or 'subtract' it (stray light).",
    )

    @property
    def flattens(self) -> bool:
        return True

    def _filter(
        self, image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None
    ) -> FloatArray:
        return remove_background(
            image, self.degree, kind=self.kind, mask=mask, should_stop=should_stop
        )


def _wave_numbers(shape: tuple[int, ...]) -> FloatArray:
    """Wave number k in rad/px of each coefficient of the discrete cosine transform."""
    k_y, k_x = (np.pi * np.arange(side) / side for side in shape)
    return np.asarray(np.hypot(k_y[:, None], k_x))


def _apply_gain(values: FloatArray, gain: FloatArray) -> FloatArray:
    return np.asarray(scipy.fft.idctn(gain * scipy.fft.dctn(values, norm="ortho"), norm="ortho"))
