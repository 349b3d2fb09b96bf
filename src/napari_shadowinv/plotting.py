"""Figures of an inversion for a logbook or a talk.

- all of one shot on a page: `report_figure`
- fields side by side on one scale: `comparison_figure`
- write a figure, whole or not at all: `save_figure`
- the field that an experimenter asks for, in a handy unit: `shown_fields`

The figures use matplotlib's objects and no pyplot, so they neither need a window nor
disturb the figures of a notebook.
"""

from __future__ import annotations

import textwrap
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = ["ShownField", "comparison_figure", "report_figure", "save_figure", "shown_fields"]

FloatArray = NDArray[np.float64]

_INTENSITY_MAP = "gray"
_POTENTIAL_MAP = "viridis"
_FIELD_MAP = "inferno"
_RESIDUAL_MAP = "RdBu_r"
_CUT_COLOURS = ("#1f9bff", "#18b368")
_CAUSTIC_COLOUR = "white"
_CAUSTIC_DENSITY = 0.15
_LARGEST_INTENSITY = 3.5
_LARGEST_RESIDUAL = 50.0
_ALARM_COLOUR = "#b00020"
_QUIET_COLOUR = "0.3"

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

_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M"}


@dataclass(frozen=True)
class _Grid:
    """Sizes in inches that put panels of one shape on a page without overlaps."""

    rows: int
    columns: int
    width: float
    height: float
    foot: float
    head: float
    left: float = 0.68
    right: float = 0.95
    below: float = 0.52
    above: float = 0.36

    @property
    def extra(self) -> float:
        """What the last panel, with the profiles, is wider than a narrow image."""
        return max(0.0, 2.5 - self.width)

    @property
    def figure_size(self) -> tuple[float, float]:
        cell_width = self.left + self.width + self.right
        cell_height = self.below + self.height + self.above
        height = self.head + self.rows * cell_height + self.foot
        return self.columns * cell_width + self.extra, height

    def box(self, index: int) -> tuple[float, float, float, float]:
        """Left, bottom, width and height of a panel as shares of the figure."""
        is_last = index == self.rows * self.columns - 1
        row, column = divmod(index, self.columns)
        total_width, total_height = self.figure_size
        left = column * (self.left + self.width + self.right) + self.left
        top = self.head + row * (self.below + self.height + self.above) + self.above
        return (
            left / total_width,
            1 - (top + self.height) / total_height,
            (self.width + is_last * self.extra) / total_width,
            self.height / total_height,
        )


