"""*Invert* with many shots: a stack, files, a table of them, or a watched folder."""

import threading
import time

import numpy as np
import pytest

from helpers.forms import enter
from helpers.layers import layer_of
from helpers.reports import texts_of
from napari_shadowinv import InversionOptions, ProtonSetup, invert, read
from napari_shadowinv._napari.layer_metadata import metadata_of, role_of
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore, read_stack
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob, toroid
from napari_shadowinv.stack import _worker

FEW = {"n_sites": 100}
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
def prepared(out):
    """Give a window few sites, one worker and a store."""

    def prepare(widget):
        widget.options.restore(FEW)
        widget.store.folder.restore({"path": str(out)})
        widget.store.run.restore({"workers": 1})
        return widget

    return prepare


@pytest.fixture
def tool(viewer, opened, stack, prepared):
    viewer.add_image(stack, name="shots")
    return prepared(opened(Invert))


def files(tool, kind, path):
    """Take the shots from files of a kind."""
    tool.image.set_kind(kind)
    tool.image.form.restore({"path": str(path)})


@pytest.fixture
def held_at_third(monkeypatch):
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


def test_a_stack_layer_becomes_a_store_and_layers(
    viewer, tool, run, stack, out, messages, proton_setup
):
    tool.setup.show_setup(proton_setup.model_dump())
    tool.store.run.restore({"workers": 2})
    run(tool)
    assert messages == []
    assert (StackStore(out).statuses() == DONE).all()
    assert tool.panel.status.text() == "4 of 4 done, in run.shadowinv.zarr"
    assert tool.stack_view.failures.isHidden()
    field, image = layer_of(viewer, "field"), viewer.layers["shots"]
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
    assert [role_of(layer) for layer in viewer.layers].count("field") == 1


def test_a_corrupt_file_is_listed_and_the_others_are_done(
    viewer, tool, run, stack, out, tmp_path, messages
):
    for index, image in enumerate(stack):
        np.save(tmp_path / f"shot_{index}.npy", image)
    content = (tmp_path / "shot_1.npy").read_bytes()
    (tmp_path / "shot_1.npy").write_bytes(content[:200])
    files(tool, "files", tmp_path / "shot_*.npy")
    run(tool)
    assert messages == []
    assert StackStore(out).statuses().tolist() == [DONE, FAILED, DONE, DONE]
    (name, reason), *further = texts_of(tool.stack_view.failures).items()
    assert name == "shot_1.npy"
    assert reason == StackStore(out).report(1)["reason"]
    assert further == []
    assert not tool.stack_view.failures.isHidden()
    assert tool.panel.status.text() == "3 of 4 done, 1 failed, in run.shadowinv.zarr"
    assert np.isnan(np.asarray(layer_of(viewer, "field").data[1])).all()

    # It stays so until it is to be tried again, which takes a box.
    (tmp_path / "shot_1.npy").write_bytes(content)
    before = written(out)
    run(tool)
    assert list(texts_of(tool.stack_view.failures)) == ["shot_1.npy"]
    enter(tool.store.run.entries["redo_failed"], True)
    run(tool)
    assert tool.stack_view.failures.isHidden()
    assert (StackStore(out).statuses() == DONE).all()
    assert before.items() <= written(out).items()
    assert not tool.store.run.model().redo_failed


def test_cancelled_in_the_middle_it_goes_on_from_there(
    window, open_widget, stack, prepared, run, rest, out, wait, held_at_third, messages
):
    window.add_image(stack, name="shots")
    tool = prepared(open_widget("Invert"))
    tool.panel.button.click()
    wait(lambda: tool.panel.bar.value() == 2)
    assert tool.panel.bar.maximum() == 4
    assert tool.panel.status.text().startswith("Inverting: 2 of 4 done")
    # What is finished can be looked at while the run goes on.
    wait(lambda: not tool.results.busy and bool(tool.results.layers))
    field = layer_of(window, "field")
    assert np.isfinite(np.asarray(field.data[1])).all()
    assert np.isnan(np.asarray(field.data[2])).all()
    window.dims.set_current_step(0, 3)
    wait(lambda: np.isnan(field._slice.image.raw).all())
    arrows = layer_of(window, "arrows")
    assert len(arrows.data) == 0
    tool.panel.button.click()
    assert tool.panel.button.text() == "Cancelling…"
    rest(tool)
    assert tool.panel.status.text() == "Cancelled: 2 of 4 done. Press Run to resume."
    assert StackStore(out).statuses().tolist() == [DONE, DONE, PENDING, PENDING]
    before = written(out)
    assert len(before) == 2
    tool.view.more_layers.click()
    rest(tool)
    potential = layer_of(window, "potential")
    potential.contrast_limits = (-3.0, 4.0)

    held_at_third.set()
    run(tool)
    assert (StackStore(out).statuses() == DONE).all()
    assert before.items() <= written(out).items()
    # The shot in view was pending, and is seen now.
    assert np.isfinite(field._slice.image.raw).all()
    wait(lambda: len(arrows.data) > 0)
    assert (arrows.data[:, 0, 0] == 3).all()
    assert layer_of(window, "field") is field
    assert field.contrast_limits[1] == pytest.approx(float(field.data.max().compute()))
    assert layer_of(window, "potential") is potential
    assert tuple(potential.contrast_limits) == (-3.0, 4.0)
    assert messages == []


