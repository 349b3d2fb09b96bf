"""Whole figures: any result or one shot on a page, or fields side by side."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import ResultKind
from napari_shadowinv.io.files import replacing
from napari_shadowinv.physics.units import intensity_limits, shown_fields
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._film_figure import pack_figure
from napari_shadowinv.plotting._fit_figure import fit_figure
from napari_shadowinv.plotting._panels import QUIET_COLOUR, draw_side_by_side

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.results import AnyResult

DOTS_PER_INCH = 160  # of a figure's file


def report_figure(inversion: Inversion, *, title: str | None = None) -> Figure:
    """Show all of one shot on a page.

    Six panels: image, potential with contours, field with arrows, re-projection, residual and
    profiles along the dashed lines on the field. White outlines are caustics; masked pixels are
    hatched. The headline stands above the panels.
    """
    shape, setup = inversion.potential.shape, inversion.setup
    (field,) = shown_fields([inversion.displacement], setup, mask=inversion.mask)
    headline, facts = inversion.headline, inversion.facts
    with _panels.shot_page(shape, setup, title, headline, facts) as (figure, panels):
        mean = float(inversion.source.mean())
        limits = intensity_limits(inversion.image / mean)

        def blank_masked(plane: FloatArray) -> FloatArray:
            return np.where(inversion.mask, plane, np.nan)

        panels[0].draw_intensity(blank_masked(inversion.image / mean), "Image", limits)
        panels[1].draw_potential(blank_masked(inversion.potential), setup)
        panels[1].outline_caustics(inversion.caustic)
        panels[2].draw_field(field)
        panels[2].hatch_insignificant(inversion.structures)
        panels[2].outline_caustics(inversion.caustic)
        reprojection = blank_masked(inversion.reprojection / mean)
        panels[3].draw_intensity(reprojection, "Re-projection", limits)
        fact = next(fact for fact in facts if fact.key == "image_residual")
        residual = 100 * blank_masked(inversion.residual) / inversion.image[inversion.mask].mean()
        label = "Difference (% of mean)"
        panels[4].draw_differences(residual, fact.short.capitalize(), label, 50.0)
        panels[5].draw_cuts(field)
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
        Gives axes in metres and fields in SI units; pixels without.
    title, caption : str
        A heading, and a line below.

    Raises
    ------
    InputError
        If there is no field or their shapes differ.
    """
    arrays = [np.asarray(values, dtype=np.float64) for values in fields.values()]
    shapes = sorted({array.shape for array in arrays})
    if len(shapes) != 1:
        raise InputError(f"fields have shapes {shapes}: expected one or more of the same shape")
    in_units = dict(zip(fields, shown_fields(arrays, setup), strict=True))
    shape = shapes[0][1:]
    grid = _panels.choose_grid(shape, panels=len(in_units) + 1, foot=0.35, title=bool(title))
    grid = replace(grid, foot=grid.foot - grid.line)
    scale, footer = _panels.image_scale(shape, setup), [(caption, QUIET_COLOUR)]
    with _panels.new_page(grid, scale, title, footer=footer) as (figure, panels):
        draw_side_by_side(panels, in_units)
    return figure


def result_figure(result: AnyResult, *, title: str | None = None) -> Figure:
    """Show an inversion, a fit or a film pack on a page; an `InputError` refuses a field alone."""
    figures: dict[ResultKind, Callable[..., Figure]] = {
        ResultKind.INVERSION: report_figure,
        ResultKind.FIT: fit_figure,
        ResultKind.FILM_DOSES: pack_figure,
    }
    if result.kind not in figures:
        raise InputError(f"received a {result.kind.noun} without images: expected a whole result")
    return figures[result.kind](result, title=title)


def save_figure(path: str | Path, figure: Figure, overwrite: bool = False) -> Path:
    """Write a figure, whole or not at all, in the format of the ending (PNG, PDF, SVG).

    Returns the path. A `FileFormatError` if the file exists and `overwrite` does not allow to
    replace it, or its folder cannot be written.
    """
    with replacing(path, overwrite) as temporary, _panels.own_style():
        figure.savefig(temporary, dpi=DOTS_PER_INCH)
    return Path(path)
