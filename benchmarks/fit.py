"""What a fit makes of folds, unknown beams, blur, B beside E: the table of docs/fit.md.

    python benchmarks/fit.py [--seeds 5] [--only "toroid 290" …]

The images are counted rays: 900 start in each pixel, each at a random place of a cell of its own
(30 × 30), is displaced by the exact formula, and counts in the pixel where it lands, with the
beam's brightness where it started. The package's forward model is not used. Errors are medians over
seeds of the noise: of the largest displacement (peak), and the norm of the error against the norm
of the truth (L2). Times are multiples of one inversion by transport (T: the toroid of 97 MG µm,
40,000 sites) in the same run. A row is marked where a limit is missed, or where a verdict is
"determined" and the L2 error above 5 %: wrong in silence.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from napari_shadowinv import FitOptions, InversionOptions, ProtonSetup, fit, invert
from napari_shadowinv.shot import shots_of
from reference import errors, toroid_case

SIDE, RAYS, AROUND = 200, 30, 40
SILENT = 5.0  # per cent

FloatArray = NDArray[np.float64]
Field = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
Beam = Callable[[FloatArray, FloatArray], FloatArray]


def blobs(parts: list[tuple[float, float, float, float, float, float]]) -> Field:
    """Gaussian potentials: amplitude in px², two radii, angle, centre (y, x)."""

    def displaced(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        along_y, along_x = np.zeros_like(y), np.zeros_like(x)
        for amplitude, tall, wide, angle, row, column in parts:
            cosine, sine = np.cos(angle), np.sin(angle)
            u = ((y - row) * cosine + (x - column) * sine) / tall
            v = ((x - column) * cosine - (y - row) * sine) / wide
            potential = amplitude * np.exp(-(u**2 + v**2) / 2)
            along_y += potential * (u / tall * cosine - v / wide * sine)
            along_x += potential * (u / tall * sine + v / wide * cosine)
        return along_y, along_x

    return displaced


def outward(peak: float) -> float:
    """Displacement in px by a field in MG µm in the paper's experiment."""
    field = ProtonSetup.example().displacement_from_path_integrated_b([-peak, 0.0], "MG um")
    return float(field[1])


def toroid(peak: float) -> Field:
    middle, sigma = (SIDE - 1) / 2, 20.0
    amplitude = outward(peak) * sigma * np.exp(0.5)
    return blobs([(amplitude, sigma, sigma, 0.0, middle, middle)])


def folded_ellipses() -> Field:
    return blobs([(700, 14, 24, 0.35, 80, 70), (650, 22, 13, 0.2, 125, 130)])


def turbulence(seed: int, share: float) -> Field:
    rng = np.random.default_rng(seed)
    return blobs(
        [
            (
                60 * share * rng.normal(),
                rng.uniform(5, 10),
                rng.uniform(5, 10),
                rng.uniform(0, 3),
                rng.uniform(30, SIDE - 30),
                rng.uniform(30, SIDE - 30),
            )
            for _ in range(70)
        ]
    )


def squared_cosine(peak: float, radius: float = 60.0) -> Field:
    """A potential A cos²(πr/2R) that ends at a rim, where the field's slope jumps."""
    amplitude = outward(peak) * radius * 2 / np.pi

    def displaced(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        v, u = y - (SIDE - 1) / 2, x - (SIDE - 1) / 2
        share = np.hypot(v, u) / radius
        slope = np.where(share < 1, amplitude * np.pi**2 / 2 * np.sinc(share), 0) / radius**2
        return slope * v, slope * u

    return displaced


def uneven_beam(seed: int, rms: float = 0.1) -> Beam:
    rng = np.random.default_rng(seed)
    lumps = [
        (rng.normal(), rng.uniform(35, 70), rng.uniform(-20, 220), rng.uniform(-20, 220))
        for _ in range(12)
    ]

    def raw(y: FloatArray, x: FloatArray) -> FloatArray:
        parts = [
            height * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 2 / radius**2)
            for height, radius, row, column in lumps
        ]
        return np.asarray(sum(parts))

    levels = raw(*pixels())
    mean, deviation = levels.mean(), levels.std()
    return lambda y, x: np.exp(rms * (raw(y, x) - mean) / deviation)


def pixels() -> tuple[FloatArray, FloatArray]:
    y, x = np.indices((SIDE, SIDE), dtype=np.float64)
    return y, x


