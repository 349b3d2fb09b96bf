"""The frame of a widget: controls in a column, the run button, progress, the report."""

from __future__ import annotations

import html
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from napari.utils import progress as activity
from qtpy import QtWidgets
from qtpy.QtCore import QSize, Qt

from napari_shadowinv._napari.kinds import main_layers
from napari_shadowinv._napari.notifications import MISTAKES, window_text
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._forms import PROBLEM_STYLE, section, wrapping_label
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers
from napari_shadowinv._napari.widgets._runner import Outcome, Runner, Work
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.facts import Headline, Level
from napari_shadowinv.physics.units import shown_fields

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.inversion import Inversion

WIDTH = 330

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
    "wait": "Waiting for shots",
    "fit": "Fitting",
    "read": "Reading the scans",
    "dose": "Computing the doses",
    "register": "Aligning the films",
    "unfold": "Unfolding the spectra",
}
_LOOK_EVERY = 500  # ms
_SHOW_SECONDS_FROM = 2.0
_LEVEL_STYLES = {
    Level.SOUND: "color: #4caf72;",
    Level.DOUBTFUL: PROBLEM_STYLE,
    Level.FAILED: "color: #e05252;",
}
_SETTLE = 10  # ms; a few changes at once are one


class _Activity:
    """The bar of the current stage in napari's activity dock."""

    def __init__(self) -> None:
        self._bar: activity | None = None
        self._stage = ""

    def show(self, what: str, news: Progress) -> None:
        if self._bar is None or news.stage != self._stage or (news.total or 0) != self._bar.total:
            self.close()
            stage = _STAGES.get(news.stage, news.stage)
            self._bar = activity(total=news.total or 0, desc=f"{what}: {stage}")
            self._stage = news.stage
        if news.total and news.step > self._bar.n:
            self._bar.update(news.step - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class RunPanel(QtWidgets.QWidget):
    """A button that runs and cancels, with a progress bar and a line of text."""

    # A change beside the canvas redraws the whole window. Without a graphics card, an animated bar
    # takes the processor that the work needs: the bar stands still between two looks, and napari's
    # animated activity dock is used only while the panel cannot be seen.

    def __init__(self, what: str, run_text: str, run_tip: str, **keywords: float) -> None:
        super().__init__()
        self._what, self._run_text = what, run_text
        self.runner = Runner(self, **keywords)
        self.button = QtWidgets.QPushButton(run_text)
        self.button.setToolTip(run_tip)
        self.bar = QtWidgets.QProgressBar()
        self.bar.setTextVisible(False)
        self.bar.setFixedHeight(8)
        self.bar.setVisible(False)
        # Nothing of napari's or of the system's style animates a bar that has a range.
        self.bar.setRange(0, 1)
        self.status = wrapping_label()
        qt.column(self, self.button, self.bar, self.status)
        self._activity = _Activity()
        self._quiet, self._said = False, ("", False)
        self._news: Progress | None = None
        self._start = 0.0
        self._looking = qt.timer(self, _LOOK_EVERY, self._look)
        self.runner.started.connect(self._on_start)
        self.runner.progressed.connect(self._on_progress)
        self.runner.ended.connect(self._on_end)
        qt.when_destroyed(self, self._activity.close)

    def run(self, work: Work, tag: object = None, *, quiet: bool = False) -> None:
        """Begin some work; if quiet, it neither shows its progress nor sends notifications."""
        self._quiet = quiet
        self.runner.start(work, tag)

    def cancel(self) -> None:
        self.runner.cancel()
        if self.runner.running:
            self.button.setText("Cancelling…")
            self.button.setEnabled(False)
            self.say("")

    def say(self, text: str, problem: bool = False) -> None:
        # To draw a window with a canvas in it takes time: only if there is something new.
        if (text, problem) == self._said:
            return
        self._said = (text, problem)
        self.status.setText(text)
        self.status.setStyleSheet(PROBLEM_STYLE if problem else "")
        self.status.setVisible(bool(text))

    def refuse(self, error: BaseException) -> None:
        """Tell a mistake of the user's; it stands here when the notification is gone."""
        qt.tell_error(error)
        self.say(qt.error_text(error), problem=True)

    def _on_start(self) -> None:
        if self._quiet:
            return
        self._news, self._start = None, time.monotonic()
        self.button.setText("Cancel")
        self.bar.setRange(0, 1)
        self.bar.setValue(0)
        self.bar.setVisible(True)
        self.say("Starting…")
        self._looking.start()

    def _on_progress(self, news: Progress) -> None:
        self._news = news

    def _look(self) -> None:
        news = self._news
        if news is None or self.runner.cancelling:
            return
        if self.isVisible():
            self._activity.close()
        else:
            self._activity.show(self._what, news)
        self.bar.setRange(0, news.total or 1)
        self.bar.setValue(news.step if news.total else 0)
        stage = _STAGES.get(news.stage, news.stage)
        text = f"{stage}: {news.text}" if news.text else f"{stage}…"
        seconds = time.monotonic() - self._start
        self.say(f"{text} ({seconds:.0f} s)" if seconds >= _SHOW_SECONDS_FROM else text)

    def _on_end(self, outcome: Outcome) -> None:
        self._looking.stop()
        self._activity.close()
        self.bar.setVisible(False)
        if self.button.text() != self._run_text:
            self.button.setText(self._run_text)
            self.button.setEnabled(True)
        self.say("Cancelled." if outcome.cancelled and not self._quiet else "")
        if outcome.error is None:
            return
        # A notification is gone after seconds: what is wrong stays here until the next run.
        self.say(qt.error_text(outcome.error), problem=True)
        if not isinstance(outcome.error, MISTAKES):
            from napari.utils.notifications import notification_manager

            error = outcome.error
            notification_manager.receive_error(type(error), error, error.__traceback__)
        elif not self._quiet:
            qt.tell_error(outcome.error)


def report_rows(inversion: Inversion) -> list[tuple[str, str]]:
    """Describe an inversion in two columns of text; its warnings stand in the headline."""
    report = inversion.report
    return [
        ("Converged", "yes" if report.converged else "NO"),
        ("Image residual", image_residual_text(inversion)),
        *_error_rows(inversion),
        ("Caustics", f"{inversion.caustic.mean():.2%} of the pixels"),
    ]


def image_residual_text(inversion: Inversion) -> str:
    return f"{100 * inversion.report.image_residual:.3g} % of the mean, r.m.s."


def solver_rows(inversion: Inversion) -> list[tuple[str, str]]:
    """Describe the solver's work and its time, in two columns of text."""
    report = inversion.report
    stages = [(f"  {stage}", f"{seconds:.2f} s") for stage, seconds in report.seconds.items()]
    return [
        ("Sites", f"{report.n_sites:,}; {report.sites_reason}".removesuffix("; ")),
        ("Flux residual", f"{report.residual:.2g} (tolerance {report.tolerance:.2g})"),
        ("Iterations", f"{report.iterations} on {len(report.levels)} levels"),
        ("Time", f"{sum(report.seconds.values()):.2f} s"),
        *stages,
    ]


def _error_rows(inversion: Inversion) -> list[tuple[str, str]]:
    errors = inversion.errors
    if errors is None:
        return []
    (field,) = shown_fields([inversion.displacement], inversion.setup, mask=inversion.mask)
    told = [(name.capitalize(), text) for name, text in inversion.error_rows]
    return [("Field", field.peak_text(errors.of_peak)), *told]


class ReportTable(QtWidgets.QTableWidget):
    """Rows of names and values, as high as they need."""

    def __init__(self) -> None:
        super().__init__(0, 2)
        self.horizontalHeader().setVisible(False)
        self.verticalHeader().setVisible(False)
        self.setEditTriggers(QtWidgets.QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setShowGrid(False)
        self.setWordWrap(True)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Fixed)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QtWidgets.QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(1, QtWidgets.QHeaderView.ResizeMode.Stretch)
        self.setVisible(False)

    def show_rows(self, rows: list[tuple[str, str]]) -> None:
        self.setRowCount(len(rows))
        for row, texts in enumerate(rows):
            for place, text in enumerate(texts):
                item = QtWidgets.QTableWidgetItem(text)
                item.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
                item.setToolTip(text)
                self.setItem(row, place, item)
        self.setVisible(True)
        self._fit()

    def empty(self) -> None:
        self.setRowCount(0)
        self.setVisible(False)

    def texts(self) -> dict[str, str]:
        rows = range(self.rowCount())
        return {self.item(row, 0).text().strip(): self.item(row, 1).text() for row in rows}

    def resizeEvent(self, event: object) -> None:
        super().resizeEvent(event)
        self._fit()

    def _fit(self) -> None:
        self.resizeRowsToContents()
        self.setFixedHeight(self.verticalHeader().length() + 2 * self.frameWidth())


class FoldedReport(QtWidgets.QWidget):
    """A report whose last rows, on the solver and its time, are folded away."""

    def __init__(self) -> None:
        super().__init__()
        self.table, self._details = ReportTable(), ReportTable()
        self.details = section("Solver and timing", self._details)
        self.details.toggled.connect(lambda _: self._details.setVisible(True))
        qt.column(self, self.table, self.details)
        self.empty()

    def show_rows(
        self, rows: list[tuple[str, str]], details: list[tuple[str, str]] | None = None
    ) -> None:
        self.table.show_rows(rows)
        self._details.show_rows(details or [])
        self.details.setVisible(bool(details))
        self.setVisible(True)

    def empty(self) -> None:
        self.table.empty()
        self._details.empty()
        self.setVisible(False)

    def texts(self) -> dict[str, str]:
        return self.table.texts() | self._details.texts()


class VerdictLine(QtWidgets.QLabel):
    """A coloured line under Run with the level of trust, the warnings, and the peak."""

    def __init__(self) -> None:
        super().__init__()
        self.setWordWrap(True)
        self.setSizePolicy(
            QtWidgets.QSizePolicy.Policy.Ignored, QtWidgets.QSizePolicy.Policy.Minimum
        )
        self.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        self.empty()

    def show_headline(self, headline: Headline, before: str = "") -> None:
        """Show a headline; `before` says whose it is, such as a preview's."""
        level = headline.level.value.capitalize()
        text = html.escape(window_text(headline.text))
        self.setText(f"<b>{html.escape(before)}{level}</b><br>{text[:1].upper()}{text[1:]}")
        self.setStyleSheet(_LEVEL_STYLES[headline.level])
        self.setVisible(True)

    def empty(self) -> None:
        self.clear()
        self.setVisible(False)


class ToolPanel(qt.Docked):
    """A column of controls that scrolls down only; its button runs what `request` describes."""

    def __init__(self, viewer: Any, name: str, panel: RunPanel) -> None:
        super().__init__()
        self.viewer, self.panel = viewer, panel
        self._ready = False
        self._running_preview = False
        content = QtWidgets.QWidget()
        self.column = qt.column(content, margin=6)
        self.column.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.area = QtWidgets.QScrollArea()
        self.area.setWidgetResizable(True)
        self.area.setFrameShape(QtWidgets.QFrame.Shape.NoFrame)
        self.area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.area.setWidget(content)
        qt.column(self, self.area)
        self.setMinimumWidth(WIDTH)
        self.setSizePolicy(
            QtWidgets.QSizePolicy.Policy.Preferred, QtWidgets.QSizePolicy.Policy.Expanding
        )
        self._keeper = qt.StateKeeper(self, name, self.state)
        self._revealed: QtWidgets.QWidget | None = None
        self._revealing = qt.timer(self, _SETTLE, self._reveal, once=True)
        panel.button.clicked.connect(lambda: self._run_or_cancel())
        panel.runner.ended.connect(self._on_end)

    def reveal(self, widget: QtWidgets.QWidget) -> None:
        """Scroll to a widget once the column has its new heights."""
        self._revealed = widget
        self._revealing.start()

    def _reveal(self) -> None:
        if self._revealed is not None:
            self.area.ensureWidgetVisible(self._revealed)

    def sizeHint(self) -> QSize:
        return QSize(WIDTH + 30, 600)

    def show_problem(self, text: str) -> None:
        """Show what is wrong, where it can be read until the next run."""
        self.panel.say(text, problem=True)

    def add(self, *rows: QtWidgets.QWidget) -> None:
        for row in rows:
            self.column.addWidget(row)

    # What is kept between sessions, made of what JSON knows

    def parts(self) -> dict[str, Any]:
        """The controls whose states are kept, by name: with methods `state` and `restore`."""
        return {}

    def state(self) -> dict[str, Any]:
        return {name: part.state() for name, part in self.parts().items()}

    def restore(self, kept: Mapping[str, Any]) -> None:
        for name, part in self.parts().items():
            if name in kept:
                part.restore(kept[name])

    def restore_last(self) -> None:
        self.restore(self._keeper.load())

    def keep(self) -> None:
        """The state has changed: write it soon."""
        if self._ready:
            self._keeper.changed()

    def hideEvent(self, event: Any) -> None:
        if self._ready:
            self._keeper.write()
        super().hideEvent(event)

    # A run

    def request(self) -> Any:
        """What the controls ask for, with a method `run`; or an `InputError`."""
        raise NotImplementedError

    def forget(self) -> None:
        """Take away what was said of the last run."""

    def show_result(self, value: Any, request: Any) -> None:
        raise NotImplementedError

    def _run_or_cancel(self) -> None:
        if self.panel.runner.running and not self._running_preview:
            self.panel.cancel()
            return
        self.forget()
        try:
            request = self.request()
        except MISTAKES as error:
            self.panel.refuse(error)
            return
        self._running_preview = False
        self.panel.run(request.run, request)

    @qt.notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is not None:
            self.show_result(outcome.value, outcome.tag)


class LivePanel(ToolPanel):
    """A panel that also shows a preview after each change; a run of its button goes before."""

    def __init__(self, viewer: Any, name: str, panel: RunPanel) -> None:
        super().__init__(viewer, name, panel)
        self.live = QtWidgets.QCheckBox("Live preview")
        self.previewed = ResultLayers(viewer, self)
        self._last = LastResults(viewer, self)
        self.keep_earlier = self._last.keep_earlier
        self._settle = qt.timer(self, _SETTLE, self._preview, once=True)
        self.live.toggled.connect(self.on_change)

    def request(self, preview: bool = False) -> Any:
        raise NotImplementedError

    def show_layers(
        self, shot: Any, described: Sequence[FullLayerData], preview: bool, fit: bool = False
    ) -> None:
        """Show layers of a preview, or instead of them those of what the button has run."""
        if preview:
            self.previewed.show(described, select=False, fit=fit)
            return
        self.previewed.hide()
        self.results = self._last.next_of(shot)
        self.results.show(main_layers(described, also=self.results.slots), fit=fit)

    def on_change(self) -> None:
        """Something that the result depends on has changed."""
        self.keep()
        if self._ready and self.live.isChecked():
            self._settle.start()

    def showEvent(self, event: Any) -> None:
        super().showEvent(event)
        if self._ready and self.live.isChecked():
            self._settle.start()

    def _preview(self) -> None:
        busy = self.panel.runner.running and not self._running_preview
        if busy or not self.isVisible():
            return
        try:
            request = self.request(preview=True)
        except MISTAKES as error:
            # Half a rectangle, half a number: no reason for a notification.
            self.panel.say(str(error), problem=True)
            return
        self._running_preview = True
        self.panel.run(request.run, request, quiet=True)
