"""A page of panels: their layout, and the drawing of each: an image, a field, a residual, cuts."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import CAUTION_CODES
from napari_shadowinv.facts import Fact, Headline, Level
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.significance import LEVEL, Structures
from napari_shadowinv.physics.units import ShownField, prefix_for, shown_potential

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_CUT_COLOURS = ("#1f9bff", "#18b368")
_REFERENCE_STYLE: dict[str, Any] = {"color": "black", "linewidth": 2.4, "alpha": 0.45}


ALARM_COLOUR, GOOD_COLOUR, QUIET_COLOUR = "#b35c00", "#1b6e3c", "0.3"
LEVEL_COLOURS = {
    Level.SOUND: GOOD_COLOUR,
    Level.CONDITIONAL: "#1f4e79",
    Level.DOUBTFUL: ALARM_COLOUR,
    Level.FAILED: "#b00020",
}
_STYLE: Any = {
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

    def extent(self, shape: Sequence[int]) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge, for images whose first row is on top."""
        edges = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
        x_min, x_max, y_max, y_min = (edge * self.pixel for edge in edges)
        return x_min, x_max, y_max, y_min


def image_scale(shape: Sequence[int], setup: Setup | None) -> Scale:
    """Metres at the object with a setup, pixels without."""
    if setup is None:
        return Scale(1.0, "px")
    pixel = setup.object_pixel_size
    factor, prefix = prefix_for(max(shape) * pixel, allowed=(-9, -6, -3, 0))
    return Scale(pixel * factor, f"{prefix}m")


