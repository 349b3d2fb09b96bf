from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from helpers.polygons import over_pixels
from napari_shadowinv.geometry.density import Density, walk_edge


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
