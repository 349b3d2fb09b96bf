"""Saving layers of a result, and getting the same ones back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from napari.components import ViewerModel

from helpers.layers import by_role
from napari_shadowinv import FileFormatError, ProtonSetup, add_to_viewer, read
from napari_shadowinv._napari.layer_metadata import metadata_of, result_of, role_of
from napari_shadowinv._napari.result_files import write_result
from napari_shadowinv.inversion import Inversion

PLUGIN = "napari-shadowinv"


@pytest.fixture
def other_viewer() -> ViewerModel:
    return ViewerModel()


SAME_FOR_ALL = ("name", "visible", "opacity", "blending", "units", "axis_labels")
SAME = {
    "image": ("contrast_limits", "gamma", "interpolation2d"),
    "labels": (),
    "points": ("face_contrast_limits",),
    "vectors": ("length", "edge_width", "vector_style"),
    "shapes": ("edge_width", "shape_type"),
}


def assert_same_layer(one: Any, two: Any) -> None:
    kind = one._type_string
    assert two._type_string == kind
    for name in (*SAME_FOR_ALL, *SAME[kind]):
        assert getattr(one, name) == getattr(two, name), name
    np.testing.assert_allclose(two.scale, one.scale)
    np.testing.assert_allclose(two.translate, one.translate)
    if kind == "shapes":
        for first, second in zip(one.data, two.data, strict=True):
            np.testing.assert_array_equal(first, second)
    else:
        np.testing.assert_array_equal(np.asarray(two.data), np.asarray(one.data))
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
    facts = [{**metadata_of(layer), "result": None, "source": None} for layer in (one, two)]
    assert facts[0] == facts[1]


def test_all_layers_come_back_as_they_were(
    viewer: ViewerModel,
    other_viewer: ViewerModel,
    solved: Inversion,
    proton_setup: ProtonSetup,
    tmp_path: Path,
) -> None:
    before = add_to_viewer(viewer, solved, proton_setup, name="shot 7", all_layers=True)
    layers = by_role(before)
    layers["residual"].visible = True
    layers["field"].colormap = "magma"
    layers["field"].contrast_limits = (1.0, 2.0)
    layers["field"].opacity = 0.5
    layers["potential"].name = "my potential"
    layers["potential"].colormap = ["black", "red", "yellow"]
    layers["arrows"].length = 3.5
    layers["image"].gamma = 0.7
    saved = viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)
    assert saved == [str(tmp_path / "a.shadowinv")]
    after = other_viewer.open(tmp_path / "a.shadowinv", plugin=None)
    assert len(before) == len(after) == 12
    for layer, two in zip(before, after, strict=True):
        assert_same_layer(layer, two)


def test_nothing_of_the_result_is_lost(
    viewer: ViewerModel, solved: Inversion, proton_setup: ProtonSetup, tmp_path: Path
) -> None:
    add_to_viewer(viewer, solved, proton_setup, origins={"Setup": "typed"})
    viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)
    dataset = read(tmp_path / "a.shadowinv")
    (*_, layer) = viewer.open(tmp_path / "a.shadowinv", plugin=PLUGIN)
    expected = solved.in_units(proton_setup).to_dataset()
    for name in expected.variables:
        np.testing.assert_array_equal(dataset[name], expected[name])
    assert dataset.attrs["options"] == expected.attrs["options"]
    assert dataset.attrs["setup"] == expected.attrs["setup"]
    assert result_of(layer).origins == {"Setup": "typed"}  # type: ignore[union-attr]


def test_one_saved_layer_stands_for_the_main_ones(
    viewer: ViewerModel, other_viewer: ViewerModel, solved: Inversion, tmp_path: Path
) -> None:
    layers = by_role(add_to_viewer(viewer, solved, name="shot", all_layers=True))
    layers["potential"].visible = True
    viewer.layers.selection = {layers["potential"]}
    viewer.layers.save(str(tmp_path / "a.shadowinv"), selected=True, plugin=PLUGIN)
    back = other_viewer.open(tmp_path / "a.shadowinv", plugin=PLUGIN)
    roles = ["image", "residual", "potential", "field", "caustic", "arrows"]
    assert [role_of(layer) for layer in back] == roles
    assert [role_of(layer) for layer in back if layer.visible] == ["potential", "field", "arrows"]
    assert all(layer.name.endswith(" – shot") for layer in back)


def test_a_place_that_no_setup_tells_comes_back(
    viewer: ViewerModel, other_viewer: ViewerModel, solved: Inversion, tmp_path: Path
) -> None:
    place = {"scale": (3.0, 3.0), "translate": (7.5, 9.0), "units": ("mm", "mm")}
    before = add_to_viewer(viewer, solved, **place, all_layers=True)
    viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)
    after = other_viewer.open(tmp_path / "a.shadowinv", plugin=PLUGIN)
    for layer, two in zip(before, after, strict=True):
        assert_same_layer(layer, two)


def test_painted_caustics_are_kept(viewer: ViewerModel, solved: Inversion, tmp_path: Path) -> None:
    caustics = by_role(add_to_viewer(viewer, solved))["caustic"]
    caustics.data[:5, :6] = 1
    viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)
    caustic = read(tmp_path / "a.shadowinv")["caustic"].values
    assert caustic[:5, :6].all()
    np.testing.assert_array_equal(caustic[5:], solved.caustic[5:])


def test_sites_are_written_with_all_that_is_known(
    viewer: ViewerModel, solved: Inversion, tmp_path: Path
) -> None:
    sites = by_role(add_to_viewer(viewer, solved, all_layers=True))["sites"]
    viewer.layers.selection = {sites}
    viewer.layers.save(str(tmp_path / "a.csv"), selected=True, plugin=PLUGIN)
    rows = np.loadtxt(tmp_path / "a.csv", delimiter=",", skiprows=1)
    np.testing.assert_array_equal(rows[:, :2], solved.cells.sites)
    np.testing.assert_array_equal(rows[:, 2], solved.cells.weights)


def test_a_field_of_other_origin_can_be_kept_as_a_result(
    viewer: ViewerModel,
    other_viewer: ViewerModel,
    solved: Inversion,
    proton_setup: ProtonSetup,
    tmp_path: Path,
) -> None:
    add_to_viewer(viewer, solved, proton_setup)
    viewer.layers.save(str(tmp_path / "a.h5"), plugin=PLUGIN)
    viewer.layers.clear()
    before = viewer.open(tmp_path / "a.h5", plugin=PLUGIN)
    viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)
    after = other_viewer.open(tmp_path / "a.shadowinv", plugin=PLUGIN)
    for layer, two in zip(before, after, strict=True):
        assert_same_layer(layer, two)


def test_layers_of_two_results_are_refused(
    viewer: ViewerModel,
    solved: Inversion,
    make_inversion: Callable[..., Inversion],
    tmp_path: Path,
) -> None:
    add_to_viewer(viewer, solved, name="one")
    add_to_viewer(viewer, make_inversion((24, 32)), name="two")
    with pytest.raises(
        FileFormatError, match=r"the layers belong to 2 results .*select layers of one"
    ):
        viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)


def test_layers_of_no_result_are_refused(viewer: ViewerModel, tmp_path: Path) -> None:
    viewer.add_image(np.zeros((4, 4)), name="holiday", contrast_limits=(0, 1))
    with pytest.raises(FileFormatError, match=r"no layer belongs to a result .'holiday'."):
        viewer.layers.save(str(tmp_path / "a.shadowinv"), plugin=PLUGIN)


def test_napari_still_writes_its_own_csv(viewer: ViewerModel, tmp_path: Path) -> None:
    viewer.add_points(np.zeros((3, 2)))
    viewer.layers.save(str(tmp_path / "points.csv"))
    assert "axis-0" in (tmp_path / "points.csv").read_text()


def described_layers(viewer: ViewerModel) -> list[Any]:
    return [layer.as_layer_data_tuple() for layer in viewer.layers]


def test_an_ending_is_added_but_never_onto_an_existing_file(
    viewer: ViewerModel, solved: Inversion, tmp_path: Path
) -> None:
    add_to_viewer(viewer, solved)
    target = tmp_path / "shot.07"
    assert write_result(str(target), described_layers(viewer)) == [f"{target}.shadowinv"]
    # The dialog asked about "shot.07", not about this.
    with pytest.raises(FileFormatError, match=r"shot.07.shadowinv exists: choose another name"):
        write_result(str(target), described_layers(viewer))


def test_a_duplicated_layer_still_belongs_to_the_result(
    viewer: ViewerModel, solved: Inversion
) -> None:
    from copy import deepcopy

    from napari.layers import Layer

    (layer, *_) = add_to_viewer(viewer, solved)
    data, keywords, kind = layer.as_layer_data_tuple()
    twin = Layer.create(deepcopy(data), keywords, kind)
    assert result_of(twin) is result_of(layer)
