"""Profiles along lines and paths."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import LineProfile, Region, analyse
from napari_shadowinv.analysis.paths import (
    interpolate_cubic,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.physics.phantoms import Phantom, toroid


def test_profile_of_a_toroid_has_its_peak_across_the_line():
    field = field_of(toroid((101, 101), SETUP, 50.0, 30e-6))
    (profile,) = analyse(field, LineProfile(path=[(50, 50), (50, 90)]), unit="MG um")
    assert profile["normal"].value.min() == pytest.approx(-50e-4, rel=1e-3)  # upwards, to the left
    np.testing.assert_allclose(profile["along"].value, 0, atol=1e-9)
    distance = profile.coordinates["distance"]
    assert distance.unit == "m"
    top = distance.values[profile["magnitude"].value.argmax()]
    assert top == pytest.approx(30e-6, abs=SETUP.object_pixel_size)
    assert profile.facts[0].text == "50 MG µm"


def test_components_of_a_profile_are_those_of_the_vector(exact: RetrievedField):
    (profile,) = analyse(exact, LineProfile(path=[(20, 15), (60, 80), (30, 90)], width=4))
    squares = profile["along"].value ** 2 + profile["normal"].value ** 2
    np.testing.assert_allclose(squares, profile["magnitude"].value ** 2)


def test_reversed_line_has_the_opposite_components(exact: RetrievedField):
    ends = [(20.0, 15.0), (60.0, 80.0)]
    (there,), (back,) = (analyse(exact, LineProfile(path=path)) for path in (ends, ends[::-1]))
    for name in ("along", "normal"):
        np.testing.assert_allclose(there[name].value, -back[name].value[::-1], atol=1e-12)


def test_band_of_a_magnitude_is_that_along_the_field_and_never_negative():
    random = np.random.default_rng(0).normal(size=(2, 200, 3))
    parts = np.array([[30.0, 0.3, 0.0], [40.0, 0.4, 0.0]])
    along, normal = (
        Quantity(value, value + noise) for value, noise in zip(parts, random, strict=True)
    )
    size = np.hypot(*parts)
    # Samples of a length have its bias: noise makes the short vectors longer.
    biased = Quantity(size, np.hypot(along.samples, normal.samples))
    profile = LineProfile(path=[(0, 0), (0, 2)])
    refined = profile.refine({"magnitude": biased, "along": along, "normal": normal})["magnitude"]
    low, high = refined.band(0.68)
    assert (high - low)[0] == pytest.approx(2, rel=0.15)
    assert (low >= 0).all()
    assert (refined.value <= high).all()
    assert low[1] == 0
    assert (biased.band(0.68)[1] < size)[1:].all()


def test_width_averages_across_the_line(ellipses: Phantom):
    rows = np.arange(100.0)[:, None] * np.ones(110)
    field = field_of(Phantom(-(rows**3) / 3, np.stack([rows**2, 0 * rows])))
    line = {"path": [(50, 10), (50, 90)]}
    (thin,), (wide,) = (
        analyse(field, LineProfile(**line, width=width), unit="px") for width in (0, 9)
    )
    np.testing.assert_allclose(thin["magnitude"].value, 2500)
    np.testing.assert_allclose(wide["magnitude"].value, 2500 + (9**2 - 1) / 12, rtol=1e-9)


def test_cubic_interpolation_is_exact_for_cubic_polynomials():
    y, x = np.mgrid[:12, :15].astype(float)
    places = np.random.default_rng(0).uniform((0, 0), (11, 14), (200, 2))
    plane = y**3 - 2 * y * x**2 + x**3 + 5
    exact = places[:, 0] ** 3 - 2 * places[:, 0] * places[:, 1] ** 2 + places[:, 1] ** 3 + 5
    np.testing.assert_allclose(interpolate_cubic(plane, places), exact)


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"path": [(1, 1)]}, "at least two points"),
        ({"path": [(1, 1), (1, 1)]}, "a line with a length"),
        ({"path": [(1, 1), (1, float("nan"))]}, "finite"),
        ({"path": [(1, 1), (2, 2)], "width": -1}, "at least 0"),
    ],
)
def test_a_line_without_a_length_is_refused(choices: dict[str, object], message: str):
    with pytest.raises(InputError, match=message):
        LineProfile(**choices)


def test_a_line_outside_the_image_is_refused(exact: RetrievedField):
    with pytest.raises(InputError, match=r"the point y = 50, x = 200 px.*100 × 110 px"):
        analyse(exact, LineProfile(path=[(50, 50), (50, 200)]))


def test_region_has_the_statistics_of_its_pixels(exact: RetrievedField):
    (region,) = analyse(exact, Region(rectangle=((29.5, 19.5), (59.5, 69.5))), unit="px")
    part = exact.displacement[:, 30:60, 20:70]
    length = np.hypot(*part)
    assert region["mean"].value == pytest.approx(length.mean())
    assert region["peak"].value == pytest.approx(length.max())
    assert region["rms"].value == pytest.approx(np.sqrt((length**2).mean()))
    assert region["mean_x"].value == pytest.approx(part[1].mean())
    rows = np.arange(30, 60)[:, None]
    centroid = SETUP.object_pixel_size * (length * rows).sum() / length.sum()
    assert region["centroid_y"].value == pytest.approx(centroid)


def test_circle_holds_the_pixels_within_its_radius(exact: RetrievedField):
    (region,) = analyse(exact, Region(center=(50.2, 51.3), radius=17.4), unit="px")
    y, x = np.indices((100, 110))
    inside = np.hypot(y - 50.2, x - 51.3) < 17.4
    assert region["mean"].value == pytest.approx(np.hypot(*exact.displacement)[inside].mean())


def test_a_region_between_pixels_is_refused(exact: RetrievedField):
    with pytest.raises(InputError, match="no pixel's centre"):
        analyse(exact, Region(center=(50.5, 50.5), radius=0.2))
