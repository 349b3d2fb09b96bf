"""Time the solvers for Newton's linear systems on the same systems, in one run.

    python benchmarks/linear.py [--sites 10000 40000 1000000] [--direct-below 300000]

Each system is the first Newton step for a power diagram of random sites over a noisy image
with a thin bright ring (conductances over four to five orders of magnitude). All solvers run
on one thread to a relative residual of 1e-2; SuperLU is exact. Each time is the best of
several. pyamg is needed for two of the columns only, and left out if it is not installed.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from time import perf_counter
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation, hilbert_order
from napari_shadowinv.transport.linear import LaplacianSolver

try:
    import pyamg
except ImportError:
    pyamg = None

Array = NDArray[np.float64]
Solve = Callable[[Array], tuple[Array, int]]

T = TypeVar("T")

TOLERANCE = 1e-2


def noisy_ring(size: int = 200) -> Array:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    ring = np.exp(-(((np.hypot(y, x) - 0.5) / 0.02) ** 2))
    image = 0.3 + 20 * ring + rng.normal(0, 0.1, ring.shape)
    return np.maximum(image, 1e-3 * image.mean())


def newton_system(n: int) -> tuple[csr_array, Array]:
    image = noisy_ring()
    sites = np.random.default_rng(1).uniform(-0.5, len(image) - 0.5, (n, 2))
    sites = sites[hilbert_order(sites)]
    diagram = PowerDiagram(RegularTriangulation(sites), Density.from_image(image))
    return diagram.laplacian(), diagram.masses.mean() - diagram.masses


def multigrid(laplacian: csr_array) -> Solve:
    solver = LaplacianSolver(laplacian)
    return lambda right: solver.solve(right, TOLERANCE)[:2]


def superlu(laplacian: csr_array) -> Solve:
    factors = splu(
        laplacian[1:, 1:].tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return lambda right: (np.append(0.0, factors.solve(right[1:])), 1)


def with_pyamg(name: str) -> Callable[[csr_array], Solve]:
    def set_up(laplacian: csr_array) -> Solve:
        hierarchy = getattr(pyamg, name)(csr_matrix(laplacian), max_coarse=500)

        def solve(right: Array) -> tuple[Array, int]:
            residuals: list[float] = []
            solution = hierarchy.solve(
                right, tol=TOLERANCE, accel="cg", maxiter=200, residuals=residuals
            )
            return solution, len(residuals) - 1

        return solve

    return set_up


def best_of(function: Callable[[], T], repeats: int) -> tuple[float, T]:
    best = np.inf
    for _ in range(repeats):
        start = perf_counter()
        result = function()
        best = min(best, perf_counter() - start)
    return best, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sites", type=int, nargs="+", default=[10_000, 40_000, 250_000])
    parser.add_argument("--direct-below", type=int, default=300_000, help="largest for SuperLU")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    solvers = {"multigrid": multigrid}
    if pyamg is not None:
        solvers["pyamg Ruge-Stüben"] = with_pyamg("ruge_stuben_solver")
        solvers["pyamg smoothed aggr."] = with_pyamg("smoothed_aggregation_solver")
    solvers["SuperLU"] = superlu
    multigrid(newton_system(1000)[0])(np.zeros(1000))  # compile
    print("|     n    | solver               | set-up, ms | iterations | solve, ms | residual |")
    print("|---------:|----------------------|-----------:|-----------:|----------:|---------:|")
    for n in options.sites:
        laplacian, right = newton_system(n)
        for name, set_up in solvers.items():
            if name == "SuperLU" and n > options.direct_below:
                continue
            repeats = 1 if name == "SuperLU" and n > 100_000 else options.repeats
            before, solve = best_of(lambda set_up=set_up, a=laplacian: set_up(a), repeats)
            during, (x, iterations) = best_of(lambda solve=solve, b=right: solve(b), repeats)
            left = np.linalg.norm(right - laplacian @ x) / np.linalg.norm(right)
            print(
                f"| {n:8d} | {name:20} | {1e3 * before:10.1f} | {iterations:10d} "
                f"| {1e3 * during:9.1f} | {left:8.1e} |",
                flush=True,
            )


if __name__ == "__main__":
    with threadpool_limits(limits=1):
        main()
