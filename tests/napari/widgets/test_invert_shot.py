"""The widget that inverts a shot, in a real window."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

import h5py
import numpy as np
import pytest
from napari.utils import progress

from helpers.forms import enter
from helpers.jobs import run_job
from helpers.layers import layer_of
from helpers.reports import texts_of
from napari_shadowinv import Instrument, InversionOptions, ProtonSetup, invert
from napari_shadowinv._napari import jobs
from napari_shadowinv._napari.jobs import Job
from napari_shadowinv._napari.layer_metadata import (
    frame_of,
    metadata_for,
    result_of,
    role_of,
    unit_of,
)
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob, toroid
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.preprocessing import STEPS

Array = np.ndarray[Any, Any]
FEW = {"n_sites": 500}
PATIENCE = 60_000  # ms; a machine may have other things to do


@pytest.fixture
def tool(window, open_widget, shot):
    window.add_image(shot, name="shot")
    widget = open_widget("Invert")
    widget.options.restore(FEW)
    return widget


@pytest.fixture
def slow(monkeypatch):
    """Make every run wait, as a large image would, until it is stopped or let go."""
    let_go = threading.Event()
    work = Job.work

    def work_slowly(job, on_progress, should_stop):
        while not let_go.is_set() and not should_stop():
            time.sleep(0.01)
        return work(job, on_progress, should_stop)

    monkeypatch.setattr(Job, "work", work_slowly)
    return let_go


def computed(tool):
    """Return the inversion of the controls, without its layers."""
    return run_job(tool.request())


def settled(tool):
    return not tool.panel.running and not tool._preview_timer.isActive()


def test_the_window_thread_computes_nothing_during_a_run(window, tool, qtbot):
    tool.options.restore({"n_sites": 2_000})
    qtbot.wait(300)
    tool.show_result = lambda *_: None
    rooms: set[str] = set()

    def note_room(frame, event, _):
        if event == "call":
            rooms.add(".".join(str(frame.f_globals.get("__name__", "")).split(".")[:2]))

    tool.panel.button.click()
    sys.setprofile(note_room)  # of this thread alone
    try:
        qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)
    finally:
        sys.setprofile(None)
    computing = {"geometry", "transport", "inversion", "physics", "preprocessing", "pipeline"}
    assert "napari_shadowinv._napari" in rooms
    assert not rooms & {f"napari_shadowinv.{room}" for room in computing}


def test_an_image_deleted_during_the_run_is_told_once(window, tool, slow, messages, qtbot):
    tool.panel.button.click()
    qtbot.waitUntil(lambda: tool.panel.button.text() == "Cancel", timeout=PATIENCE)
    window.layers.remove(window.layers["shot"])
    slow.set()
    qtbot.waitUntil(lambda: bool(tool.results.layers), timeout=PATIENCE)
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)
    (deleted,) = messages
    assert "was deleted" in deleted
    assert layer_of(window, "field").data.any()


def test_one_click_inverts_the_image_in_si_units(window, tool, run, shot, proton_setup):
    tool.setup.show_setup(proton_setup.model_dump())
    run(tool)
    expected = invert(shot, options=InversionOptions(**FEW))
    field = layer_of(window, "field")
    np.testing.assert_allclose(result_of(field).content.potential, expected.potential, atol=1e-9)
    strength = np.hypot(*proton_setup.path_integrated_b(expected.displacement))
    prefix = {"µT·m": 1e6, "mT·m": 1e3, "T·m": 1.0}[unit_of(field)]
    assert field.data.max() == pytest.approx(prefix * strength.max(), rel=1e-6)
    for layer in (window.layers["shot"], field):
        assert tuple(layer.scale) == pytest.approx((1.5, 1.5))
        assert str(layer.units[0]) == "micrometer"
    report = texts_of(tool.report)
    assert report["Flux residual"].endswith(": converged")
    assert report["Sites"] == "500; as requested"
    assert "sites" in report["Time"]
    assert tool.report.isVisible()
    assert tool.panel.button.text() == "Run"
    assert not progress._all_instances


def test_the_source_of_a_shot_a_layer_or_a_file_is_used(window, tool, shot, tmp_path, proton_setup):
    beam = 300 * (1 + np.linspace(0, 0.2, shot.shape[1]) + np.zeros(shot.shape))
    with h5py.File(tmp_path / "run.nxs", "w") as file:
        file["entry/beam"], file["entry/dark"] = beam, 0 * beam
    window.add_image(beam, name="beam")
    metadata = metadata_for("shot", "", proton_setup, source=beam)
    window.add_image(shot, name="measured", metadata=metadata)
    tool.source.layer = window.layers["beam"]
    tool.image.layer = window.layers["measured"]
    assert tool.setup.setup() == proton_setup
    assert tool.source.kind == "own"
    for kind in ("own", window.layers["beam"], "file"):
        tool.source.set_kind(kind)
        if kind == "file":
            enter(tool.source.form.entries["file"], f"{tmp_path / 'run.nxs'}::/entry/beam")
        np.testing.assert_allclose(computed(tool).source, beam)
    tool.source.set_kind("own")
    tool.image.layer = window.layers["shot"]
    assert tool.source.kind == "uniform"
    tool.source.set_kind("low-pass")
    estimated = computed(tool).source
    assert 0 < estimated.std() < 0.2 * estimated.mean()


def test_what_a_file_brings_is_used_and_told(window, tool, shot):
    mask = np.zeros(shot.shape, np.uint8)
    mask[:, :5] = 1
    window.add_labels(mask, metadata=metadata_for("mask", "", path="a.txt"))
    metadata = metadata_for(
        "shot", "", path="a.txt", cautions=[Caution("film-scan", "it may be film")]
    )
    tool.masks.painted_is_unusable.setChecked(False)
    tool.image.layer = window.add_image(shot, name="other", metadata=metadata)
    inversion = computed(tool)
    assert (inversion.mask == (mask == 0)).all()
    assert inversion.report.cautions[-1].text == "it may be film"


def test_a_run_replaces_the_last_result_of_its_shot(
    window, tool, run, shot, proton_setup, messages, qtbot
):
    run(tool)
    tool.view.more_layers.click()
    qtbot.waitUntil(lambda: not tool.results.busy, timeout=PATIENCE)
    first = list(window.layers)
    layer_of(window, "caustic").visible = True
    layer_of(window, "sites").visible = True
    tool.setup.show_setup(proton_setup.model_dump())
    tool.options.restore({"n_sites": 300})
    run(tool)
    roles = [role_of(layer) for layer in window.layers if result_of(layer) is not None]
    assert len(roles) == len(set(roles)) == len(first) - 1
    few = InversionOptions(n_sites=300)
    expected = invert(shot, options=few)
    for layer in window.layers:
        result = result_of(layer)
        if result is not None:
            assert result.content.options == few
    np.testing.assert_allclose(layer_of(window, "sites").data, expected.cells.sites)
    assert layer_of(window, "sites").visible
    assert layer_of(window, "caustic").visible
    strength = np.hypot(*proton_setup.path_integrated_b(expected.displacement))
    field = layer_of(window, "field")
    assert field in first
    assert field.data.max() == pytest.approx(1e3 * strength.max(), rel=1e-6)
    assert "mT·m" in field.name
    np.testing.assert_allclose(layer_of(window, "arrows").scale, (1.5, 1.5))

    # Another shot has results of its own, and so has a run that is told to keep the last.
    count = len(window.layers)
    assert not any(text.startswith(("Determined:", "Failed:")) for text in messages)
    metadata = metadata_for("shot", "", proton_setup)
    tool.image.layer = window.add_image(2 * shot, name="second", metadata=metadata)
    run(tool)
    assert len(window.layers) == count + 1 + 4
    tool.keep_earlier.setChecked(True)
    run(tool)
    assert len(window.layers) == count + 1 + 2 * 4
    bars = [image.name for image in window.layers if getattr(image, "colorbar", None) is not None]
    with_bar = [image for image in window.layers if image.name in bars and image.colorbar.visible]
    assert [(role_of(image), image.visible) for image in with_bar] == [("field", True)]


USER_ERRORS = {
    "no image": None,
    "colour": np.ones((20, 20, 3)),
    "o store is selected": np.ones((3, 20, 20)),
    "NaN": np.full((20, 20), np.nan),
}


def test_a_mistake_is_told_once_and_the_viewer_lives(
    window, open_widget, messages, qtbot, monkeypatch
):
    tool = open_widget("Invert")
    tool.options.restore(FEW)

    def expect(words):
        """Press Run, and check that it sends one notification with these words."""
        messages.clear()
        tool.panel.button.click()
        qtbot.waitUntil(lambda: bool(messages) and not tool.panel.running, timeout=PATIENCE)
        qtbot.wait(30)
        assert len(messages) == 1, messages
        assert words in messages[0]
        assert "\n" not in messages[0]
        # It can be read when the notification is gone.
        assert words.lower() in tool.panel.status.text().lower()
        assert tool.panel.status.isVisible()
        assert tool.panel.button.text() == "Run"
        assert tool.panel.button.isEnabled()

    for words, data in USER_ERRORS.items():
        window.layers.clear()
        if data is not None:
            rgb = data.shape[-1] == 3
            window.add_image(data, rgb=rgb, contrast_limits=None if rgb else (0, 1))
        expect(words)

    window.layers.clear()
    window.add_image(np.ones((20, 20)), name="shot")
    tool._draw_crop()
    tool.crop.layer.add_rectangles(np.array([[500, 500], [500, 600], [600, 600], [600, 500]]))
    expect("0 × 0 pixels")
    tool.crop.layer = None

    def broken(*_, **__):
        raise ZeroDivisionError("a fault of the program's")

    monkeypatch.setattr(jobs, "run", broken)
    expect("a fault of the program's")


def test_whole_numbers_and_the_finest_of_many_scales_are_inverted(
    window, tool, shot, run, messages
):
    counts = np.round(shot).astype(np.uint16)
    tool.image.layer = window.add_image(counts, name="counts")
    np.testing.assert_allclose(computed(tool).image, counts)
    pyramid = window.add_image([counts, counts[::2, ::2]], name="pyramid", multiscale=True)
    tool.image.layer = pyramid
    tool.setup.show_setup(ProtonSetup.example().model_dump())
    run(tool)
    field = layer_of(window, "field")
    assert field.data.shape == shot.shape
    np.testing.assert_allclose(pyramid.scale, 1.5)
    np.testing.assert_allclose(field.data_to_world((20, 30)), pyramid.data_to_world((20, 30)))
    # Nobody recorded the beam: a condition, which is said without a warning.
    assert messages == []
    assert tool.verdict.text().startswith("<b>Depends on the beam</b>")
    assert field.name.startswith("± ")


def test_the_result_lies_on_an_image_that_was_turned(window, tool, shot, run, messages):
    turned = window.add_image(
        shot, name="turned", rotate=30, shear=[0.2], scale=(2, 3), translate=(7, -4),
        affine=[[1, 0.1, 5], [0, 1.2, 6], [0, 0, 1]],
    )  # fmt: skip
    tool.image.layer = turned
    tool.crop.layer = window.add_shapes(
        np.array([[5, 8], [5, 50], [40, 50], [40, 8]]),
        **frame_of(turned).keywords(),
    )
    run(tool)
    for role in ("field", "arrows", "residual", "caustic"):
        layer = layer_of(window, role)
        for y, x in ((0.0, 0.0), (20.0, 30.0)):
            np.testing.assert_allclose(
                layer.data_to_world((y, x)), turned.data_to_world((y + 5, x + 8))
            )
    stacked = frame_of(turned).keywords(stacked=True)
    stack = window.add_image(np.ones((2, *shot.shape)), name="stacked", **stacked)
    np.testing.assert_allclose(stack.data_to_world((1, 3, 4))[1:], turned.data_to_world((3, 4)))
    assert frame_of(stack) == frame_of(turned)
    assert [text.partition(":")[0] for text in messages] == ["Too uncertain"]


def test_the_preview_follows_in_its_own_layers(window, tool, qtbot, messages):
    noise = np.random.default_rng(0).normal(0, 0.05, (200, 200))
    shot = (
        synthetic_image(toroid((200, 200), ProtonSetup.example(), 97, 30e-6).displacement) + noise
    )
    window.layers["shot"].data = np.maximum(shot, 0)
    # Without a graphics card, drawing a large window takes longer than the inversion.
    window.window._qt_window.resize(900, 600)
    tool.options.restore({})
    tool.live.setChecked(True)
    qtbot.waitUntil(lambda: len(tool.previewed.layers) == 2 and settled(tool), timeout=PATIENCE)
    before = tool.previewed.layers
    field = layer_of(window, "field", "preview")
    assert "Preview: " in tool.verdict.text()
    residual = result_of(field).content.report.image_residual
    assert percent(residual) in tool.panel.status.text()

    def follows(change):
        """Wait until the layer follows a change."""
        qtbot.waitUntil(lambda: settled(tool), timeout=PATIENCE)
        qtbot.wait(100)  # the last picture is drawn
        old = field.data
        change()
        qtbot.waitUntil(lambda: field.data is not old, timeout=PATIENCE)

    tool.masks.paint()
    follows(lambda: tool.steps.add("low-pass"))
    follows(lambda: enter(tool.steps.forms[0].form.entries["width"], 2.0))
    follows(lambda: enter(tool.options.entries["floor"], 0.5))
    follows(lambda: tool.masks.layer.paint((30, 10), 1))
    assert not result_of(field).content.mask.all()
    tool.masks.layer = None
    tool.options.restore({})
    tool._draw_crop()
    corners = np.array([[0, 0], [0, 150], [199, 150], [199, 0]])
    follows(lambda: tool.crop.layer.add_rectangles(corners))
    assert field.data.shape == (200, 151)
    follows(lambda: setattr(tool.crop, "layer", None))
    follows(lambda: tool.source.set_kind("low-pass"))
    width = tool.source.form.entries["width"]
    outcomes: list[Any] = []
    tool.panel.ended.connect(outcomes.append)
    for value in np.linspace(40, 60, 21):
        enter(width, value)
        qtbot.wait(2)
    qtbot.waitUntil(lambda: settled(tool), timeout=PATIENCE)
    assert outcomes[-1].tag.recipe.source.width == pytest.approx(60)
    assert outcomes[-1].value is not None
    outcomes.clear()
    for value in np.linspace(59, 50, 10):  # as fast as one event of the window
        enter(width, value)
    qtbot.waitUntil(lambda: settled(tool), timeout=PATIENCE)
    assert [outcome.tag.recipe.source.width for outcome in outcomes] == [pytest.approx(50)]
    assert [a is b for a, b in zip(before, tool.previewed.layers, strict=True)] == [True] * 2
    assert messages == []


def test_it_fits_and_remembers(window, tool, qtbot, assert_it_fits):
    tool.options.restore({"seed": 5})
    tool.source.set_kind("interpolated")
    tool.setup.show_setup(ProtonSetup.example().model_dump())
    for name in STEPS:
        tool.steps.add(name)
    tool.steps.folded.expand()
    tool.store.run.restore({"workers": 3, "overwrite": True})
    assert_it_fits(tool)
    tool.write_state()
    again = Invert(window)
    qtbot.addWidget(again)
    assert again.options.model() == InversionOptions(seed=5)
    assert again.setup.setup() == ProtonSetup.example()
    assert again.source.model() == tool.source.model()
    assert again.store.run.model() == RunOptions(workers=3)
    assert again.steps.steps() == tuple(step() for step in STEPS.values())
    steps = "Steps: subtract dark level, rotate, crop, remove hot pixels, bin"
    assert again.steps.folded.text().startswith(steps)


def test_doubts_stand_under_run_with_a_notification(window, tool, run, messages):
    tool.options.restore({**FEW, "max_iterations": 1})
    run(tool)
    assert "Failed" in tool.verdict.text()
    (text,) = messages
    assert text.startswith("Failed: ")
    assert "--" not in tool.verdict.text()
    assert layer_of(window, "field").name.startswith("✗ ")
    messages.clear()
    x = np.mgrid[:48, :60][1]
    edge = synthetic_image(np.stack([0 * x, 0.03 * (x - 20.0)]))
    window.layers["shot"].data = edge
    tool.options.restore(FEW)
    run(tool)
    report = result_of(layer_of(window, "field")).content.report
    assert report.converged
    assert report.cautions
    verdict = result_of(layer_of(window, "field")).content.verdict.capitalize()
    assert tool.verdict.text().startswith(f"<b>{verdict}")
    assert messages[-1].startswith(verdict)
    assert layer_of(window, "field").name.startswith("? ")
    assert "Iterations" in texts_of(tool.report)
    assert not tool.report.details.isExpanded()


def test_menu_brings_a_hidden_tab_to_the_front(window, tool, open_widget, qtbot):
    qtbot.waitUntil(lambda: tool._dock is not None, timeout=PATIENCE)
    front = open_widget("Analyse")
    qtbot.waitUntil(lambda: tool.visibleRegion().isEmpty(), timeout=PATIENCE)
    dock = tool._dock
    dock.setVisible(not dock.isVisible())  # as napari's menu does
    qtbot.waitUntil(lambda: not tool.visibleRegion().isEmpty(), timeout=PATIENCE)
    assert front.visibleRegion().isEmpty()
    qtbot.wait(50)
    dock.setVisible(not dock.isVisible())
    qtbot.wait(50)
    assert not dock.isVisible()


def test_camera_fits_after_units_change(window, tool, run, proton_setup):
    run(tool)
    tool.setup.show_setup(proton_setup.model_dump())
    run(tool)
    centre = np.array(window.layers["shot"].extent.world).mean(axis=0)
    camera = getattr(window, "scene", window).camera  # napari before 0.9
    np.testing.assert_allclose(camera.center[-2:], centre[-2:], rtol=0.05)
    zoom = camera.zoom
    window.reset_view()
    assert camera.zoom == pytest.approx(zoom)


def test_a_layer_of_an_estimated_source_was_not_measured(tool, window, qtbot):
    """An estimate has the error of an unmeasured beam; a layer that was opened has not."""
    tool.source.set_kind("polynomial")
    tool.show_source.click()
    name = "shot source: fitted polynomial"
    qtbot.waitUntil(lambda: name in window.layers, timeout=PATIENCE)
    source = window.layers[name]
    tool.source.layer = source
    assert tool.recipe().instrument == Instrument(beam_rms=0.05)
    enter(tool.instrument.entries["beam_source"], "laser")
    enter(tool.instrument.entries["beam_rms"], 0.01)
    assert tool.recipe().instrument == Instrument(beam_source="laser", beam_rms=0.01)
    tool.instrument.restore({})
    tool.source.layer = window.add_image(source.data, name="recorded")
    assert tool.recipe().instrument == Instrument()


def test_the_beam_under_a_painted_mask_is_predicted_with_its_error(window, open_widget, run):
    blob = gaussian_blob((64, 64), -6.0, 4.0)
    window.add_image(np.random.default_rng(0).poisson(500 * synthetic_image(blob.displacement)))
    tool = open_widget("Invert")
    tool.options.restore(FEW)
    tool.source.set_kind("kriged")
    assert tool.source.choice.current_choice == "estimate: predicted under the mask"
    tool.source_masks.paint()
    tool.source_masks.layer.data = (np.hypot(*(np.indices((64, 64)) - 31.5)) < 20).astype(int)
    run(tool)
    result = next(result for layer in window.layers if (result := result_of(layer)))
    assert result.content.errors.beam_basis == "outside"
    assert result.content.errors.beam_variation < 0.01
