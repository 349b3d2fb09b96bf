"""The colour bar in the canvas."""

from __future__ import annotations

import numpy as np
from napari.components import ViewerModel

from napari_shadowinv import add_inversion
from napari_shadowinv.inversion import Inversion


def bars(viewer: ViewerModel) -> list[str]:
    """Names beside visible colour bars."""
    shown = [one for one in viewer.layers if hasattr(one, "colorbar") and one.colorbar.visible]
    assert all(one.name_overlay.visible and one.visible for one in shown)
    tags = [one for one in viewer.layers if one.name_overlay.visible]
    assert tags == shown
    return [one.name for one in shown]


def test_only_the_image_that_is_seen_has_a_colour_bar(
    viewer: ViewerModel, solved: Inversion
) -> None:
    add_inversion(viewer, solved, name="a")
    add_inversion(viewer, solved, name="b")
    layers = viewer.layers
    assert bars(viewer) == ["b |d| (px)"]
    layers["b |d| (px)"].visible = False
    assert bars(viewer) == ["a |d| (px)"]
    layers["b potential (px²)"].visible = True
    assert bars(viewer) == ["b potential (px²)"]
    layers.move(layers.index("a |d| (px)"), len(layers))
    assert bars(viewer) == ["a |d| (px)"]
    # What covers them is no image of this plugin's.
    viewer.add_image(np.ones((40, 52)), name="other")
    assert bars(viewer) == []
    layers.remove("other")
    assert bars(viewer) == ["a |d| (px)"]
    layers.remove("a |d| (px)")
    assert bars(viewer) == ["b potential (px²)"]


def test_a_colour_bar_that_was_switched_off_stays_off(
    viewer: ViewerModel, solved: Inversion
) -> None:
    add_inversion(viewer, solved, name="a")
    viewer.layers["a |d| (px)"].colorbar.visible = False
    viewer.layers["a |d| (px)"].visible = False
    viewer.layers["a potential (px²)"].visible = True
    assert not any(one.colorbar.visible for one in viewer.layers if hasattr(one, "colorbar"))
