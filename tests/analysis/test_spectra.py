"""The spectrum of turbulence: conventions, power laws, noise and response."""

from __future__ import annotations

import math

import numpy as np
import pytest

from helpers.exact_fields import SETUP
from napari_shadowinv import OpticalSetup, invert, synthetic_image
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.analysis import TurbulenceSpectrum, analyse
from napari_shadowinv.analysis.power_spectra import (
    fit_exponent,
    random_displacement,
    ring_spectrum,
    window_weights,
)
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.options import Instrument

SIDE = 64
ENDS = 3.0, 28.0
PIXEL = SETUP.object_pixel_size


def all_of(side: int) -> np.ndarray:
    return np.ones((side, side), bool)


def potential_of(b: np.ndarray) -> np.ndarray:
    """Return the potential in px² whose displacement belongs to ∫B dz in T m, periodic."""
    displacement = SETUP.displacement_from_path_integrated_b(b)
    k_y, k_x = (2 * np.pi * np.fft.fftfreq(count) for count in b.shape[1:])
    square = k_y[:, None] ** 2 + k_x**2
    square[0, 0] = 1.0
    y, x = np.fft.fft2(displacement)
    return np.fft.ifft2(1j * (k_y[:, None] * y + k_x * x) / square).real


def field_of(potential: np.ndarray, displacement: np.ndarray, setup=SETUP) -> RetrievedField:
    return RetrievedField(dataset_from_field(displacement, potential, setup))


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


@pytest.fixture(scope="module")
def cubes() -> list[np.ndarray]:
    return [solenoidal_field(SIDE, -5 / 3, ENDS, seed) for seed in range(6)]


def test_line_integrals_of_turbulence_have_its_energy_spectrum(cubes):
    energies, true_energies = [], []
    for cube in cubes:
        b = cube[:2].sum(axis=3) * PIXEL  # ∫ dz over a box of 64 pixels
        result = field_of(potential_of(b), SETUP.displacement_from_path_integrated_b(b))
        product = TurbulenceSpectrum(path_length=SIDE * PIXEL, slope=False, taper=0.01)
        (spectrum,) = analyse(result, product)
        k = spectrum.coordinates["k"].values
        rings = slice(4, 24)
        energies.append(spectrum["energy"].value[rings].sum() * k[0])
        waves = np.abs(np.fft.fftn(cube, axes=(1, 2, 3))) ** 2 / SIDE**6
        numbers = np.fft.fftfreq(SIDE, 1 / SIDE)
        size = np.sqrt(sum(n**2 for n in np.meshgrid(numbers, numbers, numbers, indexing="ij")))
        shells = (size >= 4.5) & (size < 24.5)
        true_energies.append(0.5 * waves[:, shells].sum())
    assert np.mean(energies) == pytest.approx(np.mean(true_energies), rel=0.06)


def test_kolmogorov_turbulence_has_slopes_of_two_conventions(cubes):
    slopes, densities = [], []
    for cube in cubes:
        spectrum = ring_spectrum(
            potential_of(cube[:2].sum(axis=3)), window_weights(all_of(SIDE), 0.1)
        )
        rings = slice(4, 24)
        k, modes = spectrum.k[rings], spectrum.modes[rings]
        slopes.append(fit_exponent(k, spectrum.power[rings], modes))
        densities.append(fit_exponent(k, spectrum.power[rings] / (2 * np.pi * k), modes))
    assert np.mean(slopes) == pytest.approx(-8 / 3, abs=0.08)
    assert np.mean(densities) == pytest.approx(-11 / 3, abs=0.08)
    assert np.subtract(slopes, densities) == pytest.approx(1.0)


def test_ring_summed_power_adds_up_to_the_mean_square(cubes):
    b = cubes[0][:2].sum(axis=3)
    displacement = SETUP.displacement_from_path_integrated_b(b)
    # Without a window: the field is periodic, which the border of the Laplacian is not.
    spectrum = ring_spectrum(potential_of(b), window_weights(all_of(SIDE), 0.02))
    total = spectrum.power.sum() * spectrum.width
    assert total == pytest.approx((displacement**2).sum(axis=0).mean(), rel=0.05)


def test_random_displacement_is_the_gradient_with_its_mean_square():
    potential, displacement = random_displacement(
        lambda k: np.where((k > 0.1) & (k < 0.3), 5.0, 0.0), (128, 100), np.random.default_rng(0)
    )
    exact = 5.0 * math.pi * (0.3**2 - 0.1**2)  # the integral of the density
    assert (displacement**2).sum(axis=0).mean() == pytest.approx(exact, rel=0.1)
    down = np.gradient(potential, axis=0)[1:-1, 1:-1]
    np.testing.assert_allclose(-down, displacement[0, 1:-1, 1:-1], atol=0.06 * abs(down).max())


