"""The paper's toroid by its formula, and its images by counting rays; no code of the package.

14.7 MeV protons, σ = 30 µm, 1.3 mm from source to object, 2 cm to the detector, 200×200 pixels
of 1.5 µm in the object plane, uniform source of 1. The momentum is √(2 m W).
"""

from __future__ import annotations

from functools import cache

import numpy as np

from napari_shadowinv._typing import FloatArray

_SIDE = 200
_SIGMA_PX = 20.0
_RAYS = 16  # per pixel along each axis
_CHARGE_C, _MASS_KG = 1.602176634e-19, 1.67262192e-27
_MOMENTUM = np.sqrt(2 * _MASS_KG * 14.7e6 * _CHARGE_C)
_LENGTH_M = 2e-2 / (1 + 2e-2 / 1.3e-3)  # from deflection to displacement in the object plane


def _displacement(y: FloatArray, x: FloatArray, peak: float) -> tuple[FloatArray, FloatArray]:
    """Return the displacement in px at a place relative to the centre, for a peak in MG µm."""
    shift = peak * 1e-4 * _CHARGE_C / _MOMENTUM * _LENGTH_M / 1.5e-6  # 1 MG µm = 1e-4 T m
    factor = shift / _SIGMA_PX * np.exp(0.5 - (y**2 + x**2) / (2 * _SIGMA_PX**2))
    return y * factor, x * factor


@cache
def toroid_displacement(peak: float) -> FloatArray:
    """Return the displacement (2, 200, 200) at pixel centres, in px."""
    y, x = np.indices((_SIDE, _SIDE)) - (_SIDE - 1) / 2
    return np.stack(_displacement(y, x, peak))


@cache
def toroid_image(peak: float) -> FloatArray:
    """Return the image: 256 rays per pixel, each shared by the four pixels around its place.

    The sharing blurs by one pixel. Rays that leave count at the edge.
    """
    places = (np.arange(_SIDE * _RAYS) + 0.5) / _RAYS - _SIDE / 2
    image = np.zeros(_SIDE**2)
    for rows in places.reshape(_SIDE, _RAYS, 1):
        shift_y, shift_x = _displacement(rows, places[np.newaxis], peak)
        y, part_y = np.divmod(rows + shift_y + (_SIDE - 1) / 2, 1)
        x, part_x = np.divmod(places + shift_x + (_SIDE - 1) / 2, 1)
        for dy, dx in np.ndindex(2, 2):
            row, column = (np.clip(index, 0, _SIDE - 1).astype(int) for index in (y + dy, x + dx))
            share = (part_y if dy else 1 - part_y) * (part_x if dx else 1 - part_x)
            image += np.bincount((_SIDE * row + column).ravel(), share.ravel(), _SIDE**2)
    return image.reshape(_SIDE, _SIDE) / _RAYS**2


def noisy_toroid_image(peak: float) -> FloatArray:
    """Return the image with Gaussian noise of 10 % of the mean, not clipped."""
    return toroid_image(peak) + np.random.default_rng(1).normal(0, 0.1, (_SIDE, _SIDE))
