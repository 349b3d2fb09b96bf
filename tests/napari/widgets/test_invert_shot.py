"""The widget that inverts a shot, and the files of its results."""

import sys

import h5py
import numpy as np
import pytest
from napari.utils import progress

from helpers.forms import enter
from helpers.jobs import run_job
from helpers.layers import in_its_unit, layer_of
from helpers.reports import texts_of
from napari_shadowinv import InversionOptions, ProtonSetup, invert, read
from napari_shadowinv._napari.layer_metadata import metadata_for, result_of, role_of
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import percent
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

FEW = {"n_sites": 500}


def with_few_sites(tool):
    tool.options.restore(FEW)
    return tool


@pytest.fixture
def tool(viewer, opened, shot):
    viewer.add_image(shot, name="shot")
    return with_few_sites(opened(Invert))


@pytest.fixture
def tool_in_window(window, open_widget, shot):
    window.add_image(shot, name="shot")
    return with_few_sites(open_widget("Invert"))


def computed(tool):
    """Return the inversion of the controls, without its layers."""
    return run_job(tool.request())


def settled(tool):
    return not tool.panel.running and not tool._preview_timer.isActive()


def test_the_window_thread_computes_nothing_during_a_run(tool_in_window, qtbot, wait):
    tool = tool_in_window
    tool.options.restore({"n_sites": 2_000})
    qtbot.wait(300)
    tool.show_result = lambda *_: None
    rooms = set()

    def note_room(frame, event, _):
        if event == "call":
            rooms.add(".".join(str(frame.f_globals.get("__name__", "")).split(".")[:2]))

    tool.panel.button.click()
    sys.setprofile(note_room)  # of this thread alone
    try:
        wait(lambda: not tool.panel.running)
    finally:
        sys.setprofile(None)
    computing = {"geometry", "transport", "inversion", "physics", "preprocessing", "pipeline"}
    assert "napari_shadowinv._napari" in rooms
    assert not rooms & {f"napari_shadowinv.{room}" for room in computing}


def test_one_click_inverts_the_image_in_si_units(viewer, tool, run, shot, proton_setup):
    tool.setup.show_setup(proton_setup.model_dump())
    run(tool)
    expected = invert(shot, options=InversionOptions(**FEW))
    field = layer_of(viewer, "field")
    np.testing.assert_allclose(result_of(field).content.potential, expected.potential, atol=1e-9)
    strength = np.hypot(*proton_setup.path_integrated_b(expected.displacement))
    assert field.data.max() == pytest.approx(in_its_unit(field, strength.max()), rel=1e-6)
    for layer in (viewer.layers["shot"], field):
        assert tuple(layer.scale) == pytest.approx((1.5, 1.5))
        assert str(layer.units[0]) == "micrometer"
    report = texts_of(tool.report)
    assert report["Flux residual"].endswith(": converged")
    assert report["Sites"] == "500; as requested"
    assert "sites" in report["Time"]
    assert not tool.report.isHidden()
    assert tool.panel.button.text() == "Run"
    assert not progress._all_instances


def test_the_source_of_a_shot_a_layer_or_a_file_is_used(viewer, tool, shot, tmp_path, proton_setup):
    beam = 300 * (1 + np.linspace(0, 0.2, shot.shape[1]) + np.zeros(shot.shape))
    with h5py.File(tmp_path / "run.nxs", "w") as file:
        file["entry/beam"], file["entry/dark"] = beam, 0 * beam
    viewer.add_image(beam, name="beam")
    metadata = metadata_for("shot", "", proton_setup, source=beam)
    viewer.add_image(shot, name="measured", metadata=metadata)
    tool.source.layer = viewer.layers["beam"]
    tool.image.layer = viewer.layers["measured"]
    assert tool.setup.setup() == proton_setup
    assert tool.source.kind == "own"
    for kind in ("own", viewer.layers["beam"], "file"):
        tool.source.set_kind(kind)
        if kind == "file":
            enter(tool.source.form.entries["file"], f"{tmp_path / 'run.nxs'}::/entry/beam")
        np.testing.assert_allclose(computed(tool).source, beam)
    tool.source.set_kind("own")
    tool.image.layer = viewer.layers["shot"]
    assert tool.source.kind == "uniform"
    tool.source.set_kind("low-pass")
    estimated = computed(tool).source
    assert 0 < estimated.std() < 0.2 * estimated.mean()


