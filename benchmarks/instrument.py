"""Inversions with an instrument that is not exact: the table of docs/uncertainty.md.

    python benchmarks/instrument.py [--inversions 200] [--side 128] [--first-seed 0]

Each image is counted rays (`counted` of `fit.py`; the package's forward model is not used) of one
of six objects, with an imperfection drawn from its stated prior: a beam of random waves, a
background, a gamma, a blur, a transmission of smooth noise, a reference out of register. The noise
is that of 1,000 counts a pixel. The columns are the number of inversions, the r.m.s. ratio of the
error to the total of the budget, the share of errors within one and two totals, and the median
error. A total is right if the ratio is about 1; of a single unknown number 68 and 95 % are within.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, shift

from fit import Beam, Field, blobs, counted
from napari_shadowinv import Instrument, invert

FloatArray = NDArray[np.float64]
COUNTS, RAYS, WAVES = 1000.0, 20, 12


def objects(side: int) -> dict[str, Field]:
    """Return six objects without folds: they spread, focus, or do both."""
    u, middle = side / 100, (side - 1) / 2
    ring = side / 9
    turbulent = np.random.default_rng(3)
    lumps = [
        (
            4 * u**2 * turbulent.normal(),
            *(turbulent.uniform(5, 9, 2) * u),
            turbulent.uniform(0, 3),
            *(turbulent.uniform(25, 75, 2) * u),
        )
        for _ in range(25)
    ]
    return {
        "weak ring": blobs([(0.15 * ring**2, ring, ring, 0, middle, middle)]),
        "ring": blobs([(0.6 * ring**2, ring, ring, 0, middle, middle)]),
        "focus": blobs([(-0.25 * ring**2, ring, ring, 0, middle, middle)]),
        "ellipses": blobs(
            [
                (77 * u**2, 8 * u, 13 * u, 0.35, 40 * u, 36 * u),
                (-63 * u**2, 12 * u, 7 * u, 0.2, 62 * u, 64 * u),
            ]
        ),
        "filament": blobs([(25 * u**2, 5 * u, 20 * u, 0.5, middle, middle)]),
        "turbulence": blobs(lumps),
    }


class Shot:
    """An image of an object while it is simulated, its source, and what is stated of both."""

    def __init__(self, side: int, displaced: Field, seed: int) -> None:
        self.side, self.displaced = side, displaced
        self.rng = np.random.default_rng([seed, 28])
        self.source = np.ones((side, side))
        self.beam: Beam | None = None
        self.after: Callable[[FloatArray], FloatArray] = lambda image: image
        self.instrument = Instrument()

    def waves(self, length: float) -> Beam:
        """Return smooth noise with a mean of 0 and an r.m.s. of 1 over the image."""
        waves = self.rng.normal(size=(2, WAVES)) / (length * self.side)
        phases = self.rng.uniform(0, 2 * np.pi, WAVES)

        def height(y: FloatArray, x: FloatArray) -> FloatArray:
            total = np.zeros_like(y)
            for along_y, along_x, phase in zip(*waves, phases, strict=True):
                total += np.cos(along_y * y + along_x * x + phase)
            return total

        level = height(*np.indices((self.side, self.side), dtype=np.float64))
        mean, deviation = level.mean(), level.std()
        return lambda y, x: (height(y, x) - mean) / deviation

    def image(self) -> FloatArray:
        """Return the counts of a shot."""
        shape = self.side, self.side
        image = self.after(counted([self.displaced], np.array([1.0]), self.beam, shape, RAYS))
        return self.rng.poisson(COUNTS * np.maximum(image, 0)).astype(np.float64)


def beam_off(shot: Shot) -> None:
    wave = shot.waves(0.25)
    shot.beam = lambda y, x: 1 + 0.02 * wave(y, x)
    shot.instrument = Instrument(beam_rms=0.02)


def background(shot: Shot) -> None:
    share = 0.1 * shot.rng.normal()
    shot.after = lambda image: image + share * image.mean()
    shot.instrument = Instrument(background=0.1)


def gamma(shot: Shot) -> None:
    exponent = 1 + 0.1 * shot.rng.normal()
    shot.after = lambda image: np.maximum(image, 0) ** exponent
    shot.instrument = Instrument(gamma=0.1)


def blur(shot: Shot) -> None:
    width = abs(2 * shot.rng.normal())
    shot.after = lambda image: gaussian_filter(image, width, mode="nearest")
    shot.instrument = Instrument(blur=2.0)


def absorption(shot: Shot) -> None:
    """Smooth noise of the object's size, where the object displaces rays."""
    y, x = np.indices((shot.side, shot.side), dtype=np.float64)
    length = np.hypot(*shot.displaced(y, x))
    inside = (length > 0.1 * length.max()).astype(float)
    radius = np.sqrt(inside.sum() / np.pi)
    wave, peak = shot.waves(radius / shot.side), length.max()
    edge = np.log(10.0)

    def beam(y: FloatArray, x: FloatArray) -> FloatArray:
        depth = np.hypot(*shot.displaced(y, x)) / peak
        within = 1 / (1 + np.exp(-2 * (np.log(np.maximum(depth, 1e-9)) + edge)))
        return np.asarray(1 + 0.02 * within * wave(y, x))

    shot.beam, shot.instrument = beam, Instrument(absorption=0.02)


