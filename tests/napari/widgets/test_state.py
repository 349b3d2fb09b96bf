"""The state that widgets save and restore; most tests need only a list of layers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from helpers.forms import enter
from helpers.reports import texts_of
from napari_shadowinv import InputError, ProtonSetup
from napari_shadowinv._napari import commands
from napari_shadowinv._napari.layer_metadata import (
    metadata_for,
    result_of,
    role_of,
    setup_of,
    setup_origin_of,
    source_of,
)
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets import _qt
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.preprocessing import PolynomialEstimate

Array = np.ndarray[Any, Any]
PATIENCE = 60_000  # ms
PLUGIN = "napari-shadowinv"


@pytest.fixture
def of_a_file(viewer, shot, proton_setup):
    """A shot that came with its setup."""
    origin = "came with experiment.h5"
    metadata = metadata_for("shot", "", proton_setup, setup_origin=origin)
    return viewer.add_image(shot, name="measured", metadata=metadata)


@pytest.fixture
def plain(viewer, shot):
    """A shot that napari itself has opened."""
    return viewer.add_image(shot, name="plain")


def typed(tool, energy):
    """Type a whole setup, field by field."""
    tool.setup.set_kind("proton")
    values = {
        "energy": energy,
        "source_object_distance": 0.01,
        "object_image_distance": 1.0,
        "pixel_size": 2e-6,
    }
    for name, value in values.items():
        enter(tool.setup.form.entries[name], value)


def test_a_setup_stays_with_the_image_that_it_came_with(opened, of_a_file, plain, proton_setup):
    tool = opened(Invert)
    for _ in range(2):
        tool.image.layer = of_a_file
        assert tool.setup.setup() == proton_setup
        assert tool.setup.note.text() == "Came with experiment.h5."
        tool.image.layer = plain
        assert tool.setup.setup() is None
        assert tool.setup.note.text() == ""
    # Nor is it at hand in the form.
    tool.setup.set_kind("proton")
    assert tool.setup.form.is_empty


def test_the_setup_of_a_file_is_not_there_in_the_next_session(viewer, opened, of_a_file, shot):
    tool = opened(Invert)
    assert tool.setup.setup() is not None
    enter(tool.setup.form.entries["energy"], "3 MeV")
    assert setup_origin_of(of_a_file) == "came with experiment.h5, changed by hand"
    tool.write_state()
    viewer.layers.clear()
    viewer.add_image(shot, name="another")
    later = opened(Invert)
    assert later.setup.setup() is None
    later.setup.set_kind("proton")
    assert later.setup.form.is_empty


def test_what_the_user_typed_is_at_hand_and_says_for_what(viewer, opened, plain, shot):
    tool = opened(Invert)
    typed(tool, 5.0)
    entered = tool.setup.setup()
    assert entered.pixel_size == pytest.approx(2e-6)
    assert setup_of(plain) == entered
    image = viewer.add_image(shot, name="other")
    tool.image.layer = image
    assert tool.setup.setup() is None
    assert setup_of(image) is None
    tool.setup.set_kind("proton")
    assert tool.setup.setup() == entered
    assert tool.setup.note.text() == "Typed for 'plain'."
    assert setup_origin_of(image) == "typed for 'plain'"
    # An image keeps what was chosen for it, none too.
    tool.image.layer = plain
    tool.setup.set_kind("none")
    tool.image.layer = image
    assert tool.setup.setup() == entered
    tool.image.layer = plain
    assert tool.setup.setup() is None

    tool.write_state()
    viewer.layers.clear()
    new = viewer.add_image(shot, name="new")
    later = opened(Invert)
    assert later.setup.setup() is None
    later.setup.set_kind("proton")
    assert later.setup.setup() == entered
    assert setup_origin_of(new) == "typed for 'plain', in an earlier session"
    typed(later, 6.0)
    assert setup_origin_of(new) == "typed for 'new'"


def test_the_last_setup_is_selected_where_that_is_preferred(
    viewer, opened, plain, shot, preferences
):
    preferences.widgets.last_setup = True
    tool = opened(Invert)
    assert tool.setup.setup() is None  # there is no last one
    typed(tool, 5.0)
    entered = tool.setup.setup()
    tool.write_state()
    viewer.layers.clear()
    new = viewer.add_image(shot, name="new")
    later = opened(Invert)
    assert later.setup.setup() == entered
    assert later.setup.note.text() == "Typed for 'plain', in an earlier session."
    # The image has no setup of its own before it is edited.
    assert setup_of(new) is None
    # None is a choice, too.
    later.setup.set_kind("none")
    later.write_state()
    assert opened(Invert).setup.setup() is None
    later.setup.set_kind("proton")
    later.write_state()
    preferences.widgets.last_setup = False
    viewer.layers.clear()
    viewer.add_image(shot, name="newest")
    assert opened(Invert).setup.setup() is None


def test_a_setup_from_a_toml_file_says_so(opened, plain, tmp_path, proton_setup, monkeypatch):
    from qtpy.QtWidgets import QFileDialog

    text = tomli_w.dumps(proton_setup.model_dump(exclude_none=True))
    path = tmp_path / "tcc.toml"
    path.write_text(text)
    monkeypatch.setattr(QFileDialog, "getOpenFileName", lambda *_, **__: (str(path), ""))
    tool = opened(Invert)
    tool.setup.load_button.click()
    assert tool.setup.setup() == proton_setup
    assert tool.setup.note.text() == "Loaded from tcc.toml."
    assert setup_of(plain) is None
    tool.request()
    assert tool.setup.note.text() == "Loaded from tcc.toml for 'plain'."
    assert setup_origin_of(plain) == "loaded from tcc.toml for 'plain'"


def test_a_loaded_setup_goes_with_the_image_until_run(viewer, opened, plain, proton_setup):
    tool = opened(Invert)
    tool.image.layer = plain
    tool.setup.load(proton_setup.model_dump(exclude_none=True), "tcc.toml")
    enter(tool.setup.form.entries["energy"], 5.0)
    other = viewer.add_image(np.ones((20, 30)), name="other")
    tool.image.layer = other
    assert tool.setup.setup().energy == 5.0
    tool.request()
    assert setup_of(plain) is None
    assert setup_of(other).energy == 5.0
    assert setup_origin_of(other) == "loaded from tcc.toml, changed by hand for 'other'"
    # From then on it is the setup of this image only.
    tool.image.layer = plain
    assert tool.setup.setup() is None


def test_other_files_do_not_inherit_a_setup(viewer, opened):
    tool = opened(Invert)
    tool.image.set_kind("files")
    typed(tool, 5.0)

    def choose(pattern):
        tool.image.form.restore({"path": pattern})

    choose("monday/*.tif")
    assert tool.setup.setup() is not None
    choose("tuesday/*.tif")
    assert tool.setup.setup() is None
    tool.setup.set_kind("proton")
    assert tool.setup.setup() is not None
    assert tool.setup.origin == "typed"


def test_a_store_lies_beside_the_files_unless_another_is_chosen(viewer, opened, tmp_path):
    tool = opened(Invert)
    tool.image.set_kind("folder")
    tool.image.form.restore({"path": str(tmp_path / "night")})
    assert tool.store.path == tmp_path / "night.shadowinv.zarr"
    tool.image.set_kind("files")
    tool.image.form.restore({"path": str(tmp_path / "day" / "*.tif")})
    assert tool.store.path == tmp_path / "day.shadowinv.zarr"
    tool.store.folder.restore({"path": "mine.shadowinv.zarr"})
    tool.image.set_kind("folder")
    assert tool.store.path == Path("mine.shadowinv.zarr")


def test_a_sample_opened_beside_a_widget_is_the_image_not_its_source(viewer, opened):
    tool = opened(Invert)
    viewer.open_sample(PLUGIN, "toroid")
    shot, source = (
        next(layer for layer in viewer.layers if role_of(layer) == role)
        for role in ("shot", "source")
    )
    assert tool.image.offered == [shot]
    assert tool.image.layer is shot
    assert tool.source.kind == "own"
    assert tool.setup.note.text() == "Came with the sample 'toroid'."
    tool.source.layer = source
    assert tool.source.kind == "layer"
    viewer.layers.remove(source)
    assert tool.source.kind == "own"


def test_no_image_is_its_own_source(viewer, opened, plain, shot):
    tool = opened(Invert)
    assert tool.source.offered == []
    # Which of two unknown images is the beam, nobody but the user can tell.
    other = viewer.add_image(shot, name="other")
    assert tool.image.layer is plain
    assert tool.source.offered == [other]
    assert tool.source.layer is None
    tool.source.layer = other
    tool.image.layer = other
    assert tool.source.layer is None
    assert tool.source.offered == [plain]


def test_results_are_not_offered_as_shots(viewer, opened, plain, solved):
    add_to_viewer(viewer, solved, name="solved")
    tool = opened(Invert)
    assert tool.image.offered == [plain]
    assert [role_of(layer) for layer in tool.masks.offered] == []
    assert all(role_of(layer) in (None, "source") for layer in tool.source.offered)
    assert {role_of(layer) for layer in opened(Simulate).field.offered} == {"field"}
    field = next(layer for layer in viewer.layers if role_of(layer) == "field")
    for command in (commands.invert_uniform, commands.high_pass):
        with pytest.raises(InputError, match="is part of a result: select the shot"):
            command(field)


def test_one_click_takes_the_setup_of_the_layer_and_says_so(of_a_file, plain, proton_setup):
    for layer, setup, origin in (
        (of_a_file, proton_setup, "came with experiment.h5"),
        (plain, None, None),
    ):
        for _, keywords, _ in commands.invert_uniform(layer):
            assert setup_of(keywords) == setup
            assert result_of(keywords).origins.get("Setup") == origin  # type: ignore[union-attr]


def test_a_source_can_be_filtered_and_stays_one(viewer, opened):
    viewer.open_sample(PLUGIN, "toroid")
    source = next(layer for layer in viewer.layers if role_of(layer) == "source")
    ((_, keywords, _),) = commands.high_pass(source)
    assert role_of(keywords) == "source"
    assert setup_origin_of(keywords) == "came with the sample 'toroid'"
    with pytest.raises(InputError, match="is a source: select the shot"):
        commands.invert_uniform(source)


def test_the_source_that_was_chosen_comes_back_after_a_sample(viewer, opened, plain):
    tool = opened(Invert)
    tool.source.set_kind("low-pass")
    *_, sample = viewer.open_sample(PLUGIN, "toroid")
    tool.image.layer = sample
    assert tool.source.kind == "own"
    tool.image.layer = plain
    assert tool.source.kind == "low-pass"


# The two masks


@pytest.fixture(scope="module")
def hump():
    """A shot of an object under an uneven beam, its true potential, and the object's pixels."""
    blob = gaussian_blob((64, 72), 30.0, 6.0, (30.0, 40.0))
    y, x = np.mgrid[:64, :72]
    beam = 300 * (1 + 0.3 * x / 72 + 0.2 * (y / 64) ** 2)
    is_object = np.hypot(y - 30, x - 40) < 22
    return synthetic_image(blob.displacement, beam), blob.potential, is_object


