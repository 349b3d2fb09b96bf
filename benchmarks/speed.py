"""How fast, as multiples of one convex hull of the same lifted sites in the same run.

    python benchmarks/speed.py [--n-sites 40000] [--repeat 5]

The hull (scipy, qhull) is what a triangulation from scratch costs; the multiples do not
depend on the machine as seconds do. Each figure is the least of the repetitions. Where
pysdot is installed (``pip install pysdot==0.2.16``) it solves the same problem, same
sites, image and tolerance, beside ours.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.spatial import ConvexHull

from napari_shadowinv import InversionOptions, invert
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.transport.minimise import TransportObjective
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import Target, solve
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


def pysdot_seconds(plan: SitePlan, image: np.ndarray, options: InversionOptions) -> float | None:
    """Time pysdot on the finest level's sites; None where it is missing or does not converge."""
    try:
        from pysdot import OptimalTransport
        from pysdot.domain_types import ScaledImage
    except ImportError:
        return None
    level = plan.levels[-1]
    height, width = image.shape
    transport = OptimalTransport(
        positions=np.array(level.sites[:, ::-1]),
        masses=np.array(level.mass),
        domain=ScaledImage([-0.5, -0.5], [width - 0.5, height - 0.5], image),
        obj_max_dm=options.tolerance * level.mass.min(),
        obj_max_dw=0,
        linear_solver="Scipy",
    )
    start = time.perf_counter()
    transport.adjust_weights()
    seconds = time.perf_counter() - start
    objective = TransportObjective(
        level.triangulation.copy(), level.mass, Density.from_image(image)
    )
    reached = objective.residual(objective.diagram(np.array(transport.get_weights())))
    return seconds if reached <= options.tolerance else None


def threads_row(plan: SitePlan, image: np.ndarray, options: InversionOptions, repeat: int) -> str:
    times = []
    for threads in (1, 2):
        chosen = options.model_copy(update={"threads": threads})
        times.append(
            best(lambda chosen=chosen: solve(plan.levels, Target.of(image, chosen)), repeat)
        )
    return f"{times[0]:.4f} s on one thread, {times[1]:.4f} s on two"


def stages(name: str, image: np.ndarray, options: InversionOptions) -> str:
    """Seconds per stage of a whole inversion."""
    invert(image, options=options)
    seconds = invert(image, options=options).report.seconds
    return f"{name}: " + ", ".join(f"{stage} {spent:.3f} s" for stage, spent in seconds.items())


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

    notes: list[str] = []
    print(f"{arguments.n_sites:,} sites")
    print("| work | seconds | hulls |")
    print("|---|---|---|")
    for peak, noise in [(97, False), (194, True)]:
        case = toroid_case(peak, noise)
        image = prepare(case.image, source, options).floored_image
        weights = solve(plan.levels, Target.of(image, options))[-1].weights
        hull = hull_seconds(plan, weights, repeat)
        works = {
            "one convex hull": hull,
            "diagram, integrals and Hessian after a small change": diagram_seconds(
                plan, image, weights, repeat
            ),
            "solve": best(
                lambda image=image: solve(plan.levels, Target.of(image, options)), repeat
            ),
            "invert, sites given": best(
                lambda case=case: invert(case.image, plan=plan, options=options), repeat
            ),
            "invert": best(
                lambda case=case: invert(case.image, source=source, options=options), repeat
            ),
        }
        theirs = pysdot_seconds(plan, image, options)
        if theirs is not None:
            works[f"solve by pysdot ({theirs / works['solve']:.0f} times ours)"] = theirs
        for name, seconds in works.items():
            print(f"| {case.name}: {name} | {seconds:.4f} | {seconds / hull:.2f} |", flush=True)
        notes.append(f"{case.name}: solve {threads_row(plan, image, options, repeat)}")
        notes.append(stages(case.name, case.image, options))
    print(f"| sites (Lloyd) | {sites_seconds:.4f} | {sites_seconds / hull:.2f} |")
    print("", *notes, sep="\n")


if __name__ == "__main__":
    main()
