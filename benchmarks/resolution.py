"""The same object with pixels halved twice: the error falls, the time grows linearly.

python benchmarks/resolution.py
"""

from __future__ import annotations

import time

import numpy as np

from napari_shadowinv import InversionOptions, ProtonSetup, invert, synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from reference import Case, errors


def case(side: int, peak: float) -> Case:
    """The paper's toroid over the same 300 µm, on side² pixels."""
    setup = ProtonSetup.example().model_copy(update={"pixel_size": 300e-6 / side})
    truth = toroid((side, side), setup, peak, 30e-6).displacement
    return Case(f"toroid {peak:g}, {side}²", synthetic_image(truth, rays_per_pixel=64), truth)


def main() -> None:
    invert(np.ones((20, 20)) + np.eye(20))  # compile
    print("| image | sites | peak / L2 error, % | s | s per 10,000 sites |")
    print("|---|---|---|---|---|")
    for peak in (97.0, 180.0):
        for side in (100, 200, 400):
            shot = case(side, peak)
            seconds = []
            for _ in range(3):
                start = time.perf_counter()
                options = InversionOptions(n_sites=shot.image.size)
                inversion = invert(shot.image, options=options)
                seconds.append(time.perf_counter() - start)
            peak_error, l2 = errors(inversion.displacement, shot.displacement)
            n = inversion.report.n_sites
            print(
                f"| {shot.name} | {n:,} | {peak_error:+.2f} / {l2:.3f} | {min(seconds):.2f} "
                f"| {min(seconds) / n * 1e4:.3f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
