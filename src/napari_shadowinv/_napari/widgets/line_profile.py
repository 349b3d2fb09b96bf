"""The widget that reads values off a line across layers: `LineProfile`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import QSize, Qt, QTimer
from qtpy.QtWidgets import (
    QFileDialog,
    QListWidget,
    QListWidgetItem,
    QPushButton,
    QSizePolicy,
    QVBoxLayout,
    QWidget,
)

from napari_shadowinv._napari.marks import role_of, unit_of
from napari_shadowinv._napari.widgets._base import with_button
from napari_shadowinv._napari.widgets._drawing import new_shapes
from napari_shadowinv._napari.widgets._forms import labelled, wrapping_label
from napari_shadowinv._napari.widgets._lifetime import while_alive
from napari_shadowinv._napari.widgets._messages import reporting, tell_info
from napari_shadowinv._napari.widgets._picking import LayerPicker, kind_of
from napari_shadowinv._napari.widgets._plotting import ProfilePlot
from napari_shadowinv._napari.widgets._sampling import Profile, along, sampled, table_text
from napari_shadowinv.errors import InputError

if TYPE_CHECKING:
    import napari

__all__ = ["LineProfile"]

_FOLLOW = 40  # ms between two drawings while the line moves
_LAYER_ROLE = Qt.ItemDataRole.UserRole
_STRAIGHT = ("line", "path")


class LineProfile(QWidget):
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
            "<qt>Shapes layer with the line; of several the selected one counts.</qt>"
        )
        self.layers = QListWidget()
        self.layers.setToolTip("Layers to read.")
        self.layers.setMaximumHeight(110)
        self.layers.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.plot = ProfilePlot()
        self.hint = wrapping_label("Press ✎ and draw a line on the image.")
        self.export = QPushButton("Export CSV…")
        self.export.setToolTip("Write what is shown as a table.")
        column = QVBoxLayout(self)
        column.setContentsMargins(6, 6, 6, 6)
        column.addWidget(
            labelled("Line", with_button(self.lines, "✎", "Draw a new line.", self._draw))
        )
        for widget in (self.layers, self.hint):
            column.addWidget(widget)
        column.addWidget(self.plot, 1)
        column.addWidget(self.export)
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
            points, self._distance = along(vertices, step)
            self._unit = f"{layers[0].units[-1]:~P}"
            now = self.viewer.dims.point
            self.profiles = [
                Profile(
                    layer.name,
                    unit_of(layer),
                    sampled(_plane(layer, now), points, _mapper(layer)),
                )
                for layer in layers
            ]
        self.hint.setVisible(not self.profiles)
        self.plot.show_profiles(self._distance, self._unit, self.profiles)

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

    @reporting
    def _draw(self) -> None:
        images = self.checked() or [
            layer for layer in self.viewer.layers if kind_of(layer) == "image"
        ]
        if not images:
            raise InputError(
                "there is no image to draw a line on: open one (File → Open) or take a sample "
                "(File → Open Sample)"
            )
        self.lines.layer = new_shapes(self.viewer, images[-1], "profile", "add_line")

    @reporting
    def _export(self) -> None:
        from napari_shadowinv.io import replacing

        text = self.table()
        name, _ = QFileDialog.getSaveFileName(self, "Export CSV", "profile.csv", "CSV (*.csv)")
        if not name:
            return
        path = Path(name) if Path(name).suffix else Path(name).with_suffix(".csv")
        with replacing(path, overwrite=str(path) == name) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
        tell_info(f"Wrote {path}")


def _plane(layer: Any, point: Any) -> Any:
    """The plane of an image that is shown now."""
    data = layer.data[0] if getattr(layer, "multiscale", False) else layer.data
    if data.ndim == 2:
        return data
    at = np.round(layer.world_to_data(point[-layer.ndim :])[:-2]).astype(int)
    return data[tuple(np.clip(at, 0, np.array(data.shape[:-2]) - 1))]


def _mapper(layer: Any) -> Callable[[Any], Any]:
    scale, translate = np.asarray(layer.scale[-2:]), np.asarray(layer.translate[-2:])
    return lambda points: (points - translate) / scale
