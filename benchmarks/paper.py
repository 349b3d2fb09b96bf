"""Repeat the paper's figures: pictures and measured numbers, written as docs/paper.md.

    python benchmarks/paper.py [--out docs]

Kasim et al., "Quantitative shadowgraphy and proton radiography for large intensity
modulations", arXiv:1607.04179. All numbers on the page are measured by this run, also
those that fall short of the paper's or of what was aimed at.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.optimize import brentq, minimize

from napari_shadowinv import Inversion, InversionOptions, invert, poisson_invert, synthetic_image
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram, power_diagram
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.readout import read_centroids
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.sites import Level, lloyd, plan_levels, sample_sites
from reference import errors

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SHAPE = (200, 200)
SETUP = phantoms.paper_setup()
PIXEL = SETUP.object_pixel_size * 1e6  # µm
SIGMA = 30e-6
NOISE = 0.1
N_NOISES = 5
SHOWN_PEAKS = (24.0, 97.0, 194.0, 290.0)
SWEEP = (10, 17, 24, 30, 40, 60, 80, 97, 120, 145, 170, 194, 217, 240, 265, 290, 315, 340)
OPTIONS = InversionOptions(negative="clip")
PLASMA_SHAPE = (240, 400)
PLASMA_NOISE = 0.02
NOT_DRAWN = "–"

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


# Drawing


def new_figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.09)
    return figure


def save(figure: Figure, path: Path, dpi: int = 120) -> None:
    figure.draw_without_rendering()  # the layout of panels of fixed shape takes two rounds
    figure.savefig(path, dpi=dpi, pil_kwargs={"optimize": True})
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


# Shots


def field_of(displacement: FloatArray) -> FloatArray:
    """Magnitude of the path-integrated field in MG µm."""
    return np.hypot(*SETUP.path_integrated_b(displacement, "MG um"))


def noisy(image: FloatArray, seed: int, share: float = NOISE) -> FloatArray:
    """Add normal noise with a standard deviation that is a share of the mean."""
    rng = np.random.default_rng(seed)
    return image + share * image.mean() * rng.normal(size=image.shape)


def toroid_truth(peak: float) -> FloatArray:
    return phantoms.toroid(SHAPE, SETUP, peak, SIGMA).displacement


def retrieved(image: FloatArray, source: FloatArray | None = None) -> Inversion:
    beam = np.ones(image.shape) if source is None else source
    return invert(image, source=beam, options=OPTIONS)


def seconds_of(inversion: Inversion) -> float:
    return sum(inversion.report.seconds.values())


# Figure 1: power diagrams and Lloyd's algorithm


def figure_diagrams(path: Path) -> None:
    figure = new_figure(12.5, 6.4)
    panels = figure.subplots(2, 4).ravel()
    panels[3].set_axis_off()
    sites = np.array([[32.0, 28.0], [40.0, 72.0], [76.0, 46.0]])
    shape, density = (100, 100), Density.from_image(np.ones((100, 100)))
    draw_nearest_site(panels[0], sites, np.array([43.0, 37.0]), shape)
    for axes, weight, title in (
        (panels[1], 0.0, "(b) Voronoi diagram"),
        (panels[2], 1200.0, "(c) Power diagram, site 1 heavier"),
    ):
        weights = np.array([weight, 0.0, 0.0])
        diagram = power_diagram(sites, density, weights)
        draw_cells(axes, diagram, shape, GREY, facecolors=["#cfe3f8", "#d7f0df", "#fbe3cf"])
        label_sites(axes, sites)
        empty_square(axes, shape, title)
    explain_diagrams(panels[3])
    draw_lloyd(panels[4:], shape, density)
    save(figure, path)


def label_sites(axes: Axes, sites: FloatArray) -> None:
    draw_sites(axes, sites, "black", 26)
    for number, (y, x) in enumerate(sites, 1):
        axes.annotate(str(number), (x, y), (6, 5), textcoords="offset points", fontsize=11)


def draw_nearest_site(
    axes: Axes, sites: FloatArray, point: FloatArray, shape: tuple[int, int]
) -> None:
    nearest = np.argmin(np.hypot(*(sites - point).T))
    for i, site in enumerate(sites):
        style = "-" if i == nearest else (0, (4, 3))
        axes.plot(*np.array([point, site]).T[::-1], color=GREY, linewidth=1, linestyle=style)
    label_sites(axes, sites)
    draw_sites(axes, point[None], RED, 36)
    y, x = point
    axes.annotate("A", (x, y), (-5, -17), textcoords="offset points", fontsize=11, color=RED)
    empty_square(axes, shape, "(a) Site 1 is the nearest to A")


def explain_diagrams(axes: Axes) -> None:
    text = (
        "Cell of site i in a power diagram:\n"
        "    |r − r$_i$|² − w$_i$ ≤ |r − r$_j$|² − w$_j$ for all j\n\n"
        "Equal weights: a Voronoi diagram.\n\n"
        "Lloyd's algorithm (below) moves each\n"
        "site (•) to the centroid (+) of its cell."
    )
    axes.text(0.04, 0.5, text, va="center", fontsize=10, linespacing=1.4, transform=axes.transAxes)


def draw_lloyd(panels: Sequence[Axes], shape: tuple[int, int], density: Density) -> None:
    sites = np.random.default_rng(3).uniform(4, 96, size=(9, 2)) - 0.5
    for letter, axes, steps in zip("defg", panels, (0, 1, 3, 30), strict=True):
        moved, _ = lloyd(sites, density, iterations=steps)
        diagram = power_diagram(moved, density)
        draw_cells(axes, diagram, shape, GREY, facecolors="#eef3f8")
        draw_sites(axes, moved, "black", 24)
        y, x = diagram.centroids.T
        axes.scatter(x, y, s=46, marker="+", color=RED, linewidths=1.3, zorder=4)
        name = {0: "random sites", 1: "after 1 step"}.get(steps, f"after {steps} steps")
        empty_square(axes, shape, f"({letter}) Lloyd: {name}")


# Figure 2: the algorithm with 100 sites


@dataclass(frozen=True)
class Walkthrough:
    """What each line of the paper's algorithm makes of one image."""

    source: FloatArray
    target: FloatArray
    random_sites: FloatArray
    level: Level
    weights: list[FloatArray]
    site_moves: FloatArray
    potential: FloatArray
    displacement: FloatArray


