from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.geometry.interpolation import (
    WIDTH,
    CloughTocher,
    corner_weights,
    fit_gradients,
    with_gradients,
    with_mirror_images,
)
from napari_shadowinv.geometry.triangulation import RegularTriangulation


def quadratic(points):
    y, x = points.T
    return 3 + 2 * y - x + 0.5 * y**2 - 0.25 * x**2 + 0.125 * y * x


def quadratic_gradient(points):
    y, x = points.T
    return np.column_stack([2 + y + 0.125 * x, -1 - 0.5 * x + 0.125 * y])


@pytest.fixture
def sites():
    return np.random.default_rng(0).random((300, 2)) * 10


def slopes(surface, points, step=1e-8):
    """Of a surface at points, by differences across them."""
    along = [
        (surface(points + shift) - surface(points - shift)) / (2 * step)
        for shift in step * np.eye(2)
    ]
    return np.column_stack(along)


def test_quadratics_are_met_exactly(sites):
    surface = CloughTocher(RegularTriangulation(sites), quadratic(sites), quadratic_gradient(sites))
    queries = np.random.default_rng(1).random((500, 2)) * 6 + 2
    np.testing.assert_allclose(surface(queries), quadratic(queries), rtol=1e-11)


def test_values_and_gradients_are_met_at_the_sites(sites):
    rng = np.random.default_rng(6)
    values, gradients = rng.random(300), rng.normal(size=(300, 2))
    surface = CloughTocher(RegularTriangulation(sites), values, gradients)
    np.testing.assert_allclose(surface(sites), values, rtol=1e-9)
    inner = ((sites > 1) & (sites < 9)).all(axis=1)
    np.testing.assert_allclose(slopes(surface, sites[inner]), gradients[inner], atol=2e-4)


def test_surface_and_its_gradient_are_continuous_across_edges(sites):
    rng = np.random.default_rng(2)
    triangulation = RegularTriangulation(sites)
    surface = CloughTocher(triangulation, rng.random(300), rng.normal(size=(300, 2)))
    inner = (triangulation.vertices < 300).all(axis=1)
    inner &= inner[triangulation.neighbors[:, 2]]  # beyond the hull the surface is cut off
    corners = sites[triangulation.vertices[inner]]
    on_edge = 0.3 * corners[:, 0] + 0.7 * corners[:, 1]
    edge = corners[:, 1] - corners[:, 0]
    length = np.linalg.norm(edge, axis=1)
    across = np.column_stack([-edge[:, 1], edge[:, 0]]) / length[:, None]

    def slope(step):
        """Next to the edge, to second order in the step."""
        near, far, twice = (surface(on_edge + k * step * across) for k in (1, 2, 4))
        return 2 * (far - near) / step - (twice - far) / (2 * step)

    below, above = surface(on_edge - 1e-9 * across), surface(on_edge + 1e-9 * across)
    steepness = np.abs(slope(3e-7)).max()
    np.testing.assert_allclose(below, above, atol=1e-6 * steepness)
    np.testing.assert_allclose(slope(-3e-7), slope(3e-7), atol=1e-4 * steepness)


def test_interpolation_cache_changes_nothing(sites):
    rng = np.random.default_rng(7)
    values, gradients = rng.random(300), rng.normal(size=(300, 2))
    surface = CloughTocher(RegularTriangulation(sites), values, gradients)
    queries = rng.random((400, 2)) * 12 - 1  # also beyond the sites
    each = np.concatenate([surface(query[None]) for query in queries])
    np.testing.assert_allclose(surface(queries), each, rtol=1e-11)


def test_fitted_gradients_bend_the_edges_least(sites):
    """Many sweeps reach the minimum: no small change of any gradient lowers the energy."""
    triangulation = RegularTriangulation(sites)
    values = np.sin(sites[:, 0]) * sites[:, 1]
    pairs = {
        tuple(sorted((a, b)))
        for t in triangulation.vertices.tolist()
        for a, b in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))
        if max(a, b) < 300
    }
    a, b = np.array(sorted(pairs)).T
    edge = sites[b] - sites[a]
    length = np.linalg.norm(edge, axis=1)

    def energy(gradients):
        rise = values[b] - values[a]
        s, t = (gradients[a] * edge).sum(axis=1), (gradients[b] * edge).sum(axis=1)
        return (4 / length**3 * (s**2 + s * t + t**2 - 3 * (s + t) * rise + 3 * rise**2)).sum()

    fitted = np.zeros((300, 2))
    for _ in range(400):
        fitted = fit_gradients(triangulation, values, fitted)
    least = energy(fitted)
    for change in np.random.default_rng(4).normal(size=(10, 300, 2)):
        assert energy(fitted + 1e-3 * change) > least


