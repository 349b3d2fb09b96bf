"""Whole figures: one shot on a page, or fields side by side."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import replacing
from napari_shadowinv.physics.units import ShownField, shown_fields, shown_potential
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import Panel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup

DOTS_PER_INCH = 160  # of a figure's file
_ALARM_COLOUR, _QUIET_COLOUR = "#b00020", "0.3"
_CUT_COLOURS = ("#1f9bff", "#18b368")
_REFERENCE_STYLE: dict[str, Any] = {"color": "black", "linewidth": 2.4, "alpha": 0.45}
_CAUSTIC_DENSITY = 0.15  # where a caustic is outlined
_LARGEST_INTENSITY = 3.5
_LARGEST_RESIDUAL = 50.0


def report_figure(
    inversion: Inversion, setup: Setup | None = None, *, title: str | None = None
) -> Figure:
    """Show all of one shot on a page.

    Six panels: image, potential with contours, field with arrows, re-projection, residual and
    profiles along the dashed lines on the field. White outlines are caustics.

    Parameters
    ----------
    inversion : Inversion
    setup : Setup, optional
        Gives axes in metres and the field in SI units; pixels without.
    title : str, optional
        A heading, such as the shot's name.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with an Agg canvas; write it with `save_figure`.
    """
    import matplotlib as mpl

    shape = inversion.potential.shape
    (field,) = shown_fields([inversion.displacement], setup)
    width = _panels.choose_grid(shape, panels=6).figure_size[0]
    footer = _footer(inversion, field, columns=int(width * 14))
    grid = _panels.choose_grid(shape, panels=6, foot=0.12 + 0.18 * len(footer), title=bool(title))
    with mpl.rc_context(_panels.STYLE):
        figure, panels = _panels.new_page(grid, _panels.image_scale(shape, setup), title)
        _draw_intensity(panels[0], inversion.image, "Image", inversion)
        _draw_potential(panels[1], inversion, setup)
        _draw_field(panels[2], field, inversion.caustic)
        _draw_intensity(panels[3], inversion.reprojection, "Re-projection", inversion)
        _draw_residual(panels[4], inversion)
        _draw_cuts(panels[5], field)
        _panels.write_footer(figure, footer, grid)
    return figure


def comparison_figure(
    fields: Mapping[str, ArrayLike],
    setup: Setup | None = None,
    *,
    title: str | None = None,
    caption: str = "",
) -> Figure:
    """Show fields side by side on one scale, with cuts through the first one's peak.

    Parameters
    ----------
    fields : mapping of str to array_like, shape (2, H, W)
        Displacements in px by name; the first is the reference.
    setup, title
        As for `report_figure`.
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
    grid = _panels.choose_grid(shape, panels=len(shown) + 1, foot=0.35, title=bool(title))
    with mpl.rc_context(_panels.STYLE):
        figure, panels = _panels.new_page(grid, _panels.image_scale(shape, setup), title)
        _draw_side_by_side(panels, shown)
        _panels.write_footer(figure, [(caption, _QUIET_COLOUR)], grid)
    return figure


def save_figure(path: str | Path, figure: Figure, overwrite: bool = False) -> Path:
    """Write a figure, whole or not at all, in the format of the ending (PNG, PDF, SVG).

    Returns the path. A `FileFormatError` if the file exists and `overwrite` does not allow to
    replace it, or its folder cannot be written.
    """
    with replacing(path, overwrite) as temporary:
        figure.savefig(temporary, dpi=DOTS_PER_INCH)
    return Path(path)


def _footer(inversion: Inversion, field: ShownField, columns: int) -> list[tuple[str, str]]:
    """Lines below the panels, each with its colour, wrapped to a number of letters."""
    report = inversion.report
    facts = [
        f"{report.n_sites:,} sites",
        f"flux residual {report.residual:.1e} (tolerance {report.tolerance:.0e})",
        f"{report.iterations} steps in {sum(report.seconds.values()):.1f} s",
        field.peak_text,
    ]
    share = 100 * float(inversion.caustic.mean())
    if share:
        facts.append(f"caustics (outlined) {share:.2g} % of the pixels")
    alarms = list(report.warnings)
    if not report.converged and not any("not converged" in alarm for alarm in alarms):
        alarms.insert(0, "not converged: do not trust the field")
    lines = [(line, _QUIET_COLOUR) for line in textwrap.wrap("  ·  ".join(facts), columns)]
    for alarm in alarms:
        lines += [(line, _ALARM_COLOUR) for line in textwrap.wrap(f"⚠ {alarm}", columns)]
    return lines


def _draw_intensity(panel: Panel, plane: FloatArray, title: str, inversion: Inversion) -> None:
    """Show the image, or what the answer predicts of it, on the image's scale."""
    shown = plane / inversion.source.mean()
    limits = _intensity_limits(inversion)
    panel.show(shown, title, "Intensity / mean source", "gray", limits)