def the_masks(tool):
    """Return the object with the masks of a run."""
    job = tool.request()
    return job.shots if tool.image.is_stack else job.shot


@pytest.mark.parametrize("is_stack", [False, True])
def test_both_masks_can_be_chosen(viewer, opened, hump, is_stack, tmp_path):
    shot, _, is_object = hump
    viewer.add_image(np.stack([shot, shot]) if is_stack else shot, name="shot")
    tool = opened(Invert)
    if is_stack:
        tool.store.folder.restore({"path": str(tmp_path / "a.shadowinv.zarr")})
    assert tool.source_masks.isHidden()
    tool.source.set_kind("polynomial")
    assert not tool.source_masks.isHidden()
    tool.source_masks.paint()
    assert tool.source_masks.layer.name == "source mask – shot"
    assert role_of(tool.source_masks.layer) == "mask"
    tool.source_masks.layer.data = is_object.astype(int)
    tool.masks.paint()
    tool.masks.layer.data[:3, :3] = 1
    masks = the_masks(tool)
    np.testing.assert_array_equal(masks.source_mask, ~is_object)
    assert (~masks.mask).sum() == 9
    # A mask that is not shown has no say.
    tool.source.set_kind("uniform")
    assert tool.source_masks.isHidden()
    assert the_masks(tool).source_mask is None


