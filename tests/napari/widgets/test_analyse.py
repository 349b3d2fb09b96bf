"""*Analyse*: products of a result, and layers along a line."""

import csv

import numpy as np
import pytest

from helpers.forms import enter
from helpers.reports import texts_of
from napari_shadowinv import ProtonSetup
from napari_shadowinv._napari.layer_metadata import metadata_for
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.widgets.analyse import Analyse, shape_fields
from napari_shadowinv.analysis import PRODUCTS, EnclosedCurrent, analyse
from napari_shadowinv.inversion import invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

SETUP = ProtonSetup.example()


def image_of(side, peak, radius):
    return synthetic_image(toroid((side, side), SETUP, peak, radius).displacement)


@pytest.fixture(scope="module")
def inversion():
    image = np.random.default_rng(0).poisson(400 * image_of(48, 30.0, 9e-6))
    return invert(image, source=np.full(image.shape, 400.0))


@pytest.fixture
def form(viewer, opened, inversion):
    add_to_viewer(viewer, inversion, SETUP, name="ring")
    return opened(Analyse).products


def select(form, name):
    form.product.set_kind(name)
    if form.product.kind != name:
        form.product.set_kind("more")
        form.more_products.set_kind(name)


def draw(form, product, shape, corners):
    select(form, product)
    form._draw()
    shapes = form.shapes.layer
    add = {"ellipse": shapes.add_ellipses, "line": shapes.add_lines}[shape]
    add(np.array(corners))


@pytest.fixture
def measure(run):
    """Press the button, and return what was measured."""

    def measured(form):
        run(form)
        assert form.panel.status.text() == ""
        return form.measured[-1]

    return measured


def test_round_ellipse_becomes_a_circle_and_others_a_polygon():
    corners = np.array([[10.0, 20.0], [10.0, 30.0], [20.0, 30.0], [20.0, 20.0]])
    assert shape_fields("ellipse", corners) == {"center": (15.0, 25.0), "radius": 5.0}
    path = np.array(shape_fields("ellipse", corners * [1, 2])["path"])
    y, x = path.T
    area = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
    assert area == pytest.approx(np.pi * 5 * 10, rel=2e-3)


def test_drawn_circle_measures_the_same_current_as_python(form, measure, inversion):
    draw(form, "current", "ellipse", [[23.5, 23.5], [8.0, 8.0]])
    assert form.result.layer.scale[0] != 1  # the layers are in µm
    measured = measure(form)
    circle = EnclosedCurrent(center=(23.5, 23.5), radius=8.0)
    assert measured.product.center == pytest.approx(circle.center)
    (expected,) = analyse(inversion, measured.product, setup=SETUP)
    assert measured["current"].value == expected["current"].value
    np.testing.assert_array_equal(measured["current"].samples, expected["current"].samples)
    assert expected.facts[0].text in texts_of(form.report).values()


def test_profile_is_drawn_with_its_bands_and_exported(form, measure, tmp_path, choose):
    assert not form.export.isEnabled()
    draw(form, "profile", "line", [[23.5, 5.0], [23.5, 42.0]])
    enter(form.product.form.entries["width"], "4 px")
    form.unit.value = "MG µm"
    measured = measure(form)
    assert (measured.unit.symbol, measured.product.width) == ("MG µm", 4)
    (axes,) = form.plot.figure.axes
    assert axes.get_ylabel() == "field (MG µm)"
    assert [line.get_label() for line in axes.lines] == ["along", "normal"]
    assert len(axes.collections) == 4  # two bands each
    choose(tmp_path / "products")
    form.export.click()
    rows = list(csv.reader((tmp_path / "products.csv").open(encoding="utf-8")))
    assert {row[0] for row in rows[1:]} == {"profile"}


def test_entries_of_a_product_are_those_of_its_model(form):
    box = form.product.choice.native
    first = [box.itemText(row) for row in range(box.count())]
    assert len(first) == 7
    assert first[-1] == "more…"
    offered = set()
    for name, kind in PRODUCTS.items():
        select(form, name)
        assert form.kind is kind
        offered |= form._picker.form.entries.keys()
    assert {"width", "find_tilt", "component", "path_length", "smoothing"} <= offered
    assert offered.isdisjoint({"path", "center", "rectangle", "label", "noise_power"})


