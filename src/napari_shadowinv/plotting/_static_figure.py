"""Whether one static field explains several images, on a page: images left out, and windows."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from napari_shadowinv.fitting import FIELDS, FitWindows, LeaveOneOut, Verdict
from napari_shadowinv.physics.units import intensity_limits, shown_fields
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._drawing import (
    draw_differences,
    draw_intensity,
    draw_side_by_side,
)
from napari_shadowinv.plotting._panels import ALARM_COLOUR, GOOD_COLOUR, QUIET_COLOUR, Grid, Panel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.physics.setup import Setup

_KINDS = 3  # image, prediction, residual
_ROWS = 6  # of images below each other; then a second column of them begins
_LARGEST_RESIDUAL = 20.0  # σ
_LETTERS = 13  # in an inch of the header
_WIDE = 1.6  # of a page


def left_out_figure(
    found: LeaveOneOut, setups: Sequence[Setup] = (), *, title: str | None = None
) -> Figure:
    """Show how well the others predict each image that was left out.

    For each image, in a row: the image, what the others predict, and the residual in units of the
    noise's r.m.s. standard deviation. On top: which images one static field does not explain.

    Parameters
    ----------
    found : LeaveOneOut
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

    count, *sides = found.images.shape
    shape = sides[0], sides[1]
    side_by_side = -(-count // _ROWS)
    columns, rows = _KINDS * side_by_side, -(-count // side_by_side)
    colour = GOOD_COLOUR if found.explained.all() else ALARM_COLOUR
    grid, header, heading = _page(shape, rows, columns, [(found.explanation, colour)], title)
    with mpl.rc_context(_panels.STYLE):
        scale = _panels.image_scale(shape, setups[0] if setups else None)
        figure, panels = _panels.new_page(grid, scale, heading)
        for k in range(count):
            row, column = k % rows, k // rows
            first = row * columns + column * _KINDS
            probe = f": {setups[k].probe}" if setups else ""
            _draw_left_out(panels[first : first + _KINDS], found, k, f"Image {k + 1}{probe}")
        for place, panel in enumerate(panels):
            row, column = divmod(place, columns)
            if column // _KINDS * rows + row >= count:
                panel.axes.remove()
        _panels.write_header(figure, header, grid)
        text = (
            "Each image as predicted by a fit of the others, without those that are not explained."
        )
        _panels.write_footer(figure, [(text, QUIET_COLOUR)], grid)
    return figure


def windows_figure(found: FitWindows, *, title: str | None = None) -> Figure:
    """Show the field of each group of neighbouring images, on one scale, and cuts through it.

    Parameters
    ----------
    found : FitWindows
        Its setups give axes in metres, fields in SI units, energies and times of flight.
    title : str, optional
        A heading, such as the images' names.

    Returns
    -------
    matplotlib.figure.Figure
        A figure with an Agg canvas; write it with `save_figure`.
    """
    import matplotlib as mpl

    displacement = found.displacement
    count, fields = displacement.shape[:2]
    shape = displacement.shape[3], displacement.shape[4]
    columns = max(2, min(count + 1, math.ceil(math.sqrt(_WIDE * fields * (count + 1)))))
    rows = -(-(count + 1) // columns)
    verdicts = [
        (f"{_images(found, w)}: {fit.verdict}", ALARM_COLOUR)
        for w, fit in enumerate(found.fits)
        if fit.verdict is not Verdict.DETERMINED
    ]
    told = verdicts or [(f"All {count} windows are determined.", GOOD_COLOUR)]
    grid, header, heading = _page(shape, rows * fields, columns, told, title)
    with mpl.rc_context(_panels.STYLE):
        figure, panels = _panels.new_page(grid, _panels.image_scale(shape, found.setup), heading)
        for m, field in enumerate(found.fits[0].fields):
            block = panels[m * rows * columns : (m + 1) * rows * columns]
            shown = shown_fields(list(displacement[:, m]), found.setup, FIELDS[field.name])
            names = [f"{field.name}: " * (fields > 1) + _name(found, w) for w in range(count)]
            draw_side_by_side(block[: count + 1], dict(zip(names, shown, strict=True)), common=True)
            for panel in block[count + 1 :]:
                panel.axes.remove()
        _panels.write_header(figure, header, grid)
        text = "All fields on one colour scale"
        text += ", at the strength of the image displaced most." if found.setup is None else "."
        _panels.write_footer(figure, [(text, QUIET_COLOUR)], grid)
    return figure


def _page(
    shape: tuple[int, int],
    rows: int,
    columns: int,
    told: list[tuple[str, str]],
    title: str | None,
) -> tuple[Grid, list[tuple[str, str]], str | None]:
    """Panels of one shape below a heading and sentences, wrapped to the page's width."""
    width, height = _panels.panel_size(shape)
    grid = Grid(rows, columns, width, height, foot=0.3, head=0.0)
    letters = int(grid.figure_size[0] * _LETTERS)
    header = [(line, colour) for text, colour in told for line in textwrap.wrap(text, letters)]
    heading = title and textwrap.shorten(title, int(letters * 0.7), placeholder=" …")
    return replace(grid, head=0.52 + 0.18 * len(header)), header, heading


def _draw_left_out(panels: list[Panel], found: LeaveOneOut, k: int, name: str) -> None:
    used = found.mask[k]
    mean = float(found.images[k][used].mean())
    limits = intensity_limits(found.images[k] / mean)
    residual = found.residual[k]
    noise = float(np.sqrt((residual[used] ** 2).mean() / found.chi2[k])) if found.chi2[k] else 1.0
    draw_intensity(panels[0], found.images[k] / mean, name, limits, label="Intensity / mean")
    draw_intensity(panels[1], found.predicted[k] / mean, "Prediction", limits, "Intensity / mean")
    title = f"Residual: χ² {found.chi2[k]:.3g}"
    draw_differences(panels[2], residual / noise, title, "Residual (σ)", _LARGEST_RESIDUAL)
    if not found.explained[k]:
        panels[2].axes.set_title(f"{title}, not explained", color=ALARM_COLOUR)


def _images(found: FitWindows, window: int) -> str:
    numbers = [str(k + 1) for k in found.numbers[window]]
    return f"image{'s' * (len(numbers) > 1)} {', '.join(numbers)}"


def _name(found: FitWindows, window: int) -> str:
    """Energy and time of flight of a group, or its images."""
    energies, times = found.energies, found.times_of_flight
    if energies is None:
        return _images(found, window).capitalize()
    time = "" if times is None else f", {times[window] * 1e12:.3g} ps"
    return f"{energies[window]:.4g} MeV{time}"
