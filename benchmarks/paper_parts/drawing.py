"""What the paper's figures share: style, planes in µm, curves, cells and sites."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from PIL import Image

from napari_shadowinv.geometry.power_diagram import PowerDiagram
from paper_parts.shots import PIXEL, FloatArray

INTENSITY_MAP, FIELD_MAP, SIGNED_MAP, POTENTIAL_MAP = "gray", "inferno", "RdBu_r", "viridis"
BLUE, GREEN, RED, GREY = "#1f77d0", "#18a558", "#d6403a", "#555555"
FIELD_LABEL = "|∫B × dz| (MG µm)"
STYLE: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.linewidth": 0.7,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "figure.facecolor": "white",
}


def new_figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.09)
    return figure


def save(figure: Figure, path: Path, dpi: int = 120, palette: bool = False) -> None:
    """Write a figure; with a palette of 256 colours where many noisy panels make it large."""
    figure.draw_without_rendering()  # the layout of panels of fixed shape takes two rounds
    figure.savefig(path, dpi=dpi, pil_kwargs={"optimize": True})
    if palette:
        with Image.open(path) as picture:
            few = picture.convert("RGB").quantize(256, dither=Image.Dither.NONE)
        few.save(path, optimize=True)
    print(f"wrote {path}", flush=True)


def percent(share: float) -> str:
    return f"{100 * share:g} %"


def show(
    axes: Axes,
    plane: FloatArray,
    label: str | None,
    colours: str,
    limits: tuple[float, float],
    pixel: float = PIXEL,
) -> None:
    """Show a plane with its axes in µm, and a colour bar if there is a label for it."""
    height, width = plane.shape
    edges = (-0.5 * pixel, (width - 0.5) * pixel, (height - 0.5) * pixel, -0.5 * pixel)
    drawn = axes.imshow(
        plane, cmap=colours, vmin=limits[0], vmax=limits[1], extent=edges, interpolation="nearest"
    )
    if label is not None:
        beyond = "max" if plane.max() > 1.001 * limits[1] else "neither"
        figure = axes.figure
        bar = figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.02, extend=beyond)
        bar.set_label(label)
        bar.outline.set_linewidth(0.6)


def name_axes(axes: Axes, x: str = "x (µm)", y: str = "y (µm)") -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)


def plain(axes: Axes) -> None:
    """Leave a curve's panel with two axes and a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.margins(x=0)


def positions(count: int, pixel: float = PIXEL) -> FloatArray:
    return np.arange(count) * pixel


def clipped(polygon: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Cut a convex polygon to the image: cells at the rim reach far beyond it."""
    for axis in (0, 1):
        for sign, limit in ((1, 0.5), (-1, shape[axis] - 0.5)):
            inside = sign * polygon[:, axis] + limit >= 0
            corners: list[FloatArray] = []
            for k, corner in enumerate(polygon):
                before = polygon[k - 1]
                if inside[k] != inside[k - 1]:
                    share = (-sign * limit - before[axis]) / (corner[axis] - before[axis])
                    corners.append(before + share * (corner - before))
                if inside[k]:
                    corners.append(corner)
            polygon = np.array(corners).reshape(-1, 2)
    return polygon


def draw_cells(
    axes: Axes, diagram: PowerDiagram, shape: tuple[int, int], colour: str, **style: Any
) -> None:
    cells = [clipped(diagram.cell(i), shape) for i in range(diagram.n_sites)]
    outlines = [cell[:, ::-1] for cell in cells if len(cell)]
    collection = PolyCollection(outlines, edgecolors=colour, linewidths=0.9, **style)
    axes.add_collection(collection)


def draw_sites(axes: Axes, sites: FloatArray, colour: str, size: float = 9) -> None:
    axes.scatter(sites[:, 1], sites[:, 0], s=size, color=colour, linewidths=0, zorder=3)


def empty_square(axes: Axes, shape: tuple[int, int], title: str) -> None:
    axes.set(
        xlim=(-0.5, shape[1] - 0.5),
        ylim=(shape[0] - 0.5, -0.5),
        aspect="equal",
        xticks=[],
        yticks=[],
        title=title,
    )
