"""Fields in handy units."""

from __future__ import annotations

import numpy as np

from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.physics.units import PREFIXED_UNITS, shown_fields, shown_potential


def test_peak_is_told_in_both_units(proton_setup: ProtonSetup) -> None:
    displacement = proton_setup.displacement_from_path_integrated_b(
        np.array([97.0, 0.0]).reshape(2, 1, 1), "MG um"
    )
    (field,) = shown_fields([displacement], proton_setup)
    assert field.peak_text == "peak |∫B×dz| 9.7 mT·m (97 MG·µm)"


def test_light_is_shown_by_its_deflection(optical_setup: OpticalSetup) -> None:
    displacement = optical_setup.displacement(np.full((2, 3, 4), 3e-4))
    (field,) = shown_fields([displacement], optical_setup)
    assert (field.unit, field.components) == ("µrad", ("αy", "αx"))
    np.testing.assert_allclose(field.vectors, 300)
    plane, unit = shown_potential(optical_setup.normalized_potential([[2e-9]]), optical_setup)
    assert unit == "nm"
    np.testing.assert_allclose(plane, 2)


def test_a_prefix_is_for_units_without_a_power() -> None:
    assert {"m", "rad", "T m", "V"} == PREFIXED_UNITS


def test_what_deflects_is_shown_by_its_own_path_integral(proton_setup: ProtonSetup) -> None:
    displacement = proton_setup.displacement_from_path_integrated_e(np.full((2, 3, 4), 3e3))
    (field,) = shown_fields([displacement], proton_setup, "electric field")
    assert (field.symbol, field.unit) == ("|∫E dz|", "kV")
    np.testing.assert_allclose(field.vectors, 3)
    (usual,) = shown_fields([displacement], proton_setup, "magnetic field")
    assert usual.symbol == "|∫B×dz|"
