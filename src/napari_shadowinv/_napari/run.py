"""A button that runs work in a thread: progress, cancelling, errors.

The thread leaves progress and outcome in a mailbox that a timer of the window polls: no signal
crosses threads, nothing reaches a closed window, and all Qt bindings behave alike.
"""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from napari.utils import cancelable_progress
from napari.utils.notifications import notification_manager
from qtpy import QtWidgets
from qtpy.QtCore import Signal

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.preferences import use_preferred_threads
from napari_shadowinv._napari.viewer_sync import USER_ERRORS, error_text, show_user_error
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.errors import InversionCancelled

Work = Callable[[OnProgress, ShouldStop], Any]

_STAGES = {
    "compile": "Compiling",
    "prepare": "Preparing the image",
    "sites": "Placing the sites",
    "transport": "Solving the transport",
    "read-out": "Computing the field",
    "source": "Estimating the source",
    "field": "Computing the field",
    "image": "Tracing the rays",
    "shots": "Inverting",
    "draws": "Simulating shots",
    "samples": "Drawing samples",
    "response": "Inverting random fields",
    "wait": "Waiting for shots",
    "fit": "Fitting",
    "read": "Reading the scans",
    "dose": "Computing the doses",
    "register": "Aligning the films",
    "unfold": "Unfolding the spectra",
}
_POLL_MS, _CROSS_POLL_MS = 10, 100
_SHOW_INTERVAL_S = 0.5  # of the progress
# Handling an event of the window may need the interpreter a dozen times: threads hand it over
# after this time instead of 5 ms.
_SWITCH_INTERVAL_S = 1e-3
_MIN_SHOWN_TIME_S = 2.0
_PATIENCE_S = 0.5


@dataclass(frozen=True)
class Outcome:
    """The end of some work; `tag` is the argument of `Run.start`."""

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
    shown_progress: Progress | None = None
    outcome: Outcome | None = None

    def fill(self, work: Work) -> None:
        """Do some work in the thread."""

        def on_progress(progress: Progress) -> None:
            self.progress = progress

        try:
            self.outcome = Outcome(work(on_progress, self.stop.is_set), tag=self.tag)
        except InversionCancelled:
            self.outcome = Outcome(cancelled=True, tag=self.tag)
        except Exception as error:
            self.outcome = Outcome(error=error, tag=self.tag)


def _stop(boxes: list[_Mailbox]) -> None:
    for box in boxes:
        box.stop.set()


