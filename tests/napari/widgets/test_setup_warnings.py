"""The form of a setup shows field of view, magnification and warnings."""

from __future__ import annotations

import numpy as np
import pytest
from napari.layers import Image

from napari_shadowinv._napari.widgets._inputs import SetupPicker
from napari_shadowinv.io import read_shot
from napari_shadowinv.physics.setup import ProtonSetup


def test_setup_form_shows_geometry_and_doubts(qtbot):
    picker = SetupPicker()
    qtbot.addWidget(picker)
    paper = ProtonSetup.example()
    picker.show_setup(paper.model_dump())
    assert picker.geometry_label.text().startswith("pixel 1.5 µm at the object, M = 16.4")
    assert picker.warning_label.text() == ""
    picker.show_setup({**paper.model_dump(), "energy": 147.0})
    assert "147 MeV" in picker.warning_label.text()


@pytest.mark.parametrize("is_by_us", [True, False])
def test_sizes_in_the_file_begin_a_setup(tmp_path, qtbot, is_by_us):
    """`dr` of a text image is its pixel at the detector; napari itself knows nothing of it."""
    path = tmp_path / "shot.txt"
    np.savetxt(path, np.ones((8, 9)), header="pixel_width: 2.5e-05\nobject_image_dist: 0.1")
    geometry = read_shot(path).metadata["geometry"]
    assert geometry["detector_pixel_size"] == 2.5e-5
    layer = Image(np.ones((8, 9)), name="shot")
    if is_by_us:
        layer.metadata["napari-shadowinv"] = {"file": {"geometry": geometry}}
    else:
        layer._source = layer.source.model_copy(update={"path": str(path)})
    picker = SetupPicker()
    qtbot.addWidget(picker)
    picker.follow(layer)
    picker.set_kind("proton")
    values = picker.form.state()
    assert values["detector_pixel_size"] == 2.5e-5
    assert values["object_image_distance"] == 0.1
    assert "energy" not in values
    assert picker.note.text() == "Begun with the file of 'shot'."
    # A setup file needs not repeat it, and is not overruled.
    entries = {"kind": "proton", "energy": 14.7, "source_object_distance": 0.01}
    picker.load(entries, "setup.toml")
    assert picker.setup().detector_pixel_size == 2.5e-5
    picker.load({**entries, "pixel_size": 3e-6}, "setup.toml")
    assert picker.setup().detector_pixel_size is None
    assert picker.setup().pixel_size == 3e-6
