"""The frame of a window: controls in a column, and the result below its button.

- a column of controls, whose button runs a job: `ToolPanel`
- verdict and report of a result: `ResultView`
- its layers, which the next result of the same shot updates in place: `ResultLayers`
"""

from __future__ import annotations

import html
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from napari.utils.notifications import show_info, show_warning
from qtpy import QtWidgets
from qtpy.QtCore import QObject, Signal

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import Finished, FitJob, ImageJob, Job
from napari_shadowinv._napari.layer_metadata import Result, kind_of, main_layers, result_of
from napari_shadowinv._napari.layers import FullLayerData, add_layers
from napari_shadowinv._napari.result_files import missing_layers
from napari_shadowinv._napari.run import Outcome, Run
from napari_shadowinv._napari.viewer_sync import show_caution
from napari_shadowinv._napari.widgets import _files as files
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._qt import timer
from napari_shadowinv.cautions import CAUTION_CODES
from napari_shadowinv.facts import Fact, Headline, Level
from napari_shadowinv.preprocessing import Recipe

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
        text = f"{headline.text[:1].upper()}{headline.text[1:]}"
        lines = f"{prefix}{headline.title.capitalize()}", text
        title, sentence = map(html.escape, lines)
        self.show_text(f"<b>{title}</b><br>{sentence}", _LEVEL_STYLES[headline.level])


class ToolPanel(qt.Docked):
    """A column of controls that scrolls vertically; its button runs the `request`."""

    def __init__(self, viewer: Any, panel: Run) -> None:
        super().__init__()
        self.viewer, self.panel = viewer, panel
        self._ready = False
        self.previewing = False  # the running job is a preview
        self.results = ResultLayers(viewer, self)
        self._last: dict[Any, ResultLayers] = {}  # of each shot, by its layer or name
        tip = (
            "<qt>Keep the layers of earlier runs. Otherwise each new result replaces the previous "
            "result of the same shot.</qt>"
        )
        self.keep_earlier = QtWidgets.QCheckBox("Keep earlier results", toolTip=tip)
        self.area, self.column = qt.scrolling_column(self)
        self._revealed: QtWidgets.QWidget | None = None
        self._revealing = qt.timer(self, _SETTLE_MS, self._reveal, once=True)
        panel.button.clicked.connect(lambda: self._run_or_cancel())
        panel.ended.connect(self._on_end)

    def results_for(self, shot: Any) -> ResultLayers:
        """Return the layers for the next result of a shot, which replaces its last one."""
        results, last = ResultLayers(self.viewer, self), self._last.get(shot)
        if last is not None and not self.keep_earlier.isChecked():
            results.take_over(last)
        self._last[shot] = results
        return results

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

    def start(
        self, job: Job, show: Callable[[Any, Any], Any] | None = None, *, preview: bool = False
    ) -> None:
        """Do a job in the thread, then `show` its result; a preview shows no progress."""
        self.previewing = preview
        if show is not None:
            job.show = show
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
        job = outcome.tag
        if outcome.value is not None:
            (job.show or self.show_result)(outcome.value, job)


