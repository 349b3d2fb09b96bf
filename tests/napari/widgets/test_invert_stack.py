"""The widget that inverts a run of shots, in a real window."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import pytest

from helpers.forms import enter
from helpers.layers import layer_of
from helpers.reports import texts_of
from napari_shadowinv import InversionOptions, invert
from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.stack import _worker

Array = np.ndarray[Any, Any]
FEW = {"n_sites": 100}
PATIENCE = 60_000  # ms
SHAPE = (24, 28)


@pytest.fixture(scope="module")
def stack():
    """Four shots of a blob that grows and wanders."""
    blobs = [gaussian_blob(SHAPE, 2.0 + i, 4.0, (10, 12 + i)) for i in range(4)]
    return np.stack([100 * synthetic_image(blob.displacement) for blob in blobs])


@pytest.fixture
def out(tmp_path):
    return tmp_path / "run.shadowinv.zarr"


@pytest.fixture
def tool(window, open_widget, stack, out):
    window.add_image(stack, name="shots")
    return prepared(open_widget("Invert"), out)


def prepared(widget, out):
    widget.options.restore(FEW)
    widget.store.folder.restore({"path": str(out)})
    widget.store.run.restore({"workers": 1})
    return widget


@pytest.fixture
def run(qtbot):
    """Press Run and wait until run and layers are complete."""

    def pressed(tool):
        tool.panel.button.click()
        qtbot.waitUntil(lambda: at_rest(tool), timeout=PATIENCE)

    return pressed


def at_rest(tool):
    return not (tool.panel.running or tool.stack_view.busy)


@pytest.fixture
def held(monkeypatch):
    """Hold each run at its third shot, as a large image would, until it is stopped or let go."""
    let_go = threading.Event()
    original = _worker.run_prepared
    count = iter(range(1000))

    def holding(*args, should_stop=None, **kwargs):
        if next(count) >= 2:
            while not let_go.is_set() and not should_stop():
                time.sleep(0.01)
        return original(*args, should_stop=should_stop, **kwargs)

    monkeypatch.setattr(_worker, "run_prepared", holding)
    return let_go


def written(out):
    """When each shot's potential was written."""
    chunks = out / "potential" / "c"
    return {path.name: (path / "0" / "0").stat().st_mtime_ns for path in sorted(chunks.iterdir())}


def running():
    """Names of the threads of the run and its shots."""
    names = [thread.name for thread in threading.enumerate()]
    return [name for name in names if name.startswith(("shot", "shadowinv"))]


def test_a_stack_layer_becomes_a_store_and_layers(
    window, tool, run, stack, out, messages, proton_setup
):
    tool.setup.show_setup(proton_setup.model_dump())
    tool.store.run.restore({"workers": 2})
    run(tool)
    assert messages == []
    assert (StackStore(out).statuses() == DONE).all()
    assert tool.panel.status.text() == "4 of 4 done, in run.shadowinv.zarr"
    assert tool.panel.status.toolTip() == str(out)
    assert not tool.stack_view.failures.isVisible()
    field, image = layer_of(window, "field"), window.layers["shots"]
    expected = invert(stack[2], options=InversionOptions(**FEW))
    strength = np.hypot(*proton_setup.path_integrated_b(expected.displacement))
    plane = np.asarray(field.data[2])
    np.testing.assert_allclose(plane / plane.max(), strength / strength.max(), atol=1e-5)
    assert field.data.shape == stack.shape
    np.testing.assert_allclose(field.scale, image.scale)
    assert image.scale[-1] == pytest.approx(1.5)
    assert field.units == image.units
    # The first shot is not the strongest: colours reach to the one that is.
    assert field.contrast_limits[1] == pytest.approx(float(field.data.max().compute()))
    # Again: there is nothing to do.
    before = written(out)
    run(tool)
    assert written(out) == before
    assert [role_of(layer) for layer in window.layers].count("field") == 1


def test_a_corrupt_file_is_listed_and_the_others_are_done(
    window, tool, run, stack, out, tmp_path, messages
):
    for index, image in enumerate(stack):
        np.save(tmp_path / f"shot_{index}.npy", image)
    content = (tmp_path / "shot_1.npy").read_bytes()
    (tmp_path / "shot_1.npy").write_bytes(content[:200])
    tool.image.set_kind("files")
    tool.image.form.restore({"path": str(tmp_path / "shot_*.npy")})
    run(tool)
    assert messages == []
    assert StackStore(out).statuses().tolist() == [DONE, FAILED, DONE, DONE]
    (name, reason), *further = texts_of(tool.stack_view.failures).items()
    assert name == "shot_1.npy"
    assert reason == StackStore(out).report(1)["reason"]
    assert further == []
    assert tool.stack_view.failures.isVisible()
    assert tool.panel.status.text() == ("3 of 4 done, 1 failed, in run.shadowinv.zarr")
    assert np.isnan(np.asarray(layer_of(window, "field").data[1])).all()

    # It stays so until it is to be tried again, which takes a box.
    (tmp_path / "shot_1.npy").write_bytes(content)
    before = written(out)
    run(tool)
    assert list(texts_of(tool.stack_view.failures)) == ["shot_1.npy"]
    enter(tool.store.run.entries["redo_failed"], True)
    run(tool)
    assert not tool.stack_view.failures.isVisible()
    assert (StackStore(out).statuses() == DONE).all()
    assert before.items() <= written(out).items()
    assert not tool.store.run.model().redo_failed


