"""Properties of solutions of Newton's systems, for easy and for difficult networks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.sparse import block_diag, coo_array, csr_array, diags_array
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay

from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation, hilbert_order
from napari_shadowinv.transport import linear
from napari_shadowinv.transport.linear import FactorisedLaplacian, LaplacianSolver, SimilarSystems

Array = NDArray[np.float64]
Edges = NDArray[np.int64]


def laplacian_of(edges: Edges, conductances: Array, n: int) -> csr_array:
    a, b = edges.T
    both = coo_array(
        (np.tile(conductances, 2), (np.append(a, b), np.append(b, a))), shape=(n, n)
    ).tocsr()
    return csr_array(diags_array(both.sum(axis=1)) - both)


def delaunay_edges(n: int, seed: int = 0) -> tuple[Array, Edges]:
    points = np.random.default_rng(seed).random((n, 2))
    points = points[hilbert_order(points)]
    corners = Delaunay(points).simplices
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])
    return points, np.unique(np.sort(pairs, axis=1), axis=0)


def grid_edges(height: int, width: int) -> Edges:
    node = np.arange(height * width).reshape(height, width)
    across = np.stack([node[:, :-1].ravel(), node[:, 1:].ravel()], axis=1)
    down = np.stack([node[:-1].ravel(), node[1:].ravel()], axis=1)
    return np.concatenate([across, down])


def unit_delaunay(n: int) -> csr_array:
    _, edges = delaunay_edges(n)
    return laplacian_of(edges, np.ones(len(edges)), n)


def independent_contrast(n: int) -> csr_array:
    _, edges = delaunay_edges(n)
    exponents = np.random.default_rng(1).uniform(-4, 4, len(edges))
    return laplacian_of(edges, 10**exponents, n)


def conducting_islands(n: int) -> csr_array:
    _, edges = delaunay_edges(n)
    exponent = np.where(np.random.default_rng(2).random(n) < 0.3, 4.0, -4.0)
    return laplacian_of(edges, 10 ** exponent[edges].min(axis=1), n)


def smooth_contrast(n: int) -> csr_array:
    points, edges = delaunay_edges(n)
    middle = points[edges].mean(axis=1)
    exponents = 4 * np.sin(9 * middle[:, 0]) * np.cos(7 * middle[:, 1])
    return laplacian_of(edges, 10**exponents, n)


def grid(n: int, anisotropy: float = 1.0) -> csr_array:
    side = round(np.sqrt(n))
    edges = grid_edges(side, side)
    across = edges[:, 1] - edges[:, 0] == 1
    return laplacian_of(edges, np.where(across, anisotropy, 1.0), side * side)


def path(n: int) -> csr_array:
    nodes = np.arange(n)
    return laplacian_of(np.stack([nodes[:-1], nodes[1:]], axis=1), np.ones(n - 1), n)


def star(n: int) -> csr_array:
    leaves = np.arange(1, n)
    return laplacian_of(np.stack([np.zeros_like(leaves), leaves], axis=1), np.ones(n - 1), n)


def tangle(n: int) -> csr_array:
    edges = np.random.default_rng(3).integers(0, n, (10 * n, 2))
    edges = edges[edges[:, 0] != edges[:, 1]]
    return laplacian_of(edges, np.ones(len(edges)), n)


def noise(n: int, seed: int = 4) -> Array:
    values = np.random.default_rng(seed).standard_normal(n)
    return np.asarray(values - values.mean())


def residual(laplacian: csr_array, solution: Array, right: Array) -> float:
    return float(np.linalg.norm(right - laplacian @ solution) / np.linalg.norm(right))


def noisy_caustic(n: int) -> csr_array:
    """Newton's system of cells with hardly any flux beside bright ones."""
    rng = np.random.default_rng(5)
    y, x = np.mgrid[-1:1:100j, -1:1:100j]
    ring = np.exp(-(((np.hypot(y, x) - 0.5) / 0.02) ** 2))
    image = np.maximum(0.2 + 10 * ring + rng.normal(0, 0.2, ring.shape), 1e-3)
    sites = rng.uniform(-0.5, 99.5, (n, 2))
    triangulation = RegularTriangulation(sites[hilbert_order(sites)])
    return PowerDiagram(triangulation, Density.from_image(image)).laplacian()


