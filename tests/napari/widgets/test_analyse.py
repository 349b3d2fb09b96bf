"""*Analyse*: products of a result or of a store of shots, and layers along a line."""

import csv

import numpy as np
import pytest
from qtpy.QtWidgets import QFileDialog

from helpers.forms import enter
from helpers.reports import texts_of
from napari_shadowinv import ProtonSetup, run_stack
from napari_shadowinv._napari.layer_metadata import metadata_for
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.widgets._products import shape_fields
from napari_shadowinv._napari.widgets.analyse import Analyse
from napari_shadowinv.analysis import (
    PRODUCTS,
    EnclosedCurrent,
    Region,
    analyse,
    analyse_shots,
    products_in,
)
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.io import read_dataset, read_stack
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.preprocessing import Recipe

SETUP = ProtonSetup.example()
RATE, SHOTS = 0.2, 4  # 1/ns, number


def image_of(side, peak, radius):
    return synthetic_image(toroid((side, side), SETUP, peak, radius).displacement)


@pytest.fixture(scope="module")
def inversion():
    image = np.random.default_rng(0).poisson(400 * image_of(48, 30.0, 9e-6))
    return invert(image, source=np.full(image.shape, 400.0))


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """A toroid that grows by `RATE`, a shot each ns."""
    out = tmp_path_factory.mktemp("series") / "night.shadowinv.zarr"
    images = [300 * image_of(32, 20 * np.exp(RATE * time), 6e-6) for time in range(SHOTS)]
    run_stack(np.stack(images), out, Recipe(setup=SETUP))
    return out


@pytest.fixture
def form(viewer, opened, inversion):
    add_to_viewer(viewer, inversion, SETUP, name="ring")
    form = opened(Analyse).products
    enter(form.bands.entries["samples"], 20)
    return form


@pytest.fixture
def series(viewer, opened, store):
    """The form with the store, a region and a circle."""
    viewer.open(str(store), plugin="napari-shadowinv")
    form = opened(Analyse).products
    draw(form, "region", "ellipse", [[15.5, 15.5], [10.0, 10.0]])
    return form


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


def answer_with(monkeypatch, *names):
    """Answer the dialogs for a file, one after the other."""
    answers = iter(names)
    monkeypatch.setattr(
        QFileDialog, "getSaveFileName", lambda *_, **__: tuple(map(str, next(answers)))
    )


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
    (expected,) = analyse(inversion, measured.product, setup=SETUP, samples=20)
    assert measured["current"].value == expected["current"].value
    np.testing.assert_array_equal(measured["current"].samples, expected["current"].samples)
    assert expected.facts[0].text in texts_of(form.report).values()
    # The centre of an object along the beam is that of a circle, too.
    draw(form, "azimuthal", "ellipse", [[23.5, 23.5], [15.0, 15.0]])
    axis = measure(form).product
    assert axis.center == pytest.approx((23.5, 23.5))
    assert axis.radius == pytest.approx(15.0)


def test_profile_is_drawn_with_its_bands(form, measure):
    draw(form, "profile", "line", [[23.5, 5.0], [23.5, 42.0]])
    enter(form.product.form.entries["width"], "4 px")
    form.unit.value = "MG µm"
    measured = measure(form)
    assert (measured.unit.symbol, measured.product.width) == ("MG µm", 4)
    (axes,) = form.plot.figure.axes
    assert axes.get_ylabel() == "field (MG µm)"
    assert [line.get_label() for line in axes.lines] == ["along", "normal"]
    assert len(axes.collections) == 4  # two bands each


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


def test_products_are_exported_and_saved_with_the_result(
    form, measure, tmp_path, monkeypatch, inversion
):
    select(form, "contrast")
    for _ in range(2):
        measure(form)
    names = ["contrast", "contrast_2"]
    assert [each.name for each in form.measured] == names
    answer_with(monkeypatch, (tmp_path / "products.csv", ""), (tmp_path / "both.shadowinv", ""))
    form.export.click()
    rows = list(csv.reader((tmp_path / "products.csv").open(encoding="utf-8")))
    assert {row[0] for row in rows[1:]} == set(names)
    form.save.click()
    dataset = read_dataset(tmp_path / "both.shadowinv")
    assert [each.name for each in products_in(dataset)] == names
    again = Inversion.from_dataset(dataset)
    np.testing.assert_array_equal(again.potential, inversion.potential)
    assert again.setup == SETUP


