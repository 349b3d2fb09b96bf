"""Images with sharp edges, dark areas and single bright pixels: the table of docs/hard.md.

    python benchmarks/hard.py [--n-sites 40000] [--only disc ring]

Images of 200×200 px with the default options and one thread, after a warm-up. Times are processor
time, as multiples of that of the smooth lens in the first row just before and after.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import Inversion, InversionOptions, invert, synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from reference import DATA, toroid_case

SIDE = 200

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Hard:
    """An image with what goes with it into `invert`."""

    name: str
    image: FloatArray
    source: FloatArray | None = None
    changes: dict[str, Any] = field(default_factory=dict)


def lens() -> Hard:
    """A smooth focusing lens: an ordinary image."""
    blob = gaussian_blob((SIDE, SIDE), -250.0, 25.0)
    return Hard("ordinary: a smooth lens", synthetic_image(blob.displacement))


def toroids() -> list[Hard]:
    """The reference toroids, where they are."""
    if not (DATA / "toroid").is_dir():
        return []
    return [
        Hard(f"ordinary: {case.name}", case.image, changes={"negative": "clip"})
        for case in (toroid_case(97), toroid_case(194, noise=True))
    ]


def hard_images() -> list[Hard]:
    y, x = np.indices((SIDE, SIDE), dtype=np.float64)
    rng = np.random.default_rng(5)

    def near(row: float, column: float, radius: float) -> FloatArray:
        return (np.hypot(y - row, x - column) < radius).astype(np.float64)

    middle = (SIDE - 1) / 2
    pixel = np.zeros((SIDE, SIDE))
    pixel[SIDE // 2, SIDE // 2] = 1
    step = np.where(x < middle, 1e-6, 1.0)
    disc = near(middle, middle, 50)
    ring = near(middle, middle, 70) - near(middle, middle, 50)
    corner = np.zeros((SIDE, SIDE))
    corner[:20, :20] = 1
    lines = np.ones((SIDE, SIDE))
    lines[::20] = 100
    line = np.zeros((SIDE, SIDE))
    line[SIDE // 2] = 1
    left, right = near(middle, 50, 24), near(middle, 150, 24)
    bright = np.ones((SIDE, SIDE))
    bright.ravel()[rng.choice(SIDE**2, SIDE**2 // 100, replace=False)] = 1e4
    free = {"boundary": "free"}
    return [
        Hard("one bright pixel, the others dark", pixel),
        Hard("left half 1,000,000 times darker", step),
        Hard("the same step in the source, mirrored in the image", step, step[:, ::-1]),
        Hard("a sharp disc, radius 50 px", disc),
        Hard("a sharp ring, 50 to 70 px", ring),
        Hard("all flux in a corner of 20×20 px", corner),
        Hard("every 20th row 100 times brighter", lines),
        Hard("a single bright row", line),
        Hard("source an island on the right, image one on the left", left, right),
        Hard("two discs, radius 24 px", left + right),
        Hard("1 % of the pixels 10,000 times brighter", bright),
        Hard("the disc, free boundary", disc, changes=free),
        Hard("the corner, free boundary", corner, changes=free),
    ]


def inverted(hard: Hard, n_sites: int) -> tuple[Inversion, float]:
    """Invert on one thread, and the seconds of processor time that took."""
    options = InversionOptions(n_sites=n_sites, threads=1, **hard.changes)
    start = time.process_time()
    inversion = invert(hard.image, source=hard.source, options=options)
    return inversion, time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--n-sites", type=int, default=SIDE**2)
    parser.add_argument("--only", nargs="+", default=[""], help="words in the names of images")
    arguments = parser.parse_args()
    ordinary, *all_hard = lens(), *hard_images()
    free_lens = Hard("", ordinary.image, changes={"boundary": "free"})
    for warm_up in (ordinary, free_lens, all_hard[3]):
        inverted(warm_up, 2000)

    def unit() -> float:
        return min(inverted(ordinary, arguments.n_sites)[1] for _ in range(3))

    chosen = [
        case
        for case in (*toroids(), *all_hard)
        if any(word in case.name for word in arguments.only)
    ]
    units = [unit()]
    print(f"One unit of time is {units[0]:.2f} s.\n")
    print("| image | solved | steps | flux residual | times | message |")
    print("|---|---|---|---|---|---|", flush=True)
    for case in (ordinary, *chosen):
        inversion, seconds = inverted(case, arguments.n_sites)
        units.append(unit())
        times = seconds / np.mean(units[-2:])
        report = inversion.report
        said = [
            caution.text.split("; ", 1)[1]
            for caution in report.cautions
            if caution.code == "not-converged"
        ]
        print(
            f"| {case.name} | {'yes' if report.converged else 'no'} | {report.iterations} "
            f"| {report.residual:.2g} | {times:.1f} | {' '.join(said)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