class Run(QtWidgets.QWidget):
    """A button to run and cancel, with a progress bar and a line of text.

    It does one work at a time; cancelled work that does not stop is left alone after the `patience`
    of its tag (s).
    """

    # A change outside the canvas redraws the whole window. Without a graphics card, an animated bar
    # would slow the work down: this bar changes once a poll.

    started = Signal()
    progressed = Signal(object)
    ended = Signal(object)

    def __init__(self, text: str, tip: str) -> None:
        super().__init__()
        self._text = text
        self._box: _Mailbox | None = None
        self._pending: tuple[Work, Any, bool] | None = None
        self._to_stop: list[_Mailbox] = []
        self.button = QtWidgets.QPushButton(text, toolTip=tip)
        # A bar with a range is not animated by the style of napari or the system.
        self.bar = QtWidgets.QProgressBar(maximum=1, textVisible=False)
        self.bar.setFixedHeight(8)
        self.bar.setVisible(False)
        self.status = forms.WrappingLabel()
        qt.column(self, self.button, self.bar, self.status)
        self._quiet = False
        self._start_time = self._shown_at = 0.0
        self._timer = qt.timer(self, _POLL_MS, self._poll)
        # Closing a window stops its work; this object no longer exists then.
        qt.when_destroyed(self, partial(_stop, self._to_stop))

    @property
    def running(self) -> bool:
        return self._box is not None

    @property
    def tag(self) -> Any:
        """The tag of the running work, or None."""
        return None if self._box is None else self._box.tag

    def start(self, work: Work, tag: Any = None, *, quiet: bool = False) -> None:
        """Start some work once the running work has stopped; only the latest request waits.

        If `quiet`, it shows no progress and no notifications.
        """
        if self._box is not None:
            self._pending = (work, tag, quiet)
            self._box.stop.set()
            return
        box = self._box = _Mailbox(tag)
        self._quiet = quiet
        self._to_stop.append(box)
        use_preferred_threads()
        sys.setswitchinterval(min(sys.getswitchinterval(), _SWITCH_INTERVAL_S))
        if not quiet:
            self._show_start()  # napari handles events meanwhile
        threading.Thread(target=box.fill, args=(work,), name="shadowinv", daemon=False).start()
        self._timer.start()
        self.started.emit()

    def cancel(self) -> None:
        """Ask the work to stop, and drop the waiting work."""
        self._pending = None
        if self._box is not None:
            self._box.stop.set()
            patience = getattr(self._box.tag, "patience", _PATIENCE_S)
            self._box.detach_at = min(self._box.detach_at, time.monotonic() + patience)
            self.button.setText("Cancelling…")
            self.button.setEnabled(False)
            self.say("")

    def say(self, text: str, problem: bool = False) -> None:
        self.status.show_text(text, forms.PROBLEM_STYLE if problem else "")

    def _poll(self) -> None:
        box = self._box
        if box is None:
            return
        outcome, progress = box.outcome, box.progress
        if progress is not None and not box.stop.is_set():
            if progress is not box.shown_progress:
                box.shown_progress = progress
                self.progressed.emit(progress)
            if not self._quiet and time.monotonic() > self._shown_at + _SHOW_INTERVAL_S:
                self._show_progress(progress)
        if outcome is None:
            if time.monotonic() < box.detach_at:
                return
            outcome = Outcome(cancelled=True, tag=box.tag)
        self._timer.stop()
        self._box = None
        self._to_stop.clear()
        pending, self._pending = self._pending, None
        self._show_end(outcome)
        self.ended.emit(outcome)
        if pending is not None and self._box is None:
            work, tag, quiet = pending
            self.start(work, tag, quiet=quiet)

    def _show_start(self) -> None:
        self._start_time = self._shown_at = time.monotonic()
        self.button.setText("Cancel")
        self.bar.setRange(0, 1)
        self.bar.setValue(0)
        self.bar.setVisible(True)
        self.say("Starting…")

    def _show_progress(self, progress: Progress) -> None:
        self._shown_at = time.monotonic()
        stage = _STAGES.get(progress.stage, progress.stage)
        self.bar.setRange(0, progress.total or 1)
        self.bar.setValue(progress.step if progress.total else 0)
        text = f"{stage}: {progress.text}" if progress.text else f"{stage}…"
        seconds = self._shown_at - self._start_time
        self.say(f"{text} ({seconds:.0f} s)" if seconds >= _MIN_SHOWN_TIME_S else text)

    def _show_end(self, outcome: Outcome) -> None:
        self.bar.setVisible(False)
        self.button.setText(self._text)
        self.button.setEnabled(True)
        self.say("Cancelled." if outcome.cancelled and not self._quiet else "")
        error = outcome.error
        if error is None:
            return
        # A notification disappears after seconds: the error stays here until the next run.
        self.say(error_text(error), problem=True)
        if not isinstance(error, USER_ERRORS):
            notification_manager.receive_error(type(error), error, error.__traceback__)
        elif not self._quiet:
            show_user_error(error)


def run_in_background(task: str, work: Work, done: Callable[[Any], Any]) -> None:
    """Run some work, shown in napari's activity dock with a cross, until its window closes."""
    app: Any = QtWidgets.QApplication
    windows = [each for each in app.topLevelWidgets() if isinstance(each, QtWidgets.QMainWindow)]
    run, bar = Run("", ""), cancelable_progress(total=0, desc=task)
    active = app.activeWindow()  # perhaps a dialog
    run.setParent(max(windows, key=lambda each: (each is active, each.isVisible()), default=None))
    qt.when_destroyed(run, bar.close)

    def look_at_cross() -> None:
        if bar.is_canceled:
            run.cancel()

    qt.timer(run, _CROSS_POLL_MS, look_at_cross).start()

    def end(outcome: Outcome) -> None:
        run.deleteLater()
        if outcome.value is not None:
            done(outcome.value)

    run.ended.connect(end)
    run.start(work)
