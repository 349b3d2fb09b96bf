"""The widget that converts scans of a film pack to fluences, mostly without a window."""

import numpy as np
import pytest

from helpers.layers import layer_of
from napari_shadowinv import read, write
from napari_shadowinv._napari.layer_metadata import role_of, setup_of, usable_of
from napari_shadowinv._napari.layers import BY_HAND
from napari_shadowinv._napari.widgets.film_pack import FilmPack, corner_layers, dragged_corners
from napari_shadowinv._napari.widgets.fit_images import FitImages
from napari_shadowinv._napari.widgets.invert import Invert
from napari_shadowinv.film import read_corners
from napari_shadowinv.film_doses import FilmDoses


@pytest.fixture
def tool(opened):
    return opened(FilmPack)


@pytest.fixture
def evaluated(viewer, tool, pack_doses, tmp_path):
    """The widget with a result that was opened from a file; that of another is not kept."""
    tool.file.restore({"file": str(tmp_path / "another.toml")})
    viewer.open(write(tmp_path / "trio.shadowinv", pack_doses), plugin="napari-shadowinv")
    assert tool.file.state() == {}
    return tool


def test_corners_are_shown_dragged_and_used(viewer, evaluated, pack_doses, run, wait):
    tool = evaluated
    layer_of(viewer, "unusable").data[0, 40:44, 50:55] = BY_HAND
    viewer.dims.set_current_step(0, 1)
    tool.show_corners.click()
    polygon = viewer.layers.selection.active
    assert polygon.mode == "direct"
    corners = pack_doses.corners
    np.testing.assert_allclose(polygon.data[0], corners[1], atol=1e-4)
    assert viewer.layers["scan of film 2"].rgb
    assert dragged_corners(viewer, tool._selected()[1]) is None
    moved = corners + np.array([[-2.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    polygon.data = [moved[1]]
    viewer.dims.set_current_step(0, 2)
    tool.show_corners.click()
    assert not viewer.layers["scan of film 2"].visible
    viewer.layers.selection.active.data = [moved[2]]
    run(tool)
    doses = tool._selected()[1]
    assert doses is not pack_doses
    table = read_corners(doses.pack.corners)
    np.testing.assert_allclose(table["1"], corners[0], atol=0.006)
    np.testing.assert_allclose(table["2"], moved[1], atol=0.006)
    np.testing.assert_allclose(table["3"], moved[2], atol=0.006)
    assert list(table) == ["1", "2", "3"]
    # Marks stay in their places, although the films are a pixel higher now.
    height = doses.dose.shape[1]
    assert height == pack_doses.dose.shape[1] + 1
    spot = doses.usable[0, 38:46, 48:57]
    assert spot.sum() == spot.size - 20
    marks = tool._partner(tool.packs.layer, "unusable")
    assert (marks.data[0, 38:46, 48:57][~spot] == BY_HAND).all()
    assert not corner_layers(viewer)


def test_a_polygon_that_is_no_film_is_refused(evaluated, refused):
    evaluated.show_corners.click()
    polygon = evaluated.viewer.layers.selection.active
    (film,) = polygon.data
    for shapes, words in (
        ([film[[0, 2, 1, 3]]], "do not go around a film"),
        ([film[:3]], "with 3 corners: expected one polygon with the four"),
        ([], "has 0 shapes: expected one polygon"),
    ):
        polygon.data = shapes
        refused(evaluated, words)


def test_painted_pixels_are_not_used(viewer, evaluated, pack_doses, run, tmp_path, choose):
    tool = evaluated
    tool.show_corners.click()
    tool.paint.click()
    assert not any(layer.visible for layer in corner_layers(viewer))  # they would cover it
    marks = layer_of(viewer, "unusable")
    assert marks.visible
    assert marks.mode == "paint"
    assert marks.selected_label == BY_HAND
    spot = np.s_[1, 30:36, 40:48]
    assert pack_doses.usable[spot].all()
    marks.data[spot] = BY_HAND
    run(tool)
    doses = tool._selected()[1]
    usable = doses.usable
    assert not usable[spot].any()
    assert usable[0, 30:36, 40:48].all()
    marks = tool._partner(tool.packs.layer, "unusable")
    assert (marks.data[spot] == BY_HAND).all()
    assert (marks.data == BY_HAND).sum() == 48
    # What was corrected goes with a file.
    file = tmp_path / "mended.shadowinv"
    choose(file)
    tool.save.click()
    again = FilmDoses.from_dataset(read(file))
    np.testing.assert_array_equal(again.usable, usable)
    mask = again.pack.layers[1].mask
    assert mask == tmp_path / "mended_mask_02.tif"
    assert not read(mask).image[30:36, 40:48].any()
    # Rubbed out, they count again.
    marks.data[spot] = 0
    run(tool)
    assert tool._selected()[1].usable[spot].all()


def test_films_become_images_that_can_be_fitted(viewer, opened, evaluated, pack_doses, rest):
    evaluated.to_fit.click()
    rest(evaluated)
    images = [layer for layer in viewer.layers if role_of(layer) == "shot"]
    names = [f"film {k}, {energy:.3g} MeV" for k, energy in enumerate(pack_doses.energies, 1)]
    assert [layer.name for layer in images] == names
    fit = opened(FitImages)
    fit.source.set_kind("unknown")
    job = fit.request()
    for shot, layer in zip(job.shots, images, strict=True):
        np.testing.assert_array_equal(shot.mask, usable_of(layer))
        assert shot.setup == setup_of(layer)
    invert = opened(Invert)
    invert.image.layer = images[1]
    request = invert.request()
    np.testing.assert_array_equal(request.shot.mask, pack_doses.usable[1])
    assert request.recipe.setup == setup_of(images[1])