def walk_through(n_sites: int = 100) -> Walkthrough:
    shape = (100, 100)
    setup = SETUP.model_copy(update={"pixel_size": 3e-6})
    y, x = np.mgrid[:100, :100] - 49.5
    source = 0.55 + 0.9 * np.exp(-(y**2 + x**2) / (2 * 30**2))
    source /= source.mean()
    truth = phantoms.toroid(shape, setup, 150.0, 42e-6, center=(52.0, 47.0)).displacement
    target = np.maximum(synthetic_image(truth, source), 1e-3)
    target *= source.sum() / target.sum()
    density = Density.from_image(target)
    level = plan_levels(source, n_sites, lloyd_iterations=40).levels[-1]
    objective = TransportObjective(level.triangulation.copy(), level.mass, density)
    weights = minimise(objective)
    moves = objective.diagram(weights[-1], with_moments=True).centroids - level.centroids
    return Walkthrough(
        source,
        target,
        sample_sites(source, n_sites),
        level,
        weights,
        moves,
        *read_centroids(level, moves, shape),
    )


def minimise(objective: TransportObjective) -> list[FloatArray]:
    """L-BFGS from zero weights as in the paper; the weights of every iteration."""
    found = [np.zeros_like(objective.mass)]
    minimize(
        objective.value_and_gradient,
        found[0],
        jac=True,
        method="L-BFGS-B",
        callback=lambda w: found.append(np.array(w)),
        options={"maxiter": 500, "ftol": 0, "gtol": 1e-4 * objective.mass.mean()},
    )
    return found


