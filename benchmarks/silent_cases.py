"""Inversions of wrong inputs: which results are wrong without a warning.

    python benchmarks/silent_cases.py [--side 128] [--right 20]

Images are counted rays: 25 start in each pixel, each at a random place of a cell of its own, are
displaced by the exact formula of a Gaussian potential, and count in the pixel where they land. The
package's forward model is not used. Each case has a line with the error of the displacement
(r.m.s., as a share of the truth), the total of the error budget, and the first words of the
warnings. A case is *silent* if the error is above 5 % and above three times the total, and no
warning appears. The second table counts warnings on right input.

`CASES` is a table of functions: to add a case, write a function that takes a random generator and
the side of the image and returns a `Trial`, and put it there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_shadowinv import InversionOptions, invert
from napari_shadowinv.cautions import Caution

FloatArray = NDArray[np.float64]

RAYS, COUNTS = 5, 1000.0
MIN_ERROR, MAX_TOTALS = 0.05, 3.0


@dataclass(frozen=True)
class Trial:
    """One image, the arguments of `invert`, and the true displacement."""

    image: FloatArray
    truth: FloatArray
    arguments: dict[str, Any] = field(default_factory=dict)


def displaced(y: FloatArray, x: FloatArray, side: int, strength: float) -> FloatArray:
    """Return the displacement by a Gaussian of width side / 10, a little beside the centre.

    Caustics begin at a strength of 1 where rays are driven apart (a positive strength).
    """
    width = side / 10
    v, u = y - 0.47 * side, x - 0.52 * side
    slope = strength * np.exp(1.5) / 2 * np.exp(-(v**2 + u**2) / (2 * width**2))
    return np.array([slope * v, slope * u])


def traced(
    rng: np.random.Generator, side: int, strength: float, beam: FloatArray | float = 1.0
) -> tuple[FloatArray, FloatArray]:
    """Return the image of a beam, in counts without noise, and the displacement of its pixels."""
    rows, columns = np.indices((side, side)).astype(float)
    counts = np.zeros(side * side)
    weights = np.broadcast_to(beam, (side, side)).ravel() * COUNTS / RAYS**2
    for cell in np.ndindex(RAYS, RAYS):
        y = rows - 0.5 + (cell[0] + rng.random(rows.shape)) / RAYS
        x = columns - 0.5 + (cell[1] + rng.random(rows.shape)) / RAYS
        dy, dx = displaced(y, x, side, strength)
        # Shared among the four nearest pixels, as by a ray of a pixel's width.
        top, left = np.floor(y + dy).astype(int), np.floor(x + dx).astype(int)
        low, near = y + dy - top, x + dx - left
        for down, share_y in ((0, 1 - low), (1, low)):
            for right, share_x in ((0, 1 - near), (1, near)):
                # The field ends inside the image: what a share of a ray would lose, it keeps.
                row = np.clip(top + down, 0, side - 1)
                column = np.clip(left + right, 0, side - 1)
                light = weights * (share_y * share_x).ravel()
                counts += np.bincount((row * side + column).ravel(), light, counts.size)
    return counts.reshape(side, side), displaced(rows, columns, side, strength)


def uneven_beam(rng: np.random.Generator, side: int, variation: float) -> FloatArray:
    """Return a beam that varies over a quarter of the side by so much (r.m.s.)."""
    white = rng.normal(size=(3 * side, 3 * side))
    smooth = gaussian_filter(white, side / 4 / np.sqrt(2), mode="wrap")[:side, :side]
    smooth -= smooth.mean()
    return 1 + variation * smooth / smooth.std()


def right(strength: float = 0.5, *, recorded: bool = True) -> Callable[..., Trial]:
    """A shot with a right reference, or of a flat beam that is assumed to be flat."""

    def trial(rng: np.random.Generator, side: int) -> Trial:
        image, truth = traced(rng, side, strength)
        source = {"source": rng.poisson(COUNTS, image.shape)} if recorded else {}
        return Trial(rng.poisson(image), truth, source)

    return trial


def other_beam(
    variation: float, strength: float = 0.5, *, recorded: bool = True
) -> Callable[..., Trial]:
    """A beam that differs from the reference, or from the flat one that is assumed."""

    def trial(rng: np.random.Generator, side: int) -> Trial:
        image, truth = traced(rng, side, strength, uneven_beam(rng, side, variation))
        source = {"source": rng.poisson(COUNTS, image.shape)} if recorded else {}
        return Trial(rng.poisson(image), truth, source)

    return trial


def tilted_beam(rng: np.random.Generator, side: int) -> Trial:
    """A beam that is 5 % brighter on one side and 5 % dimmer on the other, assumed to be flat."""
    beam = np.linspace(0.95, 1.05, side)[None, :] * np.ones((side, 1))
    image, truth = traced(rng, side, 0.5, beam)
    return Trial(rng.poisson(image), truth)


def correlated_noise(blur: float) -> Callable[..., Trial]:
    """Noise of a weak shot that the detector has blurred."""

    def trial(rng: np.random.Generator, side: int) -> Trial:
        image, truth = traced(rng, side, 0.2)
        noise = gaussian_filter(rng.normal(size=image.shape), blur, mode="wrap")
        image = image + 0.05 * COUNTS * noise / noise.std()
        return Trial(image, truth, {"source": np.full(image.shape, COUNTS)})

    return trial


def masked_peak(rng: np.random.Generator, side: int) -> Trial:
    """A mask over the strongest part of the field."""
    image, truth = traced(rng, side, 0.8)
    length = np.hypot(*truth)
    row, column = np.unravel_index(length.argmax(), length.shape)
    half = side // 16
    mask = np.ones(image.shape, dtype=bool)
    mask[row - half : row + half, column - half : column + half] = False
    arguments = {"source": np.full(image.shape, COUNTS), "mask": mask}
    return Trial(rng.poisson(image), truth, arguments)


def cropped_object(share: float, strength: float = 0.5) -> Callable[..., Trial]:
    """An object that a crop cuts, so many widths of it from its centre."""

    def trial(rng: np.random.Generator, side: int) -> Trial:
        image, truth = traced(rng, side, strength)
        first = round(0.52 * side - share * side / 10)
        image, truth = image[:, first:], truth[:, :, first:]
        return Trial(rng.poisson(image), truth, {"source": np.full(image.shape, COUNTS)})

    return trial


CASES: dict[str, Callable[[np.random.Generator, int], Trial]] = {
    "reference 1 % different": other_beam(0.01),
    "reference 3 % different": other_beam(0.03),
    "reference 5 % different": other_beam(0.05),
    "reference 5 % different, weak object": other_beam(0.05, 0.1),
    "flat beam assumed, 1 % uneven": other_beam(0.01, recorded=False),
    "flat beam assumed, 3 % uneven": other_beam(0.03, recorded=False),
    "flat beam assumed, 5 % uneven": other_beam(0.05, recorded=False),
    "flat beam assumed, 15 % uneven": other_beam(0.15, recorded=False),
    "flat beam assumed, tilted by 5 %": tilted_beam,
    "noise correlated over 1 px": correlated_noise(1.0),
    "noise correlated over 2 px": correlated_noise(2.0),
    "mask over the peak": masked_peak,
    "object cropped at 2 widths": cropped_object(2.0),
    "object cropped at 1.5 widths": cropped_object(1.5),
    "object cropped at 1 width": cropped_object(1.0),
    "focusing object cropped at 1.5 widths": cropped_object(1.5, -0.3),
}

RIGHT: dict[str, Callable[[np.random.Generator, int], Trial]] = {
    "weak, reference": right(0.1),
    "strong, reference": right(0.9),
    "focusing, reference": right(-0.3),
    "weak, flat": right(0.1, recorded=False),
    "strong, flat": right(0.9, recorded=False),
}


@dataclass(frozen=True)
class Outcome:
    """The quality of one inversion against the truth."""

    error: float
    total: float
    warnings: tuple[Caution, ...]

    @property
    def is_silent(self) -> bool:
        return not self.warnings and self.error > max(MIN_ERROR, MAX_TOTALS * self.total)


def run_trial(trial: Trial) -> Outcome:
    """Invert a trial and compare the displacement with the truth where it was not masked."""
    options = InversionOptions(negative="clip")
    inversion = invert(trial.image, options=options, **trial.arguments)
    used = inversion.mask
    scale = float(np.sqrt((trial.truth[:, used] ** 2).sum(axis=0).mean()))
    difference = (inversion.displacement - trial.truth)[:, used]
    error = float(np.sqrt((difference**2).sum(axis=0).mean())) / scale
    total = np.nan if inversion.errors is None else inversion.errors.total.rms / scale
    return Outcome(error, total, inversion.report.warnings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--side", type=int, default=128, help="side of the images, px")
    parser.add_argument("--right", type=int, default=20, help="right images of each kind")
    choices = parser.parse_args()
    silent = 0
    print("| case | error, % | total, % | warnings |\n|---|---|---|---|")
    for seed, (name, make) in enumerate(CASES.items()):
        outcome = run_trial(make(np.random.default_rng(seed), choices.side))
        silent += outcome.is_silent
        codes = ", ".join(caution.code for caution in outcome.warnings)
        mark = "SILENT " if outcome.is_silent else ""
        print(f"| {name} | {outcome.error:.1%} | {outcome.total:.1%} | {mark}{codes} |", flush=True)
    print(f"\n{silent} of {len(CASES)} cases are wrong in silence\n")
    print("| right input | warned | of | error above 3 totals |\n|---|---|---|---|")
    for name, make in RIGHT.items():
        rngs = [np.random.default_rng(1000 + seed) for seed in range(choices.right)]
        outcomes = [run_trial(make(rng, choices.side)) for rng in rngs]
        warned = sum(bool(outcome.warnings) for outcome in outcomes)
        beyond = sum(outcome.error > MAX_TOTALS * outcome.total for outcome in outcomes)
        codes = sorted({caution.code for each in outcomes for caution in each.warnings})
        print(f"| {name} | {warned} {', '.join(codes)} | {choices.right} | {beyond} |", flush=True)


if __name__ == "__main__":
    main()