class ResultView(QtWidgets.QWidget):
    """Verdict and report of a result.

    It follows the results of selected layers if their `content` is of one of these kinds.
    """

    def __init__(
        self,
        tool: ToolPanel,
        content: type | tuple[type, ...],
        save_tip: str,
    ) -> None:
        super().__init__()
        self._tool, self._content = tool, content
        self._result: Result[Any] | None = None
        self._recipe: Recipe | None = None  # that was run for the result, if it is the form's
        self.changes = forms.WrappingLabel()
        self.verdict = VerdictLine()
        self.save_result = qt.push_button("Save result…", save_tip, self.save)
        tip = "Add potential, components of the field, re-projection, sites and other layers."
        self.more_layers = qt.push_button("More layers", tip, self.add_layers)
        buttons = qt.side_by_side((self.save_result, 1), (self.more_layers, 1))
        self.report = ReportView()
        qt.column(self, self.changes, self.verdict, buttons, self.report)
        # Also for runs that are cancelled, or refused before they start.
        tool.panel.button.clicked.connect(self.empty)
        tool.panel.started.connect(self._on_start)
        qt.while_alive(self, tool.viewer.layers.selection, "active", self.follow)
        self.empty()

    def empty(self) -> None:
        """Clear the report of the last result; its layers stay."""
        self._result = self._recipe = None
        self.changes.show_text("")
        self.verdict.show_text("")
        self.report.empty()

    @qt.notify_errors
    def save(self) -> None:
        """Ask for a file, and save the shown result, which of several is the last of the tool."""
        viewer, last = self._tool.viewer, files.field_of(self._tool.results.layers)
        content = files.result_to_save(viewer, files.shown_result(viewer, last))
        files.save_as(self, content, self._tool.panel.say)

    @qt.notify_errors
    def add_layers(self) -> None:
        """Add the other layers of the shown result, hidden, also to later ones of the same shot."""
        viewer, results = self._tool.viewer, self._tool.results
        layer = files.shown_result(viewer, results.layers)
        missing = missing_layers(viewer, layer)
        if not missing:
            show_info("All layers of the result are in the layer list")
        elif layer in results.layers:
            results.extend(missing)
        else:
            ResultLayers(viewer, results).show(missing, select=False)

    def show_fit(self, job: FitJob, finished: Finished) -> ResultLayers:
        """Show the layers, verdict and report of a fit; return its layers."""
        fit, tool = finished.content, self._tool
        moved = place_inputs(tool.viewer, job)
        self.show_report(finished.result, job, fit.facts_with_names(job.names))
        results = tool.results_for((job.image, job.name))
        results.show(main_layers(finished.layer_data, also=results.layer_keys), fit=moved)
        return results

    def show_report(
        self, result: Result[Any], job: ImageJob, facts: Sequence[Fact] | None = None
    ) -> None:
        """Show the verdict and report of a job's result; notify if it is doubtful."""
        headline = self._show(result, facts)
        is_refinement = isinstance(job, FitJob) and job.start is not None
        self._recipe = None if is_refinement else job.recipe
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
        facts = facts or content.facts
        self.verdict.show_headline(content.headline)
        warnings = [row for row in warning_rows(facts) if row not in origins]
        rows, details = (fact_rows(facts, details=flag) for flag in (False, True))
        self.report.show_rows([*warnings, *origins, *rows], details)
        return content.headline

    def _on_start(self) -> None:
        # The verdict of a preview stays until the next preview.
        if not self._tool.previewing:
            self.empty()


_MIN_LIMITS_CHANGE = 0.02  # relative to their range


def result_frame(image: Any, recipe: Recipe) -> about.Frame:
    """Return the frame of a result on its image, with the setup's pixels."""
    frame = about.frame_of(image)
    if recipe.setup is not None:
        upright = about.frame_for(image.data.shape, recipe.setup)
        frame = replace(frame, scale=upright.scale, units=upright.units)
    height, width = image.data.shape[-2:]
    return frame.beneath(recipe.matrix((height, width)))


def place_together(viewer: Any, image: Any, setup: Any, companions: Sequence[Any]) -> bool:
    """Place an image and the layers on it with the setup's pixels; return whether it moved."""
    old, shape = about.frame_of(image), tuple(image.data.shape[-2:])

    def is_of_size(layer: Any) -> bool:
        return kind_of(layer) in ("image", "labels") and tuple(layer.data.shape[-2:]) == shape

    on_image = [
        layer
        for layer in viewer.layers
        if about.frame_of(layer).units == old.units
        and layer is not image
        and (layer in companions or is_of_size(layer))
    ]
    upright = about.frame_for(image.data.shape, setup)
    image.scale = (*image.scale[:-2], *upright.scale)
    image.units = (*image.units[:-2], *upright.units)
    image.axis_labels = (*image.axis_labels[:-2], "y", "x")
    new = about.frame_of(image)
    if new == old:
        return False
    ratio = np.divide(new.scale, old.scale)
    for layer in on_image:
        frame = about.frame_of(layer)
        shift = ratio * np.subtract(frame.translate, old.translate)
        layer.translate = (*layer.translate[:-2], *(new.translate + shift))
        layer.scale = (*layer.scale[:-2], *(ratio * frame.scale))
        layer.units = (*layer.units[:-2], *image.units[-2:])
    viewer.reset_view()
    return True


