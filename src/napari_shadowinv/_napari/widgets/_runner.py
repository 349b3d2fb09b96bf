"""Long work in a thread, while the window stays responsive: `Runner`, `Outcome`."""

# The thread leaves progress and outcome in a mailbox that a timer of the window polls: no signal
# crosses threads, nothing reaches a closed window, and all Qt bindings behave alike.

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

_POLL_MS = 10
_SWITCH_INTERVAL_S = 1e-3
_PATIENCE_S = 0.5


@dataclass(frozen=True)
class Outcome:
    """The end of some work; `tag` is the argument of `Runner.start`."""

    value: Any = None
    error: Exception | None = None
    cancelled: bool = False
    tag: Any = None


@dataclass
class _Mailbox:
    tag: Any = None
    detach_at: float = math.inf
    stop: threading.Event = field(default_factory=threading.Event)
    progress: Progress | None = None
    outcome: Outcome | None = None


class Runner(QObject):
    """Runs one task at a time in a thread; cancelled tasks are detached after `patience` (s)."""

    started = Signal()
    progressed = Signal(object)
    ended = Signal(object)

    def __init__(self, parent: QObject, patience: float = _PATIENCE_S) -> None:
        super().__init__(parent)
        self._patience = patience
        self._box: _Mailbox | None = None
        self._pending: tuple[Work, Any] | None = None
        self._to_stop: list[_Mailbox] = []
        # Closing a window stops its work; the runner no longer exists then.
        when_destroyed(self, partial(_stop, self._to_stop))
        self._timer = timer(self, _POLL_MS, self._poll)

    @property
    def running(self) -> bool:
        return self._box is not None

    @property
    def tag(self) -> Any:
        """The tag of the running work, or None."""
        return None if self._box is None else self._box.tag

    @property
    def cancelling(self) -> bool:
        """Whether the work has been asked to stop, with no other work waiting."""
        return self._box is not None and self._box.stop.is_set() and self._pending is None

    def start(self, work: Work, tag: Any = None) -> None:
        """Start some work once the running work has stopped; only the latest request waits."""
        if self._box is not None:
            self._pending = (work, tag)
            self._box.stop.set()
            return
        box = self._box = _Mailbox(tag)
        self._to_stop.append(box)
        threading.Thread(target=_run, args=(work, box), name="shadowinv", daemon=False).start()
        self._timer.start()
        self.started.emit()

    def cancel(self) -> None:
        """Ask the work to stop, and drop the waiting work."""
        self._pending = None
        box = self._box
        if box is not None:
            box.stop.set()
            box.detach_at = min(box.detach_at, time.monotonic() + self._patience)

    def _poll(self) -> None:
        box = self._box
        if box is None:
            return
        outcome, progress = box.outcome, box.progress
        if progress is not None:
            box.progress = None
            if not box.stop.is_set():
                self.progressed.emit(progress)
        if outcome is None:
            if time.monotonic() < box.detach_at:
                return
            outcome = Outcome(cancelled=True, tag=box.tag)
        self._timer.stop()
        self._box = None
        self._to_stop.clear()
        pending, self._pending = self._pending, None
        self.ended.emit(outcome)
        if pending is not None and self._box is None:
            self.start(*pending)


class _FastSwitching:
    """Makes threads hand over the interpreter after 1 ms instead of 5."""

    # Handling an event of the window may need the interpreter a dozen times.

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._entered = 0
        self._default_interval = 0.0

    def __enter__(self) -> None:
        with self._lock:
            if self._entered == 0:
                self._default_interval = sys.getswitchinterval()
                sys.setswitchinterval(min(self._default_interval, _SWITCH_INTERVAL_S))
            self._entered += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._entered -= 1
            if self._entered == 0:
                sys.setswitchinterval(self._default_interval)


_fast_switching = _FastSwitching()


def _stop(boxes: list[_Mailbox]) -> None:
    for box in boxes:
        box.stop.set()


def _run(work: Work, box: _Mailbox) -> None:
    def on_progress(progress: Progress) -> None:
        box.progress = progress

    try:
        with _fast_switching:
            outcome = Outcome(work(on_progress, box.stop.is_set), tag=box.tag)
    except InversionCancelled:
        outcome = Outcome(cancelled=True, tag=box.tag)
    except Exception as error:
        outcome = Outcome(error=error, tag=box.tag)
    box.outcome = outcome
