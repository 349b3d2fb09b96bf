"""Fits beside a window: `FitJob`, and `FitView`, which shows its progress and its verdict."""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from napari.utils.notifications import show_warning
from qtpy.QtCore import QSignalBlocker, Qt
from qtpy.QtWidgets import QDoubleSpinBox, QPushButton, QWidget

from napari_shadowinv._napari.fit_layers import answer_layers, fit_layers, start_in_words
from napari_shadowinv._napari.frame import Frame, frame_of
from napari_shadowinv._napari.layer_metadata import result_of, role_of
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
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import FIELDS, FitOptions, Verdict, fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.preprocessing import Radiograph, Recipe

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.fitting import Fit

_DRAW_EVERY = 500  # ms
_WIDEST_BLUR = 100.0  # px
_STEP = re.compile(r"^(?P<stage>.*), objective (?P<value>\S+)$")


@dataclass(frozen=True, eq=False)
class FitAnswer:
    fit: Fit
    described: list[FullLayerData]


@dataclass(frozen=True, eq=False)
class FitJob:
    """A fit to be made, and the place of its layers; images and source may be lazy."""

    images: tuple[Any, ...]
    names: tuple[str, ...]
    keywords: Mapping[str, Any]  # of `fit`
    name: str
    frame: Frame
    given: Sequence[tuple[str, str]]  # what it was given, in words
    attributes: Mapping[str, str]
    layer: Any = None  # of the first image
    companions: tuple[Any, ...] = ()
    recipe: Recipe = field(default_factory=Recipe)  # steps and setup, of the first image
    history: list[tuple[str, float]] = field(default_factory=list)  # stage and objective so far

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> FitAnswer:
        """Fit and describe the layers, all of it beside the window."""

        def heard(news: Progress) -> None:
            step = _STEP.match(news.message)
            if step:
                self.history.append((step["stage"], float(step["value"])))
            on_progress(news)

        images, keywords = self._prepared(should_stop)
        found = fit(images, **keywords, on_progress=heard, should_stop=should_stop)
        described = fit_layers(
            found,
            self.frame,
            self.name,
            with_source=isinstance(keywords["source"], str),
            attributes=self.attributes,
        )
        return FitAnswer(found, described)

    def _prepared(self, should_stop: ShouldStop) -> tuple[FloatArray, dict[str, Any]]:
        """Read the images and do the recipe's steps to them, and to what lies on them."""
        from napari_shadowinv.pipeline._run import plane_of

        keywords = dict(self.keywords)
        planes = np.stack(
            [
                plane_of(image, f"'{name}'")
                for image, name in zip(self.images, self.names, strict=True)
            ]
        )
        source, mask, setups = (keywords[name] for name in ("source", "mask", "setups"))
        measured = source is not None and not isinstance(source, str)
        if measured:
            keywords["source"] = source = np.asarray(source)
        if not self.recipe.steps:
            return planes, keywords
        beams: Any = [None] * len(planes)
        if measured:
            _check_size("source", source, planes)
            beams = np.broadcast_to(source, planes.shape)
        shots = [
            self.recipe.prepared(
                Radiograph(image, source=beam, mask=mask, setup=setup), should_stop
            )
            for image, beam, setup in zip(
                planes, beams, setups or [None] * len(planes), strict=True
            )
        ]
        if measured:
            keywords["source"] = np.stack([shot.source for shot in shots])  # type: ignore[misc]
        if shots[0].mask is not None:
            keywords["mask"] = np.stack([shot.mask for shot in shots])  # type: ignore[misc]
        if setups is not None:
            keywords["setups"] = [shot.setup for shot in shots]
        return np.stack([shot.image for shot in shots]), keywords


def _check_size(what: str, values: FloatArray, images: FloatArray) -> None:
    if values.shape not in (images.shape, images.shape[1:]):
        raise InputError(
            f"the {what} has shape {values.shape}: expected {images.shape[1:]} or {images.shape}, "
            "like the images"
        )


