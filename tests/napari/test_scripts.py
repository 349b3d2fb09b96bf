"""The scripts for napari that a user copies."""

import os
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from napari_shadowinv import read, write
from napari_shadowinv._napari.layer_metadata import role_of, setup_of

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_headless_needs_no_display_and_saves_what_it_shows(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "DISPLAY"}
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / "napari_headless.py")],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    # Nobody measured the beam, on which the field depends.
    assert "± |∫B×dz| (mT·m) – shot 1" in done.stdout
    # The paper's toroid of 90 MG µm is 9 mT m.
    strongest = float(done.stdout.split("strongest ")[1].split()[0])
    assert strongest == pytest.approx(9.0, rel=0.03)
    dataset = read(tmp_path / "shot_1.shadowinv")
    assert dataset.sizes["site"] == 2500


@pytest.fixture
def window(make_napari_viewer, monkeypatch):
    """A napari window that a script gets when it asks for one."""
    opened = make_napari_viewer()
    monkeypatch.setattr("napari.Viewer", lambda: opened)
    return opened


def test_view_opens_a_saved_result(window, solved, proton_setup, tmp_path, monkeypatch):
    path = write(tmp_path / "a.shadowinv", solved, setup=proton_setup)
    monkeypatch.setattr(sys, "argv", ["napari_view.py", str(path)])
    runpy.run_path(str(EXAMPLES / "napari_view.py"))
    assert {"field", "arrows"} <= {role_of(layer) for layer in window.layers if layer.visible}
    assert setup_of(window.layers[0]) == proton_setup


def test_view_shows_a_sample_and_its_field(window, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["napari_view.py"])
    runpy.run_path(str(EXAMPLES / "napari_view.py"))
    field = window.layers["± |∫B×dz| (mT·m) – toroid"]
    # 194 MG µm is 19.4 mT m; noise and caustics cost a few per cent.
    assert field.data.max() == pytest.approx(19.4, rel=0.08)
    assert window.layers.selection.active is field


def test_add_to_running_lays_the_result_on_the_selected_shot(
    make_napari_viewer, solved, proton_setup
):
    from napari_shadowinv._napari.shots import shot_layer

    running = make_napari_viewer()
    data, keywords, _ = shot_layer(solved.image, "my shot", proton_setup, (0.0, 2.0))
    shot = running.add_image(data, **{**keywords, "translate": (10.0, 20.0)})
    runpy.run_path(str(EXAMPLES / "napari_add_to_running.py"))
    (field,) = [layer for layer in running.layers if role_of(layer) == "field"]
    assert field.name.endswith(" – my shot")
    np.testing.assert_array_equal(field.extent.world, shot.extent.world)
    assert setup_of(field) == proton_setup
