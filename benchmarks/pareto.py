"""Error against time, over numbers of sites, of this and of other solvers.

    python benchmarks/pareto.py [--picture docs/pareto.png] [--repeat 3]

The L2 error of the displacement and the seconds of a whole inversion, as Markdown: for
numbers of sites from a sixteenth of the pixels to four times as many; for what the accuracy leads
to by default; and for other solvers of the transport where they are installed:

- pysdot, semi-discrete as ours, on the same sites; its weights are read out as ours are;
- OTT, entropic, on the grid of the pixels, of images up to 100,000 pixels; the displacement is
  minus half the gradient of its potential.

Images are the reference toroids, and a frame of the burner where it is present, whose error is the
difference to four sites a pixel.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import InversionOptions, invert
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.transport.minimise import Solution, TransportObjective
from napari_shadowinv.transport.solvers import LevelSolution
from reference import DATA, Case, toroid_case

Array = NDArray[np.float64]
Point = tuple[str, str, float, float]  # solver, its setting, seconds, error

SHARES = (1 / 16, 1 / 4, 1, 4)  # of the pixels
REGULARISATIONS = (30.0, 10.0, 3.0)  # px²
LARGEST_GRID = 100_000  # pixels; more take OTT many minutes


def cases() -> Iterator[tuple[Case, Array]]:
    """Images with the displacement that is right, and their source."""
    for peak, noise in ((97, False), (97, True), (194, True)):
        case = toroid_case(peak, noise)
        image = np.maximum(case.image, 0)
        yield Case(case.name, image, case.displacement), np.ones(image.shape)
    files = sorted((DATA / "burner").rglob("*.bmp"))
    if files:
        from PIL import Image

        beam, frame = (
            np.asarray(Image.open(files[number]).convert("F"), np.float64) for number in (0, 3)
        )
        beam, frame = (one.reshape(464, 2, 576, 2).sum(axis=(1, 3)) for one in (beam, frame))
        finest = invert(frame, source=beam, options=InversionOptions(n_sites=4 * frame.size))
        yield Case("burner, binned by 2", frame, finest.displacement), beam


def error(found: Array, case: Case) -> float:
    return 100 * float(
        np.linalg.norm(found - case.displacement) / np.linalg.norm(case.displacement)
    )


def timed(work: Callable[[], Array], repeat: int) -> tuple[float, Array]:
    """The median seconds of some runs, after one that warms up, and the result."""
    found, seconds = work(), []
    for _ in range(repeat):
        begun = time.perf_counter()
        found = work()
        seconds.append(time.perf_counter() - begun)
    return float(np.median(seconds)), found


def ours(case: Case, beam: Array, repeat: int) -> Iterator[Point]:
    counts = [round(share * case.image.size) for share in SHARES]
    for n_sites in (*counts, None):
        options = InversionOptions(n_sites=n_sites)
        seconds, found = timed(
            lambda options=options: invert(case.image, source=beam, options=options).displacement,
            repeat,
        )
        solver = "napari-shadowinv" if n_sites else "napari-shadowinv, by default"
        yield solver, f"{n_sites:,} sites" if n_sites else "", seconds, error(found, case)


def semi_discrete(case: Case, beam: Array) -> Iterator[Point]:
    try:
        from pysdot import OptimalTransport
        from pysdot.domain_types import ScaledImage
    except ImportError:
        return
    height, width = case.image.shape
    image = np.maximum(case.image, 1e-3 * case.image.mean())
    for share in SHARES[:3]:
        options = InversionOptions(n_sites=round(share * image.size))
        begun = time.perf_counter()
        level = plan_sites(beam, options).levels[-1]
        scaled = image * level.mass.sum() / image.sum()
        transport = OptimalTransport(
            positions=np.array(level.sites[:, ::-1]),
            masses=np.array(level.mass),
            domain=ScaledImage([-0.5, -0.5], [width - 0.5, height - 0.5], scaled),
            obj_max_dm=options.tolerance * level.mass.min(),
            obj_max_dw=0,
            linear_solver="Scipy",
        )
        transport.adjust_weights()
        weights = np.array(transport.get_weights())
        density = Density.from_image(scaled)
        objective = TransportObjective(level.triangulation.copy(), level.mass, density)
        residual = objective.residual(objective.diagram(weights))
        solution = Solution(weights, residual, 0, residual <= options.tolerance)
        found = read_out(LevelSolution.of_level(level, objective, solution), options)[1]
        seconds = time.perf_counter() - begun
        told = f"{len(weights):,} sites" + ("" if solution.converged else ", does not converge")
        yield "pysdot", told, seconds, error(found, case)


def entropic(case: Case, beam: Array) -> Iterator[Point]:
    try:
        from ott.geometry import grid
        from ott.problems.linear import linear_problem
        from ott.solvers.linear import sinkhorn
    except ImportError:
        return
    if case.image.size > LARGEST_GRID:
        return
    image = np.maximum(case.image, 1e-3 * case.image.mean())
    shares = [(one / one.sum()).ravel() for one in (beam, image)]
    height, width = image.shape
    axes = [np.arange(length, dtype=float) for length in (height, width)]
    for regularisation in REGULARISATIONS:
        begun = time.perf_counter()
        plane = grid.Grid(x=axes, epsilon=regularisation)
        problem = linear_problem.LinearProblem(plane, a=shares[0], b=shares[1])
        output = sinkhorn.Sinkhorn(threshold=1e-3, max_iterations=20_000)(problem)
        potential = np.asarray(output.f).reshape(height, width)
        found = -np.array(np.gradient(potential)) / 2
        seconds = time.perf_counter() - begun
        told = f"ε = {regularisation:g} px²" + ("" if output.converged else ", does not converge")
        yield "OTT (Sinkhorn)", told, seconds, error(found, case)


def draw(points: dict[str, list[Point]], path: Path) -> None:
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, panels = plt.subplots(1, len(points), figsize=(3.2 * len(points), 3.2))
    for panel, (name, found) in zip(np.atleast_1d(panels), points.items(), strict=True):
        for solver in dict.fromkeys(point[0] for point in found):
            _, _, seconds, errors = zip(*(one for one in found if one[0] == solver), strict=True)
            by_default = solver.endswith("default")
            style = {"marker": "*", "markersize": 14} if by_default else {"marker": "o"}
            panel.plot(seconds, errors, label=solver, zorder=3 if by_default else 2, **style)
        panel.set(title=name, xlabel="Seconds", ylabel="L2 error (%)", xscale="log")
        panel.set_ylim(0, 1.15 * max(point[3] for point in found))
        panel.xaxis.set_major_locator(LogLocator(subs=(1, 3)))
        panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3)
    np.atleast_1d(panels)[0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--repeat", type=int, default=3)
    given = parser.parse_args()
    invert(np.ones((20, 20)) + np.eye(20))  # compile
    points: dict[str, list[Point]] = {}
    print("| image | solver | setting | s | L2 error, % |")
    print("|---|---|---|---|---|")
    for case, beam in cases():
        points[case.name] = []
        solvers = ours(case, beam, given.repeat), semi_discrete(case, beam), entropic(case, beam)
        for point in chain(*solvers):
            points[case.name].append(point)
            name, setting, seconds, off = point
            row = f"| {case.name} | {name} | {setting} | {seconds:.3g} | {off:.2f} |"
            print(row, flush=True)
    if given.picture:
        draw(points, given.picture)


if __name__ == "__main__":
    main()
