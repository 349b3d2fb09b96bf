"""The tab *Layers along a line* of *Analyse*."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from napari_shadowinv._napari.layer_metadata import metadata_for
from napari_shadowinv._napari.widgets.analyse import Analyse
from napari_shadowinv.analysis.paths import measure_peak

PATIENCE = 60_000  # ms
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


def test_a_profile_has_true_units_on_both_axes(profile, qtbot):
    profile.lines.layer.add_lines(LINE)
    qtbot.waitUntil(lambda: len(profile.profiles) == 2, timeout=PATIENCE)
    rows = list(csv.reader(profile.table().splitlines()))
    assert set(rows[0]) == {"distance (µm)", "height (nm)", "field (T)"}
    table = np.array(rows[1:], float)
    assert table[-1, 0] == pytest.approx(80)  # 40 px of 2 µm
    height = table[:, rows[0].index("height (nm)")]
    np.testing.assert_allclose(height, 30 + 5 + table[:, 0] / 2, atol=1e-6)
    axes = profile.plot.figure.axes
    assert {axis.get_ylabel() for axis in axes} == {"nm", "T"}
    assert axes[-1].get_xlabel() == "distance (µm)"
    assert {axis.get_title(loc="left") for axis in axes} == {"height", "field"}
    assert all(axis.get_legend() is None for axis in axes)


def test_measures_of_a_gaussian_are_those_of_its_formula():
    distance = np.linspace(0.0, 100.0, 4001)
    measures = measure_peak(distance, -3.0 * np.exp(-((distance - 40) ** 2) / (2 * 5.0**2)))
    assert measures is not None
    assert (measures.peak, measures.position) == (-3.0, 40.0)
    assert measures.width == pytest.approx(5 * np.sqrt(8 * np.log(2)), rel=1e-3)
    assert measures.area == pytest.approx(-3 * 5 * np.sqrt(2 * np.pi), rel=1e-6)
    assert "width (FWHM) 11.77 µm, area -37.6 T·µm" in measures.text("T", "µm")


def test_width_beyond_the_line_is_told_as_such():
    distance = np.linspace(0.0, 10.0, 11)
    values = np.where(distance > 8, np.nan, 5.0 - 0.1 * distance)
    measures = measure_peak(distance, values)
    assert measures is not None
    assert np.isnan(measures.width)
    assert measures.area == pytest.approx(8 * 4.6)
    assert "width (FWHM) beyond the line" in measures.text("T", "µm")
    assert measure_peak(distance, np.full(11, np.nan)) is None


def test_profile_shows_peak_width_and_area(profile, viewer, qtbot):
    profile.check(viewer.layers["field"], False)
    profile.lines.layer.add_lines(LINE)
    qtbot.waitUntil(lambda: "peak 75 nm at 80 µm" in profile.measures.text(), timeout=PATIENCE)
    assert profile.measures.isVisibleTo(profile)
    assert "area 4400 nm·µm" in profile.measures.text()


def test_a_profile_is_averaged_over_its_width(profile, viewer, qtbot):
    y = np.mgrid[:40, :50][0].astype(float)
    viewer.layers["height"].data = y**2
    profile.check(viewer.layers["field"], False)
    profile.lines.layer.add_lines(np.array([[20.0, 5.0], [20.0, 45.0]]))

    def shows(value):
        return bool(profile.profiles) and profile.profiles[0].values[3] == pytest.approx(value)

    qtbot.waitUntil(lambda: shows(400), timeout=PATIENCE)
    profile.width_edit.setText("9")
    qtbot.waitUntil(lambda: shows(400 + 80 / 12), timeout=PATIENCE)
    axes = profile.plot.figure.axes
    assert axes[-1].get_xlabel() == "distance (µm), mean over 9 px"
    assert "height (nm), mean over 9 px" in profile.table()
    profile.width_edit.setText("10 um")  # pixels of 2 µm
    qtbot.waitUntil(lambda: shows(400 + 24 / 12), timeout=PATIENCE)
    assert axes[-1] not in profile.plot.figure.axes
    assert "mean over 10 µm" in profile.table()
    profile.width_edit.setText("-1")
    qtbot.waitUntil(lambda: "Width is '-1'" in profile.problem.text(), timeout=PATIENCE)
    assert profile.profiles == []


def test_a_profile_lies_on_a_layer_that_was_turned(profile, viewer, qtbot):
    profile.check(viewer.layers["field"], False)
    viewer.layers["height"].rotate = 90
    qtbot.wait(50)
    profile.lines.layer.add_lines(np.array([[-5.0, 20.0], [-5.0, 10.0]]))
    qtbot.waitUntil(lambda: bool(profile.profiles), timeout=PATIENCE)
    # 90°: world (y, x) = (-column, row), in pixels of 2 µm.
    rows, column = np.linspace(20, 10, 11), 5
    np.testing.assert_allclose(profile.profiles[0].values, 3 * rows + column)


def test_a_profile_follows_the_line_and_the_layers(viewer, profile, qtbot):
    profile.check(viewer.layers["field"], False)
    lines = profile.lines.layer
    lines.add_lines(LINE)
    qtbot.waitUntil(lambda: len(profile.profiles) == 1, timeout=PATIENCE)
    lines.data = [np.array([[20.0, 5.0], [20.0, 45.0]])]
    qtbot.waitUntil(lambda: profile.profiles[0].values[0] == pytest.approx(65), timeout=PATIENCE)
    viewer.layers["height"].data = np.full((40, 50), 7.0)
    qtbot.waitUntil(lambda: profile.profiles[0].values[0] == pytest.approx(7), timeout=PATIENCE)
    viewer.layers.remove(viewer.layers["height"])
    qtbot.waitUntil(lambda: profile.profiles == [], timeout=PATIENCE)


def test_a_profile_is_exported_whole(profile, qtbot, tmp_path, choose, messages):
    profile.export.click()
    assert len(messages) == 1
    assert "no profile" in messages[0]
    profile.lines.layer.add_lines(LINE)
    qtbot.waitUntil(lambda: bool(profile.profiles), timeout=PATIENCE)
    choose(tmp_path / "line")
    profile.export.click()
    assert (tmp_path / "line.csv").read_text(encoding="utf-8") == profile.table()


def test_a_line_needs_an_image(opened, messages):
    tool = opened(Analyse)
    tool._draw()
    assert len(messages) == 1
    assert "no image" in messages[0]
