"""The frame of a widget: controls in a column, run button, progress and report."""

from __future__ import annotations

import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from napari.utils import progress as activity
from napari.utils.notifications import notification_manager
from qtpy import QtWidgets
from qtpy.QtCore import QObject, Qt, Signal

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.jobs import Job
from napari_shadowinv._napari.layer_metadata import main_layers
from napari_shadowinv._napari.layers import FullLayerData
from napari_shadowinv._napari.preferences import use_preferred_threads
from napari_shadowinv._napari.viewer_sync import USER_ERRORS, error_text, show_user_error
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.cautions import CAUTION_CODES
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.facts import Fact, Headline, Level

# The thread leaves progress and outcome in a mailbox that a timer of the window polls: no signal
# crosses threads, nothing reaches a closed window, and all Qt bindings behave alike.


Work = Callable[[OnProgress, ShouldStop], Any]
Rows = Sequence[tuple[str, str]]  # of a report: names and values

_MAILBOX_POLL_MS = 10
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
        qt.when_destroyed(self, partial(_stop, self._to_stop))
        self._timer = qt.timer(self, _MAILBOX_POLL_MS, self._poll)

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
        use_preferred_threads()
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
_POLL_MS = 500
_MIN_SHOWN_TIME_S = 2.0
_LEVEL_STYLES = {
    Level.SOUND: "color: #4caf72;",
    Level.CONDITIONAL: "color: #5b9bd5;",
    Level.DOUBTFUL: forms.PROBLEM_STYLE,
    Level.FAILED: "color: #e05252;",
}
_ROW_SPACING_PX = 4
_SETTLE_MS = 10  # merges simultaneous changes


