"""A page of panels: their layout, and the drawing of each."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import AnyArray, FloatArray
from napari_shadowinv.cautions import CAUTION_CODES
from napari_shadowinv.physics.units import prefix_for

if TYPE_CHECKING:
    from collections.abc import Iterable

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from napari_shadowinv.facts import Fact
    from napari_shadowinv.physics.setup import Setup

ALARM_COLOUR, GOOD_COLOUR, QUIET_COLOUR = "#b00020", "#1b6e3c", "0.3"
STYLE: Any = {
    "font.family": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.7,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-3, 5),
}


@dataclass(frozen=True)
class Scale:
    """Length of a pixel along the image's axes, and its unit."""

    pixel: float
    unit: str

    def extent(self, shape: tuple[int, int]) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge, for images whose first row is on top."""
        edges = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
        x_min, x_max, y_max, y_min = (edge * self.pixel for edge in edges)
        return x_min, x_max, y_max, y_min


def image_scale(shape: tuple[int, int], setup: Setup | None) -> Scale:
    """Metres at the object with a setup, pixels without."""
    if setup is None:
        return Scale(1.0, "px")
    pixel = setup.object_pixel_size
    factor, prefix = prefix_for(max(shape) * pixel, allowed=(-9, -6, -3, 0))
    return Scale(pixel * factor, f"{prefix}m")


@dataclass(frozen=True)
class Grid:
    """Sizes in inches that put panels of one shape on a page without overlaps."""

    rows: int
    columns: int
    width: float
    height: float
    foot: float
    head: float
    left_margin: float = 0.68
    right_margin: float = 0.95
    below: float = 0.52
    above: float = 0.36

    @property
    def extra(self) -> float:
        """Extra width of the last panel, with the profiles, compared with a narrow image."""
        return max(0.0, 2.5 - self.width)

    @property
    def figure_size(self) -> tuple[float, float]:
        cell_width = self.left_margin + self.width + self.right_margin
        cell_height = self.below + self.height + self.above
        height = self.head + self.rows * cell_height + self.foot
        return self.columns * cell_width + self.extra, height

    def box(self, index: int) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of a panel as shares of the figure."""
        is_last = index == self.rows * self.columns - 1
        row, column = divmod(index, self.columns)
        total_width, total_height = self.figure_size
        left_edge = column * (self.left_margin + self.width + self.right_margin) + self.left_margin
        top_edge = self.head + row * (self.below + self.height + self.above) + self.above
        return (
            left_edge / total_width,
            1 - (top_edge + self.height) / total_height,
            (self.width + is_last * self.extra) / total_width,
            self.height / total_height,
        )


