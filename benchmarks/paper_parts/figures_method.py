"""Figures 1 and 2: power diagrams, Lloyd's algorithm, and the method with 100 sites."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from scipy.optimize import minimize

from napari_shadowinv import synthetic_image
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.inversion.readout import read_centroids
from napari_shadowinv.physics import phantoms
from napari_shadowinv.transport.minimise import TransportObjective
from napari_shadowinv.transport.sites import SiteLevel, lloyd, plan_levels, sample_sites
from paper_parts.drawing import (
    GREY,
    INTENSITY_MAP,
    POTENTIAL_MAP,
    RED,
    SIGNED_MAP,
    draw_cells,
    draw_sites,
    empty_square,
    new_figure,
    save,
    show,
)
from paper_parts.shots import SETUP, FloatArray


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
        triangulation = RegularTriangulation(sites, weights, region=density.region)
        diagram = PowerDiagram(triangulation, density, with_moments=True)
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
        triangulation = RegularTriangulation(sites, region=density.region)
        diagram, _ = lloyd(triangulation, density, iterations=steps)
        moved = triangulation.sites
        draw_cells(axes, diagram, shape, GREY, facecolors="#eef3f8")
        draw_sites(axes, moved, "black", 24)
        y, x = diagram.centroids.T
        axes.scatter(x, y, s=46, marker="+", color=RED, linewidths=1.3, zorder=4)
        name = {0: "random sites", 1: "after 1 step"}.get(steps, f"after {steps} steps")
        empty_square(axes, shape, f"({letter}) Lloyd: {name}")


@dataclass(frozen=True)
class Walkthrough:
    """What each line of the paper's algorithm makes of one image."""

    source: FloatArray
    target: FloatArray
    random_sites: FloatArray
    level: SiteLevel
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
        *read_centroids(level, moves),
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