class _Activity:
    """The bar of the current stage in napari's activity dock."""

    def __init__(self) -> None:
        self._bar: activity | None = None
        self._stage = ""

    def show(self, task: str, progress: Progress) -> None:
        total = progress.total or 0
        if self._bar is None or progress.stage != self._stage or total != self._bar.total:
            self.close()
            stage = _STAGES.get(progress.stage, progress.stage)
            self._bar = activity(total=total, desc=f"{task}: {stage}")
            self._stage = progress.stage
        if progress.total and progress.step > self._bar.n:
            self._bar.update(progress.step - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class RunPanel(QtWidgets.QWidget):
    """A button to run and cancel, with a progress bar and a line of text."""

    # A change outside the canvas redraws the whole window. Without a graphics card, an animated bar
    # would slow the work down: this bar changes once a poll, and napari's animated activity dock is
    # used only while the panel is hidden.

    def __init__(self, task: str, run_text: str, run_tip: str, **keywords: float) -> None:
        super().__init__()
        self._task, self._run_text = task, run_text
        self.runner = Runner(self, **keywords)
        self.button = QtWidgets.QPushButton(run_text, toolTip=run_tip)
        # A bar with a range is not animated by the style of napari or the system.
        self.bar = QtWidgets.QProgressBar(maximum=1, textVisible=False)
        self.bar.setFixedHeight(8)
        self.bar.setVisible(False)
        self.status = forms.WrappingLabel()
        qt.column(self, self.button, self.bar, self.status)
        self._activity = _Activity()
        self._quiet = False
        self._progress: Progress | None = None
        self._start = 0.0
        self._poll_timer = qt.timer(self, _POLL_MS, self._show_progress)
        self.runner.started.connect(self._on_start)
        self.runner.progressed.connect(self._on_progress)
        self.runner.ended.connect(self._on_end)
        qt.when_destroyed(self, self._activity.close)

    def run(self, work: Work, tag: object = None, *, quiet: bool = False) -> None:
        """Start some work; if `quiet`, without progress and notifications."""
        self._quiet = quiet
        self.runner.start(work, tag)

    def cancel(self) -> None:
        self.runner.cancel()
        if self.runner.running:
            self.button.setText("Cancelling…")
            self.button.setEnabled(False)
            self.say("")

    def say(self, text: str, problem: bool = False) -> None:
        self.status.show_text(text, forms.PROBLEM_STYLE if problem else "")

    def _on_start(self) -> None:
        if self._quiet:
            return
        self._progress, self._start = None, time.monotonic()
        self.button.setText("Cancel")
        self.bar.setRange(0, 1)
        self.bar.setValue(0)
        self.bar.setVisible(True)
        self.say("Starting…")
        self._poll_timer.start()

    def _on_progress(self, progress: Progress) -> None:
        self._progress = progress

    def _show_progress(self) -> None:
        progress = self._progress
        if progress is None or self.runner.cancelling:
            return
        if self.isVisible():
            self._activity.close()
        else:
            self._activity.show(self._task, progress)
        self.bar.setRange(0, progress.total or 1)
        self.bar.setValue(progress.step if progress.total else 0)
        stage = _STAGES.get(progress.stage, progress.stage)
        text = f"{stage}: {progress.text}" if progress.text else f"{stage}…"
        seconds = time.monotonic() - self._start
        self.say(f"{text} ({seconds:.0f} s)" if seconds >= _MIN_SHOWN_TIME_S else text)

    def _on_end(self, outcome: Outcome) -> None:
        self._poll_timer.stop()
        self._activity.close()
        self.bar.setVisible(False)
        if self.button.text() != self._run_text:
            self.button.setText(self._run_text)
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


def fact_rows(facts: Iterable[Fact], *, details: bool = False) -> list[tuple[str, str]]:
    """Return facts as rows: those of the report, or the `details`.

    Warnings have rows of their own: `warning_rows`.
    """
    return [
        (fact.title, fact.text)
        for fact in facts
        if details == fact.is_detail and fact.key not in CAUTION_CODES
    ]


def warning_rows(facts: Iterable[Fact]) -> list[tuple[str, str]]:
    """Return the warnings among facts as rows, without the verdict in the line above."""
    codes = CAUTION_CODES.keys() - {"verdict"}
    return [(fact.title, fact.text) for fact in facts if fact.key in codes]


class ReportTable(QtWidgets.QTableWidget):
    """A table of names and values, as high as its rows."""

    def __init__(self) -> None:
        super().__init__(0, 2, showGrid=False, wordWrap=True)
        self.horizontalHeader().setVisible(False)
        self.verticalHeader().setVisible(False)
        self.verticalHeader().setMinimumSectionSize(1)
        self.setEditTriggers(QtWidgets.QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Fixed)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QtWidgets.QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(1, QtWidgets.QHeaderView.ResizeMode.Stretch)
        self.setVisible(False)

    def show_rows(self, rows: Rows) -> None:
        self.setRowCount(len(rows))
        for row, texts in enumerate(rows):
            for column, text in enumerate(texts):
                item = QtWidgets.QTableWidgetItem(text)
                item.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
                item.setToolTip(text)
                if texts[0] == "Warning":
                    item.setForeground(forms.PROBLEM_COLOUR)
                self.setItem(row, column, item)
        self.setVisible(True)
        self._fit()

    def empty(self) -> None:
        self.setRowCount(0)
        self.setVisible(False)

    def resizeEvent(self, event: object) -> None:
        super().resizeEvent(event)
        self._fit()

    def _fit(self) -> None:
        self.resizeRowsToContents()
        for row in range(self.rowCount()):
            self.setRowHeight(row, self.rowHeight(row) + _ROW_SPACING_PX)
        self.setFixedHeight(self.verticalHeader().length() + 2 * self.frameWidth())


class FoldedReport(QtWidgets.QWidget):
    """A report with a folded section on the solver and its timing."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self._details = ReportTable(), ReportTable()
        self.details = forms.section("More", self._details)
        self.details.toggled.connect(lambda _: self._details.setVisible(True))
        qt.column(self, self.table, self.details)
        self.empty()

    def show_rows(self, rows: Rows, details: Rows) -> None:
        self.table.show_rows(rows)
        self._details.show_rows(details)
        self.details.setVisible(bool(details))
        self.setVisible(True)

    def empty(self) -> None:
        self.table.empty()
        self._details.empty()
        self.setVisible(False)


class VerdictLine(forms.WrappingLabel):
    """A coloured line below Run with verdict, peak, and warnings in a few words."""

    def show_headline(self, headline: Headline, prefix: str = "") -> None:
        """Show a headline after a prefix, such as ``"Preview: "``."""
        title = f"{prefix}{headline.title.capitalize()}"
        self.show_titled(title, headline.text, _LEVEL_STYLES[headline.level])


class ToolPanel(qt.Docked):
    """A column of controls that scrolls vertically; its button runs the `request`."""

    def __init__(self, viewer: Any, name: str, panel: RunPanel) -> None:
        super().__init__()
        self.viewer, self.panel = viewer, panel
        self._ready = False
        self._running_preview = False
        self.results = ResultLayers(viewer, self)
        self._last = LastResults(viewer, self)
        self.keep_earlier = self._last.keep_earlier
        self.area, self.column = qt.scrolling_column(self)
        self._keeper = qt.StateKeeper(self, name, self.state)
        self._revealed: QtWidgets.QWidget | None = None
        self._revealing = qt.timer(self, _SETTLE_MS, self._reveal, once=True)
        panel.button.clicked.connect(lambda: self._run_or_cancel())
        panel.runner.ended.connect(self._on_end)

    def reveal(self, widget: QtWidgets.QWidget) -> None:
        """Scroll to a widget once the column has been laid out."""
        self._revealed = widget
        self._revealing.start()

    def _reveal(self) -> None:
        if self._revealed is not None:
            self.area.ensureWidgetVisible(self._revealed)

    def show_problem(self, text: str) -> None:
        """Show a problem until the next run."""
        self.panel.say(text, problem=True)

    def add(self, *rows: QtWidgets.QWidget) -> None:
        for row in rows:
            self.column.addWidget(row)

    def parts(self) -> dict[str, Any]:
        """Return the controls with a saved state, by name; they have `state` and `restore`."""
        return {}

    def state(self) -> dict[str, Any]:
        """Return the state that is saved between sessions, as JSON values."""
        return {name: part.state() for name, part in self.parts().items()}

    def restore(self, state: Mapping[str, Any]) -> None:
        for name, part in self.parts().items():
            if name in state:
                # A part with an unreadable state keeps its defaults; the others are restored.
                with suppress(*qt.UNREADABLE):
                    part.restore(state[name])

    def restore_last(self) -> None:
        self._keeper.restore(self.restore)

    def keep(self) -> None:
        """Save the changed state soon."""
        if self._ready:
            self._keeper.changed()

    def hideEvent(self, event: Any) -> None:
        if self._ready:
            self._keeper.write()
        super().hideEvent(event)

    def request(self) -> Job:
        """Return the job of the controls, or raise an `InputError`."""
        raise NotImplementedError

    def forget(self) -> None:
        """Clear the report of the last run."""

    def show_result(self, finished: Any, job: Any) -> None:
        raise NotImplementedError

    def start(self, job: Job, *, preview: bool = False) -> None:
        """Do a job in the thread; a preview shows no progress."""
        self._running_preview = preview
        self.panel.run(job.work, job, quiet=preview)

    @qt.notify_errors
    def _run_or_cancel(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            self.panel.cancel()
            return
        self.forget()
        self.start(self.request())

    @qt.notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is not None:
            self.show_result(outcome.value, outcome.tag)


class LivePanel(ToolPanel):
    """A panel that can also show a preview after each change; the button's run has priority."""

    def __init__(self, viewer: Any, name: str, panel: RunPanel) -> None:
        super().__init__(viewer, name, panel)
        self.live = QtWidgets.QCheckBox("Live preview")
        self.previewed = ResultLayers(viewer, self)
        self._preview_timer = qt.timer(self, _SETTLE_MS, self._preview, once=True)
        self.live.toggled.connect(self.on_change)

    def request(self, preview: bool = False) -> Job:
        raise NotImplementedError

    def show_layers(
        self, shot: Any, layer_data: Sequence[FullLayerData], preview: bool, fit: bool = False
    ) -> None:
        """Show the layers of a preview, or hide them and show the layers of a run."""
        if preview:
            self.previewed.show(layer_data, select=False, fit=fit)
            return
        self.previewed.hide()
        self.results = self._last.layers_for_next(shot)
        self.results.show(main_layers(layer_data, also=self.results.layer_keys), fit=fit)

    def on_change(self) -> None:
        """Save the state and update the preview after a change of the inputs."""
        self.keep()
        if self._ready and self.live.isChecked():
            self._preview_timer.start()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._ready and self.live.isChecked():
            self._preview_timer.start()

    def _preview(self) -> None:
        is_busy = self.panel.runner.running and not self._running_preview
        if is_busy or not self.isVisible():
            return
        try:
            job = self.request(preview=True)
        except USER_ERRORS as error:
            # An unfinished rectangle or number is no reason for a notification.
            self.panel.say(str(error), problem=True)
            return
        self.start(job, preview=True)
