"""How well known fields are retrieved: one table, printed as Markdown.

    python benchmarks/accuracy.py [--n-sites 40000]

Peak error: largest retrieved displacement against the largest true one. L2 error: norm of
the difference against the norm of the truth. Beside it what the accuracy leads to without a number
of sites: their number, the errors, what of them the error budget tells (discretisation and noise,
r.m.s. of the displacement), and the seconds; and the linear (Poisson) inversion.

    python benchmarks/accuracy.py --pixels [NAME …]

Errors where a pixel is the limit, in per cent of the displacement (L2), by default, at an accuracy
of 0.1 %, and by a site a pixel in which the brightness is constant: images of the comparison, of
64² and 128² px, whose names contain one of these, and a ring of 7 px with noise. Rays are counted
(`compare.images`), so the truth is not the package's.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np

from compare.fields import centres
from compare.images import Case as CountedCase
from compare.images import cases as counted_cases
from compare.images import make_image
from compare.runner import relative_error
from napari_shadowinv import Inversion, InversionOptions, invert, poisson_invert
from reference import Case, donut_case, ellipses_case, errors, toroid_case

LIMITS = {  # largest peak and L2 error allowed, in per cent
    "toroid 24 with noise": (3.5, 12),
    "toroid 97": (0.3, 0.3),
    "toroid 97 with noise": (3, 4),
    "toroid 194": (0.5, 1.6),
    "toroid 194 with noise": (1, 2.6),
    "donut": (1.5, 2.4),
    "ellipses 160×240": (1, 1),
}


def cases() -> list[Case]:
    toroids = [(24, True), (97, False), (97, True), (194, False), (194, True)]
    found = [toroid_case(peak, noise) for peak, noise in toroids]
    donut = donut_case()
    return [*found, *([donut] if donut else []), ellipses_case()]


def row(case: Case, n_sites: int | None) -> str:
    inversion, error, seconds = inverted(case, InversionOptions(n_sites=n_sites, negative="clip"))
    usual, usual_error, usual_seconds = inverted(case, InversionOptions(negative="clip"))
    peak, l2 = error
    linear = -np.array(np.gradient(poisson_invert(case.image)))
    linear_peak, linear_l2 = errors(linear, case.displacement)
    report, budget = inversion.report, usual.errors
    assert budget is not None
    limits = LIMITS.get(case.name)
    verdict = "" if limits is None else f"{limits[0]} / {limits[1]}"
    if limits is not None and (abs(peak) > limits[0] or l2 > limits[1]):
        verdict += " MISSED"
    told = [100 * one.rms / budget.rms for one in (budget.discretisation, budget.noise)]
    return (
        f"| {case.name} | {report.n_sites:,} | {peak:+.2f} / {l2:.2f} | {verdict} "
        f"| {report.residual:.1e} | {report.iterations} | {seconds:.2f} "
        f"| {usual.report.n_sites:,} | {usual_error[0]:+.2f} / {usual_error[1]:.2f} "
        f"| {told[0]:.2f} / {told[1]:.2f} | {usual_seconds:.2f} "
        f"| {linear_peak:+.1f} / {linear_l2:.1f} |"
    )


def inverted(case: Case, options: InversionOptions) -> tuple[Inversion, tuple[float, float], float]:
    """An inversion, its peak and L2 error in per cent, and the seconds of the second of two."""
    source = np.ones(case.image.shape)
    invert(case.image, source=source, options=options)
    found = invert(case.image, source=source, options=options)
    return found, errors(found.displacement, case.displacement), sum(found.report.seconds.values())


def ring(n: int, width: float = 7 / 128, radius: float = 0.25) -> np.ndarray:
    """A radial displacement of 3 px of 128 in a ring with a full width at half maximum."""
    y, x = centres(n)
    r = np.maximum(np.hypot(y, x), 1e-12)
    factor = 3 / 128 * np.exp(-4 * np.log(2) * ((r - radius) / width) ** 2) / r
    return np.stack([factor * y, factor * x])


def pixel_row(case: CountedCase) -> str:
    source, image, truth = make_image(case)
    cells = [case.key]
    for choices in ({}, {"accuracy": 0.001}, {"n_sites": image.size}):
        options = InversionOptions(threads=1, **choices)
        found = invert(image, source=source, options=options)
        seconds = sum(invert(image, source=source, options=options).report.seconds.values())
        error = relative_error(found.displacement, truth, source)
        cells += [f"{found.report.n_sites:,}", f"{error:.3f}", f"{seconds:.2f}"]
    return f"| {' | '.join(cells)} |"


def show_pixels(names: list[str]) -> None:
    """Print the table of images where a pixel is the limit."""
    small = [case for case in counted_cases() if case.size <= 128]
    chosen = [case for case in small if not names or any(name in case.name for name in names)]
    chosen += [
        CountedCase("ring", f"ring of 7 px, noise {noise:.0%},", 128, partial(ring), noise=noise)
        for noise in (0.0, 0.01, 0.03)
    ]
    kinds = "by default", "at 0.1 %", "constant in pixels"
    print("| image | " + " | ".join(f"{kind}: sites | error, % | s" for kind in kinds) + " |")
    print(f"|{'---|' * 10}")
    for case in chosen:
        print(pixel_row(case), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    parser.add_argument("--pixels", nargs="*", metavar="NAME")
    arguments = parser.parse_args()
    n_sites = arguments.n_sites
    if arguments.pixels is not None:
        show_pixels(arguments.pixels)
        return
    invert(np.ones((20, 20)) + np.eye(20))  # compile, so that the seconds are the work's
    print(
        "| image | sites | peak / L2 error, % | allowed | residual | steps | s "
        "| by default: sites | peak / L2 error, % | told: sites, noise, % | s | linear, % |"
    )
    print(f"|{'---|' * 12}")
    for case in cases():
        print(row(case, n_sites), flush=True)


if __name__ == "__main__":
    main()
