"""The widget that reads values off a line across layers: `LineProfile`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import QSignalBlocker, QSize, Qt, QTimer
from qtpy.QtWidgets import (
    QDoubleSpinBox,
    QFileDialog,
    QHBoxLayout,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from napari_shadowinv._napari.layer_metadata import role_of, unit_of
from napari_shadowinv._napari.widgets._base import with_button
from napari_shadowinv._napari.widgets._docking import Docked
from napari_shadowinv._napari.widgets._drawing import new_shapes
from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._forms import PROBLEM_STYLE, labelled, wrapping_label
from napari_shadowinv._napari.widgets._lifetime import while_alive
from napari_shadowinv._napari.widgets._notifications import notify_errors, tell_info
from napari_shadowinv._napari.widgets._picking import LayerPicker, kind_of
from napari_shadowinv._napari.widgets._plotting import ProfilePlot
from napari_shadowinv._napari.widgets._reading import shown_plane
from napari_shadowinv._napari.widgets._sampling import (
    Profile,
    abreast,
    along,
    sampled,
    table_text,
)
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import napari

__all__ = ["LineProfile"]

_FOLLOW = 40  # ms between two drawings while the line moves
_LAYER_ROLE = Qt.ItemDataRole.UserRole
_STRAIGHT = ("line", "path")
_PIXELS = "px"
_WIDEST = 1e6


class LineProfile(Docked):
    """Draw a line; see the values of the checked layers along it, in their units.

    Parameters
    ----------
    viewer : napari.viewer.Viewer
        The viewer to work in.
    """

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        super().__init__()
        self.viewer = viewer
        self._distance = np.zeros(0)
        self._unit = "px"
        self.profiles: list[Profile] = []
        self.lines = LayerPicker(viewer, ("shapes",), none="none yet")
        self.lines.setToolTip(
            "<qt>Shapes layer with the line; if it has several, the selected one is used.</qt>"
        )
        self.layers = QListWidget()
        self.layers.setToolTip("Layers to plot.")
        self.layers.setMaximumHeight(110)
        self.layers.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.width_edit = QDoubleSpinBox()
        self.width_edit.setRange(0.0, _WIDEST)
        self.width_edit.setDecimals(2)
        self.width_edit.setSpecialValueText("0: line only")
        self.width_edit.setKeyboardTracking(False)
        self.width_unit = SteadyComboBox()
        self.width_unit.addItem(_PIXELS)
        for widget in (self.width_edit, self.width_unit):
            widget.setToolTip(
                "<qt>Width of the strip, perpendicular to the line, over which values are "
                "averaged.</qt>"
            )
        self.plot = ProfilePlot()
        self.hint = wrapping_label("Press ✎ and draw a line on the image.")
        self.problem = wrapping_label(style=PROBLEM_STYLE)
        self.export = QPushButton("Export CSV…")
        self.export.setToolTip("Save the profile as a table.")
        column = QVBoxLayout(self)
        column.setContentsMargins(6, 6, 6, 6)
        column.addWidget(
            labelled("Line", with_button(self.lines, "✎", "Draw a new line.", self._draw))
        )
        width = QWidget()
        row = QHBoxLayout(width)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.width_edit, 2)
        row.addWidget(self.width_unit, 1)
        for widget in (self.layers, labelled("Width", width), self.hint):
            column.addWidget(widget)
        column.addWidget(self.plot, 1)
        for widget in (self.export, self.problem):
            column.addWidget(widget)
        self.setMinimumWidth(330)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self._connect()
        self._fill()

    def sizeHint(self) -> QSize:
        return QSize(380, 600)

    def _connect(self) -> None:
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(_FOLLOW)
        self._timer.timeout.connect(self.update_plot)
        self._watched: list[Any] = []
        events = self.viewer.layers.events
        for emitter in (events.inserted, events.removed, events.reordered):
            while_alive(self, emitter, self._fill)
        while_alive(self, self.viewer.dims.events.current_step, self._soon)
        self.lines.picked.connect(self._soon)
        self.layers.itemChanged.connect(lambda _: self._soon())
        self.width_edit.valueChanged.connect(lambda _: self._soon())
        self.width_unit.currentIndexChanged.connect(lambda _: self._soon())
        self.export.clicked.connect(lambda: self._export())

    def checked(self) -> list[Any]:
        """The layers to read."""
        items = [self.layers.item(row) for row in range(self.layers.count())]
        return [
            item.data(_LAYER_ROLE) for item in items if item.checkState() == Qt.CheckState.Checked
        ]

    def check(self, layer: Any, on: bool = True) -> None:
        """Read a layer, or leave it out."""
        for row in range(self.layers.count()):
            item = self.layers.item(row)
            if item.data(_LAYER_ROLE) is layer:
                item.setCheckState(Qt.CheckState.Checked if on else Qt.CheckState.Unchecked)

    def update_plot(self) -> None:
        """Read the layers along the line, and draw."""
        vertices = self._vertices()
        layers = self.checked()
        self.profiles = []
        if vertices is not None and layers:
            step = min(float(np.min(np.abs(layer.scale[-2:]))) for layer in layers)
            _, self._distance = along(vertices, step)
            self._unit = f"{layers[0].units[-1]:~P}"
            self._offer_width_in(self._unit)
            width, averaged = self._width(step)
            points = abreast(vertices, self._distance, width, step)
            now = self.viewer.dims.point
            self.profiles = [
                Profile(
                    layer.name,
                    unit_of(layer),
                    sampled(shown_plane(layer, now), points, _mapper(layer)),
                    averaged,
                )
                for layer in layers
            ]
            self.problem.setVisible(False)
        self.hint.setVisible(not self.profiles)
        self.plot.show_profiles(self._distance, self._unit, self.profiles)

    def show_problem(self, text: str) -> None:
        """Show what is wrong, where it can be read until there is another profile."""
        self.problem.setText(text)
        self.problem.setVisible(True)

    def _offer_width_in(self, unit: str) -> None:
        """Let the width be told in pixels or in the unit of the world."""
        units = [_PIXELS] + ([] if unit in ("pixel", "pixels", _PIXELS) else [unit])
        if units == [self.width_unit.itemText(n) for n in range(self.width_unit.count())]:
            return
        chosen = max(self.width_unit.currentIndex(), 0)
        with QSignalBlocker(self.width_unit):
            self.width_unit.clear()
            self.width_unit.addItems(units)
            self.width_unit.setCurrentIndex(min(chosen, len(units) - 1))

    def _width(self, pixel: float) -> tuple[float, str]:
        """Width of the strip in the unit of the world, and in words."""
        number, unit = self.width_edit.value(), self.width_unit.currentText()
        if not number:
            return 0.0, ""
        width = number * pixel if unit == _PIXELS else number
        return width, f"mean over {number:g} {unit}"

    def table(self) -> str:
        """What is shown, as comma-separated values.

        Raises
        ------
        InputError
            If nothing is shown.
        """
        if not self.profiles:
            raise InputError("there is no profile to export: draw a line and check a layer first")
        return table_text(self._distance, self._unit, self.profiles)

    def _vertices(self) -> Any | None:
        """Corners of the chosen line, in the world."""
        shapes = self.lines.layer
        if shapes is None:
            return None
        straight = [n for n, kind in enumerate(shapes.shape_type) if kind in _STRAIGHT]
        chosen = [n for n in straight if n in shapes.selected_data] or straight
        if not chosen:
            return None
        return np.array([shapes.data_to_world(corner)[-2:] for corner in shapes.data[chosen[-1]]])

    def _soon(self, event: Any = None) -> None:
        self._watch()
        if not self._timer.isActive():
            self._timer.start()

    def _watch(self) -> None:
        """Follow the line, and the layers that are read."""
        for layer in [self.lines.layer, *self.checked()]:
            if layer is None or any(layer is known for known in self._watched):
                continue
            self._watched.append(layer)
            while_alive(self, layer.events.set_data, self._on_layer)

    def _on_layer(self, event: Any) -> None:
        if event.source is self.lines.layer or any(event.source is one for one in self.checked()):
            self._soon()

    def _fill(self, event: Any = None) -> None:
        """Offer all plane images, the ones that can be seen checked when they are new."""
        known = [self.layers.item(row).data(_LAYER_ROLE) for row in range(self.layers.count())]
        checked = self.checked()
        self.layers.blockSignals(True)
        self.layers.clear()
        for layer in reversed(self.viewer.layers):
            if kind_of(layer) != "image" or layer.rgb or layer.ndim < 2:
                continue
            new = not any(layer is one for one in known)
            on = any(layer is one for one in checked) or (
                new and layer.visible and (role_of(layer) is not None or not known)
            )
            item = QListWidgetItem(layer.name)
            item.setData(_LAYER_ROLE, layer)
            item.setToolTip(layer.name)
            item.setCheckState(Qt.CheckState.Checked if on else Qt.CheckState.Unchecked)
            self.layers.addItem(item)
        self.layers.blockSignals(False)
        self._soon()

    @notify_errors
    def _draw(self) -> None:
        images = self.checked() or [
            layer for layer in self.viewer.layers if kind_of(layer) == "image"
        ]
        if not images:
            raise InputError(
                "there is no image to draw a line on: open one (File → Open) or use a sample "
                "(File → Open Sample)"
            )
        self.lines.layer = new_shapes(self.viewer, images[-1], "profile", "add_line")

    @notify_errors
    def _export(self) -> None:
        from napari_shadowinv.io import replacing
        from napari_shadowinv.io.formats import SITES

        text = self.table()
        name, _ = QFileDialog.getSaveFileName(self, "Export CSV", "profile.csv", "CSV (*.csv)")
        if not name:
            return
        path = Path(name) if Path(name).suffix else Path(name).with_suffix(SITES.suffix)
        with replacing(path, overwrite=str(path) == name) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
        tell_info(f"Wrote {path}")


def _mapper(layer: Any) -> Callable[[Any], Any]:
    """What brings points of the world to pixels of a layer, also of one that was turned."""
    leading = np.zeros(layer.ndim - 2)
    origin, one_down, one_right = (
        np.asarray(layer.data_to_world((*leading, *pixel))[-2:])
        for pixel in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0))
    )
    to_pixels = np.linalg.inv(np.stack([one_down - origin, one_right - origin], axis=1))
    return lambda points: (points - origin) @ to_pixels.T
