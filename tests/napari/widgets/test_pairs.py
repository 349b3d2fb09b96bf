"""An image and its beam find their boxes, in whatever order they were opened."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv import FitOptions, Recipe, read, write
from napari_shadowinv._napari.layer_metadata import is_estimate, metadata_for, role_of
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.result_files import layers_of_dataset
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.options import FitChoices
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair
from napari_shadowinv.pipeline import run_fit
from napari_shadowinv.preprocessing import PolynomialEstimate
from napari_shadowinv.shot import shots_of

SHAPE = (64, 72)
NOISE = np.random.default_rng(4).normal(1, 0.01, (3, *SHAPE))
OBJECT = synthetic_image(ellipse_pair(SHAPE).displacement) * NOISE[0]
BEAM, LATER = NOISE[1:] * (1 + np.linspace(0, 0.3, SHAPE[1]))


def boxes(tool):
    source = tool.source.layer
    return tool.image.layer.name, tool.source.kind if source is None else source.name


@pytest.mark.parametrize("window_first", [True, False])
@pytest.mark.parametrize("beam_first", [True, False])
@pytest.mark.parametrize(
    ("shot", "beam"),
    [
        ("tim_0034", "beam"), ("b", "a"), ("shot_012", "shot_013"), ("x-ray", "x-ray_ref"),
        ("img12", "ReferenceImage"), ("Image", "Image [1]"), ("refraction", "BG_1"),
        ("s7", "flat-field"), ("2026-05-01", "2026-05-01 blank"), ("p", "backgrounds"),
    ],
)  # fmt: skip
def test_a_pair_fills_both_boxes(viewer, opened, shot, beam, beam_first, window_first):
    tool = opened(Invert) if window_first else None
    images = {shot: OBJECT, beam: BEAM}
    for name in (beam, shot) if beam_first else (shot, beam):
        viewer.add_image(images[name], name=name)
    assert boxes(tool or opened(Invert)) == (shot, beam)


def test_a_name_counts_more_than_structure(viewer, opened):
    """A beam through a mesh has more structure than a weak object."""
    mesh = 1 + 0.5 * (np.indices(SHAPE).sum(axis=0) // 16 % 2)
    for name, image in {"shot": BEAM, "ref": mesh, "dark": 0.01 * OBJECT}.items():
        viewer.add_image(image, name=name)
    assert boxes(opened(Invert)) == ("shot", "ref")


@pytest.mark.parametrize(
    "others",
    [
        {"shot_2": OBJECT[::-1]},  # two shots
        {"shot high-pass": 0.5 + OBJECT / 2},  # a filtered copy
        {"beam": BEAM[1:]},  # of another size
        {"ref_1": BEAM, "ref_2": LATER},  # which of the two?
        {"a": BEAM, "b": LATER},
        {"dark": 0.01 * BEAM},
    ],
)
def test_nothing_is_guessed_where_two_are_possible(viewer, opened, others):
    for name, image in {**others, "shot": OBJECT}.items():
        viewer.add_image(image, name=name)
    assert boxes(opened(Invert)) == ("shot", "uniform")


def test_a_choice_is_never_overruled(viewer, opened):
    viewer.add_image(OBJECT, name="shot")
    tool = opened(Invert)
    tool.source.set_kind("polynomial")
    viewer.add_image(BEAM, name="ref")
    assert boxes(tool) == ("shot", "polynomial")

    tool = opened(Invert)
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


def test_without_its_beam_an_image_has_the_source_from_before(viewer, opened):
    tool = opened(Invert)
    viewer.add_image(OBJECT, name="shot")
    beam = viewer.add_image(BEAM, name="ref")
    assert boxes(tool) == ("shot", "ref")
    assert tool.state()["source"]["kind"] == "uniform"
    viewer.layers.remove(beam)
    assert boxes(tool) == ("shot", "uniform")


def test_an_estimate_is_not_taken_before_it_is_chosen(viewer, opened):
    viewer.add_image(OBJECT, name="shot")
    tool = opened(Invert)
    made_from = {"estimate": "polynomial"}
    estimate = viewer.add_image(
        BEAM, name="shot source", metadata=metadata_for("source", "", made_from=made_from)
    )
    assert boxes(tool) == ("shot", "uniform")
    assert estimate in tool.source.offered


def test_a_stack_is_taken_with_its_beam(viewer, opened):
    viewer.add_image(np.stack([OBJECT, OBJECT]), name="run")
    viewer.add_image(BEAM, name="reference")
    tool = opened(Invert)
    assert tool.image.layer.name == "run"
    assert tool.source.layer.name == "reference"


@pytest.mark.parametrize(("images", "kind"), [(1, Invert), (2, FitImages)])
def test_a_fit_from_a_file_has_its_beam(viewer, opened, tmp_path, images, kind):
    options = FitOptions(max_iterations=2, samples=0)
    strength = [1.0, 0.5][:images]
    recorded = [OBJECT * BEAM * noise for noise in NOISE[:images]]
    shots = shots_of(recorded, source=BEAM, noise=0.01, strength=strength)
    found = run_fit(Recipe(fit=FitChoices(options=options)), shots)
    path = write(tmp_path / "fit.shadowinv", found.to_dataset())
    add_layers(viewer, layers_of_dataset(read(path), "fit"))
    tool = opened(kind)
    source = tool.source
    if images == 1:
        assert source.is_supplied
        np.testing.assert_array_equal(source.measured(image_of(viewer)).image, found.source[0])
    else:
        assert len(tool.images.used) == images
        assert role_of(source.layer) == "source"
    marks = {layer.name[:2] for layer in viewer.layers if role_of(layer) in ("field", "residual")}
    assert len(marks) == 1


def image_of(viewer):
    (image,) = [layer for layer in viewer.layers if role_of(layer) == "image"]
    return image


def test_an_estimate_becomes_a_layer(viewer, opened, qtbot):
    shot = viewer.add_image(OBJECT, name="shot", scale=(2, 2), translate=(5, 7))
    tool = opened(Invert)
    assert tool.show_source.parentWidget().isHidden()
    tool.source.set_kind("polynomial")
    assert not tool.show_source.parentWidget().isHidden()
    tool.source_masks.paint()
    tool.source_masks.layer.data[10:20, 20:30] = 1
    tool.show_source.click()
    name = "shot source: fitted polynomial"
    qtbot.waitUntil(lambda: name in viewer.layers, timeout=60_000)
    source, usable = viewer.layers[name], tool.source_masks.usable(shot)
    np.testing.assert_allclose(source.data, PolynomialEstimate(degree=2).source(OBJECT, usable))
    assert (tuple(source.scale), tuple(source.translate)) == ((2, 2), (5, 7))
    assert (role_of(source), is_estimate(source)) == ("source", True)