def registration(shot: Shot) -> None:
    """A beam with structure of a tenth of the image, whose reference lies elsewhere."""
    wave = shot.waves(0.1)
    shot.beam = lambda y, x: 1 + 0.1 * wave(y, x)
    y, x = np.indices((shot.side, shot.side), dtype=np.float64)
    shot.source = shift(shot.beam(y, x), shot.rng.normal(size=2), order=3, mode="nearest")
    shot.instrument = Instrument(registration=1.0)


def everything(shot: Shot) -> None:
    """Beam, background, gamma and blur together."""
    wave = shot.waves(0.25)
    shot.beam = lambda y, x: 1 + 0.01 * wave(y, x)
    share, exponent, width = shot.rng.normal(size=3) * [0.1, 0.1, 1.0]

    def after(image: FloatArray) -> FloatArray:
        image = gaussian_filter(image, abs(width), mode="nearest")
        return np.maximum(image + share * image.mean(), 0) ** (1 + exponent)

    shot.after = after
    shot.instrument = Instrument(beam_rms=0.01, background=0.1, gamma=0.1, blur=1.0)


IMPERFECTIONS = {
    "beam, 2 % over a quarter": beam_off,
    "background, 10 %": background,
    "gamma, 0.1": gamma,
    "blur, 2 px": blur,
    "absorption, 2 %": absorption,
    "registration, 1 px": registration,
    "beam 1 %, background, gamma, blur 1 px": everything,
}


@lru_cache
def truth(side: int, name: str) -> FloatArray:
    """Return the displacement of an object, px."""
    y, x = np.indices((side, side), dtype=np.float64)
    return np.stack(objects(side)[name](y, x))


def length(displacement: FloatArray) -> float:
    return float(np.sqrt((displacement**2).sum(axis=0).mean()))


def main() -> None:
    """Print a row for each imperfection, then how often an error is far above its total."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--inversions", type=int, default=210)
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--first-seed", type=int, default=0)
    arguments = parser.parse_args()
    names = list(objects(arguments.side))
    count = -(-arguments.inversions // len(IMPERFECTIONS))
    print("| imperfection | inversions | error over total | within 1, 2 totals | error |")
    print("|---|---|---|---|---|")
    ratios_of_all = []
    for title, change in IMPERFECTIONS.items():
        ratios, shares = [], []
        for number in range(count):
            name = names[number % len(names)]
            field = objects(arguments.side)[name]
            shot = Shot(arguments.side, field, arguments.first_seed + number)
            change(shot)
            inversion = invert(
                shot.image(), source=COUNTS * shot.source, instrument=shot.instrument
            )
            exact = truth(arguments.side, name)
            error = length(inversion.displacement - exact)
            assert inversion.errors is not None
            ratios.append(error / inversion.errors.total.rms)
            shares.append(error / length(exact))
        ratio = np.array(ratios)
        ratios_of_all.extend(ratios)
        print(
            f"| {title} | {count} | {np.sqrt((ratio**2).mean()):.2f} | {(ratio < 1).mean():.0%}, "
            f"{(ratio < 2).mean():.0%} | {np.median(shares):.1%} |",
            flush=True,
        )
    total = np.array(ratios_of_all)
    print(
        f"\n{len(total)} inversions: within 2 totals {(total < 2).mean():.1%}, within 3 "
        f"{(total < 3).mean():.1%}, largest {total.max():.1f}"
    )


if __name__ == "__main__":
    main()
