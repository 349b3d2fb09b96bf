"""Filters for images before an inversion, and for potentials after it.

- keep only small or only large structures: `HighPassFilter`, `LowPassFilter`, `ButterworthFilter`
- flatten an uneven beam: `BackgroundFilter`
- replace broken pixels: `HotPixelFilter`
- their base class: `Filter`

Each is a step of a recipe, and filters one image by `Filter.filter_image`: an image or a potential
``[y, x]``, in any unit, to float64 of the same shape and unit.

An inversion amplifies low frequencies: a source that is wrong by little on a large scale
makes a large false potential. Filtering the image, the potential, or both is the simple
remedy of Kasim et al., arXiv:1607.04179, section V.

The linear filters multiply the image's discrete cosine transform (type II), or the Fourier
transform of its mirrored double, by a gain that depends on the wave number k alone. That mirrors
the image at its border, so nothing wraps around, and each cosine that fits the image is attenuated
by exactly its gain.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.noise import NORMAL_MAD
from napari_shadowinv.preprocessing.steps import Step, degree_field, width_field
from napari_shadowinv.shot import Shot


class Filter(Step):
    """A step that changes the values of the image, and of a measured source alike."""

    moves_pixels = False

    def filter_image(
        self,
        image: ArrayLike,
        mask: ArrayLike | None = None,
        should_stop: ShouldStop | None = None,
    ) -> FloatArray:
        """Return an image, shape (H, W), after the filter.

        Pixels where the mask is false, even NaN, do not affect the others. An `InputError` refuses
        an image that is not two-dimensional and finite at the others.
        """
        values, usable = pixels.checked_pixels(image, mask)
        report = Reporter(None, should_stop)
        if not usable.all():
            pixels.beam_pixels(image, mask)  # refuses one without flux
            values = np.where(usable, values, pixels.with_filled_part(values, usable, report))
        return self._filter(values, usable, report)

    def _filter(self, values: FloatArray, usable: BoolArray, report: Reporter) -> FloatArray:
        raise NotImplementedError

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


class LowPassFilter(Filter):
    """Take away small structures, by a Gaussian blur; the mean stays.

    A wave of wave number k (rad/px) keeps exp(-k²σ²/2) of its amplitude: half of it at a wavelength
    of 5.3 σ. Apart from rounding and, for σ below 1 px, ringing, no pixel leaves the range of the
    image.

    Examples
    --------
    >>> import numpy as np
    >>> wave = np.cos(np.pi * 8 * (np.arange(64) + 0.5) / 64) * np.ones((16, 1))
    >>> blurred = LowPassFilter(width=2).filter_image(wave)
    >>> float((blurred / wave).mean()), float(np.exp(-((np.pi / 8 * 2) ** 2) / 2))
    (0.7346, 0.7346)
    """

    title = "low-pass (smooth)"
    primary = "width"
    place = 80
    smooths: ClassVar[bool] = True
    step: Literal["low-pass"] = "low-pass"
    width: float = width_field(1.0, "Standard deviation of the Gaussian blur in px.", 0.1, 20.0)

    def _filter(self, values: FloatArray, usable: BoolArray, report: Reporter) -> FloatArray:
        return blur(values, self.width)


class HighPassFilter(Filter):
    """Take away large structures: all but the mean of what a Gaussian blur would keep.

    A wave of wave number k keeps 1 - exp(-k²σ²/2) of its amplitude.

    Notes
    -----
    Where its blur exceeds an image by more than its mean, as in a dark spot near the centre of a
    strongly peaked beam, the result is negative. It is not clipped: that would add flux without a
    word. `invert` treats such pixels as its option `negative` says. For a beam that uneven,
    dividing (`BackgroundFilter`, or a source estimate) serves better: it keeps the sign.
    """

    title = "high-pass"
    primary = "width"
    place = 60
    flattens: ClassVar[bool] = True
    step: Literal["high-pass"] = "high-pass"
    width: float = width_field(
        50.0, "Structures much larger than this standard deviation, in px, are removed.", 1.0, 200.0
    )

    def _filter(self, values: FloatArray, usable: BoolArray, report: Reporter) -> FloatArray:
        return np.asarray(values - blur(values, self.width) + values.mean())


class ButterworthFilter(Filter):
    """Take away large or small structures, with a chosen steepness; the mean stays.

    The gain at the wave number k, with k_c = 2π / cutoff and the order n, is (1 + (k_c/k)^2n)^-½
    for a high pass, whose result can be negative, see `HighPassFilter`, and (1 + (k/k_c)^2n)^-½
    for a low pass.

    References
    ----------
    S. Butterworth, "On the theory of filter amplifiers", Experimental Wireless and the
    Wireless Engineer 7, 536 (1930).

    Examples
    --------
    >>> import numpy as np
    >>> wave = np.cos(np.pi * 8 * (np.arange(64) + 0.5) / 64) * np.ones((16, 1))
    >>> float((ButterworthFilter(cutoff=16, order=3).filter_image(wave) / wave).mean())
    0.7071
    """

    title = "Butterworth"
    primary = "cutoff"
    place = 70
    step: Literal["butterworth"] = "butterworth"
    cutoff: float = Field(
        default=100.0,
        gt=2,
        allow_inf_nan=False,
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

    def _filter(self, values: FloatArray, usable: BoolArray, report: Reporter) -> FloatArray:
        from skimage.filters import butterworth

        # Doubled by its mirror image, as by a discrete cosine transform: nothing wraps around.
        mirrored = np.pad(values, [(0, side) for side in values.shape], mode="symmetric")
        frequency = 1 / min(self.cutoff, 1e6)  # of waves too long for any image
        filtered: FloatArray = butterworth(  # type: ignore[no-untyped-call]
            mirrored, frequency, self.flattens, self.order, squared_butterworth=False
        )
        mean = values.mean() if self.flattens else 0.0
        return filtered[: values.shape[0], : values.shape[1]] + mean


class BackgroundFilter(Filter):
    """Flatten by a polynomial; the mean stays.

    It is fitted as by `fit_polynomial` where the mask is true. An `InputError` refuses a mask that
    leaves too few pixels, and a polynomial to divide by that is not positive all over the image.
    """

    title = "flatten (polynomial)"
    place = 50
    flattens: ClassVar[bool] = True
    step: Literal["background"] = "background"
    degree: int = degree_field(" that is divided out or subtracted.")
    kind: Literal["divide", "subtract"] = Field(
        default="divide",
        title="How",
        description="'divide' by the polynomial (uneven beam) or 'subtract' it (stray light).",
    )

    def _filter(self, values: FloatArray, usable: BoolArray, report: Reporter) -> FloatArray:
        background = pixels.fit_polynomial(values, usable, self.degree, report)
        if self.kind == "subtract":
            return np.asarray(values - background + background.mean())
        if background.min() <= 0 or values.mean() <= 0:
            raise InputError(
                f"background of degree {self.degree} falls to {background.min():.4g} for an image "
                f"of mean {values.mean():.4g}, expected both to be positive for division: use a "
                "lower degree, or the kind 'subtract'"
            )
        flat = values / background
        return np.asarray(flat * (values.mean() / flat.mean()))


def blur(values: FloatArray, width: float) -> FloatArray:
    """Blur by a Gaussian, of a standard deviation in px."""
    k_y, k_x = (np.pi * np.arange(side) / side for side in values.shape)
    gain = np.exp(-0.5 * (width * np.hypot(k_y[:, None], k_x)) ** 2)
    return np.asarray(scipy.fft.idctn(gain * scipy.fft.dctn(values, norm="ortho"), norm="ortho"))


class HotPixelFilter(Filter):
    """Replace outlying pixels, alone or in pairs, by the median of their eight neighbours.

    Notes
    -----
    The noise is read off the image: the differences to the local median are sorted by
    brightness into groups of equal number, each group's variance is estimated by the median
    absolute deviation, and a + b·brightness with a, b ≥ 0 (read-out and Poisson-like noise)
    is fitted to them. The estimate includes the noise of the median itself, some 10 %; in
    a slope of several deviations per pixel, the slope as well.

    Caustics and foci also stand out, but span several pixels. A broken pixel must therefore
    also differ, by half the threshold, from all of its neighbours except one. The peak of a
    focus or line of less than some 4 px is still replaced, if its brightness is many
    deviations: compare the image with the one before, raise the threshold.

    A dead pixel among N counts stands out by √N standard deviations: below threshold² counts
    it cannot be distinguished from noise.

    Examples
    --------
    >>> import numpy as np
    >>> image = np.random.default_rng(0).normal(100, 2, (40, 40))
    >>> image[3, 5], image[20, 0] = 200, 0
    >>> clean = HotPixelFilter().filter_image(image)
    >>> np.argwhere(clean != image).tolist()
    [[3, 5], [20, 0]]
    """

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

    def _filter(self, values: FloatArray, usable: BoolArray, report: Reporter) -> FloatArray:
        local, bright, dark = _neighbours(values, report)
        difference = values - local
        limit = self.threshold * _noise(difference, local)
        is_hot = (difference > limit) & (values - bright > limit / 2)
        is_dead = (difference < -limit) & (dark - values > limit / 2)
        return np.where(is_hot | is_dead, local, values)

    def note(self, before: FloatArray, after: FloatArray, mask: BoolArray | None) -> str:
        usable = True if mask is None else mask
        hot, dead = (int((changed & usable).sum()) for changed in (after < before, after > before))
        return (
            f"{hot} hot and {dead} dead pixels replaced (beyond {self.threshold:g} standard "
            "deviations)"
        )


def _neighbours(values: FloatArray, report: Reporter) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return each pixel's median neighbour, and its second brightest and second darkest."""
    # The pixel itself does not count: with it, the noise would seem smaller than it is.
    footprint = np.ones((3, 3), dtype=np.bool_)
    footprint[1, 1] = False

    def rank_filter(rank: int, mode: Literal["mirror", "reflect"]) -> FloatArray:
        report("hot pixels", 0)
        return np.asarray(scipy.ndimage.rank_filter(values, rank, footprint=footprint, mode=mode))

    # 'reflect' lets no neighbour of a corner pixel fill half of its neighbourhood; 'mirror'
    # does not make a pixel at the border its own peer.
    median = (rank_filter(3, "reflect") + rank_filter(4, "reflect")) / 2
    return median, rank_filter(6, "mirror"), rank_filter(1, "mirror")


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
