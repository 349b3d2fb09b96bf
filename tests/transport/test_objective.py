from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.transport.minimise import TransportObjective


@pytest.fixture
def problem():
    rng = np.random.default_rng(0)
    image = rng.random((12, 15)) + 0.1
    sites = rng.random((50, 2)) * image.shape - 0.5
    mass = np.full(50, image.sum() / 50)
    objective = TransportObjective(RegularTriangulation(sites), mass, Density.from_image(image))
    return objective, 0.5 * rng.random(50), rng


def test_gradient_is_the_slope_of_the_value(problem):
    objective, weights, rng = problem
    _, gradient = objective.value_and_gradient(weights)
    for _ in range(10):
        direction = rng.normal(size=50)
        step = 1e-5
        above, _ = objective.value_and_gradient(weights + step * direction)
        below, _ = objective.value_and_gradient(weights - step * direction)
        assert (above - below) / (2 * step) == pytest.approx(gradient @ direction, rel=1e-6)


def test_hessian_is_the_slope_of_the_gradient(problem):
    objective, weights, rng = problem
    hessian = objective.diagram(weights).laplacian()
    for _ in range(10):
        direction = rng.normal(size=50)
        step = 1e-6
        above = objective.value_and_gradient(weights + step * direction)[1]
        below = objective.value_and_gradient(weights - step * direction)[1]
        np.testing.assert_allclose(
            (above - below) / (2 * step), hessian @ direction, atol=2e-5 * np.abs(direction).max()
        )


def test_value_is_convex_and_ignores_a_common_weight(problem):
    objective, weights, rng = problem
    second_weights = weights + rng.normal(size=50)
    ends = [objective.value_and_gradient(w)[0] for w in (weights, second_weights)]
    middle = objective.value_and_gradient((weights + second_weights) / 2)[0]
    assert middle < np.mean(ends)
    shifted = objective.value_and_gradient(weights + 3.0)[0]
    assert shifted == pytest.approx(ends[0], rel=1e-12)


def test_empty_cell_gives_none_and_keeps_the_diagram_usable(problem):
    objective, weights, _ = problem
    collapsed = weights.copy()
    collapsed[7] -= 1e3
    before = objective.diagram(weights).masses
    assert objective.diagram_if_full(collapsed) is None
    again = objective.diagram_if_full(weights)
    assert again is not None
    np.testing.assert_allclose(again.masses, before, atol=1e-11)
