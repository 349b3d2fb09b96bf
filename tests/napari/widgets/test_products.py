"""The tab of *Analyse* that measures products of a result."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from qtpy.QtWidgets import QFileDialog

from helpers.forms import enter
from helpers.reports import texts_of
from napari_shadowinv import ProtonSetup
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.widgets._products import shape_fields
from napari_shadowinv.analysis import PRODUCTS, EnclosedCurrent, analyse, products_in
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.io import read_dataset
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

PATIENCE = 60_000  # ms


@pytest.fixture(scope="module")
def inversion() -> Inversion:
    phantom = toroid((48, 48), ProtonSetup.example(), 30.0, 9e-6)
    image = np.random.default_rng(0).poisson(400 * synthetic_image(phantom.displacement))
    return invert(image, source=np.full(image.shape, 400.0))


@pytest.fixture
def form(window: Any, open_widget: Any, inversion: Inversion) -> Any:
    add_to_viewer(window, inversion, ProtonSetup.example(), name="ring")
    form = open_widget("Analyse").products
    enter(form.bands.entries["samples"], 20)
    return form


def choose(form: Any, name: str) -> None:
    form.product.set_kind(name)
    if form.product.kind != name:
        form.product.set_kind("more")
        form.more_products.set_kind(name)


def measure(form: Any, qtbot: Any) -> Any:
    count = len(form.measured)
    form.panel.button.click()
    qtbot.waitUntil(lambda: len(form.measured) > count, timeout=PATIENCE)
    return form.measured[-1]


def test_round_ellipse_becomes_a_circle_and_others_a_polygon():
    corners = np.array([[10.0, 20.0], [10.0, 30.0], [20.0, 30.0], [20.0, 20.0]])
    assert shape_fields("ellipse", corners) == {"center": (15.0, 25.0), "radius": 5.0}
    path = np.array(shape_fields("ellipse", corners * [1, 2])["path"])
    y, x = path.T
    area = abs((x * np.roll(y, -1) - y * np.roll(x, -1)).sum()) / 2
    assert area == pytest.approx(np.pi * 5 * 10, rel=2e-3)


def test_drawn_circle_measures_the_same_current_as_python(
    form: Any, qtbot: Any, inversion: Inversion
) -> None:
    choose(form, "current")
    form._draw()
    shapes, pixel = form.shapes.layer, form.result.layer.scale[0]
    assert pixel != 1  # the layers are in µm
    shapes.add_ellipses(np.array([[23.5, 23.5], [8.0, 8.0]]))
    measured = measure(form, qtbot)
    circle = EnclosedCurrent(center=(23.5, 23.5), radius=8.0)
    assert measured.product.center == pytest.approx(circle.center)
    (expected,) = analyse(inversion, measured.product, setup=ProtonSetup.example(), samples=20)
    assert measured["current"].value == expected["current"].value
    np.testing.assert_array_equal(measured["current"].samples, expected["current"].samples)
    assert expected.facts[0].text in texts_of(form.report).values()


def test_profile_is_drawn_with_its_bands(form: Any, qtbot: Any) -> None:
    choose(form, "profile")
    form._draw()
    form.shapes.layer.add_lines(np.array([[23.5, 5.0], [23.5, 42.0]]))
    form.unit.setCurrentText("MG µm")
    measured = measure(form, qtbot)
    assert measured.unit.symbol == "MG µm"
    (axes,) = form.plot.figure.axes
    assert axes.get_ylabel() == "field (MG µm)"
    assert [line.get_label() for line in axes.lines] == ["along", "normal"]
    assert len(axes.collections) == 4  # two bands each


def test_entries_of_a_product_are_those_of_its_model(form: Any, qtbot: Any) -> None:
    first = [form.product.choice.itemText(row) for row in range(form.product.choice.count())]
    assert len(first) == 7
    assert first[-1] == "more…"
    offered = set()
    for name, kind in PRODUCTS.items():
        choose(form, name)
        assert form.kind is kind
        offered |= form._picker.form.entries.keys()
    assert {"width", "find_tilt", "component", "path_length", "smoothing"} <= offered
    assert offered.isdisjoint({"path", "center", "rectangle", "label", "noise_power"})
    choose(form, "profile")
    enter(form.product.form.entries["width"], "4 px")
    form._draw()
    form.shapes.layer.add_lines(np.array([[23.5, 5.0], [23.5, 42.0]]))
    assert measure(form, qtbot).product.width == 4


def test_centre_of_an_object_along_the_beam_is_that_of_a_circle(form: Any, qtbot: Any) -> None:
    choose(form, "azimuthal")
    form._draw()
    form.shapes.layer.add_ellipses(np.array([[23.5, 23.5], [15.0, 15.0]]))
    measured = measure(form, qtbot).product
    assert measured.center == pytest.approx((23.5, 23.5))
    assert measured.radius == pytest.approx(15.0)
    form.shapes.layer.add_rectangles(np.array([[5.0, 5.0], [15.0, 25.0]]))
    form.panel.button.click()
    assert "is no circle" in form.panel.status.text()


def test_map_becomes_a_layer_on_its_result(form: Any, window: Any, qtbot: Any) -> None:
    choose(form, "current-density")
    field = form.result.layer
    measured = measure(form, qtbot)
    layer = window.layers[-1]
    assert layer.name.startswith("current density (")
    np.testing.assert_allclose(layer.scale, field.scale)
    ratio = layer.data / measured["density"].value
    np.testing.assert_allclose(ratio, ratio[0, 0])
    assert form.plot.isHidden()


def test_products_are_exported_and_saved_with_the_result(
    form: Any, qtbot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, inversion: Inversion
) -> None:
    for _ in range(2):
        choose(form, "contrast")
        measure(form, qtbot)
    assert [each.name for each in form.measured] == ["contrast", "contrast_2"]
    names = iter([tmp_path / "products.csv", tmp_path / "both.shadowinv"])
    monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *_, **__: (str(next(names)), ""))
    form.export.click()
    rows = list(csv.reader((tmp_path / "products.csv").open(encoding="utf-8")))
    assert {row[0] for row in rows[1:]} == {"contrast", "contrast_2"}
    form.save.click()
    dataset = read_dataset(tmp_path / "both.shadowinv")
    assert [each.name for each in products_in(dataset)] == ["contrast", "contrast_2"]
    again = Inversion.from_dataset(dataset)
    np.testing.assert_array_equal(again.potential, inversion.potential)


def test_problems_are_said_in_a_sentence(form: Any, window: Any, messages: list[str]) -> None:
    choose(form, "flux")
    form.panel.button.click()
    assert "There is no shape for the flux across a line" in messages[-1]
    choose(form, "current")
    form._draw()
    form.shapes.layer.add_lines(np.array([[3.0, 3.0], [9.0, 9.0]]))
    form.panel.button.click()
    assert "expected a closed shape" in messages[-1]
    assert "expected a closed shape" in form.panel.status.text()
    for layer in list(window.layers):
        window.layers.remove(layer)
    form.panel.button.click()
    assert "There is no result to measure" in messages[-1]
