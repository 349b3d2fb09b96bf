"""Work in a thread: how it is stopped."""

from __future__ import annotations

import math
import threading
from types import SimpleNamespace

from napari_shadowinv._napari.run import Outcome, Run


class Heard(Run):
    """A button that remembers how its work ended."""

    def __init__(self, qtbot):
        super().__init__("Run", "")
        qtbot.addWidget(self)
        self.outcomes: list[Outcome] = []
        self.ended.connect(self.outcomes.append)


class Stubborn:
    """Work that checks whether to stop only when allowed to."""

    def __init__(self):
        self.may_look = threading.Event()
        self.stopped = threading.Event()

    def __call__(self, on_progress, should_stop):
        self.may_look.wait(30)
        if should_stop():
            self.stopped.set()
        return "late"


def test_work_that_does_not_stop_is_left_alone(qtbot):
    panel = Heard(qtbot)
    work = Stubborn()
    panel.start(work, tag="first")
    panel.cancel()
    qtbot.waitUntil(lambda: not panel.running, timeout=20_000)
    assert not work.may_look.is_set()
    assert panel.outcomes == [Outcome(cancelled=True, tag="first")]

    panel.start(lambda *_: "next", tag="second")
    work.may_look.set()
    assert work.stopped.wait(5)
    qtbot.waitUntil(lambda: not panel.running, timeout=5000)
    assert panel.outcomes[1:] == [Outcome("next", tag="second")]


def test_work_that_must_be_finished_is_waited_for(qtbot):
    panel = Heard(qtbot)
    work, job = Stubborn(), SimpleNamespace(patience=math.inf)
    panel.start(work, job)
    panel.cancel()
    qtbot.wait(800)
    assert panel.cancelling
    work.may_look.set()
    qtbot.waitUntil(lambda: not panel.running, timeout=5000)
    assert panel.outcomes == [Outcome("late", tag=job)]
