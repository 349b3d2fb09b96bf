"""Products of a result on a page: `products_figure`; the curves of one: `draw_curves`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.analysis.product import BANDS
from napari_shadowinv.facts import Level
from napari_shadowinv.physics.arrays import PLANE
from napari_shadowinv.physics.units import display_unit, prefix_for
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import ALARM_COLOUR, QUIET_COLOUR

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from napari_shadowinv.analysis import ProductResult

_COLOURS = ("#1f77b4", "#d95f02", "#1b9e77", "#7a5195", "0.4")


def products_figure(results: Sequence[ProductResult], *, title: str | None = None) -> Figure:
    """Show products on a page: curves and maps with their bands, and all numbers below."""
    panels = [(each, names) for each in results for names in _panels_of(each)]
    lines = _footer(results)
    line, panel = 0.19, 3.2  # inches
    foot = 0.25 + line * len(lines)
    head = 0.35 if title else 0.1
    height = head + panel * len(panels) + foot
    with _panels.styled_figure((8.0, height)) as figure:
        for number, (each, names) in enumerate(panels):
            bottom = height - head - panel * (number + 1)
            box = (0.1, (bottom + 0.6) / height, 0.78, (panel - 1.0) / height)
            _draw(figure.add_axes(box), each, names)
        if title:
            figure.text(0.02, 1 - 0.1 / height, title, va="top", weight="bold")
        for number, (text, colour) in enumerate(lines):
            place = (foot - 0.15 - line * number) / height
            figure.text(0.02, place, text, va="top", fontsize=8, color=colour)
    return figure


def _footer(results: Sequence[ProductResult]) -> list[tuple[str, str]]:
    sentences, doubts = [], []
    for each in results:
        numbers = [fact for fact in each.facts if fact.short or fact.key in each.variables]
        listed = "; ".join(f"{fact.title.lower()} {fact.text}" for fact in numbers)
        sentences.append((f"{each.title}: {listed}", QUIET_COLOUR))
        doubts += [fact for fact in each.facts if fact not in numbers]
    for fact in doubts:
        colour = QUIET_COLOUR if fact.level is Level.SOUND else ALARM_COLOUR
        sentences.append((f"{fact.title}: {fact.text}", colour))
    limits = dict.fromkeys(sentence for each in results for sentence in each.limits)
    sentences += [(text, QUIET_COLOUR) for text in limits]
    return _panels.wrapped(dict.fromkeys(sentences), 125)


def _panels_of(result: ProductResult) -> tuple[tuple[str, ...], ...]:
    maps = [name for name, variable in result.variables.items() if len(variable.dims) == 2]
    return ((maps[0],),) if maps else result.curve_groups


def _draw(axes: Axes, result: ProductResult, names: Sequence[str]) -> None:
    axes.set_title(result.title)
    if len(result.variables[names[0]].dims) == 2:
        _draw_map(axes, result, names[0])
        return
    draw_curves(axes, result, names)
    if "intensity" in result.variables:
        beside = axes.twinx()
        places, _ = result.shown_places("intensity")
        beside.plot(places, result.quantities["intensity"].value, color="0.6", linewidth=0.8)
        beside.set_ylabel("image", color="0.5")
        beside.margins(x=0)


def make_logarithmic(axes: Axes) -> None:
    """Make both axes logarithmic, with plain numbers at 1, 2 and 5 below."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axes.set_xscale("log")
    axes.set_yscale("log", nonpositive="mask")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def draw_curves(
    axes: Axes, result: ProductResult, names: Sequence[str], colours: Sequence[str] = _COLOURS
) -> None:
    """Draw one of a result's `curve_groups` with bands, in the unit that it is shown in."""
    from matplotlib.ticker import MaxNLocator

    places, words = result.shown_places(names[0])
    scale, unit = result.shown_scale(names)
    for number, name in enumerate(names):
        colour = colours[number % len(colours)]
        marker = "." if result.is_series else ""
        values = scale * result[name].value
        axes.plot(places, values, color=colour, linewidth=1.3, marker=marker, label=name)
        for share, opacity in zip(BANDS, (0.35, 0.18), strict=True):
            if (band := result.band(name, share)) is not None:
                style: Any = {"color": colour, "alpha": opacity, "linewidth": 0}
                axes.fill_between(places, scale * band[0], scale * band[1], **style)
    axes.set_xlabel(words)
    if "shot" in result.coordinates:
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    shown_unit = "" if unit == "1" else unit
    axes.set_ylabel(f"field ({unit})" if unit == result.unit.symbol else shown_unit)
    if result.is_logarithmic:
        make_logarithmic(axes)
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.margins(x=0)
    axes.legend(frameon=False, fontsize=8)


def _draw_map(axes: Axes, result: ProductResult, name: str) -> None:
    values = result[name].value
    limit = float(np.nanpercentile(np.abs(values), 99.8)) or 1.0
    factor, prefix = prefix_for(limit)
    dims = result.variables[name].dims
    rows, columns = (result.coordinates[axis].values for axis in dims)
    scale, letter = 1.0, display_unit(result.coordinates[dims[1]].unit)
    if letter == "m":
        scale, letter = prefix_for(float(columns[-1]))
        letter = f"{letter}m"
    half = scale * (columns[1] - columns[0]) / 2
    extent = (-half, scale * columns[-1] + half, scale * rows[-1] + half, -half)
    limits: Any = {"vmin": -factor * limit, "vmax": factor * limit}
    image = axes.imshow(factor * values, cmap="RdBu_r", extent=extent, **limits)
    down, right = ("y", "x") if dims == PLANE else (result.coordinates[d].long_name for d in dims)
    axes.set_xlabel(f"{right} ({letter})")
    axes.set_ylabel(f"{down} ({letter})")
    axes.figure.colorbar(image, ax=axes, label=f"{prefix}{result.variables[name].unit}")
