"""How well known fields are retrieved: one table, printed as Markdown.

    python benchmarks/accuracy.py [--n-sites 40000]

Peak error: largest retrieved displacement against the largest true one. L2 error: norm of
the difference against the norm of the truth. Beside it what the accuracy leads to without a number
of sites: their number, the errors, what of them the error budget tells (discretisation and noise,
r.m.s. of the displacement), and the seconds; and the linear (Poisson) inversion.
"""

from __future__ import annotations

import argparse

import numpy as np

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    n_sites = parser.parse_args().n_sites
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
