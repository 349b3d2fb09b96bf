"""The frame of a widget: controls in a column, and the report below its button."""

from __future__ import annotations

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from qtpy import QtWidgets

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.jobs import Job
from napari_shadowinv._napari.run import Outcome, Run
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers
from napari_shadowinv.cautions import CAUTION_CODES
from napari_shadowinv.facts import Fact, Headline, Level

Rows = Sequence[tuple[str, str]]  # of a report: names and values

_LEVEL_STYLES = {
    Level.SOUND: "color: #2f9457;",
    Level.CONDITIONAL: "color: #4385c7;",
    Level.DOUBTFUL: forms.PROBLEM_STYLE,
    Level.FAILED: "color: #dc4c4c;",
}
_TITLE_WIDTH = "30%"
_SETTLE_MS = 10  # merges simultaneous changes


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


class ReportView(QtWidgets.QWidget):
    """Titles and texts in a column, to be read and copied; details are folded below."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: Rows = []  # with the details
        self._main, self._details = _Table(), _Table()
        self.details = forms.section("More", self._details)
        self._details.setVisible(True)
        qt.column(self, self._main, self.details)
        self.empty()

    def show_rows(self, rows: Rows, details: Rows = ()) -> None:
        self.rows = [*rows, *details]
        self._main.show_text(_table_html(rows))
        self._details.setText(_table_html(details))
        self.details.setVisible(bool(details))
        self.setVisible(bool(self.rows))

    def empty(self) -> None:
        self.show_rows([])


class _Table(forms.WrappingLabel):
    """Rows of rich text, as high as their width requires."""

    def setText(self, text: str) -> None:
        super().setText(text)
        self._fit()

    def resizeEvent(self, event: Any) -> None:
        super().resizeEvent(event)
        self._fit()

    def _fit(self) -> None:
        self.setMinimumHeight(max(self.heightForWidth(self.width()), 0))


def _table_html(rows: Rows) -> str:
    """Return a table of titles and texts, in which long names of files may wrap."""
    lines = []
    for row in rows:
        title, text = (re.sub(r"(?<=[/_.-])(?=\S{8})", "\u200b", html.escape(each)) for each in row)
        style = forms.PROBLEM_STYLE if title == "Warning" else ""
        cells = f'<td width="{_TITLE_WIDTH}">{title}&nbsp;</td><td>{text}</td>'
        lines.append(f'<tr style="{style}">{cells}</tr>')
    return f'<table cellspacing="2">{"".join(lines)}</table>' if lines else ""


class VerdictLine(forms.WrappingLabel):
    """A coloured line below Run with verdict, peak, and warnings in a few words."""

    def show_headline(self, headline: Headline, prefix: str = "") -> None:
        """Show a headline after a prefix, such as ``"Preview: "``."""
        title = f"{prefix}{headline.title.capitalize()}"
        self.show_titled(title, headline.text, _LEVEL_STYLES[headline.level])


class ToolPanel(qt.Docked):
    """A column of controls that scrolls vertically; its button runs the `request`."""

    def __init__(self, viewer: Any, name: str, panel: Run) -> None:
        super().__init__()
        self.viewer, self.panel = viewer, panel
        self._ready = False
        self.previewing = False  # the running job is a preview
        self.results = ResultLayers(viewer, self)
        self._last = LastResults(viewer, self)
        self.keep_earlier = self._last.keep_earlier
        self.area, self.column = qt.scrolling_column(self)
        self._keeper = qt.StateKeeper(self, name, self.state)
        self._revealed: QtWidgets.QWidget | None = None
        self._revealing = qt.timer(self, _SETTLE_MS, self._reveal, once=True)
        panel.button.clicked.connect(lambda: self._run_or_cancel())
        panel.ended.connect(self._on_end)

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

    @property
    def is_busy(self) -> bool:
        """Whether something else than a preview is running."""
        return self.panel.running and not self.previewing

    def request(self) -> Job:
        """Return the job of the controls, or raise an `InputError`."""
        raise NotImplementedError

    def forget(self) -> None:
        """Clear the report of the last run."""

    def show_result(self, finished: Any, job: Any) -> None:
        raise NotImplementedError

    def start(self, job: Job, *, preview: bool = False) -> None:
        """Do a job in the thread; a preview shows no progress."""
        self.previewing = preview
        self.panel.start(job.work, job, quiet=preview)

    @qt.notify_errors
    def _run_or_cancel(self) -> None:
        if self.is_busy:
            self.panel.cancel()
            return
        self.forget()
        self.start(self.request())

    @qt.notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        if outcome.value is not None:
            self.show_result(outcome.value, outcome.tag)