def figure_algorithm(walk: Walkthrough, path: Path) -> None:
    figure = new_figure(14.4, 9.9)
    panels = dict(zip("abcdefghijkl", figure.subplots(3, 4).ravel(), strict=True))
    shape, level = walk.source.shape, walk.level
    last = len(walk.weights) - 1
    target, source = Density.from_image(walk.target), Density.from_image(walk.source)
    triangulation = level.triangulation.copy()

    def picture(letter: str, plane: FloatArray, title: str) -> Axes:
        axes = panels[letter]
        high = 2.5 if plane is walk.target else float(plane.max())
        show(axes, plane, "Intensity / mean", INTENSITY_MAP, (0, high), pixel=1)
        empty_square(axes, shape, f"({letter}) {title}")
        return axes

    def cells(letter: str, plane: FloatArray, weights: FloatArray, title: str) -> Axes:
        axes = picture(letter, plane, title)
        triangulation.update(weights)
        diagram = PowerDiagram(triangulation, source if plane is walk.source else target)
        draw_cells(axes, diagram, shape, "#ffb000", facecolors="none")
        return axes

    picture("a", walk.source, "Source")
    draw_sites(picture("b", walk.source, "100 sites by rejection"), walk.random_sites, RED)
    axes = cells("c", walk.source, walk.weights[0], "After Lloyd's algorithm")
    draw_sites(axes, level.sites, RED)
    picture("d", walk.target, "Target")
    axes = cells("e", walk.target, walk.weights[0], "The same sites on the target")
    draw_sites(axes, level.sites, RED)
    early = min(2, last)
    cells("f", walk.target, walk.weights[early], f"Power diagram, iteration {early}")
    cells("g", walk.target, walk.weights[last], f"Power diagram, iteration {last}")
    axes = cells("h", walk.target, walk.weights[last], "Centroids of its cells")
    draw_sites(axes, level.centroids + walk.site_moves, "#35d07f", 13)
    draw_moves(panels["i"], walk, shape)
    draw_read_out(panels, walk, shape)
    save(figure, path)


def draw_moves(axes: Axes, walk: Walkthrough, shape: tuple[int, int]) -> None:
    y, x = walk.level.centroids.T
    v, u = walk.site_moves.T
    size = np.hypot(u, v)
    arrows = axes.quiver(
        x, y, u, v, size, angles="xy", scale_units="xy", scale=1, width=0.007, cmap="viridis_r"
    )
    axes.figure.colorbar(arrows, ax=axes, fraction=0.046, pad=0.02).set_label("px")
    draw_sites(axes, walk.level.centroids, "black", 4)
    empty_square(axes, shape, "(i) Displacements of the sites")


def draw_read_out(panels: dict[str, Axes], walk: Walkthrough, shape: tuple[int, int]) -> None:
    largest = float(np.abs(walk.displacement).max())
    lowest, highest = float(walk.potential.min()), float(walk.potential.max())
    for letter, plane, title, label, colours, limits in (
        ("j", walk.displacement[1], "x, interpolated", "px", SIGNED_MAP, (-largest, largest)),
        ("k", walk.displacement[0], "y, interpolated", "px", SIGNED_MAP, (-largest, largest)),
        ("l", walk.potential, "Deflection potential", "px²", POTENTIAL_MAP, (lowest, highest)),
    ):
        name = title if letter == "l" else f"Displacement along {title}"
        show(panels[letter], plane, label, colours, limits, pixel=1)
        empty_square(panels[letter], shape, f"({letter}) {name}")


# Figures 3 and 4: the set-up and its images


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


# Figure 5: the sweep over the toroid's strength


@dataclass(frozen=True)
class SweepRow:
    """Errors of one toroid in per cent, (peak, L2), and the seconds of a noisy image.

    Of the noisy images the mean of the errors, and the range of those of the peak.
    """

    peak: float
    noisy: tuple[float, float]
    noisy_range: tuple[float, float]
    clean: tuple[float, float]
    linear: tuple[float, float]
    seconds: float
    converged: bool


def sweep() -> list[SweepRow]:
    return [sweep_row(float(peak)) for peak in SWEEP]


def sweep_row(peak: float) -> SweepRow:
    truth = toroid_truth(peak)
    image = synthetic_image(truth)
    clean = retrieved(image)
    shots = [retrieved(noisy(image, seed=1000 * k + round(peak))) for k in range(N_NOISES)]
    found = np.array([errors(shot.displacement, truth) for shot in shots])
    linear = -np.array(np.gradient(poisson_invert(image)))
    return SweepRow(
        peak,
        noisy=(float(found[:, 0].mean()), float(found[:, 1].mean())),
        noisy_range=(float(found[:, 0].min()), float(found[:, 0].max())),
        clean=errors(clean.displacement, truth),
        linear=errors(linear, truth),
        seconds=float(np.median([seconds_of(shot) for shot in shots])),
        converged=all(shot.report.converged for shot in [clean, *shots]),
    )


