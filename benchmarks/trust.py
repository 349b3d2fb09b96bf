"""Whether verdicts and errors may be believed: what is silent, what cries, what holds the truth.

    python benchmarks/trust.py [--only edges noise …] [--seed 0] [--full] [--json FILE] [--list]

Images are made by formulae and areas (`exact_shots.py`) and by random numbers of `--seed`; the
package's forward model is not used, except by its own samples and tutorials, which are measured
as they are. 96 px, 1,000 counts a pixel unless said.

- An answer *stands* if its verdict is "determined" or "depends on the beam" or "the detector". It
  is *silent* if it stands while the field (L2) is off by more than 5 % and three times the total
  that it states.
- It is *refused* if it neither stands nor is "too uncertain".
- It *cries* if it does not stand and states more than three times its true error.

Each row prints its answers as it goes on (`--list`), and the table at the end has one line for each
number: how many, of how many. By default it takes 10 minutes on two cores, with `--full` an hour.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy import constants
from scipy.special import ndtri

from exact_shots import (
    Beam,
    Displacement,
    FloatArray,
    Gaussian,
    Profile,
    Waves,
    added,
    correlated_noise,
    gaussian_blur,
    gaussians,
    image_of,
    random_waves,
    round_field,
    scaled,
    straight,
    truth_of,
    with_slope,
)
from napari_shadowinv import (
    Fit,
    Instrument,
    Inversion,
    OpticalSetup,
    ProtonSetup,
    analyse,
    fit,
    invert,
    read,
)
from napari_shadowinv.analysis import EnclosedCurrent, LineProfile
from napari_shadowinv.shot import shots_of

SIDE, COUNTS = 96, 1000.0
MIDDLE = (SIDE - 1) / 2
MAX_ERROR, MAX_TOTALS = 0.05, 3.0
STANDING = "determined", "depends on the beam", "depends on the detector"
ENERGIES = 14.7, 30.0, 70.0  # MeV
PROTON_MASS = 938.272  # MeV
CELLS, FOLDED_CELLS = 6, 14  # a pixel on each axis
FLAT = np.full((SIDE, SIDE), COUNTS)


# Answers


@dataclass
class Answer:
    """An answer of the package beside the truth; lengths in px."""

    row: str
    case: str
    error: float  # r.m.s.
    told: float  # r.m.s.; NaN if not stated
    size: float  # r.m.s. of the true displacement
    verdict: str
    level: str
    says: str
    numbers: dict[str, float] = field(default_factory=dict)

    @property
    def share(self) -> float:
        """Error as a share of the displacement; infinite where there is none."""
        return self.error / self.size if self.size else np.inf

    @property
    def ratio(self) -> float:
        """Error over what is told of it."""
        return self.error / self.told if self.told > 0 else np.inf

    @property
    def is_determined(self) -> bool:
        return self.verdict == "determined"

    @property
    def stands(self) -> bool:
        """Whether it is offered as an answer, be it on a condition."""
        return self.verdict in STANDING

    @property
    def is_silent(self) -> bool:
        return self.stands and self.share > MAX_ERROR and self.ratio > MAX_TOTALS

    @property
    def is_refused(self) -> bool:
        return self.verdict not in (*STANDING, "too uncertain")

    @property
    def cries(self) -> bool:
        return not self.stands and self.ratio < 1 / MAX_TOTALS

    def text(self) -> str:
        marks = [name for name in ("is_silent", "is_refused", "cries") if getattr(self, name)]
        marks = [mark.removeprefix("is_").upper() for mark in marks]
        numbers = ", ".join(f"{name} {value:.3g}" for name, value in self.numbers.items())
        told = self.told / self.size if self.size else np.inf
        return (
            f"{self.row} | {self.case} | error {self.share:.1%} | told {told:.1%} | {self.verdict}"
            f" | {self.level} | {' '.join(marks)} | {numbers} | {self.says[:160]}"
        )


def answer(
    row: str, case: str, result: Inversion | Fit, truth: FloatArray, **numbers: float
) -> Answer:
    """Compare a result with the truth where pixels were used and rays start."""
    is_fit = isinstance(result, Fit)
    found = result.fields[0].displacement if is_fit else result.displacement
    used = result.used if is_fit else result.lit

    def length(planes: FloatArray) -> float:
        return float(np.sqrt((planes**2).sum(axis=0)[used].mean()))

    share = result.total_error
    return Answer(
        row,
        case,
        length(found - truth),
        np.nan if share is None else share * length(found),
        length(truth),
        str(result.verdict),
        str(result.headline.level),
        result.headline.text,
        numbers,
    )


Line = tuple[str, str]
"""What a number is, and the number with how many there are."""


def of(title: str, chosen: Sequence[object], count: int) -> Line:
    return title, f"{len(chosen)} of {count}"


def silent_line(answers: Sequence[Answer], title: str = "silent") -> Line:
    return of(title, [each for each in answers if each.is_silent], len(answers))


# Objects


def random_number(seed: int, *parts: int | str) -> np.random.Generator:
    """Return the random numbers of a case."""
    keys = [part if isinstance(part, int) else sum(part.encode()) for part in parts]
    return np.random.default_rng([seed, 55, *keys])


def beyond_the_frame(rng: np.random.Generator) -> dict[str, Displacement]:
    """Return 13 objects that go on beyond the frame."""
    tilt, width, strength = rng.uniform(-0.15, 0.15), rng.uniform(7, 10), rng.uniform(0.8, 1.1)

    def at(y: float, x: float) -> tuple[float, float]:
        row, column = SIDE * np.array([y, x]) + rng.uniform(-3, 3, 2)
        return float(row), float(column)

    def blob(y: float, x: float, radius: float) -> Displacement:
        wide = radius * rng.uniform(0.9, 1.2)
        return scaled(
            gaussians([Gaussian(radius**2, radius, wide, tilt, *at(y, x))]), 0.5 * strength
        )

    def wire(profile: Profile, angle: float, y: float) -> Displacement:
        return scaled(straight(profile, angle + tilt, *at(y, 0.5)), strength)

    def step(s: FloatArray) -> FloatArray:
        return np.asarray(0.4 * width * np.tanh(s / width))

    def falling(s: FloatArray) -> FloatArray:
        return np.asarray(0.6 * s / (1 + (s / width) ** 2))

    def bell(s: FloatArray) -> FloatArray:
        return np.asarray(0.6 * width * np.exp(-(s**2) / (2 * width**2)))

    ratio: Profile = lambda r: 0.5 * strength / (1 + (r / width) ** 2)  # noqa: E731
    wave: Profile = lambda s: 0.4 * width * np.sin(s / width)  # noqa: E731
    return {
        "wire": wire(step, 0.0, 0.5),
        "wire that falls off": wire(falling, 0.0, 0.5),
        "slanted wire": wire(falling, 0.6, 0.5),
        "two wires": added(wire(falling, 0.0, 0.33), scaled(wire(falling, 0.0, 0.67), -1.0)),
        "sheet": wire(bell, 0.0, 0.5),
        "slanted sheet": wire(bell, 0.8, 0.45),
        "waves": wire(wave, 1.2, 0.5),
        "Gaussian on the edge": blob(0.5, 0.0, 16),
        "Gaussian within an edge": blob(0.5, 0.17, 16),
        "Gaussian in a corner": blob(0.06, 0.94, 18),
        "Gaussian beyond the edge": blob(1.1, 0.5, 18),
        "Gaussian larger than the frame": blob(0.45, 0.55, 45),
        "long range": round_field(ratio, *at(0.5, 0.5)),
    }


def inside(rng: np.random.Generator) -> dict[str, Displacement]:
    """Return five objects inside the frame, to be scaled to a largest slope."""
    u, turn = SIDE / 100, float(rng.uniform(-0.3, 0.3))
    row, column = rng.uniform(-3, 3, 2) + MIDDLE
    lumps = [
        Gaussian(
            float(rng.normal()),
            *(rng.uniform(5, 9, 2) * u),
            float(rng.uniform(0, 3)),
            *(rng.uniform(28, 72, 2) * u),
        )
        for _ in range(20)
    ]
    return {
        "ring": gaussians([Gaussian(1, 10.7, 10.7, 0, row, column)]),
        "focus": gaussians([Gaussian(-1, 10.7, 10.7, 0, row, column)]),
        "ellipses": gaussians(
            [
                Gaussian(1, 6 * u, 9 * u, 0.35 + turn, row - 9, column - 10),
                Gaussian(-0.8, 9 * u, 5.5 * u, 0.2 + turn, row + 10, column + 10),
            ]
        ),
        "filament": gaussians([Gaussian(1, 5 * u, 16 * u, 0.5 + turn, row, column)]),
        "lumps": gaussians(lumps),
    }


def filling(rng: np.random.Generator) -> dict[str, Displacement]:
    """Return four objects that fill half of the frame, with 1 % of their peak at its edge."""
    row, column = rng.uniform(-2, 2, 2) + MIDDLE
    lumps = [
        Gaussian(float(rng.normal()), *rng.uniform(5, 8, 2), 0.0, *rng.uniform(18, 78, 2))
        for _ in range(30)
    ]
    spots = [
        Gaussian(float((-1) ** (i + j)), 7, 7, 0, row + 20 * (i - 1), column + 20 * (j - 1))
        for i in range(3)
        for j in range(3)
    ]
    return {
        "wide ring": gaussians([Gaussian(1, 13, 13, 0, row, column)]),
        "wide ellipse": gaussians([Gaussian(1, 11, 13.5, 0.4, row, column)]),
        "many lumps": gaussians(lumps),
        "nine spots": gaussians(spots),
    }


@lru_cache(maxsize=512)
def made(
    objects: Callable[[np.random.Generator], dict[str, Displacement]],
    name: str,
    slope: float,
    seed: int,
) -> tuple[Displacement, FloatArray, FloatArray]:
    """Return an object scaled to a largest slope, its image without noise, and the truth."""
    displacement = with_slope(objects(np.random.default_rng([seed, 56]))[name], SIDE, slope)
    image = image_of(displacement, SIDE, cells=FOLDED_CELLS if slope > 1 else CELLS)
    return displacement, image, truth_of(displacement, SIDE)


def counted(rng: np.random.Generator, image: FloatArray) -> FloatArray:
    """Return the counts of an image that is 1 in the mean."""
    return rng.poisson(COUNTS * np.maximum(image, 0)).astype(float)


def strengths_of(energies: Sequence[float]) -> FloatArray:
    """Return the displacement by a magnetic field relative to the first energy."""
    momentum = np.sqrt(np.array(energies) * (np.array(energies) + 2 * PROTON_MASS))
    return np.asarray(momentum[0] / momentum)


def setups_of(count: int) -> list[ProtonSetup]:
    lengths = {"source_object_distance": 0.01, "object_image_distance": 0.28, "pixel_size": 5e-6}
    return [ProtonSetup(energy=energy, **lengths) for energy in ENERGIES[:count]]


# Rows


def edges(seed: int, count: int) -> Iterator[Answer]:
    """Objects that go on beyond the frame."""
    stated = Instrument(background=0.02, gamma=0.02, blur=0.5)
    for name, displacement in beyond_the_frame(random_number(seed, "edges")).items():
        truth, rng = truth_of(displacement, SIDE), random_number(seed, name)
        setups = setups_of(2)
        energies = [setup.energy for setup in setups]
        shot, other = flawed_images(Flaw("none"), displacement, energies, rng)
        given = {"source": FLAT, "options": {"boundary": "free"}}
        yield answer("edges", f"{name}, free", invert(shot, **given), truth)
        yield answer("edges", f"{name}, stated", invert(shot, **given, instrument=stated), truth)
        found = fit(
            shots_of([shot, other], setup=setups, source=FLAT, noise="poisson"),
            options=given["options"],
        )
        yield answer("edges", f"{name}, fit of two", found, truth)


def turbulence(seed: int, count: int) -> Iterator[Answer]:
    """A random field that fills the frame."""
    for number in range(count):
        rng = random_number(seed, "turbulence", number)
        longest, steepest = rng.uniform(0.4, 1.0) * SIDE, float(rng.uniform(0.3, 0.7))
        displacement = random_waves(rng, SIDE, steepest, longest)
        shot = counted(rng, image_of(displacement, SIDE))
        for boundary in ("closed", "free"):
            result = invert(shot, source=FLAT, options={"boundary": boundary})
            yield answer("turbulence", boundary, result, truth_of(displacement, SIDE))


def noise(seed: int, count: int) -> Iterator[Answer]:
    """Noise correlated over 1.5 to 3 px where an object fills the frame."""
    for width in (1.5, 2.0, 3.0):
        for number in range(count):
            rng = random_number(seed, "noise", int(10 * width), number)
            names = list(filling(rng))
            name, slope = names[number % len(names)], (0.15, 0.3, 0.5)[number // len(names) % 3]
            _, image, truth = made(filling, name, slope, seed)
            level = float(rng.uniform(0.02, 0.05))
            shot = COUNTS * (image + level * correlated_noise(rng, SIDE, width))
            result = invert(shot, source=FLAT, options={"negative": "clip"})
            yield answer("noise", f"{width:g} px, {name} {slope:g}", result, truth, width=width)


def single_fits(seed: int, count: int) -> Iterator[Answer]:
    """Fits of one image with correlated noise that is estimated."""
    for number in range(count):
        rng = random_number(seed, "single", number)
        name, width = list(filling(rng))[number % 4], (1.3, 1.7, 2.2)[number % 3]
        _, image, truth = made(filling, name, 0.3, seed)
        shot = COUNTS * (image + 0.04 * correlated_noise(rng, SIDE, width))
        yield answer(
            "single fits", f"{width:g} px, {name}", fit(shots_of(shot, source=FLAT)), truth
        )


def right(seed: int, count: int) -> Iterator[Answer]:
    """Right inputs: objects inside, flat fields, small objects."""
    for number in range(count):
        rng = random_number(seed, "right", number)
        kind = ("inside", "filling", "small", "flat", "weak")[number % 5]
        if kind == "flat":
            image, truth = np.ones((SIDE, SIDE)), np.zeros((2, SIDE, SIDE))
        elif kind == "small":
            radius = float(rng.uniform(3, 5))
            spot = gaussians([Gaussian(1, radius, radius, 0, *rng.uniform(30, 66, 2))])
            displacement = with_slope(spot, SIDE, 0.7)
            image, truth = image_of(displacement, SIDE), truth_of(displacement, SIDE)
        else:
            make = filling if kind == "filling" else inside
            names = list(make(np.random.default_rng(0)))
            slope = 0.2 if kind == "weak" else 0.6
            _, image, truth = made(make, names[number // 5 % len(names)], slope, seed)
        shot = counted(rng, image)
        for boundary in ("closed", "free"):
            result = invert(shot, source=FLAT, options={"boundary": boundary})
            yield answer("right", f"{kind}, {boundary}", result, truth)


def doubted_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    doubted = [each for each in answers if each.is_refused or each.cries]
    yield of("refused or doubted", doubted, len(answers))
    yield silent_line(answers)


def inputs(seed: int, count: int) -> Iterator[Answer]:
    """Other beams than the source, wrong references, a mask over the peak, cropped objects."""
    for number in range(count):
        rng = random_number(seed, "inputs", number)
        ring = gaussians([Gaussian(1, 9.6, 9.6, 0, *(MIDDLE + rng.uniform(-3, 3, 2)))])
        for strength in (0.15, 0.6):
            displacement = with_slope(ring, SIDE, strength)
            truth = truth_of(displacement, SIDE)
            wave = Waves(rng, SIDE, SIDE / 4)
            beams = {f"beam {size:.0%} off": uneven(wave, size) for size in (0, 0.01, 0.03, 0.05)}
            beams["beam tilted by 10 %"] = uneven(lambda y, x: x / SIDE - 0.5, 0.1)
            for title, beam in beams.items():
                shot = counted(rng, image_of(displacement, SIDE, beam))
                recorded = rng.poisson(FLAT).astype(float)
                for origin, source in (("recorded", recorded), ("assumed", None)):
                    case = f"{title}, {origin}, slope {strength:g}"
                    yield answer("inputs", case, invert(shot, source=source), truth)
        yield from references(displacement, rng)
        image = counted(rng, image_of(displacement, SIDE))
        yield from hidden_parts(image, truth, int(rng.integers(4)))


def uneven(wave: Beam, size: float) -> Beam:
    return lambda y, x: 1 + size * (wave(y, x) + 0 * y)


def references(displacement: Displacement, rng: np.random.Generator) -> Iterator[Answer]:
    """References out of register, as smooth as an eighth of the frame, and negatives."""
    wave, truth = Waves(rng, SIDE, SIDE / 8), truth_of(displacement, SIDE)
    beam = uneven(wave, 0.1)
    shot = counted(rng, image_of(displacement, SIDE, beam))
    y, x = np.arange(float(SIDE))[:, None], np.arange(float(SIDE))[None, :]
    for shift in (0.0, 0.5, 2.0):
        reference = counted(rng, beam(y + 0.6 * shift, x - 0.8 * shift))
        result = invert(shot, source=reference)
        yield answer("inputs", f"reference shifted by {shift:g} px", result, truth)
    dark = 1.1 * max(shot.max(), reference.max())
    negatives = dark - shot, dark - counted(rng, beam(y, x))
    yield answer("inputs", "both negatives", invert(negatives[0], source=negatives[1]), truth)


def hidden_parts(image: FloatArray, truth: FloatArray, turns: int) -> Iterator[Answer]:
    """A mask over the strongest part of a field, and crops through it, from one of four sides."""
    length = np.hypot(*truth)
    row, column = np.unravel_index(length.argmax(), length.shape)
    mask = np.ones(image.shape, bool)
    mask[row - 6 : row + 6, column - 6 : column + 6] = False
    yield answer("inputs", "mask over the peak", invert(image, source=FLAT, mask=mask), truth)
    middle = int((length.sum(axis=0) * np.arange(SIDE)).sum() / length.sum())
    for widths in (2.0, 1.5, 1.0):
        first = middle - round(9.6 * widths)
        cut = np.ascontiguousarray(np.rot90(image[:, first:], turns))
        planes = np.array([np.rot90(part[:, first:], turns) for part in turned(truth, turns)])
        result = invert(cut, source=np.full(cut.shape, COUNTS))
        yield answer("inputs", f"cropped at {widths:g} widths", result, planes)


def turned(planes: FloatArray, turns: int) -> FloatArray:
    """Return the components of vectors in an image that `rot90` turns."""
    for _ in range(turns):
        planes = np.array([-planes[1], planes[0]])
    return planes


def input_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    titles = "beam 0% off, recorded", "reference shifted by 0 px"
    right_ones = [each for each in answers if each.case.startswith(titles)]
    wrong_ones = [each for each in answers if each not in right_ones]
    yield silent_line(wrong_ones, "wrong sources, masks and crops: silent")
    doubted = [each for each in right_ones if each.is_refused or each.cries]
    yield of("right sources: refused or doubted", doubted, len(right_ones))


@dataclass
class Flaw:
    """What is wrong with the images of a fit that is told nothing of it."""

    cause: str
    beam: float = 0.0  # r.m.s., the same in all images
    beams: float = 0.0  # r.m.s., in each another
    tilt: float = 0.0
    absorption: float = 0.0
    blur: float = 0.0
    pedestal: float = 0.0
    gamma: float = 1.0
    shift: float = 0.0  # px, of later images
    zoom: float = 1.0
    gain: float = 1.0
    energy: float = 1.0  # factor of the energies of later images
    electric: float = 0.0  # share of the displacement

    @property
    def title(self) -> str:
        values = {name: value for name, value in asdict(self).items() if name != "cause"}
        usual = asdict(Flaw(""))
        return f"{self.cause} " + " ".join(
            f"{value:g}" for name, value in values.items() if value != usual[name]
        )


FLAWS = [
    Flaw("gamma", gamma=0.85),
    Flaw("blur", blur=1.5),
    Flaw("pedestal", pedestal=0.1),
    Flaw("registration", shift=0.5),
    Flaw("beam", beam=0.05),
    Flaw("zoom", zoom=1.01),
    Flaw("energy", energy=1.15),
    Flaw("gain", gain=1.03),
    Flaw("absorption", absorption=0.1),
    Flaw("electric", electric=0.3),
    Flaw("gamma", gamma=1.15),
    Flaw("blur", blur=3.0),
    Flaw("pedestal", pedestal=0.2),
    Flaw("registration", shift=1.0),
    Flaw("beam", beam=0.02),
    Flaw("beams", beams=0.02),
    Flaw("beam", tilt=0.05),
]

# How a text names each cause, in any of these words.
NAMES = {
    "gamma": r"gamma|not linear|lineari[sz]e",
    "blur": r"blur|point spread",
    "pedestal": r"dark level|pedestal|constant lies",
    "registration": r"regist|shift",
    "zoom": r"zoom|magnif|scale of",
    "energy": r"energ(y|ies) (is|are|differ|may)|wrong energ|strength",
    "gain": r"bright|gain|exposure",
    "absorption": r"absorb|absorption|transmi",
    "electric": r"electric",
    "beams": r"beams? (differ|is|are)",
    "beam": r"beams? (differ|is|are)",
}


def causes_named(result: Fit) -> list[str]:
    """Return the first cause that a fit names as likely, in our words; beams have two.

    Those that it lists as possible do not count.
    """
    text = result.explanation
    if match := re.search(r"likely ([^;]*)", text):
        clause = match[1]
    elif match := re.search(r"(?:a wider point spread|dark level of about)[^;]*", text):
        clause = match[0]
    else:
        return []
    places = {cause: re.search(words, clause) for cause, words in NAMES.items()}
    found = {cause: place.start() for cause, place in places.items() if place}
    return [cause for cause, start in found.items() if start == min(found.values())]


def flawed_images(
    flaw: Flaw, displacement: Displacement, energies: Sequence[float], rng: np.random.Generator
) -> list[FloatArray]:
    """Return counts of each image with its flaw."""
    common = Waves(rng, SIDE, SIDE / 4)
    size = float(np.abs(truth_of(displacement, SIDE)).max())
    charged = gaussians([Gaussian(1, 9.6, 9.6, 0, 0.42 * SIDE, 0.6 * SIDE)])
    electric = scaled(charged, flaw.electric * size / float(np.abs(truth_of(charged, SIDE)).max()))
    real = np.array([energies[0], *(flaw.energy * each for each in energies[1:])])
    magnetic = strengths_of(real)
    rigidity = real * (real + 2 * PROTON_MASS) / (real + PROTON_MASS)  # pv
    images = []
    for k in range(len(energies)):
        own = Waves(rng, SIDE, SIDE / 4)

        def beam(y: FloatArray, x: FloatArray, own: Waves = own) -> FloatArray:
            square = ((y - MIDDLE) ** 2 + (x - MIDDLE) ** 2) / (2 * (SIDE / 8) ** 2)
            light = 1 + flaw.beam * common(y, x) + flaw.beams * own(y, x)
            light = light + flaw.tilt * (x / SIDE - 0.5) - flaw.absorption * np.exp(-square)
            return np.asarray(light)

        def landing(y: FloatArray, x: FloatArray, k: int = k) -> tuple[FloatArray, FloatArray]:
            # A detector that is shifted or zoomed sees the ray elsewhere.
            b_y, b_x = displacement(y, x)
            e_y, e_x = electric(y, x)
            share = rigidity[0] / rigidity[k]
            moves = magnetic[k] * b_y + share * e_y, magnetic[k] * b_x + share * e_x
            if k == 0:
                return moves
            zoomed = [
                flaw.zoom * (place - MIDDLE + move) + MIDDLE - place
                for place, move in zip((y, x), moves, strict=True)
            ]
            return zoomed[0], zoomed[1] + flaw.shift

        is_even = not (flaw.beam or flaw.beams or flaw.tilt or flaw.absorption)
        image = image_of(landing, SIDE, None if is_even else beam, cells=8)
        image = gaussian_blur(image, flaw.blur) * (flaw.gain if k else 1.0)
        counts = counted(rng, image) / COUNTS + flaw.pedestal
        images.append(COUNTS * counts**flaw.gamma)
    return images


def flaws(seed: int, count: int) -> Iterator[Answer]:
    """Fits with nothing stated where something is wrong."""
    for number in range(count):
        rng = random_number(seed, "flaws", number)
        flaw = FLAWS[number % len(FLAWS)]
        turn, place = divmod(number, len(FLAWS))
        name = ("ring", "ellipses", "lumps")[(turn + place) % 3]
        is_folded = (turn + place) % 2 == 1  # each flaw in turns
        displacement, _, truth = made(inside, name, 1.6 if is_folded else 0.6, seed)
        setups = setups_of(2 + ((turn + 1) // 2 + place // 2) % 2)
        energies = [setup.energy for setup in setups]
        images = flawed_images(flaw, displacement, energies, rng)
        level = COUNTS * (1 + flaw.pedestal) ** flaw.gamma
        given = {"noise": "poisson"} if (turn // 2 + place) % 2 else {}
        source = np.full((SIDE, SIDE), level)
        result = fit(shots_of(images, setup=setups, source=source, **given))
        named = causes_named(result)
        numbers = {"named": float(bool(named)), "cause found": float(flaw.cause in named)}
        folds = "folded " * is_folded
        noise_given = given.get("noise", "noise estimated")
        case = f"{flaw.title}, {folds}{name}, {len(images)} energies, {noise_given}"
        case += f", named {' or '.join(named) or 'none'}"
        yield answer("flaws", case, result, truth, **numbers)


def flaw_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    yield silent_line(answers, "silent")
    named = [each for each in answers if each.numbers["named"]]
    found = [each for each in named if each.numbers["cause found"]]
    yield of("causes named: right", found, len(named))


def right_fits(seed: int, count: int) -> Iterator[Answer]:
    """Right fits without a flaw, with a beam that is known exactly, or from its own counts."""
    for number in range(count):
        rng = random_number(seed, "right fits", number)
        name = list(inside(rng))[number % 5]
        energies = 1 + number % 3
        is_folded = number // 3 % 2 == 1
        slope = float(rng.choice([1.4, 2.0])) if is_folded else float(rng.choice([0.4, 0.7]))
        displacement, _, truth = made(inside, name, slope, seed)
        setups = setups_of(energies)
        images = flawed_images(Flaw("none"), displacement, [each.energy for each in setups], rng)
        beam, text = (rng.poisson(FLAT), ", recorded") if number // 6 % 2 else (FLAT, "")
        result = fit(shots_of(images, setup=setups, source=beam, noise="poisson"))
        kind = "folded single" if is_folded and energies == 1 else "others"
        case = f"{kind}, {name} at {slope:g}, {energies} energies{text}"
        yield answer("right fits", case, result, truth)


def right_fit_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    for kind in ("others", "folded single"):
        chosen = [each for each in answers if each.case.startswith(kind)]
        doubted = [each for each in chosen if each.is_refused or each.cries]
        yield of(f"{kind}: refused or doubted", doubted, len(chosen))
    yield silent_line(answers)


def unknown_beams(seed: int, count: int) -> Iterator[Answer]:
    """Right fits with an unknown beam of 5 to 10 %."""
    for number in range(count):
        rng = random_number(seed, "unknown", number)
        name, is_folded = list(inside(rng))[number % 5], number % 2 == 1
        displacement, _, truth = made(inside, name, 1.6 if is_folded else 0.6, seed)
        setups = setups_of(2 + number // 2 % 2)
        flaw = Flaw("beam", beam=float(rng.uniform(0.05, 0.1)))
        images = flawed_images(flaw, displacement, [each.energy for each in setups], rng)
        result = fit(shots_of(images, setup=setups, source="unknown", noise="poisson"))
        case = f"{'folded ' * is_folded}{name}, {len(images)} energies, beam {flaw.beam:.1%}"
        yield answer("unknown beams", case, result, truth)


def between(seed: int, count: int) -> Iterator[Answer]:
    """Beams that differ between energies, drawn as stated."""
    for number in range(count):
        rng = random_number(seed, "between", number)
        kinds = {"weak ring": ("ring", 0.15), "ring": ("ring", 0.6), "ellipses": ("ellipses", 0.6),
                 "lumps": ("lumps", 0.6), "folded ring": ("ring", 1.8)}  # fmt: skip
        title = list(kinds)[number % 5]
        displacement, _, truth = made(inside, *kinds[title], seed)
        setups = setups_of(2 + number % 2)
        size = (0.03, 0.1, 0.05)[number // 5 % 3]
        images = flawed_images(
            Flaw("beams", beams=size), displacement, [each.energy for each in setups], rng
        )
        stated = Instrument(beam_rms=0.0, beam_between=size)
        result = fit(
            shots_of(images, setup=setups, source=FLAT, noise="poisson"), instrument=stated
        )
        yield answer("between", f"{title}, {len(images)} energies, {size:.0%}", result, truth)


def between_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    kept = [each for each in answers if not each.is_refused]
    yield "error over told, r.m.s.", ratio_text(kept)
    for title in dict.fromkeys(each.case.split(",")[0] for each in answers):
        yield f"- {title}", ratio_text([a for a in kept if a.case.startswith(f"{title},")])
    determined = [each for each in answers if each.is_determined]
    wrong = [each for each in determined if each.share > MAX_ERROR]
    yield of("determined and over 5 %", wrong, len(determined))


def ratio_text(answers: Sequence[Answer]) -> str:
    ratios = [each.ratio for each in answers if np.isfinite(each.ratio)]
    return f"{np.sqrt(np.mean(np.square(ratios))):.2f} of {len(ratios)}" if ratios else "none"


@dataclass
class Drawn:
    """An imperfection drawn as it is stated."""

    stated: Instrument = field(default_factory=Instrument)
    beam: Beam | None = None
    source: FloatArray = field(default_factory=FLAT.copy)
    after: Callable[[FloatArray], FloatArray] = lambda image: image

    def counts(
        self, displacement: Displacement, rng: np.random.Generator, cells: int
    ) -> FloatArray:
        """Return an image with noise."""
        return counted(rng, self.after(image_of(displacement, SIDE, self.beam, cells)))


def spread_numbers(number: int, seed: int) -> FloatArray:
    """Return three normal numbers of a draw; those of a few draws fill the normal distribution.

    Multiples of the inverse powers of 1.2207…, a root of x⁴ = x + 1, are evenly spread.
    """
    steps = 1.2207440846057596 ** -np.arange(1.0, 4.0)
    begin = np.random.default_rng([seed, 57]).uniform(size=3)
    return np.asarray(ndtri((begin + number * steps) % 1.0))


def instrument_drawn(
    kind: str, displacement: Displacement, rng: np.random.Generator, normal: FloatArray
) -> Drawn:
    """Draw an imperfection, by normal numbers if it has few."""
    if kind == "beam":
        wave = Waves(rng, SIDE, SIDE / 4)
        return Drawn(Instrument(beam_rms=0.02), lambda y, x: 1 + 0.02 * wave(y, x))
    if kind == "long beam":
        wave = Waves(rng, SIDE, SIDE / 2)
        stated = Instrument(beam_rms=0.03, beam_length=0.5)
        return Drawn(stated, lambda y, x: 1 + 0.03 * wave(y, x))
    if kind == "background":
        return Drawn(Instrument(background=0.1), after=detector(background=0.1 * normal[0]))
    if kind == "gamma":
        return Drawn(Instrument(gamma=0.1), after=detector(gamma=0.1 * normal[0]))
    if kind == "blur":
        return Drawn(Instrument(blur=2.0), after=detector(blur=2 * normal[0]))
    if kind == "absorption":
        return Drawn(Instrument(absorption=0.02), absorbed(displacement, rng, 0.02))
    if kind == "registration":
        wave = Waves(rng, SIDE, SIDE / 10)
        y, x = np.arange(float(SIDE)), np.arange(float(SIDE))
        source = COUNTS * (1 + 0.1 * wave(y + normal[0], x + normal[1]))
        stated = Instrument(beam_rms=0.0, registration=1.0)
        return Drawn(stated, lambda y, x: 1 + 0.1 * wave(y, x), source)
    if kind == "everything":
        wave = Waves(rng, SIDE, SIDE / 4)
        stated = Instrument(beam_rms=0.01, background=0.1, gamma=0.1, blur=1.0)
        after = detector(0.1 * normal[0], 0.1 * normal[1], normal[2])
        return Drawn(stated, lambda y, x: 1 + 0.01 * wave(y, x), after=after)
    return Drawn()


def detector(
    background: float = 0.0, gamma: float = 0.0, blur: float = 0.0
) -> Callable[[FloatArray], FloatArray]:
    """Return what a detector does to an image; its mean brightness stays."""

    def changed(image: FloatArray) -> FloatArray:
        image = gaussian_blur(image, abs(blur))
        image = (1 - background) * image + background * image.mean()
        return np.asarray(np.maximum(image, 0) ** (1 + gamma))

    return changed


def absorbed(displacement: Displacement, rng: np.random.Generator, size: float) -> Beam:
    """Return a beam that the object weakens by smooth noise of its own size."""
    length = np.hypot(*truth_of(displacement, SIDE))
    peak, radius = length.max(), float(np.sqrt((length > 0.1 * length.max()).sum() / np.pi))
    wave = Waves(rng, SIDE, radius)

    def beam(y: FloatArray, x: FloatArray) -> FloatArray:
        depth = np.maximum(np.hypot(*displacement(y, x)) / peak, 1e-9)
        return np.asarray(1 + size * wave(y, x) / (1 + (0.1 / depth) ** 2))

    return beam


INVERTED = ("none", "beam", "long beam", "background", "gamma", "blur", "absorption",
            "registration", "everything")  # fmt: skip
FITTED = ("beam", "background", "gamma", "blur")


def coverage(seed: int, count: int) -> Iterator[Answer]:
    """Bands of pixels, the peak of a profile and an enclosed current, for 13 imperfections."""
    cases = [*((kind, False) for kind in INVERTED), *((kind, True) for kind in FITTED)]
    setups = setups_of(2)
    for number in range(count):
        for kind, is_fit in cases:
            rng = random_number(seed, "coverage", kind, number, int(is_fit))
            name = ("ring", "ellipses", "focus")[number % 3]
            slope = 1.5 if is_fit and number % 2 else 0.6
            cells = FOLDED_CELLS if slope > 1 else CELLS
            displacement, _, truth = made(inside, name, slope, seed)
            drawn = instrument_drawn(kind, displacement, rng, spread_numbers(number, seed))
            if is_fit:
                images = [
                    drawn.counts(scaled(displacement, strength), rng, cells)
                    for strength in strengths_of(ENERGIES[:2])
                ]
                result: Any = fit(
                    shots_of(images, setup=setups, source=FLAT, noise="poisson"),
                    instrument=drawn.stated,
                    options={"samples": 60},
                )
                std = result.fields[0].errors.per_pixel
                off = np.abs(result.fields[0].displacement - truth) / std
                pixels = [float((off < limit).mean()) for limit in (0.994, 1.96)]
            else:
                image, given = drawn.counts(displacement, rng, cells), {"instrument": drawn.stated}
                result = invert(image, source=drawn.source, **given)
                errors = result.uncertainty(60, noise="poisson").errors
                ends = [errors.samples.band(share) for share in (0.68, 0.95)]
                pixels = [float(((low < truth) & (truth < high)).mean()) for low, high in ends]
            numbers = dict(zip(("pixels 68", "pixels 95"), pixels, strict=True))
            numbers |= product_coverage(result, displacement, truth, setups[0])
            case = f"{'fit, ' * is_fit}{kind}, {'folded ' * (slope > 1)}{name}"
            yield answer("coverage", case, result, truth, **numbers)


def product_coverage(
    result: Inversion | Fit, displacement: Displacement, truth: FloatArray, setup: ProtonSetup
) -> dict[str, float]:
    """Return whether bands hold the peak of a profile, and the current in a circle."""
    row, column = np.unravel_index(np.hypot(*truth).argmax(), truth.shape[1:])
    path = ((float(row), 8.0), (float(row), SIDE - 9.0))
    radius = 18.0
    products = [LineProfile(path=path), EnclosedCurrent(center=(MIDDLE, MIDDLE), radius=radius)]
    profile, current = analyse(result, products, samples=60, setup=setup)
    lengths = np.hypot(*setup.path_integrated_b(truth))
    place = int(column) - 8
    angles = (np.arange(720) + 0.5) * np.pi / 360
    around = [
        [float(part[0]) for part in displacement(np.array([y]), np.array([x]))]
        for y, x in zip(
            MIDDLE + radius * np.sin(angles), MIDDLE + radius * np.cos(angles), strict=True
        )
    ]
    by, bx = setup.path_integrated_b(np.array(around).T[:, :, None])[:, :, 0]
    along = float((by * np.cos(angles) - bx * np.sin(angles)).mean())
    exact = along * 2 * np.pi * radius * setup.object_pixel_size / constants.mu_0
    held = {}
    for name, share in (("68", 0.68), ("95", 0.95)):
        low, high = profile.band("magnitude", share)
        held[f"peak {name}"] = float(low[place] <= lengths[row, column] <= high[place])
        low, high = current.band("current", share)
        held[f"current {name}"] = float(low <= exact <= high)
    return held


def coverage_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    for name in ("pixels", "peak", "current"):
        shares = [
            np.mean([each.numbers[f"{name} {band}"] for each in answers]) for band in (68, 95)
        ]
        yield f"{name}, 68 / 95 %", f"{shares[0]:.0%} / {shares[1]:.0%} of {len(answers)}"
    kinds: dict[str, list[Answer]] = {}
    for each in answers:
        kinds.setdefault(", ".join(each.case.split(", ")[:-1]), []).append(each)
    for kind, own in kinds.items():
        cells = [
            f"{np.mean([each.numbers[f'{name} 68'] for each in own]):.0%} / "
            f"{np.mean([each.numbers[f'{name} 95'] for each in own]):.0%}"
            for name in ("pixels", "peak", "current")
        ]
        yield f"- {kind}: pixels, peak, current", f"{', '.join(cells)} of {len(own)}"


def samples(seed: int, count: int) -> Iterator[Answer]:
    """The demo, the sample data and the tutorials, as they are; the seed changes nothing."""
    from napari_shadowinv._napari import samples as sample_data
    from napari_shadowinv.physics import phantoms

    setup = ProtonSetup.example()
    toroid = phantoms.toroid((200, 200), setup, 97.0, 30e-6).displacement
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "napari_shadowinv", "demo", "--out", folder]
        subprocess.run(command, check=False, capture_output=True)
        (file,) = [*Path(folder).glob("*.shadowinv")] or [*Path(folder).glob("*.nc")]
        yield answer("samples", "demo", Inversion.from_dataset(read(file)), toroid)
    phantoms_of = {
        "toroid": toroid,
        "toroid_with_caustics": phantoms.toroid((200, 200), setup, 194.0, 30e-6).displacement,
        "four_toroids": phantoms.four_toroids((200, 200), setup, 0.8).displacement,
        "coaxial_line": phantoms.coaxial_line((200, 200), setup)[0].displacement,
    }
    for name, truth in phantoms_of.items():
        shot, source, mask = shot_of(getattr(sample_data, name)())
        result = invert(np.asarray(shot), source=source, mask=mask)
        yield answer("samples", f"sample {name}", result, truth)
    yield from sampled_run(sample_data, phantoms)
    yield from tutorials()


def shot_of(layers: Sequence[Any]) -> tuple[Any, FloatArray | None, FloatArray | None]:
    """Return the image of a sample's layers, perhaps a lazy stack, its source and its mask."""
    images = {keywords["name"]: data for data, keywords, kind in layers if kind == "image"}
    sources = [np.asarray(data) for name, data in images.items() if name.endswith("source")]
    (shot,) = (data for name, data in images.items() if not name.endswith("source"))
    unusable = [np.asarray(data) for data, _, kind in layers if kind == "labels"]
    return shot, sources[0] if sources else None, unusable[0] == 0 if unusable else None


