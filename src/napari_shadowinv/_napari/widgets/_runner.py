"""Long work beside a responsive window: `Runner`, `Outcome`."""

# The thread leaves progress and outcome in a letter box that a timer of the window looks into:
# no signal crosses threads, nothing reaches a closed window, and all Qt bindings behave alike.

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from qtpy.QtCore import QObject, Signal

from napari_shadowinv._napari.widgets._qt import timer, when_destroyed
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.errors import InversionCancelled

Work = Callable[[OnProgress, ShouldStop], Any]

_LOOK_EVERY = 10  # ms
_SHORT_TURN = 1e-3  # s
_PATIENCE = 0.5  # s


@dataclass(frozen=True)
class Outcome:
    """How some work ended; `tag` is what `Runner.start` was given to remember."""

    value: Any = None
    error: Exception | None = None
    cancelled: bool = False
    tag: Any = None


@dataclass
class _LetterBox:
    tag: Any = None
    give_up_at: float = math.inf
    stop: threading.Event = field(default_factory=threading.Event)
    progress: Progress | None = None
    outcome: Outcome | None = None


class Runner(QObject):
    """One piece of work at a time in a thread; it has `patience` (s) to stop when cancelled."""

    started = Signal()
    progressed = Signal(object)
    ended = Signal(object)

    def __init__(self, parent: QObject, patience: float = _PATIENCE) -> None:
        super().__init__(parent)
        self._patience = patience
        self._box: _LetterBox | None = None
        self._pending: tuple[Work, Any] | None = None
        self._to_stop: list[_LetterBox] = []
        # A window that is closed takes its work with it; the runner is gone by then.
        when_destroyed(self, partial(_stop, self._to_stop))
        self._timer = timer(self, _LOOK_EVERY, self._look)

    @property
    def running(self) -> bool:
        return self._box is not None

    @property
    def tag(self) -> Any:
        """What came with the work that is being done; None without any."""
        return None if self._box is None else self._box.tag

    @property
    def cancelling(self) -> bool:
        """Whether the work has been asked to stop, and nothing waits to follow it."""
        return self._box is not None and self._box.stop.is_set() and self._pending is None

    def start(self, work: Work, tag: Any = None) -> None:
        """Begin some work; what is running is asked to stop first, and only the latest waits."""
        if self._box is not None:
            self._pending = (work, tag)
            self._box.stop.set()
            return
        box = self._box = _LetterBox(tag)
        self._to_stop.append(box)
        threading.Thread(target=_run, args=(work, box), name="shadowinv", daemon=False).start()
        self._timer.start()
        self.started.emit()

    def cancel(self) -> None:
        """Ask the work to stop, and forget what waits."""
        self._pending = None
        box = self._box
        if box is not None:
            box.stop.set()
            box.give_up_at = min(box.give_up_at, time.monotonic() + self._patience)

    def _look(self) -> None:
        box = self._box
        if box is None:
            return
        outcome, news = box.outcome, box.progress
        if news is not None:
            box.progress = None
            if not box.stop.is_set():
                self.progressed.emit(news)
        if outcome is None:
            if time.monotonic() < box.give_up_at:
                return
            outcome = Outcome(cancelled=True, tag=box.tag)
        self._timer.stop()
        self._box = None
        self._to_stop.clear()
        pending, self._pending = self._pending, None
        self.ended.emit(outcome)
        if pending is not None and self._box is None:
            self.start(*pending)


class _Courtesy:
    """While entered, a thread hands over the interpreter after 1 ms instead of 5."""

    # Only the kernels do without it, and a window's event may ask for it a dozen times.

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entered = 0
        self._usual = 0.0

    def __enter__(self) -> None:
        with self._lock:
            if self._entered == 0:
                self._usual = sys.getswitchinterval()
                sys.setswitchinterval(min(self._usual, _SHORT_TURN))
            self._entered += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._entered -= 1
            if self._entered == 0:
                sys.setswitchinterval(self._usual)


_courtesy = _Courtesy()


def _stop(boxes: list[_LetterBox]) -> None:
    for box in boxes:
        box.stop.set()


def _run(work: Work, box: _LetterBox) -> None:
    def on_progress(progress: Progress) -> None:
        box.progress = progress

    try:
        with _courtesy:
            outcome = Outcome(work(on_progress, box.stop.is_set), tag=box.tag)
    except InversionCancelled:
        outcome = Outcome(cancelled=True, tag=box.tag)
    except Exception as error:
        outcome = Outcome(error=error, tag=box.tag)
    box.outcome = outcome
