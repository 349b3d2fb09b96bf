"""Saving layers of a result, and getting the same ones back."""

import numpy as np
import pytest
from napari.components import ViewerModel

from helpers.layers import by_role
from napari_shadowinv import FileFormatError, add_to_viewer, read, write
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    layer_key,
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.layers import add_layers
from napari_shadowinv._napari.result_files import layers_of_result, write_result
from napari_shadowinv.results import result_from_dataset

PLUGIN = "napari-shadowinv"


@pytest.fixture
def other_viewer():
    return ViewerModel()


SAME_FOR_ALL = ("name", "visible", "opacity", "blending", "units", "axis_labels")
SAME = {
    "image": ("contrast_limits", "gamma", "interpolation2d"),
    "labels": (),
    "points": ("face_contrast_limits",),
    "vectors": ("length", "edge_width", "vector_style"),
}


def assert_same_layer(one, two):
    kind = one._type_string
    assert two._type_string == kind
    for name in (*SAME_FOR_ALL, *SAME[kind]):
        assert getattr(one, name) == getattr(two, name), name
    for name in ("scale", "translate", "rotate", "data"):
        np.testing.assert_array_equal(getattr(two, name), getattr(one, name))
    for name in ("colormap", "face_colormap", "edge_colormap"):
        if hasattr(one, name):
            first, second = getattr(one, name), getattr(two, name)
            assert first.name == second.name or kind == "labels"
            np.testing.assert_allclose(second.colors, first.colors)
    for name in ("face_color", "edge_color"):
        if hasattr(one, name):
            np.testing.assert_allclose(getattr(two, name), getattr(one, name))
    if hasattr(one, "features"):
        assert list(one.features) == list(two.features)
        np.testing.assert_array_equal(two.features, one.features)
    assert layer_key(one) == layer_key(two)
    assert (unit_of(one), setup_of(one)) == (unit_of(two), setup_of(two))


@pytest.fixture(params=["inversion", "fit", "film pack", "field"])
def content(request, proton_setup, tmp_path):
    """A result of each kind."""
    if request.param == "film pack":
        return request.getfixturevalue("pack_doses")
    if request.param == "fit":
        return request.getfixturevalue("two_fields")
    inversion = request.getfixturevalue("solved").in_units(proton_setup)
    if request.param == "field":
        return result_from_dataset(read(write(tmp_path / "field.h5", inversion)))
    return inversion


def test_a_result_of_each_kind_comes_back_whole(viewer, other_viewer, content, tmp_path):
    place = {"translate": (7.5, 9.0), "units": ("mm", "mm"), "rotate": ((0.0, -1.0), (1.0, 0.0))}
    result = Result(content, {"Setup": "typed"})
    frame = Frame(scale=(3.0, 3.0), **place)
    before = add_layers(viewer, layers_of_result(result, frame, "shot 7"))
    images = [layer for layer in before if layer._type_string == "image" and not layer.rgb]
    images[0].visible, images[0].gamma, images[0].opacity = True, 0.7, 0.5
    images[1].colormap, images[1].contrast_limits = "magma", (1.0, 2.0)
    if len(images) > 2:
        images[2].name, images[2].colormap = "my own", ["black", "red", "yellow"]
    for layer in before:
        if layer._type_string == "vectors":
            layer.length = 3.5
    path = tmp_path / "a.shadowinv"
    assert viewer.layers.save(str(path), plugin=PLUGIN) == [str(path)]
    after = other_viewer.open(path, plugin=None)
    for layer, two in zip(before, after, strict=True):
        assert_same_layer(layer, two)
    assert result_of(after[0]).origins == {"Setup": "typed"}
    dataset, expected = read(path), content.to_dataset()
    for name in expected.variables:
        np.testing.assert_array_equal(dataset[name], expected[name])
    kept = expected.attrs.keys() - {"created", "format"}  # a field gets another format
    assert {name: dataset.attrs[name] for name in kept} == {
        name: expected.attrs[name] for name in kept
    }


def test_one_saved_layer_stands_for_the_main_ones(viewer, other_viewer, solved, tmp_path):
    layers = by_role(add_to_viewer(viewer, solved, name="shot", all_layers=True))
    layers["potential"].visible = True
    viewer.layers.selection = {layers["potential"]}
    viewer.layers.save(str(tmp_path / "a.shadowinv"), selected=True, plugin=PLUGIN)
    back = other_viewer.open(tmp_path / "a.shadowinv", plugin=PLUGIN)
    roles = ["image", "residual", "potential", "field", "caustic", "arrows"]
    assert [role_of(layer) for layer in back] == roles
    assert [role_of(layer) for layer in back if layer.visible] == ["potential", "field", "arrows"]
    assert all(layer.name.endswith(" – shot") for layer in back)


def test_painted_caustics_are_kept(viewer, solved, tmp_path):
    caustics = by_role(add_to_viewer(viewer, solved))["caustic"]
    caustics.data[:5, :6] = 1
    viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)
    caustic = read(tmp_path / "a.shadowinv")["caustic"].values
    assert caustic[:5, :6].all()
    np.testing.assert_array_equal(caustic[5:], solved.caustic[5:])


def test_layers_of_two_results_or_of_none_are_refused(viewer, solved, make_inversion, tmp_path):
    def save():
        viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)

    viewer.add_image(np.zeros((4, 4)), name="holiday", contrast_limits=(0, 1))
    with pytest.raises(FileFormatError, match=r"no layer belongs to a result .'holiday'."):
        save()
    add_to_viewer(viewer, solved, name="one")
    add_to_viewer(viewer, make_inversion((24, 32)), name="two")
    with pytest.raises(FileFormatError, match=r"belong to 2 results .*select layers of one"):
        save()


def test_napari_still_writes_its_own_csv(viewer, tmp_path):
    viewer.add_points(np.zeros((3, 2)))
    viewer.layers.save(str(tmp_path / "points.csv"))
    assert "axis-0" in (tmp_path / "points.csv").read_text()


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
