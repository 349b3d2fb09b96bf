"""The tab *Products of a result* of *Analyse*, for a store of shots."""

from __future__ import annotations

import csv
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from qtpy.QtWidgets import QFileDialog

from helpers.forms import enter
from helpers.reports import texts_of
from napari_shadowinv import ProtonSetup, run_stack
from napari_shadowinv._napari.layers import add_to_viewer
from napari_shadowinv._napari.widgets import _products
from napari_shadowinv.analysis import Region, analyse_shots
from napari_shadowinv.inversion import invert
from napari_shadowinv.io import read_stack
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.preprocessing import Recipe

PATIENCE = 60_000  # ms
RATE = 0.2  # 1/ns
SHOTS = 4


def image_at(time: float) -> Any:
    """A toroid that grows, as the camera would see it after a time in ns."""
    phantom = toroid((32, 32), ProtonSetup.example(), 20 * np.exp(RATE * time), 6e-6)
    return 300 * synthetic_image(phantom.displacement)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("series") / "night.shadowinv.zarr"
    images = np.stack([image_at(time) for time in range(SHOTS)])
    run_stack(images, out, Recipe(setup=ProtonSetup.example()))
    return out


@pytest.fixture
def form(window: Any, open_widget: Any, store: Path) -> Any:
    """The form with the store, a region and a circle."""
    window.open(str(store), plugin="napari-shadowinv")
    tool = open_widget("Analyse")
    tool.tabs.setCurrentWidget(tool.products)
    form = tool.products
    form.product.set_kind("region")
    form._draw()
    form.shapes.layer.add_ellipses(np.array([[15.5, 15.5], [10.0, 10.0]]))
    return form


def press(form: Any, qtbot: Any) -> str:
    """Press the button, wait for the end, and return the line below the button."""
    form.panel.button.click()
    qtbot.waitUntil(lambda: not form.panel.running, timeout=PATIENCE)
    return str(form.panel.status.text())


def test_series_of_a_store_is_that_of_python(form: Any, qtbot: Any, store: Path) -> None:
    assert form.shots.isVisibleTo(form)
    enter(form.shots.entries["times"], "1 ns")
    assert press(form, qtbot) == ""
    (measured,) = form.measured
    region = Region(center=(15.5, 15.5), radius=10)
    times = 1e-9 * np.arange(SHOTS)
    (expected,) = analyse_shots(read_stack(store), region, times)
    for name, quantity in expected.quantities.items():
        np.testing.assert_allclose(measured[name].value, quantity.value, rtol=1e-12)
    rows = texts_of(form.report)
    for fact in expected.facts:
        assert rows[fact.title] == fact.text
    assert float(rows["Growth of rms"].split()[0]) == pytest.approx(RATE, rel=0.05)
    assert "95 %" in rows["Growth of rms"]


def test_numbers_and_centroid_are_drawn_over_time(form: Any, qtbot: Any) -> None:
    enter(form.shots.entries["times"], "0, 1 ns, 2 ns, 4 ns")
    press(form, qtbot)
    numbers, places = form.plot.figure.axes
    assert places.get_xlabel() == "time (ns)"
    assert places.get_ylabel() == "µm"
    lines = {line.get_label(): line for axes in (numbers, places) for line in axes.lines}
    assert {"peak", "rms", "centroid_y", "centroid_x"} <= lines.keys()
    np.testing.assert_allclose(lines["rms"].get_xdata(), [0, 1, 2, 4])
    np.testing.assert_allclose(lines["rms"].get_ydata(), form.measured[0]["rms"].value)
    middle = 1e6 * 15.5 * ProtonSetup.example().object_pixel_size
    np.testing.assert_allclose(lines["centroid_y"].get_ydata(), middle, rtol=0.02)


def test_shots_are_chosen_and_numbered_without_times(form: Any, qtbot: Any) -> None:
    enter(form.shots.entries["shots"], "1:4:2")
    press(form, qtbot)
    np.testing.assert_array_equal(form.measured[0].coordinates["shot"].values, [1, 3])
    assert "per shot" in texts_of(form.report)["Growth of rms"]
    ticks = form.plot.figure.axes[-1].get_xticks()
    np.testing.assert_array_equal(ticks, np.round(ticks))


MISTAKES = [  # product, shots, times, message
    ("region", "", "1,2", "Times is '1,2', expected the time between two shots in s, or a"),
    ("region", "", "soon", "Times is 'soon': expected a number in s"),
    ("region", "9", "", "Shots are '9': expected numbers from 0 to 3"),
    ("current-density", "", "", "The current density has no single number to follow"),
]


def test_mistake_with_a_store_is_a_sentence(form: Any, qtbot: Any, messages: list[str]) -> None:
    for product, shots, times, message in MISTAKES:
        form.product.set_kind(product)
        enter(form.shots.entries["shots"], shots)
        enter(form.shots.entries["times"], times)
        assert message in press(form, qtbot)
        assert message in messages[-1]
        assert form.measured == []


def test_series_is_saved_as_a_table_and_a_figure(
    form: Any, qtbot: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(form.shots.entries["times"], "2 ns")
    press(form, qtbot)
    names = iter([(tmp_path / "growth.csv", ""), (tmp_path / "growth", "PDF (*.pdf)")])
    monkeypatch.setattr(
        QFileDialog, "getSaveFileName", lambda *_, **__: tuple(map(str, next(names)))
    )
    form.export.click()
    rows = list(csv.DictReader((tmp_path / "growth.csv").open(encoding="utf-8")))
    places = [float(row["place"]) for row in rows if row["quantity"] == "rms"]
    np.testing.assert_allclose(places, 2e-9 * np.arange(SHOTS))
    form.picture.click()
    assert (tmp_path / "growth.pdf").read_bytes().startswith(b"%PDF")
    assert not form.save.isEnabled()


def test_cancelled_series_leaves_no_result(
    form: Any, qtbot: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    entered = threading.Event()
    original = _products.analyse_shots

    def held(*args: Any, should_stop: Any, **choices: Any) -> Any:
        entered.set()
        while not should_stop():
            threading.Event().wait(0.01)
        return original(*args, should_stop=should_stop, **choices)

    monkeypatch.setattr(_products, "analyse_shots", held)
    form.panel.button.click()
    qtbot.waitUntil(entered.is_set, timeout=PATIENCE)
    form.panel.button.click()
    qtbot.waitUntil(lambda: not form.panel.running, timeout=PATIENCE)
    assert form.panel.status.text() == "Cancelled."
    assert form.measured == []
    monkeypatch.undo()
    assert press(form, qtbot) == ""
    assert len(form.measured) == 1


def test_single_result_has_no_times(form: Any, window: Any, qtbot: Any) -> None:
    enter(form.shots.entries["times"], "1 ns")
    press(form, qtbot)
    inversion = invert(image_at(0.0), source=np.full((32, 32), 300.0))
    added = add_to_viewer(window, inversion, ProtonSetup.example(), name="single")
    form.result.layer = next(layer for layer in added if layer in form.result.offered)
    assert not form.shots.isVisibleTo(form)
    enter(form.bands.entries["samples"], 20)
    press(form, qtbot)
    (measured,) = form.measured  # those of the store are forgotten
    assert not measured.is_series
    assert form.save.isEnabled()
