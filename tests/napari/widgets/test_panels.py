"""The run button with its bar: display during a run, and its cost."""

from __future__ import annotations

import itertools
import time

import pytest
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QDockWidget

from napari_shadowinv._napari.run import Run
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.errors import InputError

PATIENCE = 60_000  # ms


class Work:
    """Work of 200 steps, each of which reports its progress."""

    def __init__(self, total):
        self.total = total

    def __call__(self, on_progress, should_stop):
        for step in range(200):
            if should_stop():
                return
            on_progress(Progress("transport", step if self.total else 0, self.total, f"at {step}"))
            time.sleep(0.01)


@pytest.fixture
def panel(window, qtbot):
    run_panel = Run("Run", "Do it.")
    window.window.add_dock_widget(run_panel, name="work", area="right")
    qtbot.wait(500)
    return run_panel


def finish(panel, qtbot):
    qtbot.waitUntil(lambda: not panel.running, timeout=PATIENCE)


@pytest.mark.parametrize("total", [None, 200])
def test_a_run_seldom_makes_the_window_be_drawn(panel, window, qtbot, total):
    """Each composition of the canvas takes 20 ms of a core without a graphics card."""
    composed: list[str] = []  # the line of text at each composition
    canvas = window.window._qt_viewer.canvas.native
    canvas.aboutToCompose.connect(lambda: composed.append(panel.status.text()))
    texts: list[str] = []
    panel.progressed.connect(lambda _: texts.append(panel.status.text()))
    panel.start(Work(total))
    finish(panel, qtbot)
    assert len(texts) > 15
    # Bar and text change together, and are then laid out anew; a busy bar never rests.
    changes = sum(first != second for first, second in itertools.pairwise(["", *texts, ""]))
    assert len(composed) <= 6 * changes
    assert len({text for text in texts if "Solving the transport: at" in text}) >= 2
    assert panel.bar.maximum() > 0


def test_what_went_wrong_stays_until_the_next_run(panel, qtbot, messages):
    def mistaken(*_):
        raise InputError("the film has no grain: expected some; take another one")

    panel.start(mistaken)
    finish(panel, qtbot)
    qtbot.wait(700)
    status = panel.status
    assert status.text() == messages[0] == "The film has no grain: expected some; take another one"
    assert status.isVisible()
    assert status.wordWrap()
    assert status.textInteractionFlags() & Qt.TextInteractionFlag.TextSelectableByMouse
    assert "color" in status.styleSheet()
    panel.start(lambda *_: None)
    assert status.text() == "Starting…"
    assert status.styleSheet() == ""
    finish(panel, qtbot)
    assert not status.isVisible()


def test_docks_of_this_plugin_share_their_place_as_tabs(window, open_widget, qtbot):
    main = window.window._qt_window
    tools = [open_widget(name) for name in ("Invert", "Analyse", "Simulate")]
    docks = [next(d for d in main.findChildren(QDockWidget) if d.isAncestorOf(t)) for t in tools]
    qtbot.waitUntil(lambda: len(main.tabifiedDockWidgets(docks[0])) == 2, timeout=PATIENCE)
    assert set(main.tabifiedDockWidgets(docks[0])) == set(docks[1:])
    qtbot.waitUntil(tools[-1].isVisible, timeout=PATIENCE)  # the latest is in front
    assert tools[-1].height() > 0.7 * main.height()
    # Whoever puts one elsewhere finds it there when it is shown again.
    main.addDockWidget(Qt.DockWidgetArea.LeftDockWidgetArea, docks[0])
    docks[0].hide()
    docks[0].show()
    qtbot.wait(100)
    assert main.dockWidgetArea(docks[0]) == Qt.DockWidgetArea.LeftDockWidgetArea
    assert docks[1] not in main.tabifiedDockWidgets(docks[0])
