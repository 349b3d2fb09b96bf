"""Figure 6, structures that are no toroid, and section V, the plasma wave."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from napari_shadowinv import OpticalSetup
from paper_parts.drawing import (
    BLUE,
    FIELD_LABEL,
    FIELD_MAP,
    GREEN,
    GREY,
    INTENSITY_MAP,
    SIGNED_MAP,
    name_axes,
    new_figure,
    percent,
    plain,
    positions,
    save,
    show,
)
from paper_parts.measurements import NOT_DRAWN, PLASMA_NOISE, Structure, Wave
from paper_parts.shots import NOISE, PIXEL, SHAPE, FloatArray, field_of


def figure_structures(structures: list[Structure], path: Path) -> None:
    found = [structure for structure in structures if structure.letter != NOT_DRAWN]
    figure = new_figure(14.4, 2.5 * len(found))
    rows = figure.subplots(len(found), 5)
    for panels, structure in zip(rows, found, strict=True):
        draw_structure(panels, structure)
    for axes, title in zip(
        rows[0],
        ("True field", f"Image, {percent(NOISE)} noise", "Retrieved field", "Re-projection", "Cut"),
        strict=True,
    ):
        axes.set_title(title, fontsize=12, fontweight="bold", pad=10)
    for axes in rows[-1]:
        axes.set_xlabel("x (µm)")
    save(figure, path, dpi=100, palette=True)


def draw_structure(panels: Sequence[Axes], structure: Structure) -> None:
    true, found = field_of(structure.truth), field_of(structure.inversion.displacement)
    largest = float(true[structure.open_pixels].max())
    planes = (
        (true, FIELD_LABEL, FIELD_MAP, largest),
        (structure.image / structure.image.mean(), "Intensity / mean", INTENSITY_MAP, 3.0),
        (found, FIELD_LABEL, FIELD_MAP, largest),
        (structure.inversion.reprojection, "Intensity / mean", INTENSITY_MAP, 3.0),
    )
    for axes, (plane, label, colours, high) in zip(panels[:4], planes, strict=True):
        show(axes, plane, label, colours, (0.0, high))
    for axes in (panels[0], panels[2]):
        axes.axhline(structure.row * PIXEL, color="white", linewidth=0.8, linestyle=(0, (5, 4)))
    panels[0].set_ylabel(f"({structure.letter})  y (µm)")
    draw_cut(panels[4], structure, true, found, largest)


def draw_cut(
    axes: Axes, structure: Structure, true: FloatArray, found: FloatArray, largest: float
) -> None:
    x, row = positions(SHAPE[1]), structure.row
    seen = np.where(structure.open_pixels[row], 1.0, np.nan)
    axes.plot(x, seen * true[row], color="black", linewidth=2.8, alpha=0.35, label="true")
    axes.plot(x, seen * found[row], color=BLUE, linewidth=1.2, label="retrieved")
    if not structure.open_pixels.all():
        shaded = ~structure.open_pixels[row]
        axes.fill_between(x, 0, 2 * largest, where=shaded, color="0.85", linewidth=0, zorder=0)
    plain(axes)
    axes.set_ylim(0, 1.6 * largest)
    axes.set_box_aspect(1)
    axes.set_ylabel("MG µm")
    axes.legend(loc="upper right", ncols=2)


def figure_wave(wave: Wave, path: Path) -> None:
    figure = new_figure(12.6, 10)
    panels = figure.subplots(3, 2, height_ratios=(1.25, 1.25, 1))
    pixel = OpticalSetup.example().object_pixel_size * 1e6
    high = float(np.abs(wave.true).max())
    label = "∫Δn/n₀ dz (µm)"
    shadow = (float(wave.image.min()), float(np.percentile(wave.image, 99.9)))
    for axes, plane, title, name, colours, limits in (
        (panels[0, 0], wave.image, "(a) Shadowgram", "Intensity / mean", INTENSITY_MAP, shadow),
        (panels[0, 1], wave.true, "(b) True modulation", label, SIGNED_MAP, (-high, high)),
        (panels[1, 0], wave.clean, "(c) Retrieved, noise-free", label, SIGNED_MAP, (-high, high)),
        (
            panels[1, 1],
            wave.filtered,
            f"(d) Retrieved, {percent(PLASMA_NOISE)} noise, high-pass",
            label,
            SIGNED_MAP,
            (-high, high),
        ),
    ):
        show(axes, plane, name, colours, limits, pixel)
        axes.set_title(title)
        name_axes(axes)
    draw_wave_cuts(panels[2], wave, pixel, label)
    save(figure, path)


def draw_wave_cuts(panels: Sequence[Axes], wave: Wave, pixel: float, label: str) -> None:
    row = wave.true.shape[0] // 2
    x = positions(wave.true.shape[1], pixel)
    curves = (
        ((wave.clean, "retrieved", GREEN, "-"),),
        (
            (wave.noisy, "retrieved", GREY, ":"),
            (wave.filtered, "retrieved, high-pass", BLUE, "-"),
        ),
    )
    titles = ("(e) Axis, noise-free", f"(f) Axis, {percent(PLASMA_NOISE)} noise")
    for axes, group, title in zip(panels, curves, titles, strict=True):
        axes.plot(x, wave.true[row], color="black", linewidth=3, alpha=0.3, label="true")
        for plane, name, colour, style in group:
            axes.plot(x, plane[row], color=colour, linewidth=1.2, linestyle=style, label=name)
        plain(axes)
        high = float(np.abs(wave.true[row]).max())
        axes.set(title=title, ylim=(-1.2 * high, 1.7 * high))
        axes.legend(loc="upper left", ncols=3)
        name_axes(axes, y=label)
