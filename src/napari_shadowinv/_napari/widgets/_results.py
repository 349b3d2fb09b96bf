"""Results as layers, which the next result of the same shot updates in place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from napari.utils.notifications import show_warning
from qtpy.QtCore import QObject, Signal
from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import ImageJob
from napari_shadowinv._napari.layer_metadata import kind_of
from napari_shadowinv._napari.layers import FullLayerData, LayerData, add_layers
from napari_shadowinv._napari.widgets._qt import timer
from napari_shadowinv.preprocessing import Recipe

_MIN_LIMITS_CHANGE = 0.02  # relative to their range


def result_frame(image: Any, recipe: Recipe) -> about.Frame:
    """Return the frame of a result on its image, with the setup's pixels."""
    frame = about.frame_of(image)
    if recipe.setup is not None:
        upright = about.frame_for(image.data.shape, recipe.setup)
        frame = replace(frame, scale=upright.scale, units=upright.units)
    height, width = image.data.shape[-2:]
    return frame.beneath(recipe.matrix((height, width)))


def place_together(viewer: Any, image: Any, setup: Any, companions: Sequence[Any]) -> bool:
    """Place an image and the layers on it with the setup's pixels; return whether it moved."""
    # napari warns about each layer while pixels and lengths are mixed.
    old = about.frame_of(image)
    same_size = [
        layer
        for layer in viewer.layers
        if kind_of(layer) in ("image", "labels")
        and tuple(layer.data.shape[-2:]) == tuple(image.data.shape[-2:])
        and about.frame_of(layer) == old
    ]
    on_image = [layer for layer in companions if about.frame_of(layer).units == old.units]
    upright = about.frame_for(image.data.shape, setup)
    image.scale = (*image.scale[:-2], *upright.scale)
    image.units = (*image.units[:-2], *upright.units)
    image.axis_labels = (*image.axis_labels[:-2], "y", "x")
    new = about.frame_of(image)
    if new == old:
        return False
    ratio = np.divide(new.scale, old.scale)
    for layer in dict.fromkeys((*on_image, *same_size)):
        if layer is image:
            continue
        frame = about.frame_of(layer)
        shift = ratio * np.subtract(frame.translate, old.translate)
        layer.translate = (*layer.translate[:-2], *(new.translate + shift))
        layer.scale = (*layer.scale[:-2], *(ratio * frame.scale))
        layer.units = (*layer.units[:-2], *image.units[-2:])
    viewer.reset_view()
    return True


def place_inputs(viewer: Any, job: ImageJob, *, quiet: bool = False) -> bool:
    """Place the layers of a job with the setup's pixels; return whether they moved.

    Unless `quiet`, warn if the image was deleted.
    """
    if job.image not in viewer.layers and not quiet:
        show_warning(
            f"'{job.image_name}' was deleted during its {job.task}; the result is shown anyway"
        )
    inputs = [layer for layer in (job.image, *job.companions) if layer in viewer.layers]
    if not inputs or job.recipe.setup is None:
        return False
    return place_together(viewer, inputs[0], job.recipe.setup, inputs[1:])


