"""The page docs/paper.md: its text and its tables."""

from __future__ import annotations

import os

import numpy as np

from napari_shadowinv.physics import phantoms
from paper_parts.beyond_caustics import ENERGIES, FoldedShot, folded_table
from paper_parts.drawing import percent
from paper_parts.measurements import (
    N_NOISES,
    NOT_DRAWN,
    PLASMA_NOISE,
    PLASMA_SHAPE,
    Structure,
    SweepRow,
    Wave,
    range_of_accuracy,
)
from paper_parts.shots import NOISE, PIXEL, SETUP, SHAPE, SIGMA, seconds_of, toroid_truth

WRONG = 5.0  # per cent: more than a determined field may be off

PAGE = """# The paper's figures, reproduced

Kasim et al., "Quantitative shadowgraphy and proton radiography for large intensity modulations",
[arXiv:1607.04179](https://arxiv.org/abs/1607.04179). This page, its pictures and its numbers are
produced by

    python benchmarks/paper.py

in {minutes:.1f} minutes on {cores} cores. The images are synthetic: exact fields, the package's
own forward model (but counted rays in the second part of Fig. 5), and Gaussian noise with a
standard deviation of 10 % of the mean. (The paper says "variance 10 % of the average intensity".)
Negative pixels are set to zero, and the source is uniform unless a row says otherwise.

{merit}

The peak error compares the largest retrieved field with the largest true field. The L2 error is the
norm of the displacement error divided by the norm of the true displacement. All options have their
default values, with one site per pixel. Seconds are for a whole inversion.

## Fig. 1: Voronoi diagram, power diagram, Lloyd's algorithm

![Voronoi and power diagrams, four stages of Lloyd's algorithm](paper-diagrams.png)

## Fig. 2: the algorithm with 100 sites

![Twelve steps from the source to the deflection potential](paper-algorithm.png)

As in the paper: L-BFGS from zero weights ({iterations} iterations), centroids, interpolation
between them (linear, the paper's is by natural neighbours) and integration, selected by the options
`solver="lbfgs"`, `stages="single"` and `readout="centroid"`. Everything below uses the defaults
instead: Newton's method on several levels, and the potential taken from the weights.

## Fig. 3: the set-up

The table below replaces panel (a) of the paper.

![Field and image of the toroid with 97 MG µm](paper-setup.png)

{setup}

## Fig. 4: images from weak modulation to branched caustics

![Images and cuts for 24, 97, 194 and 290 MG µm](paper-intensity.png)

## Fig. 5: retrieved against true field

![True and retrieved fields, and the error against the true peak](paper-sweep.png)

{sweep}

Errors with noise are the mean over {n_noises} images; the next column is the range of
their peak errors. An inversion amplifies noise at long wavelengths: if the object is weak, this
noise adds to its field, and the largest value exceeds the true peak. Beyond the onset of caustics
rays cross, but the rays of an optimal transport never do: the retrieved field is too smooth there.

### Beyond the paper: the same toroid far past caustics

![Images at three energies, cuts, and errors against the true peak](paper-folded.png)

Where rays cross, a [fit](fit.md) of the forward model takes over from transport. The images of this
part are not made by the package: rays are counted where an exact formula puts them
(`benchmarks/fit.py`). The noise is again {noise}, with one seed for each row. Transport
and the fit of one image see the image at {energies[0]:g} MeV; the other fit also sees those at
{energies[1]:g} and {energies[2]:g} MeV. Source and noise are known. Markers are open where the
verdict of the fit is not "determined".

{folded}

χ² is the largest of the images. The field from one image is right until the folds are so deep that
a field which is far too weak explains it as well. Nothing in the image tells when that is, so where
rays meet or cross, one image determines nothing. {misjudged} Three
energies determine every field here. At 600 MG µm and beyond, some rays miss the image at
{energies[0]:g} MeV.

## Fig. 6: other structures

![True field, image, retrieved field, re-projection and cut of six cases](paper-structures.png)

{structures}

The paper gives no numbers for its structures: we chose positions, sizes and strengths such that
caustics have just formed. The difference between re-projection and image includes the 10 % noise.
In (e) two conductors stop the beam (grey in the cut). Row (e) is the paper's method as published,
with a uniform source and no mask: the shadows are taken for deflection, so the field is wrong far
around them. In row (e′) the source is zero where the beam was stopped; most of the remaining error
comes from noise inside the shadows, which is taken for flux. A mask is for pixels that light
reaches, and continues the image across them, so it cannot stand for an obstacle, which
should therefore be entered as zeros in the source. Errors and correlations of the coaxial line are
evaluated over the pixels that the beam passes; the shadows contain no information.

## Section V: a plasma wave seen by light

![Shadowgram of a plasma wave, true and retrieved line-integrated modulation](paper-wakefield.png)

{wave}

A density wave of {wavelength:.2f} µm (n₀ = 1.65e19 cm⁻³) with curved wavefronts, probed at 810
nm, on {wave_shape} px in {wave_seconds:.1f} s. The paper's shadowgrams are measured, so the
true field is not known; we chose amplitude and distance. The image is computed from rays, without
diffraction. n₀ / n_c is {first_order:.2f} %, which is also the order of the error of the
thin-plasma approximation ln η ≈ −n/2n_c. (The paper's Eq. 12 leaves out the ½; see
`OpticalSetup.line_integrated_density`.) As in the paper, a high-pass filter (the potential minus
its average over a plasma wavelength, Gaussian) removes the slow variations that an inversion
produces from noise.
"""