def test_a_mask_over_the_object_is_refused(viewer, opened, hump, qtbot, messages):
    shot, _, is_object = hump
    image = viewer.add_image(shot, name="shot")
    labels = viewer.add_labels(is_object.astype(int), name="object")
    tool = opened(Invert)
    tool.source.set_kind("polynomial")
    tool.masks.layer = tool.source_masks.layer = labels
    tool.panel.button.click()
    qtbot.waitUntil(lambda: bool(messages) and not tool.panel.running, timeout=PATIENCE)
    words = "the object would be excluded from the inversion"
    assert words in tool.panel.status.text()

    # As well if the estimate was made before, in a layer of its own.
    tool.show_source.click()
    qtbot.waitUntil(lambda: "shot source: fitted polynomial" in viewer.layers, timeout=PATIENCE)
    for data in (None, np.stack([shot, shot])):
        later = opened(Invert)
        if data is not None:
            later.image.layer = viewer.add_image(data, name="stack")
            later.store.folder.restore({"path": "a.shadowinv.zarr"})
        else:
            later.image.layer = image
        later.source.layer = viewer.layers["shot source: fitted polynomial"]
        later.masks.layer = labels
        with pytest.raises(InputError, match=words):
            later.request()
        later.masks.layer = None
        later.request()


# What is said of a run


