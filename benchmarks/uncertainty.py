"""What error bars cost, and whether they are right: two tables, printed as Markdown.

    python benchmarks/uncertainty.py [--n-sites 40000] [--n 20] [--shots 30]

Cost: noisy samples against whole inversions of the same image, in the same run. Processor
time does not depend on what else the machine does, wall time shows what two threads gain.
Calibration: error bars from one noisy image against the scatter of the inversions
of many independent ones, and how often they hold the truth.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import (
    InversionOptions,
    Uncertainty,
    invert,
    plan_sites,
    synthetic_image,
    uncertainty,
)
from napari_shadowinv.physics.phantoms import paper_setup, toroid
from reference import toroid_case

SIGMA = 0.1
COUNTS = 100.0
SOURCE = np.ones((200, 200))


def seconds(work: Callable[[], object]) -> NDArray[np.float64]:
    """Wall and processor time."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return np.array([time.perf_counter() - wall, time.process_time() - processor])


def cost_row(name: str, peak: int, n: int, options: InversionOptions, repeat: int = 3) -> str:
    """Inversions and samples take turns, so that a busy machine slows both."""
    image = toroid_case(peak, noise=True).image

    def whole() -> object:
        return invert(image, source=SOURCE, options=options)

    found: list[Uncertainty] = []

    def samples() -> None:
        found.append(uncertainty(image, n, source=SOURCE, noise=SIGMA, options=options))

    turns = []
    for _ in range(repeat):
        inversions = np.mean([seconds(whole) for _ in range(3)], axis=0)
        error_bars = seconds(samples)
        inversions = (inversions + np.mean([seconds(whole) for _ in range(3)], axis=0)) / 2
        turns.append((inversions, error_bars, error_bars / inversions))
    inversion, error_bars, ratio = np.median(turns, axis=0)
    steps = np.mean(found[-1].iterations)
    levels = found[-1].inversion.report.levels
    return (
        f"| {name} | {options.threads} | {inversion[0]:.2f} | {error_bars[0]:.2f} "
        f"| {ratio[0]:.1f} | {ratio[1]:.1f} | {(ratio[1] - 1) / n:.2f} "
        f"| {sum(steps for _, steps, _ in levels)} ({levels[-1][1]}) | {steps:.1f} |"
    )


def calibration_row(peak: int, kind: str, n: int, shots: int, options: InversionOptions) -> str:
    truth = toroid(SOURCE.shape, paper_setup(), float(peak), 30e-6).displacement
    clean = synthetic_image(truth)
    rng = np.random.default_rng(peak)
    if kind == "Gaussian":
        images = [clean + SIGMA * rng.normal(size=clean.shape) for _ in range(shots)]
    else:
        images = [rng.poisson(COUNTS * clean).astype(float) for _ in range(shots)]
    noise = SIGMA if kind == "Gaussian" else "poisson"
    plan = plan_sites(SOURCE, options)
    found = uncertainty(images[0], n, plan=plan, noise=noise, options=options)
    many = [invert(image, plan=plan, options=options) for image in images]
    fields = np.array([inversion.displacement for inversion in many])
    scatter = fields.std(axis=0, ddof=1)
    of_potential = np.std([inversion.potential for inversion in many], axis=0, ddof=1)
    bias = np.abs(fields.mean(axis=0) - truth)
    sure = bias < 0.5 * scatter
    held = np.abs(fields - truth) < found.displacement_std
    return (
        f"| toroid {peak} | {kind} | {np.sqrt((scatter**2).mean()):.3f} "
        f"| {np.median(found.displacement_std / scatter):.3f} "
        f"| {np.median(found.potential_std / of_potential):.3f} "
        f"| {100 * held.mean():.0f} | {100 * held[:, sure].mean():.0f} | {100 * sure.mean():.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--shots", type=int, default=30)
    arguments = parser.parse_args()
    options = InversionOptions(n_sites=arguments.n_sites, negative="clip")
    uncertainty(np.ones((20, 20)) + np.eye(20), 2, noise=0.1)  # compile

    print(f"{arguments.n_sites:,} sites, {arguments.n} samples, noise of {SIGMA:.0%}\n")
    print(
        "| image | threads | invert, s | error bars, s | in inversions, by wall time "
        "| by processor time | one sample | steps of the inversion (finest level) | of a sample |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for peak in (97, 194):
        for threads in (1, 2):
            chosen = options.model_copy(update={"threads": threads})
            print(cost_row(f"toroid {peak}", peak, arguments.n, chosen), flush=True)

    print(f"\n{arguments.shots} independent shots of each object\n")
    print(
        "| object | noise | scatter of the displacement, px "
        "| error bars / scatter, displacement | potential | truth within one error bar, % "
        "| where bias < ½ scatter, % | such pixels, % |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for peak in (24, 97, 194):
        for kind in ("Gaussian", "Poisson"):
            row = calibration_row(peak, kind, arguments.n, arguments.shots, options)
            print(row, flush=True)


if __name__ == "__main__":
    main()
