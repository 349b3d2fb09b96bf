"""Results as layers that stay where they are when the next result comes.

- place an image and what belongs to it by a setup: `common_frame`
- show a result in layers of its own: `ResultLayers`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from napari_shadowinv._napari.frame import Frame, frame_of, place
from napari_shadowinv._napari.marks import role_of
from napari_shadowinv._napari.widgets._picking import kind_of

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData

__all__ = ["ResultLayers", "common_frame"]


def common_frame(
    viewer: Any,
    image: Any,
    setup: Any | None,
    companions: Sequence[Any],
    crop: tuple[slice, slice] | None,
) -> Frame:
    """Frame of a result, so that it lies on its image.

    Parameters
    ----------
    viewer : napari.Viewer
        Its camera follows where the image goes.
    image : napari.layers.Layer
        The shot; a setup gives it its pixel size.
    setup : ProtonSetup or OpticalSetup or None
        The experiment.
    companions : sequence of napari.layers.Layer
        Source, mask and crop: those that lie as the image does go with it.
    crop : tuple of slice, optional
        The part that was inverted.

    Returns
    -------
    Frame
    """
    before = frame_of(image)
    if setup is not None:
        followers = [layer for layer in companions if frame_of(layer) == before]
        place(image, setup)
        for layer in followers:
            layer.scale = (*layer.scale[:-2], *image.scale[-2:])
            layer.units = (*layer.units[:-2], *image.units[-2:])
    frame = frame_of(image)
    if frame != before:
        viewer.reset_view()
    if crop is None:
        return frame
    y, x = (
        origin + part.start * side
        for origin, part, side in zip(frame.translate, crop, frame.scale, strict=True)
    )
    return replace(frame, translate=(y, x))


class ResultLayers:
    """Layers of a result that is computed again and again.

    Parameters
    ----------
    viewer : napari.Viewer
        Where they are shown.
    """

    def __init__(self, viewer: Any) -> None:
        self._viewer = viewer
        self._layers: dict[str, Any] = {}

    @property
    def layers(self) -> list[Any]:
        """Those that are still in the viewer."""
        return [layer for layer in self._layers.values() if layer in self._viewer.layers]

    def show(self, described: Sequence[FullLayerData]) -> None:
        """Replace the data of the layers; add those that are not there."""
        from napari_shadowinv._napari.layers import add_layers

        here = self.layers
        for data, keywords, kind in described:
            role = str(role_of(keywords))
            layer = self._layers.get(role)
            if layer is not None and layer in here and kind_of(layer) == kind:
                _update(layer, data, keywords)
            else:
                (self._layers[role],) = add_layers(self._viewer, [(data, keywords, kind)])

    def hide(self) -> None:
        """Switch them off."""
        for layer in self.layers:
            layer.visible = False


def _update(layer: Any, data: Any, keywords: dict[str, Any]) -> None:
    frame = {name: keywords[name] for name in ("scale", "translate") if name in keywords}
    layer.data = data
    layer.metadata = keywords["metadata"]
    if layer.name != keywords["name"]:
        layer.name = keywords["name"]
    for name, value in frame.items():
        if tuple(getattr(layer, name)) != tuple(value):
            setattr(layer, name, value)
    if tuple(str(unit) for unit in layer.units) != tuple(keywords["units"]):
        layer.units = keywords["units"]
    if "contrast_limits" in keywords:
        layer.contrast_limits = keywords["contrast_limits"]
