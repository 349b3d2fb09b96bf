from __future__ import annotations

from unittest.mock import Mock

import numpy as np
import pytest

from helpers.polygons import residual
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.transport.minimise import TransportObjective, newton
from napari_shadowinv.transport.sites import plan_levels
from napari_shadowinv.transport.solvers import Target, solve


def bright_spot(shape=(40, 50)):
    y, x = np.indices(shape)
    image = 0.2 + 3 * np.exp(-(((y - 15) / 5) ** 2) - ((x - 30) / 7) ** 2)
    return image / image.mean()


@pytest.fixture(scope="module")
def plan():
    return plan_levels(np.ones((40, 50)), 2000, lloyd_iterations=5)


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-8])
def test_every_cell_holds_its_flux_to_the_tolerance(plan, tolerance):
    target = Target.of(bright_spot(), InversionOptions(tolerance=tolerance))
    solution = solve(plan.levels, target)[-1]
    assert solution.converged
    assert residual(plan.levels[-1], solution.weights, bright_spot()) <= tolerance
    assert solution.weights.mean() == pytest.approx(0, abs=1e-12)


def test_newton_converges_quadratically_near_the_solution(plan):
    level = plan.levels[-1]
    objective = TransportObjective(
        level.triangulation.copy(), level.mass, Density.from_image(bright_spot())
    )
    rough = Target.of(bright_spot(), InversionOptions(tolerance=1e-2))
    start = solve(plan.levels, rough)[-1].weights
    residuals = [
        newton(objective, start, tolerance=1e-14, max_iterations=steps).residual
        for steps in (0, 1, 2)
    ]
    assert residuals[1] < 0.05 * residuals[0]
    assert residuals[2] < 0.05 * residuals[1]


@pytest.mark.parametrize("stages", ["single", "multi"])
def test_descent_finds_the_weights_that_newton_finds(stages):
    plan = plan_levels(np.ones((30, 30)), 150, lloyd_iterations=20)
    y, x = np.indices((30, 30))
    image = 1 + 0.5 * np.sin(y / 5) * np.cos(x / 4)
    image /= image.mean()
    by_newton = solve(plan.levels, Target.of(image, InversionOptions(tolerance=1e-6)))[-1]
    options = InversionOptions(tolerance=1e-6, max_iterations=5000, solver="lbfgs", stages=stages)
    by_descent = solve(plan.levels, Target.of(image, options))[-1]
    assert by_descent.converged
    np.testing.assert_allclose(by_descent.weights, by_newton.weights, atol=1e-4)


@pytest.mark.parametrize(("solver", "steps"), [("newton", 0), ("lbfgs", 1)])
def test_a_solution_as_start_is_the_answer(plan, solver, steps):
    """Descent always makes a step before it asks how good it is."""
    options = InversionOptions(tolerance=1e-2, solver=solver, max_iterations=3000)
    cold = solve(plan.levels, Target.of(bright_spot(), InversionOptions(tolerance=1e-2)))
    (warm,) = solve(plan.levels, Target.of(bright_spot(), options), start=cold[-1].weights)
    assert warm.converged
    assert warm.iterations == steps
    np.testing.assert_allclose(warm.weights, cold[-1].weights, rtol=0, atol=0.05 * steps + 1e-9)


def test_a_start_that_leads_nowhere_has_no_influence(plan):
    rng = np.random.default_rng(0)
    nonsense = 1e4 * rng.normal(size=len(plan.levels[-1].sites))
    folding = bright_spot() ** 3
    image = folding / folding.mean() + 1e-3
    image /= image.mean()
    cold = solve(plan.levels, Target.of(image, InversionOptions()))
    warm = solve(plan.levels, Target.of(image, InversionOptions()), start=nonsense)
    assert cold[-1].converged
    assert len(warm) == len(cold) > 1
    np.testing.assert_array_equal(warm[-1].weights, cold[-1].weights)


def test_a_start_that_does_not_converge_is_no_worse_than_none(plan):
    options = InversionOptions(tolerance=1e-12, max_iterations=1)
    start = np.zeros(len(plan.levels[-1].sites))
    cold = solve(plan.levels, Target.of(bright_spot(), options))[-1]
    warm = solve(plan.levels, Target.of(bright_spot(), options), start=start)[-1]
    assert not warm.converged
    assert warm.residual == cold.residual


@pytest.mark.parametrize("is_warm", [False, True])
def test_a_request_to_stop_ends_the_solver(plan, is_warm):
    stop = Mock(side_effect=[False, False, False, True])
    start = np.zeros(len(plan.levels[-1].sites)) if is_warm else None
    target = Target.of(bright_spot(), InversionOptions())
    with pytest.raises(InversionCancelled, match="transport"):
        solve(plan.levels, target, Reporter(None, stop), start=start)
    assert stop.call_count == 4


def test_a_few_almost_empty_cells_do_not_shorten_the_steps():
    """Near a caustic the coarser sites' start has such cells: they settle among neighbours."""
    image = synthetic_image(gaussian_blob((100, 100), 280.0, 9.0).displacement)
    image = np.maximum(image, 1e-3)
    plan = plan_levels(np.ones(image.shape), image.size, lloyd_iterations=5)
    answers = solve(plan.levels, Target.of(image / image.mean(), InversionOptions()))
    assert all(answer.converged for answer in answers)
    # Steps that those cells kept short were 8, 5 and 9.
    assert all(answer.iterations <= 4 for answer in answers[1:])


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
