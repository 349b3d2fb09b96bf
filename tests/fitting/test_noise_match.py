"""Fits of images whose noise is not that of single pixels, made without the package."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from helpers.fit_images import bump, counted, distance, on_pixels, together
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import Verdict
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.options import FitOptions
from napari_shadowinv.shot import shots_of

SIZE = (64, 64)
COUNTS = 200
OBJECT = together(bump(0.4, 8, (30, 34)), bump(-0.3, 6, (42, 20)))
OPTIONS = FitOptions(samples=6, threads=1)


@pytest.fixture(scope="module")
def clean() -> FloatArray:
    return counted(OBJECT, SIZE)


def share_off(result: Fit) -> float:
    """Error of the field over the stated one."""
    assert result.total_error is not None
    return distance(result.fields[0].displacement, on_pixels(OBJECT, SIZE)) / result.total_error


def test_correlated_noise_widens_the_bars_of_one_image(clean: FloatArray) -> None:
    noise = np.random.default_rng(3).normal(0, 0.1, SIZE)
    image = clean + gaussian_filter(noise, 2.0, mode="wrap")
    result = fit(shots_of(image, source=np.ones(SIZE)), options=OPTIONS)
    assert share_off(result) < 2
    assert result.verdict is not Verdict.MISFIT


def test_smoothed_counts_are_no_misfit(clean: FloatArray) -> None:
    counts = np.random.default_rng(4).poisson(COUNTS * clean).astype(float)
    image, source = gaussian_filter(counts, 0.8), np.full(SIZE, float(COUNTS))
    result = fit(shots_of(image, source=source, noise="poisson", psf=0.8), options=OPTIONS)
    assert result.verdict is Verdict.DETERMINED
    assert 0.5 < share_off(result) < 2


def test_noise_that_is_stated_too_large_is_used_smaller(clean: FloatArray) -> None:
    image = clean + np.random.default_rng(5).normal(0, 0.05, SIZE)
    result = fit(
        shots_of(image, source=np.ones(SIZE), noise=0.2),
        options=OPTIONS,
        instrument={"background": 0.001},  # of an assumed one, the errors are larger
    )
    assert result.verdict is Verdict.DETERMINED
    assert "the noise was stated 4." in result.explanation
    assert result.noise == pytest.approx(0.05, rel=0.15)
    assert 0.5 < share_off(result) < 2


def test_the_noise_of_a_reference_is_no_misfit(clean: FloatArray) -> None:
    rng = np.random.default_rng(6)
    image, reference = rng.poisson(4 * COUNTS * clean), rng.poisson(4 * COUNTS, SIZE)
    for noise in (None, "poisson"):
        result = fit(
            shots_of(image.astype(float), source=reference.astype(float), noise=noise),
            options=OPTIONS,
            instrument={"beam_rms": 0},
        )
        assert result.verdict is Verdict.DETERMINED
        assert result.chi2 == pytest.approx(1, abs=0.3)
        assert share_off(result) < 2


def test_a_fit_does_not_follow_the_noise_of_a_reference() -> None:
    rng, hill = np.random.default_rng(7), bump(0.8, 7, (33, 30))
    y, x = (np.indices(SIZE) - 31.5) / 32
    beam = 150 * np.exp(-0.3 * (x**2 + y**2))
    image, reference = rng.poisson(beam * counted(hill, SIZE)), rng.poisson(beam)
    errors = []
    for source in (reference.astype(float), beam):
        result = fit(
            shots_of(image.astype(float), source=source), options=FitOptions(samples=0, threads=1)
        )
        assert result.chi2 == pytest.approx(1, abs=0.3)
        errors.append(distance(result.fields[0].displacement, on_pixels(hill, SIZE)))
    assert errors[0] < 1.5 * errors[1]


def test_a_beam_of_fine_structure_is_taken_as_it_is() -> None:
    speckles = np.exp(0.2 * gaussian_filter(np.random.default_rng(8).normal(size=SIZE), 1.5) * 5)
    result = fit(
        shots_of(speckles * counted(OBJECT, SIZE), source=speckles, noise=0.01),
        options=FitOptions(samples=0, threads=1),
    )
    np.testing.assert_allclose(
        result.source[0] / result.source[0].mean(), speckles / speckles.mean()
    )
