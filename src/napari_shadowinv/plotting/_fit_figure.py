"""The figure of a fit on a page: images and how they are explained, fields and verdict."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Fact
from napari_shadowinv.fitting import Fit, FittedField
from napari_shadowinv.inversion.error_budget import per_pixel_of
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.physics.setup import deflector_titles
from napari_shadowinv.physics.significance import deviation_along
from napari_shadowinv.physics.units import ShownField, intensity_limits, shown_fields
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import Panel, PanelGrid

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def fit_figure(fit: Fit, *, title: str | None = None) -> Figure:
    """Show a whole fit on a page, with its verdict on top.

    For each image: the beam unless it is uniform, the image, its re-projection, and the residual
    over the standard deviation of each pixel's noise. Below for each field: its potential where
    there is room, the field with arrows, the standard deviation that the noise leaves, and profiles
    along the dashed lines on the field. White outlines mark where rays have crossed in any image;
    masked pixels are hatched.
    """
    count, *shape = fit.images.shape
    levels = fit.source.mean(axis=(1, 2), keepdims=True)
    kinds = ["Image", "Re-projection", "Residual"]
    if not (np.abs(fit.source / levels - 1) < 1e-6).all():
        kinds.insert(0, "Beam")
    upright = count > 3  # a column for each image, else a row
    columns = count if upright else len(kinds)
    rows = len(kinds) if upright else count
    sentences = [_panels.headline_sentence(fit.headline)]
    width, height = _panels.panel_size(shape)
    grid = PanelGrid(rows + len(fit.fields), columns, width, height, foot=0.12, head=0.52)
    header = _panels.wrapped(sentences, grid.letters)
    heading = title and textwrap.shorten(title, int(grid.letters * 0.7), placeholder=" …")
    facts = fit.facts_with_names(())
    of_images = [fact for fact in facts if fact.key.startswith("image_")]
    footer = _panels.footer_lines(facts, fit.headline.text, grid.letters)
    scale = _panels.image_scale(shape, fit.setup)
    with _panels.new_page(grid, scale, heading, header, footer) as (figure, panels):
        for k in range(count):
            for j, kind in enumerate(kinds):
                place = j * columns + k if upright else k * columns + j
                _draw_image(panels[place], fit, k, kind, of_images[k])
        for m, field in enumerate(fit.fields, start=rows):
            _draw_fitted(panels[m * columns : (m + 1) * columns], fit, field)
    return figure


def _draw_image(panel: Panel, fit: Fit, k: int, kind: str, fact: Fact) -> None:
    mean = float(fit.source[k].mean())
    if kind == "Residual":
        title, residual = f"Residual: {fact.short}", fit.normalised_residual[k]
        panel.draw_differences(residual, title, "Residual (σ)", 20.0)
        return
    plane = {"Beam": fit.source, "Image": fit.images, "Re-projection": fit.reprojection}[kind][k]
    probe = f": {fit.setups[k].probe}" if fit.setups else ""
    title = f"Image {k + 1}{probe}" if kind == "Image" else kind
    scale = fit.source if kind == "Beam" else fit.images
    hidden = plane / mean if kind == "Beam" else np.where(fit.mask[k], plane / mean, np.nan)
    panel.draw_intensity(hidden, title, intensity_limits(scale[k] / mean))


def _draw_fitted(panels: list[Panel], fit: Fit, field: FittedField) -> None:
    deflector, in_units = deflector_titles()[field.name], fit.shown(field)
    title = in_units.name if len(fit.fields) == 1 else f"{field.name}: {in_units.symbol}"
    std = per_pixel_of(field.errors)
    contents = ["potential", "field", "error", "cuts"]
    if std is None:
        contents.remove("error")
    contents = contents[-len(panels) :]
    for panel, content in zip(panels, contents, strict=False):
        if content == "potential":
            panel.draw_potential(np.where(fit.used, field.potential, np.nan), fit.setup)
        elif content == "field":
            panel.draw_field(in_units, title)
            panel.hatch_insignificant(fit.structures(field))
            panel.outline_caustics(_crossed_rays(fit))
        elif content == "error" and std is not None:
            (error,) = shown_fields([std], fit.setup, deflector, mask=fit.used)
            limits = 0.0, error.largest or 1.0
            label = f"σ of {in_units.symbol} ({error.unit})"
            panel.show(error.magnitude, "Standard deviation", label, "cividis", limits)
        else:
            panel.draw_cuts(in_units, _magnitude_error(field, in_units))
    for panel in panels[len(contents) :]:
        panel.axes.remove()


def _crossed_rays(fit: Fit) -> BoolArray:
    displacements = np.stack([field.displacement for field in fit.fields])
    moved = np.einsum("lm,mcyx->lcyx", fit.strengths, displacements)
    return np.asarray(np.any([jacobian_determinant(total) < 0 for total in moved], axis=0))


def _magnitude_error(field: FittedField, in_units: ShownField) -> FloatArray | None:
    std = per_pixel_of(field.errors)
    if std is None:
        return None
    length = np.sqrt((field.displacement**2).sum(axis=0))
    pixels = deviation_along(field.displacement, std)
    strongest = in_units.peak
    # Displacements become fields by a factor.
    return np.asarray(pixels * in_units.magnitude[strongest] / max(length[strongest], 1e-12))
