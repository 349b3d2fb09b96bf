"""Noise of images by differences of neighbouring pixels: `estimated_noise`."""

from __future__ import annotations

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray

NORMAL_MAD = 1.4826  # standard deviation over median absolute deviation, normal noise


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


def estimated_noise(image: FloatArray, used: BoolArray) -> float:
    """Return the standard deviation of an image's noise, from neighbouring pixels' differences."""
    all_used = used[1:, 1:] & used[1:, :-1] & used[:-1, 1:] & used[:-1, :-1]
    return float(NORMAL_MAD * np.median(finest_differences(image, all_used)))
