"""Filaments: size, spacing and direction from the autocorrelation of the field."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.exact_fields import SETUP
from napari_shadowinv import invert, synthetic_image
from napari_shadowinv.analysis import Filaments, analyse
from napari_shadowinv.analysis.filaments import _next_maximum, field_autocorrelation
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field

SIDE = 160
PIXEL = SETUP.object_pixel_size
NUMBERS = ("radius", "spacing", "rms", "peak")


def filaments(places, angle, radius, length, strength=3.0):
    """Return potential and displacement of Gaussian filaments through points (y, x)."""
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2.0
    sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    potential, down, right = np.zeros((3, SIDE, SIDE))
    for y0, x0 in places:
        along = (x - x0) * cosine + (y - y0) * sine
        across = (y - y0) * cosine - (x - x0) * sine
        part = strength * np.exp(-(across**2) / (2 * radius**2) - along**2 / (2 * length**2))
        potential += part
        down += part * (across * cosine / radius**2 + along * sine / length**2)
        right += part * (-across * sine / radius**2 + along * cosine / length**2)
    return potential, np.stack([down, right])


def measured(potential, displacement, **choices):
    result = RetrievedField(dataset_from_field(displacement, potential, SETUP))
    (product,) = analyse(result, Filaments(**choices))
    return product


def in_pixels(product, name):
    return float(product[name].value) / PIXEL


@pytest.mark.parametrize(("radius", "angle"), [(4.0, 25.0), (5.0, -70.0)])
def test_random_filaments_have_their_size_and_direction_but_no_spacing(radius, angle):
    radii = []
    for seed in range(4):
        places = np.random.default_rng(seed).uniform(-90, 90, (60, 2))
        product = measured(*filaments(places, angle, radius, 30.0))
        radii.append(in_pixels(product, "radius"))
        assert product.product.angle == pytest.approx(angle, abs=4)
        assert float(product["elongation"].value) > 2
        assert np.isnan(product["spacing"].value)
        texts = {fact.key: fact.text for fact in product.facts}
        assert (texts["spacing"], texts["order"]) == ("none", "none")
        assert "autocorrelation" not in texts
    assert np.mean(radii) == pytest.approx(radius, rel=0.1)


@pytest.mark.parametrize("spacing", [22.0, 30.0])
def test_regular_filaments_have_their_spacing_and_size(spacing):
    normal = np.array([np.cos(np.radians(20)), -np.sin(np.radians(20))])
    places = [number * spacing * normal for number in range(-6, 7)]
    product = measured(*filaments(places, 20.0, 4.0, 300.0))
    assert in_pixels(product, "spacing") == pytest.approx(spacing, rel=0.02)
    assert in_pixels(product, "radius") == pytest.approx(4.0, rel=0.05)
    assert float(product["order"].value) > 0.8


def test_spacing_is_that_of_the_field_and_not_of_bright_lines():
    # Each strong filament gathers rays into two caustics, so lines are closer than filaments.
    places = [(number * 30.0, 0.0) for number in range(-4, 5)]
    potential, displacement = filaments(places, 0.0, 4.0, 1e4, strength=-45.0)
    product = measured(potential, displacement)
    assert in_pixels(product, "spacing") == pytest.approx(30.0, rel=0.02)
    image = synthetic_image(displacement)
    column = image[20:-20, SIDE // 2]
    bright = (column[1:-1] > column[:-2]) & (column[1:-1] >= column[2:]) & (column[1:-1] > 1.5)
    assert bright.sum() > 1.5 * len(column) / 30.0


def test_merging_filaments_and_blobs_are_warned_of():
    texts = []
    for places, radius, length in (
        ([(number * 12.0, 0.0) for number in range(-9, 10)], 4.0, 1e4),
        (np.random.default_rng(0).uniform(-80, 80, (50, 2)), 5.0, 5.0),
    ):
        product = measured(*filaments(places, 0.0, radius, length))
        texts.append(" ".join(fact.text for fact in product.facts))
    assert "lower limit" in texts[0]
    assert "blobs rather than filaments" in texts[1] or "times as long as wide" in texts[1]


def test_strength_is_that_of_the_field():
    potential, displacement = filaments([(0.0, 0.0)], 0.0, 8.0, 1e4)
    product = measured(potential, displacement, angle=0)
    field = np.hypot(*SETUP.path_integrated_b(displacement))
    assert float(product["rms"].value) == pytest.approx(np.sqrt((field**2).mean()))
    assert float(product["peak"].value) == pytest.approx(np.percentile(field, 99))
    assert product.variables["rms"].unit == "T m"


def test_thin_filaments_are_measured_without_the_error_of_pixels():
    # Radius 3 px: central differences and means over pixels take 5 % of the strength.
    potential, displacement = filaments([(y, 0.0) for y in range(-60, 61, 12)], 0.0, 3.0, 40.0)
    exact = np.array([measured(potential, displacement)[name].value for name in NUMBERS])
    image = synthetic_image(displacement)
    source = np.full(image.shape, 100.0)
    (clean,) = analyse(invert(100 * image, source=source), Filaments(), setup=SETUP, samples=20)
    np.testing.assert_allclose([clean[name].value for name in NUMBERS], exact, rtol=0.015)
    noisy_image = np.random.default_rng(1).poisson(100 * image).astype(float)
    (noisy,) = analyse(invert(noisy_image, source=source), Filaments(), setup=SETUP)
    for name, value in zip(NUMBERS, exact, strict=True):
        quantity = noisy[name]
        corrected = float(quantity.value - quantity.bias)
        assert abs(corrected - value) < 2.5 * float(quantity.std) < 0.1 * value


def test_spacing_is_exact_for_a_smooth_maximum():
    lags = np.arange(0.0, 40.0, 0.25)
    correlation = np.cos(2 * np.pi * lags / 11.1) * np.exp(-lags / 200)
    spacing, order = _next_maximum(correlation, lags, 0.5)
    assert spacing == pytest.approx(11.1, rel=2e-3)
    assert order == pytest.approx(np.exp(-11.1 / 200), rel=2e-3)


def test_a_higher_second_maximum_is_twice_the_spacing():
    lags = np.arange(0.0, 40.0, 0.25)
    envelope = np.exp(-0.5 * ((lags - 24) / 4) ** 2) + 0.2 + (lags < 1)
    correlation = np.cos(2 * np.pi * lags / 12) * envelope
    spacing, order = _next_maximum(correlation, lags, 0.5)
    assert spacing == pytest.approx(12, rel=0.05)
    assert order < 0.5


def test_a_spacing_that_samples_do_not_confirm_is_not_stated():
    quantities = {
        name: Quantity(np.asarray(1.0), np.ones(100)) for name in ("spacing", "order", "radius")
    }
    samples = np.where(np.arange(100) < 15, 2.0, 1.0)
    refined = Filaments().refine(quantities | {"spacing": Quantity(np.asarray(1.0), samples)})
    assert np.isnan(refined["spacing"].value)
    assert np.isnan(refined["order"].value)
    assert refined["radius"].value == 1
    few = np.where(np.arange(100) < 5, np.nan, 1.01)
    refined = Filaments().refine(quantities | {"spacing": Quantity(np.asarray(1.0), few)})
    assert refined["spacing"].value == 1
    np.testing.assert_allclose(refined["spacing"].band(), 0.99)


def test_autocorrelation_ignores_masked_pixels():
    rng = np.random.default_rng(2)
    component = np.sin(2 * np.pi * np.arange(100) / 20)[:, None] * np.ones((1, 80))
    weights = np.ones((100, 80))
    weights[30:50, 20:60] = 0
    spoiled = np.where(weights > 0, component, rng.normal(0, 50, component.shape))
    correlation = field_autocorrelation(spoiled, weights)
    middle = correlation.shape[0] // 2, correlation.shape[1] // 2
    assert correlation[middle] == pytest.approx(1.0)
    assert correlation[middle[0] + 20, middle[1]] == pytest.approx(1.0, abs=0.06)
    assert correlation[middle[0] + 10, middle[1]] == pytest.approx(-1.0, abs=0.06)


def test_filaments_of_no_field_are_refused():
    with pytest.raises(InputError, match="zero everywhere"):
        measured(np.zeros((SIDE, SIDE)), np.zeros((2, SIDE, SIDE)))
