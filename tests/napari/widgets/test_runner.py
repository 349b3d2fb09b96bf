"""Work in a thread: how it is stopped."""

from __future__ import annotations

import math
import threading
from typing import Any

import pytest
from qtpy.QtWidgets import QWidget

from napari_shadowinv._napari.widgets._panels import Outcome, Runner


class Heard(Runner):
    """A runner that remembers how its work ended."""

    def __init__(self, window: QWidget, **keywords: float) -> None:
        super().__init__(window, **keywords)
        self.outcomes: list[Outcome] = []
        self.ended.connect(self.outcomes.append)


@pytest.fixture
def window(qtbot: Any) -> QWidget:
    widget = QWidget()
    qtbot.addWidget(widget)
    return widget


class Stubborn:
    """Work that checks whether to stop only when allowed to."""

    def __init__(self) -> None:
        self.may_look = threading.Event()
        self.stopped = threading.Event()

    def __call__(self, on_progress: Any, should_stop: Any) -> str:
        self.may_look.wait(30)
        if should_stop():
            self.stopped.set()
        return "late"


def test_work_that_does_not_stop_is_left_alone(window: QWidget, qtbot: Any) -> None:
    runner = Heard(window)
    work = Stubborn()
    runner.start(work, tag="first")
    runner.cancel()
    qtbot.waitUntil(lambda: not runner.running, timeout=20_000)
    assert not work.may_look.is_set()
    assert runner.outcomes == [Outcome(cancelled=True, tag="first")]

    runner.start(lambda *_: "next", tag="second")
    work.may_look.set()
    assert work.stopped.wait(5)
    qtbot.waitUntil(lambda: not runner.running, timeout=5000)
    assert runner.outcomes[1:] == [Outcome("next", tag="second")]


def test_work_that_must_be_finished_is_waited_for(window: QWidget, qtbot: Any) -> None:
    runner = Heard(window, patience=math.inf)
    work = Stubborn()
    runner.start(work)
    runner.cancel()
    qtbot.wait(800)
    assert runner.cancelling
    work.may_look.set()
    qtbot.waitUntil(lambda: not runner.running, timeout=5000)
    assert runner.outcomes == [Outcome("late")]
