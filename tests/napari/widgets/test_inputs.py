"""What a run is made of, layers, sources and masks, and what is said of it."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from qtpy.QtWidgets import QFileDialog

from helpers.forms import enter
from helpers.layers import by_role, layer_of
from helpers.reports import texts_of
from napari_shadowinv import FitOptions, InputError, Instrument, Recipe, read, write
from napari_shadowinv._napari import commands
from napari_shadowinv._napari.layer_metadata import (
    is_estimate,
    metadata_for,
    result_of,
    role_of,
)
from napari_shadowinv._napari.layers import add_layers, add_to_viewer
from napari_shadowinv._napari.result_files import layers_of_dataset
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.options import FitChoices
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair, gaussian_blob
from napari_shadowinv.pipeline import run_fit
from napari_shadowinv.preprocessing import PolynomialEstimate
from napari_shadowinv.shot import shots_of

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


def test_a_store_lies_beside_the_files_unless_another_is_chosen(opened, tmp_path, monkeypatch):
    folder = str(tmp_path / "night")
    monkeypatch.setattr(QFileDialog, "getExistingDirectory", lambda *_: folder)
    tool = opened(Invert)
    tool.image.set_kind("folder")
    tool.image.choose_path()
    assert tool.image.shots() == tmp_path / "night"
    assert tool.store.path == tmp_path / "night.shadowinv.zarr"
    tool.image.set_kind("files")
    tool.image.form.restore({"path": str(tmp_path / "day" / "*.tif")})
    assert tool.store.path == tmp_path / "day.shadowinv.zarr"
    tool.store.folder.restore({"path": "mine.shadowinv.zarr"})
    tool.image.set_kind("folder")
    assert tool.store.path == Path("mine.shadowinv.zarr")


def test_the_source_of_a_sample_is_its_own_until_another_image_is_chosen(viewer, opened, plain):
    tool = opened(Invert)
    assert tool.source.offered == []  # no image is its own source
    tool.source.set_kind("low-pass")
    sample = by_role(viewer.open_sample(PLUGIN, "toroid"))
    assert tool.image.offered == [plain, sample["shot"]]
    for _ in range(2):
        tool.image.layer = sample["shot"]
        assert tool.source.kind == "own"
        assert tool.setup.note.text() == "Came with the sample 'toroid'."
        # What was chosen before comes back.
        tool.image.layer = plain
        assert tool.source.kind == "low-pass"
    tool.image.layer = sample["shot"]
    tool.source.layer = sample["source"]
    assert tool.source.kind == "layer"
    viewer.layers.remove(sample["source"])
    assert tool.source.kind == "own"


def test_results_are_not_offered_as_shots(viewer, opened, plain, solved):
    add_to_viewer(viewer, solved, name="solved")
    tool = opened(Invert)
    assert tool.image.offered == [plain]
    assert [role_of(layer) for layer in tool.masks.offered] == []
    assert all(role_of(layer) in (None, "source") for layer in tool.source.offered)
    assert {role_of(layer) for layer in opened(Simulate).field.offered} == {"field"}
    field = layer_of(viewer, "field")
    for command in (commands.invert_uniform, commands.high_pass):
        with pytest.raises(InputError, match="is part of a result: select the shot"):
            command(field)


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


def test_a_mask_over_the_object_is_refused(viewer, opened, hump, run, wait, refused):
    shot, _, is_object = hump
    image = viewer.add_image(shot, name="shot")
    labels = viewer.add_labels(is_object.astype(int), name="object")
    tool = opened(Invert)
    tool.source.set_kind("polynomial")
    tool.masks.layer = tool.source_masks.layer = labels
    words = "the object would be excluded from the inversion"
    refused(tool, words)
    # As well if the estimate was made before, in a layer of its own.
    run(tool, tool.show_source)
    name = "shot source: fitted polynomial"
    wait(lambda: name in viewer.layers)
    stack = viewer.add_image(np.stack([shot, shot]), name="stack")
    for layer in (image, stack):
        later = opened(Invert)
        later.image.layer = layer
        later.store.folder.restore({"path": "a.shadowinv.zarr"})
        later.source.layer = viewer.layers[name]
        later.masks.layer = labels
        with pytest.raises(InputError, match=words):
            later.request()
        later.masks.layer = None
        later.request()


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
    field = layer_of(viewer, "field")
    origins = result_of(field).origins
    assert {title: rows[title] for title in origins} == origins
    provenance = result_of(field).content.provenance
    assert provenance.recipe.source == PolynomialEstimate()
    assert provenance.masks[provenance.image.source_mask].mask() is not None


def test_the_report_of_one_run_does_not_stand_beside_another(
    opened, plain, of_a_file, run, rest, messages
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
    rest(tool)
    assert tool.panel.status.text() == "Cancelled."
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
    # A problem is shown until something else happens.
    assert messages == [tool.panel.status.text()]
    tool.image.layer = of_a_file
    assert tool.panel.status.text() == ""


SHAPE = (64, 72)
NOISE = np.random.default_rng(4).normal(1, 0.01, (3, *SHAPE))
OBJECT = synthetic_image(ellipse_pair(SHAPE).displacement) * NOISE[0]
BEAM, LATER = NOISE[1:] * (1 + np.linspace(0, 0.3, SHAPE[1]))


def boxes(tool):
    source = tool.source.layer
    return tool.image.layer.name, tool.source.kind if source is None else source.name


PAIRS = [
    ("tim_0034", "beam"), ("b", "a"), ("shot_012", "shot_013"), ("x-ray", "x-ray_ref"),
    ("img12", "ReferenceImage"), ("Image", "Image [1]"), ("refraction", "BG_1"),
    ("2026-05-01", "2026-05-01 blank"),
]  # fmt: skip
# By name, by structure alone and in a series, opened in all orders.
ORDERS = list(itertools.product((True, False), repeat=2))
CASES = [(*pair, *ORDERS[number % 4]) for number, pair in enumerate(PAIRS)]
CASES += [("b", "a", *order) for order in ORDERS]


@pytest.mark.parametrize(("shot", "beam", "beam_first", "window_first"), CASES)
def test_a_pair_fills_both_boxes(viewer, opened, shot, beam, beam_first, window_first):
    tool = opened(Invert) if window_first else None
    images = {shot: OBJECT, beam: BEAM}
    for name in (beam, shot) if beam_first else (shot, beam):
        viewer.add_image(images[name], name=name)
    assert boxes(tool or opened(Invert)) == (shot, beam)


MESH = 1 + 0.5 * (np.indices(SHAPE).sum(axis=0) // 16 % 2)
"""A beam through a mesh, which has more structure than a weak object."""


@pytest.mark.parametrize(
    ("images", "expected"),
    [
        ({"shot": BEAM, "ref": MESH, "dark": 0.01 * OBJECT}, "ref"),  # a name counts more
        ({"shot": np.stack([OBJECT, OBJECT]), "reference": BEAM}, "reference"),  # of a stack
        # Nothing is guessed where two are possible.
        ({"shot high-pass": 0.5 + OBJECT / 2, "shot": OBJECT}, "uniform"),
        ({"beam": BEAM[1:], "shot": OBJECT}, "uniform"),  # of another size
        ({"ref_1": BEAM, "ref_2": LATER, "shot": OBJECT}, "uniform"),
        ({"dark": 0.01 * BEAM, "shot": OBJECT}, "uniform"),
    ],
)
def test_the_source_of_several_images(viewer, opened, images, expected):
    for name, image in images.items():
        viewer.add_image(image, name=name)
    assert boxes(opened(Invert)) == ("shot", expected)


def test_a_choice_is_never_overruled_and_no_estimate_is_guessed(viewer, opened):
    tool = opened(Invert)
    viewer.add_image(OBJECT, name="shot")
    beam = viewer.add_image(BEAM, name="ref")
    assert boxes(tool) == ("shot", "ref")
    viewer.layers.remove(beam)
    metadata = metadata_for("source", "", made_from={"estimate": "polynomial"})
    estimate = viewer.add_image(BEAM, name="shot source", metadata=metadata)
    assert boxes(tool) == ("shot", "uniform")
    assert estimate in tool.source.offered
    tool.source.set_kind("polynomial")
    viewer.add_image(BEAM, name="ref")
    assert boxes(tool) == ("shot", "polynomial")
    tool.image.layer = viewer.layers["ref"]
    viewer.add_image(OBJECT, name="shot 2")
    assert tool.image.layer.name == "ref"


def test_a_layer_may_have_the_name_of_another_entry(viewer, opened):
    viewer.add_image(OBJECT, name="shot")
    beam = viewer.add_image(BEAM, name="uniform")
    tool = opened(Invert)
    for choice, kind in ((beam, "layer"), ("uniform", "uniform"), (beam, "layer")):
        tool.source.choice.value = choice
        assert tool.source.kind == kind
    assert tool.source.choice.current_choice == "layer uniform"


@pytest.mark.usefixtures("no_causes")
def test_a_fit_from_a_file_has_its_beam(viewer, opened, tmp_path):
    options = FitOptions(max_iterations=2, samples=0)
    shots = shots_of([OBJECT * BEAM * NOISE[0]], source=BEAM, noise=0.01, strength=[1.0])
    result = run_fit(Recipe(fit=FitChoices(options=options)), shots)
    path = write(tmp_path / "fit.shadowinv", result.to_dataset())
    add_layers(viewer, layers_of_dataset(read(path), "fit"))
    tool = opened(Invert)
    assert tool.source.kind == "own"
    beam = tool.source.measured(layer_of(viewer, "image")).image
    np.testing.assert_array_equal(beam, result.source[0])
    assert role_of(opened(FitImages).source.layer) == "source"
    marks = {layer.name[:2] for layer in viewer.layers if role_of(layer) in ("field", "residual")}
    assert len(marks) == 1


def test_an_estimate_becomes_a_layer(viewer, opened, wait):
    shot = viewer.add_image(OBJECT, name="shot", scale=(2, 2), translate=(5, 7))
    tool = opened(Invert)
    assert tool.show_source.parentWidget().isHidden()
    tool.source.set_kind("polynomial")
    assert not tool.show_source.parentWidget().isHidden()
    tool.source_masks.paint()
    tool.source_masks.layer.data[10:20, 20:30] = 1
    tool.show_source.click()
    name = "shot source: fitted polynomial"
    wait(lambda: name in viewer.layers)
    source, usable = viewer.layers[name], tool.source_masks.usable(shot)
    np.testing.assert_allclose(source.data, PolynomialEstimate(degree=2).source(OBJECT, usable))
    assert (tuple(source.scale), tuple(source.translate)) == ((2, 2), (5, 7))
    assert (role_of(source), is_estimate(source)) == ("source", True)
    # It has the error of an unmeasured beam unless one is stated; an opened layer has not.
    tool.source.layer = source
    assert tool.recipe().instrument == Instrument(beam_rms=0.05)
    enter(tool.instrument.entries["beam_source"], "laser")
    enter(tool.instrument.entries["beam_rms"], 0.01)
    assert tool.recipe().instrument == Instrument(beam_source="laser", beam_rms=0.01)
    tool.instrument.restore({})
    tool.source.layer = viewer.add_image(source.data, name="recorded", scale=(2, 2))
    assert tool.recipe().instrument == Instrument()
