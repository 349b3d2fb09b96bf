"""Noise of an image, and the difference of its beam from the source.

- the noise, from differences between neighbouring pixels: `ImageNoise`
- its correlation: `measure_correlation`
- the beam of a shot against its source, where there is no object: `beam_difference`

Structures from the beam's path are smooth over a few pixels, noise is not: in
(a - b - c + d) / 2 over four neighbours a smooth image cancels, and white noise keeps its
variance. A filter, a scintillator, an image plate or resampling correlates the noise of
neighbouring pixels; then differences over more pixels are larger. `measure_correlation` shows
how much more noise there is in the mean of many pixels than in white noise.

A reference of another exposure, or a beam that is less flat than assumed, differs from the beam of
the shot on large scales. An object has finer structure. The frame along the image's edge is divided
into tiles an eighth of the shorter side wide; in tiles without an object the ratio of image to
source is a plane plus noise, and its differences between such tiles are differences of the beams.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.inversion.normalise import Prepared
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.arrays import complete_block_means, order_by_value
from napari_shadowinv.preprocessing.noise import NORMAL_MAD, finest_differences
from napari_shadowinv.preprocessing.pixels import nonnegative_fit


@dataclass(frozen=True)
class QuietTiles:
    """Parts of the frame that show the beam alone, as benchmarks/imperfections.py needs them."""

    tiles: int = 8  # along the shorter side
    cells: int = 4  # along each side of a tile
    used_share: float = 0.5  # of a cell's pixels
    least_cell: int = 2  # px
    noise_ratio: float = 2.0  # variance of a quiet tile about its plane, over that of noise
    curvature: float = 0.15  # of the spread of the tiles
    least_curvature: float = 1e-3  # of the brightness
    deviations: float = 4.0  # of a quiet tile from the others
    share: float = 0.2  # of the frame's tiles
    significance: float = 5.0  # standard deviations
    least_difference: float = 2e-3


def beam_difference(
    prepared: Prepared,
    noise: ImageNoise,
    patterns: FloatArray | None = None,
    tiles: QuietTiles = QuietTiles(),
) -> float:
    """Return the r.m.s. relative difference of image and source outside the object.

    It is 0 where the difference is within the noise, or where too little of the frame along the
    edge is free of the object for a comparison, as where even calm parts have structure that hides
    the noise. The patterns, (k, H, W), are changes of the source by one standard deviation of each
    number that is known so well, as of its registration; what they explain does not count, either.
    """
    shape = prepared.mask.shape
    cell = min(shape) // (tiles.tiles * tiles.cells)
    if cell < tiles.least_cell or noise.is_bound:
        return 0.0
    rows, columns = (length // (cell * tiles.cells) for length in shape)
    ratio, variance = _cell_ratios(prepared, noise, cell, rows, columns, tiles)
    means, by_noise = ratio.mean(axis=(2, 3)), variance.mean(axis=(2, 3))
    is_used = np.isfinite(means)
    middle = float(np.median(means[is_used])) if is_used.any() else 0.0
    if not middle > 0:
        return 0.0
    means, by_noise = means / middle, by_noise / middle**2
    quiet = ~is_used | _is_quiet(ratio / middle, means, by_noise, tiles)
    # An object fades into neighbouring tiles that seem quiet.
    quiet = ndimage.binary_erosion(quiet, np.ones((3, 3)), border_value=1) & is_used
    quiet[1:-1, 1:-1] = False
    count = int(quiet.sum())
    if count < tiles.share * 2 * (rows + columns - 2):
        return 0.0
    deviation = means[quiet] - means[quiet].mean()
    by_noise = by_noise[quiet] / tiles.cells**2
    free = count - 1.0
    if patterns is not None:
        source = _tile_sums(prepared.source, cell, rows, columns, tiles)
        columns_of = [_tile_sums(each, cell, rows, columns, tiles)[quiet] for each in patterns]
        explained = np.stack(columns_of, axis=1) / source[quiet][:, None]
        explained -= explained.mean(axis=0)
        # The likeliest numbers, which are known to be about 0 ± 1: what exceeds that is not known.
        unsure = explained.T @ explained / by_noise.mean() + np.eye(len(patterns))
        answer = np.linalg.solve(unsure, explained.T) / by_noise.mean()
        numbers = answer @ deviation
        numbers /= max(1.0, float(np.sqrt((numbers**2).mean())))
        deviation = deviation - explained @ numbers
        free = max(free - float(np.trace(explained @ answer)), 1.0)
    limit = free + tiles.significance * np.sqrt(2.0 * count)
    if (deviation**2).sum() < limit * by_noise.mean():
        return 0.0
    square = (deviation**2).sum() / free - by_noise.mean()
    difference = float(np.sqrt(max(square, 0.0)))
    return difference if difference > tiles.least_difference else 0.0


def _cell_sums(
    values: FloatArray | BoolArray, cell: int, rows: int, columns: int, tiles: QuietTiles
) -> FloatArray:
    """Return sums over the cells of each tile, shape (rows, columns, 4, 4)."""
    count = tiles.cells
    inner = values[: rows * cell * count, : columns * cell * count]
    cells = inner.reshape(rows, count, cell, columns, count, cell).sum(axis=(2, 5))
    return np.asarray(np.moveaxis(cells, 2, 1), dtype=np.float64)


def _tile_sums(
    values: FloatArray, cell: int, rows: int, columns: int, tiles: QuietTiles
) -> FloatArray:
    return np.asarray(_cell_sums(values, cell, rows, columns, tiles).sum(axis=(2, 3)))


def _cell_ratios(
    prepared: Prepared, noise: ImageNoise, cell: int, rows: int, columns: int, tiles: QuietTiles
) -> tuple[FloatArray, FloatArray]:
    """Return image over source and its variance by noise, shape (rows, columns, 4, 4)."""
    image, source, count = (
        _cell_sums(values, cell, rows, columns, tiles)
        for values in (prepared.image, prepared.source, prepared.mask)
    )
    mean = prepared.source[prepared.mask].mean()
    is_known = (count >= tiles.used_share * cell**2) & (source > 0)
    source = np.where(is_known, source, np.nan)
    count = np.maximum(count, 1)
    variance = noise.variance(image / count / mean) * noise.clumping * mean**2 * count
    return image / source, variance / source**2


def _is_quiet(
    ratio: FloatArray, means: FloatArray, variance: FloatArray, tiles: QuietTiles
) -> BoolArray:
    residual = ratio - means[..., None, None]
    for slope in np.indices((tiles.cells, tiles.cells)) - (tiles.cells - 1) / 2:
        share = (residual * slope).sum(axis=(2, 3), keepdims=True) / (slope**2).sum()
        residual = residual - share * slope
    square = (residual**2).sum(axis=(2, 3)) / (tiles.cells**2 - 3)
    spread = NORMAL_MAD * float(np.nanmedian(np.abs(means - 1)))
    allowed = max(tiles.curvature * spread, tiles.least_curvature) ** 2
    quiet = square <= tiles.noise_ratio * variance + allowed
    if not quiet.any():
        return np.asarray(quiet)
    # A flank may look like a plane, but stands out from the beam's slow differences.
    away = np.abs(means - np.median(means[quiet]))
    spread = NORMAL_MAD * float(np.median(away[quiet]))
    return np.asarray(quiet & (away <= tiles.deviations * spread))


_CLIPPED_AT = 4.0  # in standard deviations of normal noise
_DEVIATIONS = 5.0
_BINS, _SAMPLES = 24, 20_000  # of brightness, and the pixels that are looked at

_DARK = 0.2  # of the mean brightness


@dataclass(frozen=True)
class CorrelationLimits:
    """How correlated noise is separated from structure, as benchmarks/trust.py (noise) needs it."""

    lags: tuple[int, ...] = (1, 2, 3, 4, 6, 8)  # px
    flat: tuple[int, int] = (1, 4)  # lags at which white noise has V(1)
    block: int = 4  # px
    most_blocks: int = 2000
    calm_share: float = 0.15  # of the blocks
    less_calm_share: float = 0.5
    least_pixels: int = 40
    rise: float = 1.2  # of V over V(1), at least
    rise_deviations: float = 20.0  # the same, in 1/√(pixels)
    widths: tuple[float, float, int] = (0.3, 4.0, 24)  # px, from, to, and how many
    fitted: int = 6  # px, lags up to which differences are compared with those of a blur
    scatter: float = 0.25  # of V
    misfit: float = 8.0  # χ², of noise that stands out of structure
    far_excess: float = 2.0  # of V at the largest lag, over that of such noise
    most_white: float = 1.0  # variance before the blur: of one quantum a pixel
    clipped_at: float = 2.5  # deviations
    clipped_variance: float = 0.973
    least_deviation: float = 1e-4  # of the brightness; below are flanks of noiseless images
    far_lag: int = 12  # px
    far_rise: float = 1.8
    far_unevenness: float = 1.5


# White noise on pixels has waves up to 3.51 rad/px, averaged over directions of its logarithm;
# a Gaussian blur of standard deviation b ends them at exp(-γ/2) / b.
_GRAIN_PER_BLUR = 3.51 / math.exp(-0.5772 / 2)


class ImageNoise:
    """Noise of an image, and of its source, as shares of the source's mean.

    It is correlated as by a Gaussian blur of a stated width, px, or as measured. A stated variance
    of more than `most_stated` times the measured one is not used.

    A pixel has the standard deviation `largest` with hot pixels and the finest structure, `typical`
    without. `clumping` is the variance of the sum of many pixels over the sum of their variances, 1
    for white noise; `correlation_length` the standard deviation of the Gaussian blur that clumps
    white noise as much, px, 0 for white noise. The `variance_terms` (3,) are constant, in
    proportion to a pixel's brightness, and to its square. If structure hides the noise, it
    `is_bound`: at most as large. If calm parts vary over more pixels than a correlation can be
    measured, it `is_correlated_far`: all of the above is then too small.
    """

    def __init__(
        self,
        prepared: Prepared,
        options: InversionOptions | None = None,
        correlation: float | None = None,
        most_stated: float = 2.5,
    ) -> None:
        image, mask = prepared.image, prepared.mask  # in units of `prepared.unit`
        self.shape = mask.shape[0], mask.shape[1]
        mean = prepared.source[mask].mean()
        excess = (image - prepared.source) / mean
        used = mask[1:, 1:] & mask[1:, :-1] & mask[:-1, 1:] & mask[:-1, :-1]
        differences = finest_differences(excess, used)
        measured = measure_correlation(excess, image / mean, mask, correlation)
        self.clumping, self.is_bound = measured.clumping, measured.is_bound
        self.is_correlated_far = measured.is_far
        self.typical, self.largest = _clipped_rms(differences), _rms(differences)
        if measured.blurred:
            self.typical = math.sqrt(measured.variance)
            self.largest = max(self.largest, self.typical)
        # The source's mean, in units of the recorded image.
        quantum = prepared.flux_scale * prepared.unit * mean
        self.variance_terms = np.zeros(3)
        level, counts = (
            (None, None) if options is None else (options.noise_level, options.units_per_quantum)
        )
        if level is not None:
            self.variance_terms[0] = (level / quantum) ** 2
            # A smooth image may have been smoothed, or has less noise than that.
            if measured.is_bound or self.variance_terms[0] > most_stated * measured.variance:
                self.clumping, self.is_bound = 1.0, False
        elif counts is not None:
            self.variance_terms[1] = counts / quantum
            self.clumping = 1.0  # a blur leaves the counting noise of many pixels as it was
            self.is_bound = self.is_correlated_far = False
        elif measured.blurred:
            self.variance_terms[1] = measured.variance
        elif used.any():
            step = -(-len(differences) // _SAMPLES)
            places = np.arange(0, used.size, step)
            if not used.all():
                places = np.flatnonzero(used)[::step]
            rows, columns = np.unravel_index(places, used.shape)
            low, right = rows + 1, columns + 1
            bright = image[low, right] + image[low, columns] + image[rows, right]
            bright = (bright + image[rows, columns]) / (4 * mean)
            self.variance_terms = _terms(bright, differences[::step])
        if (level, counts) != (None, None):  # stated for the image, not for its source
            of_source = finest_differences(prepared.source / mean, used)
            self.variance_terms[0] += _clipped_rms(of_source) ** 2
        self.correlation_length = 0.0
        if self.clumping > 1:
            self.correlation_length = math.sqrt(self.clumping / (4 * math.pi))

    @property
    def grain(self) -> float:
        """Smallest structure of correlated noise, px, where pixels have 1; 0 for white noise."""
        return _GRAIN_PER_BLUR * self.correlation_length

    def variance(self, brightness: FloatArray) -> FloatArray:
        """Return the variance of pixels by their brightness, in units of the source's mean."""
        constant, linear, square = self.variance_terms
        return np.asarray(constant + brightness * (linear + square * brightness))

    def displacements(self, level: float) -> tuple[float, float]:
        """Return the r.m.s. displacement by a level of noise, px, and its likely maximum."""
        mean, deviation = _response(self.shape)
        # The waves that correlated noise lacks contribute 1 / 2π of the mean per power of e.
        mean = max(mean - math.log(max(self.grain, 1.0)) / (2 * math.pi), deviation)
        level *= math.sqrt(self.clumping)
        return level * math.sqrt(mean), level * math.sqrt(mean + _DEVIATIONS * deviation)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _clipped_rms(differences: FloatArray) -> float:
    """Return the standard deviation, with differences clipped that noise does not explain."""
    limit = _CLIPPED_AT * NORMAL_MAD * float(np.median(differences))
    return _rms(np.minimum(differences, limit)) if limit > 0 else _rms(differences)


