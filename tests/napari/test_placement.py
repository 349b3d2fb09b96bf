"""Layers of other scales, places and axes cover the pixels of an image that they are seen on."""

import numpy as np
import pytest
from napari.layers import Image, Labels, Shapes

from napari_shadowinv._napari.layer_metadata import (
    labels_on,
    pixel_mapper,
    source_on,
)
from napari_shadowinv._napari.shots import source_of_shot
from napari_shadowinv._napari.widgets._layers import crop_of, image_of, painted_on
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import Crop

TURN = np.deg2rad(30.0)
ROTATION = np.array([[np.cos(TURN), -np.sin(TURN)], [np.sin(TURN), np.cos(TURN)]])


def painted(shape, rows, columns, **place):
    labels = np.zeros(shape, int)
    labels[rows, columns] = 1
    return Labels(labels, **place)


def seen_on(image, labels):
    """Look up the label under each pixel's centre, one by one, as the canvas does."""
    at = np.zeros(image.data.shape[-2:], bool)
    for y, x in np.ndindex(at.shape):
        world = image.data_to_world((*np.zeros(image.ndim - 2), y, x))[-2:]
        row, column = np.round(labels.world_to_data(world)[-2:]).astype(int)
        inside = 0 <= row < labels.data.shape[0] and 0 <= column < labels.data.shape[1]
        at[y, x] = inside and labels.data[row, column] != 0
    return at


@pytest.mark.parametrize(
    ("image_place", "place"),
    [
        ({"scale": (2, 2)}, {"scale": (0.9, 0.9)}),
        ({"translate": (3, -2)}, {"translate": (5.2, 1.3), "scale": (1.1, 0.7)}),
        ({"rotate": 20.0, "scale": (1.5, 1.5)}, {"scale": (1.2, 1.2)}),
        ({"scale": (2, 2)}, {"shear": [0.29], "scale": (0.83, 0.81)}),
        ({}, {"affine": [[0, 1.1, 2.2], [1.3, 0, -1.4], [0, 0, 1]]}),
    ],
)
def test_labels_mask_the_pixels_that_they_cover(image_place, place):
    image = Image(np.ones((20, 30)), **image_place)
    labels = painted((40, 50), slice(5, 21), slice(8, 30), **place)
    on_image = labels_on(labels, image)
    np.testing.assert_array_equal(on_image, seen_on(image, labels))
    assert 0 < on_image.sum() < on_image.size


def test_labels_of_one_plane_mask_all_shots_of_a_stack_and_lengths_count_in_their_units():
    stack = Image(np.ones((4, 20, 30)), scale=(1, 2, 2), translate=(0, 1, 1))
    labels = painted((40, 60), slice(10, 20), slice(0, 60))
    rows = np.flatnonzero(labels_on(labels, stack)[:, 0])
    assert list(rows) == [5, 6, 7, 8, 9]  # centres at 1 + 2 k
    image = Image(np.ones((20, 30)), scale=(2, 2), units="um")
    labels = painted((20, 30), slice(0, 5), slice(0, 30), scale=(0.001, 0.001), units="mm")
    assert list(np.flatnonzero(labels_on(labels, image)[:, 0])) == [0, 1, 2]  # centres at 0, 2, 4
    np.testing.assert_allclose(pixel_mapper(image, labels)(np.array([[0.004, 0.01]])), [[2, 5]])


def test_what_is_painted_or_drawn_lies_on_the_image():
    image, labels = Image(np.ones((10, 12)), name="shot"), Labels(np.zeros((10, 12), int))
    assert painted_on(labels, image) is None
    labels.data[2, 3] = 5
    assert np.argwhere(painted_on(labels, image)).tolist() == [[2, 3]]
    larger = Image(np.ones((20, 30)), scale=(2.0, 2.0))
    rectangle = Shapes([np.array([[8, 8], [8, 20], [16, 20], [16, 8]])], shape_type="rectangle")
    inside = painted_on(rectangle, larger)
    assert inside[5:8, 5:10].all()
    assert not inside[:3].any()
    for mask, words in (
        (painted((9, 9), slice(9), slice(9), translate=(50, 0)), "beside the image 'shot'"),
        (Labels(np.ones((3, 10, 12), int)), "expected one plane"),
        (Labels(np.ones((9, 9), int)), "they must match"),
    ):
        with pytest.raises(InputError, match=words):
            painted_on(mask, image)


