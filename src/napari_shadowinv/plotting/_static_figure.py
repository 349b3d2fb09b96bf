"""Figures that test one static field against several images: images left out, and windows."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv.fitting import FitWindows, LeaveOneOut, Verdict
from napari_shadowinv.physics.setup import deflector_titles
from napari_shadowinv.physics.units import intensity_limits, shown_fields
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import (
    ALARM_COLOUR,
    GOOD_COLOUR,
    QUIET_COLOUR,
    Grid,
    Panel,
    draw_differences,
    draw_intensity,
    draw_side_by_side,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.physics.setup import Setup

_PANELS_PER_IMAGE = 3  # image, prediction, residual
_MAX_ROWS = 6  # of images; more start a second column
_MAX_RESIDUAL_SIGMA = 20.0
_LETTERS_PER_INCH = 13  # of the header
_PAGE_ASPECT = 1.6


def left_out_figure(
    left_out: LeaveOneOut, setups: Sequence[Setup] = (), *, title: str | None = None
) -> Figure:
    """Show how well the others predict each image that was left out.

    Each row has the image, the prediction of the others, and the residual in units of the noise's
    r.m.s. standard deviation. On top: the images that one static field does not explain.

    Parameters
    ----------
    left_out : LeaveOneOut
    setups : sequence of Setup, optional
        The experiments; they name the images, and give axes in metres.
    title : str, optional
        A heading, such as the images' names.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with an Agg canvas; write it with `save_figure`.
    """
    import matplotlib as mpl

    count, *sides = left_out.images.shape
    shape = sides[0], sides[1]
    side_by_side = -(-count // _MAX_ROWS)
    columns, rows = _PANELS_PER_IMAGE * side_by_side, -(-count // side_by_side)
    colour = GOOD_COLOUR if left_out.explained.all() else ALARM_COLOUR
    grid, header, heading = _page(shape, rows, columns, [(left_out.explanation, colour)], title)
    with mpl.rc_context(_panels.STYLE):
        scale = _panels.image_scale(shape, setups[0] if setups else None)
        figure, panels = _panels.new_page(grid, scale, heading)
        for k in range(count):
            row, column = k % rows, k // rows
            first = row * columns + column * _PANELS_PER_IMAGE
            probe = f": {setups[k].probe}" if setups else ""
            _draw_left_out(
                panels[first : first + _PANELS_PER_IMAGE], left_out, k, f"Image {k + 1}{probe}"
            )
        for place, panel in enumerate(panels):
            row, column = divmod(place, columns)
            if column // _PANELS_PER_IMAGE * rows + row >= count:
                panel.axes.remove()
        _panels.write_header(figure, header, grid)
        text = (
            "Each image as predicted by a fit of the others, without those that are not explained."
        )
        _panels.write_footer(figure, [(text, QUIET_COLOUR)], grid)
    return figure


def windows_figure(windows: FitWindows, *, title: str | None = None) -> Figure:
    """Show the field of each group of neighbouring images, on one scale, and cuts through it.

    Parameters
    ----------
    windows : FitWindows
        Its setups give axes in metres, fields in SI units, energies and times of flight.
    title : str, optional
        A heading, such as the images' names.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with an Agg canvas; write it with `save_figure`.
    """
    import matplotlib as mpl

    displacement = windows.displacement
    count, fields = displacement.shape[:2]
    shape = displacement.shape[3], displacement.shape[4]
    columns = max(2, min(count + 1, math.ceil(math.sqrt(_PAGE_ASPECT * fields * (count + 1)))))
    rows = -(-(count + 1) // columns)
    verdicts = [
        (f"{_images(windows, w)}: {fit.verdict}", ALARM_COLOUR)
        for w, fit in enumerate(windows.fits)
        if fit.verdict is not Verdict.DETERMINED
    ]
    sentences = verdicts or [(f"All {count} windows are determined.", GOOD_COLOUR)]
    grid, header, heading = _page(shape, rows * fields, columns, sentences, title)
    with mpl.rc_context(_panels.STYLE):
        figure, panels = _panels.new_page(grid, _panels.image_scale(shape, windows.setup), heading)
        for m, field in enumerate(windows.fits[0].fields):
            block = panels[m * rows * columns : (m + 1) * rows * columns]
            in_units = shown_fields(
                list(displacement[:, m]), windows.setup, deflector_titles()[field.name]
            )
            names = [f"{field.name}: " * (fields > 1) + _name(windows, w) for w in range(count)]
            draw_side_by_side(
                block[: count + 1], dict(zip(names, in_units, strict=True)), common=True
            )
            for panel in block[count + 1 :]:
                panel.axes.remove()
        _panels.write_header(figure, header, grid)
        text = "All fields on one colour scale"
        text += ", at the strength of the image displaced most." if windows.setup is None else "."
        _panels.write_footer(figure, [(text, QUIET_COLOUR)], grid)
    return figure


def _page(
    shape: tuple[int, int],
    rows: int,
    columns: int,
    sentences: list[tuple[str, str]],
    title: str | None,
) -> tuple[Grid, list[tuple[str, str]], str | None]:
    """Panels of one shape below a heading and sentences, wrapped to the page's width."""
    width, height = _panels.panel_size(shape)
    grid = Grid(rows, columns, width, height, foot=0.3, head=0.0)
    letters = int(grid.figure_size[0] * _LETTERS_PER_INCH)
    header = [(line, colour) for text, colour in sentences for line in textwrap.wrap(text, letters)]
    heading = title and textwrap.shorten(title, int(letters * 0.7), placeholder=" …")
    return replace(grid, head=0.52 + 0.18 * len(header)), header, heading


def _draw_left_out(panels: list[Panel], left_out: LeaveOneOut, k: int, name: str) -> None:
    used = left_out.mask[k]
    mean = float(left_out.images[k][used].mean())
    limits = intensity_limits(left_out.images[k] / mean)
    residual = left_out.residual[k]
    chi2 = left_out.chi2[k]
    noise = float(np.sqrt((residual[used] ** 2).mean() / chi2)) if chi2 else 1.0
    draw_intensity(panels[0], left_out.images[k] / mean, name, limits, label="Intensity / mean")
    draw_intensity(
        panels[1], left_out.predicted[k] / mean, "Prediction", limits, "Intensity / mean"
    )
    title = f"Residual: χ² {chi2:.3g}"
    draw_differences(panels[2], residual / noise, title, "Residual (σ)", _MAX_RESIDUAL_SIGMA)
    if not left_out.explained[k]:
        panels[2].axes.set_title(f"{title}, not explained", color=ALARM_COLOUR)


def _images(windows: FitWindows, window: int) -> str:
    numbers = [str(k + 1) for k in windows.numbers[window]]
    return f"image{'s' * (len(numbers) > 1)} {', '.join(numbers)}"


def _name(windows: FitWindows, window: int) -> str:
    """Energy or wavelength and time of flight of a group, or its images."""
    quantity, means, times = windows.beam_quantity, windows.beam_means, windows.times_of_flight
    if quantity is None or means is None:
        return _images(windows, window).capitalize()
    time = "" if times is None else f", {times[window] * 1e12:.3g} ps"
    return f"{quantity.text(means[window])}{time}"
