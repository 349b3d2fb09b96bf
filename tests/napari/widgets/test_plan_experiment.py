"""The widget *Plan an experiment*, in a real window."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv.physics.phantoms import paper_setup

PATIENCE = 60_000  # ms


@pytest.fixture
def tool(window: Any, open_widget: Any) -> Any:
    """The widget with a small toroid and three draws."""
    tool = open_widget("Plan an experiment")
    tool.object.set_kind("toroid")
    tool.object.form.set_values({"peak": 20.0, "radius": 9e-6})
    tool.side.setText("64 x 64")
    tool.instrument.set_values({"beam_rms": 0.0})
    tool.options.set_values({"draws": 3, "counts": 3000.0})
    return tool


def finished(tool: Any, qtbot: Any) -> None:
    tool.panel.button.click()
    qtbot.waitUntil(lambda: not tool.panel.runner.running, timeout=PATIENCE)


def test_a_plan_shows_its_verdict_and_the_first_image(tool: Any, window: Any, qtbot: Any) -> None:
    assert tool.setup.setup() == paper_setup()
    finished(tool, qtbot)
    assert "would be determined: 3 of 3" in tool.verdict.text()
    assert "Error made" in tool.report.texts()
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


def test_particles_are_traced_through_a_field_in_a_file(
    tool: Any, tmp_path: Path, qtbot: Any
) -> None:
    """A bundle of field lines around the beam, which runs along x of the grid."""
    places = np.linspace(-6e-5, 6e-5, 33)
    z, y, x = np.meshgrid(places, places, places, indexing="ij")
    bell = 8e6 * np.exp(-(x**2 + y**2 + z**2) / (2 * 1.2e-5**2))
    values = {"Bx": bell * 0, "By": -z * bell, "Bz": y * bell}
    magnetic = {name: (("z", "y", "x"), value, {"units": "T"}) for name, value in values.items()}
    axes = {name: (name, places, {"units": "m"}) for name in "zyx"}
    xr.Dataset(magnetic, axes).to_netcdf(tmp_path / "cube.nc", engine="h5netcdf")
    tool.object.set_kind("grid")
    tool.panel.button.click()
    assert "There is no file with a 3-D field: choose one" in tool.panel.status.text()
    tool.object.form.set_values({"beam": "x", "right": "y"})
    tool.file.edit.setText(str(tmp_path / "cube.nc"))
    tool.options.set_values({"draws": 2, "counts": 100_000.0})
    tool.side.setText("")  # all of the grid
    finished(tool, qtbot)
    assert "would be determined: 2 of 2" in tool.verdict.text()
    restored = tool.state()
    assert restored["file"] == str(tmp_path / "cube.nc")
    assert restored["object"]["kind"] == "grid"
    tool.file.edit.setText(str(tmp_path / "missing.nc"))
    finished(tool, qtbot)
    assert "missing.nc" in tool.panel.status.text()


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