def caustic_onset() -> float:
    """Peak in MG µm beyond which the map of the toroid folds."""
    at_one = toroid_truth(1.0)
    return float(brentq(lambda peak: jacobian_determinant(peak * at_one).min(), 100, 250))


def range_of_accuracy(rows: list[SweepRow], kind: str, limit: float = 10.0) -> float:
    """Peak where the error grows beyond the limit for good, interpolated; inf if nowhere."""
    peaks = [row.peak for row in rows]
    size = [abs(getattr(row, kind)[0]) for row in rows]
    within = [k for k, value in enumerate(size) if value <= limit]
    if not within:
        return 0.0
    k = within[-1]
    if k == len(rows) - 1:
        return float("inf")
    share = (limit - size[k]) / (size[k + 1] - size[k])
    return peaks[k] + share * (peaks[k + 1] - peaks[k])


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


# Figure 6: other structures


@dataclass(frozen=True)
class Structure:
    """An object of the paper's Fig. 6 and what was retrieved of it."""

    letter: str
    name: str
    truth: FloatArray
    image: FloatArray
    inversion: Inversion
    open_pixels: BoolArray
    row: int

    @property
    def peak_error(self) -> float:
        """Error of the largest field among the pixels that the beam passes, in per cent."""
        found = field_of(self.inversion.displacement)[self.open_pixels].max()
        return 100 * float(found / field_of(self.truth)[self.open_pixels].max() - 1)

    @property
    def l2_error(self) -> float:
        """L2 error of the displacement in per cent, over the same pixels."""
        difference = (self.inversion.displacement - self.truth)[:, self.open_pixels]
        return 100 * float(
            np.linalg.norm(difference) / np.linalg.norm(self.truth[:, self.open_pixels])
        )

    @property
    def correlation(self) -> float:
        """Correlation of the retrieved with the true cross-section."""
        seen = self.open_pixels[self.row]
        found = field_of(self.inversion.displacement)[self.row, seen]
        return float(np.corrcoef(found, field_of(self.truth)[self.row, seen])[0, 1])

    @property
    def image_difference(self) -> float:
        """Root mean square of re-projection minus image, in per cent of the mean."""
        return 100 * rms(self.inversion.residual) / float(self.inversion.source.mean())


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def structures() -> list[Structure]:
    scenes: tuple[tuple[str, Callable[..., phantoms.Phantom], float], ...] = (
        ("four toroids", phantoms.four_toroids, 0.67),
        ("two cos² ellipses", phantoms.cosine_ellipses, 0.37),
        ("two focusing ellipses", phantoms.focusing_pair, 0.5),
        ("opposite directions", phantoms.opposite_pair, 0.5),
    )
    found = []
    for letter, (name, scene, share) in zip("abcd", scenes, strict=True):
        truth = scene(SHAPE, SETUP).displacement
        image = noisy(synthetic_image(truth), seed=ord(letter))
        everywhere = np.ones(SHAPE, dtype=bool)
        row = round(share * SHAPE[0])
        found.append(Structure(letter, name, truth, image, retrieved(image), everywhere, row))
    return [*found, *coaxial_structures()]


def coaxial_structures() -> list[Structure]:
    """The coaxial line with a uniform source, and with its shadow in the source."""
    phantom, obstructed = phantoms.coaxial_line(SHAPE, SETUP)
    shadow = np.where(obstructed, 0.0, 1.0)
    clean = synthetic_image(phantom.displacement, shadow)
    image = noisy(clean, seed=ord("e"))
    cases = (
        ("e", "coaxial line, uniform source", image, np.ones(SHAPE)),
        ("e′", "coaxial line, its shadow in the source", image, shadow),
        (NOT_DRAWN, "the same, noise-free", clean, shadow),
    )
    truth, row = phantom.displacement, SHAPE[0] // 2
    return [
        Structure(letter, name, truth, shot, retrieved(shot, source), ~obstructed, row)
        for letter, name, shot, source in cases
    ]


def figure_structures(structures: list[Structure], path: Path) -> None:
    found = [structure for structure in structures if structure.letter != NOT_DRAWN]
    figure = new_figure(16.4, 2.85 * len(found))
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
    save(figure, path, dpi=100)


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