def test_what_a_file_brings_is_used_and_told(viewer, tool, shot):
    mask = np.zeros(shot.shape, np.uint8)
    mask[:, :5] = 1
    viewer.add_labels(mask, metadata=metadata_for("mask", "", path="a.txt"))
    cautions = [Caution("film-scan", "it may be film")]
    metadata = metadata_for("shot", "", path="a.txt", cautions=cautions)
    tool.image.layer = viewer.add_image(shot, name="other", metadata=metadata)
    inversion = computed(tool)
    assert (inversion.mask == (mask == 0)).all()
    assert inversion.report.cautions[-1].text == "it may be film"


def test_a_run_replaces_the_last_result_of_its_shot(
    viewer, tool, run, rest, shot, proton_setup, messages
):
    run(tool)
    few = [role_of(layer) for layer in viewer.layers]
    assert few == [None, "residual", "field", "caustic", "arrows"]
    tool.view.more_layers.click()
    rest(tool)
    first = list(viewer.layers)
    added = {role_of(layer) for layer in viewer.layers} - set(few)
    roles_of_more = {
        "image",
        "reprojection",
        "potential",
        "field y",
        "field x",
        "direction",
        "sites",
    }
    assert added == roles_of_more
    visible = {role_of(layer) for layer in viewer.layers if layer.visible}
    assert visible == {None, "field", "arrows"}
    tool.view.more_layers.click()
    rest(tool)
    assert list(viewer.layers) == first
    layer_of(viewer, "caustic").visible = True
    layer_of(viewer, "sites").visible = True
    tool.setup.show_setup(proton_setup.model_dump())
    tool.options.restore({"n_sites": 300})
    run(tool)
    roles = [role_of(layer) for layer in viewer.layers if result_of(layer) is not None]
    assert len(roles) == len(set(roles)) == len(first) - 1
    few = InversionOptions(n_sites=300)
    expected = invert(shot, options=few)
    results = filter(None, map(result_of, viewer.layers))
    assert all(result.content.options == few for result in results)
    np.testing.assert_allclose(layer_of(viewer, "sites").data, expected.cells.sites)
    assert layer_of(viewer, "sites").visible
    assert layer_of(viewer, "caustic").visible
    strength = np.hypot(*proton_setup.path_integrated_b(expected.displacement))
    field = layer_of(viewer, "field")
    assert field in first
    assert field.data.max() == pytest.approx(1e3 * strength.max(), rel=1e-6)
    assert "mT·m" in field.name
    np.testing.assert_allclose(layer_of(viewer, "arrows").scale, (1.5, 1.5))
    # The camera fits to the new units.
    centre = np.array(viewer.layers["shot"].extent.world).mean(axis=0)
    camera = getattr(viewer, "scene", viewer).camera  # napari before 0.9
    np.testing.assert_allclose(camera.center[-2:], centre[-2:], rtol=0.05)
    zoom = camera.zoom
    viewer.reset_view()
    assert camera.zoom == pytest.approx(zoom)

    # Another shot has results of its own, and so has a run that is told to keep the last.
    count = len(viewer.layers)
    assert not any(text.startswith(("Determined:", "Failed:")) for text in messages)
    metadata = metadata_for("shot", "", proton_setup)
    tool.image.layer = viewer.add_image(2 * shot, name="second", metadata=metadata)
    run(tool)
    assert len(viewer.layers) == count + 1 + 4
    tool.keep_earlier.setChecked(True)
    run(tool)
    assert len(viewer.layers) == count + 1 + 2 * 4
    bars = [image.name for image in viewer.layers if getattr(image, "colorbar", None) is not None]
    with_bar = [image for image in viewer.layers if image.name in bars and image.colorbar.visible]
    assert [(role_of(image), image.visible) for image in with_bar] == [("field", True)]


