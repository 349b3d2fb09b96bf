"""Tests of residuals: of noise whose statistics are known, and of structure added to it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.fitting.pattern import (
    blur_score,
    correlation_length,
    lack_of_noise,
    noise_amplification,
    pattern_strength,
)


def noise(seed: int, side: int = 96, width: float = 0.0) -> FloatArray:
    """Noise of unit r.m.s., blurred by a Gaussian."""
    values = np.random.default_rng(seed).normal(size=(side, side))
    values = gaussian_filter(values, width, mode="wrap") if width else values
    return np.asarray(values / values.std())


def everywhere(side: int = 96) -> BoolArray:
    return np.ones((side, side), bool)


def holed(side: int = 96) -> BoolArray:
    used = everywhere(side)
    used[20:60, 30:80] = False
    used[:, :10] = False
    return used


@pytest.mark.parametrize("used", [everywhere(), holed()], ids=["all", "mask"])
def test_pattern_strength_of_white_noise_is_about_zero(used: BoolArray) -> None:
    strengths = [pattern_strength(noise(seed), used) for seed in range(40)]
    assert abs(np.mean(strengths)) < 1.0
    assert max(strengths) < 5.0


@pytest.mark.parametrize("used", [everywhere(), holed()], ids=["all", "mask"])
def test_pattern_strength_grows_with_a_smooth_wave(used: BoolArray) -> None:
    y, x = np.indices((96, 96))
    wave = np.cos(2 * np.pi * y / 48) * np.cos(2 * np.pi * x / 48)
    weak, strong = (pattern_strength(noise(3) + a * wave, used) for a in (0.4, 0.8))
    assert weak > 8
    # Its power is that of the amplitude squared.
    assert strong / weak == pytest.approx(4, rel=0.35)


def test_pattern_strength_does_not_depend_on_the_noise_level() -> None:
    values = noise(1) + 0.3 * noise(2, width=6)
    reference = pattern_strength(values, everywhere())
    assert pattern_strength(1.3 * values, everywhere()) == pytest.approx(reference)


def test_pattern_strength_of_nothing_is_zero() -> None:
    assert pattern_strength(np.zeros((48, 48)), everywhere(48)) == 0.0


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_correlation_length_is_the_width_of_the_blur(width: float) -> None:
    assert correlation_length(noise(5, 128, width), everywhere(128)) == pytest.approx(
        width, rel=0.1
    )


@pytest.mark.parametrize("seed", range(4))
def test_correlation_length_of_white_noise_is_zero(seed: int) -> None:
    """Neither a smooth wave nor a bright line is taken for correlated noise."""
    _, x = np.indices((64, 64))
    values = noise(seed, 64) + 0.4 * np.cos(x / 8)
    values[30:33] += 5
    assert correlation_length(values, everywhere(64)) == 0.0


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_pattern_strength_allows_for_correlated_noise(width: float) -> None:
    values = noise(7, 128, width)
    assert pattern_strength(values, everywhere(128)) > 20
    assert pattern_strength(values, everywhere(128), width) < 3


@pytest.mark.parametrize("width", [1.0, 2.0])
def test_noise_amplification_is_that_of_means_over_squares(width: float) -> None:
    """The standard deviation of a mean over many pixels, against that of white noise."""
    means = [noise(seed, 128, width)[32:96, 32:96].mean() for seed in range(200)]
    assert np.std(means) * 64 == pytest.approx(noise_amplification(width), rel=0.2)


@pytest.mark.parametrize("used", [everywhere(), holed()], ids=["all", "mask"])
def test_lack_of_noise_is_that_of_the_variance(used: BoolArray) -> None:
    stack, masks = np.stack([noise(1), noise(2)]), np.stack([used, used])
    lack, deviation = lack_of_noise(stack, masks)
    assert abs(lack) < 4 * deviation < 0.06
    less, _ = lack_of_noise(np.sqrt(0.8) * stack, masks)
    assert 1 - less == pytest.approx(0.8 * (1 - lack))
    # Masked values do not count.
    assert lack_of_noise(np.where(masks, stack, 1e6), masks) == (lack, deviation)


def test_lack_of_noise_ignores_smooth_noise_that_a_fit_absorbs() -> None:
    stack, used = np.stack([noise(1), noise(2)]), np.stack([everywhere()] * 2)
    rough = stack - gaussian_filter(stack, (0, 4, 4))
    lack, deviation = lack_of_noise(rough, used)
    assert abs(lack - lack_of_noise(stack, used)[0]) < deviation


def test_blur_score_finds_blur_and_ignores_noise() -> None:
    y, x = np.indices((64, 64)) - 31.5
    sharp = 1 + np.exp(-(y**2 + x**2) / 2 / 3**2)
    blurred = gaussian_filter(sharp, 1.0)
    roots = np.full((1, 64, 64), 20.0)
    white = noise(4, 64)[None]
    assert blur_score(roots * (blurred - sharp) + white, roots, sharp[None]) > 5
    assert abs(blur_score(white, roots, sharp[None])) < 3
    assert blur_score(-roots * (blurred - sharp), roots, sharp[None]) < 0
