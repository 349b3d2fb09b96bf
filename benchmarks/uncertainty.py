"""What error bars cost, and whether they are right: three tables, printed as Markdown.

    python benchmarks/uncertainty.py [--n 200] [--n-solved 20] [--shots 30]

Cost: what one more sample takes, by the linear response and by solving, on one thread. Both
methods take turns, so that a busy machine slows both.
Linear against solved: error bars of the same samples by both methods.
Calibration: error bars from one noisy image against the scatter of the inversions
of many independent ones, and how often they hold the truth.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import InversionOptions, ProtonSetup, invert, synthetic_image
from napari_shadowinv.inversion import ErrorSamples, plan_sites
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.physics.phantoms import toroid
from reference import toroid_case

SIGMA = 0.1
COUNTS = 100.0
SOURCE = np.ones((200, 200))


def seconds(work: Callable[[], object]) -> NDArray[np.float64]:
    """Wall and processor time."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return np.array([time.perf_counter() - wall, time.process_time() - processor])


def samples_of(
    inversion: Inversion, n: int, noise: Any, method: Literal["linear", "resolve"] = "linear"
) -> ErrorSamples:
    """Return samples of the noise alone."""
    errors = inversion.uncertainty(n, noise=noise, noise_only=True, method=method).errors
    assert errors is not None
    assert errors.samples is not None
    return errors.samples


def cost_rows(n_sites: int, n: int, n_solved: int, repeat: int = 5) -> list[str]:
    """Time two numbers of samples of each method: their difference tells what samples take."""
    options = InversionOptions(n_sites=n_sites, negative="clip", threads=1)
    image = toroid_case(97, noise=True).image
    plan = plan_sites(SOURCE, options)
    start = invert(image, plan=plan, options=options)

    def call(method: Literal["linear", "resolve"], samples: int) -> NDArray[np.float64]:
        return seconds(lambda: samples_of(start, samples, SIGMA, method))

    few, most = 3, {"linear": n, "resolve": n_solved}  # linear samples are checked by so many
    turns = [
        [[call(method, samples) for samples in (few, many)] for method, many in most.items()]
        + [[seconds(lambda: invert(image, plan=plan, options=options))] * 2]
        for _ in range(repeat)
    ]
    *methods, (inversion, _) = np.median(turns, axis=0)
    return [
        f"| {n_sites:,} | {method} | {inversion[1]:.2f} | {many} | {whole[1]:.2f} "
        f"| {1e3 * (whole[0] - first[0]) / (many - few):.2f} "
        f"| {1e3 * (whole[1] - first[1]) / (many - few):.2f} |"
        for (method, many), (first, whole) in zip(most.items(), methods, strict=True)
    ]


def agreement_row(peak: int, n_sites: int, n: int) -> str:
    """Error bars of the same noisy images by both methods."""
    options = InversionOptions(n_sites=n_sites, negative="clip")
    image = toroid_case(peak, noise=True).image
    inversion = invert(image, source=SOURCE, options=options)
    linear = samples_of(inversion, n, SIGMA)
    solved = samples_of(inversion, n, SIGMA, "resolve")

    def compared(name: str) -> str:
        one, other = getattr(linear, name), getattr(solved, name)
        whole = np.linalg.norm(one) / np.linalg.norm(other)
        low, high = np.percentile(one / other, (5, 95))
        return f"{whole:.3f} ({low:.2f} to {high:.2f})"

    return (
        f"| toroid {peak} | {n_sites:,} | {linear.linearity.nonlinearity:.0%} "
        f"| {compared('displacement_std')} | {compared('potential_std')} |"
    )


def calibration_row(peak: int, kind: str, n: int, shots: int) -> str:
    options = InversionOptions(n_sites=40_000, negative="clip")
    truth = toroid(SOURCE.shape, ProtonSetup.example(), float(peak), 30e-6).displacement
    clean = synthetic_image(truth)
    rng = np.random.default_rng(peak)
    if kind == "Gaussian":
        images = [clean + SIGMA * rng.normal(size=clean.shape) for _ in range(shots)]
    else:
        images = [rng.poisson(COUNTS * clean).astype(float) for _ in range(shots)]
    noise = SIGMA if kind == "Gaussian" else "poisson"
    plan = plan_sites(SOURCE, options)
    many = [invert(image, plan=plan, options=options) for image in images]
    found = samples_of(many[0], n, noise)
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
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--n-solved", type=int, default=20)
    parser.add_argument("--shots", type=int, default=30)
    arguments = parser.parse_args()
    samples_of(invert(np.ones((20, 20)) + np.eye(20)), 2, 0.1)  # compile

    print(f"One thread, toroid 97, noise of {SIGMA:.0%}; processor time but for the last but one\n")
    print(
        "| sites | method | inversion, s | samples | whole call, s | ms a sample, wall time "
        "| processor time |"
    )
    print("|---|---|---|---|---|---|---|")
    for n_sites in (2_500, 10_000, 40_000):
        print(*cost_rows(n_sites, arguments.n, arguments.n_solved), sep="\n", flush=True)

    print(f"\n{arguments.n_solved} samples of noise of {SIGMA:.0%} by both methods\n")
    print(
        "| image | sites | nonlinearity | linear / solved, displacement: r.m.s. (90 % of pixels) "
        "| potential |"
    )
    print("|---|---|---|---|---|")
    for n_sites in (10_000, 40_000):
        for peak in (24, 97, 194):
            print(agreement_row(peak, n_sites, arguments.n_solved), flush=True)

    print(f"\n{arguments.shots} independent shots of each object\n")
    print(
        "| object | noise | scatter of the displacement, px "
        "| error bars / scatter, displacement | potential | truth within one error bar, % "
        "| where bias < ½ scatter, % | such pixels, % |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for peak in (24, 97, 194):
        for kind in ("Gaussian", "Poisson"):
            row = calibration_row(peak, kind, arguments.n, arguments.shots)
            print(row, flush=True)


if __name__ == "__main__":
    main()
