"""Layers of a result: content, placement, and the order in which they appear."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.fits import SETUPS, SHAPE, WHY
from helpers.layers import by_role, in_its_unit
from napari_shadowinv import add_to_viewer, write
from napari_shadowinv._napari.layer_metadata import (
    Frame,
    Result,
    displacement_of,
    layer_key,
    result_of,
    role_of,
    setup_of,
    unit_of,
)
from napari_shadowinv._napari.layers import (
    add_layers,
    direction_colours,
    fit_layers,
    inversion_layers,
    sample_arrows,
)
from napari_shadowinv._napari.result_files import missing_layers
from napari_shadowinv.cautions import Caution
from napari_shadowinv.facts import Assessment, Verdict


def test_all_of_a_result_is_there_on_request(viewer, solved, proton_setup):
    layers = by_role(add_to_viewer(viewer, solved, proton_setup, name="shot 7", all_layers=True))
    assert list(layers) == [
        "image", "reprojection", "residual", "potential", "field y", "field x",
        "direction", "field", "caustic", "arrows", "sites",
    ]  # fmt: skip
    assert {role for role, layer in layers.items() if layer.visible} == {"field", "arrows"}
    assert all(layer.name.endswith(" – shot 7") for layer in viewer.layers)
    overlays = getattr(getattr(viewer, "canvas", None), "overlays", viewer)  # napari before 0.9
    assert overlays.scale_bar.visible
    assert viewer.layers.selection.active is layers["field"]


def test_values_are_those_of_the_result_in_the_unit_that_the_layer_names(
    viewer, solved, proton_setup
):
    layers = by_role(add_to_viewer(viewer, solved, proton_setup, all_layers=True))
    field = proton_setup.path_integrated_b(solved.displacement)
    for role, values in (("field", np.hypot(*field)), ("field y", field[0]), ("field x", field[1])):
        np.testing.assert_allclose(layers[role].data, in_its_unit(layers["field"], values))
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
    # They share the arrays of the result.
    assert np.shares_memory(layers["reprojection"].data, solved.reprojection)
    assert np.shares_memory(layers["sites"].data, solved.cells.sites)


def test_light_shows_the_deflection_angle(viewer, solved, optical_setup):
    field = by_role(add_to_viewer(viewer, solved, optical_setup))["field"]
    factor = {"mrad": 1e3, "µrad": 1e6}[unit_of(field)]
    angle = np.hypot(*optical_setup.deflection_angle(solved.displacement))
    np.testing.assert_allclose(field.data, factor * angle)


def test_signed_layers_have_symmetric_limits_and_a_white_middle(viewer, solved):
    layers = by_role(add_to_viewer(viewer, solved, all_layers=True))
    for role in ("residual", "field y", "field x"):
        low, high = layers[role].contrast_limits
        assert low == -high
        middle = layers[role].colormap.map(np.array([0.5]))[0, :3]
        assert middle.min() > 0.9
    assert layers["field"].contrast_limits[0] == 0


def test_pixels_are_lengths_at_the_object_or_pixels(viewer, solved, proton_setup):
    for layer in add_to_viewer(viewer, solved):
        assert {str(unit) for unit in layer.units} == {"pixel"}
        np.testing.assert_array_equal(layer.scale, 1)
    viewer.layers.clear()
    for layer in add_to_viewer(viewer, solved, proton_setup, origins={"Setup": "typed"}):
        np.testing.assert_allclose(layer.scale, 1.5)
        assert {str(unit) for unit in layer.units} == {"micrometer"}
        assert layer.axis_labels == ("y", "x")
        assert setup_of(layer) == proton_setup
        # Each knows the whole result.
        result = result_of(layer)
        assert result.content.cells is solved.cells
        assert result.content.setup == proton_setup
        assert result.origins == {"Setup": "typed"}
    # The centre of pixel (0, 0) is at the origin, for images as for sites.
    height, width = solved.potential.shape
    corners = [[0, 0], [1.5 * (height - 1), 1.5 * (width - 1)]]
    np.testing.assert_allclose(viewer.layers[0].extent.world, corners)
    assert {tuple(layer.translate) for layer in viewer.layers} == {(0.0, 0.0)}
    # A binned crop lies on its original.
    place = {"scale": (3.0, 3.0), "translate": (7.5, 9.0), "units": ("um", "um")}
    for _, keywords, _ in inversion_layers(solved, proton_setup, **place):
        assert {name: keywords[name] for name in place} == place


def test_arrows_are_true_displacements_on_a_grid_that_can_be_read(viewer, solved):
    arrows = by_role(add_to_viewer(viewer, solved))["arrows"]
    starts, steps = arrows.data[:, 0].astype(int), arrows.data[:, 1]
    np.testing.assert_array_equal(steps, solved.displacement[:, starts[:, 0], starts[:, 1]].T)
    # Drawn, nearly all keep to their own place, and the longest reach to the next but one.
    spacing = np.diff(np.unique(starts[:, 1])).min()
    lengths = arrows.length * np.hypot(*steps.T) / spacing
    assert np.percentile(lengths, 94) < 1
    assert 0.9 < lengths.max() < 2
    # No field makes no arrow.
    names = ("displacement", "potential", "residual")
    zeros = {name: np.zeros_like(getattr(solved, name)) for name in names}
    cells = replace(solved.cells, displacement=np.zeros_like(solved.cells.displacement))
    layers = by_role(add_to_viewer(viewer, replace(solved, **zeros, cells=cells)))
    assert len(layers["arrows"].data) == 0
    assert layers["field"].contrast_limits == [0, 1]


def test_hue_is_the_direction_and_brightness_the_length():
    """Right is red, up yellow-green, left cyan, down violet; y points down in the image."""
    vectors = np.array([[0.0, -2.0, 0.0, 1.0], [2.0, 0.0, -1.0, 0.0]])[:, None]
    ((right, up, left, down),) = direction_colours(vectors)
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(up, [0.5, 1, 0], atol=1e-9)
    np.testing.assert_allclose(left, [0, 0.5, 0.5], atol=1e-9)
    np.testing.assert_allclose(down, [0.25, 0, 0.5], atol=1e-9)


@pytest.mark.parametrize("shape", [(64, 200), (700, 500), (20, 20)])
def test_about_twenty_arrows_lie_along_the_longer_side(shape):
    data, spacing = sample_arrows(np.ones((2, *shape)))
    for axis in (0, 1):
        places = np.unique(data[:, 0, axis])
        np.testing.assert_array_equal(np.diff(places), spacing)
        assert len(places) <= 21
    assert len(np.unique(data[:, 0, int(np.argmax(shape))])) >= 15


def test_sites_have_the_numbers_of_the_report_and_are_coloured_by_displacement(
    viewer, solved, monkeypatch
):
    sites = by_role(add_to_viewer(viewer, solved, all_layers=True))["sites"]
    features, cells = sites.features, solved.cells
    assert list(features) == ["weight", "mass", "displacement", "flux residual"]
    np.testing.assert_array_equal(features["weight"], cells.weights)
    np.testing.assert_allclose(features["mass"].sum(), solved.source.sum())
    np.testing.assert_allclose(features["displacement"], np.hypot(*cells.displacement.T))
    worst = np.abs(features["flux residual"]).max()
    np.testing.assert_allclose(worst, solved.report.residual, rtol=1e-6)
    brightness = sites.face_color[np.argsort(features["displacement"])][:, :3].sum(axis=1)
    assert brightness[-1] > brightness[0] + 1
    # Many are thinned, and the name says so.
    monkeypatch.setattr("napari_shadowinv._napari.layers._MAX_SHOWN_SITES", 200)
    sites = by_role(add_to_viewer(viewer, solved, all_layers=True))["sites"]
    np.testing.assert_array_equal(sites.data, cells.sites[::3])
    assert sites.name == "✓ sites (1 in 3)"
    np.testing.assert_array_equal(sites.features["weight"], cells.weights[::3])


def test_an_uneven_source_has_its_layer(viewer, solved):
    source = solved.source * np.linspace(0.5, 1.5, solved.source.shape[1])
    uneven = replace(solved, source=source)
    layer_data = {role_of(keywords): data for data, keywords, _ in inversion_layers(uneven)}
    assert layer_data["source"] is source


def test_layers_are_added_one_at_a_time_in_their_order(viewer, solved, qtbot):
    from qtpy.QtCore import QObject, QTimer

    from napari_shadowinv._napari.widgets._panels import ResultLayers

    layer_data, parent = inversion_layers(solved), QObject()
    names = [keywords["name"] for _, keywords, _ in layer_data]
    results, counts = ResultLayers(viewer, parent), set()
    between = QTimer(parent, interval=0)  # as a window draws
    between.timeout.connect(lambda: counts.add(len(results.layers)))
    between.start()
    with qtbot.waitSignal(results.complete, timeout=60_000):
        results.show(layer_data)
    assert {1, 2, 3} <= counts
    assert [layer.name for layer in viewer.layers] == names
    assert role_of(viewer.layers.selection.active) == "field"
    # They keep their order when some are deleted between results.
    for name in ("✓ |d| (px)", "✓ dx (px)", "✓ sites"):
        viewer.layers.remove(name)
    viewer.add_image(np.ones((9, 9)), name="other")
    with qtbot.waitSignal(results.complete, timeout=60_000):
        results.show(layer_data, select=False)
    assert [layer.name for layer in viewer.layers if layer.name != "other"] == names
    assert viewer.layers.selection.active is viewer.layers["other"]


def test_masked_pixels_are_blank_and_set_no_limits(solved):
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


def test_doubtful_result_has_the_doubt_in_its_names(solved):
    marks = {((), True): "✓", (EDGE, True): "?", (EDGE, False): "✗"}
    for (warnings, converged), mark in marks.items():
        report = replace(solved.report, cautions=warnings, converged=converged)
        marked = replace(solved, report=report)
        for _, keywords, _ in inversion_layers(marked, name="a"):
            assert keywords["name"].startswith(f"{mark} ")
            assert keywords["name"].endswith(" – a")
        names = [keywords["name"] for _, keywords, _ in inversion_layers(marked)]
        assert f"{mark} |d| (px)" in names


def test_errors_of_an_inversion_have_a_layer(viewer, solved):
    std = np.full_like(solved.displacement, 0.05)
    certain = replace(solved, errors=replace(solved.errors, per_pixel=std, causes=("noise",)))
    layers = by_role(add_to_viewer(viewer, certain))
    np.testing.assert_allclose(layers["uncertainty"].data, 0.05 * np.sqrt(2))


def opened(viewer, path):
    viewer.layers.clear()
    viewer.open(str(path), plugin="napari-shadowinv")
    slots = [layer_key(layer) for layer in viewer.layers]
    assert len(set(slots)) == len(slots)
    return dict(zip(slots, viewer.layers, strict=True))


def more(viewer, layers):
    """All layers of a result of which only the main ones are shown."""
    missing = add_layers(viewer, missing_layers(viewer, layers["field"]))
    return layers | {layer_key(layer): layer for layer in missing}


def test_a_file_of_the_command_shows_all_of_a_fit(viewer, two_fields, tmp_path, messages):
    layers = opened(viewer, write(tmp_path / "pack.shadowinv", two_fields))
    layers = more(viewer, layers)
    in_each = ["potential", "field y", "field x", "direction", "field", "uncertainty", "arrows"]
    of_fields = [f"{role}{part}" for role in in_each for part in ("", " E")]
    of_images = ["reprojection", "residual"]
    assert set(layers) == {*of_fields, *of_images, "image 1", "image 2"}
    assert {slot for slot, layer in layers.items() if layer.visible} == {"field", "arrows"}
    for slot in of_images:
        assert layers[slot].data.shape == (2, *SHAPE)
        assert tuple(map(str, layers[slot].units)) == ("pixel", "micrometer", "micrometer")
        assert tuple(layers[slot].scale) == pytest.approx((1, 1.5, 1.5))
    np.testing.assert_array_equal(layers["reprojection"].data, two_fields.reprojection)
    residual = 100 * two_fields.residual[1] / two_fields.images[1].mean()
    np.testing.assert_allclose(layers["residual"].data[1], residual)
    for number, (pixels, setup) in enumerate(zip(two_fields.images, SETUPS, strict=True), 1):
        np.testing.assert_array_equal(layers[f"image {number}"].data, pixels)
        assert setup_of(layers[f"image {number}"]) == setup
    for slot, fitted_field in zip(("field", "field E"), two_fields.fields, strict=True):
        np.testing.assert_array_equal(displacement_of(layers[slot]), fitted_field.displacement)
    assert unit_of(layers["field"]).endswith("T·m")
    assert unit_of(layers["field E"]).endswith("V")
    assert unit_of(layers["uncertainty E"]) == unit_of(layers["field E"])


def test_a_doubt_is_told_when_a_file_is_opened(viewer, doubtful, solved, tmp_path, messages):
    layers = opened(viewer, write(tmp_path / "pack.shadowinv", doubtful))
    assert messages == [f"pack.shadowinv: the fit's verdict is 'one of several': {WHY}"]
    assert layers["field"].name == "? |∫B×dz| (µT·m) – pack"
    good = replace(doubtful, assessment=Assessment(Verdict.DETERMINED, "all starts lead to one"))
    layers = opened(viewer, write(tmp_path / "good.shadowinv", good))
    assert len(messages) == 1
    assert layers["field"].name == "✓ |∫B×dz| (µT·m) – good"
    report = replace(solved.report, cautions=(Caution("not-converged", "it did not converge"),))
    opened(viewer, write(tmp_path / "shot.shadowinv", replace(solved, report=report)))
    assert messages[1:] == ["shot.shadowinv: it did not converge"]


def test_a_beam_is_shown_once_unless_images_have_different_ones(doubtful):
    def beam(content):
        layers = fit_layers(Result(content), Frame(), "a")
        return next((data for data, about, _ in layers if role_of(about) == "source"), None)

    assert beam(doubtful) is None
    uneven = 1 + np.arange(SHAPE[1]) * np.ones(SHAPE) / 100
    proportional = np.stack([uneven, 1.3 * uneven])
    np.testing.assert_array_equal(beam(replace(doubtful, source=proportional)), uneven)
    different = np.stack([uneven, uneven[:, ::-1]])
    np.testing.assert_array_equal(beam(replace(doubtful, source=different)), different)
