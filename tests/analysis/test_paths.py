"""Values along a path, averaged over a strip, and their table."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.analysis.paths import (
    interpolate,
    measure_peak,
    sample_path,
    sample_strip,
)


def test_a_plane_is_sampled_exactly_at_its_place_in_the_world() -> None:
    y, x = np.mgrid[:30, :40]
    plane = 2.0 * y + 0.5 * x
    points, distance = sample_path([[5.0, 10.0], [35.0, 50.0]], 0.5)
    values = interpolate(plane, points, lambda at: (at - np.array([3.0, 4.0])) / 2.0)
    expected = (points[:, 0] - 3) + 0.25 * (points[:, 1] - 4)
    inside = ((points[:, 1] - 4) / 2 >= 0) & ((points[:, 1] - 4) / 2 <= 39)
    np.testing.assert_allclose(values[inside], expected[inside], atol=1e-12)
    assert distance[-1] == pytest.approx(50)
    assert np.isnan(interpolate(plane, np.array([[-1.0, 0.0]]), lambda at: at)).all()


@pytest.mark.parametrize("degrees", [0.0, 33.0, 90.0, 200.0])
def test_a_strip_averages_across_the_line_and_not_along_it(degrees: float) -> None:
    """The mean of cos ks across a width w is sinc kw/2; variations along the line are kept."""
    turned = np.deg2rad(degrees)
    tangent = np.array([np.sin(turned), np.cos(turned)])
    normal = np.array([np.cos(turned), -np.sin(turned)])
    middle, k, width = np.array([60.0, 65.0]), 0.15, 21.0
    place = np.moveaxis(np.mgrid[:121, :131].astype(float), 0, -1) - middle
    line = [middle - 30 * tangent, middle + 30 * tangent]
    _, distance = sample_path(line, 1.0)
    strip = sample_strip(line, distance, width, 1.0)
    assert strip.shape == (21, len(distance), 2)
    across = interpolate(np.cos(k * place @ normal), strip, lambda at: at)
    half = k * width / 2
    np.testing.assert_allclose(across, np.sin(half) / half, atol=0.003)
    on_line = interpolate(np.cos(k * place @ tangent), strip, lambda at: at)
    np.testing.assert_allclose(on_line, np.cos(k * (distance - 30)), atol=0.003)


def test_a_strip_of_whole_pixels_is_the_mean_of_their_rows() -> None:
    y, x = np.mgrid[:40, :50].astype(float)
    line = [[20.0, 5.0], [20.0, 45.0]]
    _, distance = sample_path(line, 1.0)
    for width in (1, 5, 9):
        values = interpolate(y**2 + x, sample_strip(line, distance, width, 1.0), lambda at: at)
        np.testing.assert_allclose(values, 400 + (width**2 - 1) / 12 + 5 + distance)
    # A row that is partly outside counts as far as it is inside.
    edge = [[0.0, 5.0], [0.0, 45.0]]
    values = interpolate(y, sample_strip(edge, distance, 5, 1.0), lambda at: at)
    np.testing.assert_allclose(values, 1.0)
    path = [[5.0, 5.0], [5.0, 15.0], [25.0, 15.0]]
    _, distance = sample_path(path, 1.0)
    strip = sample_strip(path, distance, 3.0, 1.0)
    np.testing.assert_allclose(np.ptp(strip[:, distance < 9.5, 0], axis=0), 2)
    np.testing.assert_allclose(np.ptp(strip[:, distance > 10.5, 1], axis=0), 2)


def test_measures_of_a_gaussian_are_those_of_its_formula() -> None:
    distance = np.linspace(0.0, 100.0, 4001)
    measures = measure_peak(distance, -3.0 * np.exp(-((distance - 40) ** 2) / (2 * 5.0**2)))
    assert measures is not None
    assert (measures.peak, measures.position) == (-3.0, 40.0)
    assert measures.width == pytest.approx(5 * np.sqrt(8 * np.log(2)), rel=1e-3)
    assert measures.area == pytest.approx(-3 * 5 * np.sqrt(2 * np.pi), rel=1e-6)
    assert "width (FWHM) 11.77 µm, area -37.6 T·µm" in measures.text("T", "µm")


def test_width_beyond_the_line_is_told_as_such() -> None:
    distance = np.linspace(0.0, 10.0, 11)
    values = np.where(distance > 8, np.nan, 5.0 - 0.1 * distance)
    measures = measure_peak(distance, values)
    assert measures is not None
    assert np.isnan(measures.width)
    assert measures.area == pytest.approx(8 * 4.6)
    assert "width (FWHM) beyond the line" in measures.text("T", "µm")
    assert measure_peak(distance, np.full(11, np.nan)) is None
