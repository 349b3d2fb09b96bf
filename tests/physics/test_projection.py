"""The same object in two experiments."""

from __future__ import annotations

import math

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.physics.projection import (
    predict_image,
    transferred_displacement,
)
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

SHAPE = (48, 56)
FAST = ProtonSetup.example()
SLOW = FAST.model_copy(update={"energy": 3.0})
GREEN = OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=12e-6)
RED = GREEN.model_copy(update={"wavelength": 633e-9})
# Rest energies in MeV (CODATA), independent of the package's constants.
REST = {"proton": 938.27208816, "alpha": 3727.3794066, "electron": 0.51099895}


def momentum(kinetic: float, rest: float) -> float:
    """Of a relativistic particle, p c in MeV."""
    return math.sqrt(kinetic * (kinetic + 2 * rest))


def velocity(kinetic: float, rest: float) -> float:
    """In units of the speed of light: p c / E."""
    return momentum(kinetic, rest) / (kinetic + rest)


@pytest.fixture(scope="module")
def field() -> np.ndarray:
    return np.random.default_rng(3).normal(size=(2, *SHAPE))


def test_in_its_own_experiment_nothing_changes(field: np.ndarray) -> None:
    np.testing.assert_array_equal(transferred_displacement(field, FAST, FAST), field)
    truth = toroid(SHAPE, FAST, 20.0, 10e-6).displacement
    source = np.linspace(1, 2, truth[0].size).reshape(SHAPE)
    np.testing.assert_array_equal(
        predict_image(truth, FAST, FAST, source=source), synthetic_image(truth, source)
    )


@pytest.mark.parametrize(
    ("species", "energy", "charge"),
    [("proton", 3.0, 1), ("alpha", 3.5, 2), ("electron", 150.0, -1)],
)
@pytest.mark.parametrize("deflector", ["magnetic field", "electric field"])
def test_deflections_go_with_charge_over_momentum_and_velocity(
    field: np.ndarray, species: str, energy: float, charge: int, deflector: str
) -> None:
    """The paper's root of the energies' ratio is another number."""
    rest = REST[species]
    ratio = charge * momentum(14.7, REST["proton"]) / momentum(energy, rest)
    if deflector == "electric field":
        ratio *= velocity(14.7, REST["proton"]) / velocity(energy, rest)
    other = FAST.model_copy(update={"energy": energy, "species": species})
    moved = transferred_displacement(field, FAST, other, deflector=deflector)
    np.testing.assert_allclose(moved, ratio * field, rtol=1e-7)


@pytest.mark.parametrize("deflector", ["magnetic field", "electric field"])
def test_projection_keeps_the_line_integrated_field(field: np.ndarray, deflector: str) -> None:
    other_setup = ProtonSetup(
        energy=3.0,
        source_object_distance=0.02,
        object_image_distance=0.3,
        detector_pixel_size=FAST.object_pixel_size * 16,
    )
    assert other_setup.object_pixel_size == pytest.approx(FAST.object_pixel_size, rel=1e-12)
    moved = transferred_displacement(field, FAST, other_setup, deflector=deflector, shape=SHAPE)
    name = "path_integrated_b" if deflector == "magnetic field" else "path_integrated_e"
    np.testing.assert_allclose(
        getattr(other_setup, name)(moved),
        getattr(FAST, name)(field),
        rtol=1e-9,
        # The spline between pixels whose sizes differ by rounding.
        atol=1e-9 * np.abs(getattr(FAST, name)(field)).max(),
    )


def test_there_and_back_is_exact(field: np.ndarray) -> None:
    other_setup = SLOW.model_copy(
        update={"object_image_distance": 0.5, "source_object_distance": 0.07}
    )
    transferred = transferred_displacement(field, FAST, other_setup)
    np.testing.assert_allclose(
        transferred_displacement(transferred, other_setup, FAST), field, rtol=1e-13
    )


def test_light_in_a_plasma_and_in_a_gas(field: np.ndarray) -> None:
    plasma = transferred_displacement(field, GREEN, RED, deflector="plasma")
    np.testing.assert_allclose(plasma, field * (633 / 532) ** 2, rtol=1e-12)
    glass = transferred_displacement(
        field, GREEN, RED, deflector="refractive index", dispersion=0.98
    )
    np.testing.assert_allclose(glass, 0.98 * field, rtol=1e-13)


