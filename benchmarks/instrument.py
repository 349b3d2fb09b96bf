"""Inversions with an instrument that is not exact: the tables of docs/uncertainty.md.

    python benchmarks/instrument.py [totals bands ranks cost fits energies] [--shots 210]
        [--side 128] [--times 2]

Each image is counted rays (`counted` of `fit.py`; the package's forward model is not used) of one
of six objects, with an imperfection drawn from its stated prior: a smooth random beam, a
background, a gamma, a blur, a transmission of smooth noise, a reference out of register. The noise
is that of 1,000 counts a pixel.

Totals: the r.m.s. ratio of the error to the total of the budget, the share of errors within one
and two totals, and the median error. A total is right if the ratio is about 1; of a single unknown
number 68 and 95 % are within.
Bands: the share of pixels whose true displacement lies within the bands of `uncertainty`, for
imperfections as large as stated, half and twice as large.
Ranks: for random objects, the rank of the truth among the samples of quantities, mirrored as in
their bands, and TARP, the rank of its distance from random points. The columns are the share of
truths within 68 and 95 %, and the probability of ranks as uneven if all were equally likely
(Kolmogorov and Smirnov).
Cost: samples a minute, and time and memory of the budget.
Fits: the same for fits of one to four images, by the objects in turn, half of them folded, with
3 % noise: the L2 error over the total of the report, the share of pixels within 1 and 1.96 standard
deviations, and what is wrong though it is *determined*, by more than 5 % and three totals.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter
from scipy.stats import kstest

from fit import Beam, Field, blobs, counted
from napari_shadowinv import FitOptions, Instrument, InversionOptions, fit, invert, synthetic_image
from napari_shadowinv._system.machine import available_threads
from napari_shadowinv.facts import Verdict
from napari_shadowinv.inversion import ErrorSamples, Maximum, plan_sites
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.shot import shots_of
from reference import toroid_case

FloatArray = NDArray[np.float64]
COUNTS, RAYS = 1000.0, 12
HIGHEST_WAVE, ROUGH_WAVE = 7.0, 30.0  # times the length
BANDS, RANKS = 100, 199  # samples


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

    smoothness: float | None = None

    def __init__(self, side: int, displaced: Field, seed: int, times: float = 1.0) -> None:
        self.side, self.displaced, self.times = side, displaced, times
        self.rng = np.random.default_rng([seed, 28])
        self.source = np.ones((side, side))
        self.beam: Beam | None = None
        self.after: Callable[[FloatArray], FloatArray] = lambda image: image
        self.instrument = Instrument()

    def waves(self, length: float) -> Beam:
        """Return a random field of Gaussian correlation, or of Matérn's if it is less smooth.

        A Fourier series with normal coefficients, whose period is longer than any correlation. Its
        mean over the image is 0, its expected r.m.s. 1.
        """
        side = self.side
        period = side * (2 + 4 * length)
        smoothness = self.smoothness
        highest_wave = HIGHEST_WAVE if smoothness is None else ROUGH_WAVE
        highest = int(np.ceil(highest_wave * period / (2 * np.pi * length * side)))
        orders = np.arange(-highest, highest + 1) * 2 * np.pi / period
        squares = (length * side) ** 2 * (orders[:, None] ** 2 + orders**2)
        if smoothness is None:
            spectrum = np.exp(-squares / 4)
        else:  # of Matérn
            spectrum = (2 * smoothness + squares) ** (-(smoothness + 1) / 2)
        spectrum /= np.sqrt((spectrum**2).sum())
        pixels = np.arange(side, dtype=np.float64)
        of_mean = np.abs(np.exp(1j * np.multiply.outer(pixels, orders)).mean(axis=0)) ** 2
        variance = 1 - of_mean @ spectrum**2 @ of_mean  # without the mean over the image
        numbers = self.rng.normal(size=spectrum.shape) + 1j * self.rng.normal(size=spectrum.shape)
        numbers *= spectrum / np.sqrt(variance)
        step = 0.6 * length * side / highest_wave
        places = np.arange(-0.5 * side, 1.5 * side + step, step)

        def height(places: FloatArray) -> FloatArray:
            waves = np.exp(1j * np.multiply.outer(places, orders))
            return np.asarray((waves @ numbers @ waves.T).real)

        smooth = spline_filter(height(places) - height(pixels).mean())

        def at(y: FloatArray, x: FloatArray) -> FloatArray:
            indices = (np.stack([y, x]) - places[0]) / step
            return np.asarray(map_coordinates(smooth, indices, prefilter=False, mode="nearest"))

        return at

    def image(self) -> FloatArray:
        """Return the counts of a shot."""
        shape = self.side, self.side
        image = self.after(counted([self.displaced], np.array([1.0]), self.beam, shape, RAYS))
        return self.rng.poisson(COUNTS * np.maximum(image, 0)).astype(np.float64)


def beam_off(shot: Shot) -> None:
    wave = shot.waves(0.25)
    shot.beam = lambda y, x: 1 + 0.02 * shot.times * wave(y, x)
    shot.instrument = Instrument(beam_rms=0.02)


def background(shot: Shot) -> None:
    share = 0.1 * shot.times * shot.rng.normal()
    shot.after = lambda image: image + share * image.mean()
    shot.instrument = Instrument(background=0.1)


def gamma(shot: Shot) -> None:
    exponent = 1 + 0.1 * shot.times * shot.rng.normal()
    shot.after = lambda image: np.maximum(image, 0) ** exponent
    shot.instrument = Instrument(gamma=0.1)


def blur(shot: Shot) -> None:
    width = abs(2 * shot.times * shot.rng.normal())
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
        return np.asarray(1 + 0.02 * shot.times * within * wave(y, x))

    shot.beam, shot.instrument = beam, Instrument(absorption=0.02)


def registration(shot: Shot) -> None:
    """A beam with structure of a tenth of the image, whose reference is shifted and turned."""
    wave = shot.waves(0.1)
    shot.beam = lambda y, x: 1 + 0.1 * wave(y, x)
    middle = (shot.side - 1) / 2
    y, x = np.indices((shot.side, shot.side), dtype=np.float64)
    down, right, turn, scale = shot.times * shot.rng.normal(size=4)
    v, u = ((place - middle) / (np.sqrt(0.5) * shot.side) for place in (y, x))
    shot.source = shot.beam(y + down + turn * u + scale * v, x + right - turn * v + scale * u)
    shot.instrument = Instrument(registration=1.0)


def everything(shot: Shot) -> None:
    """Beam, background, gamma and blur together."""
    wave = shot.waves(0.25)
    shot.beam = lambda y, x: 1 + 0.01 * shot.times * wave(y, x)
    share, exponent, width = shot.times * shot.rng.normal(size=3) * [0.1, 0.1, 1.0]

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


def table_of_totals(side: int, shots: int, first_seed: int) -> None:
    """Print a row for each imperfection, then how often an error is far above its total."""
    names = list(objects(side))
    count = -(-shots // len(IMPERFECTIONS))
    print("| imperfection | inversions | error over total | within 1, 2 totals | error |")
    print("|---|---|---|---|---|")
    ratios_of_all = []
    for title, change in IMPERFECTIONS.items():
        ratios, shares = [], []
        for number in range(count):
            name = names[number % len(names)]
            shot = Shot(side, objects(side)[name], first_seed + number)
            change(shot)
            inversion = invert(
                shot.image(), source=COUNTS * shot.source, instrument=shot.instrument
            )
            exact = truth(side, name)
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
        f"{(total < 3).mean():.1%}, largest {total.max():.1f}\n",
        flush=True,
    )


def table_of_bands(side: int, shots: int, first_seed: int) -> None:
    """Print the share of pixels within their bands, for imperfections as stated and not."""
    names = list(objects(side))
    count = -(-shots // len(IMPERFECTIONS))
    sizes = 1.0, 0.5, 2.0
    heads = ["as stated", "half as large", "twice as large"]
    print(f"| imperfection, {count} shots each | " + " | ".join(f"{h}, 68, 95 %" for h in heads))
    print("|---|---|---|---|")
    for title, change in IMPERFECTIONS.items():
        row = []
        for times in sizes:
            within = []
            for number in range(count):
                name = names[number % len(names)]
                shot = Shot(side, objects(side)[name], first_seed + number, times)
                change(shot)
                inversion = invert(
                    shot.image(), source=COUNTS * shot.source, instrument=shot.instrument
                )
                exact = truth(side, name)
                drawn = samples_of(inversion, BANDS)
                ends = [drawn.band(share) for share in (0.68, 0.95)]
                within.append([((low < exact) & (exact < high)).mean() for low, high in ends])
            narrow, wide = np.mean(within, axis=0)
            row.append(f"{narrow:.0%}, {wide:.0%}")
        print(f"| {title} | " + " | ".join(row) + " |", flush=True)
    print()


def samples_of(inversion: Inversion, n: int, **choices: Any) -> ErrorSamples:
    """Return samples of counting noise and instrument."""
    errors = inversion.uncertainty(n, noise="poisson", **choices).errors
    assert errors is not None
    assert errors.samples is not None
    return errors.samples


def quantities(side: int) -> dict[str, Callable[[FloatArray, FloatArray], FloatArray]]:
    """Return a peak, an r.m.s., the flux through a line, and a sum of charges by its field."""
    start, stop = side // 4, side - side // 4

    def enclosed(potential: FloatArray, displacement: FloatArray) -> FloatArray:
        """Flux of the displacement out of a square, by Gauss the sum of its sources."""
        along_y, along_x = displacement[:, start:stop, start:stop]
        ends = along_y[-1] - along_y[0] + along_x[:, -1] - along_x[:, 0]
        return np.asarray(ends.sum())

    return {
        "peak": Maximum(lambda potential, displacement: np.hypot(*displacement).max()),
        "r.m.s.": lambda potential, displacement: np.asarray(length(displacement)),
        "flux through a line": lambda potential, displacement: displacement[
            1, start:stop, side // 3
        ].sum(),
        "enclosed integral": enclosed,
    }


def table_of_ranks(side: int, shots: int, first_seed: int, method: str) -> None:
    """Print how even the ranks of the truth are among the samples."""
    measures = quantities(side)
    names = list(objects(side))
    samples, truths = [], []
    for number in range(shots):
        rng = np.random.default_rng([first_seed + number, 29])
        strength = rng.uniform(0.5, 1.0)
        shape = objects(side)[names[number % len(names)]]
        scaled = scale_field(shape, strength)
        shot = Shot(side, scaled, first_seed + number)
        everything(shot)
        inversion = invert(
            shot.image(),
            source=COUNTS * shot.source,
            instrument=shot.instrument,
            options=InversionOptions(seed=number),
        )
        result = samples_of(inversion, RANKS, quantities=measures, method=method)
        samples.append(np.array([q.mirrored() for q in result.quantities.values()]).T)
        exact = strength * truth(side, names[number % len(names)])
        truths.append([float(measure(exact[0], exact)) for measure in measures.values()])
    drawn, exact = np.array(samples), np.array(truths)
    print(f"| quantity, {shots} objects, {method} | within 68, 95 % | probability |")
    print("|---|---|---|")
    rng = np.random.default_rng(first_seed)
    ranks = dict(zip(measures, ((drawn < exact[:, None]).mean(axis=1)).T, strict=True))
    scale = drawn.std(axis=1, keepdims=True)
    # Random points near each truth's inversion, not at it.
    points = drawn.mean(axis=1, keepdims=True) + 2 * scale * rng.normal(size=scale.shape)
    of_samples = np.linalg.norm((drawn - points) / scale, axis=2)
    of_truth = np.linalg.norm((exact[:, None] - points) / scale, axis=2)
    for title, rank in ranks.items():
        within = [(abs(rank - 0.5) < share / 2).mean() for share in (0.68, 0.95)]
        print(f"| {title} | {within[0]:.0%}, {within[1]:.0%} | {evenness(rank):.2g} |")
    rank = (of_samples < of_truth).mean(axis=1)
    within = [(rank < share).mean() for share in (0.68, 0.95)]
    print(f"| TARP | {within[0]:.0%}, {within[1]:.0%} | {evenness(rank):.2g} |\n", flush=True)


def scale_field(shape: Field, strength: float) -> Field:
    """Return a field times a number."""

    def scaled(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        along_y, along_x = shape(y, x)
        return strength * along_y, strength * along_x

    return scaled


def evenness(ranks: FloatArray) -> float:
    return float(kstest(ranks, "uniform").pvalue)


INSTRUMENT = Instrument(
    beam_rms=0.02,
    background=0.05,
    gamma=0.05,
    blur=1.0,
    absorption=0.02,
    registration=1.0,
    other_field=0.05,
)


def table_of_cost() -> None:
    """Print samples a minute, by wall and by processor time, and what a budget costs."""
    options = InversionOptions(n_sites=10_000)
    image = np.random.default_rng(0).poisson(COUNTS * toroid_case(97).image).astype(float)
    plan = plan_sites(COUNTS * np.ones(image.shape), options)
    inversion = invert(image, plan=plan, options=options, instrument=INSTRUMENT)
    print("| samples, 200², 10,000 sites | a minute | a minute by processor time |")
    print("|---|---|---|")
    for method, (few, many) in {"linear": (8, 1608), "resolve": (8, 108)}.items():

        def seconds(n: int, method: str = method) -> FloatArray:
            start = np.array([time.perf_counter(), time.process_time()])
            samples_of(inversion, n, method=method)
            return np.array([time.perf_counter(), time.process_time()]) - start

        seconds(few)
        wall, processor = np.median([seconds(many) - seconds(few) for _ in range(3)], axis=0)
        count, threads = many - few, available_threads(None)
        print(f"| {method} | {60 * count / wall:,.0f} | {60 * threads * count / processor:,.0f} |")
    print("\n| budget | all imperfections, s | exact, s | memory of the process, GB |")
    print("|---|---|---|---|")
    for side in (200, 1000):
        rng = np.random.default_rng(0)
        displaced = objects(side)["ring"]
        moves = np.stack(displaced(*np.indices((side, side), dtype=np.float64)))
        image = rng.poisson(COUNTS * synthetic_image(moves)).astype(float)
        source = COUNTS * np.ones((side, side))
        repeats = 3 if side == 200 else 1  # the first compiles
        stated, exact = (
            [
                invert(image, source=source, instrument=instrument).report.seconds["errors"]
                for _ in range(repeats)
            ][-1]
            for instrument in (INSTRUMENT, Instrument())
        )
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(f"| {side}² | {stated:.2f} | {exact:.2f} | {memory:.1f} |", flush=True)


FIT_STRENGTHS = 1.0, 0.69, 0.45, 0.3  # 14.7, 30, 70 and 130 MeV or so
FIT_NOISE, FIT_BLUR_PX, FIT_RAYS = 0.03, 2.0, 20
FOLDED = 2.2  # times the objects of inversions


@dataclass
class Imperfect:
    """Images of an object at several energies while they are simulated."""

    beam: float = 0.0  # r.m.s.
    between: float = 0.0  # r.m.s., from image to image
    background: float = 0.0  # share of the mean
    gamma: float = 0.0
    blur: float = FIT_BLUR_PX
    absorption: float = 0.0

    def images(self, shot: Shot, strengths: FloatArray) -> list[FloatArray]:
        """Return the images, with noise."""
        common = shot.waves(0.25)
        images = []
        y, x = np.indices((shot.side, shot.side), dtype=np.float64)
        depth = np.hypot(*shot.displaced(y, x))
        radius = np.sqrt((depth > 0.1 * depth.max()).sum() / np.pi)
        wave = shot.waves(radius / shot.side)

        def transmission(y: FloatArray, x: FloatArray) -> FloatArray:
            size = np.maximum(np.hypot(*shot.displaced(y, x)) / depth.max(), 1e-9)
            within = 1 / (1 + np.exp(-2 * (np.log(size) + np.log(10.0))))
            return np.asarray(1 + self.absorption * within * wave(y, x))

        for strength in strengths:
            own = shot.waves(0.25)

            def beam(y: FloatArray, x: FloatArray, own: Beam = own) -> FloatArray:
                light = (1 + self.beam * common(y, x)) * (1 + self.between * own(y, x))
                return np.asarray(light * transmission(y, x))

            shape = shot.side, shot.side
            image = counted([shot.displaced], np.array([strength]), beam, shape, FIT_RAYS)
            image = gaussian_filter(image, self.blur, mode="nearest") if self.blur else image
            image = image ** (1 + self.gamma)
            image = (1 - self.background) * image + self.background * image.mean()
            noise = FIT_NOISE * image.mean() * shot.rng.normal(size=shape)
            images.append(image + noise)
        return images


class FitOutcome(NamedTuple):
    """L2 error of a fit, its total, and the shares of pixels within their bands."""

    error: float
    total: float
    verdict: Verdict
    within_68: float
    within_95: float

    @property
    def ratio(self) -> float:
        """Error over total."""
        return self.error / self.total


def fit_cases(
    rng: np.random.Generator, times: float = 1.0
) -> dict[str, tuple[Imperfect, Instrument]]:
    """Return imperfections drawn from what is stated of them, or times as large."""
    normal = lambda size: float(times * size * rng.normal())  # noqa: E731
    blur = float(np.sqrt(max(FIT_BLUR_PX**2 + normal(1.66**2), 0.0)))
    exact_beam = {"beam_rms": 0.0}
    return {
        "none": (Imperfect(), Instrument(**exact_beam)),
        "beam 5 %": (Imperfect(beam=0.05 * times), Instrument(beam_rms=0.05)),
        "beam 2 %": (Imperfect(beam=0.02 * times), Instrument(beam_rms=0.02)),
        "beams 3 % between": (
            Imperfect(between=0.03 * times),
            Instrument(beam_rms=0.0, beam_between=0.03),
        ),
        "beams 10 % between": (
            Imperfect(between=0.1 * times),
            Instrument(beam_rms=0.0, beam_between=0.1),
        ),
        "background 10 %": (
            Imperfect(background=normal(0.1)),
            Instrument(background=0.1, **exact_beam),
        ),
        "gamma 0.15": (Imperfect(gamma=normal(0.15)), Instrument(gamma=0.15, **exact_beam)),
        "blur 2 px ± 30 %": (Imperfect(blur=blur), Instrument(blur=1.66, **exact_beam)),
        "absorption 5 %": (
            Imperfect(absorption=0.05 * times),
            Instrument(absorption=0.05, **exact_beam),
        ),
        "beam 5 %, background 10 %, blur ± 30 %": (
            Imperfect(beam=0.05 * times, background=normal(0.1), blur=blur),
            Instrument(beam_rms=0.05, background=0.1, blur=1.66),
        ),
    }


def fit_outcome(
    side: int, name: str, times: float, count: int, case: tuple[Imperfect, Instrument], seed: int
) -> FitOutcome:
    """Fit images of an object, `times` as strong, at a number of energies."""
    imperfect, instrument = case
    exact = scale_field(objects(side)[name], times)
    strengths = np.array(FIT_STRENGTHS[:count])
    result = fit(
        shots_of(
            imperfect.images(Shot(side, exact, seed), strengths),
            strength=strengths,
            psf=FIT_BLUR_PX,
        ),
        instrument=instrument,
        options=FitOptions(samples=8),
    )
    exact_field = times * truth(side, name)
    (field,) = result.fields
    error = length(field.displacement - exact_field) / length(exact_field)
    assert field.errors.per_pixel is not None
    off = np.abs(field.displacement - exact_field) / field.errors.per_pixel
    within = (off < 1).mean(), (off < 1.96).mean()
    return FitOutcome(error, result.total_error, result.verdict, *within)


def table_of_energies(side: int, first_seed: int) -> None:
    """Print fits of three energies of each object with an inexact beam, background and blur."""
    print("| object | error | total | verdict |\n|---|---|---|---|")
    for number, name in enumerate(objects(side)):
        for times in (1.0, FOLDED):
            cases = fit_cases(np.random.default_rng([first_seed + number, 30]))
            case = cases["beam 5 %, background 10 %, blur ± 30 %"]
            outcome = fit_outcome(side, name, times, 3, case, first_seed + number)
            print(
                f"| {name} x {times:g} | {outcome.error:.1%} | {outcome.total:.1%} | "
                f"{outcome.verdict} |",
                flush=True,
            )
    print()


def table_of_fits(side: int, shots: int, first_seed: int, times: float) -> None:
    """Print a row for each imperfection, and each fit that is wrong though it is determined."""
    names = list(objects(side))
    rows: dict[str, list[FitOutcome]] = {}
    for number in range(shots):
        cases = fit_cases(np.random.default_rng([first_seed + number, 30]), times)
        title = list(cases)[number % len(cases)]
        round_number = number // len(cases)
        # One energy in every eighth shot; the others have two, three or four.
        count = 1 if number % 8 == 7 else 2 + round_number % 3
        folded = FOLDED if round_number % 2 else 1.0
        name = names[(number + round_number) % len(names)]
        outcome = fit_outcome(side, name, folded, count, cases[title], first_seed + number)
        rows.setdefault(title, []).append(outcome)
        is_wrong = outcome.verdict is Verdict.DETERMINED and outcome.ratio > 3
        is_wrong &= outcome.error > 0.05
        print(
            f"{title}, {name} x {folded:g}, {count}: error {outcome.error:.1%}, total "
            f"{outcome.total:.1%}, {outcome.verdict}{' WRONG' if is_wrong else ''}",
            file=sys.stderr,
            flush=True,
        )
    heads = "determined | refused | error over total | within 1, 2 totals | pixels | error"
    print(f"| stated | fits | {heads} |")
    print("|---|---|---|---|---|---|---|---|")
    for title, values in rows.items():
        print(f"| {title} | {_fit_row(values)} |")
    print(f"| all | {_fit_row([value for row in rows.values() for value in row])} |\n", flush=True)


def _fit_row(outcomes: list[FitOutcome]) -> str:
    verdicts = [outcome.verdict for outcome in outcomes]
    known = [each for each in outcomes if each.verdict in (Verdict.DETERMINED, Verdict.UNCERTAIN)]
    counts = (
        f"{len(outcomes)} | {verdicts.count(Verdict.DETERMINED)} | {len(outcomes) - len(known)}"
    )
    if not known:
        return f"{counts} | – | – | – | –"
    ratios = np.array([each.ratio for each in known])
    pixels = np.mean([each[-2:] for each in known], axis=0)
    return (
        f"{counts} | {np.sqrt((ratios**2).mean()):.2f} | "
        f"{(ratios < 1).mean():.0%}, {(ratios < 2).mean():.0%} | "
        f"{pixels[0]:.0%}, {pixels[1]:.0%} | "
        f"{np.median([each.error for each in known]):.1%}"
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    tables = ["totals", "bands", "ranks", "cost", "fits", "energies"]
    parser.add_argument("tables", nargs="*", choices=[*tables, []], help="default: all")
    parser.add_argument("--shots", type=int, default=210)
    parser.add_argument("--side", type=int, default=128)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--times", type=float, default=1.0, help="imperfections of fits as stated")
    parser.add_argument("--method", choices=["linear", "resolve"], default="linear")
    parser.add_argument("--smoothness", type=float, help="of beams: a Matérn correlation's")
    arguments = parser.parse_args()
    Shot.smoothness = arguments.smoothness
    size = arguments.side, arguments.shots, arguments.first_seed
    chosen = arguments.tables or tables
    if "totals" in chosen:
        table_of_totals(*size)
    if "bands" in chosen:
        table_of_bands(*size)
    if "ranks" in chosen:
        table_of_ranks(*size, arguments.method)
    if "cost" in chosen:
        table_of_cost()
    if "fits" in chosen:
        table_of_fits(*size, arguments.times)
    if "energies" in chosen:
        table_of_energies(arguments.side, arguments.first_seed)


if __name__ == "__main__":
    main()