def verdict(value: float, limit: float) -> str:
    return "reached" if abs(value) <= limit else "**missed**"


def worst(rows: list[SweepRow], kind: str, low: float, high: float) -> float:
    return max(abs(getattr(row, kind)[0]) for row in rows if low <= row.peak <= high)


def worst_single(rows: list[SweepRow], low: float, high: float) -> float:
    ranges = [row.noisy_range for row in rows if low <= row.peak <= high]
    return float(np.abs(ranges).max())


def sweep_table(rows: list[SweepRow]) -> str:
    lines = [
        "| D_m, MG µm | 10 % noise: peak / L2 error, % | range of the peak error | noise-free, % "
        "| Poisson, noise-free, % | seconds |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        pairs = [f"{p:+.2f} / {l2:.2f}" for p, l2 in (row.noisy, row.clean, row.linear)]
        low, high = row.noisy_range
        pairs.insert(1, f"{low:+.2f} … {high:+.2f}")
        note = "" if row.converged else " (not converged)"
        lines.append(f"| {row.peak:g} | {' | '.join(pairs)} | {row.seconds:.2f}{note} |")
    return "\n".join(lines)


def misjudged(shots: list[FoldedShot]) -> str:
    """Where the fit of one image calls a wrong field determined, in words."""
    wrong = [
        f"At {shot.peak:g} MG µm a field is called determined that is {one.errors[1]:.0f} % wrong."
        for shot in shots
        for one in (shot.answers["one"],)
        if one.verdict == "determined" and one.errors[1] > WRONG
    ]
    return " ".join(wrong) or "No wrong field is called determined."


def structure_table(found: list[Structure]) -> str:
    lines = [
        "| object | peak error, % | L2 error, % | correlation of the cut | re-projection − image, "
        "% rms | seconds |",
        "|---|---|---|---|---|---|",
    ]
    for s in found:
        letter = "" if s.letter == NOT_DRAWN else f"({s.letter}) "
        lines.append(
            f"| {letter}{s.name} | {s.peak_error:+.2f} | {s.l2_error:.2f} "
            f"| {s.correlation:.4f} | {s.image_difference:.1f} "
            f"| {seconds_of(s.inversion):.2f} |"
        )
    return "\n".join(lines)


def wave_table(wave: Wave) -> str:
    lines = [
        "| ∫Δn/n₀ dz along the axis | peak error, % | largest error, % of the peak "
        "| rms error, % of the peak |",
        "|---|---|---|---|",
    ]
    for name, plane in (
        ("noise-free", wave.clean),
        (f"{percent(PLASMA_NOISE)} noise", wave.noisy),
        (f"{percent(PLASMA_NOISE)} noise, high-pass", wave.filtered),
    ):
        largest, mean = wave.axis_error(plane)
        lines.append(f"| {name} | {wave.peak_error(plane):+.2f} | {largest:.2f} | {mean:.2f} |")
    return "\n".join(lines)


def merit_table(rows: list[SweepRow], onset: float, found: list[Structure], wave: Wave) -> str:
    """Put the paper's figures of merit and the aims beside what was measured."""
    four = found[:4]
    times = [row.seconds for row in rows] + [seconds_of(s.inversion) for s in four]
    peak = max(abs(s.peak_error) for s in four)
    correlation = min(s.correlation for s in four)
    axis_errors = [wave.axis_error(plane)[0] for plane in (wave.clean, wave.noisy, wave.filtered)]
    conditions = ("noise-free", f"{percent(PLASMA_NOISE)} noise", "the same noise, high-pass")

    def aim(text: str, kind: str, low: float, high: float, limit: float) -> str:
        value = worst(rows, kind, low, high)
        return f"| {text} | ≤ {limit:g} % | {value:.2f} % | {verdict(value, limit)} |"

    def aim_of_each(low: float, high: float, limit: float) -> str:
        value = worst_single(rows, low, high)
        return (
            f"| the same, worst single image | ≤ {limit:g} % | {value:.2f} % "
            f"| {verdict(value, limit)} |"
        )

    def reach(kind: str) -> str:
        limit = range_of_accuracy(rows, kind)
        return f"beyond {rows[-1].peak:g}" if limit == float("inf") else f"{limit:.0f}"

    return "\n".join(
        [
            "| figure of merit | paper | here |",
            "|---|---|---|",
            f"| peak error below 10 % up to, MG µm, 10 % noise | 300 | {reach('noisy')} |",
            f"| the same, noise-free | – | {reach('clean')} |",
            f"| Poisson's error below 10 % up to, MG µm | 30 | {reach('linear')} |",
            f"| caustics from, MG µm | 190 | {onset:.0f} |",
            f"| one image of 200 × 200 px | 2–3 h on 32 cores | {min(times):.1f}–{max(times):.1f} s"
            f" on {os.cpu_count()} cores |",
            "",
            "| aim | | measured | |",
            "|---|---|---|---|",
            aim("peak of the toroid, 10 % noise, 24–240 MG µm, mean", "noisy", 24, 240, 5),
            aim_of_each(24, 240, 5),
            aim("peak of the toroid, 10 % noise, 290 MG µm, mean", "noisy", 290, 290, 10),
            aim_of_each(290, 290, 10),
            aim("peak of the toroid, noise-free, 10–194 MG µm", "clean", 10, 194, 2),
            f"| peak of (a)–(d) | ≤ 10 % | {peak:.2f} % | {verdict(peak, 10)} |",
            f"| correlation of the cuts of (a)–(d) | ≥ 0.99 | {correlation:.4f} "
            f"| {verdict(1 - correlation, 0.01)} |",
            *(
                f"| plasma wave along its axis, {condition} | ≤ 10 % of its peak "
                f"| {error:.2f} % | {verdict(error, 10)} |"
                for condition, error in zip(conditions, axis_errors, strict=True)
            ),
        ]
    )


def setup_table() -> str:
    angle = float(np.hypot(*SETUP.deflection_angle(toroid_truth(97.0))).max())
    return "\n".join(
        [
            "| quantity | paper | here |",
            "|---|---|---|",
            f"| protons, MeV | 14.7 | {SETUP.energy:g}, relativistic momentum |",
            f"| source to object l, mm | 1.3 | {SETUP.source_object_distance * 1e3:g} |",
            f"| object to screen L, cm | 2 | {SETUP.object_image_distance * 1e2:g} |",
            f"| magnification 1 + L/l | 15 | {SETUP.magnification:.2f} |",
            f"| radius σ, µm | 30 | {SIGMA * 1e6:g} |",
            f"| image, px | 200 × 200 | {SHAPE[0]} × {SHAPE[1]} of {PIXEL:g} µm at the object |",
            f"| largest deflection at 97 MG µm, mrad | – | {angle * 1e3:.1f} |",
        ]
    )


def write(
    rows: list[SweepRow],
    onset: float,
    folded: list[FoldedShot],
    found: list[Structure],
    wave: Wave,
    iterations: int,
    minutes: float,
) -> str:
    """Return the page with everything measured in its place."""
    return PAGE.format(
        minutes=minutes,
        cores=os.cpu_count(),
        merit=merit_table(rows, onset, found, wave),
        n_noises=N_NOISES,
        iterations=iterations,
        setup=setup_table(),
        sweep=sweep_table(rows),
        noise=f"{percent(NOISE)} of the mean",
        energies=ENERGIES,
        folded=folded_table(folded),
        misjudged=misjudged(folded),
        structures=structure_table(found),
        wave=wave_table(wave),
        wavelength=phantoms.plasma_wavelength(1.65e25) * 1e6,
        wave_shape=f"{PLASMA_SHAPE[0]} × {PLASMA_SHAPE[1]}",
        wave_seconds=wave.seconds,
        first_order=wave.first_order_error,
    )
