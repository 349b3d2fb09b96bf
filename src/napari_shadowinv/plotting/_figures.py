"""Whole figures: one shot on a page, or fields side by side."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import replacing
from napari_shadowinv.physics.units import ShownField, shown_fields
from napari_shadowinv.plotting._drawing import (
    draw_cuts,
    draw_field,
    draw_intensity,
    draw_potential,
    draw_residual,
    draw_side_by_side,
)
from napari_shadowinv.plotting._panels import (
    STYLE,
    choose_grid,
    image_scale,
    new_page,
    write_footer,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup

DOTS_PER_INCH = 160  # of a figure's file
_ALARM_COLOUR = "#b00020"
_QUIET_COLOUR = "0.3"


def report_figure(
    inversion: Inversion,
    setup: Setup | None = None,
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
    width = choose_grid(shape, panels=6).figure_size[0]
    footer = _footer(inversion, field, columns=int(width * 14))
    grid = choose_grid(shape, panels=6, foot=0.12 + 0.18 * len(footer), title=bool(title))
    with mpl.rc_context(STYLE):
        figure, panels = new_page(grid, image_scale(shape, setup), title)
        draw_intensity(panels[0], inversion.image, "Image", inversion)
        draw_potential(panels[1], inversion, setup)
        draw_field(panels[2], field, inversion.caustic)
        draw_intensity(panels[3], inversion.reprojection, "Re-projection", inversion)
        draw_residual(panels[4], inversion)
        draw_cuts(panels[5], field)
        write_footer(figure, footer, grid)
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
    setup : Setup, optional
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
    grid = choose_grid(shape, panels=len(shown) + 1, foot=0.35, title=bool(title))
    with mpl.rc_context(STYLE):
        figure, panels = new_page(grid, image_scale(shape, setup), title)
        draw_side_by_side(panels, shown)
        write_footer(figure, [(caption, _QUIET_COLOUR)], grid)
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
