"""A fit of large images: time, memory and error; and what a second thread is worth.

    python benchmarks/fit_large.py

Three images of 576×464 px at 14.7, 30 and 60 MeV with 5 % noise, of three folded blobs: rays
counted where an exact formula puts them, as in fit.py. Times are multiples of one inversion by
transport (T) in the same run. Value and gradient of the forward model are those of 200×200 px.
"""

from __future__ import annotations

import resource
import time
from collections.abc import Callable

import numpy as np

from fit import blobs, counted, unit_of_time
from napari_shadowinv import ProtonSetup, fit
from napari_shadowinv.fitting.rays import RayModel, TracedBeam
from napari_shadowinv.shot import shots_of
from reference import errors

SIZE = (464, 576)
NOISE = 0.05
RAYS = 16
BLOBS = [(3000, 40, 40, 0, 200, 220), (-2200, 35, 35, 0, 300, 400), (1200, 25, 25, 0, 150, 420)]


def fastest(work: Callable[[], object], times: int = 15) -> float:
    """Seconds that some work takes at least."""
    taken = []
    for _ in range(times):
        begun = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begun)
    return min(taken)


def main() -> None:
    field = blobs([tuple(map(float, one)) for one in BLOBS])
    momenta = [
        ProtonSetup.example().model_copy(update={"energy": e}).momentum for e in (14.7, 30.0, 60.0)
    ]
    strengths = momenta[0] / np.array(momenta)
    clean = [counted([field], np.array([one]), None, SIZE, RAYS) for one in strengths]
    images = clean + NOISE * np.random.default_rng(0).normal(size=(3, *SIZE))
    truth = np.stack(field(*np.indices(SIZE, dtype=np.float64)))
    small = np.ones((40, 40))
    fit(shots_of([small, small], strength=[1, 0.5], noise=0.1))  # compile
    unit = unit_of_time()
    begun = time.perf_counter()
    found = fit(shots_of(images, strength=strengths, noise=NOISE, source=np.ones(SIZE)))
    seconds = time.perf_counter() - begun
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    peak, l2 = errors(found.fields[0].displacement, truth)
    print(
        f"576×464, three energies: {seconds / unit:.0f} T ({seconds:.0f} s), at most "
        f"{gigabytes:.2f} GB, error {peak:+.2f} / {l2:.2f} %, χ² {found.chi2.min():.2f} to "
        f"{found.chi2.max():.2f}, {found.folded:.1%} folded, {found.verdict}"
    )
    alone, together = (value_and_gradient(threads) for threads in (1, 2))
    print(f"value and gradient: {1e3 * together:.1f} ms, {alone / together:.2f} × by two threads")


def value_and_gradient(threads: int) -> float:
    rays = RayModel((200, 200), threads=threads)
    y, x = np.indices(rays.shape) - 54.0
    potential = 60.0 * np.exp(-(y**2 + x**2) / 2 / 12**2)
    beam, pull = rays.around(np.ones((200, 200))), np.ones((200, 200))
    traced = TracedBeam(potential, rays.ray_counts(potential), beam)

    def both() -> None:
        rays.image(traced)
        rays.gradient(traced, pull)

    return fastest(both)


if __name__ == "__main__":
    main()
