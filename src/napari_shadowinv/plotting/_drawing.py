"""Contents of a panel: an image, a field, a residual, cuts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.physics.units import ShownField, shown_potential
from napari_shadowinv.plotting._panels import Panel

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

_CUT_COLOURS = ("#1f9bff", "#18b368")
_REFERENCE_STYLE: dict[str, Any] = {"color": "black", "linewidth": 2.4, "alpha": 0.45}
_CAUSTIC_DENSITY = 0.15  # level of the outline of a caustic


def draw_intensity(
    panel: Panel,
    plane: FloatArray,
    title: str,
    limits: tuple[float, float],
    label: str = "Intensity / mean source",
) -> None:
    """Show an image, or its prediction, in units of the mean source."""
    panel.show(plane, title, label, "gray", limits)


def draw_potential(panel: Panel, potential: FloatArray, setup: Setup | None) -> None:
    """Show a potential with contours."""
    plane, unit = shown_potential(potential, setup)
    limits = (float(np.nanmin(plane)), float(np.nanmax(plane)))
    panel.show(plane, "Deflection potential", f"Potential ({unit})", "viridis", limits)
    if limits[1] > limits[0]:
        levels = np.linspace(*limits, 9)[1:-1]
        panel.contour(plane, levels, "black", linewidths=0.5, alpha=0.45)


def draw_field(panel: Panel, field: ShownField, title: str = "") -> None:
    """Show a field, and the lines of `draw_cuts`."""
    _draw_vectors(panel, field, title or field.name, _strongest(field))
    row, column = field.peak
    style: Any = {"linewidth": 1.0, "linestyle": (0, (5, 3))}
    panel.axes.axhline(row * panel.scale.pixel, color=_CUT_COLOURS[0], **style)
    panel.axes.axvline(column * panel.scale.pixel, color=_CUT_COLOURS[1], **style)


def _strongest(field: ShownField) -> float:
    """Upper end of a colour scale, which must not be empty even if the field is."""
    return field.largest or 1.0


def _label(field: ShownField) -> str:
    return f"{field.symbol} ({field.unit})"


def _draw_vectors(panel: Panel, field: ShownField, title: str, largest: float) -> None:
    """Show a field, with arrows where it is strong enough to have a direction."""
    everywhere = field.magnitude
    panel.show(everywhere, title, _label(field), "inferno", (0.0, largest))
    height, width = everywhere.shape
    step = max(1, round(np.sqrt(height * width) / 14))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    strong = everywhere[rows, columns] > 0.15 * field.largest
    if not strong.any():
        return
    rows, columns = rows[strong], columns[strong]
    share = everywhere[rows, columns] / field.largest
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


def outline_caustics(panel: Panel, caustic: BoolArray) -> None:
    """Draw a line around the caustics."""
    from scipy.ndimage import gaussian_filter

    # Noise breaks a caustic into specks; one line around them is readable.
    density = gaussian_filter(caustic.astype(np.float64), 1 + min(caustic.shape) / 200)
    if density.min() < _CAUSTIC_DENSITY < density.max():
        panel.contour(density, [_CAUSTIC_DENSITY], "white", linewidths=1.1)


def draw_differences(
    panel: Panel, plane: FloatArray, title: str, label: str, largest: float
) -> None:
    """Show differences in red and blue, up to `largest`."""
    # Limits that a handful of pixels at a caustic cannot blow up.
    limit = min(float(np.nanpercentile(np.abs(plane), 99.5)) or 1.0, largest)
    panel.show(plane, title, label, "RdBu_r", (-limit, limit))


def draw_cuts(panel: Panel, field: ShownField, error: FloatArray | None = None) -> None:
    """Plot a field's magnitude along x and along y through its peak, with its error's band."""
    row, column = field.peak
    lines: dict[str, Any] = {
        f"along x, at y = {_coordinate(row, panel)}": np.s_[row, :],
        f"along y, at x = {_coordinate(column, panel)}": np.s_[:, column],
    }
    for (name, line), colour in zip(lines.items(), _CUT_COLOURS, strict=True):
        values = field.magnitude[line]
        panel.plot(values, color=colour, linewidth=1.4, label=name)
        if error is not None:
            panel.band(values, error[line], colour)
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
    axes.set_ylim(0, 1.0 if not field.largest else 1.38 * float(axes.dataLim.ymax))
    axes.legend(loc="upper left", frameon=False, fontsize=8, handlelength=1.6, borderaxespad=0.2)
    panel.few_ticks()


def draw_side_by_side(
    panels: list[Panel], fields: Mapping[str, ShownField], *, common: bool = False
) -> None:
    """Show fields on the first one's scale, and in the last panel a cut through its peak.

    A `common` scale is set by the strongest field.
    """
    *pictures, cuts = panels
    reference = next(iter(fields.values()))
    largest = max(map(_strongest, fields.values() if common else [reference]))
    row, _ = reference.peak
    for panel, (name, field) in zip(pictures, fields.items(), strict=True):
        _draw_vectors(panel, field, name, largest)
        style = _REFERENCE_STYLE if field is reference else {"linewidth": 1.3}
        cuts.plot(field.magnitude[row], label=name, **style)
    _finish_cuts(cuts, reference, f"Cut at y = {_coordinate(row, cuts)}")
