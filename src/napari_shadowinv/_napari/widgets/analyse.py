"""The widget that measures layers along a line, and products of a result: `Analyse`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from qtpy import QtWidgets
from qtpy.QtCore import QSignalBlocker, Qt

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.layer_metadata import kind_of, pixel_mapper, role_of, unit_of
from napari_shadowinv._napari.widgets import _products as products
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LayerPicker, new_shapes, shown_plane
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.analysis.paths import (
    Profile,
    interpolate,
    measure_peak,
    sample_path,
    sample_strip,
    table_text,
)
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import number_in_unit

_REDRAW_MS = 40  # while the line moves
_MAX_NAME_LENGTH = 34
_MAX_WIDTH = 1e6
_LIST_HEIGHT_PX = 110


def draw_profiles(
    columns: Sequence[Any], distance: FloatArray, unit: str, profiles: Sequence[Profile]
) -> None:
    """Draw profiles in panels for their units, with a common distance axis."""
    units = list(dict.fromkeys(profile.unit for profile in profiles))
    for axes, of_unit in zip(columns, units, strict=False):
        axes.set_ylabel(of_unit or "value")
        for number, profile in enumerate(profiles):
            if profile.unit == of_unit:
                colour, name = qt.COLOURS[number % len(qt.COLOURS)], profile.name
                if len(name) > _MAX_NAME_LENGTH:
                    name = f"{name[: _MAX_NAME_LENGTH - 1]}…"
                axes.plot(distance, profile.values, color=colour, label=name)
    averaging = f", {profiles[0].averaging}" if profiles and profiles[0].averaging else ""
    columns[-1].set_xlabel(f"distance ({unit}){averaging}")


class Analyse(qt.Docked):
    """Plot the checked layers along a line in their units, and measure products of a result."""

    spare_width = 50

    def __init__(self, napari_viewer: Any) -> None:
        super().__init__()
        self.viewer = napari_viewer
        self._distance, self._unit = np.zeros(0), "px"
        self.profiles: list[Profile] = []
        tip = "Shapes layer with the line. Of several lines, the selected one is used."
        kinds = ("shapes",)
        self.lines = LayerPicker(self.viewer, tip, "none yet", kinds=kinds, label="Line")
        self.lines.add_button("✎", "Draw a new line.", self._draw)
        self._listed: list[Any] = []
        self.layers = QtWidgets.QListWidget(maximumHeight=_LIST_HEIGHT_PX)
        self.layers.setSelectionMode(QtWidgets.QListWidget.SelectionMode.NoSelection)
        self.width_edit = forms.text_line(
            "0: line only",
            "Width of the strip, perpendicular to the line, over which values are averaged: in "
            "px, or with a unit such as 20 um.",
        )
        self.plot = qt.Plot(height=220)
        self.measures = forms.WrappingLabel()
        self.measures.setToolTip(
            "<qt>Peak: value of largest magnitude. Width: full width at half of the peak, relative "
            "to zero. Area: integral along the line.</qt>"
        )
        self.hint = forms.WrappingLabel("Press ✎ and draw a line on the image.")
        self.problem = forms.WrappingLabel(style=forms.PROBLEM_STYLE)
        self.export = qt.push_button("Export CSV…", "Save the profile as a table.", self._export)
        width = forms.labelled("Width", self.width_edit)
        title = QtWidgets.QLabel("Layers to plot")
        controls = (self.lines, title, self.layers, width)
        results = (self.hint, self.plot, self.measures, self.export, self.problem)
        page, self.products = QtWidgets.QWidget(), products.ProductForm(self.viewer)
        self.products.setMinimumWidth(0)  # that of the window counts
        self.tabs = QtWidgets.QTabWidget()
        self.tabs.addTab(page, "Layers along a line")
        self.tabs.addTab(self.products, "Products of a result")
        qt.column(self, self.tabs)
        qt.column(page, *controls, *results, margin=6).setStretchFactor(self.plot, 1)
        self.plot.setVisible(True)  # it keeps its place
        self._connect()
        self._fill()

    def _connect(self) -> None:
        self._timer = qt.timer(self, _REDRAW_MS, self.update_plot, once=True)
        qt.while_alive(self, self.viewer.layers, ("inserted", "removed", "reordered"), self._fill)
        qt.while_alive(self, self.viewer.dims, "current_step", self._schedule_plot)
        qt.layers_while_alive(self, self.viewer.layers, "set_data", self._on_layer)
        self.lines.picked.connect(self._schedule_plot)
        for signal in (self.layers.itemChanged, self.width_edit.textChanged):
            signal.connect(lambda _: self._schedule_plot())

    def checked(self) -> list[Any]:
        checked = Qt.CheckState.Checked
        items = (self.layers.item(row) for row in range(self.layers.count()))
        pairs = zip(self._listed, items, strict=True)
        return [layer for layer, item in pairs if item.checkState() == checked]

    def check(self, layer: Any, on: bool = True) -> None:
        for row, listed in enumerate(self._listed):
            if listed is layer:
                self.layers.item(row).setCheckState(_state_of(on))

    @qt.notify_errors
    def plot_layer(self, layer: Any) -> None:
        """Plot only one layer; without a line yet, begin to draw it."""
        if not any(layer is listed for listed in self._listed):
            raise InputError("no image is selected: select a grey image in the layer list")
        self.tabs.setCurrentIndex(0)
        for checked in self.checked():
            self.check(checked, on=checked is layer)
        self.check(layer)
        if self.lines.layer is None:
            self._draw()

    @qt.notify_errors
    def measure_layer(self, layer: Any) -> None:
        """Show the form for products of the result that a layer belongs to."""
        self.tabs.setCurrentWidget(self.products)
        self.products.choose(layer)

    def update_plot(self) -> None:
        shapes, layers = self.lines.layer, self.checked()
        line = None
        if shapes is not None:
            line = products.selected_shape(shapes, lambda kind: kind in products.OPEN_SHAPES)
        self.profiles, problem = [], ""
        if shapes is not None and line is not None and layers:
            vertices = np.array([shapes.data_to_world(end)[-2:] for end in shapes.data[line]])
            try:
                self._sample(vertices, layers, shapes)
            except InputError as error:
                problem = str(error)
        self.problem.show_text(problem)
        self.hint.setVisible(not self.profiles and not problem)
        if self.profiles or self.plot.figure is not None:
            panels = len({profile.unit for profile in self.profiles}) or 1
            curves = self._distance, self._unit, self.profiles
            self.plot.show_drawing(lambda axes: draw_profiles(axes, *curves), panels)
        self._show_measures()

    def _sample(self, vertices: FloatArray, layers: Sequence[Any], shapes: Any) -> None:
        """Sample the layers along a line with corners in the world of its shapes."""
        step = min(float(np.min(np.abs(layer.scale[-2:]))) for layer in layers)
        _, self._distance = sample_path(vertices, step)
        self._unit = f"{layers[0].units[-1]:~P}"
        width, averaging = strip_width(self.width_edit.text(), step, self._unit)
        points = sample_strip(vertices, self._distance, width, step)
        position = self.viewer.dims.point
        self.profiles = [
            Profile(
                layer.name,
                unit_of(layer),
                interpolate(shown_plane(layer, position), points, pixel_mapper(layer, shapes)),
                averaging,
            )
            for layer in layers
        ]

    def _show_measures(self) -> None:
        lines = []
        for profile in self.profiles:
            peak = measure_peak(self._distance, profile.values)
            if peak is not None:
                name = f"{profile.name}: " if len(self.profiles) > 1 else ""
                lines.append(f"{name}{peak.text(profile.unit, self._unit)}")
        self.measures.show_text("\n".join(lines))

    def show_problem(self, text: str) -> None:
        """Show a problem until the next profile."""
        self.problem.show_text(text)

    def table(self) -> str:
        """Return the profiles as comma-separated values, or raise an `InputError`."""
        if not self.profiles:
            raise InputError("there is no profile to export: draw a line and check a layer first")
        return table_text(self._distance, self._unit, self.profiles)

    def _schedule_plot(self, _: Any = None) -> None:
        if not self._timer.isActive():
            self._timer.start()

    def _on_layer(self, event: Any) -> None:
        if any(event.source is layer for layer in (self.lines.layer, *self.checked())):
            self._schedule_plot()

    def _fill(self, _: Any = None) -> None:
        """List all grey images; new visible ones are checked."""
        earlier, checked = self._listed, self.checked()
        images = [layer for layer in reversed(self.viewer.layers) if kind_of(layer) == "image"]
        self._listed = [layer for layer in images if not layer.rgb and layer.ndim >= 2]
        with QSignalBlocker(self.layers):
            self.layers.clear()
            for layer in self._listed:
                is_new = not any(layer is old for old in earlier)
                on = any(layer is old for old in checked) or (
                    is_new and layer.visible and (role_of(layer) is not None or not earlier)
                )
                item = QtWidgets.QListWidgetItem(layer.name, self.layers)
                item.setToolTip(layer.name)
                item.setCheckState(_state_of(on))
        self._schedule_plot()

    @qt.notify_errors
    def _draw(self) -> None:
        layers = self.viewer.layers
        images = self.checked() or [layer for layer in layers if kind_of(layer) == "image"]
        if not images:
            raise InputError(
                "there is no image to draw a line on: open one (File → Open) or use a sample "
                "(File → Open Sample)"
            )
        self.lines.layer = new_shapes(self.viewer, images[-1], "profile", "add_line")

    @qt.notify_errors
    def _export(self) -> None:
        products.export_csv(self, "profile", self.table())


def _state_of(on: bool) -> Qt.CheckState:
    return Qt.CheckState.Checked if on else Qt.CheckState.Unchecked


def strip_width(text: str, pixel: float, unit: str) -> tuple[float, str]:
    """Return a strip's width, of px or a length, in the world's unit, and the mean in words."""
    for in_unit, factor in (("px", pixel), (unit, 1.0)):
        with suppress(ValueError):
            width = number_in_unit(text or "0", in_unit)
            if 0 <= width < _MAX_WIDTH:
                return factor * width, f"mean over {width:g} {in_unit}" if width else ""
    raise InputError(f"Width is '{text}', expected a number in px, or with a unit, such as 20 um")