@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.5, 2.0])
def test_other_pixels_see_the_same_field_in_metres(ratio: float) -> None:
    """Off-centre, asymmetric: an exact field drawn in both pixels."""
    pixel = ratio * FAST.object_pixel_size
    other_setup = FAST.model_copy(update={"pixel_size": pixel})
    shape = tuple(math.floor(n / ratio) for n in SHAPE)
    sigma = (9e-6, 13e-6)
    offset = np.array([4.0, -3.0])  # px of the first experiment, from the middle

    def drawn(setup: ProtonSetup, size: tuple[int, ...], scale: float) -> np.ndarray:
        center = (np.array(size) - 1) / 2 + offset / scale
        return toroid(size, setup, 40.0, sigma, tuple(center), 0.4).displacement

    moved = transferred_displacement(drawn(FAST, SHAPE, 1.0), FAST, other_setup)
    expected = drawn(other_setup, shape, ratio)
    assert moved.shape == expected.shape
    assert np.abs(moved - expected).max() < 1e-3 * np.abs(expected).max()
    angle, true_angle = other_setup.deflection_angle(moved), other_setup.deflection_angle(expected)
    np.testing.assert_allclose(angle, true_angle, atol=1e-3 * np.abs(true_angle).max())


def test_cubic_fields_are_resampled_exactly_up_to_the_border() -> None:
    fine = FAST.model_copy(update={"pixel_size": FAST.object_pixel_size / 3})
    y, x = (np.arange(n) - (n - 1) / 2 for n in (12, 15))
    field = np.stack([y[:, None] ** 3 - x, y[:, None] * x**2])
    v, u = ((np.arange(3 * n) - (3 * n - 1) / 2) / 3 for n in (12, 15))
    expected = 3 * np.stack([v[:, None] ** 3 - u, v[:, None] * u**2])
    np.testing.assert_allclose(transferred_displacement(field, FAST, fine), expected, atol=1e-9)


def test_source_gives_the_shape_of_the_image() -> None:
    source = np.full((20, 24), 7.0)
    image = predict_image(np.zeros((2, *SHAPE)), FAST, FAST, source=source)
    np.testing.assert_allclose(image, source)
    with pytest.raises(InputError, match=r"\(60, 24\) .* known only on \(48, 56\)"):
        predict_image(np.zeros((2, *SHAPE)), FAST, FAST, source=np.ones((60, 24)))


def test_projection_refuses_impossible_transfers(field: np.ndarray) -> None:
    with pytest.raises(
        InputError, match="kind 'proton', but the image is requested for kind 'optical'"
    ):
        transferred_displacement(field, FAST, GREEN)
    with pytest.raises(InputError, match=r"wavelengths differ .* choose 'plasma'"):
        transferred_displacement(field, GREEN, RED)
    with pytest.raises(InputError, match="'plasma', but the beam is particles"):
        transferred_displacement(field, FAST, SLOW, deflector="plasma")
    with pytest.raises(InputError, match="'magnetic field', but the beam is light"):
        transferred_displacement(field, GREEN, RED, deflector="magnetic field")
    with pytest.raises(InputError, match="deflector is 'gravity': it must be one of magnetic"):
        transferred_displacement(field, FAST, SLOW, deflector="gravity")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="dispersion is 2, but it does not apply to a plasma"):
        transferred_displacement(field, GREEN, RED, deflector="plasma", dispersion=2.0)
    with pytest.raises(InputError, match="dispersion is nan"):
        transferred_displacement(field, GREEN, RED, dispersion=math.nan)
    with pytest.raises(InputError, match=r"displacement has shape \(48, 56\)"):
        transferred_displacement(field[0], FAST, SLOW)
    coarse = FAST.model_copy(update={"pixel_size": 1e-4})
    with pytest.raises(InputError, match="covers 0 × 0 pixels of the other setup"):
        transferred_displacement(field, FAST, coarse)
