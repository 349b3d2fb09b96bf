"""Figures 3 to 5: the toroid, its images, and how well its field is retrieved."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from napari_shadowinv import synthetic_image
from paper_parts.drawing import (
    BLUE,
    FIELD_LABEL,
    FIELD_MAP,
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
from paper_parts.measurements import N_NOISES, SweepRow
from paper_parts.shots import (
    NOISE,
    PIXEL,
    SHAPE,
    field_of,
    noisy,
    retrieved,
    toroid_truth,
)

SHOWN_PEAKS = (24.0, 97.0, 194.0, 290.0)


def figure_setup(path: Path, peak: float = 97.0) -> None:
    truth = toroid_truth(peak)
    field, image = field_of(truth), noisy(synthetic_image(truth), seed=97)
    figure = new_figure(9.2, 6.6)
    (top_left, top_right), (low_left, low_right) = figure.subplots(2, 2, width_ratios=(1, 1.12))
    show(top_left, field, FIELD_LABEL, FIELD_MAP, (0, peak))
    show(low_left, image, "Intensity / mean", INTENSITY_MAP, (0, 2))
    row = SHAPE[0] // 2
    for axes, plane, colour, label in (
        (top_right, field, RED, FIELD_LABEL),
        (low_right, image, BLUE, "Intensity / mean"),
    ):
        axes.plot(positions(SHAPE[1]), plane[row], color=colour, linewidth=1.2)
        plain(axes)
        axes.set_ylim(bottom=0)
        name_axes(axes, y=label)
    for axes, colour in ((top_left, "white"), (low_left, "yellow")):
        axes.axhline(row * PIXEL, color=colour, linewidth=0.9, linestyle=(0, (5, 4)))
        name_axes(axes)
    top_left.set_title(f"(b) Toroid with D$_m$ = {peak:g} MG µm")
    top_right.set_title("(c) Cut along x")
    low_left.set_title(f"(d) Image with {percent(NOISE)} noise")
    low_right.set_title("(e) Cut along x")
    save(figure, path)


def figure_intensity(path: Path) -> None:
    figure = new_figure(13.2, 5.9)
    panels = figure.subplots(2, 4, height_ratios=(1.75, 1))
    row = SHAPE[0] // 2
    titles = ("weak", "strong", "caustics form", "branched")
    for column, (peak, title) in enumerate(zip(SHOWN_PEAKS, titles, strict=True)):
        clean = synthetic_image(toroid_truth(peak))
        image = noisy(clean, seed=round(peak))
        picture, curve = panels[:, column]
        label = "Intensity / mean" if column == 3 else None
        show(picture, image, label, INTENSITY_MAP, (0, 2.5))
        picture.axhline(row * PIXEL, color="yellow", linewidth=0.8, linestyle=(0, (5, 4)))
        picture.set_title(f"({'abcd'[column]}) D$_m$ = {peak:g} MG µm: {title}")
        curve.plot(positions(SHAPE[1]), image[row], color=BLUE, linewidth=1, label="with noise")
        curve.plot(positions(SHAPE[1]), clean[row], color="black", linewidth=0.7, label="without")
        plain(curve)
        curve.set_ylim(0, 14 if column > 1 else 2.4)
        name_axes(curve, y="Intensity / mean" if column == 0 else "")
        name_axes(picture, "", "y (µm)" if column == 0 else "")
    panels[1, 0].legend(loc="upper right", ncols=2)
    save(figure, path)


def figure_sweep(rows: list[SweepRow], onset: float, path: Path) -> None:
    figure = new_figure(14, 6.6)
    left, right = figure.subfigures(1, 2, width_ratios=(1.12, 1))
    shot = left.subplot_mosaic([["true", "found"], ["cut", "cut"]], height_ratios=(1.15, 1))
    draw_shot(shot, 194.0)
    draw_sweep(right.subplots(2, 1, sharex=True), rows, onset)
    save(figure, path)


def draw_shot(panels: dict[str, Axes], peak: float) -> None:
    truth = toroid_truth(peak)
    found = retrieved(noisy(synthetic_image(truth), seed=round(peak)))
    row = SHAPE[0] // 2
    wide: dict[str, Any] = {"color": "black", "linewidth": 3, "alpha": 0.35}
    thin: dict[str, Any] = {"color": BLUE, "linewidth": 1.2}
    cut = panels["cut"]
    for key, name, displacement, style in (
        ("true", "True field", truth, wide),
        ("found", f"Retrieved, {percent(NOISE)} noise", found.displacement, thin),
    ):
        axes, field = panels[key], field_of(displacement)
        show(axes, field, FIELD_LABEL if key == "found" else None, FIELD_MAP, (0, peak))
        axes.axhline(row * PIXEL, color="white", linewidth=0.8, linestyle=(0, (5, 4)))
        axes.set_title(name)
        name_axes(axes, y="y (µm)" if key == "true" else "")
        cut.plot(positions(SHAPE[1]), field[row], label=name, **style)
    plain(cut)
    cut.set_title(f"Cut along x, D$_m$ = {peak:g} MG µm")
    cut.set_ylim(0, 1.3 * peak)
    cut.legend(loc="upper center", ncols=2)
    name_axes(cut, y=FIELD_LABEL)


def draw_sweep(panels: Sequence[Axes], rows: list[SweepRow], onset: float) -> None:
    peaks = np.array([row.peak for row in rows])
    curves = (
        ("clean", "noise-free", GREEN, "s"),
        ("noisy", f"{percent(NOISE)} noise, mean and range of {N_NOISES}", BLUE, "o"),
        ("linear", "Poisson, noise-free", RED, "^"),
    )
    panels[0].plot(peaks, peaks, color="black", linewidth=3, alpha=0.25, label="truth", zorder=0)
    for kind, name, colour, marker in curves:
        error = np.array([getattr(row, kind)[0] for row in rows])
        style: dict[str, Any] = {"color": colour, "marker": marker, "markersize": 4.5}
        style |= {"linewidth": 1.2, "label": name}
        panels[0].plot(peaks, peaks * (1 + error / 100), **style)
        panels[1].plot(peaks, error, **style)
    low, high = np.array([row.noisy_range for row in rows]).T
    panels[1].fill_between(peaks, low, high, color=BLUE, alpha=0.22, linewidth=0)
    for axes in panels:
        axes.axvline(onset, color=GREY, linewidth=0.9, linestyle=(0, (5, 4)))
        plain(axes)
        axes.set_xlim(0, 350)
    panels[0].text(onset + 4, 8, "caustics", color=GREY, rotation=90, va="bottom")
    panels[0].set(title="Largest field: retrieved against true", ylim=(0, 350))
    panels[0].set_ylabel("Retrieved peak (MG µm)")
    panels[0].legend(loc="upper left")
    finish_errors(panels[1])


def finish_errors(axes: Axes) -> None:
    """Give the signed errors a scale that is linear up to 1 % and logarithmic beyond."""
    for limit in (-10, 10):
        axes.axhline(limit, color="black", linewidth=0.9, linestyle=(0, (5, 4)))
    axes.axhline(0, color="black", linewidth=0.6)
    axes.set_yscale("symlog", linthresh=1, linscale=0.8)
    axes.set(ylim=(-100, 30), yticks=(-100, -30, -10, -3, -1, 0, 1, 3, 10, 30))
    axes.yaxis.set_major_formatter(
        lambda value, _: f"{value:+g}".replace("-", "−") if value else "0"
    )
    axes.minorticks_off()
    axes.set(title="Its error", xlabel="True peak D$_m$ (MG µm)", ylabel="Error of the peak (%)")
