"""Forms and tables of a further kind of setup, that of CONTRIBUTING.md."""

from __future__ import annotations

import numpy as np

from napari_shadowinv._napari.widgets._image_table import ImageTable, beam_column
from napari_shadowinv._napari.widgets._inputs import SetupPicker, fields_of


def test_form_reads_a_new_kind(xray_setup, qtbot):
    picker = SetupPicker()
    qtbot.addWidget(picker)
    soft = xray_setup.example()
    picker.show_setup(soft.model_dump())
    assert picker.kind == "x-ray"
    assert picker.setup() == soft


def test_fields_to_fit_are_those_of_a_new_kind(xray_setup):
    assert fields_of("x-ray") == {"electrons": ("electron density (phase ∝ λ²)", None)}
    assert beam_column("x-ray").heading == "Energy (keV)"


def test_table_of_images_has_the_quantity_of_a_new_kind(xray_setup, qtbot):
    from napari.components import ViewerModel

    viewer = ViewerModel()
    viewer.add_image(np.ones((8, 8)), name="soft")
    table = ImageTable(viewer, lambda layer: True)
    qtbot.addWidget(table)
    table.show_beams("x-ray", 8.0, is_brightness_known=True)
    assert table.horizontalHeaderItem(1).text() == "Energy (keV)"
    assert table.beam_value(table.used[0]) == 8.0