@pytest.mark.parametrize(
    ("layer", "words"),
    [
        (None, "File → Open"),
        (Image(np.ones((8, 8, 3)), rgb=True), "colour"),
        (Image(np.ones((4, 8, 8))), "Split Stack"),
    ],
)
def test_layers_that_are_no_single_image_are_refused(layer, words):
    with pytest.raises(InputError, match=words):
        image_of(layer)


def test_a_drawn_crop_follows_the_scale_of_its_image():
    image = Image(np.ones((20, 30)), scale=(2.0, 2.0), translate=(10.0, 0.0))
    rectangle = Shapes([np.array([[14, 8], [14, 40], [30, 40], [30, 8]])], shape_type="rectangle")
    assert crop_of(rectangle, image) == Crop(y=(2, 11), x=(4, 21))
    beyond = Shapes([np.array([[-90, -90], [-90, 90], [90, 90], [90, -90]])])
    assert crop_of(beyond, image) == Crop(y=(0, 20), x=(0, 30))
    assert crop_of(Shapes(ndim=2), image) is None


def test_a_rectangle_on_a_turned_image_crops_its_pixels():
    image = Image(np.ones((40, 50)), scale=(2, 2), rotate=30.0, translate=(5, 7))
    corners = np.array([[9.6, 4.6], [9.6, 20.4], [25.4, 20.4], [25.4, 4.6]])
    world = 2 * corners @ ROTATION.T + (5, 7)
    crop = crop_of(Shapes([world], shape_type="polygon"), image)
    assert crop == Crop(y=(10, 26), x=(5, 21))


def test_a_source_is_moved_by_whole_pixels_only():
    beam = np.random.default_rng(1).uniform(1, 2, (40, 50))
    image = Image(np.ones((20, 30)), scale=(2, 2), translate=(6, 8), name="shot")
    reference = Image(beam, scale=(2, 2), name="ref")
    np.testing.assert_array_equal(source_on(reference, beam, image), beam[3:23, 4:34])
    for translate, words in (
        ((1, 0), r"50 × 40 px \(scale 2 × 2\), the image 'shot' 30 × 20 px"),  # half a pixel
        ((8, 0), "only a part"),
    ):
        reference.translate = translate
        with pytest.raises(InputError, match=words):
            source_on(reference, beam, image)
    # A setup has placed the shot; the reference was opened later, in pixels.
    square, beam = Image(np.ones((20, 20)), scale=(1.5, 1.5), units="um"), np.eye(20)
    assert source_on(Image(beam), beam, square) is beam


@pytest.mark.parametrize(
    ("beam", "words"),
    [
        (Image(np.ones((20, 20)), scale=(2, 2)), "pixels that lie on each other"),
        (Image(np.ones((20, 20)), rotate=90.0), "pixels that lie on each other"),
        (Image(np.ones((20, 20)), scale=(1, -1)), "pixels that lie on each other"),
        (Image(np.ones((22, 24)), name="ref"), "'ref' has 24 × 22 px, the image 'shot' 20 × 20 px"),
    ],
)
def test_a_source_of_other_pixels_is_refused(beam, words):
    with pytest.raises(InputError, match=words):
        source_on(beam, beam.data, Image(np.ones((20, 20)), name="shot"))


def test_a_cut_source_is_no_longer_its_file(tmp_path):
    metadata = {"napari-shadowinv": {"path": str(tmp_path / "ref.tif")}}
    beam = Image(np.ones((40, 50)), metadata=metadata)
    image = Image(np.ones((20, 30)), translate=(4, 4))
    assert source_of_shot(beam, beam.data, image).path is None
    image.translate, image.data = (0, 0), np.ones((40, 50))
    assert source_of_shot(beam, beam.data, image).path == tmp_path / "ref.tif"