def counted(
    fields: list[Field],
    strengths: FloatArray,
    beam: Beam | None,
    size: tuple[int, int] = (SIDE, SIDE),
    rays: int = RAYS,
) -> FloatArray:
    """The image: rays counted where they land."""
    rng = np.random.default_rng(0)
    height, width = size
    counts = np.zeros(height * width)
    cells = np.arange((width + 2 * AROUND) * rays)
    for row in range((height + 2 * AROUND) * rays):
        y = (row + rng.random(cells.size)) / rays - 0.5 - AROUND
        x = (cells + rng.random(cells.size)) / rays - 0.5 - AROUND
        landed_y, landed_x = y.copy(), x.copy()
        for one, strength in zip(fields, strengths, strict=True):
            dy, dx = one(y, x)
            landed_y += strength * dy
            landed_x += strength * dx
        rows, columns = np.rint(landed_y).astype(int), np.rint(landed_x).astype(int)
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        flux = None if beam is None else beam(y, x)[inside]
        counts += np.bincount(rows[inside] * width + columns[inside], flux, height * width)
    return counts.reshape(size) / rays**2


@dataclass(frozen=True)
class Case:
    """A row: one object at some energies (MeV), and what the errors may be (per cent, L2)."""

    name: str
    fields: list[Field]
    energies: tuple[float, ...]
    noise: float = 0.1
    beam: Beam | None = None
    blur: float = 0.0
    goals: tuple[float, ...] = ()
    musts: tuple[float, ...] = ()
    keywords: dict[str, Any] = field(default_factory=dict)

    def strengths(self) -> FloatArray:
        setups = [ProtonSetup.example().model_copy(update={"energy": e}) for e in self.energies]
        first = setups[0]
        magnetic = [first.momentum / s.momentum for s in setups]
        rigid = [first.momentum * first.velocity / s.momentum / s.velocity for s in setups]
        return np.array([magnetic, rigid][: len(self.fields)]).T

    def images(self) -> FloatArray:
        shots = [counted(self.fields, line, self.beam) for line in self.strengths()]
        if not self.blur:
            return np.stack(shots)
        wide = [np.pad(shot, 20, mode="edge") for shot in shots]
        return np.stack([gaussian_filter(shot, self.blur)[20:-20, 20:-20] for shot in wide])


def cases() -> Iterator[Case]:
    three, two = (14.7, 30.0, 60.0), (14.7, 20.0)
    free: dict[str, Any] = {"brightness": "free"}
    unknown: dict[str, Any] = {"source": "unknown"}
    for peak, goal, must in ((290, 1.0, 1.5), (340, 2.0, 3.0)):
        yield Case(f"toroid {peak}", [toroid(peak)], three[:1], goals=(goal,), musts=(must,))
    yield Case("folded ellipses", [folded_ellipses()], three[:1], goals=(2.5,), musts=(4.0,))
    for peak in (340, 500, 700):
        name = f"toroid {peak}, three energies, brightness free"
        yield Case(name, [toroid(peak)], three, goals=(0.5,), musts=(1.0,), keywords=free)
    five = (10.0, 12.0, 14.7, 17.0, 20.0)
    yield Case("toroid 500, five energies", [toroid(500)], five, goals=(0.8,), musts=(1.5,))
    rim = [squared_cosine(200)]
    yield Case("cos², three energies", rim, three, goals=(0.7,), musts=(1.2,))
    lumps = [turbulence(3, 1.0)]
    yield Case("turbulence, three energies", lumps, three, goals=(1.2,), musts=(2.0,))
    beam = uneven_beam(5)
    for peak, energies, goal, must in ((97, two, 1.2, 2.5), (290, three, 0.5, 1.0)):
        yield Case(
            f"toroid {peak}, beam unknown, {len(energies)} energies",
            [toroid(peak)],
            energies,
            0.03,
            beam,
            goals=(goal,),
            musts=(must,),
            keywords=unknown,
        )
    for share in (1.0, 2.5):
        magnetic = blobs([(350 * share, 18, 22, 0.3, 90, 85)])
        electric = blobs([(-220 * share, 16, 16, 0, 115, 120), (120 * share, 12, 14, 0, 70, 125)])
        yield Case(
            f"B and E × {share:g}, four energies",
            [magnetic, electric],
            (5.0, 10.0, 20.0, 40.0),
            0.03,
            goals=(1.2, 2.0),
            musts=(2.0, 4.0),
            keywords={"fields": ("B", "E")},
        )
    for width in (1.0, 2.0, 4.0):
        yield Case(
            f"toroid 194, blur {width:g} px",
            [toroid(194)],
            three[:1],
            0.03,
            blur=width,
            goals=(0.5,),
            musts=(1.0,),
            keywords={"psf": width},
        )
    # What one image, or two that are too much alike, cannot tell: no figure but the verdict.
    for peak in (150, 200, 250):
        yield Case(f"cos² {peak}, one image", [squared_cosine(peak)], three[:1])
    for seed, share in ((3, 1.0), (3, 0.5), (4, 0.4), (5, 0.3)):
        yield Case(f"turbulence {seed} × {share:g}, one image", [turbulence(seed, share)], (14.7,))
    yield Case("toroid 97, beam unknown, one image", [toroid(97)], (14.7,), 0.03, beam,
               keywords=unknown)  # fmt: skip
    yield Case("turbulence, two energies", lumps, two)
    for energies in ((14.7, 15.5), (14.7, 17.0)):
        yield Case(f"cos² 200, {energies[0]} and {energies[1]} MeV", rim, energies)
        yield Case(
            f"toroid 97, beam unknown, {energies[0]} and {energies[1]} MeV",
            [toroid(97)],
            energies,
            0.03,
            beam,
            keywords=unknown,
        )