def _grid(shape: tuple[int, int], panels: int, *, foot: float = 0.0, title: bool = True) -> _Grid:
    """Choose the columns for which the page is closest to a slide's 16:10."""
    aspect = shape[0] / shape[1]
    # Panels of equal area, within limits that leave room for ticks on the short side.
    width = float(np.clip(2.75 / np.sqrt(aspect), 1.2, 6.4))
    height = float(np.clip(width * aspect, 1.2, 6.4))
    grids = [
        _Grid(panels // columns, columns, width, height, foot, head=0.4 if title else 0.05)
        for columns in range(1, panels + 1)
        if panels % columns == 0
    ]
    return min(grids, key=lambda g: abs(np.log(g.figure_size[0] / g.figure_size[1] / 1.6)))


@dataclass(frozen=True)
class _Scale:
    """Lengths of the image's axes: how long a pixel is, and in which unit."""

    pixel: float
    unit: str

    def extent(self, shape: tuple[int, int]) -> tuple[float, float, float, float]:
        """Left, right, bottom and top edge, for images whose first row is on top."""
        edges = (-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5)
        left, right, bottom, top = (edge * self.pixel for edge in edges)
        return left, right, bottom, top

    def centres(self, count: int) -> FloatArray:
        return np.arange(count, dtype=np.float64) * self.pixel


def _scale(shape: tuple[int, int], setup: ProtonSetup | OpticalSetup | None) -> _Scale:
    if setup is None:
        return _Scale(1.0, "px")
    pixel = setup.object_pixel_size
    factor, prefix = _prefix(max(shape) * pixel, allowed=(-9, -6, -3, 0))
    return _Scale(pixel * factor, f"{prefix}m")


def _prefix(largest: float, allowed: Collection[int] = tuple(_PREFIXES)) -> tuple[float, str]:
    """Return the factor and the SI prefix that bring a value to 1 or more."""
    if not largest > 0 or not np.isfinite(largest):
        return 1.0, ""
    power = max((p for p in allowed if largest >= 10.0**p), default=min(allowed))
    return 10.0**-power, _PREFIXES[power]


@dataclass(frozen=True)
class ShownField:
    """A vector field in the unit that it is shown in.

    Attributes
    ----------
    vectors : ndarray, shape (2, H, W)
        Components in axis order (y, x).
    name, symbol, unit : str
        What it is.
    """

    vectors: FloatArray
    name: str
    symbol: str
    unit: str

    @property
    def magnitude(self) -> FloatArray:
        """Length of the vectors, shape (H, W)."""
        return np.sqrt(np.sum(self.vectors**2, axis=0, dtype=np.float64))

    @property
    def peak(self) -> tuple[int, int]:
        """Row and column of the strongest point."""
        row, column = np.unravel_index(np.argmax(self.magnitude), self.magnitude.shape)
        return int(row), int(column)

    @property
    def peak_text(self) -> str:
        """The largest magnitude in words, path-integrated fields in MG·µm, too."""
        largest = float(self.magnitude.max())
        text = f"peak {self.symbol} {largest:.3g} {self.unit}"
        if not self.unit.endswith("T·m"):
            return text
        prefix = self.unit.removesuffix("T·m")
        power = next(power for power, name in _PREFIXES.items() if name == prefix)
        return f"{text} ({largest * 10.0**power / 1e-4:.3g} MG·µm)"


def shown_fields(
    displacements: Collection[FloatArray], setup: ProtonSetup | OpticalSetup | None
) -> list[ShownField]:
    """Turn displacements into what an experimenter asks for, in one unit for all.

    Parameters
    ----------
    displacements : collection of ndarray, shape (2, H, W)
        Displacements in px.
    setup : ProtonSetup or OpticalSetup or None
        With it, the path-integrated magnetic field of particles, or the deflection angle of
        light; without, the displacement in px.

    Returns
    -------
    list of ShownField
        One for each displacement.
    """
    if setup is None:
        return [ShownField(d, "Displacement", "|d|", "px") for d in displacements]
    if setup.kind == "proton":
        fields = [setup.path_integrated_b(d) for d in displacements]
        name, symbol, unit = "Path-integrated field", "|∫B×dz|", "T·m"
    else:
        fields = [setup.deflection_angle(d) for d in displacements]
        name, symbol, unit = "Deflection angle", "|α|", "rad"
    factor, prefix = _prefix(max(float(np.hypot(*field).max()) for field in fields))
    return [ShownField(field * factor, name, symbol, f"{prefix}{unit}") for field in fields]


def report_figure(
    inversion: Inversion,
    setup: ProtonSetup | OpticalSetup | None = None,
    *,
    title: str | None = None,
) -> Figure:
    """Show all of one shot on a page.

    Six panels: image, potential with contours, field with arrows, re-projection, residual
    and profiles. The profiles are cuts along the dashed lines on the field. White outlines
    on potential and field are caustics.

    Parameters
    ----------
    inversion : Inversion
        The result.
    setup : ProtonSetup or OpticalSetup, optional
        Gives axes in metres and the field in SI units; pixels without.
    title : str, optional
        A heading, such as the shot's name.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with an Agg canvas; write it with `save_figure`.
    """
    import matplotlib as mpl

    shape = _shape(inversion.potential)
    (field,) = shown_fields([inversion.displacement], setup)
    scale = _scale(shape, setup)
    width = _grid(shape, panels=6).figure_size[0]
    footer = _footer(inversion, field, columns=int(width * 14))
    grid = _grid(shape, panels=6, foot=0.12 + 0.18 * len(footer), title=bool(title))
    with mpl.rc_context(_STYLE):
        figure = _new_figure(grid, title)
        panels = [_Panel(figure.add_axes(grid.box(index)), scale, grid) for index in range(6)]
        _draw_image(panels[0], inversion)
        _draw_potential(panels[1], inversion, setup)
        _draw_field(panels[2], field, inversion.caustic)
        _draw_reprojection(panels[3], inversion)
        _draw_residual(panels[4], inversion)
        _draw_cuts(panels[5], field)
        _write_footer(figure, footer, grid)
    return figure


def comparison_figure(
    fields: Mapping[str, ArrayLike],
    setup: ProtonSetup | OpticalSetup | None = None,
    *,
    title: str | None = None,
    caption: str = "",
) -> Figure:
    """Show fields side by side on one scale, with cuts through the first one's peak.

    Parameters
    ----------
    fields : mapping of str to array_like, shape (2, H, W)
        Displacements in px by name; the first is the reference.
    setup : ProtonSetup or OpticalSetup, optional
        Gives axes in metres and the field in SI units; pixels without.
    title : str, optional
        A heading.
    caption : str
        A line below.

    Returns
    -------
    matplotlib.figure.Figure
        One panel for each field and one with the profiles.

    Raises
    ------
    InputError
        If there is no field or their shapes differ.
    """
    import matplotlib as mpl

    arrays = [np.asarray(values, dtype=np.float64) for values in fields.values()]
    shapes = sorted({array.shape for array in arrays})
    if len(shapes) != 1:
        raise InputError(f"fields have shapes {shapes}: expected one or more of the same shape")
    shown = dict(zip(fields, shown_fields(arrays, setup), strict=True))
    shape = shapes[0][1], shapes[0][2]
    grid = _grid(shape, panels=len(shown) + 1, foot=0.35, title=bool(title))
    scale = _scale(shape, setup)
    with mpl.rc_context(_STYLE):
        figure = _new_figure(grid, title)
        boxes = [grid.box(index) for index in range(len(shown) + 1)]
        panels = [_Panel(figure.add_axes(box), scale, grid) for box in boxes]
        _draw_side_by_side(panels, shown)
        _write_footer(figure, [(caption, _QUIET_COLOUR)], grid)
    return figure


def save_figure(path: str | Path, figure: Figure, overwrite: bool = False) -> Path:
    """Write a figure, whole or not at all.

    Parameters
    ----------
    path : str or Path
        The file; its ending chooses the format (PNG, PDF, SVG).
    figure : matplotlib.figure.Figure
        What to write.
    overwrite : bool
        Whether an existing file may be replaced.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    FileFormatError
        If the file exists and must not be replaced, or its folder cannot be written.
    """
    with replacing(path, overwrite) as temporary:
        figure.savefig(temporary, dpi=160)
    return Path(path)


def _shape(plane: NDArray[Any]) -> tuple[int, int]:
    height, width = plane.shape
    return height, width


def _new_figure(grid: _Grid, title: str | None) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=grid.figure_size)
    FigureCanvasAgg(figure)
    if title:
        width, height = grid.figure_size
        figure.text(0.2 / width, 1 - 0.26 / height, title, size=13, weight="bold", va="center")
    return figure