def refinement(layers: Sequence[Any], image: Any, psf: float) -> FitJob:
    """The fit to an inversion's image, with its source, mask and setup, that starts from it.

    Of the `layers` that show the inversion, the field tells where the image lies.
    """
    shown = next((layer for layer in layers if role_of(layer) == "field"), None)
    result = None if shown is None else result_of(shown)
    if result is None or not isinstance(result.content, Inversion):
        raise InputError(
            "there is no inversion of this image to refine: press Run first, then Refine"
        )
    inversion, setup, name = result.content, result.setup, str(image.name)
    bends = ("magnetic field",) if setup is None else setup.deflectors
    (fields, *_) = (name for name, deflector in FIELDS.items() if deflector in bends)
    edge = "free" if inversion.options.boundary == "free" else "fading"
    keywords = {
        "setups": None if setup is None else [setup],
        "fields": (fields,),
        "source": inversion.source,
        "mask": inversion.mask,
        "psf": psf,
        "start": inversion.potential,
        "options": FitOptions(edge=edge, seed=inversion.options.seed),
    }
    given = [
        ("Start", f"the inversion of '{name}'"),
        ("Point spread", f"σ {psf:g} px" if psf else "none"),
    ]
    attributes = {"start_origin": f"the inversion of '{name}'"}
    frame = frame_of(shown)
    return FitJob(
        (inversion.image,), (name,), keywords, f"{name} refined", frame, given, attributes, image
    )


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
        self._fit: Fit | None = None
        self._others = ResultLayers(viewer, self)
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
        self._fit = None
        self.curve.empty()
        self.verdict.setVisible(False)
        self._answers_row.setVisible(False)
        self.report.empty()

    def show_result(self, job: FitJob, answer: FitAnswer, last: LastResults) -> ResultLayers:
        """Show a fit's layers and its verdict, which is a notification if it is not a good one."""
        found = answer.fit
        if job.layer not in self._viewer.layers:
            show_warning(f"'{job.names[0]}' was deleted during its fit; the result is shown anyway")
        elif job.recipe.setup is not None:
            place_together(self._viewer, job.layer, job.recipe.setup, job.companions)
        self._tell(found)
        self.report.show_rows([*job.given, *fit_rows(found, job.names)])
        self._others.show([])
        self._job, self._fit = job, found
        self._fill_answers(found)
        results = last.next_of((job.layer, job.name))
        results.show(answer.described)
        return results

    def _tell(self, found: Fit) -> None:
        good = found.verdict is Verdict.DETERMINED
        sentence = f"{found.explanation[:1].upper()}{found.explanation[1:]}."
        self.verdict.setText(
            f"<b>Verdict: {html.escape(found.verdict.value)}</b><br>{html.escape(sentence)}"
        )
        self.verdict.setStyleSheet("" if good else PROBLEM_STYLE)
        self.verdict.setVisible(True)
        if not good:
            show_warning(f"The fit's verdict is '{found.verdict.value}': {found.explanation}")

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
        if self._fit is None or self._job is None or number is None:
            return
        described = []
        if number:
            described = answer_layers(self._fit, number, self._job.frame, self._job.name)
        self._others.show(described, select=False)

    def _on_start(self) -> None:
        self.empty()
        if isinstance(self._panel.runner.tag, FitJob):
            self._drawing.start()

    def _draw(self) -> None:
        job = self._panel.runner.tag
        if isinstance(job, FitJob):
            self.curve.show_steps(list(job.history))

    def _on_end(self, outcome: Any) -> None:
        self._drawing.stop()
        if isinstance(outcome.tag, FitJob):
            self.curve.show_steps(list(outcome.tag.history))


def fit_rows(found: Fit, names: Sequence[str]) -> list[tuple[str, str]]:
    """How a fit went, in two columns of text."""
    rows = []
    for k, name in enumerate(names):
        told = [name, *([found.setups[k].probe] if found.setups else []), f"χ² {found.chi2[k]:.3g}"]
        if abs(found.gains[k] - 1) > 1e-6:
            told.append(f"gain {found.gains[k]:.3f}")
        shift = found.frames[k][[0, 3]]
        if shift.any():
            told.append(f"shifted by {shift[0]:.2f}, {shift[1]:.2f} px (y, x)")
        rows.append((f"Image {k + 1}", ", ".join(told)))
    report = found.report
    if np.isfinite(report.uncertainty):
        rows.append(("Error bars", f"{report.uncertainty:.1%} of the displacement (r.m.s.)"))
    rows.append(("Rays cross", f"over {found.folded:.1%} of the pixels"))
    rows.append(("Converged", "yes" if report.converged else "NO"))
    rows.append(("Time", f"{sum(report.seconds.values()):.1f} s"))
    return rows
