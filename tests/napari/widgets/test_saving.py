"""Saving a result with a button, and using the reopened result."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from helpers.layers import by_role
from napari_shadowinv import ProtonSetup, read
from napari_shadowinv._napari.layer_metadata import metadata_for, result_of, role_of
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets.invert import Invert

PATIENCE = 60_000  # ms


@pytest.fixture
def tool(viewer, opened, shot):
    viewer.add_image(shot, name="shot", metadata=metadata_for("shot", "", ProtonSetup.example()))
    widget = opened(Invert)
    widget.options.restore({"n_sites": 300})
    return widget


def test_saved_result_comes_back_and_is_inverted_again(
    window, open_widget, shot, run, qtbot, tmp_path, choose, messages
):
    window.add_image(shot, name="shot", metadata=metadata_for("shot", "", ProtonSetup.example()))
    tool = open_widget("Invert")
    tool.options.restore({"n_sites": 300})
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


def test_save_asks_before_it_replaces_a_file_and_leaves_none_that_fails(
    tool, run, tmp_path, choose, messages
):
    choose(tmp_path / "a")
    tool.view.save_result.click()
    assert messages == ["There is no result yet: press Run first, or select a layer of a result"]
    assert not list(tmp_path.glob("a*"))
    run(tool)
    path = tmp_path / "a.shadowinv"
    path.write_text("precious")
    tool.view.save_result.click()
    assert path.read_text() == "precious"
    choose(tmp_path / "a", replace=True)
    tool.view.save_result.click()
    assert read(path)["displacement"].shape == (2, 48, 60)
    choose(tmp_path / "nowhere" / "a")
    tool.view.save_result.click()
    assert "nowhere" in messages[-1]
    assert "\n" not in messages[-1]
    assert tool.panel.status.text() == messages[-1]
    assert not (tmp_path / "nowhere").exists()


def test_more_layers_adds_those_that_are_missing(tool, viewer, run, qtbot):
    run(tool)
    few = [role_of(layer) for layer in viewer.layers]
    assert few == ["shot", "residual", "field", "caustic", "arrows"]
    tool.view.more_layers.click()
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)
    added = {role_of(layer) for layer in viewer.layers} - set(few)
    assert added == {
        "reprojection", "potential", "field y", "field x", "direction", "field arrows", "sites"
    }  # fmt: skip
    assert {role_of(layer) for layer in viewer.layers if layer.visible} == {
        "shot",
        "field",
        "arrows",
    }
    count = len(viewer.layers)
    tool.view.more_layers.click()
    run(tool)
    assert len(viewer.layers) == count


def test_forward_image_is_saved_with_its_pixels(opened, run, tmp_path, choose):
    tool = opened(Simulate)
    tool.side.setText("40 x 50")
    run(tool)
    choose(tmp_path / "image")
    tool.save_result.click()
    saved = tifffile.imread(tmp_path / "image.tif")
    np.testing.assert_allclose(saved, tool.results.layers[0].data, rtol=1e-6)


def test_shot_of_a_store_is_saved_alone(
    viewer, opened, qtbot, tmp_path, choose, shot, proton_setup
):
    stack = np.stack([shot, shot[:, ::-1]])
    viewer.add_image(stack, name="run", metadata=metadata_for("shot", "", proton_setup))
    tool = opened(Invert)
    tool.options.restore({"n_sites": 300})
    tool.store.folder.restore({"path": str(tmp_path / "run.shadowinv.zarr")})
    tool.panel.button.click()
    qtbot.waitUntil(lambda: bool(tool.results.layers), timeout=PATIENCE)
    qtbot.waitUntil(lambda: not tool.panel.running and not tool.results.busy, timeout=PATIENCE)
    viewer.dims.set_current_step(0, 1)
    choose(tmp_path / "second")
    tool.view.save_result.click()
    field = read(tmp_path / "second.shadowinv")["displacement"].values
    # The second shot is the first one's mirror image.
    blob = field[1][:, field.shape[2] // 2 :]
    assert np.abs(field[1]).max() > 0.5
    assert np.abs(blob).max() < np.abs(field[1]).max() * 1.001
    viewer.layers.clear()
    layers = by_role(viewer.open(str(tmp_path / "second.shadowinv"), plugin="napari-shadowinv"))
    assert "T·m" in layers["field"].name