@dataclass(frozen=True)
class _Panel:
    """Axes with room for a colour bar on their right."""

    axes: Axes
    scale: _Scale
    grid: _Grid

    def show(
        self, plane: FloatArray, title: str, label: str, cmap: str, limits: tuple[float, float]
    ) -> None:
        picture = self.axes.imshow(
            plane,
            extent=self.scale.extent(_shape(plane)),
            cmap=cmap,
            vmin=limits[0],
            vmax=limits[1],
            # Smoothing would hide single bad pixels.
            interpolation="nearest",
            aspect="equal",
        )
        self.axes.set_title(title)
        self._label_axes()
        self._add_colour_bar(picture, label, _extend(plane, limits))

    def contour(self, plane: NDArray[Any], levels: ArrayLike, colour: str, **style: Any) -> None:
        self.axes.contour(
            plane,
            levels=levels,
            extent=self.scale.extent(_shape(plane)),
            origin="upper",
            colors=colour,
            **style,
        )

    @property
    def width(self) -> float:
        """Width in inches."""
        return float(self.axes.get_position().width * self.grid.figure_size[0])

    def few_ticks(self) -> None:
        from matplotlib.ticker import MaxNLocator

        for axis, length in (
            (self.axes.xaxis, self.width / 0.5),
            (self.axes.yaxis, self.grid.height / 0.3),
        ):
            bins = max(2, min(6, int(length)))
            axis.set_major_locator(MaxNLocator(nbins=bins, steps=[1, 2, 5, 10]))

    def _label_axes(self) -> None:
        self.axes.set_xlabel(f"x ({self.scale.unit})")
        self.axes.set_ylabel(f"y ({self.scale.unit})")
        self.few_ticks()

    def _add_colour_bar(self, picture: Any, label: str, extend: str) -> None:
        room = self.axes.inset_axes((1 + 0.08 / self.grid.width, 0, 0.12 / self.grid.width, 1))
        bar = self.axes.figure.colorbar(picture, cax=room, extend=extend)
        bar.set_label(label)
        bar.outline.set_linewidth(0.7)