def sampled_run(sample_data: Any, phantoms: Any) -> Iterator[Answer]:
    """Three shots of the sample of twenty."""
    stack, source, _ = shot_of(sample_data.wakefield_run())
    for shot in (5, 10, 14):
        phase = shot / 19
        height, width = stack.shape[1:]
        wave = phantoms.wakefield(
            (height, width),
            OpticalSetup.example(),
            0.8 * np.sin(np.pi * (0.15 + 0.75 * phase)) ** 2,
            center=((height - 1) / 2, width * (0.2 + 0.6 * phase)),
        )
        result = invert(np.asarray(stack[shot]), source=source)
        yield answer("samples", f"sample wakefield_run, shot {shot}", result, wave.displacement)


TUTORIALS = {
    "script": ("inversion", "truth.displacement"),
    "flame": ("inversion", "displacement"),
    "two-energies": ("found", "truth"),
}
"""Names of the result and of the true displacement in the code of each page."""


def tutorials() -> Iterator[Answer]:
    """The tutorials' own code, run as it stands."""
    for name, (result, truth) in TUTORIALS.items():
        names = names_after(name)
        yield answer("samples", f"tutorial {name}", eval(result, names), eval(truth, names))


def names_after(page: str) -> dict[str, Any]:
    """Run the Python code of a tutorial in a folder of its own, and return its variables."""
    text = (Path(__file__).parents[1] / "docs" / "tutorials" / f"{page}.md").read_text()
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    names: dict[str, Any] = {}
    silence = contextlib.redirect_stdout(io.StringIO())
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), silence:
        exec(code, names)
    return names


