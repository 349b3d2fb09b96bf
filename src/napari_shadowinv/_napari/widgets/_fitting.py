"""Fits beside a window: `Refining` begins one, `FitView` shows its progress and its verdict."""

from __future__ import annotations

import html
import time
from collections.abc import Callable, Sequence
from typing import Any

from napari.utils.notifications import show_warning
from qtpy.QtCore import QSignalBlocker, Qt
from qtpy.QtWidgets import QDoubleSpinBox, QPushButton, QWidget

from napari_shadowinv._napari.fit_jobs import FitAnswer, FitJob
from napari_shadowinv._napari.fit_layers import (
    answer_layers,
    setup_of_fit,
    start_in_words,
    verdict_in_words,
)
from napari_shadowinv._napari.kinds import main_layers
from napari_shadowinv._napari.layer_metadata import Result, result_of
from napari_shadowinv._napari.notifications import window_text
from napari_shadowinv._napari.widgets._fields import SteadyComboBox
from napari_shadowinv._napari.widgets._forms import (
    PROBLEM_STYLE,
    labelled,
    section,
    wrapping_label,
)
from napari_shadowinv._napari.widgets._panels import ReportTable, RunPanel
from napari_shadowinv._napari.widgets._plots import ObjectiveCurve
from napari_shadowinv._napari.widgets._qt import column, timer
from napari_shadowinv._napari.widgets._results import LastResults, ResultLayers, place_together
from napari_shadowinv.fitting import FIELDS, Fit, FittedField, Verdict
from napari_shadowinv.physics.units import shown_fields

_DRAW_EVERY, _DRAW_SHARE = 500, 10  # ms, and at least so many times what drawing takes
_WIDEST_BLUR = 100.0  # px


class Refining(QWidget):
    """Folded controls that refine an inversion; `refine` gets the blur's σ in px."""

    def __init__(self, refine: Callable[[float], None]) -> None:
        super().__init__()
        self.psf = QDoubleSpinBox()
        self.psf.setRange(0.0, _WIDEST_BLUR)
        self.psf.setSingleStep(0.1)
        self.psf.setSuffix(" px")
        self.psf.setSpecialValueText("none")
        self.psf.setToolTip(
            "<qt>Standard deviation of the image's blur by source size and detector, in pixels of "
            "the object plane.</qt>"
        )
        self.button = QPushButton("Refine")
        self.button.setToolTip(
            "<qt>Fit the forward model to the image, starting from its last inversion: with blur, "
            "with error bars, and beyond the first caustic. The verdict tells whether one image "
            "determines the field.</qt>"
        )
        self.button.clicked.connect(lambda: refine(self.psf.value()))
        self.folded = section("Refine the result", labelled("Blur σ", self.psf), self.button)
        column(self, self.folded)