NETWORKS = {
    "Delaunay": lambda: unit_delaunay(20_000),
    "independent contrast 1e8": lambda: independent_contrast(20_000),
    "islands 1e8": lambda: conducting_islands(20_000),
    "smooth contrast 1e8": lambda: smooth_contrast(20_000),
    "grid": lambda: grid(20_000),
    "grid, 1000 times more along x": lambda: grid(20_000, 1000.0),
    "path": lambda: path(20_000),
    "star": lambda: star(20_000),
    "not planar": lambda: tangle(3_000),
    "noisy caustic": lambda: noisy_caustic(20_000),
}


@given(n=st.integers(4, 700), seed=st.integers(0, 1000), decades=st.floats(0, 3))
@settings(max_examples=30, deadline=None)
def test_small_systems_have_the_pseudoinverse_solution(n: int, seed: int, decades: float) -> None:
    _, edges = delaunay_edges(n, seed)
    exponents = np.random.default_rng(seed).uniform(-decades, decades, len(edges)) / 2
    laplacian = laplacian_of(edges, 10**exponents, n)
    right = noise(n, seed)
    # Right-hand sides without a mean have that of the pseudoinverse once constants are tied down.
    expected = np.linalg.solve(laplacian.toarray() + 1 / n, right)
    for solution in (
        SimilarSystems().solve(laplacian, right, 1e-12),
        LaplacianSolver(laplacian).solve(right, 1e-12)[0],
    ):
        assert np.abs(solution - expected).max() < 1e-7 * np.abs(expected).max()


def test_larger_systems_have_the_factorised_solution() -> None:
    laplacian = smooth_contrast(5000)
    right = noise(5000)
    expected = np.append(0.0, splu(laplacian[1:, 1:].tocsc()).solve(right[1:]))
    expected -= expected.mean()
    solution = SimilarSystems().solve(laplacian, right, 1e-10)
    assert np.abs(solution - expected).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("name", NETWORKS)
def test_tolerance_is_honoured_in_few_iterations(name: str) -> None:
    laplacian = NETWORKS[name]()
    right = noise(laplacian.shape[0])
    solution, iterations, reported = LaplacianSolver(laplacian).solve(right, 1e-2)
    assert iterations <= 30
    assert reported <= 1e-2
    assert residual(laplacian, solution, right) <= 1e-2
    assert abs(solution.mean()) < 1e-12 * np.abs(solution).max()


def test_iterations_hardly_grow_with_size() -> None:
    def iterations(n: int) -> int:
        return LaplacianSolver(unit_delaunay(n)).solve(noise(n), 1e-8)[1]

    assert iterations(40_000) <= 1.6 * iterations(2_500)


