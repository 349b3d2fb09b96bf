"""One colour bar in the canvas, for the image that is seen: `follow_top_image`.

Each layer of napari has a colour bar and a name tag of its own. Where several results lie on top
of each other, only those of the topmost image that is visible say something about what is seen.
"""

from __future__ import annotations

from typing import Any

from napari_shadowinv._napari.following import LayerEvents
from napari_shadowinv._napari.layer_metadata import role_of

__all__ = ["follow_top_image"]

_layers = LayerEvents()


def follow_top_image(viewer: Any) -> None:
    """Show colour bar and name of the topmost visible image, if it is one of this plugin's.

    The name tells the unit. Whoever switches the bar off keeps it off.

    Parameters
    ----------
    viewer : napari.Viewer or napari.components.ViewerModel
        Calling it again with the same viewer does nothing more.
    """
    events = _layers.taken_from(viewer)
    if events is None:
        return
    shown: list[Any] = []

    def follow(_: Any = None) -> None:
        top = _top_image(viewer.layers)
        if shown and shown[0] is top:
            return
        wanted = not shown or shown[0].colorbar.visible
        for layer in shown:
            _show(layer, False)
        if top is not None and role_of(top) is not None:
            shown[:] = [top]
            _show(top, wanted)
        elif wanted:
            shown.clear()

    def watch(event: Any) -> None:
        event.value.events.visible.connect(follow)
        follow()

    def leave(event: Any) -> None:
        event.value.events.visible.disconnect(follow)
        follow()

    for layer in viewer.layers:
        layer.events.visible.connect(follow)
    events.inserted.connect(watch)
    events.removed.connect(leave)
    events.reordered.connect(follow)
    follow()


def _top_image(layers: Any) -> Any | None:
    """The topmost visible layer that has a colour bar; napari has none for colour images."""
    for layer in reversed(layers):
        if layer.visible and layer.__class__.__name__ == "Image":
            return layer if hasattr(layer, "colorbar") and not layer.rgb else None
    return None


def _show(layer: Any, on: bool) -> None:
    layer.colorbar.visible = on
    # Beside the bar, as napari lays out what shares a corner.
    layer.name_overlay.position = layer.colorbar.position
    layer.name_overlay.visible = on