def sample_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    near = [each for each in answers if 1 / MAX_TOTALS < each.ratio < MAX_TOTALS]
    yield of("told within a factor 3 of the true error", near, len(answers))
    good = [each for each in answers if each.share < MAX_ERROR]
    lit = [each for each in good if each.stands]
    yield of("first line not red where the error is below 5 %", lit, len(good))


def times(seed: int, count: int) -> Iterator[Answer]:
    """Time of a default inversion, of one with a free boundary, and of fits, over numpy's."""
    rng = random_number(seed, "times")
    displacement, image, truth = made(inside, "ellipses", 0.6, seed)
    shot = counted(rng, image)
    setups = setups_of(2)
    images = flawed_images(Flaw("none"), displacement, [each.energy for each in setups], rng)
    plain = rng.normal(size=(512, 512))

    def workload() -> None:
        for _ in range(12):
            np.sort(np.fft.ifft2(np.fft.fft2(plain)).real, axis=1)

    works: dict[str, Callable[[], Any]] = {
        "invert": lambda: invert(shot, source=FLAT),
        "invert, no source": lambda: invert(shot),
        "invert, free": lambda: invert(shot, source=FLAT, options={"boundary": "free"}),
        "fit, one image": lambda: fit(shots_of(shot, source=FLAT, noise="poisson")),
        "fit, two images": lambda: fit(
            shots_of(images, setup=setups, source=FLAT, noise="poisson")
        ),
        "fit, two images, no source": lambda: fit(shots_of(images, setup=setups, noise="poisson")),
    }
    for work in works.values():
        work()
    for title, work in works.items():
        ratios = []
        for _ in range(count):
            spent = [processor_seconds(each) for each in (workload, work, workload)]
            ratios.append(2 * spent[1] / (spent[0] + spent[2]))
        result = work()
        yield answer("times", title, result, truth, ratio=float(np.median(ratios)))


