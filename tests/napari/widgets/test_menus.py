"""Entries of napari's menus that open a widget, and its preferences."""

import numpy as np
import pytest
from qtpy.QtWidgets import QComboBox

from napari_shadowinv._napari.layer_metadata import role_of
from napari_shadowinv._napari.layers import add_layers, inversion_layers
from napari_shadowinv._napari.preferences import preference
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.simulate import Simulate
from napari_shadowinv._napari.widgets.analyse import Analyse
from napari_shadowinv._system.machine import available_threads, set_default_threads


@pytest.fixture
def choose(window, in_loop):
    """Choose an entry of a menu."""
    from napari._app_model import get_app_model

    def execute(name):
        in_loop(get_app_model().commands.execute_command, f"napari-shadowinv.{name}")

    return execute


def add_some(window, inversion, *roles):
    """Add the layers of a result with these roles, in their order."""
    described = {role_of(each[1]): each for each in inversion_layers(inversion)}
    return add_layers(window, [described[role] for role in roles])


def docked(window, kind):
    """The only widget of a class in the window."""
    (widget,) = [each for each in window.window.dock_widgets.values() if isinstance(each, kind)]
    return widget


def test_analyse_opens_once_for_the_selected_image_or_result(
    window, choose, solved, messages, wait
):
    choose("analyse")  # in the menu Plugins
    choose("plot_along_line")
    assert messages == ["No image is selected: select a grey image in the layer list"]
    window.add_image(np.ones((20, 30)), name="other")
    image = window.add_image(np.ones((20, 30)), name="shot")
    choose("plot_along_line")
    analyse = docked(window, Analyse)
    assert analyse.tabs.currentIndex() == 0
    assert analyse.layers == [image]
    assert analyse.lines.layer.name == "profile – shot"
    assert analyse.lines.layer.mode == "add_line"
    wait(analyse.isVisible)
    analyse.parent().hide()
    field, arrows = add_some(window, solved, "field", "arrows")
    add_some(window, solved, "field")
    window.layers.selection.active = arrows
    choose("measure_products")
    assert docked(window, Analyse) is analyse
    assert analyse.isVisible()
    assert analyse.tabs.currentWidget() is analyse.products
    assert analyse.products.result.layer is field
    assert len(messages) == 1
    window.layers.selection.active = window.add_image(np.ones((20, 30)))
    choose("measure_products")
    assert messages[-1].startswith("No result is selected: select a layer of an inversion")


def test_an_image_is_predicted_from_the_selected_potential(window, choose, solved, messages):
    potential, arrows = add_some(window, solved, "potential", "arrows")
    window.layers.selection.active = potential
    choose("predict_image")
    forward = docked(window, Simulate)
    assert forward.object.kind == "layer"
    assert forward.field.layer is potential
    window.layers.selection.active = arrows
    choose("predict_image")
    assert "is selected: select the field or the potential of a result" in messages[-1]
    assert forward.field.layer is potential


def test_the_dialog_of_napari_shows_and_keeps_the_preferences(preferences, window, qtbot):
    from napari._qt.dialogs.preferences_dialog import PreferencesDialog

    dialog = PreferencesDialog(window.window._qt_window)
    qtbot.addWidget(dialog)
    pages = {dialog._list.item(row).text(): row for row in range(dialog._list.count())}
    dialog._list.setCurrentRow(pages["Shadowinv"])
    boxes = dialog._stack.currentWidget().findChildren(QComboBox)
    (lengths,) = [box for box in boxes if box.findText("cm") >= 0 and box.findText("mm") >= 0]
    lengths.setCurrentIndex(lengths.findText("mm"))
    assert preference("units", "length") == "mm"
    dialog.reject()
    assert preference("units", "length") == "automatic"


def test_runs_have_the_preferred_number_of_threads(preferences, qtbot, wait):
    cores, threads = available_threads(None), []
    panel = Run("Run", "")
    qtbot.addWidget(panel)
    try:
        for preferences.widgets.threads in (7, 0):  # 0: all of them
            panel.start(lambda on_progress, should_stop: threads.append(available_threads(None)))
            wait(lambda: not panel.running)
    finally:
        set_default_threads(None)
    assert threads == [7, cores]
