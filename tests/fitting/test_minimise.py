"""L-BFGS and conjugate gradients on problems with known answers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, eigensystem, solve
from napari_shadowinv.fitting.descent import minimise


def positive_definite(size: int, seed: int) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(size, size))
    return np.asarray(root @ root.T + np.eye(size))


def rosenbrock(point: FloatArray) -> tuple[float, FloatArray]:
    x, y = point
    value = (1 - x) ** 2 + 100 * (y - x**2) ** 2
    return value, np.array([-2 * (1 - x) - 400 * x * (y - x**2), 200 * (y - x**2)])


def test_a_quadratic_has_its_minimum_where_the_gradient_vanishes() -> None:
    matrix, right = positive_definite(30, 0), np.random.default_rng(1).normal(size=30)

    def objective(point: FloatArray) -> tuple[float, FloatArray]:
        return float(point @ matrix @ point / 2 - right @ point), matrix @ point - right

    point, value, _ = minimise(objective, np.zeros(30), iterations=300, least_gain=1e-14)
    exact = np.linalg.solve(matrix, right)
    np.testing.assert_allclose(point, exact, atol=1e-5)
    assert value == pytest.approx(-right @ exact / 2, rel=1e-10)


def test_a_curved_valley_is_followed_to_its_end() -> None:
    values: list[float] = []
    start, told = np.array([-1.2, 1.0]), values.append
    point, value, steps = minimise(
        rosenbrock, start, iterations=200, least_gain=1e-15, after_step=told
    )
    np.testing.assert_allclose(point, 1, atol=1e-5)
    assert value < 1e-10
    assert len(values) == steps < 80
    assert values == sorted(values, reverse=True)
    assert values[-1] == value


def test_it_ends_after_the_most_steps_or_where_little_is_gained() -> None:
    start = np.array([-1.2, 1.0])
    assert minimise(rosenbrock, start, iterations=7, least_gain=0)[2] == 7
    _, value, steps = minimise(rosenbrock, start, iterations=200, least_gain=0.5)
    assert steps < 30
    assert value < rosenbrock(start)[0]


def test_conjugate_gradients_solve_what_elimination_solves() -> None:
    matrix, right = positive_definite(40, 2), np.random.default_rng(3).normal(size=40)
    solution = solve(lambda v: matrix @ v, right, tolerance=1e-12, iterations=400)
    np.testing.assert_allclose(solution, np.linalg.solve(matrix, right), atol=1e-8)


def test_conjugate_gradients_end_at_the_tolerance() -> None:
    matrix, right = positive_definite(40, 4), np.random.default_rng(5).normal(size=40)
    solution, _ = solve_and_count(matrix, right, tolerance=0.05)
    residual = np.linalg.norm(matrix @ solution - right) / np.linalg.norm(right)
    assert 1e-4 < residual <= 0.05 * 1.001
    assert solve_and_count(matrix, right, tolerance=0, iterations=3)[1] == 3


def test_nothing_on_the_right_gives_nothing() -> None:
    np.testing.assert_array_equal(
        solve(lambda v: v, np.zeros(4), tolerance=0.1, iterations=5), np.zeros(4)
    )


def with_soft_directions(size: int, soft: int, seed: int, stiff: int = 0) -> FloatArray:
    """A matrix with eigenvalues between 0.6 and 2, but for some down to 0.0001 or up to 3000."""
    rng = np.random.default_rng(seed)
    directions = np.linalg.qr(rng.normal(size=(size, size)))[0]
    values = np.append(np.geomspace(1e-4, 0.3, soft), rng.uniform(0.6, 2, size - soft))
    values[size - stiff :] = np.geomspace(10, 3000, stiff)
    return np.asarray(directions * values @ directions.T)


def solve_and_count(
    matrix: FloatArray,
    right: FloatArray,
    modes: SoftModes | None = None,
    *,
    tolerance: float = 1e-6,
    iterations: int = 2000,
) -> tuple[FloatArray, int]:
    """Return the solution, and how often it took the matrix: once in each step."""
    products = 0

    def times(vector: FloatArray) -> FloatArray:
        nonlocal products
        products += 1
        return np.asarray(matrix @ vector)

    solution = solve(times, right, tolerance=tolerance, iterations=iterations, modes=modes)
    return solution, products


def test_soft_modes_of_a_solution_make_the_next_ones_short() -> None:
    rng = np.random.default_rng(6)
    matrix, modes = with_soft_directions(600, 25, 7), SoftModes()
    # A matrix nearby: the energy of no vector changes by more than 2 %.
    root = np.linalg.cholesky(matrix)
    noise = rng.normal(size=matrix.shape)
    noise = (noise + noise.T) / np.linalg.norm(noise + noise.T, 2)
    nearby = root @ (np.eye(600) + 0.02 * noise) @ root.T
    for _ in range(2):
        solve_and_count(matrix, rng.normal(size=600), modes)
    assert 20 <= len(modes) <= 40
    right = rng.normal(size=600)
    solution, steps = solve_and_count(nearby, right, modes)
    plain, plain_steps = solve_and_count(nearby, right)
    assert steps < 40 < 150 < plain_steps
    error = np.linalg.norm(nearby @ solution - right) / np.linalg.norm(right)
    assert error < 1.1e-6
    np.testing.assert_allclose(solution, plain, atol=2e-3 * np.abs(plain).max())


def test_stiff_modes_make_solutions_short_and_scales_stay_positive() -> None:
    rng = np.random.default_rng(12)
    matrix, modes = with_soft_directions(400, 15, 13, stiff=25), SoftModes()
    for _ in range(3):
        solve_and_count(matrix, rng.normal(size=400), modes)
    right = rng.normal(size=400)
    solution, steps = solve_and_count(matrix, right, modes)
    _, plain_steps = solve_and_count(matrix, right)
    assert steps < plain_steps / 3
    assert np.linalg.norm(matrix @ solution - right) < 1.1e-6 * np.linalg.norm(right)
    scales = np.array([modes.precondition(unit) for unit in np.eye(400)])
    np.testing.assert_allclose(scales, scales.T, atol=1e-9 * np.abs(scales).max())
    assert np.linalg.eigvalsh(scales)[0] > 0


def test_modes_of_another_matrix_do_no_harm() -> None:
    rng, modes = np.random.default_rng(8), SoftModes()
    solve_and_count(with_soft_directions(300, 20, 9, stiff=20), rng.normal(size=300), modes)
    assert len(modes) > 0
    for size in (300, 200):
        matrix, right = with_soft_directions(size, 20, 10), rng.normal(size=size)
        solution, _ = solve_and_count(matrix, right, modes)
        assert np.linalg.norm(matrix @ solution - right) < 1.1e-6 * np.linalg.norm(right)


def test_threads_of_linear_algebra_change_no_bit_of_a_solution() -> None:
    solutions = []
    for threads in (1, 2):
        rng, modes = np.random.default_rng(11), SoftModes()
        values = np.append(np.geomspace(1e-4, 0.3, 90), rng.uniform(0.6, 2, 8000))
        options: dict[str, Any] = {"tolerance": 1e-6, "iterations": 2000, "modes": modes}
        with threadpool_limits(threads, user_api="blas"):
            for right in rng.normal(size=(3, values.size)):
                solution = solve(lambda v, values=values: values * v, right, **options)  # type: ignore[misc]
        assert len(modes) > 64  # of fewer, products use one thread in any case
        solutions.append(solution)
    np.testing.assert_array_equal(*solutions)


@pytest.mark.parametrize("size", [1, 2, 3, 40, 110])
def test_eigensystem_is_that_of_lapack(size: int) -> None:
    rng = np.random.default_rng(size)
    matrix = rng.normal(size=(size, size))
    matrix += matrix.T
    values, vectors = eigensystem(matrix)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-12 * size)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(size), atol=1e-12)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, atol=1e-11)
    diagonal = np.diag(np.arange(1.0, size + 1))
    np.testing.assert_allclose(eigensystem(diagonal)[0], np.arange(1, size + 1), atol=1e-14)
