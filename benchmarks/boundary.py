"""Closed and free boundary side by side: one table, printed as Markdown, and a picture.

    python benchmarks/boundary.py [--n-sites 40000] [--picture docs/boundary.png]

Objects of 200×200 px: two elliptical blobs whose light crosses the edge, centred 0, 20 and 40 px
inside it; two blobs in the middle; a toroid. Displacement L2 error, and the time of each as a
multiple of the closed boundary's in the same run.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from napari_shadowinv import Inversion, InversionOptions, invert, synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from reference import Case, errors, toroid_case

SIDE, AROUND = 200, 60
WAYS: dict[str, dict[str, Any]] = {
    "closed": {},
    "free, known": {"boundary": "free", "flux": "known"},
    "free, conserve": {"boundary": "free", "flux": "conserve"},
}

FloatArray = NDArray[np.float64]


def blobs(name: str, places: tuple[tuple[float, float], tuple[float, float]], peak: float) -> Case:
    """Two blobs of opposite sign on a larger field, of which the image shows the middle."""
    shape = (SIDE + 2 * AROUND,) * 2
    first, second = (
        gaussian_blob(shape, amplitude, widths, (y + AROUND, x + AROUND), angle).displacement
        for amplitude, widths, (y, x), angle in (
            (45.0, (14.0, 24.0), places[0], 0.5),
            (-30.0, (20.0, 12.0), places[1], 0.3),
        )
    )
    field = first + second
    field *= peak / np.hypot(*field).max()
    image = synthetic_image(field, np.ones(shape))
    inside = (slice(AROUND, -AROUND),) * 2
    return Case(f"{name}, {peak:g} px", image[inside], field[:, *inside])


def cases() -> list[Case]:
    across = [
        blobs(f"across the edge, centred {c} px inside", ((80, c), (SIDE - 1 - c, 130)), 6)
        for c in (0, 20, 40)
    ]
    middle = ((70, 90), (130, 130))
    noisy = blobs("in the middle", middle, 12)
    noise = 0.1 * np.random.default_rng(1).normal(size=noisy.image.shape)
    return [
        *across,
        blobs("in the middle", middle, 6),
        Case(f"{noisy.name}, 10 % noise", np.maximum(noisy.image + noise, 0), noisy.displacement),
        toroid_case(97),
        toroid_case(194, noise=True),
    ]


def inverted(case: Case, way: str, n_sites: int) -> tuple[Inversion, float]:
    """The last of three inversions, and the seconds of the fastest."""
    options = InversionOptions(n_sites=n_sites, negative="clip", **WAYS[way])
    fastest = np.inf
    for _ in range(3):
        start = time.perf_counter()
        inversion = invert(case.image, source=np.ones(case.image.shape), options=options)
        fastest = min(fastest, time.perf_counter() - start)
    return inversion, fastest


def draw(case: Case, found: dict[str, FloatArray], path: Path) -> None:
    """The image and the true field beside what two boundaries make of it."""
    figure, panels = plt.subplots(2, 2, figsize=(9, 8), layout="constrained")
    top = np.hypot(*case.displacement).max()

    def show(axes: Axes, values: FloatArray, title: str, label: str, **look: Any) -> None:
        shown = axes.imshow(values, **look)
        axes.set_title(title, fontsize=11)
        axes.set(xlabel="x (px)", ylabel="y (px)")
        figure.colorbar(shown, ax=axes, label=label)

    show(panels[0, 0], case.image, "Image", "flux of the source", cmap="gray")
    fields = {"True field": case.displacement, **found}
    for axes, (title, field) in zip(panels.flat[1:], fields.items(), strict=True):
        show(axes, np.hypot(*field), title, "displacement (px)", cmap="viridis", vmin=0, vmax=top)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=40_000)
    parser.add_argument("--picture", type=Path, help="where to draw the second object")
    arguments = parser.parse_args()
    print(f"| object | {' | '.join(WAYS)} | times of closed |")
    print("|---" * (len(WAYS) + 2) + "|")
    for number, case in enumerate(cases()):
        fields, seconds, cells = {}, {}, []
        for way in WAYS:
            inversion, seconds[way] = inverted(case, way, arguments.n_sites)
            fields[way] = inversion.displacement
            mark = "" if inversion.report.converged else " (not converged)"
            cells.append(f"{errors(inversion.displacement, case.displacement)[1]:.2f}{mark}")
        ratios = " / ".join(f"{seconds[way] / seconds['closed']:.2f}" for way in list(WAYS)[1:])
        print(f"| {case.name} | {' | '.join(cells)} | {ratios} |", flush=True)
        if number == 1 and arguments.picture:
            found = {"Closed boundary": fields["closed"], "Free boundary": fields["free, known"]}
            draw(case, found, arguments.picture)


if __name__ == "__main__":
    main()
