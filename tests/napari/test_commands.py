"""One-click commands of the layer menus."""

import threading
import time

import numpy as np
import pytest

from helpers.shifted_pair import shifted_pair
from napari_shadowinv import InputError, invert
from napari_shadowinv._napari import commands, jobs
from napari_shadowinv._napari.layer_metadata import (
    KEY,
    result_of,
    role_of,
    setup_of,
    source_of,
    usable_of,
)
from napari_shadowinv._napari.shots import shot_layer
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair
from napari_shadowinv.preprocessing import measure_shift, move


@pytest.fixture
def shot():
    return synthetic_image(ellipse_pair((32, 40)).displacement)


def add_shot(viewer, image, setup=None):
    data, keywords, _ = shot_layer(image, "shot", setup, (0.0, 2.0))
    return viewer.add_image(data, **keywords)


def test_invert_makes_the_layers_of_the_default_inversion(viewer, shot, proton_setup):
    layer = add_shot(viewer, shot, proton_setup)
    layer.translate = (30.0, 60.0)
    layer.metadata[KEY]["setup_origin"] = "came with experiment.h5"
    by_role = {role_of(keywords): (data, keywords)
                 for data, keywords, _ in commands.invert_uniform(layer)}  # fmt: skip
    field = proton_setup.path_integrated_b(invert(shot).displacement)
    data, keywords = by_role["field"]
    np.testing.assert_allclose(data, 1e6 * np.hypot(*field), rtol=1e-9)
    assert keywords["name"] == "± |∫B×dz| (µT·m) – shot"
    assert keywords["translate"] == (30.0, 60.0)
    assert keywords["scale"] == (1.5, 1.5)
    # They have the setup of the layer, and say so; without one, none.
    for _, keywords, _ in commands.invert_uniform(layer):
        assert setup_of(keywords) == proton_setup
        assert result_of(keywords).origins["Setup"] == "came with experiment.h5"
    ((_, keywords, _), *_) = commands.invert_uniform(add_shot(viewer, shot))
    assert setup_of(keywords) is None
    assert "Setup" not in result_of(keywords).origins


def test_filters_and_estimates(viewer, noisy, shot, proton_setup):
    layer = add_shot(viewer, noisy)
    ((data, keywords, _),) = commands.remove_hot_pixels(layer)
    assert keywords["name"] == "shot without 1 hot or dead pixels"
    assert data[10, 20] < 700
    assert (data != noisy).sum() == 1
    ((data, _, _),) = commands.high_pass(layer)
    assert data.mean() == pytest.approx(noisy.mean())
    slope = data[:, -10:].mean() - data[:, :10].mean()
    assert abs(slope) < 60  # 167 before
    stack = add_shot(viewer, np.stack([np.full_like(noisy, 5), noisy]))
    viewer.dims.set_point(0, 1)
    ((plane, keywords, _),) = commands.high_pass(stack, viewer)
    np.testing.assert_array_equal(plane, data)
    assert keywords["name"].startswith("shot [1] 1 high-pass σ=")


def test_a_wrong_layer_is_one_sentence(viewer, shot):
    points = viewer.add_points(np.zeros((2, 2)))
    colours = viewer.add_image(np.zeros((5, 6, 3)), rgb=True, name="colours")
    grey = {
        None: "no layer is selected: select an image",
        points: "'Points' is of type Points: select a grey image",
        colours: "'colours' is a colour image: select a grey image",
    }
    for command in (commands.invert_uniform, commands.high_pass):
        for layer, words in grey.items():
            with pytest.raises(InputError, match=words):
                command(layer)


def outline(viewer, layer, low, high):
    """A rectangle over the pixels from `low` to `high` of both axes, in the world of a layer."""
    corners = [layer.data_to_world((y, x)) for y in (low, high) for x in (low, high)]
    rectangle = np.array(corners)[[0, 1, 3, 2]]
    return viewer.add_shapes([rectangle], shape_type="rectangle", units=layer.units)


def placed_shot(viewer, shot, setup):
    layer = add_shot(viewer, shot, setup)
    layer.translate = (30.0, 60.0)
    layer.metadata[KEY] |= {"source": 2 * shot, "usable": shot < shot.max()}
    return layer


def test_a_crop_keeps_place_setup_source_and_mask(viewer, shot, proton_setup):
    layer = placed_shot(viewer, shot, proton_setup)
    viewer.add_shapes([[(3, 3), (20, 20)]], shape_type="line", name="profile")
    with pytest.raises(InputError, match="no rectangle to crop to: draw one in a shapes layer"):
        commands.crop(layer, viewer)
    outline(viewer, layer, 5, 14)
    ((data, keywords, _),) = commands.crop(layer, viewer)
    np.testing.assert_array_equal(data, shot[5:15, 5:15])
    cropped = viewer.add_image(data, **keywords)
    assert cropped.name == "shot cropped to 10 × 10 px"
    np.testing.assert_allclose(cropped.data_to_world((0, 0)), layer.data_to_world((5, 5)))
    assert setup_of(cropped) == proton_setup
    np.testing.assert_array_equal(source_of(cropped), 2 * data)
    np.testing.assert_array_equal(usable_of(cropped), data < shot.max())


