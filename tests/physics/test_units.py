"""Fields in handy units."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.physics.units import (
    PeakError,
    intensity_limits,
    shown_fields,
    shown_potential,
    takes_prefix,
)


def test_peak_text_has_both_units(proton_setup: ProtonSetup) -> None:
    displacement = proton_setup.displacement_from_path_integrated_b(
        np.array([97.0, 0.0]).reshape(2, 1, 1), "MG um"
    )
    (field,) = shown_fields([displacement], proton_setup)
    assert field.peak_text() == "peak |∫B×dz| 9.7 mT·m (97 MG·µm)"
    text = field.peak_text(PeakError(2.1 / 97, "noise"))
    assert text == "peak |∫B×dz| 9.70 ± 0.21 mT·m (97.0 ± 2.1 MG·µm) (noise)"


def test_peak_and_largest_leave_out_masked_pixels() -> None:
    displacement = np.zeros((2, 3, 4))
    displacement[0, 0, 1], displacement[1, 2, 3] = -3.0, 9.0
    mask = np.ones((3, 4), bool)
    mask[2, 3] = False
    (field,) = shown_fields([displacement], None, mask=mask)
    assert (field.peak, field.largest) == ((0, 1), 3.0)
    assert np.isnan(field.magnitude[2, 3])
    (field,) = shown_fields([displacement], None)
    assert (field.peak, field.largest) == ((2, 3), 9.0)


def test_light_is_shown_by_its_deflection(optical_setup: OpticalSetup) -> None:
    displacement = optical_setup.displacement(np.full((2, 3, 4), 3e-4))
    (field,) = shown_fields([displacement], optical_setup)
    assert (field.unit, field.components) == ("µrad", ("αy", "αx"))
    np.testing.assert_allclose(field.vectors, 300)
    plane, unit = shown_potential(optical_setup.normalized_potential([[2e-9]]), optical_setup)
    assert unit == "nm"
    np.testing.assert_allclose(plane, 2)


def test_a_prefix_is_for_units_without_a_power() -> None:
    units = ("m", "rad", "T m", "V", "m⁻²", "pixel")
    assert [takes_prefix(unit) for unit in units] == [True, True, True, True, False, False]


def test_each_deflector_has_its_own_path_integral(proton_setup: ProtonSetup) -> None:
    displacement = proton_setup.displacement_from_path_integrated_e(np.full((2, 3, 4), 3e3))
    (field,) = shown_fields([displacement], proton_setup, "electric field")
    assert (field.symbol, field.unit) == ("|∫E dz|", "kV")
    np.testing.assert_allclose(field.vectors, 3)
    (usual,) = shown_fields([displacement], proton_setup, "magnetic field")
    assert usual.symbol == "|∫B×dz|"


@pytest.mark.parametrize(("darkest", "low"), [(-2.0, -2.0), (1.0, 0.0), (7.0, 7.0)])
def test_intensity_limits_show_negative_pixels_and_begin_at_zero_if_near(darkest, low) -> None:
    limits = intensity_limits(np.linspace(darkest, 8.0, 10_000).reshape(100, 100))
    assert limits[0] == pytest.approx(low, abs=0.02 if low else 0.0)
    assert limits[1] == pytest.approx(8.0, abs=0.04)


def test_intensity_limits_ignore_a_caustic() -> None:
    image = np.ones((100, 100))
    image[40:43] = 50.0
    assert intensity_limits(image)[1] == pytest.approx(3.5 * image.mean())


def test_intensity_limits_differ_for_an_empty_image() -> None:
    for image in (np.full((4, 4), np.nan), np.zeros((4, 4)), np.full((4, 4), -1.0)):
        low, high = intensity_limits(image)
        assert low < high
