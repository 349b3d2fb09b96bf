"""Runs over many shots or a watched folder: `StackJob`; their layers and report: `StackView`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from qtpy.QtWidgets import QLabel, QWidget

from napari_shadowinv._napari.jobs import ImageJob
from napari_shadowinv._napari.layer_metadata import kind_of, layer_key, main_layers, role_of
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.run import Outcome
from napari_shadowinv._napari.stores import follow_shots, shot_rows, store_layers
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._results import ResultLayers, place_together, result_frame
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from napari_shadowinv.stack import RunStatus, ShotOutcome

_UPDATE_INTERVAL_S = 0.5
_MIN_UPDATE_RATIO = 10  # interval over the time of a description
_REFRESH_INTERVAL_MS = 200  # many small shots may finish within a second
_MAX_FAILURES = 100
_SAME_LIMITS = 0.03  # relative to their range; smaller changes are not shown


def _empty_status() -> RunStatus:
    from napari_shadowinv.stack import RunStatus

    return RunStatus()


@dataclass(eq=False, kw_only=True)
class StackJob(ImageJob):
    """Shots to invert into a store, or a folder to watch; the layers over the store grow with it.

    Its thread writes the last fields, which the window reads at any time.
    """

    task: ClassVar[str] = "inversion"
    patience: ClassVar[float] = math.inf  # it finishes writing to the store

    shots: Shot  # an array (shot, y, x), also a lazy one, files, rows of a table, or a folder
    out: Path
    options: RunOptions | WatchOptions = field(default_factory=RunOptions)
    placement: Mapping[str, Any] = field(default_factory=dict)  # keywords of the layers
    status: RunStatus = field(default_factory=_empty_status)
    layer_data: LayerData = field(default_factory=list)  # empty until a shot is finished
    newest: int = 0  # the last shot that could be inverted
    _note: str = ""
    _describe_at: float = 0.0  # s

    @property
    def is_watch(self) -> bool:
        return isinstance(self.options, WatchOptions)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> RunStatus:
        """Invert the pending shots, and describe the layers once one shot is done."""
        from napari_shadowinv.stack import run_stack, watch_stack

        def update(status: RunStatus) -> None:
            if status.stage:
                on_progress(Progress("prepare", 0, None, status.stage))
                return
            self._note = status.note or self._note
            # The layers must be ready before the window reads the status.
            if status.done and (status.outcome is not None or not self.layer_data):
                self._update(status)
            self.status = status
            on_progress(self._progress(status))

        on_progress(Progress("prepare", 0, None, "shots and source"))
        callbacks: dict[str, Any] = {"on_progress": update, "should_stop": should_stop}
        if isinstance(self.options, WatchOptions):
            watch_stack(self.shots, self.out, self.recipe, watch=self.options, **callbacks)
        else:
            run_stack(self.shots, self.out, self.recipe, run=self.options, **callbacks)
        return self.status

    def layers(self, content: RunStatus) -> LayerData:
        """Return the layers described by the run, which grow with it."""
        return self.layer_data

    def _progress(self, status: RunStatus) -> Progress:
        ended = status.done + status.failed
        if not self.is_watch:
            return Progress("shots", ended, status.total, status.text)
        stage = "shots" if status.ended and status.waiting else "wait"
        note = f" ({self._note})" if self._note else ""
        return Progress(stage, status.ended, None, f"{status.text}{note}")

    def _update(self, status: RunStatus) -> None:
        """Describe the layers of the store from time to time, so that the shots need not wait."""
        outcome: ShotOutcome | None = status.outcome
        if outcome is not None and not outcome.reason:
            self.newest = max(self.newest, outcome.index)
        start = time.monotonic()
        if self.layer_data and status.waiting > 1 and start < self._describe_at:
            return
        # napari's cache of a pending shot would hide that it is done.
        placement = {"cache": False, **self.placement}
        with suppress(InputError, OSError):  # that has to wait for the next shot
            self.layer_data = [
                (data, keywords | placement, kind)
                for data, keywords, kind in store_layers(self.out)
            ]
        end = time.monotonic()
        self._describe_at = end + max(_UPDATE_INTERVAL_S, _MIN_UPDATE_RATIO * (end - start))


class StackView(QWidget):
    """Layers over the store of a run; its failed shots, and the report of the shot in view."""

    def __init__(self, viewer: Any, report: panels.ReportView) -> None:
        super().__init__()
        self._viewer, self._report = viewer, report
        self.job: StackJob | None = None  # whose layers are shown
        self.results = ResultLayers(viewer, self)
        self._applied: dict[str, tuple[float, float]] = {}  # by role; other contrast is the user's
        self._failed, self._newest = 0, 0
        self._resets_view, self._moves = False, False
        self._shown: LayerData = []  # all layers of the store as it was
        self._arrows: Any = None
        self._read_arrows: Callable[[], None] | None = None
        self._refresh_timer = qt.timer(self, _REFRESH_INTERVAL_MS, self._refresh, once=True)
        self._report_timer = qt.timer(self, _REFRESH_INTERVAL_MS, self.show_report, once=True)
        self.failures_title, self.failures = QLabel("Failed shots"), panels.ReportView()
        qt.column(self, self.failures_title, self.failures)
        qt.while_alive(self, viewer.dims, "current_step", self._on_step)
        self.empty()

    @property
    def busy(self) -> bool:
        return self.results.busy or self._refresh_timer.isActive()

    @property
    def images(self) -> list[Any]:
        return [layer for layer in self.results.layers if kind_of(layer) == "image"]

    def empty(self) -> None:
        """Forget the failures of the last run; its layers stay."""
        self.show_failures([])

    def show_run(self, job: StackJob) -> None:
        """Show the failures and layers of a run."""
        if len(job.status.failures) != self._failed:
            self.show_failures(list(job.status.failures))
        if job.layer_data and job is not self.job:
            self._begin(job)
        if job.layer_data is not self._shown and not self._refresh_timer.isActive():
            self._refresh_timer.start()

    def _begin(self, job: StackJob) -> None:
        is_resumed = self.job is not None and self.job.out == job.out and bool(self.results.layers)
        if not is_resumed:
            self.results, self._applied, self._newest = ResultLayers(self._viewer, self), {}, 0
            self.results.complete.connect(self._on_layers)
        self.job, self._resets_view = job, not is_resumed and job.image is None
        if job.image is not None and job.recipe.setup is not None:
            place_together(self._viewer, job.image, job.recipe.setup, job.companions)
        self._show(main_layers(job.layer_data, also=self.results.layer_keys), select=not is_resumed)

    def _refresh(self) -> None:
        """Show the shots that have ended since; layers that the user deleted stay so."""
        if self.results.busy:
            self._refresh_timer.start()
        elif self.job is not None and self.job.layer_data is not self._shown:
            keys = self.results.layer_keys
            self._show([each for each in self.job.layer_data if layer_key(each[1]) in keys])

    def _show(self, layer_data: LayerData, *, select: bool = False) -> None:
        assert self.job is not None
        self._shown, shot = self.job.layer_data, self.shot_in_view
        # The newest shot is followed only if it was in view.
        self._moves = not self.images or (shot is not None and shot >= self._newest)
        current: dict[str, Any] = {
            str(role_of(layer)): tuple(layer.contrast_limits) for layer in self.images
        }
        for _, keywords, kind in self._shown:
            if kind != "image":
                continue
            role, limits = str(role_of(keywords)), keywords["contrast_limits"]
            applied: Any = self._applied.get(role, limits)
            change = np.subtract(current.get(role) or applied, applied)
            if np.abs(change).max() > _SAME_LIMITS * np.ptp(applied):
                keywords["contrast_limits"] = current[role]
            else:
                self._applied[role] = limits
        self.results.show(layer_data, select=select)

    def _on_layers(self) -> None:
        # The setup places the results of files, perhaps far outside the view.
        if self._resets_view:
            self._resets_view = False
            self._viewer.reset_view()
        if self.job is not None and self.job.is_watch:
            # A failed shot would leave a black canvas.
            self._newest = max(self._newest, min(self.job.newest, self._last))
            if self._moves:
                self._viewer.dims.set_current_step(self._viewer.dims.ndim - 3, self._newest)
        layers = self.results.layers
        arrows = next((layer for layer in layers if role_of(layer) == "arrows"), None)
        if arrows is not self._arrows:
            self._arrows = arrows
            self._read_arrows = None if arrows is None else follow_shots(self._viewer, arrows)
        if self._read_arrows is not None:
            self._read_arrows()

    @property
    def _last(self) -> int:
        """Index of the last shot of the layers."""
        return max((len(layer.data) - 1 for layer in self.images), default=-1)

    @property
    def shot_in_view(self) -> int | None:
        """The shot of the layers that the viewer shows; None without a shot in view."""
        dims = self._viewer.dims
        shot = int(dims.current_step[dims.ndim - 3]) if dims.ndim > 2 else -1
        return shot if 0 <= shot <= self._last else None

    def _on_step(self, _: Any) -> None:
        self._report_timer.start()

    def show_report(self) -> None:
        """Show the origins of the results, and the quantities of the shot in view."""
        job, shot = self.job, self.shot_in_view
        if job is None or self.isHidden():
            return
        rows = list(job.origins.items())
        with suppress(FileFormatError):  # a damaged shot
            rows += [] if shot is None else shot_rows(job.out, shot)
        self._report.show_rows(rows)

    def show_failures(self, failures: list[tuple[str, str]]) -> None:
        """Show the first failures, and the number of further ones."""
        self._failed = len(failures)
        hidden = failures[_MAX_FAILURES:]
        more = [("…", f"and {len(hidden)} more")] if hidden else []
        self.failures.show_rows(failures[:_MAX_FAILURES] + more)
        self.failures_title.setVisible(bool(failures))

    def end(self, outcome: Outcome) -> str:
        """Show the end of a run; return it as a sentence, empty if an error says more."""
        job: StackJob = outcome.tag
        if not job.status.total:
            is_stopped = outcome.error is None and job.is_watch
            return "Stopped: no shot has arrived." if is_stopped else ""
        self.show_run(job)
        self.show_report()
        if outcome.cancelled:
            return f"Cancelled: {job.status.text}. Press Run to resume."
        return f"{job.status.text}, in {job.out.name}"


def placement_on(layer: Any, recipe: Recipe) -> dict[str, Any]:
    """Return the keywords that place results on their stack, with the setup's pixels."""
    keywords = result_frame(layer, recipe).keywords(stacked=True)
    for name in ("scale", "translate", "units"):
        keywords[name] = (getattr(layer, name)[0], *keywords[name][1:])
    return keywords