@dataclass(frozen=True)
class PanelGrid:
    """Sizes in inches that put panels of one shape on a page without overlaps.

    Lines of a header or footer add to `head` and `foot`.
    """

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
    line: float = 0.18  # of a header or footer

    @property
    def extra(self) -> float:
        """Extra width of the last panel, with the profiles, compared with a narrow image."""
        return max(0.0, 2.5 - self.width)

    @property
    def letters(self) -> int:
        """Letters that fit on a line of a header or footer."""
        return int(self.figure_size[0] * 13)

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
    shape: Sequence[int], panels: int, *, foot: float = 0, title: bool = True
) -> PanelGrid:
    """Choose the columns for which the page is closest to a slide's 16:10."""
    width, height = panel_size(shape)
    grids = [
        PanelGrid(panels // columns, columns, width, height, foot, head=0.4 if title else 0.05)
        for columns in range(1, panels + 1)
        if panels % columns == 0
    ]
    return min(grids, key=lambda g: abs(np.log(g.figure_size[0] / g.figure_size[1] / 1.6)))


def panel_size(shape: Sequence[int]) -> tuple[float, float]:
    """Width and height in inches: panels of equal area, with room for ticks on the short side."""
    aspect = shape[0] / shape[1]
    width = float(np.clip(2.75 / np.sqrt(aspect), 1.2, 6.4))
    return width, float(np.clip(width * aspect, 1.2, 6.4))


@contextmanager
def own_style(style: Any = _STYLE) -> Iterator[None]:
    """Draw, or save, in the style of all pages, whatever the user's matplotlibrc says."""
    from matplotlib import rc_context, rcdefaults, rcParams

    with rc_context():
        rcdefaults()
        rcParams.update(style)
        yield


@contextmanager
def styled_figure(size: tuple[float, float], **layout: Any) -> Iterator[Figure]:
    """Yield an empty figure with an Agg canvas, to be drawn in the style of all pages."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with own_style():
        figure = Figure(figsize=size, **layout)
        FigureCanvasAgg(figure)
        yield figure


@contextmanager
def new_page(
    grid: PanelGrid,
    scale: Scale,
    title: str | None,
    header: Sequence[tuple[str, str]] = (),
    footer: Sequence[tuple[str, str]] = (),
) -> Iterator[tuple[Figure, list[Panel]]]:
    """Yield a figure with its empty panels, between lines of text, each with its colour."""
    top = grid.head - 0.08
    head, foot = grid.head + grid.line * len(header), grid.foot + grid.line * len(footer)
    grid = replace(grid, head=head, foot=foot)
    width, height = grid.figure_size
    with styled_figure(grid.figure_size) as figure:
        if title:
            figure.text(0.2 / width, 1 - 0.26 / height, title, size=13, weight="bold", va="center")
        for number, (text, colour) in enumerate(header):
            y = 1 - (top + grid.line * number) / height
            figure.text(0.2 / width, y, text, size=10, color=colour, va="top")
        boxes = [grid.box(index) for index in range(grid.rows * grid.columns)]
        yield figure, [Panel(figure.add_axes(box), scale, grid) for box in boxes]
        for number, (text, colour) in enumerate(reversed(footer)):
            y = (0.1 + grid.line * number) / height
            figure.text(0.2 / width, y, text, size=8.5, color=colour, va="bottom")


def wrapped(sentences: Iterable[tuple[str, str]], letters: int) -> list[tuple[str, str]]:
    """Wrap sentences, each with its colour, to lines of a number of letters."""
    return [(line, colour) for text, colour in sentences for line in textwrap.wrap(text, letters)]


def headline_sentence(headline: Headline) -> tuple[str, str]:
    """Return a headline with the colour of its level."""
    return str(headline), LEVEL_COLOURS[headline.level]


_LEGENDS = {"masked": " (hatched)", "caustics": " (outlined)", "crossed_rays": " (outlined)"}


def fact_line(facts: Iterable[Fact]) -> str:
    """Return facts as one line of text, to be wrapped."""
    return "  ·  ".join(f"{fact.title}{_LEGENDS.get(fact.key, '')}: {fact.text}" for fact in facts)


def footer_lines(facts: Iterable[Fact], headline: str, letters: int) -> list[tuple[str, str]]:
    """Return the facts that a headline does not contain as lines; long ones have their own."""
    shown = [
        fact
        for fact in facts
        if fact.key in _LEGENDS
        or not (fact.is_detail or fact.key == "verdict" or fact.text in headline)
    ]
    warnings = [
        fact for fact in shown if fact.key in CAUTION_CODES or fact.level is not Level.SOUND
    ]
    quiet = [fact for fact in shown if fact not in warnings]
    is_long = {fact: len(fact.text) > letters // 2 for fact in quiet}
    paragraphs = [(fact_line([fact]), ALARM_COLOUR) for fact in warnings]
    paragraphs.append((fact_line(fact for fact in quiet if not is_long[fact]), QUIET_COLOUR))
    paragraphs += [(fact_line([fact]), QUIET_COLOUR) for fact in quiet if is_long[fact]]
    return wrapped(paragraphs, letters)


def shot_page(
    shape: Sequence[int],
    setup: Setup | None,
    title: str | None,
    headline: Headline,
    facts: Iterable[Fact] = (),
) -> AbstractContextManager[tuple[Figure, list[Panel]]]:
    """Return a page of six panels of one shot, below its headline and above its facts."""
    width = choose_grid(shape, panels=6).figure_size[0]
    header = wrapped([headline_sentence(headline)], int(width * 12))
    footer = footer_lines(facts, headline.text, int(width * 14))
    grid = choose_grid(shape, panels=6, foot=0.12 + 0.18 * len(footer), title=bool(title))
    grid = replace(grid, head=0.52 if title else 0.22, foot=0.12)
    return new_page(grid, image_scale(shape, setup), title, header, footer)


@dataclass(frozen=True)
class Panel:
    """Axes with room for a colour bar on their right."""

    axes: Axes
    scale: Scale
    grid: PanelGrid

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

    def few_ticks(self) -> None:
        """Keep the tick labels apart on small panels."""
        from matplotlib.ticker import MaxNLocator

        width = float(self.axes.get_position().width * self.grid.figure_size[0])
        x_axis, y_axis = self.axes.xaxis, self.axes.yaxis
        for axis, most in ((x_axis, width / 0.5), (y_axis, self.grid.height / 0.3)):
            bins = max(2, min(6, int(most)))
            axis.set_major_locator(MaxNLocator(nbins=bins, steps=[1, 2, 5, 10]))

    def draw_intensity(
        self,
        plane: FloatArray,
        title: str,
        limits: tuple[float, float],
        label: str = "Intensity / mean source",
    ) -> None:
        """Show an image, or its prediction, in units of the mean source."""
        self.show(plane, title, label, "gray", limits)

    def draw_potential(self, potential: FloatArray, setup: Setup | None) -> None:
        """Show a potential with contours."""
        plane, unit = shown_potential(potential, setup)
        limits = (float(np.nanmin(plane)), float(np.nanmax(plane)))
        self.show(plane, "Deflection potential", f"Potential ({unit})", "viridis", limits)
        if limits[1] > limits[0]:
            self.contour(plane, np.linspace(*limits, 9)[1:-1], "black", linewidths=0.5, alpha=0.45)

    def draw_differences(self, plane: FloatArray, title: str, label: str, largest: float) -> None:
        """Show differences in red and blue, up to `largest`."""
        # Limits that a handful of pixels at a caustic cannot blow up.
        limit = min(float(np.nanpercentile(np.abs(plane), 99.5)) or 1.0, largest)
        self.show(plane, title, label, "RdBu_r", (-limit, limit))

    def draw_field(self, field: ShownField, title: str = "") -> None:
        """Show a field, and the lines of `draw_cuts`."""
        self.draw_vectors(field, title or field.name, field.largest or 1.0)
        row, column = field.peak
        style: Any = {"linewidth": 1.0, "linestyle": (0, (5, 3))}
        self.axes.axhline(row * self.scale.pixel, color=_CUT_COLOURS[0], **style)
        self.axes.axvline(column * self.scale.pixel, color=_CUT_COLOURS[1], **style)

    def draw_vectors(self, field: ShownField, title: str, largest: float) -> None:
        """Show a field, with arrows where it is strong enough to have a direction."""
        everywhere = field.magnitude
        self.show(everywhere, title, f"{field.symbol} ({field.unit})", "inferno", (0.0, largest))
        height, width = everywhere.shape
        step = max(1, round(np.sqrt(height * width) / 14))
        rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
        strong = everywhere[rows, columns] > 0.15 * field.largest
        if not strong.any():
            return
        rows, columns = rows[strong], columns[strong]
        share = everywhere[rows, columns] / field.largest
        pixel = self.scale.pixel
        # A square root keeps weak arrows long enough to see where they point.
        length = 0.8 * step * pixel * np.sqrt(share)
        dy, dx = field.vectors[:, rows, columns] / everywhere[rows, columns] * length
        size: Any = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "units": "inches"}
        head: Any = {"width": 0.011, "headwidth": 4, "headlength": 4.5, "headaxislength": 4}
        style: Any = {"pivot": "mid", "color": "white", "alpha": 0.7}
        self.axes.quiver(columns * pixel, rows * pixel, dx, dy, **size, **head, **style)

    def hatch_insignificant(self, structures: Structures | None) -> None:
        """Hatch the pixels outside structures thinly, and say so in the lower left corner."""
        from matplotlib.colors import to_rgba

        if structures is None:
            return
        outside = structures.labels == 0
        text = f"all above {LEVEL:g} σ"
        if outside.any():
            place: Any = {"extent": self.scale.extent(outside.shape), "origin": "upper"}
            filled: Any = self.axes.contourf(
                outside.astype(np.float64), [0.5, 1.5], colors="none", hatches=["///"], **place
            )
            filled.set(edgecolor=to_rgba("white", 0.28), linewidth=0.0)
            text = f"hatched: no structure above {LEVEL:g} σ"
        box = {"facecolor": "black", "alpha": 0.6, "linewidth": 0, "boxstyle": "square,pad=0.25"}
        style: Any = {"transform": self.axes.transAxes, "fontsize": 7, "color": "white"}
        self.axes.text(0.02, 0.02, text, bbox=box, va="bottom", zorder=5, **style)

    def outline_caustics(self, caustic: BoolArray, *, level: float = 0.15) -> None:
        """Draw a line around the caustics."""
        from scipy.ndimage import gaussian_filter

        # Noise breaks a caustic into specks; one line around them is readable.
        density = gaussian_filter(caustic.astype(np.float64), 1 + min(caustic.shape) / 200)
        if density.min() < level < density.max():
            self.contour(density, [level], "white", linewidths=1.1)

    def draw_cuts(self, field: ShownField, error: FloatArray | None = None) -> None:
        """Plot a field's magnitude along x and along y through its peak, with its error's band."""
        row, column = field.peak
        lines: dict[str, Any] = {
            f"along x, at y = {self.coordinate(row)}": np.s_[row, :],
            f"along y, at x = {self.coordinate(column)}": np.s_[:, column],
        }
        for (name, line), colour in zip(lines.items(), _CUT_COLOURS, strict=True):
            values = field.magnitude[line]
            places = np.arange(values.size) * self.scale.pixel
            self.axes.plot(places, values, color=colour, linewidth=1.4, label=name)
            if error is not None:
                edges = np.maximum(values - error[line], 0), values + error[line]
                self.axes.fill_between(places, *edges, color=colour, alpha=0.25, linewidth=0)
        self.finish_cuts(field, "Cuts through the peak")

    def coordinate(self, index: int) -> str:
        """Return the place of a row or column in words."""
        return f"{index * self.scale.pixel:.4g} {self.scale.unit}"

    def finish_cuts(self, field: ShownField, title: str) -> None:
        """Add titles and a legend to cuts through a field."""
        axes = self.axes
        axes.set_title(title)
        axes.set_xlabel(f"Position ({self.scale.unit})")
        axes.set_ylabel(f"{field.symbol} ({field.unit})")
        axes.grid(alpha=0.25, linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.margins(x=0)
        # Room on top for the legend, so that it never hides a curve.
        axes.set_ylim(0, 1.0 if not field.largest else 1.38 * float(axes.dataLim.ymax))
        axes.legend(
            loc="upper left", frameon=False, fontsize=8, handlelength=1.6, borderaxespad=0.2
        )
        self.few_ticks()


def draw_side_by_side(
    panels: list[Panel], fields: Mapping[str, ShownField], *, common: bool = False
) -> None:
    """Show fields on the first one's scale, and in the last panel a cut through its peak.

    A `common` scale is set by the strongest field.
    """
    *pictures, cuts = panels
    reference = next(iter(fields.values()))
    # A colour scale must not be empty even if a field is.
    largest = max(each.largest or 1.0 for each in (fields.values() if common else [reference]))
    row, _ = reference.peak
    places = np.arange(reference.magnitude.shape[1]) * cuts.scale.pixel
    for panel, (name, field) in zip(pictures, fields.items(), strict=True):
        panel.draw_vectors(field, name, largest)
        style = _REFERENCE_STYLE if field is reference else {"linewidth": 1.3}
        cuts.axes.plot(places, field.magnitude[row], label=name, **style)
    cuts.finish_cuts(reference, f"Cut at y = {cuts.coordinate(row)}")