def test_series_of_a_store_is_that_of_python(series, measure, store, tmp_path, monkeypatch):
    assert series.shots.isVisibleTo(series)
    enter(series.shots.entries["times"], "1 ns")
    measured = measure(series)
    region, times = Region(center=(15.5, 15.5), radius=10), 1e-9 * np.arange(SHOTS)
    (expected,) = analyse_shots(read_stack(store), region, times)
    for name, quantity in expected.quantities.items():
        np.testing.assert_allclose(measured[name].value, quantity.value, rtol=1e-12)
    rows = texts_of(series.report)
    assert {fact.title: rows[fact.title] for fact in expected.facts} == {
        fact.title: fact.text for fact in expected.facts
    }
    assert float(rows["Growth of rms"].split()[0]) == pytest.approx(RATE, rel=0.05)
    assert "95 %" in rows["Growth of rms"]
    answer_with(monkeypatch, (tmp_path / "growth.csv", ""), (tmp_path / "growth", "PDF (*.pdf)"))
    series.export.click()
    table = list(csv.DictReader((tmp_path / "growth.csv").open(encoding="utf-8")))
    places = [float(row["place"]) for row in table if row["quantity"] == "rms"]
    np.testing.assert_allclose(places, times)
    series.picture.click()
    assert (tmp_path / "growth.pdf").read_bytes().startswith(b"%PDF")
    assert not series.save.isEnabled()


def test_numbers_and_centroid_are_drawn_over_time(series, measure):
    enter(series.shots.entries["times"], "0, 1 ns, 2 ns, 4 ns")
    measured = measure(series)
    numbers, places = series.plot.figure.axes
    assert places.get_xlabel() == "time (ns)"
    assert places.get_ylabel() == "µm"
    lines = {line.get_label(): line for axes in (numbers, places) for line in axes.lines}
    assert {"peak", "rms", "centroid_y", "centroid_x"} <= lines.keys()
    np.testing.assert_allclose(lines["rms"].get_xdata(), [0, 1, 2, 4])
    np.testing.assert_allclose(lines["rms"].get_ydata(), measured["rms"].value)
    middle = 1e6 * 15.5 * SETUP.object_pixel_size
    np.testing.assert_allclose(lines["centroid_y"].get_ydata(), middle, rtol=0.02)


def test_shots_are_chosen_and_numbered_without_times(series, measure):
    enter(series.shots.entries["shots"], "1:4:2")
    measured = measure(series)
    np.testing.assert_array_equal(measured.coordinates["shot"].values, [1, 3])
    assert "per shot" in texts_of(series.report)["Growth of rms"]
    ticks = series.plot.figure.axes[-1].get_xticks()
    np.testing.assert_array_equal(ticks, np.round(ticks))


MISTAKES = [  # product, shots, times, message
    ("region", "", "1,2", "Times is '1,2', expected the time between two shots in s, or a"),
    ("region", "", "soon", "Times is 'soon': expected a number in s"),
    ("region", "9", "", "Shots are '9': expected numbers from 0 to 3"),
    ("current-density", "", "", "The current density has no single number to follow"),
]


def test_mistake_with_a_store_is_a_sentence(series, refused):
    for product, shots, times, message in MISTAKES:
        series.product.set_kind(product)
        enter(series.shots.entries["shots"], shots)
        enter(series.shots.entries["times"], times)
        refused(series, message)
    assert series.measured == []


def test_cancelled_series_leaves_no_result(series, cancelled, held):
    cancelled(series)
    assert series.measured == []


def test_single_result_has_no_times(series, viewer, measure, inversion):
    enter(series.shots.entries["times"], "1 ns")
    measure(series)
    added = add_to_viewer(viewer, inversion, SETUP, name="single")
    series.result.layer = next(layer for layer in added if layer in series.result.offered)
    assert not series.shots.isVisibleTo(series)
    enter(series.bands.entries["samples"], 20)
    measure(series)
    (measured,) = series.measured  # those of the store are forgotten
    assert not measured.is_series
    assert series.save.isEnabled()


LINE = np.array([[10.0, 5.0], [10.0, 45.0]])