@pytest.mark.parametrize("exponent", [-4.67, -2.67, 0.5])
def test_exponent_of_noisy_rings_is_unbiased(exponent):
    rng = np.random.default_rng(1)
    k = np.arange(4.0, 40.0)
    modes = np.round(np.pi * k)
    fitted = [fit_exponent(k, k**exponent * rng.gamma(modes) / modes, modes) for _ in range(200)]
    centre = np.average(np.log(k), weights=modes)
    expected = 1 / np.sqrt(np.sum(modes * (np.log(k) - centre) ** 2))
    assert np.mean(fitted) == pytest.approx(exponent, abs=4 * expected / 200**0.5)
    assert np.std(fitted) == pytest.approx(expected, rel=0.2)


def test_steep_spectrum_does_not_leak_from_large_structures():
    side = 128
    k0 = 2 * np.pi / side
    slopes = []
    for seed in range(4):
        potential, _ = random_displacement(
            lambda k: np.where((k > 2 * k0) & (k < 40 * k0), (k / k0) ** (-11 / 3 - 2), 0.0),
            (200, 200),
            np.random.default_rng(seed),
        )
        spectrum = ring_spectrum(potential[:side, :side], window_weights(all_of(side), 0.125))
        rings = slice(5, 34)
        k, power, modes = spectrum.k[rings], spectrum.power[rings], spectrum.modes[rings]
        slopes.append(fit_exponent(k, k * power, modes))
    assert np.mean(slopes) == pytest.approx(-11 / 3, abs=0.1)


def turbulent_image(side: int, contrast: float, seed: int, slope: float = -5 / 3):
    """Return counts, and the potential inside the image of a field that goes on beyond it."""
    k0, size = 2 * np.pi / side, int(1.4 * side)
    potential, displacement = random_displacement(
        lambda k: np.where((k > 3.5 * k0) & (k < 0.12 * side * k0), (k / k0) ** (slope - 2), 0.0),
        (size, size),
        np.random.default_rng(seed),
    )
    divergence = sum(np.gradient(part, axis=axis) for axis, part in enumerate(displacement))
    strength = contrast / divergence.std()
    first = (size - side) // 2
    inner = np.s_[first : first + side, first : first + side]
    image = 250 * synthetic_image(strength * displacement)[inner]
    return np.random.default_rng(seed + 9).poisson(image), strength * potential[inner]


@pytest.fixture(scope="module")
def shot():
    counts, potential = turbulent_image(96, 0.6, 3)
    white = Instrument(noise_correlation=0)
    return invert(counts, source=np.full(counts.shape, 250.0), instrument=white), potential


def test_response_corrects_what_the_inversion_loses(shot):
    inversion, potential = shot
    product = TurbulenceSpectrum(longest=96 / 3.9, shortest=96 / 10.1, path_length=1e-4)
    (spectrum,) = analyse(inversion, product, setup=SETUP, samples=20)
    weights = window_weights(all_of(96), product.taper)
    true = ring_spectrum(potential, weights)
    rings = spectrum["trusted"].value > 0
    slope = fit_exponent(true.k[rings], true.k[rings] * true.power[rings], true.modes[rings])
    assert float(spectrum["slope"].value) == pytest.approx(slope, abs=0.1)
    field = abs(SETUP.path_integrated_b(np.ones((2, 1)))).max()
    energy = (true.k * true.power)[rings].sum() * true.width / PIXEL * field**2
    exact = math.sqrt(2 * energy / (math.pi * 1e-4))
    assert float(spectrum["rms_field"].value) == pytest.approx(exact, rel=0.05)
    raw = ring_spectrum(inversion.potential, weights)
    assert (raw.k * raw.power)[rings].sum() < 0.98 * (true.k * true.power)[rings].sum()
    low, high = spectrum.band("slope")
    assert low < float(spectrum["slope"].value) < high
    assert float(spectrum["contrast"].value) == pytest.approx(0.6, abs=0.08)


def test_power_of_the_noise_is_subtracted(shot):
    inversion, _ = shot
    (spectrum,) = analyse(
        inversion, TurbulenceSpectrum(slope=False, phantoms=0), setup=SETUP, samples=20
    )
    assert inversion.cells.are_pixels  # so that the potential is that at points
    raw = ring_spectrum(inversion.potential, window_weights(all_of(96), 0.125))
    scale = abs(SETUP.path_integrated_b(np.ones((2, 1)))).max() ** 2 * PIXEL
    noise = spectrum["noise"].value
    assert (noise > 0).all()
    np.testing.assert_allclose(spectrum["power"].value + noise, raw.power * scale)
    low, high = spectrum.band("power")
    centre = (low + high) / 2
    assert np.median(abs(centre - spectrum["power"].value) / (high - low)) < 0.2