class FitView(QWidget):
    """The objective while a fit runs; then its verdict, its report and its other answers."""

    def __init__(self, viewer: Any, panel: RunPanel) -> None:
        super().__init__()
        self._viewer, self._panel = viewer, panel
        self._job: FitJob | None = None
        self._result: Result | None = None
        self._others = ResultLayers(viewer, self)
        self.results: ResultLayers | None = None
        self.curve = ObjectiveCurve()
        self.verdict = wrapping_label()
        self.answers = SteadyComboBox()
        self.answers.setToolTip(
            "<qt>Where other starts have led. A chosen one is shown as layers of its own, beside "
            "the best.</qt>"
        )
        self._answers_row = labelled("Answer", self.answers)
        self.report = ReportTable()
        column(self, self.verdict, self._answers_row, self.curve, self.report)
        self._drawing = timer(self, _DRAW_EVERY, self._draw)
        self.answers.currentIndexChanged.connect(self._show_answer)
        panel.runner.started.connect(self._on_start)
        panel.runner.ended.connect(self._on_end)
        self.empty()

    def empty(self) -> None:
        """Take away what was said of the last fit; its layers stay."""
        self._result = None
        self.curve.empty()
        self.verdict.setVisible(False)
        self._answers_row.setVisible(False)
        self.report.empty()

    def show_result(self, job: FitJob, answer: FitAnswer, last: LastResults) -> ResultLayers:
        """Show a fit's layers and its verdict, which is a notification if it is not a good one."""
        found = answer.fit
        if job.layer not in self._viewer.layers:
            show_warning(f"'{job.names[0]}' was deleted during its fit; the result is shown anyway")
        here = [one for one in (job.layer, *job.companions) if one in self._viewer.layers]
        moved = False
        if here and job.recipe.setup is not None:
            moved = place_together(self._viewer, here[0], job.recipe.setup, here[1:])
        self._tell(found)
        if found.verdict is not Verdict.DETERMINED:
            text = verdict_in_words(found)
            show_warning(text[:1].upper() + text[1:])
        texts = {text for name, text in job.given if name == "Warning"}
        doubts = [
            ("Warning", window_text(caution.text))
            for caution in found.warnings
            if caution.text not in texts
        ]
        self.report.show_rows([*doubts, *job.given, *fit_rows(found, job.names)])
        self._others.show([])
        self._job, self._result = job, answer.result
        self._fill_answers(found)
        results = last.next_of((job.layer, job.name))
        results.show(main_layers(answer.described, also=results.slots), fit=moved)
        self.results = results
        return results

    def follow(self) -> None:
        """Tell the verdict on the fit whose layer is selected, such as one of a file."""
        layer = self._viewer.layers.selection.active
        result = None if layer is None else result_of(layer)
        if result is None or result is self._result or self._panel.runner.running:
            return
        if isinstance(result.content, Fit):
            self.empty()
            self._result = result
            self._tell(result.content)
            doubts = [("Warning", window_text(caution.text)) for caution in result.content.warnings]
            self.report.show_rows([*doubts, *fit_rows(result.content)])

    def _tell(self, found: Fit) -> None:
        good = found.verdict is Verdict.DETERMINED
        explanation = window_text(found.explanation)
        sentence = f"{explanation[:1].upper()}{explanation[1:]}."
        self.verdict.setText(
            f"<b>Verdict: {html.escape(found.verdict.value)}</b><br>{html.escape(sentence)}"
        )
        self.verdict.setStyleSheet("" if good else PROBLEM_STYLE)
        self.verdict.setVisible(True)

    def _fill_answers(self, found: Fit) -> None:
        with QSignalBlocker(self.answers):
            self.answers.clear()
            best, *others = found.basins
            self.answers.addItem(f"{start_in_words(best)}: the best", 0)
            for number, basin in enumerate(others, 1):
                worse = f"{100 * (basin.objective / best.objective - 1):+.1f} %"
                start, away = start_in_words(basin), f"{basin.distance:.0%}"
                self.answers.addItem(f"{start}: {worse}, {away} off", number)
                full = f"objective {worse}, displacement {away} (r.m.s.) from the best"
                self.answers.setItemData(number, f"{start}: {full}", Qt.ItemDataRole.ToolTipRole)
        self._answers_row.setVisible(len(found.basins) > 1)

    def _show_answer(self) -> None:
        number = self.answers.currentData()
        if self._result is None or self._job is None or number is None:
            return
        described = []
        if number:
            described = answer_layers(self._result, number, self._job.frame, self._job.name)
        self._others.show(described, select=False)

    def _on_start(self) -> None:
        self.empty()
        if isinstance(self._panel.runner.tag, FitJob):
            self._drawing.start()

    def _draw(self) -> None:
        job = self._panel.runner.tag
        if isinstance(job, FitJob):
            begun = time.perf_counter()
            self.curve.show_steps(list(job.course.history))
            # A slow screen must not keep the fit and the window waiting.
            spent = 1000 * (time.perf_counter() - begun)
            self._drawing.setInterval(max(_DRAW_EVERY, round(_DRAW_SHARE * spent)))

    def _on_end(self, outcome: Any) -> None:
        self._drawing.stop()
        if isinstance(outcome.tag, FitJob):
            self.curve.show_steps(list(outcome.tag.course.history))


def fit_rows(found: Fit, names: Sequence[str] = ()) -> list[tuple[str, str]]:
    """How a fit went, in two columns of text."""
    rows = []
    for k, chi2 in enumerate(found.chi2):
        told = [*names[k : k + 1], *([found.setups[k].probe] if found.setups else [])]
        told.append(f"χ² {chi2:.3g}")
        if abs(found.gains[k] - 1) > 1e-6:
            told.append(f"gain {found.gains[k]:.3f}")
        shift = found.frames[k][[0, 3]]
        if shift.any():
            told.append(f"shifted by {shift[0]:.2f}, {shift[1]:.2f} px (y, x)")
        rows.append((f"Image {k + 1}", ", ".join(told)))
    report = found.report
    rows += [(_peak_name(found, field), _peak_text(found, field)) for field in found.fields]
    rows += [(name.capitalize(), text) for name, text in found.error_rows]
    rows.append(("Rays cross", f"over {found.folded:.1%} of the pixels"))
    rows.append(("Converged", "yes" if report.converged else "NO"))
    rows.append(("Time", f"{sum(report.seconds.values()):.1f} s"))
    return rows


def _peak_name(found: Fit, field: FittedField) -> str:
    return "Peak" if len(found.fields) == 1 else f"Peak of {field.name}"


def _peak_text(found: Fit, field: FittedField) -> str:
    (shown,) = shown_fields([field.displacement], setup_of_fit(found), FIELDS[field.name])
    return found.peak_text(field, shown).removeprefix("peak ")
