"""Time and memory against the number of sites, with the fitted exponent and a plot.

    python benchmarks/scaling.py [--out docs/scaling.png] [--largest 1000000]

The image is the paper's toroid of 97 MG µm on 200² pixels, and of 194 with noise; only the
number of sites changes. Each size runs in a process of its own, which warms up first,
so that its peak memory is its own too.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from napari_shadowinv import InversionOptions, invert
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.transport.solvers import Target, solve
from reference import toroid_case

SIZES = (10_000, 20_000, 40_000, 100_000, 200_000, 400_000, 1_000_000)
SHOTS = ((97, False), (194, True))


def peak_memory() -> int:
    """Peak resident memory of this process in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def measure(n_sites: int) -> dict[str, float]:
    """Times and memory of one size, in this process."""
    source = np.ones((200, 200))
    invert(np.ones((20, 20)) + np.eye(20))
    before = peak_memory()
    options = InversionOptions(n_sites=n_sites, negative="clip")
    repeat = 3 if n_sites <= 100_000 else 1
    seconds: dict[str, list[float]] = {"sites": [], "97": [], "194": []}
    for _ in range(repeat):
        start = time.perf_counter()
        plan = plan_sites(source, options)
        seconds["sites"].append(time.perf_counter() - start)
        for peak, noise in SHOTS:
            image = prepare(toroid_case(peak, noise).image, source, options).floored_image
            start = time.perf_counter()
            solution = solve(plan.levels, Target.of(image, options))[-1]
            seconds[str(peak)].append(time.perf_counter() - start)
            if not solution.converged:
                print(f"{n_sites} sites, {peak}: {solution.reason}", file=sys.stderr)
    found = {name: min(times) for name, times in seconds.items()}
    return {**found, "bytes": (peak_memory() - before) / n_sites}


def exponent(sizes: list[int], seconds: list[float]) -> float:
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def plot(path: Path, sizes: list[int], rows: list[dict[str, float]]) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = figure.add_subplot()
    labels = {"97": "solve, toroid 97", "194": "solve, toroid 194 with noise", "sites": "sites"}
    for name, marker in zip(labels, "os^", strict=True):
        times = [row[name] for row in rows]
        label = f"{labels[name]}: n^{exponent(sizes, times):.2f}"
        axes.loglog(sizes, times, marker=marker, label=label)
    axes.set_xlabel("sites")
    axes.set_ylabel("seconds")
    axes.grid(which="both", alpha=0.2)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="where to put the plot")
    parser.add_argument("--largest", type=int, default=SIZES[-1])
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        print(json.dumps(measure(arguments.one)))
        return
    sizes = [size for size in SIZES if size <= arguments.largest]
    rows = []
    print("| sites | sites, s | solve 97, s | solve 194 with noise, s | bytes per site |")
    print("|---|---|---|---|---|")
    for size in sizes:
        command = [sys.executable, __file__, "--one", str(size)]
        row = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
        rows.append(row)
        print(
            f"| {size:,} | {row['sites']:.3f} | {row['97']:.3f} | {row['194']:.3f} "
            f"| {row['bytes']:.0f} |",
            flush=True,
        )
    for name in ("sites", "97", "194"):
        print(f"{name}: n^{exponent(sizes, [row[name] for row in rows]):.3f}")
    if arguments.out:
        plot(arguments.out, sizes, rows)


if __name__ == "__main__":
    main()
