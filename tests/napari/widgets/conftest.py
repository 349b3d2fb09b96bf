"""A real window with the plugin's widgets, independent of the user's settings."""

from __future__ import annotations

import gc
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import pytest

from napari_shadowinv.inversion import invert
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob


@pytest.fixture(autouse=True)
def settings_folder(tmp_path):
    """Keep the widgets' state out of the user's settings."""
    from qtpy.QtCore import QSettings

    folder = tmp_path / "settings"
    QSettings.setPath(QSettings.Format.IniFormat, QSettings.Scope.UserScope, str(folder))
    return folder


@pytest.fixture(scope="module", autouse=True)
def _lasting():
    """Exclude what earlier modules leave from the garbage collections of napari, two a test."""
    import_module("napari._qt.qt_main_window")
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _no_collection_for_each_layer():
    """Collect garbage once a window, not with each layer that it closes, as drivers may need."""
    from napari._vispy import canvas

    if hasattr(canvas, "gc"):
        canvas.gc = SimpleNamespace(collect=lambda: 0)


@pytest.fixture(scope="session")
def shot():
    """An off-centre blob in an even beam, in counts, that no edge cuts."""
    blob = gaussian_blob((48, 60), 15.0, 6.0, (22.0, 33.0))
    return 300 * synthetic_image(blob.displacement)


@pytest.fixture(scope="session")
def _compiled(shot):
    """Compile the kernels of an inversion, so that no test waits for them."""
    invert(shot, options=InversionOptions(n_sites=700))


@pytest.fixture
def window(make_napari_viewer, qtbot, _compiled):
    """A viewer in a visible window; at the end none of the plugin's threads runs."""
    viewer = make_napari_viewer(show=True)
    viewer.window._qt_window.resize(700, 400)  # a large canvas takes long to draw without a card
    yield viewer
    qtbot.waitUntil(lambda: not running_threads(), timeout=20_000)


@pytest.fixture
def open_widget(window):
    """Open a widget as the menu does."""

    def opened(name):
        _, widget = window.window.add_plugin_dock_widget("napari-shadowinv", name)
        return widget

    return opened


@pytest.fixture
def opened(viewer, qtbot):
    """Make a widget of a class, as a session does when its menu is used first."""
    widgets: list[Any] = []

    def make(kind):
        widgets.append(kind(viewer))
        qtbot.addWidget(widgets[-1])
        return widgets[-1]

    yield make
    # None writes into the settings of the next test.
    for widget in widgets:
        if hasattr(widget, "_writing"):
            widget._writing.stop()


@pytest.fixture
def assert_it_fits(window, qtbot):
    """Check that a widget needs no sideways scrolling, and has no gaps, in windows of any size."""
    from qtpy.QtCore import Qt

    def check(tool):
        for size in ((1280, 800), (2560, 1440)):
            window.window._qt_window.resize(*size)
            qtbot.wait(50)
            qtbot.waitUntil(lambda: tool.area.horizontalScrollBar().maximum() == 0)
            assert tool.area.widget().minimumSizeHint().width() <= tool.area.viewport().width()
            spread = tool.area.widget().layout().expandingDirections()
            assert not spread & Qt.Orientation.Vertical

    return check


@pytest.fixture
def run(qtbot):
    """Press Run and wait until the layers are there."""

    def pressed(tool):
        before = getattr(tool, "results", None)
        tool.panel.button.click()
        qtbot.waitUntil(lambda: getattr(tool, "results", None) is not before, timeout=60_000)
        qtbot.waitUntil(lambda: not tool.results.busy, timeout=60_000)

    return pressed


@pytest.fixture
def choose(monkeypatch):
    """Answer the dialogs for a file with a path and the first filter, and whether to replace it."""
    from qtpy.QtWidgets import QFileDialog, QMessageBox

    def answer(path, replace=False):
        def ask(parent, title, proposal, filters, **_):
            return str(path), filters.split(";;")[0]

        button = QMessageBox.StandardButton.Yes if replace else QMessageBox.StandardButton.No
        monkeypatch.setattr(QFileDialog, "getSaveFileName", ask)
        monkeypatch.setattr(QFileDialog, "getOpenFileName", ask)
        monkeypatch.setattr(QMessageBox, "question", lambda *_: button)

    return answer


def running_threads():
    import threading

    return [thread for thread in threading.enumerate() if thread.name == "shadowinv"]
