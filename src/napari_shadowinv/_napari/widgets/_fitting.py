"""Fits in a window: `RefineSection` starts a fit, `FitView` shows its progress and verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from napari.utils.notifications import show_warning
from qtpy.QtCore import QSignalBlocker, Qt
from qtpy.QtWidgets import QDoubleSpinBox, QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari.fit_layers import alternative_layers, start_name
from napari_shadowinv._napari.jobs import Finished, FitJob
from napari_shadowinv._napari.layer_metadata import Result, main_layers, result_of
from napari_shadowinv._napari.run import Run
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets._qt import ObjectiveCurve, column, push_button, timer
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers, place_inputs
from napari_shadowinv.facts import Fact, percent
from napari_shadowinv.fitting import Fit

_REDRAW_MS = 500
_MIN_REDRAW_RATIO = 10  # interval over the time of a drawing
_MAX_BLUR_PX = 100.0


class RefineSection(QWidget):
    """Folded controls to refine an inversion; `refine` gets the blur's σ in px."""

    def __init__(self, refine: Callable[[float], None]) -> None:
        super().__init__()
        tip = (
            "<qt>Standard deviation of the image's blur from source size and detector, in pixels "
            "of the object plane.</qt>"
        )
        self.psf = QDoubleSpinBox(maximum=_MAX_BLUR_PX, singleStep=0.1, suffix=" px", toolTip=tip)
        self.psf.setSpecialValueText("none")
        self.button = push_button(
            "Refine",
            "Fit the forward model to the image, starting from its last inversion. The fit "
            "includes blur, gives error bars, and works beyond the first caustic. The verdict "
            "says whether the image determines the field.",
            lambda: refine(self.psf.value()),
        )
        blur = forms.labelled("Blur σ", self.psf)
        self.folded = forms.section("Refine the result", blur, self.button)
        column(self, self.folded)


class FitView(QWidget):
    """The objective of a running fit; then its verdict, report and alternative solutions."""

    def __init__(self, viewer: Any, panel: Run) -> None:
        super().__init__()
        self._viewer, self._panel = viewer, panel
        self._job: FitJob | None = None
        self._result: Result[Any] | None = None
        self._alternative = ResultLayers(viewer, self)
        self.results = ResultLayers(viewer, self)
        self.curve = ObjectiveCurve()
        self.verdict = panels.VerdictLine()
        self.solutions = forms.SteadyComboBox(
            tip="Alternative solutions from other starting points. Select one to show it next to "
            "the best."
        )
        self._solutions_row = forms.labelled("Solution", self.solutions)
        self.report = panels.ReportView()
        column(self, self.verdict, self._solutions_row, self.curve, self.report)
        self._redraw_timer = timer(self, _REDRAW_MS, self._draw)
        self.solutions.currentIndexChanged.connect(self._show_alternative)
        panel.started.connect(self._on_start)
        panel.ended.connect(self._on_end)
        self.empty()

    def empty(self) -> None:
        """Clear the report of the last fit; its layers stay."""
        self._result = None
        self.curve.empty()
        self.verdict.setVisible(False)
        self._solutions_row.setVisible(False)
        self.report.empty()

    def show_result(self, job: FitJob, finished: Finished, last: LastResults) -> None:
        """Show the layers, verdict and report of a fit; notify if the field is doubtful."""
        fit = finished.content
        moved = place_inputs(self._viewer, job)
        self._show_report(fit, fit.facts_with_names(job.names), job.inputs)
        if not fit.headline.level.is_success:
            show_warning(str(fit.headline))
        self._alternative.show([])
        self._job, self._result = job, finished.result
        self._list_solutions(fit)
        self.results = last.layers_for_next((job.image, job.name))
        self.results.show(main_layers(finished.layer_data, also=self.results.layer_keys), fit=moved)

    def follow(self, _: Any = None) -> bool:
        """Show the verdict on the fit whose layer is selected; return False without a fit."""
        layer = self._viewer.layers.selection.active
        result = None if layer is None else result_of(layer)
        if result is None or self._panel.running or not isinstance(result.content, Fit):
            return False
        if result is not self._result:
            self.empty()
            self._result = result
            self._show_report(result.content, result.content.facts)
        return True

    def _show_report(self, fit: Fit, facts: Sequence[Fact], inputs: panels.Rows = ()) -> None:
        self.verdict.show_headline(fit.headline)
        warnings = [
            ("Warning", caution.text) for caution in fit.cautions if caution.code != "verdict"
        ]
        rows = [row for row in warnings if row not in inputs]
        shown, details = (panels.fact_rows(facts, details=flag) for flag in (False, True))
        self.report.show_rows([*rows, *inputs, *shown], details)

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
        self.empty()
        if isinstance(self._panel.tag, FitJob):
            self._redraw_timer.start()

    def _draw(self) -> None:
        job = self._panel.tag
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
