"""Saving a result with a button, and using the reopened result."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from napari_shadowinv import ProtonSetup, read
from napari_shadowinv._napari.layer_metadata import metadata_for, result_of, role_of

PATIENCE = 60_000  # ms


@pytest.fixture
def tool(window, open_widget, shot):
    window.add_image(shot, name="shot", metadata=metadata_for("shot", "", ProtonSetup.example()))
    widget = open_widget("Invert")
    widget.options.restore({"n_sites": 300})
    return widget


def test_saved_result_comes_back_and_is_inverted_again(
    window, tool, run, qtbot, tmp_path, choose, messages
):
    run(tool)
    verdict, peak = tool.verdict.text(), window.layers.selection.active.data.max()
    choose(tmp_path / "a")
    tool.view.save_result.click()
    path = tmp_path / "a.shadowinv"
    assert str(path) in tool.panel.status.text()
    assert str(path) in messages[-1]
    names = [layer.name for layer in window.layers if result_of(layer) is not None]
    window.layers.clear()
    assert tool.verdict.text() != verdict
    window.open(str(path), plugin="napari-shadowinv")
    qtbot.waitUntil(lambda: role_of(window.layers.selection.active) == "field", timeout=PATIENCE)
    field = window.layers.selection.active
    assert field.colorbar.visible
    assert (tool.verdict.text(), field.data.max()) == (verdict, peak)
    assert [layer.name for layer in window.layers if role_of(layer) != "image"] == names
    assert {role_of(layer) for layer in window.layers if layer.visible} == {"field", "arrows"}
    # The image has its setup and source, and is a shot again.
    assert role_of(tool.image.layer) == "image"
    assert tool.setup.setup() == ProtonSetup.example()
    run(tool)
    assert window.layers.selection.active.data.max() == pytest.approx(peak, rel=1e-6)


def test_save_asks_before_it_replaces_a_file(tool, run, tmp_path, choose):
    run(tool)
    path = tmp_path / "a.shadowinv"
    path.write_text("precious")
    choose(tmp_path / "a")
    tool.view.save_result.click()
    assert path.read_text() == "precious"
    choose(tmp_path / "a", replace=True)
    tool.view.save_result.click()
    assert read(path)["displacement"].shape == (2, 48, 60)


def test_save_without_a_result_says_what_to_do(tool, tmp_path, choose, messages):
    choose(tmp_path / "a")
    tool.view.save_result.click()
    assert messages == ["There is no result yet: press Run first, or select a layer of a result"]
    assert not list(tmp_path.glob("a*"))


def test_save_that_fails_leaves_no_file(tool, run, tmp_path, choose, messages):
    run(tool)
    choose(tmp_path / "nowhere" / "a")
    tool.view.save_result.click()
    assert "nowhere" in messages[-1]
    assert "\n" not in messages[-1]
    assert tool.panel.status.text() == messages[-1]
    assert not (tmp_path / "nowhere").exists()


def test_more_layers_adds_those_that_are_missing(tool, window, run, qtbot):
    run(tool)
    few = [role_of(layer) for layer in window.layers]
    assert few == ["shot", "residual", "field", "caustic", "arrows"]
    tool.view.more_layers.click()
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)
    added = {role_of(layer) for layer in window.layers} - set(few)
    assert added == {
        "reprojection", "potential", "field y", "field x", "direction", "field arrows", "sites"
    }  # fmt: skip
    assert {role_of(layer) for layer in window.layers if layer.visible} == {
        "shot",
        "field",
        "arrows",
    }
    count = len(window.layers)
    tool.view.more_layers.click()
    run(tool)
    assert len(window.layers) == count


def test_forward_image_is_saved_with_its_pixels(window, open_widget, qtbot, tmp_path, choose):
    tool = open_widget("Simulate")
    tool.side.setText("40 x 50")
    tool.panel.button.click()
    qtbot.waitUntil(
        lambda: tool.results is not None and bool(tool.results.layers), timeout=PATIENCE
    )
    choose(tmp_path / "image")
    tool.save_result.click()
    saved = tifffile.imread(tmp_path / "image.tif")
    np.testing.assert_allclose(saved, tool.results.layers[0].data, rtol=1e-6)


def test_shot_of_a_store_is_saved_alone(
    window, open_widget, qtbot, tmp_path, choose, shot, proton_setup
):
    stack = np.stack([shot, shot[:, ::-1]])
    window.add_image(stack, name="run", metadata=metadata_for("shot", "", proton_setup))
    tool = open_widget("Invert")
    tool.options.restore({"n_sites": 300})
    tool.store.folder.restore({"path": str(tmp_path / "run.shadowinv.zarr")})
    tool.panel.button.click()
    qtbot.waitUntil(lambda: bool(tool.results.layers), timeout=PATIENCE)
    qtbot.waitUntil(lambda: not tool.panel.running and not tool.results.busy, timeout=PATIENCE)
    window.dims.set_current_step(0, 1)
    choose(tmp_path / "second")
    tool.view.save_result.click()
    field = read(tmp_path / "second.shadowinv")["displacement"].values
    # The second shot is the first one's mirror image.
    blob = field[1][:, field.shape[2] // 2 :]
    assert np.abs(field[1]).max() > 0.5
    assert np.abs(blob).max() < np.abs(field[1]).max() * 1.001
    window.layers.clear()
    (layer, *_) = [
        opened_layer
        for opened_layer in window.open(
            str(tmp_path / "second.shadowinv"), plugin="napari-shadowinv"
        )
        if role_of(opened_layer) == "field"
    ]
    assert "mT·m" in layer.name or "µT·m" in layer.name
