"""Results as layers that stay where they are when the next result comes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from qtpy.QtCore import QObject, Signal
from qtpy.QtWidgets import QCheckBox

from napari_shadowinv._napari.frame import Frame, frame_for, frame_of, place
from napari_shadowinv._napari.layer_metadata import slot_of
from napari_shadowinv._napari.widgets._layers import kind_of
from napari_shadowinv._napari.widgets._qt import timer

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.preprocessing import Recipe

_VISIBLE = 0.02  # of what limits span


def result_frame(image: Any, recipe: Recipe) -> Frame:
    """Frame of a result, so that it lies on its image once that is placed by the setup."""
    frame = frame_of(image)
    if recipe.setup is not None:
        upright = frame_for(image.data.shape, recipe.setup)
        frame = replace(frame, scale=upright.scale, units=upright.units)
    height, width = image.data.shape[-2:]
    return frame.beneath(recipe.matrix((height, width)))


def place_together(viewer: Any, image: Any, setup: Any, companions: Sequence[Any]) -> bool:
    """Give an image, and what lies on it, the setup's pixels; return whether that moved it."""
    # Pixels and lengths side by side would make napari warn at each layer.
    before = frame_of(image)
    others = [
        layer
        for layer in viewer.layers
        if layer is not image
        and kind_of(layer) in ("image", "labels")
        and tuple(layer.data.shape[-2:]) == tuple(image.data.shape[-2:])
    ]
    followers = [layer for layer in (*companions, *others) if frame_of(layer) == before]
    place(image, setup)
    if frame_of(image) == before:
        return False
    for layer in followers:
        layer.scale = (*layer.scale[:-2], *image.scale[-2:])
        layer.units = (*layer.units[:-2], *image.units[-2:])
    viewer.reset_view()
    return True


class ResultLayers(QObject):
    """Layers of a result that may be computed again and again."""

    complete = Signal()  # all layers of the last result are there

    def __init__(self, viewer: Any, parent: QObject) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._layers: dict[str, Any] = {}
        self._order: list[str] = []
        self._waiting: list[FullLayerData] = []
        self._select, self._before, self._fit = True, None, False
        self._timer = timer(self, 0, self._add_next)

    @property
    def layers(self) -> list[Any]:
        """Those that are still in the viewer."""
        return [layer for layer in self._layers.values() if layer in self._viewer.layers]

    @property
    def busy(self) -> bool:
        return bool(self._timer.isActive())

    def show(
        self, described: Sequence[FullLayerData], *, select: bool = True, fit: bool = False
    ) -> None:
        """Replace the data of the layers, the lowest first; add those that are not there.

        The camera is then fitted to all layers if that is asked for.
        """
        # Adding a layer takes napari some tenths of a second: one by one, the window stays alive.
        self._select, self._fit = select, fit
        self._before = self._viewer.layers.selection.active
        here = self.layers
        self._order = [slot_of(keywords) for _, keywords, _ in described]
        self._remove_all_but(set(self._order))
        waiting = []
        for data, keywords, kind in described:
            layer = self._layers.get(slot_of(keywords))
            if layer is None or layer not in here:
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

    def extend(self, described: Sequence[FullLayerData]) -> None:
        """Add layers of the same result below the others, without a change of the selection."""
        self._select, self._before = False, self._viewer.layers.selection.active
        self._order = [slot_of(keywords) for _, keywords, _ in described] + self._order
        self._waiting += described
        self._timer.start()

    @property
    def slots(self) -> set[str]:
        """Roles and parts of the layers that are still in the viewer."""
        return {slot for slot, layer in self._layers.items() if layer in self._viewer.layers}

    def take_over(self, earlier: ResultLayers) -> None:
        """Show the next result in the layers of another one, which shows nothing any more."""
        earlier._timer.stop()
        self._layers, earlier._layers = earlier._layers, {}

    def _remove_all_but(self, slots: set[str]) -> None:
        for slot, layer in list(self._layers.items()):
            if slot not in slots:
                del self._layers[slot]
                if layer in self._viewer.layers:
                    self._viewer.layers.remove(layer)

    def hide(self) -> None:
        for layer in self.layers:
            layer.visible = False

    def _add_next(self) -> None:
        from napari_shadowinv._napari.layers import add_layers

        if self._waiting:
            described = self._waiting.pop(0)
            slot = slot_of(described[1])
            (self._layers[slot],) = add_layers(
                self._viewer, [described], below=self._next_above(slot)
            )
            # Layers that nobody sees yet must not take the selection.
            main = self._layers.get("field") or self._layers.get("fluence")
            active = main if self._select else self._before
            if active is not None and active in self._viewer.layers:
                self._viewer.layers.selection.active = active
        if not self._waiting:
            self._timer.stop()
            self._finish()

    def _finish(self) -> None:
        if self._fit:
            # Layers of an earlier result have the new units only now.
            self._fit = False
            self._viewer.reset_view()
        self.complete.emit()

    def _next_above(self, slot: str) -> Any | None:
        """The lowest layer of the result that lies above this one and is there already."""
        higher = self._order[self._order.index(slot) + 1 :]
        layers = (self._layers.get(one) for one in higher)
        return next((layer for layer in layers if layer in self._viewer.layers), None)


