"""Results in a window: `ResultView` shows verdict and report, of a fit also its course."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from qtpy.QtCore import QSignalBlocker, Qt
from qtpy.QtWidgets import QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.fit_layers import alternative_layers, start_name
from napari_shadowinv._napari.jobs import Finished, FitJob, ImageJob, Refinement
from napari_shadowinv._napari.layer_metadata import Result, main_layers, result_of
from napari_shadowinv._napari.viewer_sync import show_caution
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets._qt import (
    ObjectiveCurve,
    column,
    timer,
    while_alive,
)
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers, place_inputs
from napari_shadowinv.facts import Fact, Headline, percent
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.preprocessing import Recipe

_REDRAW_MS = 500
_MIN_REDRAW_RATIO = 10  # interval over the time of a drawing


class ResultView(QWidget):
    """Verdict and report of a result; of a fit also its course and its other solutions.

    It follows the results of selected layers if their `content` is of one of these kinds; `said`
    returns warnings that stand elsewhere.
    """

    def __init__(
        self,
        tool: panels.ToolPanel,
        last: LastResults,
        content: type | tuple[type, ...],
        buttons: QWidget,
        said: Callable[[], str] = str,
    ) -> None:
        super().__init__()
        self._tool, self._last, self._content, self._said = tool, last, content, said
        self._job: FitJob | None = None
        self._result: Result[Any] | None = None
        self._recipe: Recipe | None = None  # that was run for the result, if it is the form's
        self.changes = forms.WrappingLabel()
        self._alternative = ResultLayers(tool.viewer, self)
        self.curve = ObjectiveCurve()
        self.verdict = panels.VerdictLine()
        self.solutions = forms.SteadyComboBox(
            tip="Alternative solutions from other starting points. Select one to show it next to "
            "the best."
        )
        self._solutions_row = forms.labelled("Solution", self.solutions)
        self.report = panels.ReportView()
        column(
            self, self.changes, self.verdict, self._solutions_row, self.curve, buttons, self.report
        )
        self._redraw_timer = timer(self, _REDRAW_MS, self._draw)
        self.solutions.currentIndexChanged.connect(self._show_alternative)
        # Also for runs that are cancelled, or refused before they start.
        tool.panel.button.clicked.connect(self.empty)
        tool.panel.started.connect(self._on_start)
        tool.panel.ended.connect(self._on_end)
        while_alive(self, tool.viewer.layers.selection, "active", self.follow)
        self.empty()

    def empty(self) -> None:
        """Clear the report of the last result; its layers stay."""
        self._result = self._recipe = None
        self.changes.show_text("")
        self.curve.empty()
        self.verdict.show_text("")
        self._solutions_row.setVisible(False)
        self.report.empty()

    def show_fit(self, job: FitJob, finished: Finished) -> ResultLayers:
        """Show the layers, verdict and report of a fit; return its layers."""
        fit, tool = finished.content, self._tool
        moved = place_inputs(tool.viewer, job)
        self.show_report(finished.result, job, fit.facts_with_names(job.names))
        self._alternative.show([])
        self._job = job
        self._list_solutions(fit)
        results = self._last.layers_for_next((job.image, job.name))
        results.show(main_layers(finished.layer_data, also=results.layer_keys), fit=moved)
        return results

    def show_report(
        self, result: Result[Any], job: ImageJob, facts: Sequence[Fact] | None = None
    ) -> None:
        """Show the verdict and report of a job's result; notify if it is doubtful."""
        headline = self._show(result, facts)
        self._recipe = None if isinstance(job, Refinement) else job.recipe
        if not headline.level.is_success:
            show_caution(str(headline))
        self._tool.reveal(self.verdict)

    def compare(self, recipe: Recipe) -> None:
        """Say so if the form's recipe is no longer that of the result."""
        is_other = self._recipe is not None and recipe != self._recipe
        self.changes.show_text("Changed since this result: press Run." if is_other else "")

    def show_preview(self, result: Result[Any]) -> None:
        self._result = result
        self.verdict.show_headline(result.content.headline, "Preview: ")

    def follow(self, _: Any = None) -> None:
        """Show the report of the result whose layer is selected, such as a layer from a file."""
        layer = self._tool.viewer.layers.selection.active
        result = None if layer is None else result_of(layer)
        if result is None or result is self._result or self._tool.panel.running:
            return
        if isinstance(result.content, self._content):
            self.empty()
            self._show(result)
            self._tool.reveal(self.verdict)

    def _show(self, result: Result[Any], facts: Sequence[Fact] | None = None) -> Headline:
        self._result, content, origins = result, result.content, result.origins.items()
        if isinstance(content, Inversion):
            content = content.in_units(result.setup)
        facts, said = facts or content.facts, self._said()
        self.verdict.show_headline(content.headline)
        warnings = [
            row for row in panels.warning_rows(facts) if row not in origins and row[1] not in said
        ]
        rows, details = (panels.fact_rows(facts, details=flag) for flag in (False, True))
        self.report.show_rows([*warnings, *origins, *rows], details)
        return content.headline

    def _list_solutions(self, fit: Fit) -> None:
        with QSignalBlocker(self.solutions):
            self.solutions.clear()
            best, *alternatives = fit.basins
            self.solutions.addItem(f"{start_name(best)}: best", 0)
            for number, basin in enumerate(alternatives, 1):
                excess = f"{100 * (basin.objective / best.objective - 1):+.1f} %"
                start, distance = start_name(basin), f"{percent(basin.distance)}"
                self.solutions.addItem(f"{start}: {excess}, differs by {distance}", number)
                tip = f"{start}: objective {excess}, displacement differs by {distance} (r.m.s.)"
                self.solutions.setItemData(number, tip, Qt.ItemDataRole.ToolTipRole)
        self._solutions_row.setVisible(len(fit.basins) > 1)

    def _show_alternative(self) -> None:
        number = self.solutions.currentData()
        if self._result is None or self._job is None or number is None:
            return
        layer_data = []
        if number:
            layer_data = alternative_layers(self._result, number, self._job.frame, self._job.name)
        self._alternative.show(layer_data, select=False)

    def _on_start(self) -> None:
        # The verdict of a preview stays until the next preview.
        if not self._tool.previewing:
            self.empty()
        if isinstance(self._tool.panel.tag, FitJob):
            self._redraw_timer.start()

    def _draw(self) -> None:
        job = self._tool.panel.tag
        if isinstance(job, FitJob):
            start = time.perf_counter()
            self.curve.show_steps(list(job.progress.history))
            # A slow screen must not delay the fit and the window.
            elapsed_ms = 1000 * (time.perf_counter() - start)
            self._redraw_timer.setInterval(max(_REDRAW_MS, round(_MIN_REDRAW_RATIO * elapsed_ms)))

    def _on_end(self, outcome: Any) -> None:
        self._redraw_timer.stop()
        if isinstance(outcome.tag, FitJob):
            self.curve.show_steps(list(outcome.tag.progress.history))