def test_a_result_says_where_everything_came_from(viewer, opened, of_a_file, run):
    tool = opened(Invert)
    tool.options.restore({"n_sites": 300})
    tool.source.set_kind("polynomial")
    tool.source_masks.paint()
    tool.source_masks.layer.data[10:30, 20:45] = 1
    run(tool)
    rows = texts_of(tool.report)
    assert rows["Image"] == "measured"
    assert rows["Source"].startswith("estimate: fitted polynomial")
    assert rows["Source mask"] == "layer 'source mask – measured', excludes 17 % of the pixels"
    assert "Mask" not in rows
    assert rows["Setup"] == "particles (protons, …), came with experiment.h5"
    field = next(layer for layer in viewer.layers if role_of(layer) == "field")
    origins = result_of(field).origins  # type: ignore[union-attr]
    assert {title: rows[title] for title in origins} == origins
    provenance = result_of(field).content.provenance  # type: ignore[union-attr]
    assert provenance.recipe.source == PolynomialEstimate()
    assert provenance.masks[provenance.image.source_mask].mask() is not None


def test_the_report_of_one_run_does_not_stand_beside_another(
    opened, plain, of_a_file, run, qtbot, messages
):
    tool = opened(Invert)
    tool.options.restore({"n_sites": 300})

    def rerun():
        run(tool)
        assert texts_of(tool.report)["Flux residual"].endswith("converged")

    rerun()
    # A result of other choices is marked, until they are those of the run again.
    for number in (300, 400, 300):
        tool.options.restore({"n_sites": number})
        assert bool(tool.view.changes.text()) == (number != 300)
    tool.panel.button.click()
    assert texts_of(tool.report) == {}
    tool.panel.button.click()
    qtbot.waitUntil(lambda: tool.panel.status.text() == "Cancelled.", timeout=PATIENCE)
    assert texts_of(tool.report) == {}
    rerun()
    tool.image.layer = plain
    assert texts_of(tool.report) == {}
    rerun()
    plain.data = plain.data + 1
    assert texts_of(tool.report) == {}
    rerun()
    tool.source.set_kind("file")
    tool.panel.button.click()
    assert texts_of(tool.report) == {}
    # The notification goes; the sentence stays until something else happens.
    assert messages == [tool.panel.status.text()]
    assert "o source file" in tool.panel.status.text()
    tool.image.layer = of_a_file
    assert tool.panel.status.text() == ""


# The forward model


def test_a_forward_model_takes_the_setup_of_a_potential_and_gives_it_back(
    viewer, opened, solved, proton_setup, qtbot
):
    tool = opened(Simulate)
    assert tool.setup.setup() == ProtonSetup.example()
    assert tool.setup.note.text() == "Example from the paper."
    typed(tool, 7.0)
    entered = tool.setup.setup()
    add_to_viewer(viewer, solved, proton_setup, name="solved")
    tool.object.set_kind("layer")
    assert tool.setup.setup() == proton_setup
    tool.object.set_kind("toroid")
    assert tool.setup.setup() == entered
    tool.write_state()
    later = opened(Simulate)
    assert later.setup.setup() == entered
    tool.side.setText("20 x 20")
    tool.panel.button.click()
    qtbot.waitUntil(lambda: role_of(viewer.layers[-1]) == "shot", timeout=PATIENCE)
    prediction = viewer.layers[-1]
    assert setup_of(prediction) == entered
    assert setup_origin_of(prediction).startswith("came with the forward model")
    assert source_of(prediction) is None
    # Opened in Invert, it is a file's setup like any other.
    assert opened(Invert).setup.setup() == entered


@pytest.mark.parametrize("kind", [FitImages, Invert, Simulate])
def test_a_saved_state_of_another_form_keeps_no_widget_from_opening(opened, kind, monkeypatch):
    parts = opened(kind).state()
    for value in (7, None, "text", [3], {"values": 4, "own": [1], "size": "x"}):
        monkeypatch.setattr(_qt, "saved_state", lambda _: dict.fromkeys(parts, value))  # noqa: B023
        assert opened(kind).state().keys() == parts.keys()


def test_a_part_of_another_form_leaves_the_other_parts_restored(viewer, opened, monkeypatch):
    first = opened(Invert)
    first.options.restore({"n_sites": 777})
    saved = {**first.state(), "source": {"values": 5}, "steps": 3}
    monkeypatch.setattr(_qt, "saved_state", lambda name: saved)
    assert opened(Invert).options.model().n_sites == 777
