"""Where the time of one inversion goes, and what it has to do at least.

    python benchmarks/profile_inversion.py [--peak 97] [--noise] [--n-sites 40000]

Prints the share of each part of the work (Python's profiler, one thread), then how much geometry
it moved: trial steps, flips, borders walked, pixels crossed.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
from collections import defaultdict
from types import SimpleNamespace
from unittest.mock import patch

import numpy as np

from napari_shadowinv import Inversion, InversionOptions, invert
from napari_shadowinv.geometry import flips
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangle_mesh import FLIPS
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.transport.minimise import TransportObjective
from reference import toroid_case

PARTS = {  # function, or file of functions, that belong to a part of the work
    "build": "triangulations from scratch",
    "repair": "repair of the triangulation",
    "raise_hidden": "repair of the triangulation",
    "look_for_irregular": "repair of the triangulation",
    "relocate": "repair of the triangulation",
    "hilbert_permutation": "triangulations from scratch",
    "_integrate_edges": "integrals along borders",
    "_integrate_moments": "integrals along borders",
    "_power_centres": "integrals along borders",
    "list_edges": "integrals along borders",
    "_sum_over_cells": "integrals along borders",
    "_laplacian": "Hessian",
    "_coarsening.py": "multigrid: set-up",
    "linear.py": "multigrid: cycles",
    "interpolation.py": "coarse to fine, and read-out",
    "budget.py": "error budget",
    "response.py": "error budget",
    "noise.py": "error budget",
    "factorised.py": "error budget",
    "<built-in method scipy.sparse.linalg._dsolve._superlu.gstrf>": "error budget",
    "forward.py": "re-projection",
    # with one thread only the re-projection waits for workers, which the profiler does not see
    "<method 'acquire' of '_thread.lock' objects>": "re-projection",
}


def part_of(file: str, function: str) -> str:
    return PARTS.get(function) or PARTS.get(file.rsplit("/", 1)[-1]) or "everything else"


def shares(profile: cProfile.Profile) -> dict[str, float]:
    seconds: dict[str, float] = defaultdict(float)
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    for (file, _, function), (_, _, own, _, _) in stats.items():
        seconds[part_of(file, function)] += own
    return dict(sorted(seconds.items(), key=lambda item: -item[1]))


def counted(image: np.ndarray, options: InversionOptions) -> tuple[Inversion, SimpleNamespace]:
    """Invert once more and count trial steps and flips."""
    count = SimpleNamespace(trials=0, rejected=0, flips=0)
    repair = flips.repair
    try_weights = TransportObjective.diagram_if_full

    def counting_repair(mesh, *arguments):
        status = repair(mesh, *arguments)
        count.flips += int(mesh.counters[FLIPS])
        return status

    def counting_trial(objective, weights):
        diagram = try_weights(objective, weights)
        if len(weights) == options.n_sites:
            count.trials += 1
            count.rejected += diagram is None
        return diagram

    with (
        patch.object(flips, "repair", counting_repair),
        patch.object(TransportObjective, "diagram_if_full", counting_trial),
    ):
        inversion = invert(image, source=np.ones(image.shape), options=options)
    return inversion, count


def pixels_crossed(inversion: Inversion) -> tuple[int, int]:
    """Borders between cells, and pieces that pixels cut them into."""
    density = Density.from_image(inversion.image)
    sites, weights = inversion.cells.sites, inversion.cells.weights
    triangulation = RegularTriangulation(sites, weights, region=density.region)
    ends = PowerDiagram(triangulation, density)
    corners = np.clip(ends.vertices + 0.5, 0, density.shape).astype(int)
    neighbors = triangulation.neighbors
    pieces = sum(
        int(
            (np.abs(corners - corners[neighbors[:, k]]).sum(axis=1) + 1)[neighbors[:, k] >= 0].sum()
        )
        for k in range(3)
    )
    return len(ends.edges), pieces // 2


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peak", type=int, default=97)
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--n-sites", type=int, default=40_000)
    arguments = parser.parse_args()
    case = toroid_case(arguments.peak, arguments.noise)
    source = np.ones(case.image.shape)
    options = InversionOptions(n_sites=arguments.n_sites, negative="clip", threads=1)
    invert(case.image, source=source, options=options)
    profile = cProfile.Profile()
    profile.enable()
    invert(case.image, source=source, options=options)
    profile.disable()
    found = shares(profile)
    total = sum(found.values())
    print(f"{case.name}, {arguments.n_sites:,} sites, one thread: {total:.3f} s")
    print("| part | ms | % |")
    print("|---|---|---|")
    for name, seconds in found.items():
        print(f"| {name} | {1e3 * seconds:.1f} | {100 * seconds / total:.0f} |")
    inversion, count = counted(case.image, options)
    borders, pieces = pixels_crossed(inversion)
    print(
        f"\n{count.trials} trial diagrams on the finest level, {count.rejected} of them rejected "
        f"because of an empty cell; {count.flips:,} repair flips on all levels; {borders:,} "
        f"borders in {pieces:,} pieces, {pieces / borders:.2f} pixels per border."
    )


if __name__ == "__main__":
    main()
