"""Images that are opened beside results: `place_newcomers`.

Results lie in µm or mm, an image from a file in pixels. Side by side they do not fit on each
other, and napari drops the unit of its scale bar.
"""

from __future__ import annotations

from typing import Any

from napari_shadowinv._napari.following import LayerEvents
from napari_shadowinv._napari.frame import Frame, frame_of
from napari_shadowinv._napari.marks import role_of

__all__ = ["place_newcomers"]

_layers = LayerEvents()


def place_newcomers(viewer: Any) -> None:
    """Lay images that are opened from now on over results of the same size, or say how to.

    An image of as many pixels as a result gets the result's place and pixel size. For one of
    another size the user is told how to give it a scale. What has a scale keeps it.

    Parameters
    ----------
    viewer : napari.Viewer or napari.components.ViewerModel
        Calling it again with the same viewer does nothing more.
    """
    events = _layers.taken_from(viewer)
    if events is None:
        return

    def receive(event: Any) -> None:
        layer = event.value
        if _is_bare_image(layer):
            _receive(layer, [one for one in viewer.layers if _is_placed_field(one)])

    events.inserted.connect(receive)


def _receive(layer: Any, fields: list[Any]) -> None:
    from napari.utils.notifications import show_info, show_warning

    if not fields:
        return
    alike = [one for one in fields if one.data.shape[-2:] == _size(layer)]
    if not alike:
        unit = f"{fields[-1].units[-1]:~P}"
        show_warning(
            f"'{layer.name}' is in pixels, the results are in {unit}, and their sizes differ, so "
            "they do not overlap. Set a scale: choose the layer in 'Invert shot' with its setup "
            "and press Run, or move it into place (layer controls → transform)"
        )
        return
    frame = frame_of(alike[-1])
    for name, value in frame.keywords(stacked=layer.ndim > 2).items():
        setattr(layer, name, value)
    show_info(
        f"'{layer.name}' has the same size in pixels as '{alike[-1].name}': it was placed at the "
        f"same position, with pixels of {frame.scale[-1]:.4g} {alike[-1].units[-1]:~P}"
    )


def _is_bare_image(layer: Any) -> bool:
    """Whether it is an image of the user's that lies where napari puts it by default."""
    if layer.__class__.__name__ != "Image" or not 2 <= layer.ndim <= 3:
        return False
    own = role_of(layer) is not None and layer.source.path is None
    return not own and frame_of(layer) == Frame()


def _is_placed_field(layer: Any) -> bool:
    return role_of(layer) == "field" and frame_of(layer).units != Frame().units


def _size(layer: Any) -> tuple[int, ...]:
    data = layer.data[0] if layer.multiscale else layer.data
    shape = data.shape[:-1] if layer.rgb else data.shape
    return tuple(shape[-2:])
