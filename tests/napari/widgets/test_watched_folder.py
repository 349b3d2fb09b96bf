"""*Invert* with a watched folder: its layers grow as shots arrive."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.layers import layer_of
from helpers.reports import texts_of
from napari_shadowinv._napari.form import PROBLEM_STYLE
from napari_shadowinv._napari.layer_metadata import metadata_of, role_of
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob

PATIENCE = 60_000  # ms
SHAPE = (24, 28)


def put(folder, index):
    blob = gaussian_blob(SHAPE, 2.0 + index, 4.0, (10, 12 + index))
    np.save(folder / f"shot_{index}.npy", 100 * synthetic_image(blob.displacement))


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "live").mkdir()
    return tmp_path / "live"


@pytest.fixture
def out(tmp_path):
    return tmp_path / "live.shadowinv.zarr"


@pytest.fixture
def tool(open_widget, folder, out):
    tool = open_widget("Invert")
    tool.options.restore({"n_sites": 100})
    tool.image.set_kind("folder")
    tool.image.form.restore({"path": str(folder)})
    tool.store.watch.restore({"pattern": "*.npy"})
    tool.store.folder.restore({"path": str(out)})
    return tool


def test_layers_grow_and_the_newest_shot_is_in_view_unless_one_steps_back(
    window, tool, folder, out, qtbot, messages
):
    def shown(count):
        """Wait until the field has this many shots, and return it."""

        def is_there():
            roles = [role_of(layer) for layer in window.layers]
            return "field" in roles and len(layer_of(window, "field").data) == count

        qtbot.waitUntil(is_there, timeout=PATIENCE)
        qtbot.waitUntil(lambda: not tool.stack_view.busy, timeout=PATIENCE)
        return layer_of(window, "field")

    assert tool.store.run.isHidden()
    tool.panel.button.click()
    qtbot.waitUntil(lambda: "Waiting for shots" in tool.panel.status.text(), timeout=PATIENCE)
    put(folder, 0)
    field = shown(1)
    put(folder, 1)
    assert shown(2) is field
    qtbot.waitUntil(
        lambda: "Waiting for shots: 2 done" in tool.panel.status.text(), timeout=PATIENCE
    )
    assert window.dims.current_step[0] == 1
    limits = field.contrast_limits[1]
    assert limits == pytest.approx(float(np.asarray(field.data[1]).max()))
    arrows = layer_of(window, "arrows")
    assert (arrows.data[:, 0, 0] == 1).all()
    window.dims.set_current_step(0, 0)
    (folder / "shot_2.npy").write_bytes(b"")
    put(folder, 3)
    shown(4)
    assert window.dims.current_step[0] == 0
    assert field.contrast_limits[1] > limits
    assert np.isfinite(np.asarray(layer_of(window, "field").data[3])).all()
    assert list(texts_of(tool.stack_view.failures)) == ["shot_2.npy"]
    assert metadata_of(field)["shots"] == [f"shot_{index}.npy" for index in range(4)]
    status = tool.panel.status
    qtbot.waitUntil(lambda: "3 done, 1 failed" in status.text(), timeout=PATIENCE)
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)
    expected = "3 done, 1 failed, in live.shadowinv.zarr"
    assert tool.panel.status.text() == expected
    assert messages == []
    # Run again: it goes on in the same layers.
    tool.panel.button.click()
    window.dims.set_current_step(0, 3)
    put(folder, 4)
    assert shown(5) is field
    assert window.dims.current_step[0] == 4
    assert (StackStore(out).statuses() == DONE).sum() == 4
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)


def test_it_fits_and_a_refused_watch_has_its_reason_under_the_button(
    tool, qtbot, messages, assert_it_fits, tmp_path, out
):
    assert_it_fits(tool)
    (tmp_path / "notes.txt").write_text("no folder")
    reasons = {
        str(tmp_path / "nowhere"): "does not exist: expected a folder to watch",
        str(tmp_path / "notes.txt"): "expected a folder to watch",
        "": "o folder is selected",
    }
    for folder, reason in reasons.items():
        messages.clear()
        tool.image.form.restore({"path": folder})
        tool.panel.button.click()
        qtbot.waitUntil(lambda: bool(messages), timeout=PATIENCE)
        qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)
        qtbot.wait(50)
        status, button = tool.panel.status, tool.panel.button
        assert reason in messages[0]
        assert status.text() == messages[0]
        assert status.styleSheet() == PROBLEM_STYLE
        assert not status.visibleRegion().isEmpty()
        assert status.geometry().top() > button.geometry().bottom()
        assert button.text() == "Run"
        assert button.isEnabled()
    assert not out.exists()
