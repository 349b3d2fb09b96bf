"""The form of a setup shows field of view, magnification and warnings."""

from __future__ import annotations

from napari_shadowinv._napari.widgets._inputs import SetupPicker
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