@dataclass(frozen=True)
class CorrelatedNoise:
    """Noise that is partly white, partly blurred by a Gaussian."""

    white: float  # variance of a pixel as bright as the source's mean
    blurred: float = 0.0  # another such variance
    width: float = 0.0  # of the Gaussian, px
    is_bound: bool = False
    is_far: bool = False

    @property
    def variance(self) -> float:
        """Variance of a pixel."""
        return self.white + self.blurred

    @property
    def white_variance(self) -> float:
        """Variance in a pixel of white noise with as much power on long waves."""
        return self.white + max(4 * math.pi * self.width**2, 1.0) * self.blurred

    @property
    def clumping(self) -> float:
        """Variance of the sum of many pixels over the sum of their variances."""
        return self.white_variance / self.variance if self.blurred else 1.0


def measure_correlation(
    excess: FloatArray,
    brightness: FloatArray,
    mask: BoolArray,
    width: float | None = None,
    limits: CorrelationLimits = CorrelationLimits(),
) -> CorrelatedNoise:
    """Return the noise of the calm parts of an image, or the most that structure there allows.

    Second differences over d pixels along both axes have a variance V(d) that is constant for white
    noise. If a Gaussian blurred the noise, V is smaller up to about twice its width, and in
    structure up to the structure's size: V(1) to V(6) are compared with V of blurred noise, and no
    V may be exceeded. Of the widths that fit alike, the one with most noise on long waves is used.

    The excess is image less source, the brightness the image, over the source's mean, (H, W); the
    width of the blur is in px, if it is known.
    """
    differences = _CalmDifferences.of(excess, brightness, mask, limits)
    lags, variances = differences.curve(limits.calm_share)
    if len(lags) < 3 or variances[-1] < limits.least_deviation**2:
        return CorrelatedNoise(0.0)
    variances = np.maximum(variances, 1e-9 * variances.max())
    white = float(variances[0])
    widths = np.geomspace(*limits.widths) if width is None else np.array([width])
    if width is None:
        least = max(
            limits.rise,
            1 + limits.rise_deviations / math.sqrt(differences.count(limits.calm_share)),
        )
        if variances[slice(*limits.flat)].max() < least * white:
            return CorrelatedNoise(white, is_far=differences.rise_evenly())
    elif 4 * math.pi * width**2 <= 1:
        return CorrelatedNoise(white)
    near = lags <= limits.fitted
    answers = []
    for blur in widths.tolist():
        shares = _blurred_shares(lags, blur)
        columns = np.stack([np.full(len(lags), width is None), shares], axis=1)
        fitted, _ = nonnegative_fit((columns / variances[:, None])[near], np.ones(near.sum()))
        white = min(float(fitted[0]), float(variances.min()))
        blurred = min(float(fitted[1]), float(((variances - white) / shares).min()))
        most = max(limits.most_white - white, 0.0) / max(4 * math.pi * blur**2, 1.0)
        noise = CorrelatedNoise(white, min(blurred, most), blur, blurred >= most)
        rest = 1 - columns @ [white, noise.blurred] / variances
        answers.append((float((rest[near] ** 2).sum()) / limits.scatter**2, noise))
    least = min(misfit for misfit, _ in answers)
    alike = [noise for misfit, noise in answers if misfit <= least + 1]
    noise = max(alike, key=lambda noise: noise.white_variance)
    # Beyond its width V of blurred noise is constant, and that of structure still rises.
    far = noise.white + noise.blurred * float(_blurred_shares(lags[-1:], noise.width)[0])
    is_bound = (
        noise.is_bound or least > limits.misfit or float(variances[-1]) > limits.far_excess * far
    )
    return replace(noise, is_bound=is_bound)


