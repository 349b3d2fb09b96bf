from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from helpers.polygons import over_pixels
from napari_shadowinv.geometry.density import Density, resolve_pixels, walk_edge
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation


def integrate(polygon, density):
    """Sum the walks along all edges of a polygon given in the image's coordinates."""
    corners = polygon + 0.5
    total = np.zeros(5)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        total += walk_edge(density.image, density.sums, (*start, *end), True, True)
    # the walk goes counter-clockwise in (y, x), for which ∮ F dy is minus the mass
    return -total[1:]


def convex_polygon(rng, low, high):
    points = rng.uniform(low, high, (12, 2))
    return points[ConvexHull(points).vertices]


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_moments_of_convex_polygons_equal_clipping_every_pixel(seed):
    rng = np.random.default_rng(seed)
    image = rng.random((7, 9))
    polygon = convex_polygon(rng, (-3, -3), (9, 11))  # some of it beyond the image
    mass, moments, inertia = over_pixels(polygon, image)
    got = integrate(polygon, Density.from_image(image))
    np.testing.assert_allclose(got[0], mass, atol=1e-11)
    # clipping measures from the centre of pixel (0, 0), the walk from its corner
    shifted = moments + 0.5 * mass
    np.testing.assert_allclose(got[1:3], shifted, atol=1e-10)
    np.testing.assert_allclose(got[3], inertia + moments.sum() + 0.5 * mass, atol=1e-9)


def test_flux_is_the_intensity_times_the_length_in_each_pixel():
    image = np.array([[1.0, 10.0], [100.0, 1000.0]])
    density = Density.from_image(image)
    along_row = walk_edge(density.image, density.sums, (0.5, -3.0, 0.5, 1.25), False, False)
    assert along_row[0] == pytest.approx(1.0 + 10.0 * 0.25)
    diagonal = walk_edge(density.image, density.sums, (5.0, 5.0, -5.0, -5.0), False, False)
    assert diagonal[0] == pytest.approx(np.sqrt(2) * (1.0 + 1000.0))


def test_beyond_the_image_there_is_no_flux():
    density = Density.from_image(np.ones((4, 5)))
    for ends in [(-2, 1, -1, 4), (4.5, 0, 7, 3), (1, -3, 3, -0.1), (1, 5.1, 3, 9)]:
        assert walk_edge(density.image, density.sums, tuple(map(float, ends)), False, False)[0] == 0


@given(st.lists(st.integers(0, 12), min_size=4, max_size=4))
def test_density_edges_through_corners_cancel_in_return(ends):
    """Walking there and back is nothing, and the ways round a pixel grid close."""
    ya, xa, yb, xb = (end / 2 - 1 for end in ends)
    density = Density.from_image(np.arange(1.0, 17.0).reshape(4, 4))
    forward = np.array(walk_edge(density.image, density.sums, (ya, xa, yb, xb), True, True))
    back = np.array(walk_edge(density.image, density.sums, (yb, xb, ya, xa), True, True))
    np.testing.assert_allclose(forward[1:], -back[1:], atol=1e-12)
    detour = np.array([ya, xb])
    triangle = np.array([[ya, xa], detour, [yb, xb]]) - 0.5
    mass, moments, _ = over_pixels(triangle, np.arange(1.0, 17.0).reshape(4, 4))
    got = integrate(triangle, density)
    np.testing.assert_allclose(abs(got[0]), abs(mass), atol=1e-12)
    np.testing.assert_allclose(np.abs(got[1:3]), np.abs(moments + 0.5 * mass), atol=1e-11)


def blocks_of(fine, parts=3):
    height, width = fine.shape
    return fine.reshape(height // parts, parts, width // parts, parts)


def test_resolved_pixels_keep_their_flux_and_stay_positive():
    image = np.random.default_rng(0).exponential(size=(12, 17))
    image[4:7, 5:9] = 0
    fine = resolve_pixels(image)
    np.testing.assert_allclose(blocks_of(fine).sum(axis=(1, 3)), image, rtol=1e-13, atol=1e-15)
    assert (blocks_of(fine) >= image[:, None, :, None] / 18 - 1e-15).all()


def test_the_flux_of_polynomials_up_to_degree_four_is_exact():
    """In pixels with two more on each side; that of straight lines up to the border."""

    def flux(per_pixel, degree):
        borders = np.linspace(-8, 8, 16 * per_pixel + 1)
        along = np.diff(borders ** (degree + 1)) / (degree + 1)
        return 9e4 * np.diff(borders)[0] ** 2 + np.outer(along, along)

    for degree in range(5):
        inside = np.s_[:, :] if degree < 2 else np.s_[6:-6, 6:-6]
        fine = resolve_pixels(flux(1, degree))
        np.testing.assert_allclose(fine[inside], flux(3, degree)[inside], rtol=1e-10)


def test_a_step_stays_a_step_two_pixels_away():
    image = np.ones((10, 12))
    image[:, 6:] = 50.0
    fine = resolve_pixels(image)
    np.testing.assert_allclose(fine[:, : 3 * 4], 1 / 9, rtol=1e-12)
    np.testing.assert_allclose(fine[:, 3 * 8 :], 50 / 9, rtol=1e-12)
    assert fine.min() >= 0.5 / 9
    assert fine.max() < 1.2 * 50 / 9


def test_masses_over_a_resolved_image_are_those_of_its_parts():
    image = 1 + np.random.default_rng(1).random((9, 11))
    density = Density.from_image(image).resolved()
    assert density.shape == image.shape
    sites = np.random.default_rng(2).uniform(0, 8, (30, 2))
    diagram = PowerDiagram(RegularTriangulation(sites, region=density.region), density)
    apart = Density.from_image(resolve_pixels(image))
    triangulation = RegularTriangulation(3 * (sites + 0.5) - 0.5, region=apart.region)
    parts = PowerDiagram(triangulation, apart, with_moments=True)
    np.testing.assert_allclose(diagram.masses, parts.masses, rtol=1e-10)
    assert diagram.masses.sum() == pytest.approx(image.sum())