def _intensity_limits(inversion: Inversion) -> tuple[float, float]:
    """Limits that neither a caustic's few bright pixels nor a faint contrast can spoil."""
    mean = inversion.source.mean()
    dark, bright = (float(p / mean) for p in np.percentile(inversion.image, (0.1, 99.7)))
    if not bright > 0:
        return 0.0, 1.0
    high = min(bright, _LARGEST_INTENSITY)
    return (dark if 0.3 * high < dark < high else 0.0), high


def _draw_potential(panel: Panel, inversion: Inversion, setup: Setup | None) -> None:
    """Show the potential with contours, and where the caustics are."""
    plane, unit = shown_potential(inversion.potential, setup)
    limits = (float(plane.min()), float(plane.max()))
    panel.show(plane, "Deflection potential", f"Potential ({unit})", "viridis", limits)
    if limits[1] > limits[0]:
        levels = np.linspace(*limits, 9)[1:-1]
        panel.contour(plane, levels, "black", linewidths=0.5, alpha=0.45)
    _outline_caustics(panel, inversion.caustic)


def _draw_field(panel: Panel, field: ShownField, caustic: BoolArray) -> None:
    """Show a field, the lines of `_draw_cuts`, and where the caustics are."""
    _draw_vectors(panel, field, field.name, _strongest(field))
    row, column = field.peak
    style: Any = {"linewidth": 1.0, "linestyle": (0, (5, 3))}
    panel.axes.axhline(row * panel.scale.pixel, color=_CUT_COLOURS[0], **style)
    panel.axes.axvline(column * panel.scale.pixel, color=_CUT_COLOURS[1], **style)
    _outline_caustics(panel, caustic)


def _strongest(field: ShownField) -> float:
    """Upper end of a colour scale, which must not be empty even if the field is."""
    return float(field.magnitude.max()) or 1.0


def _label(field: ShownField) -> str:
    return f"{field.symbol} ({field.unit})"


def _draw_vectors(panel: Panel, field: ShownField, title: str, largest: float) -> None:
    """Show a field, with arrows where it is strong enough to have a direction."""
    everywhere = field.magnitude
    panel.show(everywhere, title, _label(field), "inferno", (0.0, largest))
    height, width = everywhere.shape
    step = max(1, round(np.sqrt(height * width) / 14))
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


def _outline_caustics(panel: Panel, caustic: BoolArray) -> None:
    from scipy.ndimage import gaussian_filter

    # Noise breaks a caustic into specks; one line around them is what can be read.
    density = gaussian_filter(caustic.astype(np.float64), 1 + min(caustic.shape) / 200)
    if density.min() < _CAUSTIC_DENSITY < density.max():
        panel.contour(density, [_CAUSTIC_DENSITY], "white", linewidths=1.1)


def _draw_residual(panel: Panel, inversion: Inversion) -> None:
    """Show image minus re-projection in percent of the mean."""
    percent = 100 * inversion.residual / inversion.image[inversion.mask].mean()
    # Limits that a handful of pixels at a caustic cannot blow up.
    limit = min(float(np.percentile(np.abs(percent), 99.5)) or 1.0, _LARGEST_RESIDUAL)
    title = f"Residual: {100 * inversion.report.image_residual:.3g} % rms"
    panel.show(percent, title, "Difference (% of mean)", "RdBu_r", (-limit, limit))


def _draw_cuts(panel: Panel, field: ShownField) -> None:
    """Plot a field's magnitude along x and along y through its peak."""
    row, column = field.peak
    along_x = field.magnitude[row], f"along x, at y = {_coordinate(row, panel)}"
    along_y = field.magnitude[:, column], f"along y, at x = {_coordinate(column, panel)}"
    for (values, name), colour in zip((along_x, along_y), _CUT_COLOURS, strict=True):
        panel.plot(values, color=colour, linewidth=1.4, label=name)
    _finish_cuts(panel, field, "Cuts through the peak")


def _coordinate(index: int, panel: Panel) -> str:
    return f"{index * panel.scale.pixel:.4g} {panel.scale.unit}"


def _finish_cuts(panel: Panel, field: ShownField, title: str) -> None:
    axes = panel.axes
    axes.set_title(title)
    axes.set_xlabel(f"Position ({panel.scale.unit})")
    axes.set_ylabel(_label(field))
    axes.grid(alpha=0.25, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0)
    # Room on top for the legend, so that it never hides a curve.
    axes.set_ylim(0, 1.0 if not field.magnitude.any() else 1.38 * float(axes.dataLim.ymax))
    axes.legend(loc="upper left", frameon=False, fontsize=8, handlelength=1.6, borderaxespad=0.2)
    panel.few_ticks()


def _draw_side_by_side(panels: list[Panel], fields: Mapping[str, ShownField]) -> None:
    """Show fields on the first one's scale, and in the last panel a cut through its peak."""
    *pictures, cuts = panels
    reference = next(iter(fields.values()))
    largest = _strongest(reference)
    row, _ = reference.peak
    for panel, (name, field) in zip(pictures, fields.items(), strict=True):
        _draw_vectors(panel, field, name, largest)
        style = _REFERENCE_STYLE if field is reference else {"linewidth": 1.3}
        cuts.plot(field.magnitude[row], label=name, **style)
    _finish_cuts(cuts, reference, f"Cut at y = {_coordinate(row, cuts)}")