class ResultLayers(QObject):
    """Layers of a result, which later results update."""

    complete = Signal()  # all layers of the last result have been added

    def __init__(self, viewer: Any, parent: QObject) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._layers: dict[str, Any] = {}
        self._order: list[str] = []
        self._waiting: LayerData = []
        self._select, self._before, self._fit = True, None, False
        self._timer = timer(self, 0, self._add_next)

    @property
    def layers(self) -> list[Any]:
        """The layers that are still in the viewer."""
        return [layer for layer in self._layers.values() if layer in self._viewer.layers]

    @property
    def busy(self) -> bool:
        return bool(self._timer.isActive())

    def show(
        self, layer_data: Sequence[FullLayerData], *, select: bool = True, fit: bool = False
    ) -> None:
        """Update the layers, the lowest first, and add missing ones.

        With `fit`, the camera is then fitted to all layers.
        """
        # Adding a layer takes napari some tenths of a second: one at a time, the window responds.
        self._select, self._fit = select, fit
        self._before = self._viewer.layers.selection.active
        present = self.layers
        self._order = [about.layer_key(keywords) for _, keywords, _ in layer_data]
        for key in [key for key in self._layers if key not in self._order]:
            layer = self._layers.pop(key)
            if layer in present:
                self._viewer.layers.remove(layer)
        waiting = []
        for data, keywords, kind in layer_data:
            layer = self._layers.get(about.layer_key(keywords))
            if layer is None or layer not in present:
                waiting.append((data, keywords, kind))
            elif kind_of(layer) == kind and _can_be_updated(layer, keywords):
                _update(layer, data, keywords)
            else:
                keywords = {**keywords, "visible": layer.visible}
                self._viewer.layers.remove(layer)
                waiting.append((data, keywords, kind))
        self._waiting = sorted(waiting, key=lambda layer: not layer[1].get("visible", True))
        if self._waiting:
            self._timer.start()
        else:
            self._finish()

    def extend(self, layer_data: Sequence[FullLayerData]) -> None:
        """Add layers of the same result below the others, keeping the selection."""
        self._select, self._before = False, self._viewer.layers.selection.active
        self._order = [about.layer_key(keywords) for _, keywords, _ in layer_data] + self._order
        self._waiting += layer_data
        self._timer.start()

    @property
    def layer_keys(self) -> set[str]:
        """Keys of the layers that are still in the viewer."""
        return {key for key, layer in self._layers.items() if layer in self._viewer.layers}

    def take_over(self, earlier: ResultLayers) -> None:
        """Take the layers of an earlier result, to update them with the next one."""
        earlier._timer.stop()
        self._layers, earlier._layers = earlier._layers, {}

    def adopt(self, layers: Sequence[Any]) -> None:
        """Update layers of an opened result with the next one."""
        self._layers = {about.layer_key(layer): layer for layer in layers}

    def hide(self) -> None:
        for layer in self.layers:
            layer.visible = False

    def _add_next(self) -> None:
        if self._waiting:
            layer = self._waiting.pop(0)
            key = about.layer_key(layer[1])
            (self._layers[key],) = add_layers(self._viewer, [layer], below=self._next_above(key))
            # Hidden layers must not take the selection.
            main = self._layers.get("field") or self._layers.get("fluence")
            active = main if self._select else self._before
            if active is not None and active in self._viewer.layers:
                self._viewer.layers.selection.active = active
        if not self._waiting:
            self._timer.stop()
            self._finish()

    def _finish(self) -> None:
        if self._fit:
            # Only now all layers of an earlier result have the new units.
            self._fit = False
            self._viewer.reset_view()
        self.complete.emit()

    def _next_above(self, key: str) -> Any | None:
        """Return the lowest present layer of the result that belongs above this one."""
        higher = self._order[self._order.index(key) + 1 :]
        layers = map(self._layers.get, higher)
        return next((layer for layer in layers if layer in self._viewer.layers), None)


class LastResults:
    """The last result of each shot, which the next one replaces unless earlier ones are kept."""

    def __init__(self, viewer: Any, parent: QObject) -> None:
        self._viewer, self._parent = viewer, parent
        self._last: dict[Any, ResultLayers] = {}  # by image layer or name
        tip = (
            "<qt>Keep the layers of earlier runs. Otherwise each new result replaces the previous "
            "result of the same shot.</qt>"
        )
        self.keep_earlier = QCheckBox("Keep earlier results", toolTip=tip)

    def layers_of(self, shot: Any) -> list[Any]:
        """Return the layers of a shot's last result that are still in the viewer."""
        return self._last[shot].layers if shot in self._last else []

    def shot_of(self, layer: Any) -> Any | None:
        """Return the shot to whose last result a layer belongs, or None."""
        shots = (shot for shot, last in self._last.items() if layer in last.layers)
        return next((shot for shot in shots if shot in self._viewer.layers), None)

    def layers_for_next(self, shot: Any) -> ResultLayers:
        """Return the layers for the next result of a shot, which is an image layer or a name."""
        results = ResultLayers(self._viewer, self._parent)
        last = self._last.pop(shot, None)
        if last is not None and not self.keep_earlier.isChecked():
            results.take_over(last)
        self._last[shot] = results
        return results


def _can_be_updated(layer: Any, keywords: dict[str, Any]) -> bool:
    """Whether a layer can be updated; a new type or rotation needs a new layer."""
    if kind_of(layer) not in ("image", "labels", "vectors"):
        return False
    frame, upright = about.frame_of(layer), about.Frame()
    rotate = np.asarray(keywords.get("rotate", upright.rotate))[-2:, -2:]
    shear = np.ravel(keywords.get("shear", upright.shear))[-1]
    affine = np.asarray(keywords.get("affine", upright.affine))[-3:, -3:]
    pairs = ((frame.rotate, rotate), (frame.shear, shear), (frame.affine, affine))
    return all(np.allclose(old, new) for old, new in pairs)


def _update(layer: Any, data: Any, keywords: dict[str, Any]) -> None:
    layer.data = data
    layer.metadata = keywords["metadata"]
    if layer.name != keywords["name"]:
        layer.name = keywords["name"]
    for name in ("scale", "translate"):
        if tuple(getattr(layer, name)) != tuple(keywords[name]):
            setattr(layer, name, keywords[name])
    if tuple(str(unit) for unit in layer.units) != tuple(keywords["units"]):
        layer.units = keywords["units"]
    limits = keywords.get("contrast_limits")
    if limits is not None:
        # Only visible changes: setting limits takes as long as setting data.
        tolerance = _MIN_LIMITS_CHANGE * np.ptp(limits)
        if not np.allclose(layer.contrast_limits, limits, rtol=0, atol=tolerance):
            layer.contrast_limits = limits
    for name in ("features", "length", "edge_width"):
        if name in keywords and kind_of(layer) == "vectors":
            setattr(layer, name, keywords[name])
