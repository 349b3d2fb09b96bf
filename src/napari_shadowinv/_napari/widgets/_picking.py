"""Which layers a widget works on.

- choose a layer: `LayerPicker`
- hear of what is painted, drawn or replaced in the chosen layers: `LayerWatch`
- a layer's type: `kind_of`
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from qtpy.QtCore import QObject, QSignalBlocker, Signal

from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._lifetime import while_alive

__all__ = ["LayerPicker", "LayerWatch", "kind_of"]


def kind_of(layer: Any) -> str:
    """Return a layer's type, such as ``"image"`` or ``"labels"``."""
    # Not by type(): a widget may be handed a proxy, which tells its content's class only here.
    return str(layer.__class__.__name__).lower()


class LayerPicker(SteadyComboBox):
    """A combo box of the viewer's layers of some kinds.

    Parameters
    ----------
    viewer : napari.Viewer
        Its layers are offered.
    kinds : tuple of str
        Layer types, such as ``"image"``.
    none : str
        What to show for no layer; without it the latest layer is chosen.
    suits : callable, optional
        Which of these layers are offered. Default: all.

    Signals
    -------
    picked
        Another layer, or none, is chosen.
    """

    picked = Signal()

    def __init__(
        self,
        viewer: Any,
        kinds: tuple[str, ...],
        none: str = "",
        suits: Callable[[Any], bool] | None = None,
    ) -> None:
        super().__init__()
        self._viewer, self._kinds, self._none, self._suits = viewer, kinds, none, suits
        self._offered: list[Any] = []
        self.fill()
        self.currentIndexChanged.connect(lambda _: self.picked.emit())
        for emitter in (viewer.layers.events.inserted, viewer.layers.events.removed):
            while_alive(self, emitter, self.fill)
        for layer in viewer.layers:
            self._watch_name(layer)
        while_alive(self, viewer.layers.events.inserted, self._on_insertion)

    @property
    def layer(self) -> Any | None:
        """The chosen layer."""
        index = self.currentIndex() - bool(self._none)
        return self._offered[index] if 0 <= index < len(self._offered) else None

    @layer.setter
    def layer(self, layer: Any | None) -> None:
        if layer is None:
            self.setCurrentIndex(0 if self._none else -1)
        elif layer in self._offered:
            self.setCurrentIndex(self._offered.index(layer) + bool(self._none))

    def _on_insertion(self, event: Any) -> None:
        self._watch_name(event.value)

    def _watch_name(self, layer: Any) -> None:
        while_alive(self, layer.events.name, self.fill)

    @property
    def offered(self) -> list[Any]:
        """The layers to choose from."""
        return list(self._offered)

    def fill(self, event: Any = None) -> None:
        """Offer what the viewer has now; what is chosen stays while it is there."""
        before = self.layer
        offered = [layer for layer in self._viewer.layers if self._is_offered(layer)]
        with QSignalBlocker(self):
            self.clear()
            self._offered = offered
            if self._none:
                self.addItem(self._none)
            for layer in offered:
                self.addItem(layer.name)
            if before in offered:
                self.layer = before
            elif not self._none and offered:
                self.layer = offered[-1]
        if self.layer is not before:
            self.picked.emit()

    def _is_offered(self, layer: Any) -> bool:
        return kind_of(layer) in self._kinds and (self._suits is None or self._suits(layer))


class LayerWatch(QObject):
    """Tells when the content of chosen layers changes.

    Parameters
    ----------
    pickers : sequence of LayerPicker or MaskPicker
        Where the layers are chosen.

    Signals
    -------
    edited
        Something was painted, drawn or replaced in a chosen layer.
    """

    edited = Signal()

    def __init__(self, pickers: Sequence[Any]) -> None:
        super().__init__()
        self._pickers = pickers
        self._watched: list[Any] = []
        for picker in pickers:
            picker.picked.connect(self._watch)
        self._watch()

    def _watch(self) -> None:
        for layer in [picker.layer for picker in self._pickers]:
            if layer is None or any(layer is known for known in self._watched):
                continue
            self._watched.append(layer)
            for name in ("data", "paint"):
                if hasattr(layer.events, name):
                    while_alive(self, getattr(layer.events, name), self._on_event)

    def _on_event(self, event: Any) -> None:
        if any(event.source is picker.layer for picker in self._pickers):
            self.edited.emit()