def choose_grid(
    shape: tuple[int, int], panels: int, *, foot: float = 0.0, title: bool = True
) -> Grid:
    """Choose the columns for which the page is closest to a slide's 16:10."""
    width, height = panel_size(shape)
    grids = [
        Grid(panels // columns, columns, width, height, foot, head=0.4 if title else 0.05)
        for columns in range(1, panels + 1)
        if panels % columns == 0
    ]
    return min(grids, key=lambda g: abs(np.log(g.figure_size[0] / g.figure_size[1] / 1.6)))


def panel_size(shape: tuple[int, int]) -> tuple[float, float]:
    """Width and height in inches: panels of equal area, with room for ticks on the short side."""
    aspect = shape[0] / shape[1]
    width = float(np.clip(2.75 / np.sqrt(aspect), 1.2, 6.4))
    return width, float(np.clip(width * aspect, 1.2, 6.4))


def new_page(grid: Grid, scale: Scale, title: str | None) -> tuple[Figure, list[Panel]]:
    """Return a figure with all its panels, still empty."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=grid.figure_size)
    FigureCanvasAgg(figure)
    if title:
        width, height = grid.figure_size
        figure.text(0.2 / width, 1 - 0.26 / height, title, size=13, weight="bold", va="center")
    boxes = [grid.box(index) for index in range(grid.rows * grid.columns)]
    return figure, [Panel(figure.add_axes(box), scale, grid) for box in boxes]


def write_header(
    figure: Figure, lines: list[tuple[str, str]], grid: Grid, *, has_title: bool = True
) -> None:
    """Write lines, each with its colour, between the title and the panels."""
    width, height = grid.figure_size
    top = 0.44 if has_title else 0.14
    for number, (text, colour) in enumerate(lines):
        y = 1 - (top + 0.18 * number) / height
        figure.text(0.2 / width, y, text, size=10, color=colour, va="top")


_LEGENDS = {"masked": "hatched", "caustics": "outlined", "crossed_rays": "outlined"}


def fact_line(facts: Iterable[Fact]) -> str:
    """Return facts as one line of text, to be wrapped."""
    titles = {key: f" ({look})" for key, look in _LEGENDS.items()}
    return "  ·  ".join(f"{fact.title}{titles.get(fact.key, '')}: {fact.text}" for fact in facts)


def footer_lines(facts: Iterable[Fact], headline: str, letters: int) -> list[tuple[str, str]]:
    """Return the facts that a headline does not contain as lines; long ones have their own."""
    shown = [fact for fact in facts if fact.key not in CAUTION_CODES and fact.text not in headline]
    is_long = {fact: len(fact.text) > letters // 2 for fact in shown}
    paragraphs = [fact_line(fact for fact in shown if not is_long[fact])]
    paragraphs += [fact_line([fact]) for fact in shown if is_long[fact]]
    return [(line, QUIET_COLOUR) for text in paragraphs for line in textwrap.wrap(text, letters)]


def write_footer(figure: Figure, lines: list[tuple[str, str]], grid: Grid) -> None:
    """Write lines, each with its colour, below the panels."""
    width, height = grid.figure_size
    for number, (text, colour) in enumerate(reversed(lines)):
        y = (0.1 + 0.18 * number) / height
        figure.text(0.2 / width, y, text, size=8.5, color=colour, va="bottom")


@dataclass(frozen=True)
class Panel:
    """Axes with room for a colour bar on their right."""

    axes: Axes
    scale: Scale
    grid: Grid

    def show(
        self, plane: FloatArray, title: str, label: str, cmap: str, limits: tuple[float, float]
    ) -> None:
        """Show a plane in false colours, hatched where it is NaN.

        The ends of the colour bar are pointed where limits cut the plane.
        """
        low, high = limits
        self.hatch_gaps(plane)
        # Smoothing would hide single bad pixels.
        choices: Any = {"vmin": low, "vmax": high, "interpolation": "nearest", "aspect": "equal"}
        extent = self.scale.extent(plane.shape)
        picture = self.axes.imshow(plane, extent=extent, cmap=cmap, **choices)
        self.axes.set_title(title)
        self.axes.set_xlabel(f"x ({self.scale.unit})")
        self.axes.set_ylabel(f"y ({self.scale.unit})")
        self.few_ticks()
        below, above = bool(np.nanmin(plane) < low), bool(np.nanmax(plane) > high)
        extend = {(True, True): "both", (True, False): "min", (False, True): "max"}
        room = self.axes.inset_axes((1 + 0.08 / self.grid.width, 0, 0.12 / self.grid.width, 1))
        figure: Any = self.axes.figure
        bar = figure.colorbar(picture, cax=room, extend=extend.get((below, above), "neither"))
        bar.set_label(label)
        bar.outline.set_linewidth(0.7)

    def hatch_gaps(self, plane: FloatArray) -> None:
        """Hatch the background if it shows through a plane, where that is NaN."""
        if np.isnan(plane).any():
            self.axes.patch.set(facecolor="0.92", edgecolor="0.6", hatch="////")

    def contour(self, plane: AnyArray, levels: ArrayLike, colour: str, **style: Any) -> None:
        """Draw lines of equal value onto the picture."""
        place: Any = {"extent": self.scale.extent(plane.shape), "origin": "upper"}
        self.axes.contour(plane, levels=levels, colors=colour, **place, **style)

    def plot(self, values: FloatArray, **style: Any) -> None:
        """Plot a cut along an axis of the image."""
        self.axes.plot(np.arange(values.size) * self.scale.pixel, values, **style)

    def band(self, values: FloatArray, error: FloatArray, colour: str) -> None:
        """Fill the band within a standard deviation of a cut."""
        places = np.arange(values.size) * self.scale.pixel
        edges = np.maximum(values - error, 0), values + error
        self.axes.fill_between(places, *edges, color=colour, alpha=0.25, linewidth=0)

    def few_ticks(self) -> None:
        """Keep the tick labels apart on small panels."""
        from matplotlib.ticker import MaxNLocator

        width = float(self.axes.get_position().width * self.grid.figure_size[0])
        x_axis, y_axis = self.axes.xaxis, self.axes.yaxis
        for axis, most in ((x_axis, width / 0.5), (y_axis, self.grid.height / 0.3)):
            bins = max(2, min(6, int(most)))
            axis.set_major_locator(MaxNLocator(nbins=bins, steps=[1, 2, 5, 10]))