def processor_seconds(work: Callable[[], Any]) -> float:
    begun = time.process_time()
    work()
    return time.process_time() - begun


def time_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    by_title = {each.case: each.numbers["ratio"] for each in answers}
    for title, ratio in by_title.items():
        yield f"{title}: processor time over numpy's", f"{ratio:.2f}"
    yield "free over closed", f"{by_title['invert, free'] / by_title['invert']:.2f}"


def silent_lines(answers: Sequence[Answer]) -> Iterator[Line]:
    yield silent_line(answers)
    widths = sorted({each.numbers["width"] for each in answers if "width" in each.numbers})
    for width in widths:
        own = [each for each in answers if each.numbers["width"] == width]
        yield silent_line(own, f"- over {width:g} px")
    yield of("determined", [a for a in answers if a.is_determined], len(answers))
    yield "error over told, r.m.s.", ratio_text(answers)


@dataclass(frozen=True)
class Row:
    """A row of the table: its answers, how many by default and in full, and what is counted."""

    answers: Callable[[int, int], Iterator[Answer]]
    usual: int
    full: int
    lines: Callable[[Sequence[Answer]], Iterator[Line]]


ROWS = {
    "edges": Row(edges, 1, 1, silent_lines),
    "turbulence": Row(turbulence, 12, 12, silent_lines),
    "noise": Row(noise, 24, 60, silent_lines),
    "single fits": Row(single_fits, 6, 6, silent_lines),
    "right": Row(right, 30, 60, doubted_lines),
    "inputs": Row(inputs, 1, 4, input_lines),
    "flaws": Row(flaws, 34, 106, flaw_lines),
    "right fits": Row(right_fits, 24, 64, right_fit_lines),
    "unknown beams": Row(unknown_beams, 8, 20, doubted_lines),
    "between": Row(between, 15, 30, between_lines),
    "coverage": Row(coverage, 6, 20, coverage_lines),
    "samples": Row(samples, 1, 1, sample_lines),
    "times": Row(times, 3, 7, time_lines),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=list(ROWS), default=list(ROWS))
    parser.add_argument("--seed", type=int, default=0, help="of objects, imperfections and noise")
    parser.add_argument("--full", action="store_true", help="all cases")
    parser.add_argument("--json", type=Path, help="file for all answers")
    parser.add_argument("--list", action="store_true", help="print each answer")
    chosen = parser.parse_args()
    table: list[tuple[str, str, str]] = []
    kept: list[Answer] = []
    for name in chosen.only:
        row, begun, answers = ROWS[name], time.perf_counter(), []
        for each in row.answers(chosen.seed, row.full if chosen.full else row.usual):
            answers.append(each)
            if chosen.list:
                print(each.text(), flush=True)
        seconds = time.perf_counter() - begun
        print(f"{name}: {seconds:.0f} s", file=sys.stderr, flush=True)
        table += [(name, *line) for line in row.lines(answers)]
        kept += answers
    print("\n| row | number | of how many |\n|---|---|---|")
    for name, title, number in table:
        value, _, count = number.partition(" of ")
        print(f"| {name}: {title} | {value} | {count} |")
    if chosen.json:
        lines = [dict(zip(("row", "number", "value"), line, strict=True)) for line in table]
        answers_out = [{**asdict(each), "is_silent": each.is_silent} for each in kept]
        chosen.json.write_text(
            json.dumps({"seed": chosen.seed, "table": lines, "answers": answers_out}, indent=1)
        )


if __name__ == "__main__":
    main()