# The plasma wave


@dataclass(frozen=True)
class Wave:
    """Line-integrated modulation ∫Δn/n₀ dz in µm: true and retrieved."""

    image: FloatArray
    noisy_image: FloatArray
    true: FloatArray
    clean: FloatArray
    noisy: FloatArray
    filtered: FloatArray
    first_order_error: float
    seconds: float

    def axis_error(self, found: FloatArray) -> tuple[float, float]:
        """Largest and root mean square error along the axis, per cent of the true peak."""
        row = self.true.shape[0] // 2
        error = found[row] - self.true[row]
        scale = 100 / float(np.abs(self.true[row]).max())
        return scale * float(np.abs(error).max()), scale * rms(error)

    def peak_error(self, found: FloatArray) -> float:
        row = self.true.shape[0] // 2
        return 100 * float(np.abs(found[row]).max() / np.abs(self.true[row]).max() - 1)


def plasma_wave() -> Wave:
    setup = phantoms.wakefield_setup()
    density = 1.65e25
    phantom = phantoms.wakefield(PLASMA_SHAPE, setup, density=density)
    image = synthetic_image(phantom.displacement)
    with_noise = noisy(image, seed=810, share=PLASMA_NOISE)

    def modulation(potential: FloatArray) -> FloatArray:
        return setup.relative_density_modulation(potential, density) * 1e6

    of_noisy = retrieved(with_noise)
    noisy_modulation = modulation(of_noisy.potential)
    # As in the paper: slow variations are the noise's, the wave is fast.
    scale = phantoms.plasma_wavelength(density) / setup.object_pixel_size
    return Wave(
        image,
        with_noise,
        modulation(phantom.potential),
        modulation(retrieved(image).potential),
        noisy_modulation,
        noisy_modulation - gaussian_filter(noisy_modulation, scale, mode="nearest"),
        100 * density / setup.critical_density,
        seconds_of(of_noisy),
    )


def figure_wave(wave: Wave, path: Path) -> None:
    figure = new_figure(12.6, 10)
    panels = figure.subplots(3, 2, height_ratios=(1.25, 1.25, 1))
    pixel = phantoms.wakefield_setup().object_pixel_size * 1e6
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


# The page


def verdict(value: float, limit: float) -> str:
    return "reached" if abs(value) <= limit else "**missed**"


def worst(rows: list[SweepRow], kind: str, low: float, high: float) -> float:
    return max(abs(getattr(row, kind)[0]) for row in rows if low <= row.peak <= high)


def worst_single(rows: list[SweepRow], low: float, high: float) -> float:
    ranges = [row.noisy_range for row in rows if low <= row.peak <= high]
    return float(np.abs(ranges).max())