class LastResults:
    """The last result of each shot, which the next one of the same shot replaces or leaves."""

    def __init__(self, viewer: Any, parent: QObject) -> None:
        self._viewer, self._parent = viewer, parent
        self._last: list[tuple[Any, ResultLayers]] = []
        self.keep_earlier = QCheckBox("Keep earlier results")
        self.keep_earlier.setToolTip(
            "<qt>Keep the layers of earlier runs. Otherwise the next result replaces the previous "
            "one of the same shot.</qt>"
        )

    def of(self, shot: Any) -> list[Any]:
        """The layers of the last result of a shot that are still in the viewer."""
        return [layer for known, last in self._last if known == shot for layer in last.layers]

    def shot_of(self, layer: Any) -> Any | None:
        """The image of whose last result a layer is a part; None if it is not one of them."""
        for shot, last in self._last:
            if layer in last.layers and shot in self._viewer.layers:
                return shot
        return None

    def next_of(self, shot: Any) -> ResultLayers:
        """Return what shows the next result of a shot: an image layer, or a name."""
        results = ResultLayers(self._viewer, self._parent)
        for known, last in self._last:
            if known == shot and not self.keep_earlier.isChecked():
                results.take_over(last)
        self._last = [(known, last) for known, last in self._last if known != shot]
        self._last.append((shot, results))
        return results


@dataclass(frozen=True)
class Origins:
    """What an inversion was given, in words; empty where there is no mask or setup."""

    image: str
    source: str
    mask: str
    source_mask: str
    setup: str
    setup_origin: str

    def attributes(self) -> dict[str, str]:
        """What a result keeps of it, beside the names of files."""
        told = {
            "source_origin": self.source,
            "mask_origin": self.mask,
            "source_mask_origin": self.source_mask,
            "setup_origin": self.setup_origin,
        }
        return {name: text for name, text in told.items() if text}

    def rows(self) -> list[tuple[str, str]]:
        """The report of an inversion, in two columns of text."""
        told = [
            ("Image", self.image),
            ("Source", self.source),
            ("Source mask", self.source_mask),
            ("Mask", self.mask),
            ("Setup", self.setup),
        ]
        return [(name, text) for name, text in told if text]


def _can_be_updated(layer: Any, keywords: dict[str, Any]) -> bool:
    """Whether nothing has to change that is easier to make anew."""
    if kind_of(layer) not in ("image", "labels", "vectors"):
        return False
    now, upright = frame_of(layer), Frame()
    rotate = np.asarray(keywords.get("rotate", upright.rotate))[-2:, -2:]
    shear = np.ravel(keywords.get("shear", upright.shear))[-1]
    affine = np.asarray(keywords.get("affine", upright.affine))[-3:, -3:]
    pairs = ((now.rotate, rotate), (now.shear, shear), (now.affine, affine))
    return all(np.allclose(one, other) for one, other in pairs)


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
        # Only a difference that can be seen: to set limits takes as long as data.
        least = _VISIBLE * np.ptp(limits)
        if not np.allclose(layer.contrast_limits, limits, rtol=0, atol=least):
            layer.contrast_limits = limits
    for name in ("features", "length", "edge_width"):
        if name in keywords and kind_of(layer) == "vectors":
            setattr(layer, name, keywords[name])
