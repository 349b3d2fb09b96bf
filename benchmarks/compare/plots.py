"""Plots of the comparison: error against time and memory, and all three against the size."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from compare import summary
from compare.catalogue import OURS, SOLVERS
from compare.summary import Result, Results

_COLOURS = (
    "#1f77d0", "#0b3d75", "#17becf", "#7fb2e5", "#999999", "#e8711a", "#c23b22",
    "#2e8b57", "#7bbf4b", "#8e44ad", "#c78fd8", "#b8860b", "#008080", "#d62790",
)  # fmt: skip
_MARKERS = ("*", "P", "p", "X", "v", "s", "D", "o", "^", "<", ">", "h", "d", "H")
_AXES = {"seconds": "Processor seconds", "megabytes": "Peak memory (MB)"}
STYLES = {
    solver.name: (colour, marker)
    for solver, colour, marker in zip(SOLVERS, _COLOURS, _MARKERS, strict=False)
}


def number(value: float, _: object = None) -> str:
    return f"{value:g}"


def plain_logarithmic(axes: Axes) -> None:
    axes.set(xscale="log", yscale="log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(number))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.25)


def draw_trade_off(results: Results, path: Path, chosen: tuple[int, ...] = (64, 128)) -> None:
    """Each image a faint mark, each solver's medians a large one, of two sizes of images."""
    figure = Figure(figsize=(11, 8.6), layout="constrained")
    panels = figure.subplots(2, len(chosen), sharey=True, squeeze=False)
    for column, size in enumerate(chosen):
        for row, (name, label) in enumerate(_AXES.items()):
            axes: Axes = panels[row, column]
            plain_logarithmic(axes)
            _draw_solvers(axes, results, size, getattr(summary, name))
            axes.set(xlabel=label, title=f"Images of {size}² px" if row == 0 else "")
            if column == 0:
                axes.set_ylabel("L2 error of the displacement (%)")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=120)


def _draw_solvers(
    axes: Axes, results: Results, size: int, measure: Callable[[Result], float]
) -> None:
    for name, (colour, marker) in STYLES.items():
        if name not in results["solvers"]:
            continue
        successes = list(summary.solved(results, name, summary.keys(results, size)).values())
        x, y = (
            [measure(result) for result in successes],
            [summary.error(result) for result in successes],
        )
        axes.plot(x, y, marker, color=colour, alpha=0.25, markersize=4, markeredgewidth=0)
        medians = [summary.median(value, successes) for value in (measure, summary.error)]
        x, y = ([] if median is None else [median] for median in medians)
        axes.plot(
            x, y, marker, color=colour, label=name, markeredgecolor="white",
            markersize=17 if name == OURS else 11, zorder=3 if name == OURS else 2,
        )  # fmt: skip


def draw_scaling(results: Results, path: Path) -> None:
    """Medians over the ten densities against the image's side, where most of them were solved."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    panels = figure.subplots(1, 3)
    measures = (summary.seconds, summary.megabytes, summary.error)
    titles = (*_AXES.values(), "L2 error of the displacement (%)")
    for axes, measure, title in zip(panels, measures, titles, strict=True):
        plain_logarithmic(axes)
        axes.set(title=title, xlabel="Side of the image (px)")
        axes.set_xticks(summary.sizes(results))
        for name, (colour, marker) in STYLES.items():
            if name in results["solvers"]:
                axes.plot(*_medians(results, name, measure), f"{marker}-", color=colour, label=name)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.savefig(path, dpi=120)


def _medians(
    results: Results, solver: str, measure: Callable[[Result], float]
) -> tuple[list[int], list[float]]:
    points = {}
    for size in summary.sizes(results):
        chosen = summary.keys(results, size, ["densities"])
        successes = summary.solved(results, solver, chosen)
        middle = summary.median(measure, successes.values())
        if middle is not None and 2 * len(successes) > len(chosen):
            points[size] = middle
    return list(points), list(points.values())
