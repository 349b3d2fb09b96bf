"""The widget that fits several images, and Refine of the widget for one."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from qtpy.QtCore import Qt

from helpers.command_line import undrawn
from helpers.fit_images import of_each
from helpers.forms import enter
from helpers.layers import layer_of
from helpers.reports import texts_of
from napari_shadowinv import InversionOptions, ProtonSetup, invert, read, write
from napari_shadowinv._napari.jobs import Finished
from napari_shadowinv._napari.layer_metadata import (
    Result,
    metadata_for,
    setup_of,
    store_setup,
)
from napari_shadowinv._napari.layers import fit_layers
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit, compilation, fit
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.projection import predict_image
from napari_shadowinv.physics.setup import OpticalSetup
from napari_shadowinv.pipeline.fit_run import collect_fit_inputs
from napari_shadowinv.shot import Shot, shots_of

SHAPE = (48, 64)
LENGTHS = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2, "pixel_size": 1.5e-6}
ENERGIES = (14.7, 6.0)
SETUPS = tuple(ProtonSetup(energy=energy, **LENGTHS) for energy in ENERGIES)
TRUTH = gaussian_blob(SHAPE, 17.5, 7.0, (22.0, 35.0)).displacement  # ends inside the image
BEAM = 1  # column
QUICK = {"samples": 0, "max_iterations": 5, "spacing": 0.25, "smoothness": 5.0}
MIDDLE = np.s_[2:42, 11:59]  # of an image, with the whole object


def images(noise=0.01):
    """One magnetic object at two energies."""
    rng = np.random.default_rng(5)
    planes = [predict_image(TRUTH, SETUPS[0], setup) for setup in SETUPS]
    return [300 * plane * rng.normal(1, noise, plane.shape) for plane in planes]


@pytest.fixture
def tool(viewer, opened):
    for energy, setup, image in zip(ENERGIES, SETUPS, images(), strict=True):
        viewer.add_image(image, name=f"{energy} MeV", metadata=metadata_for("shot", "", setup))
    widget = opened(FitImages)
    widget.options.restore(QUICK)
    return widget


@pytest.fixture(scope="session")
def fitted():
    """The fit of the widget to its two images, without the window."""
    options = FitOptions(samples=2, max_iterations=5, spacing=0.25)
    return fit(shots_of(np.stack(images()), setup=SETUPS, psf=[0, 0]), options=options)


@pytest.fixture
def show(rest):
    """Show a fit as if the widget had made it."""

    def shown(tool, found):
        job = tool.request()
        layer_data = fit_layers(Result(found, job.origins), job.frame, job.name)
        tool.show_result(Finished(found, layer_data), job)
        rest(tool)

    return shown


def inputs_of(tool):
    """Return the inputs of the requested fit."""
    job = tool.request()
    return collect_fit_inputs(job.recipe, job.shots)


def texts(tool, column):
    table = tool.images
    return [table.item(row, column).text() for row in range(table.rowCount())]


def type_in(tool, row, column, text):
    tool.images.item(row, column).setText(text)


def test_the_table_is_filled_from_the_layers(viewer, tool):
    viewer.add_image(np.ones((20, 30)), name="another size")
    viewer.add_image(np.ones((*SHAPE, 3)), name="colour", rgb=True)
    viewer.add_image(np.ones(SHAPE), name="beam", metadata=metadata_for("source", ""))
    assert texts(tool, 0) == ["14.7 MeV", "6.0 MeV", "another size"]
    assert texts(tool, BEAM) == ["14.7", "6", ""]
    assert tool.images.horizontalHeaderItem(BEAM).text() == "Energy (MeV)"
    assert tool.setup.setup() == SETUPS[0]
    viewer.layers["6.0 MeV"].name = "slow"
    assert texts(tool, 0)[1] == "slow"


def test_what_is_asked_for_is_what_the_controls_show(viewer, tool):
    type_in(tool, 1, BEAM, "7 MeV")
    tool.choices.restore({"noise": "poisson", "psf": 0.8, "brightness": "free"})
    inputs = inputs_of(tool)
    assert [setup.energy for setup in inputs.setups] == [14.7, 7.0]
    assert of_each(inputs.shots, "brightness") == ["free", "free"]
    assert of_each(inputs.shots, "psf") == [0.8, 0.8]
    assert of_each(inputs.shots, "source") == [None, None]
    assert of_each(inputs.shots, "noise") == ["poisson", "poisson"]
    assert inputs.choices.options == FitOptions(**QUICK)
    assert tool.cost.text().startswith("2 images of 48 × 64 px: about ")
    # The image's own setup stays; what was typed stays with its layer, not with the widget.
    assert setup_of(viewer.layers["6.0 MeV"]) == SETUPS[1]
    viewer.add_image(np.ones((20, 30)))
    assert texts(tool, BEAM)[:2] == ["14.7", "7 MeV"]
    # The energy of the first image is that of the setup below.
    assert not tool.images.item(0, BEAM).flags() & Qt.ItemFlag.ItemIsEditable
    tool.setup.show_setup({**SETUPS[0].model_dump(), "energy": 15.0})
    assert texts(tool, BEAM)[0] == "15"
    # What the table rounds is taken exactly.
    viewer.layers.clear()
    setups = [setup.model_copy(update={"energy": setup.energy + 1e-8 / 3}) for setup in SETUPS]
    for setup in setups:
        viewer.add_image(np.ones(SHAPE), metadata=metadata_for("shot", "", setup))
    assert texts(tool, BEAM) == ["14.7", "6"]
    assert inputs_of(tool).setups == tuple(setups)


def test_the_images_of_an_opened_fit_can_be_fitted_again(viewer, tool, fitted, tmp_path):
    viewer.layers.clear()
    viewer.open(write(tmp_path / "pair.shadowinv", fitted), plugin="napari-shadowinv")
    assert [shot.setup for shot in tool.request().shots] == list(fitted.setups)
    assert tool.request().name == "pair fit"
    assert tool.source.kind == "uniform"  # a beam that was found is not measured


def test_a_good_verdict_is_shown_and_a_bad_one_is_told(viewer, tool, show, fitted, messages):
    show(tool, fitted)
    assert "Determined" in tool.view.verdict.text()
    sound_style = tool.view.verdict.styleSheet()
    assert messages == []
    count = len(viewer.layers)
    explanation = "the forward model does not explain image 2"
    show(tool, replace(fitted, assessment=Assessment(Verdict.MISFIT, explanation)))
    assert "Does not fit" in tool.view.verdict.text()
    assert explanation[1:] in tool.view.verdict.text()
    assert tool.view.verdict.styleSheet() != sound_style
    (message,) = messages
    assert message.startswith("Does not fit: peak ")
    assert message.endswith(f"; {explanation}")
    # The layers of the same images' earlier fit are replaced.
    assert len(viewer.layers) == count
    tool.keep_earlier.setChecked(True)
    show(tool, fitted)
    assert len(viewer.layers) > count
    tool.images.item(0, 0).setCheckState(Qt.CheckState.Unchecked)
    assert tool.view.verdict.isHidden()


def test_light_has_wavelengths_and_its_own_fields(viewer, opened):
    green = OpticalSetup(wavelength=532e-9, object_image_distance=0.01, pixel_size=1e-6)
    red = green.model_copy(update={"wavelength": 810e-9})
    for setup in (green, red):
        viewer.add_image(np.ones(SHAPE), name=setup.probe, metadata=metadata_for("shot", "", setup))
    tool = opened(FitImages)
    assert texts(tool, BEAM) == ["532 nm", "810 nm"]
    keys = list(tool.fields.choice.choices)
    assert keys == ["plasma", "phase", "plasma and phase"]
    tool.fields.set_kind("plasma and phase")
    inputs = inputs_of(tool)
    assert inputs.choices.fields == ("plasma", "phase")
    assert inputs.setups == (green, red)


def test_what_other_widgets_change_is_followed(viewer, tool, wait):
    tool.hide()
    for layer, energy in zip(viewer.layers, (15.0, 7.0), strict=True):
        store_setup(layer, SETUPS[0].model_copy(update={"energy": energy}), "typed elsewhere")
    tool.show()
    wait(tool.isVisible)
    assert texts(tool, BEAM) == ["15", "7"]
    assert [setup.energy for setup in inputs_of(tool).setups] == [15.0, 7.0]
    assert tool.setup.origin == "typed elsewhere"


def test_the_compiler_is_told_and_does_not_hold_up_cancelling(tool, wait, rest, monkeypatch):
    at_work = threading.Event()
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    monkeypatch.setattr(compilation.RayModel, "gradient", lambda *_: at_work.wait(20))
    tool.panel.button.click()
    wait(lambda: "Compiling" in tool.panel.status.text())
    assert "once, for a minute or so" in tool.panel.status.text()
    tool.panel.button.click()
    rest(tool)
    assert not at_work.is_set()
    at_work.set()
    assert tool.results.layers == []


def test_refine_starts_from_the_last_inversion(viewer, opened, run, refused):
    shot = images()[0][MIDDLE]
    viewer.add_image(shot, name="shot", metadata=metadata_for("shot", "", SETUPS[0]))
    tool = opened(Invert)
    tool.options.restore({"n_sites": 600})
    refused(tool, "here is no inversion of this image", tool.refine_button.click)
    inversion = run(tool)
    enter(tool.refine_form.entries["psf"], 0.5)
    result = run(tool, tool.refine_button)
    inputs = {"source": inversion.source, "mask": inversion.mask, "start": inversion.potential}
    expected = fit([Shot(inversion.image, setup=SETUPS[0], psf=0.5, **inputs)])
    np.testing.assert_allclose(result.fields[0].potential, expected.fields[0].potential)
    assert any(basin.start == "given" for basin in result.basins)
    assert tool.view.verdict.text()
    refined = layer_of(viewer, "field", "refined")
    assert refined.name[2:].startswith("|∫B×dz| (mT·m) – shot")
    assert refined.data.shape == shot.shape
    assert refined.visible
    assert layer_of(viewer, "arrows", "refined")
    # A new inversion is not hidden by what was made of the one before.
    run(tool)
    assert not refined.visible
    assert "Flux residual" in texts_of(tool.report)


def test_an_inversion_of_a_file_is_refined(viewer, opened, rest, tmp_path, messages, refused):
    path = tmp_path / "shot.shadowinv"
    inversion = invert(images()[0][MIDDLE], options=InversionOptions(n_sites=600))
    write(path, inversion, setup=SETUPS[0])
    viewer.open(str(path), plugin="napari-shadowinv")
    viewer.layers.selection.active = layer_of(viewer, "arrows")
    tool = opened(Invert)
    tool.refine_button.click()
    assert tool.panel.running
    tool.refine_button.click()
    assert messages[-1].startswith("Invert is running")
    rest(tool)
    assert layer_of(viewer, "field", "shot refined").visible
    assert texts_of(tool.view.report)["Start"] == "the inversion of 'shot'"
    viewer.layers.selection.active = layer_of(viewer, "field", "refined")
    refused(tool, "shows a fit: select a layer of an inversion", tool.refine_button.click)


def command(*words):
    done = undrawn(*words)
    assert done.exit_code in (0, 3), done.output
    return " ".join(done.output.split())


def assert_same(one, other):
    for first, second in zip(one.fields, other.fields, strict=True):
        np.testing.assert_array_equal(first.potential, second.potential)
        np.testing.assert_array_equal(first.displacement, second.displacement)
    np.testing.assert_array_equal(one.reprojection, other.reprojection)


def test_window_and_command_make_the_same_fit_and_make_it_again(
    viewer, opened, run, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    beam = 300 * (1 + np.arange(SHAPE[1]) * np.ones(SHAPE) / 500)
    noise = np.random.default_rng(4).normal(0, 3, (2, *SHAPE))
    planes = [predict_image(TRUTH, SETUPS[0], setup, source=beam) for setup in SETUPS] + noise
    for name, plane in zip(("fast.txt", "slow.txt", "beam.txt"), [*planes, beam], strict=True):
        np.savetxt(name, plane)
        viewer.open(tmp_path / name, plugin="napari-shadowinv")
    tool = opened(FitImages)
    tool.options.restore(QUICK)
    tool.setup.show_setup(SETUPS[0].model_dump())
    type_in(tool, 1, BEAM, "6")
    tool.source.layer = viewer.layers["beam"]
    tool.choices.restore({"brightness": "free", "noise": "poisson", "psf": 0.6})
    tool.steps.add("crop", {"y": (0, 48), "x": (4, 64)})
    painted = np.zeros(SHAPE, np.uint8)
    painted[:4, :6] = 1
    tool.masks.layer = viewer.add_labels(painted, name="dust")
    tool.recipes.save(tmp_path / "recipe.toml")
    result = run(tool)
    provenance = result.provenance
    assert [image.file for image in provenance.images] == ["fast.txt", "slow.txt"]
    assert [image.source.file for image in provenance.images] == ["beam.txt"] * 2
    assert all(image.sha256 and image.source.sha256 for image in provenance.images)
    write(tmp_path / "window.shadowinv", result)
    output = command("rerun", "window.shadowinv", "--out", "again.shadowinv")
    assert "changed nothing" in output
    assert "bit for bit" in output
    assert_same(Fit.from_dataset(read(tmp_path / "again.shadowinv")), result)
    words = ("--recipe", "recipe.toml", "--energies", "14.7,6", "--out", "fit.shadowinv")
    command("fit", "fast.txt", "slow.txt", *words)
    assert_same(Fit.from_dataset(read(tmp_path / "fit.shadowinv")), result)


def test_what_a_reader_tells_of_its_file_counts_for_that_file_only(viewer, tool, tmp_path):
    facts = {"path": str(tmp_path / "a.h5"), "file": {"sha256": "1" * 64}}
    doubt = Caution("film-scan", "it may be film")
    first, second = viewer.layers
    first.metadata = metadata_for("shot", "", SETUPS[0], **facts)
    second.metadata = metadata_for("shot", "", SETUPS[1], cautions=[doubt])
    tool.source.layer = viewer.add_image(
        np.full(SHAPE, 300.0), metadata=metadata_for("source", "", **facts)
    )
    assert [shot.cautions for shot in tool.request().shots] == [(), (doubt,)]
    of_first, of_second = inputs_of(tool).provenance.images
    assert (of_first.file, of_first.source.file) == ("a.h5", "a.h5")
    assert (of_second.file, of_second.source.file) == ("", "")


def lies_in_view(tool, part):
    top = part.mapTo(tool.area.viewport(), part.rect().topLeft()).y()
    bottom = part.mapTo(tool.area.viewport(), part.rect().bottomLeft()).y()
    return bool(part.isVisible() and top >= 0 and bottom < tool.area.viewport().height())


def test_run_is_in_view_at_once_and_the_verdict_at_the_end(
    window, open_widget, show, fitted, qtbot, wait
):
    window.window._qt_window.resize(1366, 768)
    for setup, image in zip(SETUPS, images(), strict=True):
        metadata = metadata_for("shot", "", setup, setup_origin="came with pack.h5")
        window.add_image(image, name=setup.probe, metadata=metadata)
    tool = open_widget("Fit several images")
    qtbot.wait(100)
    wait(lambda: lies_in_view(tool, tool.panel.button))
    assert not tool.setup_section.isExpanded()
    assert tool.setup_section.text() == "Setup: 14.7 MeV proton, came with pack.h5"
    window.window._qt_window.resize(1366, 560)
    qtbot.wait(100)
    tool.area.verticalScrollBar().setValue(0)
    show(tool, fitted)
    wait(lambda: lies_in_view(tool, tool.view.verdict))
    # What is not known yet has to be seen, and must not fold away while it is typed.
    window.layers.select_all()
    window.layers.remove_selected()
    for image in images():
        window.add_image(image)
    assert tool.setup_section.text() == "Setup: none"
    assert tool.setup_section.isExpanded()
    tool.setup.show_setup(SETUPS[0].model_dump())
    assert tool.setup_section.isExpanded()
    assert tool.setup_section.text() == "Setup: 14.7 MeV proton, typed for 'image'"
