"""Synchronisation with a viewer: events, the colour bar, images that are opened next to results."""

import numpy as np
import pytest

from napari_shadowinv import add_to_viewer
from napari_shadowinv._napari.viewer_sync import (
    connect,
    connect_layers,
    error_text,
    without_proxy,
)
from napari_shadowinv.errors import InputError


def test_each_layer_is_followed_until_it_is_disconnected(viewer):
    first = viewer.add_image(np.ones((4, 5)))
    calls = []
    names = "name", "paint"  # images have no event `paint`
    disconnect = connect_layers(viewer.layers, names, lambda event: calls.append(event.source))
    second = viewer.add_image(np.ones((4, 5)))
    first.name, second.name = "b", "c"
    assert calls == [first, second]
    disconnect()
    third = viewer.add_image(np.ones((4, 5)))
    first.name, second.name, third.name = "d", "e", "f"
    assert len(calls) == 2


def test_the_list_behind_a_proxy_is_the_same_each_time(viewer):
    from napari.utils._proxies import PublicOnlyProxy

    proxies = [PublicOnlyProxy(viewer) for _ in range(2)]
    assert all(without_proxy(proxy.layers) is viewer.layers for proxy in proxies)
    calls = []
    connect(proxies[0].layers, "inserted", calls.append)
    layer = viewer.add_image(np.ones((4, 5)))
    assert calls[0].value is layer


def bars(viewer):
    """Names beside visible colour bars."""
    with_bar = [
        layer for layer in viewer.layers if hasattr(layer, "colorbar") and layer.colorbar.visible
    ]
    assert all(layer.name_overlay.visible and layer.visible for layer in with_bar)
    tags = [layer for layer in viewer.layers if layer.name_overlay.visible]
    assert tags == with_bar
    return [layer.name for layer in with_bar]


def test_only_the_image_that_is_seen_has_a_colour_bar(viewer, solved):
    add_to_viewer(viewer, solved, name="a")
    add_to_viewer(viewer, solved, name="b")
    layers = viewer.layers
    assert bars(viewer) == ["✓ |d| (px) – b"]
    layers["✓ |d| (px) – b"].visible = False
    assert bars(viewer) == ["✓ |d| (px) – a"]
    layers["✓ residual (% of mean) – b"].visible = True
    assert bars(viewer) == ["✓ residual (% of mean) – b"]
    layers.move(layers.index("✓ |d| (px) – a"), len(layers))
    assert bars(viewer) == ["✓ |d| (px) – a"]
    # What covers them is no image of this plugin's.
    viewer.add_image(np.ones((40, 52)), name="other")
    assert bars(viewer) == []
    layers.remove("other")
    assert bars(viewer) == ["✓ |d| (px) – a"]
    layers.remove("✓ |d| (px) – a")
    assert bars(viewer) == ["✓ residual (% of mean) – b"]


def test_a_colour_bar_that_was_switched_off_stays_off_and_has_room_for_a_long_name(viewer, solved):
    add_to_viewer(viewer, solved, name="a")
    add_to_viewer(viewer, solved, name=80 * "b")
    short, long = (viewer.layers[f"✓ |d| (px) – {name}"] for name in ("a", 80 * "b"))
    long.visible = False
    sizes = [layer.name_overlay.font_size for layer in (short, long)]
    assert sizes[1] * len(long.name) < 1.01 * sizes[0] * 46
    short.colorbar.visible = short.visible = False
    viewer.layers["✓ residual (% of mean) – a"].visible = True
    assert not any(layer.colorbar.visible for layer in viewer.layers if hasattr(layer, "colorbar"))


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("the image is empty", "The image is empty"),
        ("shot.tif: the image is empty", "shot.tif: the image is empty"),
        ("run_3/a has no image", "run_3/a has no image"),
    ],
)
def test_a_sentence_begins_with_a_capital_but_no_name_of_a_file(text, shown):
    assert error_text(InputError(text)) == shown