def row(case: Case, seeds: int, unit: float) -> str:
    images, strengths = case.images(), case.strengths()
    truths = [np.stack(one(*pixels())) for one in case.fields]
    known = {"source": np.ones((SIDE, SIDE)), **case.keywords}
    names = {"fields": known.pop("fields", ("B",))}
    found: list[list[tuple[float, float]]] = []
    verdicts, chi2, seconds, silent = [], [], [], False
    for seed in range(seeds):
        noise = case.noise * np.random.default_rng(seed).normal(size=images.shape)
        begun = time.perf_counter()
        options = FitOptions(ambiguous=True)
        result = fit(
            shots_of(images + noise, strength=list(strengths), noise=case.noise, **known),
            options=options,
            **names,
        )
        seconds.append((time.perf_counter() - begun) / unit)
        found.append(
            [errors(one.displacement, t) for one, t in zip(result.fields, truths, strict=True)]
        )
        verdicts.append(result.verdict.value)
        chi2.append([result.chi2.min(), result.chi2.max()])
        worst = max(l2 for _, l2 in found[-1])
        silent |= result.verdict == "determined" and worst > SILENT
    median = np.median(np.abs(found), axis=0)
    told = ", ".join(f"{peak:.1f} / {l2:.2f}" for peak, l2 in median)
    limits = " / ".join(f"{must:g}" for must in case.musts)
    marks = " MISSED" * any(l2 > must for (_, l2), must in zip(median, case.musts, strict=False))
    marks += " SILENT" * silent
    goals = " / ".join(f"{goal:g}" for goal in case.goals)
    low, high = np.min(chi2, axis=0)[0], np.max(chi2, axis=0)[1]
    return (
        f"| {case.name} | {told} | {goals} | {limits}{marks} | {low:.2f}–{high:.2f} "
        f"| {', '.join(sorted(set(verdicts)))} | {np.median(seconds):.0f} |"
    )


def unit_of_time() -> float:
    """Seconds of one inversion by transport, the least of three."""
    image = np.maximum(toroid_case(97).image, 0)
    options = InversionOptions(n_sites=40_000)
    times = []
    for _ in range(4):
        begun = time.perf_counter()
        invert(image, options=options)
        times.append(time.perf_counter() - begun)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=[], help="parts of the rows' names")
    arguments = parser.parse_args()
    small = np.ones((40, 40))
    fit(
        shots_of([small, small], strength=[1, 0.5], noise=0.1)
    )  # compile, so that times are the work's
    unit = unit_of_time()
    print("| images | peak / L2 error, % | goal | must | χ² | verdict | time, T |")
    print("|---|---|---|---|---|---|---|")
    for case in cases():
        if not arguments.only or any(part in case.name for part in arguments.only):
            print(row(case, arguments.seeds, unit), flush=True)


if __name__ == "__main__":
    main()
