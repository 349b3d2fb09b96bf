"""A real window with the plugin's widgets, independent of the user's settings."""

import gc
import threading
import time
from importlib import import_module
from types import SimpleNamespace

import pytest

from helpers.windows import PATIENCE, at_rest, running_threads
from napari_shadowinv._napari.form import PROBLEM_STYLE
from napari_shadowinv._napari.run import _Mailbox
from napari_shadowinv.errors import InversionCancelled
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

    def make(kind):
        widget = kind(viewer)
        qtbot.addWidget(widget)
        return widget

    return make


@pytest.fixture
def wait(qtbot):
    """Wait until a condition holds."""
    return lambda condition: qtbot.waitUntil(condition, timeout=PATIENCE)


@pytest.fixture
def rest(wait):
    """Wait until the work of a window has ended and its layers are there."""
    return lambda tool: wait(lambda: at_rest(tool))


@pytest.fixture
def run(rest):
    """Press Run or another button, wait until the layers are there, and return the result."""

    def pressed(tool, button=None):
        outcomes = []
        tool.panel.ended.connect(outcomes.append)
        (button or tool.panel.button).click()
        rest(tool)
        (outcome,) = outcomes
        assert outcome.error is None
        return getattr(outcome.value, "content", outcome.value)

    return pressed


@pytest.fixture
def refused(wait, qtbot, messages):
    """Press Run, and check that it is refused in one sentence, which stays below the button.

    Something else than Run may be done, too.
    """

    def check(tool, words, do=None):
        layers, usual = list(tool.viewer.layers), tool.panel.button.text()
        messages.clear()
        (do or tool.panel.button.click)()
        wait(lambda: bool(messages) and not tool.panel.running)
        qtbot.wait(20)
        (text,) = messages
        assert words in text
        assert "\n" not in text
        status, button = tool.panel.status, tool.panel.button
        assert status.text() == text
        assert status.styleSheet() == PROBLEM_STYLE
        assert not status.isHidden()
        assert (button.text(), button.isEnabled()) == (usual, True)
        assert list(tool.viewer.layers) == layers

    return check


@pytest.fixture
def held(monkeypatch):
    """Hold all work, as a large image would, until it is let go, or asked to stop: see `stops`."""
    let_go, fill = threading.Event(), _Mailbox.fill
    let_go.stops = []  # whether each work then ended by itself

    def hold(box, work):
        def later(on_progress, should_stop):
            while not (let_go.is_set() or should_stop()):
                time.sleep(0.01)
            let_go.stops.append(False)
            try:
                return work(on_progress, should_stop)
            except InversionCancelled:
                let_go.stops[-1] = True
                raise

        fill(box, later)

    monkeypatch.setattr(_Mailbox, "fill", hold)
    return let_go


@pytest.fixture
def cancelled(wait, rest, qtbot, messages):
    """Press Run and Cancel, and check that the work ends and leaves nothing behind."""

    def check(tool, begun=lambda: True):
        layers = list(tool.viewer.layers)
        button = tool.panel.button
        usual = button.text()
        button.click()
        assert button.text() == "Cancel"
        wait(begun)
        button.click()
        assert (button.text(), button.isEnabled()) == ("Cancelling…", False)
        rest(tool)
        wait(lambda: not running_threads())
        qtbot.wait(50)
        assert (button.text(), button.isEnabled()) == (usual, True)
        assert tool.panel.status.text().startswith("Cancelled")
        assert tool.panel.bar.isHidden()
        assert list(tool.viewer.layers) == layers
        assert messages == []

    return check


@pytest.fixture
def choose(monkeypatch):
    """Answer the dialogs for a file with a path and the first filter."""
    from qtpy.QtWidgets import QFileDialog

    def answer(path):
        def ask(parent, title, proposal="", filters="", **_):
            return str(path), filters.split(";;")[0]

        monkeypatch.setattr(QFileDialog, "getSaveFileName", ask)
        monkeypatch.setattr(QFileDialog, "getOpenFileName", ask)

    return answer
