"""Detection and replacement of broken pixels: `remove_hot_pixels`; as a step: `HotPixelFilter`."""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike
from pydantic import Field

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import pixels
from napari_shadowinv.preprocessing.filters import Filter

_NORMAL_MEAN = 1.2533  # standard deviation over mean absolute deviation, normal noise
_PIXELS_PER_NOISE_BIN = 400
_MOST_NOISE_BINS = 16
_OUTSTANDING = 0.5  # share of the threshold by which a pixel differs from its nearest peers


class HotPixelFilter(Filter):
    """Replace broken pixels."""

    title = "remove hot pixels"
    primary = "threshold"
    place = 30
    step: Literal["hot-pixels"] = "hot-pixels"
    threshold: float = Field(
        default=6.0,
        gt=0,
        title="Threshold",
        description=(
            "Replace pixels that differ from the median of their neighbours by more than this "
            "many standard deviations of the noise."
        ),
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
    hot = (difference > limit) & (values - bright > _OUTSTANDING * limit)
    dead = (difference < -limit) & (dark - values > _OUTSTANDING * limit)
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


def _noise(difference: FloatArray, brightness: FloatArray) -> FloatArray:
    """Return the standard deviation of each pixel's difference, by its brightness."""
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
    constant, slope = scipy.optimize.nnls(columns * share[:, None], variance * share)[0] * unit
    fitted: FloatArray = np.sqrt(constant + slope * np.maximum(brightness, 0) / scale)
    return fitted


def _deviation(difference: FloatArray) -> float:
    """Return the robust standard deviation about zero."""
    size = np.abs(difference)
    # In few-bit images more than half the pixels can equal their median.
    return float(pixels.NORMAL_MAD * np.median(size)) or float(_NORMAL_MEAN * size.mean())
