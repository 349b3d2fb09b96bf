"""Saving layers of a result, and getting the same ones back."""

import numpy as np
import pytest
from napari.components import ViewerModel

from helpers.layers import by_role
from napari_shadowinv import FileFormatError, add_to_viewer, read
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    frame_of,
    layer_key,
    main_layers,
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.result_files import layers_of_result, write_result
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.results import result_from_dataset

PLUGIN = "napari-shadowinv"


@pytest.fixture
def other_viewer():
    return ViewerModel()


@pytest.fixture(params=["inversion", "fit", "film pack", "field"])
def content(request, proton_setup, tmp_path):
    """A result of each kind."""
    if request.param == "film pack":
        return request.getfixturevalue("pack_doses")
    if request.param == "fit":
        return request.getfixturevalue("two_fields")
    inversion = request.getfixturevalue("solved").in_units(proton_setup)
    if request.param == "field":
        field = inversion.displacement, inversion.potential, proton_setup
        return result_from_dataset(dataset_from_field(*field))
    return inversion


def test_a_result_of_each_kind_comes_back_whole(viewer, other_viewer, content, tmp_path):
    result = Result(content, {"Setup": "typed"})
    turn = ((0.0, -1.0, 2.0), (1.0, 0.0, 3.0), (0.0, 0.0, 1.0))
    frame = Frame(scale=(3.0, 3.0), translate=(7.5, 9.0), units=("mm", "mm"), affine=turn)
    layer_data = layers_of_result(result, frame, "shot 7")
    before = add_layers(viewer, main_layers(layer_data, also={"image"}))
    path = tmp_path / "a.shadowinv"
    assert viewer.layers.save(str(path), plugin=PLUGIN) == [str(path)]
    after = other_viewer.open(path, plugin=None)
    for one, two in zip(before, after, strict=True):
        assert (one.name, one.visible, frame_of(one)) == (two.name, two.visible, frame_of(two))
        assert (layer_key(one), unit_of(one)) == (layer_key(two), unit_of(two))
        np.testing.assert_array_equal(two.data, one.data)
        assert setup_of(one) == setup_of(two)
    assert result_of(after[0]).origins == {"Setup": "typed"}
    dataset, expected = read(path), content.to_dataset()
    for name in expected.variables:
        np.testing.assert_array_equal(dataset[name], expected[name])
    kept = expected.attrs.keys() - {"created", "format"}  # a field gets another format
    assert {name: dataset.attrs[name] for name in kept} == {
        name: expected.attrs[name] for name in kept
    }


def test_one_saved_layer_stands_for_the_result(viewer, other_viewer, solved, tmp_path):
    layers = by_role(add_to_viewer(viewer, solved, name="shot", all_layers=True))
    viewer.layers.selection = {layers["potential"]}
    viewer.layers.save(str(tmp_path / "a.shadowinv"), selected=True, plugin=PLUGIN)
    back = other_viewer.open(tmp_path / "a.shadowinv", plugin=PLUGIN)
    roles = ["image", "residual", "field", "caustic", "arrows"]
    assert [role_of(layer) for layer in back] == roles
    assert [role_of(layer) for layer in back if layer.visible] == ["field", "arrows"]
    assert all(layer.name.endswith(" – shot") for layer in back)


def test_layers_of_two_results_or_of_none_are_refused(viewer, solved, make_inversion, tmp_path):
    def save():
        viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)

    viewer.add_image(np.zeros((4, 4)), name="holiday", contrast_limits=(0, 1))
    with pytest.raises(FileFormatError, match="no layer belongs to a result"):
        save()
    add_to_viewer(viewer, solved, name="one")
    add_to_viewer(viewer, make_inversion((24, 32)), name="two")
    with pytest.raises(FileFormatError, match="several results: select layers of one"):
        save()


def test_an_ending_is_added_but_never_onto_an_existing_file(viewer, solved, tmp_path):
    layers = [layer.as_layer_data_tuple() for layer in add_to_viewer(viewer, solved)]
    target = tmp_path / "shot.07"
    assert write_result(str(target), layers) == [f"{target}.shadowinv"]
    # The dialog asked about "shot.07", not about this.
    with pytest.raises(FileFormatError, match=r"shot.07.shadowinv exists: choose another name"):
        write_result(str(target), layers)


def test_a_duplicated_layer_still_belongs_to_the_result(viewer, solved):
    from copy import deepcopy

    from napari.layers import Layer

    (layer, *_) = add_to_viewer(viewer, solved)
    data, keywords, kind = layer.as_layer_data_tuple()
    twin = Layer.create(deepcopy(data), keywords, kind)
    assert result_of(twin) is result_of(layer)
