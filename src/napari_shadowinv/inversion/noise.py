"""Noise of an image, and the difference of its beam from the source.

- the noise, from differences between neighbouring pixels: `ImageNoise`
- the beam of a shot against its source, where there is no object: `beam_difference`

Structures from the beam's path are smooth over a few pixels, noise is not: in
(a - b - c + d) / 2 over four neighbours a smooth image cancels, and white noise keeps its
variance. A filter, a scintillator or an image plate correlates the noise of neighbouring pixels;
then such a difference over k pixels grows with k until the pixels are independent, in all parts
of the image alike. The variances V(k) = V(∞) (1 - ρ(k))² give the correlation ρ along one axis,
and from it how much more noise there is in the mean of many pixels than in white noise.

A reference of another exposure, or a beam that is less flat than assumed, differs from the beam of
the shot on large scales. An object has finer structure. The frame along the image's edge is divided
into tiles an eighth of the shorter side wide; in tiles without an object the ratio of image to
source is a plane plus noise, and its differences between such tiles are differences of the beams.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import ndimage

from napari_shadowinv._system.arrays import NORMAL_MAD, order_by_value
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.inversion.normalise import Prepared
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.preprocessing.pixels import nonnegative_fit

_TILES = 8  # along the shorter side
_CELLS = 4  # along each side of a tile
_MIN_USED_SHARE = 0.5  # of a cell's pixels
_MIN_CELL_PX = 2
_MAX_NOISE_RATIO = 2.0  # variance of a quiet tile about its plane, over that of noise
_MAX_CURVATURE = 0.15  # of the spread of the tiles
_MAX_DEVIATIONS = 4.0  # of a quiet tile from the others
_MIN_CURVATURE = 1e-3  # of the brightness
_MIN_QUIET_SHARE = 0.2  # of the frame's tiles
_SIGNIFICANCE = 5.0  # standard deviations
_MIN_DIFFERENCE = 2e-3


def beam_difference(
    prepared: Prepared, noise: ImageNoise, patterns: FloatArray | None = None
) -> float:
    """Return the r.m.s. relative difference of image and source outside the object.

    Parameters
    ----------
    prepared : Prepared
        Image and source in units of the source's power of two.
    noise : ImageNoise
        Noise of that image; differences that it explains do not count.
    patterns : ndarray, shape (k, H, W), optional
        Changes of the source by one standard deviation of each number that is known so well, as of
        its registration; what they explain does not count, either.

    Returns
    -------
    float
        0 where the difference is within the noise, or where too little of the frame along the
        edge is free of the object for a comparison.
    """
    shape = prepared.mask.shape
    cell = min(shape) // (_TILES * _CELLS)
    if cell < _MIN_CELL_PX:
        return 0.0
    rows, columns = (length // (cell * _CELLS) for length in shape)
    ratio, variance = _cell_ratios(prepared, noise, cell, rows, columns)
    means, by_noise = ratio.mean(axis=(2, 3)), variance.mean(axis=(2, 3))
    is_used = np.isfinite(means)
    middle = float(np.median(means[is_used])) if is_used.any() else 0.0
    if not middle > 0:
        return 0.0
    means, by_noise = means / middle, by_noise / middle**2
    quiet = ~is_used | _is_quiet(ratio / middle, means, by_noise)
    # An object fades into neighbouring tiles that seem quiet.
    quiet = ndimage.binary_erosion(quiet, np.ones((3, 3)), border_value=1) & is_used
    quiet[1:-1, 1:-1] = False
    count = int(quiet.sum())
    if count < _MIN_QUIET_SHARE * 2 * (rows + columns - 2):
        return 0.0
    deviation = means[quiet] - means[quiet].mean()
    by_noise = by_noise[quiet] / _CELLS**2
    free = count - 1.0
    if patterns is not None:
        source = _tile_sums(prepared.source, cell, rows, columns)
        columns_of = [_tile_sums(each, cell, rows, columns)[quiet] for each in patterns]
        explained = np.stack(columns_of, axis=1) / source[quiet][:, None]
        explained -= explained.mean(axis=0)
        # The likeliest numbers, which are known to be about 0 ± 1: what exceeds that is not known.
        unsure = explained.T @ explained / by_noise.mean() + np.eye(len(patterns))
        answer = np.linalg.solve(unsure, explained.T) / by_noise.mean()
        numbers = answer @ deviation
        numbers /= max(1.0, float(np.sqrt((numbers**2).mean())))
        deviation = deviation - explained @ numbers
        free = max(free - float(np.trace(explained @ answer)), 1.0)
    limit = free + _SIGNIFICANCE * np.sqrt(2.0 * count)
    if (deviation**2).sum() < limit * by_noise.mean():
        return 0.0
    square = (deviation**2).sum() / free - by_noise.mean()
    difference = float(np.sqrt(max(square, 0.0)))
    return difference if difference > _MIN_DIFFERENCE else 0.0


def _cell_sums(values: FloatArray | BoolArray, cell: int, rows: int, columns: int) -> FloatArray:
    """Return sums over the cells of each tile, shape (rows, columns, 4, 4)."""
    side = cell * _CELLS
    inner = values[: rows * side, : columns * side]
    cells = inner.reshape(rows, _CELLS, cell, columns, _CELLS, cell).sum(axis=(2, 5))
    return np.asarray(np.moveaxis(cells, 2, 1), dtype=np.float64)


def _tile_sums(values: FloatArray, cell: int, rows: int, columns: int) -> FloatArray:
    return np.asarray(_cell_sums(values, cell, rows, columns).sum(axis=(2, 3)))


def _cell_ratios(
    prepared: Prepared, noise: ImageNoise, cell: int, rows: int, columns: int
) -> tuple[FloatArray, FloatArray]:
    """Return image over source and its variance by noise, shape (rows, columns, 4, 4)."""
    image, source, count = (
        _cell_sums(values, cell, rows, columns)
        for values in (prepared.image, prepared.source, prepared.mask)
    )
    mean = prepared.source[prepared.mask].mean()
    is_known = (count >= _MIN_USED_SHARE * cell**2) & (source > 0)
    source = np.where(is_known, source, np.nan)
    count = np.maximum(count, 1)
    variance = noise.variance(image / count / mean) * noise.clumping * mean**2 * count
    return image / source, variance / source**2


def _is_quiet(ratio: FloatArray, means: FloatArray, variance: FloatArray) -> BoolArray:
    """Return which tiles contain only a plane and noise."""
    residual = ratio - means[..., None, None]
    for slope in np.indices((_CELLS, _CELLS)) - (_CELLS - 1) / 2:
        share = (residual * slope).sum(axis=(2, 3), keepdims=True) / (slope**2).sum()
        residual = residual - share * slope
    square = (residual**2).sum(axis=(2, 3)) / (_CELLS**2 - 3)
    spread = NORMAL_MAD * float(np.nanmedian(np.abs(means - 1)))
    allowed = max(_MAX_CURVATURE * spread, _MIN_CURVATURE) ** 2
    quiet = square <= _MAX_NOISE_RATIO * variance + allowed
    if not quiet.any():
        return np.asarray(quiet)
    # A flank may look like a plane, but stands out from the beam's slow differences.
    away = np.abs(means - np.median(means[quiet]))
    spread = NORMAL_MAD * float(np.median(away[quiet]))
    return np.asarray(quiet & (away <= _MAX_DEVIATIONS * spread))


_CLIPPED_AT = 4.0  # in standard deviations of normal noise
_DEVIATIONS = 5.0
_BINS, _SAMPLES = 24, 20_000  # of brightness, and the pixels that are looked at

_LAGS_PX = (1, 2, 3, 4, 6, 8, 12)
_TILE_PX, _SMALL_TILE_PX = 16, 10
_MIN_SIDE_PX = 92  # of an image with large tiles
_MAX_TILES = 20  # along each axis
_MIN_TILES = 5
_QUIET_SHARE = 0.3  # of the tiles, those with the least structure around them
_RISE_LAG_PX = 3
_MIN_RISE, _RISE_DEVIATIONS = 1.2, 0.8  # of V(3) over V(1): least, and in 1/√(tiles)
_LOW_QUANTILE = 0.25  # of the quiet tiles: noise is correlated in nearly all of them
_MAX_UNEVENNESS = 0.25  # of its logarithm between tiles: noise has 0.15, structure 0.4 and more
_MIN_DEVIATION = 1e-4  # of the brightness; below are the smooth flanks of noiseless images
_MAX_PLATEAU_RISE = 1.35  # of V at the largest lag over the one before
_MIN_CORRELATION = 0.05
_CLIP_DEVIATIONS = 5.0

_MIN_FAR_TILES = 12
_MIN_FAR_RISE = 1.4  # of V at the largest lag over V(1), in most of the quiet tiles
_MAX_FAR_UNEVENNESS = 0.62  # of its logarithm between tiles: noise has up to 0.6, structure 0.64
_MAX_FAR_SPREAD = 0.85  # of the logarithm of V: noise has up to 0.75, structure 1 and more
# White noise on pixels has waves up to 3.51 rad/px, averaged over directions of its logarithm;
# a Gaussian blur of standard deviation b ends them at exp(-γ/2) / b.
_GRAIN_PER_BLUR = 3.51 / math.exp(-0.5772 / 2)


class ImageNoise:
    """Noise of an image, and of its source, as shares of the source's mean.

    It is correlated as by a Gaussian blur of a stated width, px, or as measured.

    Attributes
    ----------
    largest, typical : float
        Standard deviation of a pixel with hot pixels and the finest structure, and without.
    clumping : float
        Variance of the sum of many pixels over the sum of their variances; 1 for white noise.
    correlation_length : float
        Standard deviation of the Gaussian blur that clumps white noise as much, px; 0 for white
        noise.
    variance_terms : ndarray, shape (3,)
        Terms of a pixel's variance: constant, in proportion to its brightness, and to its square.
    is_correlated_far : bool
        Whether calm parts vary over more pixels than a correlation can be measured: all of the
        above is then too small.
    """

    def __init__(
        self,
        prepared: Prepared,
        options: InversionOptions | None = None,
        correlation: float | None = None,
    ) -> None:
        image, mask = prepared.image, prepared.mask  # in units of `prepared.unit`
        self.shape = mask.shape[0], mask.shape[1]
        mean = prepared.source[mask].mean()
        excess = (image - prepared.source) / mean
        used = mask[1:, 1:] & mask[1:, :-1] & mask[:-1, 1:] & mask[:-1, :-1]
        differences = finest_differences(excess, used)
        self.is_correlated_far = False
        if correlation is not None:
            inflation, self.clumping = _stated_correlation(excess, mask, correlation)
        elif (tiles := _Tiles.of(excess, mask)) is None:
            inflation = self.clumping = 1.0
        else:
            inflation, self.clumping = _correlation(tiles)
            self.is_correlated_far = self.clumping == 1 and _is_correlated_far(tiles)
        self.largest = _rms(differences) * math.sqrt(inflation)
        self.typical = _clipped_rms(differences) * math.sqrt(inflation)
        # The source's mean, in units of the recorded image.
        quantum = prepared.flux_scale * prepared.unit * mean
        self.variance_terms = np.zeros(3)
        level, counts = (
            (None, None) if options is None else (options.noise_level, options.units_per_quantum)
        )
        if level is not None:
            self.variance_terms[0] = (level / quantum) ** 2
        elif counts is not None:
            self.variance_terms[1] = counts / quantum
            self.clumping = 1.0  # a blur leaves the counting noise of many pixels as it was
            self.is_correlated_far = False
        elif used.any():
            step = -(-len(differences) // _SAMPLES)
            places = np.arange(0, used.size, step)
            if not used.all():
                places = np.flatnonzero(used)[::step]
            rows, columns = np.unravel_index(places, used.shape)
            low, right = rows + 1, columns + 1
            bright = image[low, right] + image[low, columns] + image[rows, right]
            bright = (bright + image[rows, columns]) / (4 * mean)
            self.variance_terms = inflation * _terms(bright, differences[::step])
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


def finest_differences(values: FloatArray, used: BoolArray) -> FloatArray:
    """Return |a - b - c + d| / 2 of four neighbours each, of those that are all used."""
    if not used.any():
        return np.zeros(1)
    finest = values[1:, 1:] - values[1:, :-1]
    finest -= values[:-1, 1:]
    finest += values[:-1, :-1]
    finest /= 2
    np.abs(finest, out=finest)
    return finest.ravel() if used.all() else finest[used]


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _clipped_rms(differences: FloatArray) -> float:
    """Return the standard deviation, with differences clipped that noise does not explain."""
    limit = _CLIPPED_AT * NORMAL_MAD * float(np.median(differences))
    return _rms(np.minimum(differences, limit)) if limit > 0 else _rms(differences)


@dataclass(frozen=True, eq=False)
class _Tiles:
    """Tiles of an image on a grid, each with the pixels at a lag; not all are used."""

    values: FloatArray
    used: BoolArray
    side: int
    lag: int

    @classmethod
    def of(cls, excess: FloatArray, mask: BoolArray, lag: int | None = None) -> _Tiles | None:
        """Cut an image into tiles; None if it has too few."""
        side = _TILE_PX if min(excess.shape) >= _MIN_SIDE_PX else _SMALL_TILE_PX
        if lag is None:
            lag = max(known for known in _LAGS_PX if known < side)
        size = side + lag
        if _MIN_TILES * side + lag > min(excess.shape):
            return None
        steps = [max(side, -(-(n - size) // _MAX_TILES)) for n in excess.shape]
        places = np.s_[:: steps[0], :: steps[1]]
        values = sliding_window_view(excess, (size, size))[places]
        used = sliding_window_view(mask, (size, size))[places].all(axis=(2, 3))
        return cls(values, np.asarray(used), side, lag)

    @cached_property
    def quiet(self) -> FloatArray:
        """Tiles with the least structure around them, without hot pixels."""
        tiles = _without_hot_pixels(self.values)
        finest = _difference_variance(tiles, self.side, 1)
        used = self.used & (finest > 0)
        far = _difference_variance(tiles, self.side, self.lag)
        around = _average_neighbours(np.where(used, far / np.where(used, finest, 1.0), 1.0))
        return tiles[used & (around <= np.quantile(around, _QUIET_SHARE))]


def _correlation(tiles: _Tiles) -> tuple[float, float]:
    """Return the variance of a pixel relative to the finest differences, and the clumping."""
    side, lags = tiles.side, [lag for lag in _LAGS_PX if lag <= tiles.lag]
    finest = _difference_variance(tiles.values, side, 1)
    rising = _difference_variance(tiles.values, side, _RISE_LAG_PX) > _MIN_RISE * finest
    if (tiles.used & (finest > 0) & rising).mean() < _QUIET_SHARE * (1 - _LOW_QUANTILE):
        return 1.0, 1.0
    quiet = tiles.quiet
    count = len(quiet)
    if count < _MIN_TILES:
        return 1.0, 1.0
    finest = _difference_variance(quiet, side, 1)
    rise = _difference_variance(quiet, side, _RISE_LAG_PX) / np.maximum(finest, 1e-300)
    least = max(_MIN_RISE, 1 + _RISE_DEVIATIONS / math.sqrt(count))
    if np.quantile(rise, _LOW_QUANTILE) < least or np.log(rise).std() > _MAX_UNEVENNESS:
        return 1.0, 1.0
    variances = [_difference_variance(quiet, side, lag) for lag in lags]
    ratios = np.array([np.median(variance / finest) for variance in variances])
    if ratios[-1] > _MAX_PLATEAU_RISE * ratios[-2]:
        return 1.0, 1.0  # structure, which grows with the distance
    if np.median(variances[-1]) < _MIN_DEVIATION**2:
        return 1.0, 1.0
    inflation = float(ratios[-2:].mean())
    correlation = 1 - np.sqrt(np.minimum(ratios / inflation, 1.0))
    ends = np.flatnonzero(correlation < _MIN_CORRELATION)
    correlation[ends[0] if ends.size else len(lags) :] = 0.0
    steps = np.arange(lags[-1] + 1)
    along_axis = np.interp(steps, [0, *lags], [1.0, *correlation])
    return inflation, float((2 * along_axis.sum() - 1) ** 2)


def _stated_correlation(excess: FloatArray, mask: BoolArray, width: float) -> tuple[float, float]:
    """Return the same where the noise is correlated as by a Gaussian blur of a width, px."""
    clumping = 4 * math.pi * width**2
    if clumping <= 1:
        return 1.0, 1.0
    # The nearest pixels hardly differ: the noise is measured where they are nearly independent.
    lag = min(math.ceil(2 * width), _LAGS_PX[-1])
    near, far = ((1 - math.exp(-((d / width) ** 2) / 4)) ** 2 for d in (1, lag))
    tiles = _Tiles.of(excess, mask, lag)
    if tiles is None or len(tiles.quiet) < _MIN_TILES:
        return 1 / near, clumping
    far_variance, finest = (_difference_variance(tiles.quiet, tiles.side, d) for d in (lag, 1))
    ratio = far_variance / finest
    return float(np.median(ratio)) / far, clumping


def _is_correlated_far(tiles: _Tiles) -> bool:
    """Whether tiles vary over many pixels, all of them alike, as noise does and structure not."""
    if tiles.side < _TILE_PX or len(tiles.quiet) < _MIN_FAR_TILES:
        return False
    far = _difference_variance(tiles.quiet, tiles.side, tiles.lag)
    rise = far / _difference_variance(tiles.quiet, tiles.side, 1)
    return bool(
        np.quantile(rise, _LOW_QUANTILE) > _MIN_FAR_RISE
        and np.log(rise).std() < _MAX_FAR_UNEVENNESS
        and np.log(far).std() < _MAX_FAR_SPREAD
        and np.median(far) > _MIN_DEVIATION**2
    )


def _without_hot_pixels(tiles: FloatArray) -> FloatArray:
    """Clip each tile about its median."""
    middle = np.median(tiles[..., ::2, ::2], axis=(2, 3), keepdims=True)
    spread = np.median(np.abs(tiles[..., ::2, ::2] - middle), axis=(2, 3), keepdims=True)
    limit = _CLIP_DEVIATIONS * NORMAL_MAD * spread
    return np.clip(tiles, middle - limit, middle + limit)


def _difference_variance(tiles: FloatArray, side: int, lag: int) -> FloatArray:
    """Return the mean square of (a - b - c + d) / 2 over pixels at a lag, for each tile."""
    near, far = slice(0, side), slice(lag, side + lag)
    down = tiles[..., near, :] - tiles[..., far, :]
    return np.asarray(((down[..., near] - down[..., far]) ** 2).mean(axis=(-2, -1)) / 4)


def _average_neighbours(values: FloatArray) -> FloatArray:
    """Average tiles with their neighbours, so that noise hardly affects the choice of tiles."""
    cross = ndimage.generate_binary_structure(2, 1).astype(np.float64)
    sums, counts = (ndimage.convolve(v, cross, mode="constant") for v in (values, values**0))
    return np.asarray(sums / counts)


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