def _extend(plane: FloatArray, limits: tuple[float, float]) -> str:
    below, above = bool(plane.min() < limits[0]), bool(plane.max() > limits[1])
    if below and above:
        return "both"
    return "min" if below else "max" if above else "neither"


def _draw_image(panel: _Panel, inversion: Inversion) -> None:
    plane = inversion.image / inversion.source.mean()
    panel.show(
        plane, "Image", "Intensity / mean source", _INTENSITY_MAP, _intensity_limits(inversion)
    )


def _draw_reprojection(panel: _Panel, inversion: Inversion) -> None:
    plane = inversion.reprojection / inversion.source.mean()
    limits = _intensity_limits(inversion)
    panel.show(plane, "Re-projection", "Intensity / mean source", _INTENSITY_MAP, limits)


def _intensity_limits(inversion: Inversion) -> tuple[float, float]:
    """Limits that neither a caustic's few bright pixels nor a faint contrast can spoil."""
    mean = inversion.source.mean()
    dark, bright = (float(p / mean) for p in np.percentile(inversion.image, (0.1, 99.7)))
    if not bright > 0:
        return 0.0, 1.0
    high = min(bright, _LARGEST_INTENSITY)
    return (dark if 0.3 * high < dark < high else 0.0), high


def _draw_potential(
    panel: _Panel, inversion: Inversion, setup: ProtonSetup | OpticalSetup | None
) -> None:
    plane, unit = _shown_potential(inversion.potential, setup)
    limits = (float(plane.min()), float(plane.max()))
    panel.show(plane, "Deflection potential", f"Potential ({unit})", _POTENTIAL_MAP, limits)
    if limits[1] > limits[0]:
        levels = np.linspace(*limits, 9)[1:-1]
        panel.contour(plane, levels, "black", linewidths=0.5, alpha=0.45)
    _outline_caustics(panel, inversion.caustic)


def _shown_potential(
    potential: FloatArray, setup: ProtonSetup | OpticalSetup | None
) -> tuple[FloatArray, str]:
    if setup is None:
        return potential, "px²"
    metres = setup.potential(potential)
    factor, prefix = _prefix(float(np.abs(metres).max()))
    return metres * factor, f"{prefix}m"


def _draw_field(panel: _Panel, field: ShownField, caustic: NDArray[np.bool_]) -> None:
    magnitude = field.magnitude
    limits = (0.0, float(magnitude.max()) or 1.0)
    panel.show(magnitude, field.name, f"{field.symbol} ({field.unit})", _FIELD_MAP, limits)
    _draw_arrows(panel, field)
    row, column = field.peak
    style: dict[str, Any] = {"linewidth": 1.0, "linestyle": (0, (5, 3))}
    panel.axes.axhline(row * panel.scale.pixel, color=_CUT_COLOURS[0], **style)
    panel.axes.axvline(column * panel.scale.pixel, color=_CUT_COLOURS[1], **style)
    _outline_caustics(panel, caustic)


def _draw_arrows(panel: _Panel, field: ShownField, across: int = 14) -> None:
    """Show the direction where the field is strong enough to have one."""
    everywhere = field.magnitude
    height, width = everywhere.shape
    step = max(1, round(np.sqrt(height * width) / across))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    strong = everywhere[rows, columns] > 0.15 * everywhere.max()
    if not strong.any():
        return
    rows, columns = rows[strong], columns[strong]
    share = everywhere[rows, columns] / everywhere.max()
    pixel = panel.scale.pixel
    # A square root keeps weak arrows long enough to see where they point.
    length = 0.8 * step * pixel * np.sqrt(share)
    direction = field.vectors[:, rows, columns] / everywhere[rows, columns]
    panel.axes.quiver(
        columns * pixel,
        rows * pixel,
        direction[1] * length,
        direction[0] * length,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        pivot="mid",
        color="white",
        alpha=0.7,
        units="inches",
        width=0.011,
        headwidth=4,
        headlength=4.5,
        headaxislength=4,
    )


def _outline_caustics(panel: _Panel, caustic: NDArray[np.bool_]) -> None:
    from scipy.ndimage import gaussian_filter

    # Noise breaks a caustic into specks; one line around them is what can be read.
    density = gaussian_filter(caustic.astype(np.float64), 1 + min(caustic.shape) / 200)
    if density.min() < _CAUSTIC_DENSITY < density.max():
        panel.contour(density, [_CAUSTIC_DENSITY], _CAUSTIC_COLOUR, linewidths=1.1)