def test_cancelled_in_the_middle_it_goes_on_from_there(
    window, tool, run, out, qtbot, held, messages
):
    tool.panel.button.click()
    qtbot.waitUntil(lambda: tool.panel.bar.value() == 2, timeout=PATIENCE)
    assert tool.panel.bar.maximum() == 4
    assert tool.panel.status.text().startswith("Inverting: 2 of 4 done")
    # What is finished can be looked at while the run goes on.
    qtbot.waitUntil(lambda: not tool.results.busy and bool(tool.results.layers), timeout=PATIENCE)
    field = layer_of(window, "field")
    assert np.isfinite(np.asarray(field.data[1])).all()
    assert np.isnan(np.asarray(field.data[2])).all()
    window.dims.set_current_step(0, 3)
    qtbot.waitUntil(lambda: np.isnan(field._slice.image.raw).all(), timeout=PATIENCE)
    arrows = layer_of(window, "arrows")
    assert len(arrows.data) == 0
    tool.panel.button.click()
    assert tool.panel.button.text() == "Cancelling…"
    qtbot.waitUntil(lambda: at_rest(tool), timeout=PATIENCE)
    assert tool.panel.status.text() == "Cancelled: 2 of 4 done. Press Run to resume."
    assert StackStore(out).statuses().tolist() == [DONE, DONE, PENDING, PENDING]
    before = written(out)
    assert len(before) == 2
    tool.view.more_layers.click()
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)
    potential = layer_of(window, "potential")
    potential.contrast_limits = (-3.0, 4.0)

    held.set()
    run(tool)
    assert (StackStore(out).statuses() == DONE).all()
    assert before.items() <= written(out).items()
    # The shot in view was pending, and is seen now.
    assert np.isfinite(field._slice.image.raw).all()
    qtbot.waitUntil(lambda: len(arrows.data) > 0, timeout=PATIENCE)
    assert (arrows.data[:, 0, 0] == 3).all()
    assert layer_of(window, "field") is field
    assert field.contrast_limits[1] == pytest.approx(float(field.data.max().compute()))
    assert layer_of(window, "potential") is potential
    assert tuple(potential.contrast_limits) == (-3.0, 4.0)
    assert messages == []


def test_closing_the_window_ends_the_run(make_napari_viewer, qtbot, stack, out, held, messages):
    viewer = make_napari_viewer(show=True)
    viewer.add_image(stack, name="shots")
    _, widget = viewer.window.add_plugin_dock_widget("napari-shadowinv", "Invert")
    prepared(widget, out).panel.button.click()
    qtbot.waitUntil(lambda: widget.panel.bar.value() == 2, timeout=PATIENCE)
    viewer.close()
    qtbot.waitUntil(lambda: not running(), timeout=PATIENCE)
    qtbot.wait(100)
    assert messages == []
    assert StackStore(out).statuses().tolist() == [DONE, DONE, PENDING, PENDING]


def test_a_mistake_is_told_once_and_nothing_is_lost(
    window, tool, run, out, messages, qtbot, tmp_path, monkeypatch
):
    def expect(words):
        messages.clear()
        tool.panel.button.click()
        qtbot.waitUntil(lambda: bool(messages) and at_rest(tool), timeout=PATIENCE)
        qtbot.wait(30)
        assert len(messages) == 1, messages
        assert words in messages[0]
        assert tool.panel.button.text() == "Run"
        assert tool.panel.button.isEnabled()

    run(tool)
    before = written(out)
    tool.options.restore({**FEW, "seed": 7})
    expect("started with different options (seed: 0 there, 7 now)")
    tool.options.restore(FEW)
    tool.source.set_kind("low-pass")
    expect("started with a different source")
    tool.source.set_kind("uniform")
    assert written(out) == before

    tool.store.folder.restore({"path": ""})
    expect("o store is selected")
    tool.store.folder.restore({"path": str(tmp_path / "other.shadowinv.zarr")})
    tool.image.set_kind("files")
    expect("o files are selected")
    assert sorted(path.name for path in tmp_path.glob("*.zarr")) == [out.name]


def test_overwriting_takes_a_box_that_counts_once(tool, run, out):
    run(tool)
    before = written(out)
    tool.options.restore({**FEW, "seed": 7})
    enter(tool.store.run.entries["overwrite"], True)
    run(tool)
    assert not before.items() & written(out).items()
    assert not tool.store.run.model().overwrite