def test_correlation_length_of_the_spectrum_gives_the_same_field(cubes):
    b = cubes[1][:2].sum(axis=3) * PIXEL
    result = field_of(potential_of(b), SETUP.displacement_from_path_integrated_b(b))
    (plain,) = analyse(result, TurbulenceSpectrum(path_length=1e-4))
    assert float(plain["rms_by_correlation"].value) == pytest.approx(
        float(plain["rms_field"].value)
    )
    length = 4 * float(plain["correlation_length"].value)
    (longer,) = analyse(result, TurbulenceSpectrum(path_length=1e-4, correlation_length=length))
    ratio = float(longer["rms_by_correlation"].value / plain["rms_by_correlation"].value)
    assert ratio == pytest.approx(0.5)


def test_density_has_the_slope_of_its_own_plane():
    setup = OpticalSetup(wavelength=532e-9, object_image_distance=0.01, pixel_size=5e-6)
    k0 = 2 * np.pi / 96
    # E ∝ k P of the density, whose modes are those of the displacement over k².
    potential, displacement = random_displacement(
        lambda k: np.where(k > 2 * k0, (k / k0) ** (-5 / 3), 0.0),
        (96, 96),
        np.random.default_rng(2),
    )
    result = field_of(potential, displacement, setup)
    (spectrum,) = analyse(result, TurbulenceSpectrum(longest=24, shortest=5), unit="m⁻²")
    assert float(spectrum["slope"].value) == pytest.approx(-5 / 3, abs=0.2)
    assert spectrum.variables["power"].unit == "(m⁻²)² m"


def test_masked_pixels_do_not_change_the_slope_much(cubes):
    potential = potential_of(cubes[2][:2].sum(axis=3))
    mask = all_of(SIDE)
    mask[20:26, 30:36] = False
    slopes = []
    for weights in (window_weights(all_of(SIDE), 0.1), window_weights(mask, 0.1)):
        spectrum = ring_spectrum(potential, weights)
        rings = slice(4, 24)
        slopes.append(fit_exponent(spectrum.k[rings], spectrum.power[rings], spectrum.modes[rings]))
    assert slopes[1] == pytest.approx(slopes[0], abs=0.25)


def test_random_fields_report_and_stop_on_request(shot):
    inversion, _ = shot
    steps: list[Progress] = []

    def is_second() -> bool:
        return any(each.stage == "response" and each.step == 1 for each in steps)

    with pytest.raises(InversionCancelled):
        analyse(
            inversion, TurbulenceSpectrum(phantoms=2), samples=20,
            on_progress=steps.append, should_stop=is_second,
        )  # fmt: skip
    counted = [(each.step, each.total) for each in steps if each.stage == "response"]
    assert counted == [(0, 4), (1, 4)]


def test_slope_of_one_image_is_refused_past_a_contrast_of_one():
    counts, _ = turbulent_image(64, 1.6, 1)
    inversion = invert(counts, source=np.full(counts.shape, 250.0))
    with pytest.raises(InputError, match=r"contrast|trusted rings"):
        analyse(inversion, TurbulenceSpectrum(phantoms=1), samples=20)


@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        ({"longest": 5, "shortest": 9}, "expected the longest wavelength"),
        ({"correlation_length": 1e-5}, "expected both"),
        ({"path_length": 0}, "greater than 0"),
        ({"taper": 0.6}, "at most 0.5"),
    ],
)
def test_spectrum_refuses_choices_that_make_no_sense(choices, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        TurbulenceSpectrum(**choices)
    assert "\n" not in str(error.value)


def test_spectrum_refuses_fields_and_windows_without_one(exact):
    with pytest.raises(InputError, match="energy spectrum is defined for"):
        analyse(exact, TurbulenceSpectrum(path_length=1e-3), unit="rad")
    with pytest.raises(InputError, match="at least 32 px"):
        window_weights(np.ones((20, 90), bool), 0.1)
    with pytest.raises(InputError, match="masked pixels leave no region"):
        window_weights(np.arange(4096).reshape(64, 64) % 3 > 0, 0.1)
    with pytest.raises(InputError, match="at least 4 for a slope"):
        analyse(exact, TurbulenceSpectrum(longest=30, shortest=29))