def test_binned_pixels_are_larger_and_stay_in_place(viewer, shot, proton_setup):
    layer = placed_shot(viewer, shot, proton_setup)
    ((data, keywords, _),) = commands.bin_pixels(layer)
    assert data.sum() == pytest.approx(shot.sum())
    binned = viewer.add_image(data, **keywords)
    assert setup_of(binned).pixel_size == pytest.approx(2 * proton_setup.pixel_size)
    np.testing.assert_allclose(binned.data_to_world((3, 4)), layer.data_to_world((6.5, 8.5)))
    assert source_of(binned).sum() == pytest.approx(2 * data.sum())


def test_a_source_is_moved_to_fit_its_image(viewer):
    image, source = shifted_pair((2.3, -1.6))
    layer = add_shot(viewer, image)
    with pytest.raises(InputError, match="no source for 'shot' is selected: select its source"):
        commands.align_source(layer, viewer)
    beam = viewer.add_image(source, name="beam")
    viewer.layers.selection = {layer, beam}
    ((data, keywords, _),) = commands.align_source(layer, viewer)
    assert role_of(keywords) == "source"
    assert keywords["name"].startswith("beam moved by y +2.")
    np.testing.assert_array_equal(data, move(source, measure_shift(image, source).significant))
    # What is in place stays there.
    viewer.layers.selection = {layer, viewer.add_image(data, name="moved")}
    with pytest.raises(
        InputError, match=r"'moved' need not be moved, or cannot: its shift is y [+-]0\.0"
    ):
        commands.align_source(layer, viewer)
    # Nothing need be selected where only one source fits.
    beam.metadata[KEY] = {"role": "source"}
    viewer.layers.selection = {layer}
    ((again, _, _),) = commands.align_source(layer, viewer)
    np.testing.assert_array_equal(again, data)


def registered(name):
    from napari._app_model import get_app_model

    return lambda: get_app_model().commands.execute_command(f"napari-shadowinv.{name}").result()


def test_from_the_menu_the_selected_image_is_not_its_own_source(make_napari_viewer, in_loop, qtbot):
    window = make_napari_viewer()
    image, source = shifted_pair((2.3, -1.6))
    beam = window.add_image(source, name="beam", metadata={KEY: {"role": "source"}})
    add_shot(window, image)
    in_loop(registered("align_source"))
    qtbot.waitUntil(lambda: len(window.layers) == 3, timeout=30_000)
    moved = window.layers[-1]
    assert moved.name.startswith("beam moved by y +2.")
    assert beam in window.layers


def test_from_the_menu_the_selected_layer_is_worked_on_beside_the_window(
    make_napari_viewer, noisy, shot, in_loop, qtbot, messages, proton_setup
):
    window = make_napari_viewer()
    in_loop(registered("invert_uniform"))
    assert messages == ["No layer is selected: select an image in the layer list"]
    add_shot(window, np.full((20, 20), -1.0))
    in_loop(registered("invert_uniform"))
    qtbot.waitUntil(lambda: len(messages) == 2, timeout=30_000)
    assert messages[1].startswith("Image has 400 negative pixels")
    add_shot(window, noisy)
    in_loop(registered("remove_hot_pixels"))
    qtbot.waitUntil(lambda: len(window.layers) == 3, timeout=30_000)
    assert window.layers[-1].data[10, 20] < 700
    add_shot(window, shot, proton_setup)
    in_loop(registered("invert_uniform"))
    qtbot.waitUntil(lambda: len(window.layers) == 8, timeout=120_000)
    assert window.layers.selection.active.name.startswith("± |∫B×dz| (µT·m) – shot")
    overlays = getattr(getattr(window, "canvas", None), "overlays", window)  # napari before 0.9
    assert overlays.scale_bar.visible


@pytest.mark.parametrize("by", ["its cross", "closing"])
def test_a_command_is_ended_by_its_cross_or_with_its_window(
    make_napari_viewer, shot, in_loop, qtbot, messages, monkeypatch, by
):
    from napari.utils.progress import cancelable_progress, progress

    stopped = threading.Event()

    def wait_for_stop(*_, should_stop, **__):
        while not should_stop():
            time.sleep(0.01)
        stopped.set()
        raise InversionCancelled

    monkeypatch.setattr(jobs, "run", wait_for_stop)
    window = make_napari_viewer(show=True)  # a command belongs to the window in sight
    add_shot(window, shot)
    in_loop(registered("invert_uniform"))
    (bar,) = [bar for bar in progress._all_instances if isinstance(bar, cancelable_progress)]
    assert bar.desc.startswith("Inverting shot")
    if by == "closing":
        window.close()
    else:
        bar.cancel()
    qtbot.waitUntil(stopped.is_set, timeout=30_000)
    qtbot.waitUntil(lambda: bar not in progress._all_instances, timeout=30_000)
    assert messages == []
    assert by == "closing" or len(window.layers) == 1
