"""Parts that several widgets have: the run button, progress, the report.

- start, cancel and watch: `RunPanel`
- how an inversion went: `ReportTable`, `report_rows`
- a part that can be folded away: `section`
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from napari.utils import progress as activity
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QProgressBar,
    QPushButton,
    QSizePolicy,
    QTableWidget,
    QTableWidgetItem,
    QVBoxLayout,
    QWidget,
)
from superqt import QCollapsible

from napari_shadowinv._napari.widgets._forms import PROBLEM_STYLE, wrapping_label
from napari_shadowinv._napari.widgets._lifetime import when_destroyed
from napari_shadowinv._napari.widgets._notifications import error_text, tell_error
from napari_shadowinv._napari.widgets._runner import Outcome, Runner, Work
from napari_shadowinv._system.progress import Progress

if TYPE_CHECKING:
    from napari_shadowinv.inversion import Inversion

__all__ = ["ReportTable", "RunPanel", "report_rows", "section"]

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
}


_LOOK_EVERY = 500  # ms
_SHOW_SECONDS_FROM = 2.0


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


class RunPanel(QWidget):
    """A button that runs and cancels, with a progress bar and a line of text.

    Whatever changes beside the canvas makes the whole window be drawn anew. Without a graphics
    card, an animated bar thus takes the processor that the work needs: the bar stands still
    between two looks, and napari's activity dock, which is animated, is used only while the
    panel cannot be seen.

    Parameters
    ----------
    what : str
        The name of the work, for the activity dock.
    run_text, run_tip : str
        What the button says, and its tooltip.
    **keywords
        More of `Runner`.
    """

    def __init__(self, what: str, run_text: str, run_tip: str, **keywords: float) -> None:
        super().__init__()
        self._what, self._run_text = what, run_text
        self.runner = Runner(self, **keywords)
        self.button = QPushButton(run_text)
        self.button.setToolTip(run_tip)
        self.bar = QProgressBar()
        self.bar.setTextVisible(False)
        self.bar.setFixedHeight(8)
        self.bar.setVisible(False)
        # Nothing of napari's or of the system's style animates a bar that has a range.
        self.bar.setRange(0, 1)
        self.status = wrapping_label()
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        for widget in (self.button, self.bar, self.status):
            column.addWidget(widget)
        self._activity = _Activity()
        self._quiet = False
        self._said = ("", False)
        self._news: Progress | None = None
        self._start = 0.0
        self._looking = QTimer(self)
        self._looking.setInterval(_LOOK_EVERY)
        self._looking.timeout.connect(self._look)
        self.runner.started.connect(self._on_start)
        self.runner.progressed.connect(self._on_progress)
        self.runner.ended.connect(self._on_end)
        when_destroyed(self, self._activity.close)

    def run(self, work: Work, tag: object = None, *, quiet: bool = False) -> None:
        """Begin some work.

        Parameters
        ----------
        work, tag
            See `Runner.start`.
        quiet : bool
            A preview: it neither shows its progress nor sends notifications.
        """
        self._quiet = quiet
        self.runner.start(work, tag)

    def cancel(self) -> None:
        """Ask the work to stop."""
        self.runner.cancel()
        if self.runner.running:
            self.button.setText("Cancelling…")
            self.button.setEnabled(False)
            self.say("")

    def say(self, text: str, problem: bool = False) -> None:
        """Show a line of text under the button."""
        # To draw a window with a canvas in it takes time: only if there is something new.
        if (text, problem) == self._said:
            return
        self._said = (text, problem)
        self.status.setText(text)
        self.status.setStyleSheet(PROBLEM_STYLE if problem else "")
        self.status.setVisible(bool(text))

    def refuse(self, error: BaseException) -> None:
        """Tell a mistake of the user's; it stands here when the notification is gone."""
        tell_error(error)
        self.say(error_text(error), problem=True)

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
        """Show the latest news."""
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
        text = f"{stage}: {news.message}" if news.message else f"{stage}…"
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
        self.say(error_text(outcome.error), problem=True)
        if not outcome.is_mistake:
            from napari.utils.notifications import notification_manager

            error = outcome.error
            notification_manager.receive_error(type(error), error, error.__traceback__)
        elif not self._quiet:
            tell_error(outcome.error)


def report_rows(inversion: Inversion) -> list[tuple[str, str]]:
    """How an inversion went, in two columns of text; warnings come last."""
    report = inversion.report
    stages = [(f"  {stage}", f"{seconds:.2f} s") for stage, seconds in report.seconds.items()]
    return [
        ("Converged", "yes" if report.converged else "NO"),
        ("Flux residual", f"{report.residual:.2g} (tolerance {report.tolerance:.2g})"),
        ("Image residual", f"{100 * report.image_residual:.3g} % of the mean, r.m.s."),
        ("Iterations", f"{report.iterations} on {len(report.levels)} levels"),
        ("Sites", f"{report.n_sites:,}"),
        ("Caustics", f"{inversion.caustic.mean():.2%} of the pixels"),
        ("Time", f"{sum(report.seconds.values()):.2f} s"),
        *stages,
        *[("Warning", text) for text in report.warnings],
    ]


class ReportTable(QTableWidget):
    """Rows of names and values, as high as they need."""

    def __init__(self) -> None:
        super().__init__(0, 2)
        self.horizontalHeader().setVisible(False)
        self.verticalHeader().setVisible(False)
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setShowGrid(False)
        self.setWordWrap(True)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        header = self.horizontalHeader()
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(1, QHeaderView.ResizeMode.Stretch)
        self.setVisible(False)

    def show_rows(self, rows: list[tuple[str, str]]) -> None:
        """Replace what is shown."""
        self.setRowCount(len(rows))
        for number, row in enumerate(rows):
            for column, text in enumerate(row):
                item = QTableWidgetItem(text)
                item.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop)
                item.setToolTip(text)
                self.setItem(number, column, item)
        self.setVisible(True)
        self._fit()

    def empty(self) -> None:
        """Show nothing."""
        self.setRowCount(0)
        self.setVisible(False)

    def texts(self) -> dict[str, str]:
        """What is shown, by name."""
        rows = range(self.rowCount())
        return {self.item(row, 0).text().strip(): self.item(row, 1).text() for row in rows}

    def resizeEvent(self, event: object) -> None:
        super().resizeEvent(event)
        self._fit()

    def _fit(self) -> None:
        self.resizeRowsToContents()
        self.setFixedHeight(self.verticalHeader().length() + 2 * self.frameWidth())


def section(title: str, *widgets: QWidget) -> QCollapsible:
    """Widgets under a title that folds them away; folded to begin with."""
    folded = QCollapsible(title, expandedIcon="▾", collapsedIcon="▸")
    folded.setDuration(0)
    folded.layout().setContentsMargins(0, 0, 0, 0)
    folded.layout().setSpacing(2)
    folded.content().layout().setContentsMargins(6, 2, 0, 4)
    for widget in widgets:
        folded.addWidget(widget)
    return folded