def test_whole_numbers_and_the_finest_of_many_scales_are_inverted(
    viewer, tool, shot, run, messages
):
    counts = np.round(shot).astype(np.uint16)
    tool.image.layer = viewer.add_image(counts, name="counts")
    np.testing.assert_allclose(computed(tool).image, counts)
    pyramid = viewer.add_image([counts, counts[::2, ::2]], name="pyramid", multiscale=True)
    tool.image.layer = pyramid
    tool.setup.show_setup(ProtonSetup.example().model_dump())
    run(tool)
    field = layer_of(viewer, "field")
    assert field.data.shape == shot.shape
    np.testing.assert_allclose(pyramid.scale, 1.5)
    np.testing.assert_allclose(field.data_to_world((20, 30)), pyramid.data_to_world((20, 30)))
    # Nobody recorded the beam: a condition, which is said without a warning.
    assert messages == []
    assert tool.verdict.text().startswith("<b>Depends on the beam</b>")
    assert field.name.startswith("± ")


def test_the_preview_follows_in_its_own_layers(window, tool_in_window, qtbot, wait, messages):
    tool, noise = tool_in_window, np.random.default_rng(0).normal(0, 0.05, (200, 200))
    ring = toroid((200, 200), ProtonSetup.example(), 97, 30e-6)
    window.layers["shot"].data = np.maximum(synthetic_image(ring.displacement) + noise, 0)
    # Without a graphics card, drawing a large window takes longer than the inversion.
    window.window._qt_window.resize(900, 600)
    tool.options.restore({})
    tool.live.setChecked(True)
    wait(lambda: len(tool.previewed.layers) == 2 and settled(tool))
    before = tool.previewed.layers
    field = layer_of(window, "field", "preview")
    assert "Preview: " in tool.verdict.text()
    residual = result_of(field).content.report.image_residual
    assert percent(residual) in tool.panel.status.text()

    def follows(change):
        """Wait until the layer follows a change."""
        wait(lambda: settled(tool))
        qtbot.wait(100)  # the last picture is drawn
        old = field.data
        change()
        wait(lambda: field.data is not old)

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
    outcomes = []
    tool.panel.ended.connect(outcomes.append)
    for value in np.linspace(59, 50, 10):  # as fast as one event of the window
        enter(width, value)
    wait(lambda: settled(tool))
    assert [outcome.tag.recipe.source.width for outcome in outcomes] == [pytest.approx(50)]
    assert [a is b for a, b in zip(before, tool.previewed.layers, strict=True)] == [True] * 2
    assert messages == []


def test_doubts_stand_under_run_with_a_notification(viewer, tool, run, messages):
    tool.options.restore({**FEW, "max_iterations": 1})
    run(tool)
    assert "Failed" in tool.verdict.text()
    (text,) = messages
    assert text.startswith("Failed: ")
    assert "--" not in tool.verdict.text()
    assert layer_of(viewer, "field").name.startswith("✗ ")
    messages.clear()
    x = np.mgrid[:48, :60][1]
    edge = synthetic_image(np.stack([0 * x, 0.03 * (x - 20.0)]))
    viewer.layers["shot"].data = edge
    tool.options.restore(FEW)
    run(tool)
    report = result_of(layer_of(viewer, "field")).content.report
    assert report.converged
    assert report.cautions
    verdict = result_of(layer_of(viewer, "field")).content.verdict.capitalize()
    assert tool.verdict.text().startswith(f"<b>{verdict}")
    assert messages[-1].startswith(verdict)
    assert layer_of(viewer, "field").name.startswith("? ")
    assert "Iterations" in texts_of(tool.report)
    assert not tool.report.details.isExpanded()


def test_save_replaces_what_the_dialog_asked_about_and_leaves_no_file_that_fails(
    tool, run, refused, tmp_path, choose
):
    save, path = tool.view.save_result.click, tmp_path / "a.shadowinv"
    choose(tmp_path / "a")
    refused(tool, "There is no result yet: press Run first, or select a layer of a result", save)
    assert not list(tmp_path.glob("a*"))
    run(tool)
    path.write_text("precious")
    refused(tool, "a.shadowinv exists", save)
    assert path.read_text() == "precious"
    choose(path)
    save()
    assert read(path)["displacement"].shape == (2, 48, 60)
    assert str(path) in tool.panel.status.text()
    choose(tmp_path / "nowhere" / "a")
    refused(tool, "nowhere", save)
    assert not (tmp_path / "nowhere").exists()
