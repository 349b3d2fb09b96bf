"""The widget *Plan an experiment*, in a real window."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from helpers.reports import texts_of
from napari_shadowinv import Instrument
from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv.io import read_field_grid
from napari_shadowinv.physics.phantoms import paper_setup
from napari_shadowinv.pipeline import ExperimentOptions, plan_experiment
from napari_shadowinv.pipeline.experiment_object import object_of_field

PATIENCE = 60_000  # ms


@pytest.fixture
def tool(window: Any, open_widget: Any) -> Any:
    """The widget with a small toroid and three draws."""
    tool = open_widget("Plan an experiment")
    tool.object.set_kind("toroid")
    tool.object.form.restore({"peak": 20.0, "radius": 9e-6})
    tool.side.setText("64 x 64")
    tool.instrument.restore({"beam_rms": 0.0})
    tool.options.restore({"draws": 3, "counts": 3000.0})
    return tool


def finished(tool: Any, qtbot: Any) -> None:
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.running, timeout=PATIENCE)


def test_a_plan_shows_its_verdict_and_the_first_image(tool: Any, window: Any, qtbot: Any) -> None:
    assert tool.setup.setup() == paper_setup()
    finished(tool, qtbot)
    assert "would be determined: 3 of 3" in tool.verdict.text()
    assert "Error made" in texts_of(tool.report)
    qtbot.waitUntil(lambda: len(window.layers) == 1, timeout=PATIENCE)
    (layer,) = window.layers
    assert role_of(layer) == "shot"
    assert layer.data.mean() == pytest.approx(3000, rel=0.01)
    assert not tool.plot.isHidden()


def test_a_sweep_draws_the_error_at_each_value(tool: Any, qtbot: Any) -> None:
    tool.quantity.setCurrentIndex(tool.quantity.findData("counts"))
    tool.values.setText("100, 1600")
    finished(tool, qtbot)
    line = tool.plot.figure.axes[0].lines[0]
    np.testing.assert_array_equal(line.get_xdata(), [100, 1600])
    few, many = line.get_ydata()
    assert few > 2 * many


@pytest.mark.parametrize(
    ("energies", "size", "message"),
    [("3; 15", "64 x 64", "separated by commas"), ("", "64", "expected height and width")],
)
def test_wrong_entries_are_a_sentence_below_the_button(
    tool: Any, messages: list[str], energies: str, size: str, message: str
) -> None:
    tool.energies.setText(energies)
    tool.side.setText(size)
    tool.panel.button.click()
    assert message in tool.panel.status.text()
    assert len(messages) == 1


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    """A ring of B about the axis x, away from the middle of its frame."""
    z, y, x = np.meshgrid(*[np.linspace(-4e-5, 4e-5, 20)] * 3, indexing="ij")
    bell = 8e6 * np.exp(-(x**2 + y**2 + z**2) / (2 * 1.2e-5**2))
    values = {"Bx": bell * 0, "By": -z * bell, "Bz": y * bell}
    magnetic = {name: (("z", "y", "x"), value, {"units": "T"}) for name, value in values.items()}
    places = {"z": 1e-3 + z[:, 0, 0], "y": y[0, :, 0], "x": x[0, 0]}
    axes = {name: (name, line, {"units": "m"}) for name, line in places.items()}
    path = tmp_path / "cube.nc"
    xr.Dataset(magnetic, axes).to_netcdf(path, engine="h5netcdf")
    return path


@pytest.fixture
def traced(tool: Any, cube: Path) -> Any:
    """The widget with the field of the file, seen along x."""
    tool.object.set_kind("grid")
    tool.file.edit.setText(str(cube))
    tool.file.changed.emit()
    tool.object.form.restore({"beam": "x", "right": "y", "centre": True})
    tool.side.setText("")
    return tool


def test_a_3d_field_is_planned_as_in_python(
    traced: Any, window: Any, cube: Path, qtbot: Any
) -> None:
    assert traced.file.isVisibleTo(traced)
    finished(traced, qtbot)
    qtbot.waitUntil(lambda: len(window.layers) == 1, timeout=PATIENCE)
    grid = read_field_grid(cube).turned("x", "y").centred()
    expected = plan_experiment(
        object_of_field(grid, paper_setup()),
        paper_setup(),
        instrument=Instrument(beam_rms=0.0),
        options=ExperimentOptions(draws=3, counts=3000.0),
    )
    (layer,) = window.layers
    np.testing.assert_array_equal(layer.data, expected.images[0])
    assert layer.name == "cube.nc, planned"
    texts = texts_of(traced.report)
    assert texts["Error made"] == next(f.text for f in expected.facts if f.title == "Error made")
    traced.object.set_kind("toroid")
    assert not traced.file.isVisibleTo(traced)


def test_forward_model_offers_the_same_view_of_a_file(traced: Any, open_widget: Any) -> None:
    forward = open_widget("Forward model")
    forward.object.set_kind("grid")
    names = [tool.object.choice.currentText() for tool in (traced, forward)]
    assert names == ["a 3-D field from a file"] * 2
    assert forward.object.form.entries.keys() == traced.object.form.entries.keys()
    assert forward.file.toolTip() == traced.file.toolTip()


def test_file_and_view_are_remembered(traced: Any, cube: Path) -> None:
    state = traced.state()
    traced.object.set_kind("toroid")
    traced.file.edit.setText("")
    traced.restore(state)
    file = traced._object()
    assert file.path == str(cube)
    assert file.view.model_dump() == {"beam": "x", "right": "y", "centre": True}


def test_wrong_file_is_a_sentence(
    traced: Any, qtbot: Any, messages: list[str], tmp_path: Path
) -> None:
    np.save(tmp_path / "plane.npy", np.ones((4, 4)))
    xr.Dataset({"rho": ("x", np.ones(3))}).to_netcdf(tmp_path / "rho.nc", engine="h5netcdf")
    for text, message in (
        ("", "There is no file with a 3-D field: choose one"),
        (str(tmp_path / "none.h5"), "none.h5"),
        (str(tmp_path / "plane.npy"), "is no HDF5 file: expected an openPMD file or a NetCDF 4"),
        (str(tmp_path / "rho.nc"), "rho.nc"),
    ):
        traced.file.edit.setText(text)
        finished(traced, qtbot)
        assert message in traced.panel.status.text()
        assert message in messages[-1]
    assert len(messages) == 4
    traced.file.edit.setText(str(tmp_path / "cube.nc"))
    traced.object.form.restore({"beam": "x", "right": "x"})
    finished(traced, qtbot)
    assert len(messages) == 5
    assert "right" in messages[-1]
    traced.object.form.restore({"beam": "x", "right": "y"})
    traced.setup.picker.set_kind("none")
    finished(traced, qtbot)
    assert "There is no setup: expected one of charged particles" in messages[-1]