def _draw_residual(panel: _Panel, inversion: Inversion) -> None:
    percent = 100 * inversion.residual / inversion.source.mean()
    # Limits that a handful of pixels at a caustic cannot blow up.
    limit = min(float(np.percentile(np.abs(percent), 99.5)) or 1.0, _LARGEST_RESIDUAL)
    rms = float(np.sqrt(np.mean(percent**2)))
    panel.show(
        percent,
        f"Residual: {rms:.2g} % rms",
        "Difference (% of mean)",
        _RESIDUAL_MAP,
        (-limit, limit),
    )


def _draw_cuts(panel: _Panel, field: ShownField) -> None:
    row, column = field.peak
    along_x, along_y = field.magnitude[row], field.magnitude[:, column]
    for values, colour, name in (
        (along_x, _CUT_COLOURS[0], f"along x, at y = {_coordinate(row, panel.scale)}"),
        (along_y, _CUT_COLOURS[1], f"along y, at x = {_coordinate(column, panel.scale)}"),
    ):
        panel.axes.plot(
            panel.scale.centres(values.size), values, color=colour, linewidth=1.4, label=name
        )
    _finish_cuts(panel, field, "Cuts through the peak")


def _coordinate(index: int, scale: _Scale) -> str:
    return f"{index * scale.pixel:.4g} {scale.unit}"


def _finish_cuts(panel: _Panel, field: ShownField, title: str) -> None:
    axes = panel.axes
    axes.set_title(title)
    axes.set_xlabel(f"Position ({panel.scale.unit})")
    axes.set_ylabel(f"{field.symbol} ({field.unit})")
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0)
    # Room on top for the legend, so that it never hides a curve.
    axes.set_ylim(0, 1.0 if not field.magnitude.any() else 1.38 * float(axes.dataLim.ymax))
    axes.legend(loc="upper left", frameon=False, fontsize=8, handlelength=1.6, borderaxespad=0.2)
    panel.few_ticks()


def _draw_side_by_side(panels: list[_Panel], fields: Mapping[str, ShownField]) -> None:
    reference = next(iter(fields.values()))
    limits = (0.0, float(reference.magnitude.max()) or 1.0)
    row, _ = reference.peak
    cuts = panels[-1]
    for panel, (name, field) in zip(panels[:-1], fields.items(), strict=True):
        label = f"{field.symbol} ({field.unit})"
        panel.show(field.magnitude, name, label, _FIELD_MAP, limits)
        _draw_arrows(panel, field)
        cuts.axes.plot(
            cuts.scale.centres(field.magnitude.shape[1]),
            field.magnitude[row],
            label=name,
            color="black" if field is reference else None,
            linewidth=2.4 if field is reference else 1.3,
            alpha=0.45 if field is reference else 1.0,
        )
    _finish_cuts(cuts, reference, f"Cut at y = {_coordinate(row, cuts.scale)}")


def _footer(inversion: Inversion, field: ShownField, columns: int) -> list[tuple[str, str]]:
    """Lines below the panels, each with its colour, wrapped to a number of letters."""
    report = inversion.report
    facts = [
        f"{report.n_sites:,} sites",
        f"flux residual {report.residual:.1e} (asked for {report.tolerance:.0e})",
        f"{report.iterations} steps in {sum(report.seconds.values()):.1f} s",
        field.peak_text,
    ]
    share = 100 * float(inversion.caustic.mean())
    if share:
        facts.append(f"caustics (outlined) {share:.2g} % of the pixels")
    alarms = list(report.warnings)
    if not report.converged and not any("not converged" in alarm for alarm in alarms):
        alarms.insert(0, "not converged: the field is not to be trusted")
    lines = [(line, _QUIET_COLOUR) for line in textwrap.wrap("  ·  ".join(facts), columns)]
    for alarm in alarms:
        lines += [(line, _ALARM_COLOUR) for line in textwrap.wrap(f"⚠ {alarm}", columns)]
    return lines


def _write_footer(figure: Figure, lines: list[tuple[str, str]], grid: _Grid) -> None:
    width, height = grid.figure_size
    for number, (text, colour) in enumerate(reversed(lines)):
        y = (0.1 + 0.18 * number) / height
        figure.text(0.2 / width, y, text, size=8.5, color=colour, va="bottom")
