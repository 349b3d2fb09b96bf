"""A fit on a page: its images and how they are explained, its fields, its verdict."""

from __future__ import annotations

import textwrap
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Fact, Level
from napari_shadowinv.fitting import Fit, FittedField
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.physics.setup import deflector_titles
from napari_shadowinv.physics.units import ShownField, intensity_limits, shown_fields
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import (
    ALARM_COLOUR,
    GOOD_COLOUR,
    Grid,
    Panel,
    draw_cuts,
    draw_differences,
    draw_field,
    draw_intensity,
    draw_potential,
    outline_caustics,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_MAX_ROWS = 3  # up to this number of images, each has a row; more have a column each
_UNIFORM_TOLERANCE = 1e-6
_MAX_RESIDUAL_SIGMA = 20.0
_LETTERS_PER_INCH = 13  # of the header


def fit_figure(fit: Fit, *, title: str | None = None) -> Figure:
    """Show a whole fit on a page, with its verdict on top.

    For each image: the beam unless it is uniform, the image, its re-projection, and the residual
    in units of the noise's r.m.s. standard deviation. Below for each field: its potential where
    there is room, the field with arrows, the standard deviation that the noise leaves, and
    profiles along the dashed lines on the field. White outlines mark where rays have crossed in
    any image; masked pixels are hatched.

    Parameters
    ----------
    fit : Fit
        With its setups, which give axes in metres and fields in SI units; pixels without.
    title : str, optional
        A heading, such as the images' names.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with an Agg canvas; write it with `save_figure`.
    """
    import matplotlib as mpl

    setup = fit.setups[0] if fit.setups else None
    count, *sides = fit.images.shape
    shape = sides[0], sides[1]
    kinds = _kinds(fit)
    upright = count > _MAX_ROWS
    columns = count if upright else len(kinds)
    rows = len(kinds) if upright else count
    fields = [_field_in_units(fit, field) for field in fit.fields]
    width, height = _panels.panel_size(shape)
    grid = Grid(rows + len(fields), columns, width, height, foot=0.0, head=0.0)
    letters = int(grid.figure_size[0] * _LETTERS_PER_INCH)
    heading = title and textwrap.shorten(title, int(letters * 0.7), placeholder=" …")
    header = _header(fit, letters)
    facts = fit.facts_with_names(())
    of_images = [fact for fact in facts if fact.key.startswith("image_")]
    footer = _panels.footer_lines(facts, fit.headline.text, letters)
    grid = replace(grid, foot=0.12 + 0.18 * len(footer), head=0.52 + 0.18 * len(header))
    with mpl.rc_context(_panels.STYLE):
        figure, panels = _panels.new_page(grid, _panels.image_scale(shape, setup), heading)
        for k in range(count):
            for j, kind in enumerate(kinds):
                place = j * columns + k if upright else k * columns + j
                _draw_image(panels[place], fit, k, kind, of_images[k])
        for m, (field, error) in enumerate(fields):
            row = panels[(rows + m) * columns : (rows + m + 1) * columns]
            _draw_fitted(row, fit, fit.fields[m], field, error)
        _panels.write_header(figure, header, grid)
        _panels.write_footer(figure, footer, grid)
    return figure


def _kinds(fit: Fit) -> tuple[str, ...]:
    levels = fit.source.mean(axis=(1, 2), keepdims=True)
    is_uniform = bool((np.abs(fit.source / levels - 1) < _UNIFORM_TOLERANCE).all())
    usual = ("Image", "Re-projection", "Residual")
    return usual if is_uniform else ("Beam", *usual)


def _field_in_units(fit: Fit, field: FittedField) -> tuple[ShownField, ShownField | None]:
    """Return a field and its standard deviation, each in a handy unit."""
    setup = fit.setups[0] if fit.setups else None
    deflector = deflector_titles()[field.name]
    (in_units,) = shown_fields([field.displacement], setup, deflector, mask=fit.used)
    if field.uncertainty is None:
        return in_units, None
    (error,) = shown_fields([field.uncertainty], setup, deflector, mask=fit.used)
    return in_units, error


def _draw_image(panel: Panel, fit: Fit, k: int, kind: str, fact: Fact) -> None:
    mean = float(fit.source[k].mean())
    if kind == "Residual":
        used = fit.residual[k][fit.mask[k]]
        noise = float(np.sqrt((used**2).mean() / fit.chi2[k])) if fit.chi2[k] > 0 else 1.0
        title = f"Residual: {fact.short}"
        residual = np.where(fit.mask[k], fit.residual[k] / noise, np.nan)
        draw_differences(panel, residual, title, "Residual (σ)", _MAX_RESIDUAL_SIGMA)
        return
    plane = {"Beam": fit.source, "Image": fit.images, "Re-projection": fit.reprojection}[kind][k]
    probe = f": {fit.setups[k].probe}" if fit.setups else ""
    title = f"Image {k + 1}{probe}" if kind == "Image" else kind
    scale = fit.source if kind == "Beam" else fit.images
    hidden = plane / mean if kind == "Beam" else np.where(fit.mask[k], plane / mean, np.nan)
    draw_intensity(panel, hidden, title, intensity_limits(scale[k] / mean))


def _draw_fitted(
    panels: list[Panel],
    fit: Fit,
    field: FittedField,
    in_units: ShownField,
    error: ShownField | None,
) -> None:
    """Fill a row of panels with a field; the potential comes first if there is room for it."""
    title = in_units.name if len(fit.fields) == 1 else f"{field.name}: {in_units.symbol}"
    contents = ["potential", "field", "error", "cuts"]
    if error is None:
        contents.remove("error")
    contents = contents[-len(panels) :] if len(panels) < len(contents) else contents
    for panel, content in zip(panels, contents, strict=False):
        if content == "potential":
            potential = np.where(fit.used, field.potential, np.nan)
            draw_potential(panel, potential, fit.setups[0] if fit.setups else None)
        elif content == "field":
            draw_field(panel, in_units, title)
            outline_caustics(panel, _crossed_rays(fit))
        elif content == "error" and error is not None:
            limits = 0.0, error.largest or 1.0
            label = f"σ of {in_units.symbol} ({error.unit})"
            panel.show(error.magnitude, "Standard deviation", label, "cividis", limits)
        else:
            draw_cuts(panel, in_units, _magnitude_error(fit, field))
    for panel in panels[len(contents) :]:
        panel.axes.remove()


def _crossed_rays(fit: Fit) -> BoolArray:
    """Return the pixels whose rays have crossed others in any image."""
    displacements = np.stack([field.displacement for field in fit.fields])
    moved = np.einsum("lm,mcyx->lcyx", fit.strengths, displacements)
    return np.asarray(np.any([jacobian_determinant(total) < 0 for total in moved], axis=0))


def _magnitude_error(fit: Fit, field: FittedField) -> FloatArray | None:
    """Standard deviation of a field's magnitude in the unit in which it is shown."""
    if field.uncertainty is None:
        return None
    length = np.sqrt((field.displacement**2).sum(axis=0))
    along = np.sqrt(((field.displacement * field.uncertainty) ** 2).sum(axis=0))
    pixels = along / np.maximum(length, 1e-12)
    in_units, _ = _field_in_units(fit, field)
    strongest = in_units.peak
    # Displacements become fields by a factor.
    return np.asarray(pixels * in_units.magnitude[strongest] / max(length[strongest], 1e-12))


def _header(fit: Fit, letters: int) -> list[tuple[str, str]]:
    """Return the lines of the headline, each with its colour."""
    colour = GOOD_COLOUR if fit.headline.level is Level.SOUND else ALARM_COLOUR
    return [(line, colour) for line in textwrap.wrap(fit.headline.text, letters)]
