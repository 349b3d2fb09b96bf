"""The beam of a shot against its source, where there is no object: `beam_difference`.

A reference of another exposure, or a beam that is less flat than assumed, differs from the beam of
the shot on large scales. An object has finer structure. The frame along the image's edge is divided
into tiles an eighth of the shorter side wide; in tiles without an object the ratio of image to
source is a plane plus noise, and its differences between such tiles are differences of the beams.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from napari_shadowinv.inversion.noise import ImageNoise
    from napari_shadowinv.inversion.normalise import Prepared

__all__ = ["beam_difference"]

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


def beam_difference(prepared: Prepared, noise: ImageNoise) -> float:
    """Return the r.m.s. relative difference of image and source outside the object.

    Parameters
    ----------
    prepared : Prepared
        Image and source in units of the source's power of two.
    noise : ImageNoise
        Noise of that image; differences that it explains do not count.

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
    limit = count - 1 + _SIGNIFICANCE * np.sqrt(2.0 * count)
    if (deviation**2).sum() < limit * by_noise.mean():
        return 0.0
    square = (deviation**2).sum() / (count - 1) - by_noise.mean()
    difference = float(np.sqrt(max(square, 0.0)))
    return difference if difference > _MIN_DIFFERENCE else 0.0


def _cell_ratios(
    prepared: Prepared, noise: ImageNoise, cell: int, rows: int, columns: int
) -> tuple[FloatArray, FloatArray]:
    """Return image over source and its variance by noise, shape (rows, columns, 4, 4)."""

    def sums(values: FloatArray | BoolArray) -> FloatArray:
        side = cell * _CELLS
        inner = values[: rows * side, : columns * side]
        cells = inner.reshape(rows, _CELLS, cell, columns, _CELLS, cell).sum(axis=(2, 5))
        return np.asarray(np.moveaxis(cells, 2, 1), dtype=np.float64)

    image, source, count = (sums(v) for v in (prepared.image, prepared.source, prepared.mask))
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
    spread = 1.4826 * float(np.nanmedian(np.abs(means - 1)))
    allowed = max(_MAX_CURVATURE * spread, _MIN_CURVATURE) ** 2
    quiet = square <= _MAX_NOISE_RATIO * variance + allowed
    if not quiet.any():
        return np.asarray(quiet)
    # A flank may look like a plane, but stands out from the beam's slow differences.
    away = np.abs(means - np.median(means[quiet]))
    spread = 1.4826 * float(np.median(away[quiet]))
    return np.asarray(quiet & (away <= _MAX_DEVIATIONS * spread))
