"""The toroid far beyond caustics: transport, and fits of one image and of three energies.

The images are counted rays (benchmarks/fit.py), so that no fit meets its own forward model.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from fit import counted, pixels, toroid
from napari_shadowinv.facts import Verdict
from napari_shadowinv.fitting import fit
from napari_shadowinv.shot import shots_of
from paper_parts.drawing import (
    BLUE,
    FIELD_LABEL,
    GREEN,
    GREY,
    INTENSITY_MAP,
    RED,
    name_axes,
    new_figure,
    percent,
    plain,
    positions,
    save,
    show,
)
from paper_parts.shots import NOISE, SETUP, SHAPE, FloatArray, field_of, noisy, retrieved
from reference import errors

PEAKS = (97, 194, 240, 290, 340, 420, 500, 600, 700)
ENERGIES = (14.7, 30.0, 60.0)
SHOWN = 500
METHODS = {
    "transport": ("transport, one image", RED, "^"),
    "one": ("fit of one image", BLUE, "o"),
    "three": ("fit of three energies", GREEN, "s"),
}


@dataclass(frozen=True)
class Answer:
    """A retrieved displacement, its errors in per cent (peak, L2) and what the fit says of it."""

    displacement: FloatArray
    errors: tuple[float, float]
    verdict: Verdict | None = None
    chi2: float = float("nan")


@dataclass(frozen=True)
class FoldedShot:
    """One toroid: its noisy images at all energies, its field, and what each method finds."""

    peak: float
    images: FloatArray
    truth: FloatArray
    answers: dict[str, Answer]


def folded_shots() -> list[FoldedShot]:
    return [folded_shot(float(peak)) for peak in PEAKS]


def folded_shot(peak: float) -> FoldedShot:
    setups = [SETUP.model_copy(update={"energy": energy}) for energy in ENERGIES]
    field = toroid(peak)
    truth = np.stack(field(*pixels()))
    images = np.stack(
        [
            noisy(counted([field], np.array([SETUP.momentum / setup.momentum]), None), seed)
            for seed, setup in enumerate(setups, start=round(peak))
        ]
    )
    given: dict[str, Any] = {"source": np.ones(SHAPE), "noise": NOISE}
    moved = retrieved(images[0]).displacement
    answers = {"transport": Answer(moved, errors(moved, truth))}
    for name, count in (("one", 1), ("three", len(setups))):
        found = fit(shots_of(images[:count], setup=setups[:count], **given))
        moved, worst = found.fields[0].displacement, float(found.chi2.max())
        answers[name] = Answer(moved, errors(moved, truth), found.verdict, worst)
    return FoldedShot(peak, images, truth, answers)


def folded_table(shots: list[FoldedShot]) -> str:
    lines = [
        "| D_m, MG µm | transport: peak / L2 error, % | fit of one image | χ² | its verdict "
        "| fit of three energies | χ² | its verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for shot in shots:
        cells = [f"{shot.peak:g}"]
        for answer in shot.answers.values():
            cells.append(f"{answer.errors[0]:+.2f} / {answer.errors[1]:.2f}")
            if answer.verdict is not None:
                cells += [f"{answer.chi2:.2f}", str(answer.verdict)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def figure_folded(shots: list[FoldedShot], onset: float, path: Path) -> None:
    figure = new_figure(14, 6.6)
    left, right = figure.subfigures(1, 2, width_ratios=(1.12, 1))
    names = [f"{energy:g} MeV" for energy in ENERGIES]
    panels = left.subplot_mosaic([names, ["cut"] * len(names)], height_ratios=(1, 1.25))
    (shown,) = (shot for shot in shots if shot.peak == SHOWN)
    for number, (name, image) in enumerate(zip(names, shown.images, strict=True)):
        label = "Intensity / mean" if name == names[-1] else None
        show(panels[name], image, label, INTENSITY_MAP, (0, 3))
        panels[name].set_title(name)
        name_axes(panels[name], y="" if number else "y (µm)")
    draw_cuts(panels["cut"], shown)
    above, below = right.subplots(2, 1, sharex=True)
    draw_errors(above, shots, onset, 0)
    draw_errors(below, shots, onset, 1)
    above.set(title="Error of the peak", ylabel="|error| (%)")
    below.set(title="L2 error of the field", ylabel="error (%)", xlabel="True peak D$_m$ (MG µm)")
    below.legend(loc="lower right", ncols=2)
    below.text(onset + 6, 120, "caustics", color=GREY, rotation=90, va="top")
    save(figure, path)


def draw_cuts(axes: Axes, shot: FoldedShot) -> None:
    row = SHAPE[0] // 2
    x = positions(SHAPE[1])
    axes.plot(x, field_of(shot.truth)[row], color="black", linewidth=3, alpha=0.3, label="truth")
    for kind, (name, colour, _) in METHODS.items():
        found = field_of(shot.answers[kind].displacement)[row]
        axes.plot(x, found, color=colour, linewidth=1.2, label=name)
    plain(axes)
    axes.set(title=f"Cut along x, D$_m$ = {shot.peak:g} MG µm, {percent(NOISE)} noise")
    axes.set_ylim(0, 1.45 * shot.peak)
    axes.legend(loc="upper center", ncols=2)
    name_axes(axes, y=FIELD_LABEL)


def draw_errors(axes: Axes, shots: list[FoldedShot], onset: float, which: int) -> None:
    """Draw an error against the strength; an open marker is a fit that is not "determined"."""
    peaks = np.array([shot.peak for shot in shots])
    for kind, (name, colour, marker) in METHODS.items():
        answers = [shot.answers[kind] for shot in shots]
        size = np.abs([answer.errors[which] for answer in answers])
        doubted = np.array([a.verdict not in (None, Verdict.DETERMINED) for a in answers])
        style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 5.5}
        axes.plot(peaks, size, linewidth=1.2, label=name, **style)
        open_label = 'verdict is not "determined"' if kind == "one" else None
        axes.plot(
            peaks[doubted], size[doubted], linestyle="", markerfacecolor="white", label=open_label,
            **style,
        )  # fmt: skip
    axes.axvline(onset, color=GREY, linewidth=0.9, linestyle=(0, (5, 4)))
    plain(axes)
    axes.set_yscale("log")
    axes.set(xlim=(0, 720), ylim=(0.01, 200), yticks=(0.01, 0.1, 1, 10, 100))
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
