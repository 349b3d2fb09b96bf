"""Solenoidal random fields on a 3-D grid, and their line integrals."""

from __future__ import annotations

import numpy as np


def solenoidal_field(side: int, slope: float, ends: tuple[float, float], seed: int) -> np.ndarray:
    """Return B of shape (3, side, side, side), components and axes in order (y, x, z).

    Its energy spectrum is ∝ k^slope between two numbers of waves in the box.
    """
    rng = np.random.default_rng(seed)
    numbers = np.fft.fftfreq(side, 1 / side)
    k = np.stack(np.meshgrid(numbers, numbers, np.fft.rfftfreq(side, 1 / side), indexing="ij"))
    size = np.sqrt((k**2).sum(axis=0))
    # Of E ∝ k^s each of 4πk² modes has k^(s - 2).
    inside = (size >= ends[0]) & (size <= ends[1])
    amplitude = np.where(inside, np.maximum(size, 1.0) ** (slope / 2 - 1), 0.0)
    waves = np.fft.rfftn(rng.normal(size=(3, side, side, side)), axes=(1, 2, 3)) * amplitude
    along = (k * waves).sum(axis=0) / np.maximum(size, 1.0) ** 2
    return np.fft.irfftn(waves - k * along, s=(side,) * 3, axes=(1, 2, 3))
