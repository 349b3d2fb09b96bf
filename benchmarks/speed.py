"""How fast, as multiples of one convex hull of the same lifted sites in the same run.

    python benchmarks/speed.py [--n-sites 40000] [--repeat 5]

The hull (scipy, qhull) is what a triangulation from scratch costs; the multiples do not
depend on the machine as seconds do. Each figure is the least of the repetitions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial import ConvexHull

from napari_shadowinv import InversionOptions, invert, plan_sites
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.preprocess import prepare
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import solve
from reference import toroid_case


def best(work: Callable[[], object], repeat: int) -> float:
    seconds = []
    for _ in range(repeat):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def hull_seconds(plan: SitePlan, weights: np.ndarray, repeat: int) -> float:
    sites = plan.levels[-1].sites
    lifted = np.column_stack([sites, (sites**2).sum(axis=1) - weights])
    return best(lambda: ConvexHull(lifted), repeat)


def diagram_seconds(plan: SitePlan, image: np.ndarray, weights: np.ndarray, repeat: int) -> float:
    """A small change of weights: repair, integrals of all cells, Hessian."""
    level = plan.levels[-1]
    density = Density.from_image(image)
    triangulation = level.triangulation.copy()
    rng = np.random.default_rng(0)
    changes = weights + 1e-2 * level.spacing**2 * rng.normal(size=(repeat + 1, len(weights)))
    triangulation.update(changes[0])
    steps = iter(changes[1:])

    def work() -> None:
        triangulation.update(next(steps))
        diagram = PowerDiagram(triangulation, density)
        diagram.laplacian()
        _ = diagram.masses

    return best(work, repeat)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    options = InversionOptions(n_sites=arguments.n_sites, negative="clip")
    repeat = arguments.repeat
    source = np.ones((200, 200))
    plan = plan_sites(source, options)
    sites_seconds = best(lambda: plan_sites(source, options), repeat)

    print(f"{arguments.n_sites:,} sites")
    print("| work | seconds | hulls |")
    print("|---|---|---|")
    for peak, noise in [(97, False), (194, True)]:
        case = toroid_case(peak, noise)
        image = prepare(case.image, source, options).floored
        weights = solve(plan.levels, image, options)[-1].weights
        hull = hull_seconds(plan, weights, repeat)
        works = {
            "one convex hull": hull,
            "diagram, integrals and Hessian after a small change": diagram_seconds(
                plan, image, weights, repeat
            ),
            "solve": best(lambda image=image: solve(plan.levels, image, options), repeat),
            "invert, sites given": best(
                lambda case=case: invert(case.image, plan=plan, options=options), repeat
            ),
            "invert": best(
                lambda case=case: invert(case.image, source=source, options=options), repeat
            ),
        }
        for name, seconds in works.items():
            print(f"| {case.name}: {name} | {seconds:.4f} | {seconds / hull:.2f} |", flush=True)
    print(f"| sites (Lloyd) | {sites_seconds:.4f} | {sites_seconds / hull:.2f} |")


if __name__ == "__main__":
    main()
