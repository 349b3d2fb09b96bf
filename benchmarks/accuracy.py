"""How well known fields are retrieved: one table, printed as Markdown.

    python benchmarks/accuracy.py [--n-sites 40000]

Peak error: largest retrieved displacement against the largest true one. L2 error: norm of
the difference against the norm of the truth. Beside it the linear (Poisson) inversion.
"""

from __future__ import annotations

import argparse

import numpy as np

from napari_shadowinv import InversionOptions, invert, poisson_invert
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
    options = InversionOptions(n_sites=n_sites, negative="clip")
    inversion = invert(case.image, source=np.ones(case.image.shape), options=options)
    peak, l2 = errors(inversion.displacement, case.displacement)
    linear = -np.array(np.gradient(poisson_invert(case.image)))
    linear_peak, linear_l2 = errors(linear, case.displacement)
    report = inversion.report
    limits = LIMITS.get(case.name)
    verdict = "" if limits is None else f"{limits[0]} / {limits[1]}"
    if limits is not None and (abs(peak) > limits[0] or l2 > limits[1]):
        verdict += " MISSED"
    return (
        f"| {case.name} | {report.n_sites:,} | {peak:+.2f} / {l2:.2f} | {verdict} "
        f"| {linear_peak:+.1f} / {linear_l2:.1f} | {report.residual:.1e} "
        f"| {report.iterations} | {sum(report.seconds.values()):.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    n_sites = parser.parse_args().n_sites
    invert(np.ones((20, 20)) + np.eye(20))  # compile, so that the seconds are the work's
    print("| image | sites | peak / L2 error, % | allowed | linear, % | residual | steps | s |")
    print("|---|---|---|---|---|---|---|---|")
    for case in cases():
        print(row(case, n_sites), flush=True)


if __name__ == "__main__":
    main()