@pytest.mark.parametrize(
    ("name", "blocks"),
    [("islands 1e8", 2), *((name, 28) for name in NETWORKS)],  # the most make them on two levels
)
def test_blocks_of_nodes_cost_hardly_an_iteration(name: str, blocks: int) -> None:
    laplacian = NETWORKS[name]()
    right = noise(laplacian.shape[0])
    n = len(right)
    undivided = LaplacianSolver(laplacian, nodes_per_block=n).solve(right, 1e-3)
    solver = LaplacianSolver(laplacian, nodes_per_block=n // blocks)
    solution, iterations, _ = solver.solve(right, 1e-3)
    assert iterations <= 1.15 * undivided[1] + 2
    assert residual(laplacian, solution, right) <= 1e-3


def test_a_network_too_small_for_levels_is_one_block() -> None:
    laplacian, right = unit_delaunay(30), noise(30)
    solution, iterations, _ = LaplacianSolver(laplacian, nodes_per_block=10).solve(right, 1e-8)
    assert iterations == 1
    assert residual(laplacian, solution, right) <= 1e-8


def test_threads_do_not_change_a_solution() -> None:
    laplacian = unit_delaunay(60_000)
    right = noise(60_000)
    solvers = [LaplacianSolver(laplacian, nodes_per_block=5_000, threads=n) for n in (1, 2, 3)]
    assert [len(blocks.bounds) - 1 for blocks in solvers[0]._blocks] == [8, 2]
    solutions = [solver.solve(right, 1e-4)[0] for solver in solvers]
    np.testing.assert_array_equal(solutions[0], solutions[1])
    np.testing.assert_array_equal(solutions[0], solutions[2])


def test_a_cycle_is_symmetric_where_blocks_meet() -> None:
    solver = LaplacianSolver(unit_delaunay(400), nodes_per_block=35)
    network = solver._hierarchy.network
    assert [len(blocks.bounds) - 1 for blocks in solver._blocks] == [8, 2]
    assert all(len(blocks.cuts.first) > 5 for blocks in solver._blocks)
    # Without second steps, which make a cycle depend on the residual, it is a matrix.
    solver._hierarchy.twice[:] = False
    columns = []
    for k in range(400):
        solver._vectors.residual[:] = 0.0
        solver._vectors.residual[k] = 1.0
        solver._correct(0)
        columns.append(solver._vectors.correction[:400].copy())
        assert solver._vectors.residual[:400].tolist() == np.eye(400)[k].tolist()
    cycle = np.stack(columns, axis=1)
    np.testing.assert_allclose(cycle, cycle.T, atol=1e-12 * np.abs(cycle).max())
    assert network.ends[:400].sum() < network.starts[1:401].sum()


def test_columns_may_come_in_any_order() -> None:
    laplacian = unit_delaunay(3000)
    rows = np.repeat(np.arange(3000), np.diff(laplacian.indptr))
    key = np.random.default_rng(0).random(len(rows))
    permutation = np.lexsort((key, rows))
    shuffled = csr_array(
        (laplacian.data[permutation], laplacian.indices[permutation], laplacian.indptr),
        shape=laplacian.shape,
    )
    right = noise(3000)
    solution = SimilarSystems().solve(shuffled, right, 1e-10)
    assert residual(laplacian, solution, right) <= 1e-10


@pytest.mark.parametrize("n", [20, 5000])
def test_a_constant_in_the_right_side_is_ignored(n: int) -> None:
    laplacian = unit_delaunay(n)
    right = noise(n)
    solution = SimilarSystems().solve(laplacian, right, 1e-10)
    shifted = SimilarSystems().solve(laplacian, right + 7.0, 1e-10)
    assert np.allclose(shifted, solution, atol=1e-6 * np.abs(solution).max())
    assert abs(shifted.mean()) < 1e-12 * np.abs(shifted).max()


def test_a_zero_right_side_gives_zeros() -> None:
    assert not SimilarSystems().solve(unit_delaunay(1000), np.full(1000, 3.0), 1e-2).any()


@pytest.mark.parametrize("sizes", [(10, 10), (60, 1), (2000, 2000), (4000, 5)])
def test_a_graph_in_two_pieces_is_refused(sizes: tuple[int, int]) -> None:
    pieces = [path(size) for size in sizes]
    n = sum(sizes)
    matrix = coo_array((n, n)).tolil()
    matrix[: sizes[0], : sizes[0]] = pieces[0]
    matrix[sizes[0] :, sizes[0] :] = pieces[1]
    with pytest.raises(RuntimeError, match="several groups with no flux between them"):
        SimilarSystems().solve(csr_array(matrix), noise(n), 1e-2)


def test_infinite_conductances_are_refused() -> None:
    edges = grid_edges(40, 40)
    with pytest.raises(RuntimeError, match="not finite"):
        LaplacianSolver(laplacian_of(edges, np.full(len(edges), np.inf), 1600))


def test_factorisation_replaces_insufficient_iterations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Lazy(LaplacianSolver):
        def solve(
            self,
            right: Array,
            tolerance: float = 1e-2,
            max_iterations: int = 200,
            *,
            laplacian: csr_array | None = None,
            ground: Array | None = None,
        ) -> tuple[Array, int, float]:
            return super().solve(right, tolerance, 1, laplacian=laplacian, ground=ground)

    laplacian = smooth_contrast(5000)
    right = noise(5000)
    monkeypatch.setattr(linear, "LaplacianSolver", Lazy)
    assert Lazy(laplacian).solve(right, 1e-6)[2] > 1e-6
    assert residual(laplacian, SimilarSystems().solve(laplacian, right, 1e-6), right) <= 1e-6


@pytest.mark.parametrize("grounded", [False, True])
def test_one_setup_solves_similar_systems(grounded: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    setups = []

    class Counted(LaplacianSolver):
        def __init__(self, *given: Any, **named: Any) -> None:
            setups.append(given)
            super().__init__(*given, **named)

    monkeypatch.setattr(linear, "LaplacianSolver", Counted)
    systems, laplacian = SimilarSystems(), unit_delaunay(3000)
    rng = np.random.default_rng(5)
    for length in (1.0, 0.3, 0.01):  # as Newton's right-hand sides become shorter
        scale = diags_array(1 + 0.05 * rng.random(3000))
        varied = scale @ laplacian @ scale
        varied = csr_array(varied - diags_array(varied.sum(axis=1)))
        ground = 0.1 * rng.random(3000) if grounded else None
        matrix = varied if ground is None else varied + diags_array(ground)
        right = length * noise(3000)
        assert residual(matrix, systems.solve(varied, right, 1e-9, ground=ground), right) <= 1e-9
    assert len(setups) == 1
    changed = smooth_contrast(3000)
    assert residual(changed, systems.solve(changed, right, 1e-9), right) <= 1e-9
    assert len(setups) == 2
    for _ in range(2):  # a step that was kept short changes the matrix too much
        systems.solve(changed, right, 1e-9)
    assert len(setups) == 4


@pytest.mark.parametrize("n", [50, 5000])
@pytest.mark.parametrize("strength", [1e-3, 1.0, 1e3])
def test_a_ground_makes_the_system_regular(n: int, strength: float) -> None:
    laplacian = independent_contrast(n)
    ground = np.where(np.arange(n) % 7 == 0, strength, 0.0)
    right = np.random.default_rng(2).random(n)  # its sum flows off through the ground
    exact = splu((laplacian + diags_array(ground)).tocsc()).solve(right)
    solution = SimilarSystems().solve(laplacian, right, 1e-10, ground=ground)
    np.testing.assert_allclose(solution, exact, rtol=1e-5, atol=1e-7 * np.abs(exact).max())
    assert ground @ solution == pytest.approx(right.sum(), rel=1e-6)


def test_grounded_multigrid_needs_few_iterations() -> None:
    laplacian = unit_delaunay(20_000)
    ground = np.where(np.arange(20_000) < 3000, 0.05, 0.0)
    right = np.random.default_rng(3).normal(size=20_000)
    _, iterations, residual = LaplacianSolver(laplacian, ground).solve(right, 1e-8)
    assert residual <= 1e-8
    assert iterations < 40


@pytest.fixture(scope="module")
def laplacian():
    """Of a grid with uneven conductances."""
    n = 30
    node = np.arange(n * n).reshape(n, n)
    first = np.concatenate([node[:, :-1].ravel(), node[:-1].ravel()])
    second = np.concatenate([node[:, 1:].ravel(), node[1:].ravel()])
    conductances = 10 ** np.random.default_rng(0).uniform(-3, 3, len(first))
    one_way = csr_array((conductances, (first, second)), shape=(n * n, n * n))
    both = one_way + one_way.T
    return csr_array(diags_array(both.sum(axis=1)) - both)


@pytest.mark.parametrize("grounded", [False, True])
def test_every_system_is_solved(laplacian, grounded):
    rng = np.random.default_rng(1)
    n = laplacian.shape[0]
    ground = np.where(rng.random(n) < 0.1, 2.0, 0.0) if grounded else None
    right = rng.normal(size=(n, 8))
    right[:, -1] = 0
    solution = FactorisedLaplacian(laplacian, ground).solve(right)
    if ground is None:
        np.testing.assert_array_equal(solution[0], 0)
        np.testing.assert_allclose(laplacian @ solution, right - right.mean(axis=0), atol=1e-7)
    else:
        np.testing.assert_allclose(
            laplacian @ solution + ground[:, None] * solution, right, atol=1e-7
        )
    np.testing.assert_array_equal(solution[:, -1], 0)


def test_groups_without_conductors_between_them_are_refused(laplacian):
    with pytest.raises(RuntimeError, match="several groups"):
        FactorisedLaplacian(csr_array(block_diag([laplacian, laplacian])))
