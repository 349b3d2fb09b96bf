"""Profiles about an axis: the Abel inversion, the axis, units, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import constants
from scipy.special import erf

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv import OpticalSetup, ProtonSetup, invert, synthetic_image
from napari_shadowinv.analysis import AxisymmetricProfile, AzimuthalProfile, analyse
from napari_shadowinv.analysis.abel import (
    FIRST_OFFSET,
    choose_smoothing,
    deflection_matrix,
    inverse_matrix,
    projection_matrix,
)
from napari_shadowinv.analysis.axis import Axis, find_axis, sample_sides
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics.phantoms import gaussian_blob, toroid

RADII = np.arange(60.0)
SIGMA = 12.0
LIGHT = OpticalSetup(wavelength=532e-9, object_image_distance=0.2, pixel_size=20e-6)


def gaussian(r: np.ndarray) -> np.ndarray:
    return np.exp(-(r**2) / (2 * SIGMA**2))


def result_of(phantom, setup=SETUP) -> RetrievedField:
    return RetrievedField(dataset_from_field(phantom.displacement, phantom.potential, setup))


@pytest.mark.parametrize("smoothing", [0.0, 1.0])
def test_abel_inversion_of_a_gaussian_is_a_gaussian(smoothing):
    y, height = RADII + FIRST_OFFSET, np.sqrt(2 * np.pi) * SIGMA
    for matrix, data in (
        (deflection_matrix(60), height * gaussian(y) * y / SIGMA**2),
        (projection_matrix(60), height * gaussian(RADII)),
    ):
        inverse = inverse_matrix(matrix, smoothing)
        np.testing.assert_allclose(inverse @ data, gaussian(RADII), atol=1.5e-3)


def test_projection_of_a_cone_is_that_of_its_integral():
    # ∫(1 - r/R) dz = √(R² - y²) - (y²/R) arcosh(R/y), exact for linear pieces
    y, radius = RADII + 0.5, 60.0
    exact = np.sqrt(radius**2 - y**2) - y**2 / radius * np.arccosh(radius / y)
    np.testing.assert_allclose(projection_matrix(60, 0.5) @ (1 - RADII / radius), exact)


def test_deflection_of_a_cone_is_that_of_its_integral():
    y = RADII + 0.3
    exact = 2 * y / 60 * np.arccosh(60 / y)
    np.testing.assert_allclose(deflection_matrix(60, 0.3) @ (1 - RADII / 60), exact)


def test_operator_agrees_with_pyabel():
    daun = pytest.importorskip("abel.daun", reason="PyAbel is not installed")
    projection = np.sqrt(2 * np.pi) * SIGMA * gaussian(RADII)
    theirs = daun.daun_transform(np.tile(projection, (2, 1)), degree=1, reg=0.0, verbose=False)[0]
    ours = inverse_matrix(projection_matrix(60), 0.0) @ projection
    np.testing.assert_allclose(ours, theirs, atol=1e-10)
    y = RADII + FIRST_OFFSET
    deflection = np.sqrt(2 * np.pi) / SIGMA * y * gaussian(y)
    from_deflection = inverse_matrix(deflection_matrix(60), 0.0) @ deflection
    np.testing.assert_allclose(from_deflection, theirs, atol=2e-3)


def test_smoothing_grows_with_noise():
    rng = np.random.default_rng(1)
    matrix = deflection_matrix(60)
    data = matrix @ gaussian(RADII)
    chosen = [
        choose_smoothing(matrix, data + rng.normal(0, size, 60), data + rng.normal(0, size, 60))
        for size in (1e-4, 1e-2, 0.3)
    ]
    assert chosen == sorted(chosen)
    assert chosen[-1] > 100 * chosen[0]


@pytest.mark.parametrize(("tilt", "x"), [(0.0, 51.3), (0.08, 47.0)])
def test_axis_of_an_ellipse_is_found_with_its_inclination(tilt, x):
    phantom = gaussian_blob((110, 100), 100.0, (25.0, 9.0), (54.5, x), tilt)
    axis = find_axis(phantom.displacement)
    middle = (np.array(axis.start) + axis.end) / 2
    slope = axis.direction[1] / axis.direction[0]
    assert slope == pytest.approx(np.tan(tilt), abs=2e-3)
    assert middle[1] == pytest.approx(x + (middle[0] - 54.5) * np.tan(tilt), abs=0.02)
    right, left = sample_sides(phantom.displacement[1], axis, 30)
    assert np.abs(right - left).max() < 0.05 * np.abs(right).max() + 10 * abs(tilt)


def test_horizontal_axis_is_found():
    phantom = gaussian_blob((90, 110), 100.0, (8.0, 30.0), (40.6, 54.0))
    axis = find_axis(phantom.displacement, "horizontal")
    assert axis.start[0] == pytest.approx(40.6, abs=0.02)
    assert axis.across[0] == pytest.approx(1.0, abs=1e-3)


def test_profile_of_a_sphere_has_the_index_of_its_formula():
    change, sigma = 2e-5, SIGMA * LIGHT.object_pixel_size
    integral = change * np.sqrt(2 * np.pi) * sigma  # ∫ Δη dz through the middle
    amplitude = float(LIGHT.normalized_potential_from_log_index(integral))
    phantom = gaussian_blob((100, 120), amplitude, SIGMA, (49.5, 60.2))
    (profile,) = analyse(result_of(phantom, LIGHT), AxisymmetricProfile(find_tilt=False))
    values, places = profile["refractive_index"].value, profile.coordinates
    along = places["along"].values / LIGHT.object_pixel_size - 49.5
    radius = places["radius"].values / LIGHT.object_pixel_size
    exact = change * gaussian(np.hypot(along[:, None], radius))
    np.testing.assert_allclose(values, exact, atol=8e-3 * change)
    assert profile.variables["refractive_index"].unit == "1"


def test_temperature_is_that_of_the_ideal_gas():
    constant, density = 2.26e-4, 1.2
    hot = 1500.0
    # ρ = ρ₀ T₀ / T, and Δη = K (ρ - ρ₀), on the axis
    change = constant * density * (293.0 / hot - 1)
    integral = change * np.sqrt(2 * np.pi) * SIGMA * LIGHT.object_pixel_size
    amplitude = float(LIGHT.normalized_potential_from_log_index(integral))
    phantom = gaussian_blob((90, 100), amplitude, SIGMA)
    product = AxisymmetricProfile(
        axis=((35.0, 49.5), (54.0, 49.5)),
        gladstone_dale=constant, ambient_density=density, ambient_temperature=293.0,
    )  # fmt: skip
    (profile,) = analyse(result_of(phantom, LIGHT), product)
    assert profile["temperature"].value.max() == pytest.approx(hot, rel=0.05)
    assert profile["temperature"].value[:, -1] == pytest.approx(293.0, rel=0.01)
    assert profile["density"].value.min() == pytest.approx(density * 293 / hot, rel=0.05)


def test_electron_density_is_that_of_its_line_integral():
    density, sigma = 3e24, SIGMA * LIGHT.object_pixel_size
    integral = density * np.sqrt(2 * np.pi) * sigma
    log_index = -integral / (2 * LIGHT.critical_density)
    amplitude = float(LIGHT.normalized_potential_from_log_index(log_index))
    (profile,) = analyse(
        result_of(gaussian_blob((90, 100), amplitude, SIGMA), LIGHT),
        AxisymmetricProfile(),
        unit="m⁻²",
    )
    assert profile["electron_density"].value.max() == pytest.approx(density, rel=0.01)


def test_radial_field_is_that_of_a_charged_column():
    volts = 1000.0  # V = V₀ exp(-r²/2σ²), E_r = V₀ r/σ² exp(-r²/2σ²), uniform along the axis
    pixel = SETUP.object_pixel_size
    y, x = np.mgrid[:80, :100] - np.array([39.5, 49.5])[:, None, None]
    across = volts * np.sqrt(2 * np.pi) * SIGMA * gaussian(x) * x / SIGMA**2  # ∫E_x dz in V
    displacement = SETUP.displacement_from_path_integrated_e(np.stack([0 * y, across]))
    result = RetrievedField(dataset_from_field(displacement, None, SETUP))
    product = AxisymmetricProfile(slice_width=0, axis=((10.0, 49.5), (70.0, 49.5)))
    (profile,) = analyse(result, product, unit="V")
    radii = np.arange(len(profile["radial_field"].value))
    exact = volts * radii / SIGMA**2 * gaussian(radii) / pixel
    np.testing.assert_allclose(profile["radial_field"].value, exact, atol=0.02 * exact.max())
    assert profile["electric_potential"].value[0] == pytest.approx(volts, rel=0.01)
    assert profile.variables["radial_field"].dims == ("radius",)


def test_axial_field_of_a_solenoid_is_inverted_from_the_side():
    tesla, pixel = 30.0, SETUP.object_pixel_size
    x = np.arange(100) - 49.5
    along = tesla * np.sqrt(2 * np.pi) * SIGMA * pixel * gaussian(x) * np.ones((60, 1))
    b = np.stack([along, 0 * along])  # ∫B_y dz in T m
    displacement = SETUP.displacement_from_path_integrated_b(b)
    result = RetrievedField(dataset_from_field(displacement, None, SETUP))
    product = AxisymmetricProfile(
        component="axial", axis=((5.0, 49.5), (50.0, 49.5)), slice_width=0
    )
    (profile,) = analyse(result, product)
    radii = np.arange(len(profile["axial_field"].value))
    np.testing.assert_allclose(profile["axial_field"].value, tesla * gaussian(radii), atol=0.3)


def test_azimuthal_field_face_on_has_the_current_of_ampere():
    peak, sigma = 40e-4, 20e-6
    phantom = toroid((100, 100), SETUP, 40.0, sigma)
    (profile,) = analyse(field_of(phantom), AzimuthalProfile(center=(49.5, 49.5)))
    r = profile.coordinates["radius"].values
    exact = peak * r / sigma * np.exp(0.5 - r**2 / (2 * sigma**2))  # counter-clockwise
    np.testing.assert_allclose(profile["azimuthal_field"].value, exact, atol=2e-3 * peak)
    enclosed = -2 * np.pi * r * exact / constants.mu_0
    np.testing.assert_allclose(profile["current"].value, enclosed, atol=3e-3 * abs(enclosed).max())
    assert profile["variation"].value.max() < 0.01 * peak


def noisy_cylinder(seed: int):
    """Return an inversion of a hollow cylinder, 250 counts a pixel, and its profile."""
    y, x = np.mgrid[:60, :140] - np.array([29.5, 69.5])[:, None, None]

    def profile(r):
        return 3.0 * (1 + erf((r - 15) / 14)) * (1 + erf((35 - r) / 14)) / 4

    depth = (np.arange(1200) + 0.5) / 20
    left, right = (profile(np.hypot(x[0][:, None] + step, depth)) for step in (-0.01, 0.01))
    slope = 2 * (right - left).sum(axis=1) / 20 / 0.02
    displacement = np.stack([0 * y, -slope * np.ones((60, 1))])
    image = np.random.default_rng(seed).poisson(250 * synthetic_image(displacement))
    return invert(image, source=np.full(image.shape, 250.0)), profile


def test_band_of_a_cylinder_holds_it():
    shares = []
    for seed in range(4):
        inversion, profile = noisy_cylinder(seed)
        product = AxisymmetricProfile(slice_width=0, axis=((0.0, 69.5), (59.0, 69.5)), radius=65)
        (result,) = analyse(inversion, product, samples=60)
        low, high = result.band("profile", 0.95)
        exact = profile(np.arange(len(low)) * 1.0)
        shares.append(((low <= exact) & (exact <= high)).mean())
        error = np.linalg.norm(result["profile"].value - exact) / np.linalg.norm(exact)
        assert error < 0.1
        drift, width = result["axis_offset"].value, result["axis_offset"].std
        assert abs(drift) < 4 * width
    assert np.mean(shares) > 0.7


def test_band_holds_what_a_closed_edge_takes_from_an_object():
    """Its deflection is 3 % of the largest there; the error is long compared with the object.

    It leaves through two further edges, so that the band also holds what may lie beyond those.
    """
    x, sigma = np.arange(100.0) - 49.5, 16.0
    moves = 3.0 * (x / sigma) * np.exp(0.5 - x**2 / (2 * sigma**2))
    displacement = np.stack([np.zeros((60, 100)), np.tile(moves, (60, 1))])
    product = AxisymmetricProfile(axis=((0.0, 49.5), (59.0, 49.5)), slice_width=0, smoothing=1.0)
    result = invert(1000 * synthetic_image(displacement), instrument={"beam_rms": 0.0})
    (profile,) = analyse(result, product)
    radius = np.arange(50.0)
    exact = 3.0 * np.exp(0.5 - radius**2 / (2 * sigma**2)) / np.sqrt(2 * np.pi)
    error = (profile["profile"].value - exact)[5:35]
    deviation = profile["profile"].std[5:35]
    assert (error < 0).all()
    assert (-error < 1.3 * deviation).all()
    assert (deviation < -5 * error).all()


def codes(result) -> set[str]:
    return {fact.key for fact in result.facts}


def texts(result) -> str:
    return " ".join(fact.text for fact in result.facts)


def test_object_beyond_the_edge_and_lopsided_objects_are_warned_of():
    wide = gaussian_blob((60, 80), 400.0, 30.0)
    (profile,) = analyse(result_of(wide, LIGHT), AxisymmetricProfile(slice_width=0))
    assert "does not end inside the radius" in texts(profile)
    lopsided = gaussian_blob((60, 120), 60.0, 8.0) + gaussian_blob(
        (60, 120), 30.0, 6.0, (29.5, 80.0)
    )
    (profile,) = analyse(
        result_of(lopsided, LIGHT), AxisymmetricProfile(axis=((0.0, 59.5), (59.0, 59.5)))
    )
    assert "halves of the object differ" in texts(profile)


def test_long_object_near_a_point_source_is_warned_of():
    near = ProtonSetup(
        energy=14.7, source_object_distance=2e-3, object_image_distance=0.1, pixel_size=2e-6
    )
    phantom = gaussian_blob((80, 100), 30.0, SIGMA)
    (profile,) = analyse(result_of(phantom, near), AxisymmetricProfile(), unit="V")
    assert "of its distance from the source" in texts(profile)
    far = near.model_copy(update={"source_object_distance": 0.09})
    (profile,) = analyse(result_of(phantom, far), AxisymmetricProfile(), unit="V")
    assert "of its distance from the source" not in texts(profile)


@pytest.mark.parametrize(
    ("product", "unit", "sentence"),
    [
        (AxisymmetricProfile(), "T m", "azimuthal magnetic field is not visible from the side"),
        (AxisymmetricProfile(component="axial"), "T m", "cannot be found from its symmetry"),
        (AxisymmetricProfile(axis=((0.0, 2.0), (9.0, 2.0))), "V", "within 2.5 px of the edge"),
        (AxisymmetricProfile(axis=((0.0, 50.0), (9.0, 500.0))), "V", "inside the image"),
        (
            AxisymmetricProfile(axis=((0.0, 50.0), (9.0, 50.0)), radius=80),
            "V",
            "expected at most",
        ),
        (AxisymmetricProfile(gladstone_dale=2e-4), "V", "not a refractive index"),
        (AzimuthalProfile(center=(50, 50)), "V", "not defined"),
        (AzimuthalProfile(center=(3, 50)), "T m", "from the edge"),
    ],
)
def test_profile_refuses_fields_and_axes_that_it_cannot_use(exact, product, unit, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        analyse(exact, product, unit=unit)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("choices", "sentence"),
    [
        ({"ambient_density": 1.2}, "expected both"),
        ({"ambient_temperature": 293}, "expected both"),
        ({"axis": ((1, 1), (1, 1))}, "two equal points"),
        ({"radius": 3}, "at least 8"),
    ],
)
def test_profile_refuses_choices_that_make_no_sense(choices, sentence):
    with pytest.raises(InputError, match=sentence):
        AxisymmetricProfile(**choices)


def test_axis_refuses_nothing_and_measures_its_room():
    axis = Axis((0.0, 30.0), (50.0, 30.0))
    assert axis.max_radius((60, 100)) == pytest.approx(30.5)
    with pytest.raises(InputError, match="at least 4 px"):
        deflection_matrix(3)
