"""Maps of sources, their smoothing, and the contrast."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import constants
from scipy.ndimage import gaussian_filter

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import (
    ChargeDensity,
    Contrast,
    CurrentDensity,
    PhaseCurvature,
    analyse,
)
from napari_shadowinv.analysis.maps import chosen_width, smooth
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics.derivatives import laplacian
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import (
    Phantom,
    gaussian_blob,
    toroid,
)
from napari_shadowinv.physics.setup import OpticalSetup

PIXEL = SETUP.object_pixel_size


def offsets(side: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    return y, x


def test_current_density_of_a_toroid_is_that_of_its_formula():
    sigma, peak = 30e-6, 50e-4
    field = field_of(toroid((160, 160), SETUP, peak / 1e-4, sigma))
    (density,) = analyse(field, CurrentDensity(smoothing=3))
    y, x = offsets(160)
    square = (y**2 + x**2) * PIXEL**2 / sigma**2
    exact = -peak / sigma / constants.mu_0 * np.exp(0.5 - square / 2) * (2 - square)
    np.testing.assert_allclose(density["density"].value, exact, atol=3e-3 * abs(exact).max())
    assert density.variables["density"].unit == "A/m"


def test_charge_density_of_a_gaussian_is_that_of_its_formula():
    amplitude, sigma = 60.0, 15.0
    field = field_of(gaussian_blob((128, 128), amplitude, sigma))
    (density,) = analyse(field, ChargeDensity(smoothing=0), unit="V")
    y, x = offsets(128)
    square = (y**2 + x**2) / sigma**2
    divergence = amplitude / sigma**2 * np.exp(-square / 2) * (2 - square)  # of the displacement
    volts = SETUP.path_integrated_e([0.0, 1.0])[1]
    exact = constants.epsilon_0 * volts * divergence / PIXEL
    np.testing.assert_allclose(density["density"].value, exact, atol=1e-3 * abs(exact).max())


def test_curvature_of_a_phase_is_that_of_its_formula():
    radians, sigma, distance = -40.0, 13.0, 0.4
    light = OpticalSetup(wavelength=532e-9, object_image_distance=distance, pixel_size=8e-6)
    wave_number = 2 * np.pi / light.wavelength
    # A ray turns by the gradient of the phase over the wave number.
    per_px = distance / wave_number / light.pixel_size**2
    y, x = offsets(128)
    square = (y**2 + x**2) / sigma**2
    phase = radians * np.exp(-square / 2)
    displacement = -per_px * phase * np.stack([y, x]) / sigma**2
    field = RetrievedField(dataset_from_field(displacement, -per_px * phase, light))
    exact = phase * (square - 2) / (sigma * light.pixel_size) ** 2
    for unit in (None, "m", "m⁻²"):
        (curvature,) = analyse(field, PhaseCurvature(smoothing=0), unit=unit)
        np.testing.assert_allclose(
            curvature["curvature"].value, exact, atol=1e-3 * abs(exact).max()
        )
        assert curvature.variables["curvature"].unit == "rad/m²"
    protons = field_of(gaussian_blob((64, 64), 60.0, 9.0))
    for unit in (None, "rad"):
        with pytest.raises(InputError, match="phase curvature"):
            analyse(protons, PhaseCurvature(), unit=unit)


def test_laplacian_is_exact_for_polynomials_of_fifth_order():
    y, x = np.mgrid[:12, :14].astype(float)
    plane = x**5 + y**4 * x + y**2 * x**3
    exact = 20 * x**3 + 12 * y**2 * x + 2 * x**3 + 6 * y**2 * x
    np.testing.assert_allclose(laplacian(plane)[2:-2, 2:-2], exact[2:-2, 2:-2])


def test_smoothing_keeps_the_mean_and_large_waves():
    x = np.arange(120) + 0.5
    wave = 3 + np.cos(np.pi * 4 * x / 120) * np.ones((60, 1))
    smoothed = smooth(wave, 4.0)
    assert smoothed.mean() == pytest.approx(wave.mean())
    np.testing.assert_allclose(smoothed, wave, atol=1e-3)
    fine = np.cos(np.pi * 60 * x / 120) * np.ones((60, 1))  # 4 px
    assert abs(smooth(fine, 4.0)).max() < 1e-3


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.5])
def test_chosen_width_is_nearly_the_best(noise: float):
    y, x = offsets(96)
    truth = np.exp(-(y**2 + x**2) / (2 * 9.0**2))
    rng = np.random.default_rng(2)
    draws = gaussian_filter(rng.normal(size=(5, 96, 96)), (0, 0.7, 0.7))
    plane = truth + noise * draws[0]
    width = chosen_width(plane, noise * draws[1:], 1.0)

    def error(width: float) -> float:
        return float(np.linalg.norm(smooth(plane, width) - truth))

    best = min(map(error, np.geomspace(1, 20, 60)))
    assert error(width) < 1.15 * best


def test_smoothing_of_an_inversion_follows_its_noise(inversion: Inversion):
    (density,) = analyse(inversion, CurrentDensity(), setup=SETUP, samples=20)
    spacing = (64 * 64 / len(inversion.cells.sites)) ** 0.5
    assert density.product.smoothing >= 1.5 * spacing - 1e-3
    text = next(fact.text for fact in density.facts if fact.key == "smoothing")
    assert f"width {density.product.smoothing:.3g} px" in text


def test_weak_map_is_the_contrast_of_the_image():
    weak = toroid((64, 64), SETUP, 3.0, 12e-6)
    image = 1e6 * synthetic_image(weak.displacement)
    inversion = invert(image, source=np.full(image.shape, 1e6))
    (density,) = analyse(inversion, CurrentDensity(), setup=SETUP, samples=20)
    text = next(fact.text for fact in density.facts if fact.key == "linear")
    assert float(text.partition("differs from this map by ")[2].partition("%")[0]) < 10


def test_masked_pixels_do_not_count_in_the_largest_density():
    blob = gaussian_blob((60, 60), 30.0, 6.0)
    field = field_of(blob)
    values = field.dataset.displacement.values.copy()
    values[:, 20:40, 20:40] = np.nan
    dataset = field.dataset.assign(displacement=(field.dataset.displacement.dims, values))
    (whole,), (hidden,) = (
        analyse(RetrievedField(each), CurrentDensity(smoothing=1))
        for each in (field.dataset, dataset)
    )
    assert whole.facts[0].text != hidden.facts[0].text


def test_contrast_of_a_wave_is_that_of_its_formula():
    # A potential A cos(k x): r.m.s. displacement A k/√2, of the divergence A k²/√2.
    count, amplitude = 96, 8.0
    k = 2 * np.pi / 24
    x = np.arange(count) + 0.5
    potential = amplitude * np.cos(k * x) * np.ones((count, 1))
    field = field_of(Phantom(potential, np.zeros((2, count, count))))
    (contrast,) = analyse(field, Contrast(smoothing=0))
    # The border of 4 px leaves no whole number of waves.
    assert contrast["mu"].value == pytest.approx(amplitude * k**2 / np.sqrt(2), rel=0.06)
    assert contrast["scale"].value == pytest.approx(PIXEL / k, rel=0.06)
    assert contrast["compression"].value == pytest.approx(amplitude * k**2, rel=0.02)


@pytest.mark.parametrize(
    ("strength", "regime"), [(0.05, "linear"), (0.5, "injective"), (1.3, "caustic")]
)
def test_regime_follows_from_the_compression(strength: float, regime: str):
    # The potential of a blob is compressed by -A/σ² in its middle if A is negative.
    sigma = 9.0
    field = field_of(gaussian_blob((90, 90), -strength * sigma**2, sigma))
    (contrast,) = analyse(field, Contrast(smoothing=0))
    text = next(fact.text for fact in contrast.facts if fact.key == "regime")
    assert text.startswith({"injective": "nonlinear injective"}.get(regime, regime))


def test_a_long_object_is_diffusive():
    field = field_of(gaussian_blob((90, 90), -0.5 * 81, 9.0))
    (contrast,) = analyse(field, Contrast(smoothing=0, object_length=1.0))
    assert "rays cross inside the object" in str(contrast.facts)


def test_a_map_of_a_few_pixels_is_refused():
    field = field_of(gaussian_blob((9, 9), 1.0, 2.0))
    with pytest.raises(InputError, match="expected at least 12 px each way"):
        analyse(field, CurrentDensity())


def test_crossed_rays_of_an_inversion_are_the_caustic_regime():
    blob = gaussian_blob((64, 64), -1.6 * 64, 8.0)
    image = np.random.default_rng(0).poisson(300 * synthetic_image(blob.displacement))
    inversion = invert(image, source=np.full(image.shape, 300.0))
    assert "folds" in {caution.code for caution in inversion.cautions}
    (contrast,) = analyse(inversion, Contrast(), samples=20)
    assert contrast["compression"].value < 1
    assert "caustic: rays cross" in str(contrast.facts)