def test_map_becomes_a_layer_on_its_result(form, viewer, measure):
    select(form, "current-density")
    measured, layer = measure(form), viewer.layers[-1]
    assert layer.name.startswith("current density (")
    np.testing.assert_allclose(layer.scale, form.result.layer.scale)
    ratio = layer.data / measured["density"].value
    np.testing.assert_allclose(ratio, ratio[0, 0])
    assert form.plot.isHidden()


LINE = np.array([[10.0, 5.0], [10.0, 45.0]])


@pytest.fixture
def profile(viewer, opened):
    """A profile across a plane in nm and another one in T, of pixels of 2 µm."""
    y, x = np.mgrid[:40, :50]
    placement = {"scale": (2.0, 2.0), "units": ("um", "um")}
    for name, plane, unit in (("height", 3.0 * y + x, "nm"), ("field", 1.0 * x, "T")):
        viewer.add_image(plane, name=name, metadata=metadata_for("image", unit), **placement)
    tool = opened(Analyse)
    tool._draw()
    return tool


def test_a_profile_has_true_units_on_both_axes(profile, wait):
    profile.lines.layer.add_lines(LINE)
    wait(lambda: len(profile.profiles) == 2)
    assert "peak 75 nm at 80 µm" in profile.measures.text()
    assert "area 4400 nm·µm" in profile.measures.text()
    assert profile.measures.isVisibleTo(profile)
    height, distance = profile.profiles[1], profile._distance
    assert distance[-1] == pytest.approx(80)  # 40 px of 2 µm
    np.testing.assert_allclose(height.values, 30 + 5 + distance / 2, atol=1e-6)
    axes = profile.plot.figure.axes
    assert {axis.get_ylabel() for axis in axes} == {"nm", "T"}
    assert axes[-1].get_xlabel() == "distance (µm)"
    assert {axis.get_title(loc="left") for axis in axes} == {"height", "field"}
    assert all(axis.get_legend() is None for axis in axes)


def test_a_profile_is_averaged_over_its_width(profile, viewer, wait):
    y = np.mgrid[:40, :50][0].astype(float)
    viewer.layers["height"].data = y**2
    viewer.layers["field"].visible = False
    profile.lines.layer.add_lines(np.array([[20.0, 5.0], [20.0, 45.0]]))

    def shows(value):
        return bool(profile.profiles) and profile.profiles[0].values[3] == pytest.approx(value)

    wait(lambda: shows(400))
    profile.width_px.value = 9
    wait(lambda: shows(400 + 80 / 12))
    assert profile.plot.figure.axes[-1].get_xlabel() == "distance (µm), mean over 9 px"


def test_a_profile_follows_the_line_and_the_layers(viewer, profile, wait):
    height, lines = viewer.layers["height"], profile.lines.layer
    viewer.layers["field"].visible = False
    lines.add_lines(LINE)
    wait(lambda: len(profile.profiles) == 1)
    lines.data = [np.array([[20.0, 5.0], [20.0, 45.0]])]
    wait(lambda: profile.profiles[0].values[0] == pytest.approx(65))
    # 90°: world (y, x) = (-column, row), in pixels of 2 µm.
    height.rotate = 90
    lines.data = [np.array([[-5.0, 20.0], [-5.0, 10.0]])]
    expected = pytest.approx(3 * np.linspace(20, 10, 11) + 5)
    wait(lambda: bool(profile.profiles) and profile.profiles[0].values == expected)
    height.data = np.full((40, 50), 7.0)
    wait(lambda: profile.profiles[0].values[0] == pytest.approx(7))
    viewer.layers.remove(height)
    wait(lambda: profile.profiles == [])


def test_a_line_needs_an_image(opened, messages):
    tool = opened(Analyse)
    tool._draw()
    (message,) = messages
    assert "no image" in message
