from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.geometry.interpolation import (
    WIDTH,
    CloughTocher,
    corner_weights,
    fit_gradients,
    with_gradients,
)
from napari_shadowinv.geometry.triangulation import RegularTriangulation


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
    for column in range(WIDTH):
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
