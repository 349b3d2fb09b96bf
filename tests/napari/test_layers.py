"""Layers of a result: content, placement, and the order in which they appear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from napari.components import ViewerModel

from helpers.layers import by_role
from napari_shadowinv import OpticalSetup, ProtonSetup, add_to_viewer
from napari_shadowinv._napari.layer_metadata import (
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.layers import direction_colours, inversion_layers, sample_arrows
from napari_shadowinv.cautions import Caution
from napari_shadowinv.inversion import Cells, Inversion


def test_all_of_a_result_is_there_on_request(
    viewer: ViewerModel, solved: Inversion, proton_setup: ProtonSetup
) -> None:
    layers = by_role(add_to_viewer(viewer, solved, proton_setup, name="shot 7", all_layers=True))
    assert list(layers) == [
        "image", "reprojection", "residual", "potential", "field y", "field x",
        "direction", "field", "caustic", "field arrows", "arrows", "sites",
    ]  # fmt: skip
    assert {role for role, layer in layers.items() if layer.visible} == {"field", "arrows"}
    assert all(layer.name.endswith(" – shot 7") for layer in viewer.layers)
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", viewer)  # napari before 0.9
    assert overlays.scale_bar.visible
    assert viewer.layers.selection.active is layers["field"]


def test_values_are_those_of_the_result_in_the_unit_that_the_layer_names(
    viewer: ViewerModel, solved: Inversion, proton_setup: ProtonSetup
) -> None:
    layers = by_role(add_to_viewer(viewer, solved, proton_setup, all_layers=True))
    field = proton_setup.path_integrated_b(solved.displacement)
    factor = {"mT·m": 1e3, "µT·m": 1e6, "T·m": 1.0}[unit_of(layers["field"])]
    np.testing.assert_allclose(layers["field"].data, factor * np.hypot(*field))
    np.testing.assert_allclose(layers["field y"].data, factor * field[0])
    np.testing.assert_allclose(layers["field x"].data, factor * field[1])
    metres = {"m": 1.0, "mm": 1e3, "µm": 1e6, "nm": 1e9}[unit_of(layers["potential"])]
    np.testing.assert_allclose(
        layers["potential"].data, metres * proton_setup.potential(solved.potential)
    )
    assert unit_of(layers["potential"]) in layers["potential"].name
    percent = 100 * solved.residual / solved.image.mean()
    np.testing.assert_allclose(layers["residual"].data, percent)
    np.testing.assert_array_equal(layers["reprojection"].data, solved.reprojection)
    np.testing.assert_array_equal(layers["caustic"].data > 0, solved.caustic)
    np.testing.assert_array_equal(layers["sites"].data, solved.cells.sites)


def test_light_shows_the_deflection_angle(
    viewer: ViewerModel, solved: Inversion, optical_setup: OpticalSetup
) -> None:
    field = by_role(add_to_viewer(viewer, solved, optical_setup))["field"]
    factor = {"mrad": 1e3, "µrad": 1e6}[unit_of(field)]
    angle = np.hypot(*optical_setup.deflection_angle(solved.displacement))
    np.testing.assert_allclose(field.data, factor * angle)


def test_signed_layers_have_symmetric_limits_and_a_white_middle(
    viewer: ViewerModel, solved: Inversion
) -> None:
    layers = by_role(add_to_viewer(viewer, solved, all_layers=True))
    for role in ("residual", "field y", "field x"):
        low, high = layers[role].contrast_limits
        assert low == -high
        middle = layers[role].colormap.map(np.array([0.5]))[0, :3]
        assert middle.min() > 0.9
    assert layers["field"].contrast_limits[0] == 0


def test_pixels_are_lengths_at_the_object(
    viewer: ViewerModel, solved: Inversion, proton_setup: ProtonSetup
) -> None:
    for layer in add_to_viewer(viewer, solved, proton_setup):
        np.testing.assert_allclose(layer.scale, 1.5)
        assert {str(unit) for unit in layer.units} == {"micrometer"}
        assert layer.axis_labels == ("y", "x")
        assert setup_of(layer) == proton_setup
    # The centre of pixel (0, 0) is at the origin, for images as for sites.
    height, width = solved.potential.shape
    np.testing.assert_allclose(
        viewer.layers[0].extent.world, [[0, 0], [1.5 * (height - 1), 1.5 * (width - 1)]]
    )
    assert {tuple(layer.translate) for layer in viewer.layers} == {(0.0, 0.0)}


def test_without_a_setup_lengths_are_pixels(viewer: ViewerModel, solved: Inversion) -> None:
    for layer in add_to_viewer(viewer, solved):
        assert {str(unit) for unit in layer.units} == {"pixel"}
        np.testing.assert_array_equal(layer.scale, 1)


def test_a_binned_crop_lies_on_its_original(solved: Inversion, proton_setup: ProtonSetup) -> None:
    layers = inversion_layers(
        solved, proton_setup, scale=(3.0, 3.0), translate=(7.5, 9.0), units=("um", "um")
    )
    for _, keywords, _ in layers:
        assert (keywords["scale"], keywords["translate"]) == ((3.0, 3.0), (7.5, 9.0))


def test_arrows_are_true_displacements_on_a_grid_that_can_be_read(
    viewer: ViewerModel, solved: Inversion
) -> None:
    arrows = by_role(add_to_viewer(viewer, solved))["arrows"]
    starts, steps = arrows.data[:, 0].astype(int), arrows.data[:, 1]
    np.testing.assert_array_equal(steps, solved.displacement[:, starts[:, 0], starts[:, 1]].T)
    # Drawn, nearly all keep to their own place, and the longest reach to the next but one.
    spacing = np.diff(np.unique(starts[:, 1])).min()
    lengths = arrows.length * np.hypot(*steps.T) / spacing
    assert np.percentile(lengths, 94) < 1
    assert 0.9 < lengths.max() < 2


def test_hue_is_the_direction_and_brightness_the_length() -> None:
    """Right is red, up yellow-green, left cyan, down violet; y points down in the image."""
    vectors = np.array([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, -1.0, 0.0]])[:, None]
    ((right, up, left, down),) = direction_colours(vectors)
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(up, [0.5, 1, 0], atol=1e-9)
    np.testing.assert_allclose(left, [0, 0.5, 0.5], atol=1e-9)
    np.testing.assert_allclose(down, [0.25, 0, 0.5], atol=1e-9)


@pytest.mark.parametrize("shape", [(64, 200), (700, 500), (20, 20)])
def test_about_twenty_arrows_lie_along_the_longer_side(shape: tuple[int, int]) -> None:
    data, spacing = sample_arrows(np.ones((2, *shape)))
    for axis in (0, 1):
        places = np.unique(data[:, 0, axis])
        np.testing.assert_array_equal(np.diff(places), spacing)
        assert len(places) <= 21
    assert len(np.unique(data[:, 0, int(np.argmax(shape))])) >= 15


def test_no_field_makes_no_arrow(viewer: ViewerModel, solved: Inversion) -> None:
    still = replace(
        solved,
        displacement=np.zeros_like(solved.displacement),
        potential=np.zeros_like(solved.potential),
        residual=np.zeros_like(solved.residual),
        cells=replace(solved.cells, displacement=np.zeros_like(solved.cells.displacement)),
    )
    layers = by_role(add_to_viewer(viewer, still))
    assert len(layers["arrows"].data) == 0
    assert layers["field"].contrast_limits == [0, 1]


def test_features_of_the_sites_agree_with_the_report(
    viewer: ViewerModel, solved: Inversion
) -> None:
    sites = by_role(add_to_viewer(viewer, solved, all_layers=True))["sites"]
    features = sites.features
    assert list(features) == ["weight", "mass", "displacement", "flux residual"]
    np.testing.assert_array_equal(features["weight"], solved.cells.weights)
    np.testing.assert_allclose(features["mass"].sum(), solved.source.sum())
    np.testing.assert_allclose(features["displacement"], np.hypot(*solved.cells.displacement.T))
    worst = np.abs(features["flux residual"]).max()
    np.testing.assert_allclose(worst, solved.report.residual, rtol=1e-6)


def test_sites_are_coloured_by_displacement(viewer: ViewerModel, solved: Inversion) -> None:
    sites = by_role(add_to_viewer(viewer, solved, all_layers=True))["sites"]
    order = np.argsort(sites.features["displacement"])
    brightness = sites.face_color[order][:, :3].sum(axis=1)
    assert brightness[-1] > brightness[0] + 1


def test_many_sites_are_thinned_and_the_name_says_so(
    viewer: ViewerModel, solved: Inversion, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("napari_shadowinv._napari.layers._MAX_SHOWN_SITES", 200)
    sites = by_role(add_to_viewer(viewer, solved, all_layers=True))["sites"]
    np.testing.assert_array_equal(sites.data, solved.cells.sites[::3])
    assert sites.name == "✓ sites (1 in 3)"
    np.testing.assert_array_equal(sites.features["weight"], solved.cells.weights[::3])


def test_each_layer_knows_the_whole_result(
    viewer: ViewerModel, solved: Inversion, proton_setup: ProtonSetup
) -> None:
    for layer in add_to_viewer(viewer, solved, proton_setup, origins={"Setup": "typed"}):
        result = result_of(layer)
        assert result is not None
        assert result.content is solved
        assert result.origins == {"Setup": "typed"}


def test_an_uneven_source_has_its_layer(viewer: ViewerModel, solved: Inversion) -> None:
    source = solved.source * np.linspace(0.5, 1.5, solved.source.shape[1])
    uneven = replace(solved, source=source)
    layer_data = {role_of(keywords): data for data, keywords, _ in inversion_layers(uneven)}
    assert layer_data["source"] is source


@pytest.fixture(scope="module")
def large(make_inversion: Callable[..., Inversion]) -> Inversion:
    """A result of a megapixel with 100,000 sites."""
    inversion = make_inversion((1024, 1024))
    count = 100_000
    rng = np.random.default_rng(0)
    return replace(
        inversion,
        cells=Cells(
            sites=rng.uniform(-0.5, 1023.5, (count, 2)),
            weights=np.zeros(count),
            mass=np.full(count, inversion.source.sum() / count),
            flux=np.full(count, inversion.source.sum() / count),
            displacement=rng.normal(0, 1, (count, 2)),
        ),
    )


def test_layers_share_the_arrays_of_a_large_result(large: Inversion) -> None:
    added = add_to_viewer(ViewerModel(), large, all_layers=True)
    layers = {role_of(layer): layer for layer in added}
    assert np.shares_memory(layers["reprojection"].data, large.reprojection)
    assert np.shares_memory(layers["sites"].data, large.cells.sites)


def show_layers(viewer: Any, qtbot: Any, layer_data: list[Any]) -> tuple[list[str], Any]:
    """Layers in the order in which they are drawn or complete, and the layers."""
    from napari_shadowinv._napari.widgets._results import ResultLayers

    results = ResultLayers(viewer, viewer.window._qt_window)
    events: list[str] = []

    def on_draw(_: Any) -> None:
        events.append(f"{len(results.layers)} drawn")

    canvas = viewer.window._qt_viewer.canvas._scene_canvas
    canvas.events.draw.connect(on_draw)
    results.complete.connect(lambda: events.append("complete"))
    results.show(layer_data)
    qtbot.waitUntil(lambda: "complete" in events, timeout=60_000)
    canvas.events.draw.disconnect(on_draw)
    return events, results


def test_the_field_of_a_megapixel_is_drawn_before_hidden_layers(
    large: Inversion, make_napari_viewer: Any, qtbot: Any
) -> None:
    window = make_napari_viewer(show=True)
    qtbot.wait(100)
    layer_data = inversion_layers(large)
    names = [keywords["name"] for _, keywords, _ in layer_data]
    inserted: list[str] = []
    window.layers.events.inserted.connect(lambda event: inserted.append(role_of(event.value)))
    events, _ = show_layers(window, qtbot, layer_data)
    assert inserted[:2] == ["field", "arrows"]
    counts = [int(event.split()[0]) for event in events if event.endswith("drawn")]
    assert min(count for count in counts if count) <= 2
    assert [layer.name for layer in window.layers] == names
    assert role_of(window.layers.selection.active) == "field"


def test_layers_keep_their_order_when_some_are_deleted_between_results(
    solved: Inversion, make_napari_viewer: Any, qtbot: Any
) -> None:
    window = make_napari_viewer(show=True)
    layer_data = inversion_layers(solved)
    names = [keywords["name"] for _, keywords, _ in layer_data]
    _, results = show_layers(window, qtbot, layer_data)
    for name in ("✓ |d| (px)", "✓ dx (px)", "✓ sites"):
        window.layers.remove(name)
    window.add_image(np.ones((9, 9)), name="other")
    complete: list[bool] = []
    results.complete.connect(lambda: complete.append(True))
    results.show(layer_data, select=False)
    qtbot.waitUntil(lambda: bool(complete), timeout=60_000)
    assert [layer.name for layer in window.layers if layer.name != "other"] == names
    assert window.layers.selection.active is window.layers["other"]


def test_masked_pixels_are_blank_and_set_no_limits(solved: Inversion) -> None:
    mask = np.ones(solved.image.shape, bool)
    mask[15:25, 20:30] = False
    displacement = solved.displacement.copy()
    displacement[:, ~mask] = 100.0
    masked = replace(solved, mask=mask, displacement=displacement)
    for data, keywords, _ in inversion_layers(masked):
        role = role_of(keywords)
        if role in ("field", "field y", "field x", "potential", "residual", "reprojection"):
            np.testing.assert_array_equal(np.isnan(data), ~mask)
        if role == "field":
            strongest = np.hypot(*solved.displacement)[mask].max()
            assert keywords["contrast_limits"] == (0.0, pytest.approx(strongest))
        if role == "arrows":
            at = data[:, 0].astype(int)
            assert mask[at[:, 0], at[:, 1]].all()
    assert (masked.displacement[:, ~mask] == 100.0).all()


EDGE = (Caution("edge", "the field reaches the edge"),)


def test_doubtful_result_has_the_doubt_in_its_names(solved: Inversion) -> None:
    marks = {((), True): "✓", (EDGE, True): "?", (EDGE, False): "✗"}
    for (warnings, converged), mark in marks.items():
        report = replace(solved.report, cautions=warnings, converged=converged)
        for _, keywords, _ in inversion_layers(replace(solved, report=report), name="a"):
            assert keywords["name"].startswith(f"{mark} ")
            assert keywords["name"].endswith(" – a")
        names = [
            keywords["name"] for _, keywords, _ in inversion_layers(replace(solved, report=report))
        ]
        assert f"{mark} |d| (px)" in names


def test_structures_of_an_inversion_are_outlined_on_its_significance(
    viewer: ViewerModel, solved: Inversion
) -> None:
    std = np.full_like(solved.displacement, 0.05)
    certain = replace(solved, errors=replace(solved.errors, per_pixel=std, causes=("noise",)))
    layers = by_role(add_to_viewer(viewer, certain, all_layers=True))
    expected = np.hypot(*solved.displacement) / 0.05
    np.testing.assert_allclose(layers["significance"].data, expected)
    structures = layers["structures"]
    regions = certain.structures
    assert regions is not None
    assert 0 < (structures.data > 0).sum() < (regions.labels > 0).sum()
    for row, column in np.argwhere(structures.data > 0):
        around = regions.labels[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        assert structures.data[row, column] == regions.labels[row, column]
        assert (around == 0).any()
    assert not {"significance", "structures"} & set(by_role(add_to_viewer(viewer, certain)))