def test_a_store_of_other_choices_is_not_continued(tool, run, out, refused):
    run(tool)
    before = written(out)
    tool.options.restore({**FEW, "seed": 7})
    refused(tool, "started with different options (seed: 0 there, 7 now)")
    tool.options.restore(FEW)
    tool.source.set_kind("low-pass")
    refused(tool, "started with a different source")
    assert written(out) == before
    # Overwriting takes a box, which counts once.
    enter(tool.store.run.entries["overwrite"], True)
    run(tool)
    assert not before.items() & written(out).items()
    assert not tool.store.run.model().overwrite


def test_the_shot_in_view_is_saved_alone(viewer, tool, run, out, tmp_path, choose, proton_setup):
    tool.setup.show_setup(proton_setup.model_dump())
    run(tool)
    viewer.dims.set_current_step(0, 1)
    choose(tmp_path / "second")
    tool.view.save_result.click()
    field = read(tmp_path / "second.shadowinv")["displacement"]
    np.testing.assert_array_equal(field, read_stack(out)["displacement"][1])
    viewer.layers.clear()
    viewer.open(str(tmp_path / "second.shadowinv"), plugin="napari-shadowinv")
    assert "T·m" in layer_of(viewer, "field").name


def test_a_table_is_inverted(viewer, opened, prepared, run, tmp_path, messages):
    """One toroid on three films, of which the table leaves the last one out."""
    setup = ProtonSetup(
        energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
    )
    slow = setup.model_copy(update={"energy": 6.0})
    for number, each in enumerate((slow, setup, setup)):
        displacement = toroid((48, 48), each, 25.0, 80e-6).displacement
        np.save(tmp_path / f"film{number}.npy", synthetic_image(displacement))
    rows = ["file,energy,brightness,exclude", "film0.npy,6,1.5,", "film1.npy,,,", "film2.npy,,,yes"]
    (tmp_path / "pack.csv").write_text("\n".join(rows))
    tool = prepared(opened(Invert))
    tool.options.restore({"tolerance": 1e-3})
    files(tool, "table", tmp_path / "pack.csv")
    tool.setup.show_setup(setup.model_dump())
    run(tool)
    store = StackStore(tool.store.path)
    assert messages == []
    assert store.names == ("film0.npy", "film1.npy")
    assert (store.statuses() == DONE).all()
    stack = read(tool.store.path)
    assert [setup_from_dataset(stack.isel(shot=k)) for k in range(2)] == [slow, setup]
    (origin,) = store.report(0)["provenance"]["images"]
    assert origin["brightness"] == 1.5
    # The layer is in the units of each shot's own energy: the same field twice.
    field = layer_of(viewer, "field")
    first, second = (np.asarray(field.data[k]) for k in range(2))
    assert first.max() == pytest.approx(second.max(), rel=0.02)
    reach = np.hypot(*stack["displacement"].values.swapaxes(0, 1)).max(axis=(1, 2))
    assert reach[0] > 1.3 * reach[1]
    in_si = np.hypot(*stack["path_integrated_b"].values[1])
    np.testing.assert_allclose(second / second.max(), in_si / in_si.max(), atol=1e-6)


def test_layers_grow_and_the_newest_shot_is_in_view_unless_one_steps_back(
    window, open_widget, prepared, tmp_path, stack, out, wait, rest, qtbot, messages
):
    folder = tmp_path / "live"
    folder.mkdir()

    def put(index):
        np.save(folder / f"shot_{index}.npy", stack[index % len(stack)])

    def shown(count):
        """Wait until the field has this many shots, and return it."""
        roles = [role_of(layer) for layer in window.layers]
        return "field" in roles and len(layer_of(window, "field").data) == count

    tool = prepared(open_widget("Invert"))
    files(tool, "folder", folder)
    tool.store.watch.restore({"pattern": "*.npy"})
    status = tool.panel.status
    assert tool.store.run.isHidden()
    tool.panel.button.click()
    wait(lambda: "Waiting for shots" in status.text())
    for index in (0, 1):
        put(index)
        wait(lambda: shown(index + 1))  # noqa: B023
    field = layer_of(window, "field")
    wait(lambda: "Waiting for shots: 2 of 2 done" in status.text())
    assert window.dims.current_step[0] == 1
    limits = field.contrast_limits[1]
    assert limits == pytest.approx(float(np.asarray(field.data[1]).max()))
    assert (layer_of(window, "arrows").data[:, 0, 0] == 1).all()
    window.dims.set_current_step(0, 0)
    (folder / "shot_2.npy").write_bytes(b"")
    put(3)
    wait(lambda: shown(4))
    assert window.dims.current_step[0] == 0
    assert field.contrast_limits[1] > limits
    assert np.isfinite(np.asarray(field.data[3])).all()
    assert list(texts_of(tool.stack_view.failures)) == ["shot_2.npy"]
    assert metadata_of(field)["shots"] == [f"shot_{index}.npy" for index in range(4)]
    wait(lambda: "3 of 4 done, 1 failed" in status.text())
    tool.panel.button.click()
    rest(tool)
    assert status.text() == f"3 of 4 done, 1 failed, in {out.name}"
    assert messages == []
    # Run again: it goes on in the same layers.
    tool.panel.button.click()
    window.dims.set_current_step(0, 3)
    put(4)
    wait(lambda: shown(5))
    wait(lambda: window.dims.current_step[0] == 4)
    # A file that fails is not shown in place of the last shot.
    (folder / "shot_5.npy").write_bytes(b"")
    wait(lambda: len(tool.stack_view.failures.rows) == 2)
    qtbot.wait(1000)
    assert window.dims.current_step[0] == 4
    put(6)
    wait(lambda: window.dims.current_step[0] == 6)
    assert layer_of(window, "field") is field
    assert (StackStore(out).statuses() == DONE).sum() == 5
    tool.panel.button.click()
    rest(tool)
