"""Line integrals: exact values, Stokes' theorem, additivity and symmetries."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import constants
from scipy.special import erf

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import (
    CurrentDensity,
    EnclosedCharge,
    EnclosedCurrent,
    Flux,
    analyse,
)
from napari_shadowinv.analysis.frame import FIELD_UNITS, FieldFrame
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.physics.derivatives import finer_field
from napari_shadowinv.physics.phantoms import gaussian_blob, toroid

PIXEL = SETUP.object_pixel_size


def number(field: RetrievedField, product: Flux | EnclosedCurrent | EnclosedCharge) -> float:
    unit = "V" if isinstance(product, EnclosedCharge) else None
    (result,) = analyse(field, product, unit=unit)
    (quantity,) = result.quantities.values()
    return float(quantity.value)


def test_flux_and_current_of_a_toroid_are_those_of_its_formula():
    sigma, peak = 30e-6, 50e-4  # m, T m
    field = field_of(toroid((151, 151), SETUP, peak / 1e-4, sigma))
    # On the right of the middle a counter-clockwise field points up, to the left of a line in +x.
    r = 40 * PIXEL
    exact = -peak * sigma * np.exp(0.5) * (1 - np.exp(-(r**2) / (2 * sigma**2)))
    assert number(field, Flux(path=[(75, 75), (75, 115)])) == pytest.approx(exact, rel=1e-3)
    radius = 25 * PIXEL
    strength = peak * radius / sigma * np.exp(0.5 - radius**2 / (2 * sigma**2))
    # Counter-clockwise as shown, so the current is towards the viewer, against the beam.
    exact = -2 * np.pi * radius * strength / constants.mu_0
    current = number(field, EnclosedCurrent(center=(75, 75), radius=25))
    assert current == pytest.approx(exact, rel=1e-3)


def test_current_of_an_inversion_lacks_nothing_by_its_read_out():
    # Means over pixels of exp(-r²/2σ²), whose central differences lack 1 % of the current.
    sigma, radius, middle = 5.0, 8.0, 40
    edges = (np.arange(82) - middle - 0.5) / (np.sqrt(2) * sigma)
    line = sigma * np.sqrt(np.pi / 2) * np.diff(erf(edges))
    potential = np.multiply.outer(line, line)
    displacement = -np.array(np.gradient(potential))
    frame = FieldFrame(potential.shape, potential > -1, SETUP, "B", FIELD_UNITS["T m"])
    circle = EnclosedCurrent(center=(middle, middle), radius=radius)
    outward = radius / sigma**2 * np.exp(-(radius**2) / (2 * sigma**2))
    field = SETUP.path_integrated_b([outward, 0.0])[1]
    exact = -2 * np.pi * radius * PIXEL * abs(field) / constants.mu_0
    (read_out,) = circle.measure(potential, displacement, frame).values()
    assert abs(read_out / exact - 1) > 8e-3
    (current,) = circle.measure(*finer_field(potential, displacement), frame).values()
    assert current == pytest.approx(exact, rel=1e-3)


def test_charge_of_a_gaussian_is_that_of_gauss_law():
    # A potential A exp(-r²/2σ²) px²: outward displacement A r/σ² exp(-r²/2σ²).
    amplitude, sigma, radius = 60.0, 15.0, 20.0
    field = field_of(gaussian_blob((121, 121), amplitude, sigma))
    outward = amplitude * radius / sigma**2 * np.exp(-(radius**2) / (2 * sigma**2))
    volts = SETUP.path_integrated_e([0.0, outward])[1]
    exact = constants.epsilon_0 * 2 * np.pi * radius * PIXEL * volts
    charge = number(field, EnclosedCharge(center=(60, 60), radius=radius))
    assert charge == pytest.approx(exact, rel=1e-3)


def test_enclosed_current_is_the_integral_of_the_current_density(exact: RetrievedField):
    # A rectangle along the edges of pixels encloses whole pixels.
    low, high = (19.5, 24.5), (69.5, 60.5)
    (density,) = analyse(exact, CurrentDensity(smoothing=0))
    inside = density["density"].value[20:70, 25:61]
    current = number(exact, EnclosedCurrent(rectangle=(low, high)))
    assert inside.sum() * PIXEL**2 == pytest.approx(current, rel=5e-3)


def test_fluxes_of_joined_lines_add_up(exact: RetrievedField):
    a, b, c = (30.0, 20.0), (55.5, 61.2), (70.0, 40.0)
    parts = [number(exact, Flux(path=path)) for path in ([a, b], [b, c])]
    assert number(exact, Flux(path=[a, b, c])) == pytest.approx(sum(parts))
    assert number(exact, Flux(path=[c, a])) == pytest.approx(-sum(parts))


def test_current_does_not_depend_on_the_sense_of_its_outline(exact: RetrievedField):
    corners = [(20.0, 25.0), (22.0, 70.0), (75.0, 60.0), (60.0, 30.0)]
    first, second = (number(exact, EnclosedCurrent(path=c)) for c in (corners, corners[::-1]))
    assert first == pytest.approx(second)


def test_flux_across_a_closed_line_is_refused(exact: RetrievedField):
    with pytest.raises(InputError, match=r"closed line is zero.*'current'"):
        analyse(exact, Flux(path=[(10, 10), (20, 30), (10, 10)]))


@pytest.mark.parametrize(
    ("outline", "message"),
    [
        ({}, "expected one outline"),
        ({"center": (5, 5)}, "only one of 'center' and 'radius'"),
        ({"center": (5, 5), "radius": 0}, "greater than 0"),
        ({"rectangle": ((5, 5), (5, 9))}, "no area"),
        ({"path": [(0, 0), (9, 9), (0, 9), (9, 0)]}, "crosses itself"),
        ({"center": (5, 5), "radius": 3, "rectangle": ((1, 1), (3, 3))}, "expected one outline"),
    ],
)
def test_an_outline_without_an_inside_is_refused(outline: dict[str, object], message: str):
    with pytest.raises(InputError, match=message):
        EnclosedCurrent(**outline)


def test_a_current_needs_a_magnetic_field(exact: RetrievedField):
    with pytest.raises(InputError, match="not defined for a field in V: choose one of T m"):
        analyse(exact, EnclosedCurrent(center=(50, 50), radius=9), unit="V")
