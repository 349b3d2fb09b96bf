"""Noise of images in which an object fills the frame, against the noise that was added."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, zoom

from napari_shadowinv import invert
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.inversion.noise import CorrelatedNoise, measure_correlation

SIDE = 96


def spots(side: int = SIDE) -> FloatArray:
    """Nine bright and dark spots that fill the frame."""
    y, x = np.indices((side, side)) / side
    contrast = np.zeros((side, side))
    for i, j in np.ndindex(3, 3):
        square = (y - 0.25 - 0.25 * i) ** 2 + (x - 0.25 - 0.25 * j) ** 2
        contrast += (-1) ** (i + j) * np.exp(-square / (2 * 0.07**2))
    return 1 + 0.3 * contrast


def blurred(rng: np.random.Generator, width: float, side: int = SIDE) -> FloatArray:
    """White noise of deviation 1 after a blur."""
    margin = int(4 * width) + 1
    noise = gaussian_filter(rng.normal(size=(side + 2 * margin,) * 2), width)
    return noise[margin:-margin, margin:-margin]


def measure(image: FloatArray) -> CorrelatedNoise:
    return measure_correlation(image - 1, image, np.ones(image.shape, bool))


@pytest.mark.parametrize("width", [1.5, 2.0, 3.0])
def test_correlated_noise_is_seen_between_structures(width: float) -> None:
    """Its deviation before the blur, which is its power on long waves."""
    estimate = []
    for seed in range(8):
        image = spots() + 0.2 * blurred(np.random.default_rng(seed), width)
        estimate.append(measure(image).white_variance ** 0.5)
    assert np.median(estimate) == pytest.approx(0.2, rel=0.35)
    assert min(estimate) > 0.07


def waves(seed: int) -> FloatArray:
    """Counts of waves of an eighth to a third of the frame, in all directions."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((SIDE, SIDE))
    total = np.zeros((SIDE, SIDE))
    for _ in range(60):
        length, angle, phase = SIDE * rng.uniform(0.12, 0.4), *rng.uniform(0, 2 * np.pi, 2)
        along = np.cos(angle) * y + np.sin(angle) * x
        total += np.cos(2 * np.pi * along / length + phase)
    return rng.poisson(1000 * np.maximum(1 + 0.3 * total / total.std(), 0.1)) / 1000


def test_structure_that_fills_the_frame_is_no_difference_of_beams() -> None:
    """It grows with the distance, as blurred noise does not beyond its width."""
    for seed in (0, 2, 3, 4):
        image = waves(seed)
        estimate = measure(image)
        assert estimate.is_bound or estimate.clumping == 1
        errors = invert(image, source=np.ones(image.shape), options={"n_sites": 900}).errors
        assert errors is not None
        assert errors.beam is None
    quiet = [
        measure(spots() + 0.2 * blurred(np.random.default_rng(seed), width))
        for width in (1.0, 1.5, 2.0)
        for seed in range(4)
    ]
    assert np.mean([estimate.is_bound for estimate in quiet]) < 0.3


@pytest.mark.parametrize("factor", [1.4, 2.0])
def test_resampled_counts_are_not_white(factor: float) -> None:
    side = round(SIDE / factor)
    counts = np.random.default_rng(4).poisson(400 * spots(side)) / 400
    estimate = measure(zoom(counts, factor, order=3, mode="nearest", grid_mode=True))
    # Of each recorded pixel there are factor² now.
    assert estimate.white_variance**0.5 == pytest.approx(factor * 0.05, rel=0.5)


@pytest.mark.parametrize("level", [0.02, 0.1])
def test_white_noise_between_structures_stays_white(level: float) -> None:
    for seed in range(8):
        estimate = measure(spots() + level * np.random.default_rng(seed).normal(size=(SIDE, SIDE)))
        assert estimate.clumping == 1
        assert estimate.white**0.5 == pytest.approx(level, rel=0.2)


def test_structure_without_calm_parts_is_not_called_white_noise() -> None:
    y, x = np.indices((SIDE, SIDE))
    estimate = measure(1 + 0.3 * np.sin(y / 2) * np.sin(x / 2))
    assert estimate.is_bound
    assert estimate.white_variance**0.5 > 0.3


def test_an_image_without_a_whole_block_has_no_correlation_to_measure() -> None:
    rng = np.random.default_rng(4)
    excess = rng.normal(0, 0.1, (96, 96))
    noise = measure_correlation(excess, 1 + excess, rng.random((96, 96)) > 0.4, None)
    assert noise.variance == 0
    assert not noise.is_bound