@pytest.fixture
def profile(viewer, opened):
    """A profile across a plane in nm and another one in T, of pixels of 2 µm."""
    y, x = np.mgrid[:40, :50]
    placement = {"scale": (2.0, 2.0), "units": ("um", "um")}
    for name, plane, unit in (("height", 3.0 * y + x, "nm"), ("field", 1.0 * x, "T")):
        viewer.add_image(plane, name=name, metadata=metadata_for("image", unit), **placement)
    tool = opened(Analyse)
    for name in ("height", "field"):
        tool.check(viewer.layers[name])
    tool._draw()
    return tool


def test_a_profile_has_true_units_on_both_axes(profile, wait):
    profile.lines.layer.add_lines(LINE)
    wait(lambda: len(profile.profiles) == 2)
    rows = list(csv.reader(profile.table().splitlines()))
    assert set(rows[0]) == {"distance (µm)", "height (nm)", "field (T)"}
    assert "peak 75 nm at 80 µm" in profile.measures.text()
    assert "area 4400 nm·µm" in profile.measures.text()
    assert profile.measures.isVisibleTo(profile)
    table = np.array(rows[1:], float)
    assert table[-1, 0] == pytest.approx(80)  # 40 px of 2 µm
    height = table[:, rows[0].index("height (nm)")]
    np.testing.assert_allclose(height, 30 + 5 + table[:, 0] / 2, atol=1e-6)
    axes = profile.plot.figure.axes
    assert {axis.get_ylabel() for axis in axes} == {"nm", "T"}
    assert axes[-1].get_xlabel() == "distance (µm)"
    assert {axis.get_title(loc="left") for axis in axes} == {"height", "field"}
    assert all(axis.get_legend() is None for axis in axes)


def test_a_profile_is_averaged_over_its_width(profile, viewer, wait):
    y = np.mgrid[:40, :50][0].astype(float)
    viewer.layers["height"].data = y**2
    profile.check(viewer.layers["field"], False)
    profile.lines.layer.add_lines(np.array([[20.0, 5.0], [20.0, 45.0]]))

    def shows(value):
        return bool(profile.profiles) and profile.profiles[0].values[3] == pytest.approx(value)

    wait(lambda: shows(400))
    profile.width_edit.setText("9")
    wait(lambda: shows(400 + 80 / 12))
    axes = profile.plot.figure.axes
    assert axes[-1].get_xlabel() == "distance (µm), mean over 9 px"
    assert "height (nm), mean over 9 px" in profile.table()
    profile.width_edit.setText("10 um")  # pixels of 2 µm
    wait(lambda: shows(400 + 24 / 12))
    assert axes[-1] not in profile.plot.figure.axes
    assert "mean over 10 µm" in profile.table()
    profile.width_edit.setText("-1")
    wait(lambda: "Width is '-1'" in profile.problem.text())
    assert profile.profiles == []


def test_a_profile_lies_on_a_layer_that_was_turned(profile, viewer, wait):
    profile.check(viewer.layers["field"], False)
    viewer.layers["height"].rotate = 90
    profile.lines.layer.add_lines(np.array([[-5.0, 20.0], [-5.0, 10.0]]))
    # 90°: world (y, x) = (-column, row), in pixels of 2 µm.
    rows, column = np.linspace(20, 10, 11), 5
    expected = pytest.approx(3 * rows + column)
    wait(lambda: bool(profile.profiles) and profile.profiles[0].values == expected)


def test_a_profile_follows_the_line_and_the_layers(viewer, profile, wait):
    profile.check(viewer.layers["field"], False)
    lines = profile.lines.layer
    lines.add_lines(LINE)
    wait(lambda: len(profile.profiles) == 1)
    lines.data = [np.array([[20.0, 5.0], [20.0, 45.0]])]
    wait(lambda: profile.profiles[0].values[0] == pytest.approx(65))
    viewer.layers["height"].data = np.full((40, 50), 7.0)
    wait(lambda: profile.profiles[0].values[0] == pytest.approx(7))
    viewer.layers.remove(viewer.layers["height"])
    wait(lambda: profile.profiles == [])


def test_a_profile_is_exported_whole(profile, wait, tmp_path, choose, messages):
    profile.export.click()
    assert len(messages) == 1
    assert "no profile" in messages[0]
    profile.lines.layer.add_lines(LINE)
    wait(lambda: bool(profile.profiles))
    choose(tmp_path / "line")
    profile.export.click()
    assert (tmp_path / "line.csv").read_text(encoding="utf-8") == profile.table()


def test_a_line_needs_an_image(opened, messages):
    tool = opened(Analyse)
    tool._draw()
    assert len(messages) == 1
    assert "no image" in messages[0]