def test_mirror_images_lie_beyond_the_border_equally_far():
    sites = np.array([[0.0, 5.0], [5.0, 5.0], [9.2, 9.0]])
    points, origin, sense = with_mirror_images(sites, (10, 10), 1.5)
    np.testing.assert_array_equal(points[:3], sites)
    expected = {
        (-1.0, 5.0, 0, -1, 1),
        (9.8, 9.0, 2, -1, 1),
        (9.2, 10.0, 2, 1, -1),
        (9.8, 10.0, 2, -1, -1),
    }
    images = np.column_stack([points, origin, sense])[3:].round(9)
    assert set(map(tuple, images.tolist())) == expected


@pytest.mark.parametrize("threads", [1, 3])
def test_pixels_equal_points_for_any_number_of_threads(threads):
    """Also beyond the hull, and on sites and edges that lie on pixels."""
    rng = np.random.default_rng(3)
    shape = 150, 400
    sites = np.concatenate(
        [rng.random((700, 2)) * (120, 380) + 10, np.indices((5, 5)).reshape(2, -1).T * 4.0 + 40]
    )
    values, gradients = rng.normal(size=len(sites)), rng.normal(size=(len(sites), 2))
    surface = CloughTocher(RegularTriangulation(sites), values, gradients, threads=threads)
    pixels = np.indices(shape, dtype=float).reshape(2, -1).T
    expected = surface(pixels).reshape(shape)
    np.testing.assert_allclose(surface.at_pixels(shape), expected, rtol=1e-7, atol=1e-7)
    alone = CloughTocher(RegularTriangulation(sites), values, gradients, threads=1)
    np.testing.assert_array_equal(surface.at_pixels(shape), alone.at_pixels(shape))
    np.testing.assert_array_equal(expected, alone(pixels).reshape(shape))


@pytest.fixture(scope="module")
def triangulation():
    return RegularTriangulation(np.random.default_rng(0).random((400, 2)) * 20)


@pytest.fixture(scope="module")
def values():
    return np.random.default_rng(1).normal(size=(400, WIDTH))


def mean_of_triangles(triangulation, values):
    """Gradients at the sites, by solving for the plane over each triangle."""
    total, area = np.zeros((len(values), 2)), np.zeros(len(values))
    for corners in triangulation.vertices:
        if corners.max() < len(values):
            edges = triangulation.sites[corners[1:]] - triangulation.sites[corners[0]]
            size = abs(np.linalg.det(edges))
            total[corners] += size * np.linalg.solve(
                edges, values[corners[1:]] - values[corners[0]]
            )
            area[corners] += size
    return total / area[:, None]


def test_gradients_equal_separate_sets_of_values(triangulation, values):
    surface = with_gradients(triangulation, values)
    np.testing.assert_array_equal(surface[:, 0], values)
    for column in range(0, WIDTH, 5):
        begun = mean_of_triangles(triangulation, values[:, column])
        fitted = fit_gradients(triangulation, values[:, column], begun)
        np.testing.assert_allclose(surface[:, 1:, column], fitted, rtol=1e-9, atol=1e-9)


def test_corner_weights_give_the_surface_also_beyond_the_sites(triangulation, values):
    rng = np.random.default_rng(2)
    gradients = rng.normal(size=(400, 2))
    queries = np.sort(rng.random((5000, 2)) * 24 - 2, axis=0)
    corners, weights = corner_weights(triangulation, queries)
    at_sites = np.column_stack([values[:, 0], gradients])
    interpolated = (weights * at_sites[corners]).sum(axis=(1, 2))
    surface = CloughTocher(triangulation, values[:, 0], gradients)
    np.testing.assert_allclose(interpolated, surface(queries), rtol=1e-9, atol=1e-9)
    again = corner_weights(triangulation, queries, threads=3)
    np.testing.assert_array_equal(corners, again[0])
    np.testing.assert_array_equal(weights, again[1])