def place_inputs(viewer: Any, job: ImageJob, *, quiet: bool = False) -> bool:
    """Place the layers of a job with the setup's pixels; return whether they moved.

    Unless `quiet`, warn if the image was deleted.
    """
    if job.image not in viewer.layers and not quiet:
        show_warning(
            f"'{job.image_name}' was deleted during its {job.task}; the result is shown anyway"
        )
    inputs = [layer for layer in (job.image, *job.companions) if layer in viewer.layers]
    if not inputs or job.recipe.setup is None:
        return False
    return place_together(viewer, inputs[0], job.recipe.setup, inputs[1:])


class ResultLayers(QObject):
    """Layers of a result, which later results update."""

    complete = Signal()  # all layers of the last result have been added

    def __init__(self, viewer: Any, parent: QObject) -> None:
        super().__init__(parent)
        self._viewer = viewer
        self._layers: dict[str, Any] = {}
        self._work: Iterator[None] = iter(())
        # Adding a layer takes napari some tenths of a second: one at a time, the window responds.
        self._timer = timer(self, 0, self._go_on, once=True)

    @property
    def layers(self) -> list[Any]:
        """The layers that are still in the viewer."""
        return [layer for layer in self._layers.values() if layer in self._viewer.layers]

    @property
    def layer_keys(self) -> set[str]:
        """Keys of the layers that are still in the viewer."""
        return {about.layer_key(layer) for layer in self.layers}

    @property
    def busy(self) -> bool:
        return bool(self._timer.isActive())

    def show(
        self, layer_data: Sequence[FullLayerData], *, select: bool = True, fit: bool = False
    ) -> None:
        """Update the layers, the lowest first, and add missing ones.

        With `fit`, the camera is then fitted to all layers.
        """
        self._work = self._show(layer_data, select, fit)
        self._go_on()

    def extend(self, layer_data: Sequence[FullLayerData]) -> None:
        """Add layers of the same result below the others, keeping the selection."""
        lowest = next((layer for layer in self._viewer.layers if layer in self.layers), None)
        self._work = chain(self._work, self._add(layer_data, lowest))
        self._go_on()

    def take_over(self, earlier: ResultLayers) -> None:
        """Take the layers of an earlier result, to update them with the next one."""
        earlier._timer.stop()
        self._layers, earlier._layers = earlier._layers, {}

    def hide(self) -> None:
        for layer in self.layers:
            layer.visible = False

    def _go_on(self) -> None:
        work = self._work
        is_over = next(work, True)
        if work is self._work:
            (self.complete.emit if is_over else self._timer.start)()

    def _show(self, layer_data: Sequence[FullLayerData], select: bool, fit: bool) -> Iterator[None]:
        described = {about.layer_key(each[1]): each for each in layer_data}
        for layer in self.layers:
            if about.layer_key(layer) not in described:
                self._viewer.layers.remove(layer)
        self._layers = {about.layer_key(layer): layer for layer in self.layers}
        for key, layer in self._layers.items():
            _update(layer, *described[key][:2])
        above = None
        for key, each in reversed(described.items()):
            if key not in self._layers:
                yield from self._add([each], above, select=select)
            above = self._layers[key]
        if fit:
            # Only now all layers of an earlier result have the new units.
            self._viewer.reset_view()

    def _add(
        self, layer_data: Sequence[FullLayerData], above: Any | None, *, select: bool = False
    ) -> Iterator[None]:
        for each in reversed(layer_data):
            before = self._viewer.layers.selection.active
            (above,) = add_layers(self._viewer, [each], below=above)
            self._layers[about.layer_key(above)] = above
            main = self._layers.get("field") or self._layers.get("fluence")
            # Hidden layers must not take the selection.
            if (active := main if select else before) is not None:
                self._viewer.layers.selection.active = active
            yield


def _update(layer: Any, data: Any, keywords: dict[str, Any]) -> None:
    layer.data = data
    layer.metadata = keywords["metadata"]
    if tuple(str(unit) for unit in layer.units) != tuple(keywords["units"]):
        layer.units = keywords["units"]
    limits = keywords.get("contrast_limits")
    if limits is not None:
        # Only visible changes: setting limits takes as long as setting data.
        tolerance = _MIN_LIMITS_CHANGE * np.ptp(limits)
        if not np.allclose(layer.contrast_limits, limits, rtol=0, atol=tolerance):
            layer.contrast_limits = limits
    for name in ("name", "scale", "translate", "affine", "features", "length", "edge_width"):
        if name in keywords and not np.array_equal(getattr(layer, name), keywords[name]):
            setattr(layer, name, keywords[name])