def _blurred_shares(lags: FloatArray, width: float) -> FloatArray:
    """Return V(d) of noise that a Gaussian has blurred, over its variance."""
    near, far = (np.exp(-((distance / width) ** 2) / 4) for distance in (lags, 2 * lags))
    return np.asarray(((6 - 8 * near + 2 * far) / 6) ** 2)


@dataclass(frozen=True, eq=False)
class _CalmDifferences:
    """Blocks of an image in the order of their slopes, and differences of their pixels."""

    excess: FloatArray
    brightness: FloatArray
    mask: BoolArray
    blocks: IntArray  # rows and columns, the calmest first
    limits: CorrelationLimits

    @classmethod
    def of(
        cls,
        excess: FloatArray,
        brightness: FloatArray,
        mask: BoolArray,
        limits: CorrelationLimits,
    ) -> _CalmDifferences:
        used = complete_block_means(mask, limits.block) == 1
        level = complete_block_means(brightness, limits.block)
        if not used.any():
            return cls(excess, brightness, mask, np.zeros((0, 2), np.int64), limits)
        mean = level[used].mean()
        smooth, level = (
            ndimage.gaussian_filter(np.where(used, values, fill), 1.0, mode="nearest")
            for values, fill in ((complete_block_means(excess, limits.block), 0.0), (level, mean))
        )
        slopes = np.gradient(smooth) if min(smooth.shape) > 1 else [smooth]
        slope = np.hypot(*slopes) if len(slopes) > 1 else slopes[0]
        slope = ndimage.gaussian_filter(slope / np.sqrt(np.maximum(level, 0.05 * mean)), 1.0)
        blocks = np.argwhere(used & (level > _DARK * mean))
        order = np.argsort(slope[tuple(blocks.T)], kind="stable")
        return cls(excess, brightness, mask, blocks[order], limits)

    def count(self, share: float) -> int:
        """Return the number of pixels in the calmest blocks."""
        return max(math.ceil(share * len(self.blocks)), 1) * self.limits.block**2

    def variance(self, lag: int, share: float) -> float:
        """Return V at a lag over the brightness, in calm blocks; NaN in few or dark pixels."""
        blocks = self.blocks[: max(math.ceil(share * len(self.blocks)), 1)]
        blocks = blocks[:: max(-(-len(blocks) // self.limits.most_blocks), 1)]
        inside = np.indices((self.limits.block, self.limits.block)).reshape(2, -1)
        places = (self.limits.block * blocks.T[:, :, None] + inside[:, None]).reshape(2, -1)
        limits = np.array(self.mask.shape)[:, None] - lag
        rows, columns = places[:, ((places >= lag) & (places < limits)).all(axis=0)]
        total, is_used = np.zeros(len(rows)), np.ones(len(rows), bool)
        middle, width = rows * self.mask.shape[1] + columns, self.mask.shape[1]
        for down, right in itertools.product((-lag, 0, lag), repeat=2):
            at = middle + (down * width + right)
            total += (-2.0) ** ((down == 0) + (right == 0)) * self.excess.take(at)
            is_used &= self.mask.take(at)
        squares = (total[is_used] / 6) ** 2
        brightness = self.brightness[rows, columns][is_used]
        if len(squares) < self.limits.least_pixels or not brightness.any():
            return math.nan
        limit = (self.limits.clipped_at * NORMAL_MAD) ** 2 * float(np.median(squares))
        clipped = float(np.minimum(squares, limit).mean())
        return clipped / (self.limits.clipped_variance * float(brightness.mean()))

    def curve(self, share: float) -> tuple[FloatArray, FloatArray]:
        """Return the lags at which V can be measured, and V."""
        variances = np.array([self.variance(lag, share) for lag in self.limits.lags])
        measured = np.isfinite(variances)
        return np.array(self.limits.lags, dtype=np.float64)[measured], variances[measured]

    def rise_evenly(self) -> bool:
        """Whether V rises at a large lag, and not more where the image is less calm."""
        near, far = (self.variance(lag, self.limits.calm_share) for lag in (1, self.limits.far_lag))
        uneven = self.variance(self.limits.far_lag, self.limits.less_calm_share)
        return far > self.limits.far_rise * near and uneven < self.limits.far_unevenness * far


def _terms(bright: FloatArray, differences: FloatArray) -> FloatArray:
    """Fit the noise terms of detectors: read-out, counting, and uneven response."""
    order = order_by_value(bright)
    parts = np.array_split(order, min(_BINS, max(1, len(order) // 20)))
    bins = [(float(bright[part].mean()), _clipped_rms(differences[part]) ** 2) for part in parts]
    places, variances = np.array(bins).T
    if not variances.any():
        return np.zeros(3)
    # Relative deviations: bins on bright lines, whose structure looks like noise, count little.
    weights = 1 / np.maximum(variances, 1e-6 * variances.max())
    powers = np.stack([np.ones_like(places), places, places**2], axis=1)
    return nonnegative_fit(weights[:, None] * powers, weights * variances)[0]


@lru_cache(maxsize=8)
def _response(shape: tuple[int, int]) -> tuple[float, float]:
    """Return mean and standard deviation of the mean square displacement by unit noise, px²."""
    wave_y, wave_x = (np.pi * np.arange(length) / length for length in shape)
    square = wave_y[:, None] ** 2 + wave_x**2
    square[0, 0] = np.inf
    power = 1 / square
    return float(power.mean()), float(np.sqrt(2 * (power**2).sum()) / power.size)
