"""Layers of other scales, places and axes cover the pixels of an image that they are seen on."""

from __future__ import annotations

import numpy as np
import pytest
from napari.layers import Image, Labels, Shapes

from napari_shadowinv._napari.placement import labels_on, matrix_between, pixel_mapper, source_on
from napari_shadowinv._napari.shots import source_of_shot
from napari_shadowinv._napari.widgets._layers import crop_of, mask_of
from napari_shadowinv.errors import InputError

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


def test_labels_of_one_plane_mask_all_shots_of_a_stack():
    stack = Image(np.ones((4, 20, 30)), scale=(1, 2, 2), translate=(0, 1, 1))
    labels = painted((40, 60), slice(10, 20), slice(0, 60))
    rows = np.flatnonzero(labels_on(labels, stack)[:, 0])
    assert list(rows) == [5, 6, 7, 8, 9]  # centres at 1 + 2 k


def test_lengths_are_compared_in_their_units():
    image = Image(np.ones((20, 30)), scale=(2, 2), units="um")
    labels = painted((20, 30), slice(0, 5), slice(0, 30), scale=(0.001, 0.001), units="mm")
    assert list(np.flatnonzero(labels_on(labels, image)[:, 0])) == [0, 1, 2]  # centres at 0, 2, 4
    np.testing.assert_allclose(pixel_mapper(image, labels)(np.array([[0.004, 0.01]])), [[2, 5]])


def test_a_mask_beside_the_image_or_of_planes_is_refused():
    image = Image(np.ones((20, 30)), name="shot")
    with pytest.raises(InputError, match="beside the image 'shot'"):
        mask_of(painted((9, 9), slice(9), slice(9), translate=(50, 0)), image, True)
    with pytest.raises(InputError, match="expected one plane"):
        mask_of(Labels(np.ones((3, 20, 30), int)), image, True)


def test_a_rectangle_on_a_turned_image_crops_its_pixels():
    image = Image(np.ones((40, 50)), scale=(2, 2), rotate=30.0, translate=(5, 7))
    corners = np.array([[9.6, 4.6], [9.6, 20.4], [25.4, 20.4], [25.4, 4.6]])
    world = 2 * corners @ ROTATION.T + (5, 7)
    crop = crop_of(Shapes([world], shape_type="polygon"), image)
    assert crop is not None
    assert (crop.y, crop.x) == ((10, 26), (5, 21))


def test_a_source_is_moved_by_whole_pixels_only():
    beam = np.random.default_rng(1).uniform(1, 2, (40, 50))
    image = Image(np.ones((20, 30)), scale=(2, 2), translate=(6, 8), name="shot")
    whole = Image(beam, scale=(2, 2), name="ref")
    np.testing.assert_array_equal(source_on(whole, beam, image), beam[3:23, 4:34])
    whole.translate = (1, 0)  # half a pixel
    with pytest.raises(InputError, match=r"50 × 40 px \(scale 2\), the image 'shot' 30 × 20 px"):
        source_on(whole, beam, image)
    whole.translate = (8, 0)  # covers only a part
    with pytest.raises(InputError, match="only a part"):
        source_on(whole, beam, image)


@pytest.mark.parametrize("place", [{"scale": (2, 2)}, {"rotate": 90.0}, {"scale": (1, -1)}])
def test_a_source_of_other_pixels_is_refused(place):
    image, beam = Image(np.ones((20, 20)), name="shot"), Image(np.ones((20, 20)), **place)
    with pytest.raises(InputError, match="pixels that lie on each other"):
        source_on(beam, beam.data, image)


def test_sizes_at_one_place_must_match():
    image, beam = Image(np.ones((20, 20)), name="shot"), Image(np.ones((22, 24)), name="ref")
    with pytest.raises(InputError, match="'ref' has 24 × 22 px, the image 'shot' 20 × 20 px"):
        source_on(beam, beam.data, image)
    with pytest.raises(InputError, match="they must match"):
        labels_on(Labels(np.ones((9, 9), int)), image)


def test_a_source_without_place_is_taken_pixel_by_pixel():
    """A setup has placed the shot; the reference was opened later, in pixels."""
    image, beam = Image(np.ones((20, 20)), scale=(1.5, 1.5), units="um"), np.eye(20)
    assert source_on(Image(beam), beam, image) is beam


def test_a_cut_source_is_no_longer_its_file(tmp_path):
    metadata = {"napari-shadowinv": {"path": str(tmp_path / "ref.tif")}}
    beam = Image(np.ones((40, 50)), metadata=metadata)
    image = Image(np.ones((20, 30)), translate=(4, 4))
    assert source_of_shot(beam, beam.data, image).path is None
    image.translate, image.data = (0, 0), np.ones((40, 50))
    assert source_of_shot(beam, beam.data, image).path == tmp_path / "ref.tif"


def test_matrices_there_and_back_are_inverse():
    image = Image(np.ones((20, 30)), scale=(2, 3), rotate=20.0, units="um")
    other = Image(np.ones((20, 30)), shear=[0.2], translate=(4, 5), units="mm")
    there, back = matrix_between(image, other), matrix_between(other, image)
    np.testing.assert_allclose(there @ back, np.eye(3), atol=1e-9)
