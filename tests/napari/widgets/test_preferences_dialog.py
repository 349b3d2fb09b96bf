"""The preferences in napari's dialog, and the threads of a run."""

from qtpy.QtWidgets import QComboBox

from napari_shadowinv._napari.preferences import colour_map
from napari_shadowinv._napari.run import Run
from napari_shadowinv._system.machine import available_threads, set_default_threads


def test_the_dialog_of_napari_shows_and_keeps_the_preferences(preferences, window, qtbot):
    from napari._qt.dialogs.preferences_dialog import PreferencesDialog

    dialog = PreferencesDialog(window.window._qt_window)
    qtbot.addWidget(dialog)
    pages = {dialog._list.item(row).text(): row for row in range(dialog._list.count())}
    dialog._list.setCurrentRow(pages["Shadowinv"])
    boxes = dialog._stack.currentWidget().findChildren(QComboBox)
    (signed,) = [box for box in boxes if box.findText("PiYG") >= 0]
    signed.setCurrentIndex(signed.findText("PiYG"))
    assert colour_map("signed") == "PiYG"
    dialog.reject()
    assert colour_map("signed") == "RdBu_r"


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