def sweep_table(rows: list[SweepRow]) -> str:
    lines = [
        "| D_m, MG µm | 10 % noise: peak / L2 error, % | range of the peak's | noise-free, % "
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


PAGE = """# The paper's figures, repeated

Kasim et al., "Quantitative shadowgraphy and proton radiography for large intensity modulations",
[arXiv:1607.04179](https://arxiv.org/abs/1607.04179). This page, its pictures and its numbers are
written by

    python benchmarks/paper.py

in {minutes:.1f} minutes on {cores} cores. The images are synthetic: exact fields, the package's
own forward model, and normal noise whose standard deviation is 10 % of the mean. (The paper says
"variance 10 % of the average intensity".) Negative pixels are set to zero, and the source is
uniform, except where a row says otherwise.

{merit}

Peak error: largest retrieved field against the largest true one. L2 error: norm of the difference
of the displacements against the norm of the truth. The solver's tolerance and all other options
are the defaults, with a site per pixel. Seconds are those of a whole inversion.

## Fig. 1: Voronoi diagram, power diagram, Lloyd's algorithm

![Voronoi and power diagrams, four stages of Lloyd's algorithm](paper-diagrams.png)

## Fig. 2: the algorithm with 100 sites

![Twelve steps from the source to the deflection potential](paper-algorithm.png)

As in the paper: L-BFGS from zero weights ({iterations} iterations), centroids, natural-neighbour
interpolation and integration, which the options `solver="lbfgs"`, `stages="single"` and
`readout="centroid"` ask for. Everything below uses the defaults instead: Newton's method on
several levels, and the potential read off the weights.

## Fig. 3: the set-up

The drawing (a) of the paper is the table below.

![Field and image of the toroid with 97 MG µm](paper-setup.png)

{setup}

## Fig. 4: images from weak modulation to branched caustics

![Images and cuts for 24, 97, 194 and 290 MG µm](paper-intensity.png)

## Fig. 5: retrieved against true field

![True and retrieved fields, and the error against the true peak](paper-sweep.png)

{sweep}

Errors with noise are the mean over {n_noises} images, and the range of their peak's. An inversion
amplifies the slow variations of noise: where the object is weak they add to its field, and the
largest value lies above the true peak. Beyond the caustics' onset rays cross, which no transport
of least cost does: the field comes out too smooth there.

## Fig. 6: other structures

![True field, image, retrieved field, re-projection and cut of six cases](paper-structures.png)

{structures}

The paper gives no numbers for its structures: positions, sizes and strengths are ours, such that
caustics have just formed. Of the re-projection's difference from the image, 10 % are the noise.
In (e) two conductors stop the beam (grey in the cut). Row (e) is the paper's method as it is
written, with a uniform source and no mask: shadows count as deflection, so the field is wrong far
around them. Row (e′) tells the inversion where the beam was stopped, by zeros in the source; most
of what is left comes from noise inside the shadows, which counts as light there. Errors and
correlations of the coaxial line are over the pixels that the beam passes; inside the shadows
there is nothing to see.

## Section V: a plasma wave seen by light

![Shadowgram of a plasma wave, true and retrieved line-integrated modulation](paper-wakefield.png)

{wave}

A density wave of {wavelength:.2f} µm (n₀ = 1.65e19 cm⁻³) with curved wavefronts, probed at 810
nm, on {wave_shape} px in {wave_seconds:.1f} s. The paper's shadowgrams are measured, with no
truth to compare with; amplitude and distance are ours. The image is one of rays, without
diffraction. n₀ / n_c is {first_order:.2f} %: of that order is the error of the thin plasma, ln η ≈
−n/2n_c. (The paper's Eq. 12 leaves out the ½; see `OpticalSetup.line_integrated_density`.) As in
the paper, a high-pass filter (the potential minus its average over a plasma wavelength, Gaussian)
takes out the slow variations into which an inversion turns noise.
"""


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    default = Path(__file__).resolve().parents[1] / "docs"
    parser.add_argument("--out", type=Path, default=default, help="folder of page and pictures")
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    invert(np.ones((20, 20)) + np.eye(20))  # compile, so that the seconds are the work's
    with mpl.rc_context(STYLE):
        values = make_everything(out)
    minutes = (time.perf_counter() - start) / 60
    page = PAGE.format(minutes=minutes, cores=os.cpu_count(), **values)
    (out / "paper.md").write_text(page, encoding="utf-8")
    print(f"wrote {out / 'paper.md'} after {minutes:.1f} minutes")


def make_everything(out: Path) -> dict[str, Any]:
    """Draw all figures; return what the page says about them."""
    figure_diagrams(out / "paper-diagrams.png")
    walk = walk_through()
    figure_algorithm(walk, out / "paper-algorithm.png")
    figure_setup(out / "paper-setup.png")
    figure_intensity(out / "paper-intensity.png")
    rows, onset = sweep(), caustic_onset()
    figure_sweep(rows, onset, out / "paper-sweep.png")
    found = structures()
    figure_structures(found, out / "paper-structures.png")
    wave = plasma_wave()
    figure_wave(wave, out / "paper-wakefield.png")
    return {
        "merit": merit_table(rows, onset, found, wave),
        "n_noises": N_NOISES,
        "iterations": len(walk.weights) - 1,
        "setup": setup_table(),
        "sweep": sweep_table(rows),
        "structures": structure_table(found),
        "wave": wave_table(wave),
        "wavelength": phantoms.plasma_wavelength(1.65e25) * 1e6,
        "wave_shape": f"{PLASMA_SHAPE[0]} × {PLASMA_SHAPE[1]}",
        "wave_seconds": wave.seconds,
        "first_order": wave.first_order_error,
    }


if __name__ == "__main__":
    main()
