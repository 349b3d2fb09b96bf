"""The layers of a film pack on a page: `pack_figure`."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.facts import Level
from napari_shadowinv.plotting import _panels
from napari_shadowinv.plotting._panels import ALARM_COLOUR, QUIET_COLOUR, Panel, PanelGrid, Scale

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from napari_shadowinv.film_doses import FilmDoses


def pack_figure(doses: FilmDoses, *, title: str | None = None) -> Figure:
    """Show the dose of each film of a pack, and three neighbouring films in one picture.

    Masked pixels are light grey. In the last panel, three aligned films add up to grey;
    misalignment gives coloured fringes.
    """
    planes, usable = doses.dose, doses.usable
    count, *shape = planes.shape
    panels_shown = count + (count >= 3)
    columns = min(4, panels_shown)
    width, height = (0.75 * side for side in _panels.panel_size(shape))
    grid = PanelGrid(-(-panels_shown // columns), columns, width, height, foot=0.1, head=0.52)
    facts = [fact for fact in doses.facts if not fact.is_detail]
    line = _panels.fact_line(fact for fact in facts if fact.level is Level.SOUND)
    cautions = [(fact.text, ALARM_COLOUR) for fact in facts if fact.level is not Level.SOUND]
    header = _panels.wrapped([(line, QUIET_COLOUR), *cautions], grid.letters)
    with _panels.new_page(grid, Scale(1.0, "px"), title, header) as (figure, panels):
        for k in range(count):
            label = doses.film_label(k)
            film_title = f"{label[:1].upper()}{label[1:]}, {doses.pack.layers[k].film}"
            _draw_dose(panels[k], planes[k], usable[k], film_title)
        if count >= 3:
            _draw_overlay(panels[count], planes, usable)
        for panel in panels[panels_shown:]:
            panel.axes.remove()
    return figure


def _draw_dose(panel: Panel, dose: FloatArray, usable: BoolArray, title: str) -> None:
    if not usable.any():
        panel.axes.set_title(title)
        panel.axes.set_axis_off()
        return
    middle = tuple(slice(side // 8, side - side // 8) for side in dose.shape)  # edges may be burnt
    reliable = dose[middle][usable[middle]] if usable[middle].any() else dose[usable]
    limits = [float(p) for p in np.percentile(reliable, (0.5, 99.7))]
    high = limits[1] if limits[1] > limits[0] else limits[0] + 1.0
    panel.show(np.where(usable, dose, limits[0]), title, "Dose (Gy)", "magma", (limits[0], high))
    hidden: Any = np.ma.masked_array(np.ones(dose.shape), usable)
    place: Any = {"extent": panel.scale.extent(dose.shape), "interpolation": "nearest"}
    panel.axes.imshow(hidden, cmap="Greys", vmin=0.0, vmax=4.0, aspect="equal", **place)


def _draw_overlay(panel: Panel, doses: FloatArray, usable: BoolArray) -> None:
    """Draw the fine structure of the three best correlated films as red, green and blue."""
    from scipy.ndimage import gaussian_filter

    logarithms = [
        np.where(used, np.log(np.maximum(dose, 1e-30)), np.log(np.median(dose[used])))
        if used.any()
        else np.zeros(dose.shape)
        for dose, used in zip(doses, usable, strict=True)
    ]
    structures = [gaussian_filter(p, 1.0) - gaussian_filter(p, 20.0) for p in logarithms]
    inner = np.s_[structures[0].shape[0] // 8 : -(structures[0].shape[0] // 8)]
    correlations = [
        _correlation(plane[inner], neighbour[inner]) for plane, neighbour in pairwise(structures)
    ]
    first = int(np.argmax([min(correlations[k : k + 2]) for k in range(len(correlations) - 1)]))
    planes = []
    for k in range(first, first + 3):
        size = float(np.percentile(np.abs(structures[k]), 98)) or 1.0
        planes.append(np.clip(0.5 + structures[k] / size / 2, 0, 1))
    place: Any = {"extent": panel.scale.extent(doses.shape[1:]), "interpolation": "nearest"}
    panel.axes.imshow(np.stack(planes, axis=-1), aspect="equal", **place)
    panel.axes.set_title(f"Films {first + 1}, {first + 2}, {first + 3} in red, green, blue")
    panel.axes.set_xlabel(f"x ({panel.scale.unit})")
    panel.few_ticks()


def _correlation(plane: FloatArray, neighbour: FloatArray) -> float:
    if not (plane.any() and neighbour.any()):
        return -1.0
    return float(np.corrcoef(plane.ravel(), neighbour.ravel())[0, 1])
