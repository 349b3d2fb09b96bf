"""Arrows of a store that follow whoever leafs through its shots.

- arrows that are in a viewer already: `follow_shots`
- those that a reader is about to hand over: `follow_once_added`

Images of a store are read by napari, a shot at a time. It has no such vectors: to show all at
once, the displacement of each shot would have to be read. So those of one shot are replaced by
those of the next.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._napari.layer_metadata import mark_of, role_of
from napari_shadowinv._napari.layers import thinned_arrows
from napari_shadowinv._napari.stores import at_shot, opened_store

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv._napari.layers import FullLayerData

__all__ = ["follow_once_added", "follow_shots"]


def follow_shots(viewer: Any, layer: Any) -> Callable[[], None]:
    """Let arrows show the shot in view, for as long as they are in the viewer.

    Parameters
    ----------
    viewer : napari.Viewer or napari.components.ViewerModel
        Whose axis of shots is moved.
    layer : napari.layers.Vectors
        The arrows, as described by `store_layers`. All shots are drawn at the same scale.

    Returns
    -------
    callable
        Reads the store again, in which the shot in view may not have been done before.
    """
    displacement = _displacement(layer)
    shown: list[int] = []

    def shot_in_view() -> int:
        return round(float(layer.world_to_data(viewer.dims.point[-layer.ndim :])[0]))

    def read() -> None:
        shot = shot_in_view()
        if not layer.visible or not 0 <= shot < len(displacement):
            return
        shown[:] = [shot]
        try:
            plane = displacement[shot].values
        except OSError:
            return  # the field comes from the same place, and tells of it
        data, _ = thinned_arrows(plane)
        layer.data = at_shot(data, shot)
        layer.features = {"displacement": np.hypot(*data[:, 1].T)}

    def read_again() -> None:
        nonlocal displacement
        displacement = _displacement(layer)
        read()

    def follow(_: Any = None) -> None:
        if shown != [shot_in_view()]:
            read()

    def leave(event: Any) -> None:
        if event.value is layer:
            viewer.dims.events.current_step.disconnect(follow)
            viewer.layers.events.removed.disconnect(leave)

    viewer.dims.events.current_step.connect(follow)
    viewer.layers.events.removed.connect(leave)
    layer.events.visible.connect(follow)
    follow()
    return read_again


def _displacement(layer: Any) -> xarray.DataArray:
    dataset = opened_store(Path(mark_of(layer)["store"]))
    return dataset["displacement"].transpose("shot", "component", "y", "x")


def follow_once_added(described: Sequence[FullLayerData]) -> None:
    """Let arrows follow in the window that asked for them; without one, nobody leafs.

    Parameters
    ----------
    described : sequence of (data, keywords, layer type)
        The layers of a store, which the caller hands over to napari.
    """
    if "napari._qt" not in sys.modules:
        return
    from napari import current_viewer

    viewer = current_viewer()
    stores = {mark_of(one[1]).get("store") for one in described if role_of(one[1]) == "arrows"}
    if viewer is None or not stores:
        return

    def begin(event: Any) -> None:
        layer = event.value
        if role_of(layer) == "arrows" and mark_of(layer).get("store") in stores:
            viewer.layers.events.inserted.disconnect(begin)
            follow_shots(viewer, layer)

    viewer.layers.events.inserted.connect(begin)
