"""Synchronisation with a viewer: events, the colour bar, images that are opened next to results."""

import numpy as np
import pytest

from napari_shadowinv import add_to_viewer
from napari_shadowinv._napari.layer_metadata import frame_of, metadata_for, role_of
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


def test_an_image_of_the_same_size_lies_on_the_result(
    viewer, solved, proton_setup, messages, tmp_path
):
    layers = add_to_viewer(viewer, solved, proton_setup, name="a", translate=(3.0, 4.0))
    frame = frame_of(next(layer for layer in layers if role_of(layer) == "field"))
    for data in (np.ones((40, 52)), np.ones((5, 40, 52)), np.ones((40, 52), np.uint8)):
        messages.clear()
        image = viewer.add_image(data, name="other")
        assert frame_of(image) == frame
        title = "✓ |∫B×dz| (mT·m) – a"
        assert f"'{image.name}' has the same size in pixels as '{title}'" in messages[-1]
        assert "1.5 µm" in messages[-1]
    np.savetxt(tmp_path / "other.txt", np.ones((40, 52)))
    (opened,) = viewer.open(tmp_path / "other.txt", plugin="napari-shadowinv")
    assert frame_of(opened) == frame
    assert {str(unit) for layer in viewer.layers for unit in layer.units[-2:]} == {"micrometer"}
    # One of another size is told how to get a scale.
    image = viewer.add_image(np.ones((30, 52)), name="smaller")
    assert tuple(image.scale) == (1, 1)
    assert "'smaller' is in pixels, the results are in µm" in messages[-1]
    assert "Invert" in messages[-1]


def test_what_has_a_place_keeps_it(viewer, solved, proton_setup, messages):
    viewer.add_image(np.ones((40, 52)))
    add_to_viewer(viewer, solved, name="in pixels")
    first = viewer.add_image(np.ones((40, 52)))
    add_to_viewer(viewer, solved, proton_setup, name="a")
    messages.clear()
    with_scale = viewer.add_image(np.ones((40, 52)), scale=(2, 2), units=("um", "um"))
    of_plugin = viewer.add_image(np.ones((40, 52)), metadata=metadata_for("image", ""))
    viewer.add_labels(np.ones((40, 52), int))
    assert tuple(with_scale.scale) == (2, 2)
    assert tuple(of_plugin.scale) == tuple(first.scale) == (1, 1)
    assert not any("same position" in text or "in pixels" in text for text in messages)


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
