"""Many shots: where they come from, their run into a store, its layers and report.

- a layer, files, a table of them, or a folder to watch: `ShotPicker`
- the store, and the choices of a run of many shots: `StoreSection`
- the run: `StackJob`; its layers and report: `StackView`
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field, create_model
from qtpy.QtWidgets import QLabel, QWidget

from napari_shadowinv._napari import form as forms
from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.jobs import ImageJob
from napari_shadowinv._napari.layer_metadata import kind_of, layer_key, main_layers, role_of
from napari_shadowinv._napari.layers import LayerData
from napari_shadowinv._napari.result_files import follow_arrows, shot_rows, store_layers
from napari_shadowinv._napari.run import Outcome
from napari_shadowinv._napari.widgets import _layers as layers
from napari_shadowinv._napari.widgets import _panels as panels
from napari_shadowinv._napari.widgets import _qt as qt
from napari_shadowinv._napari.widgets._layers import LAYER
from napari_shadowinv._napari.widgets._panels import ResultLayers, place_together, result_frame
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.store import STORE_SUFFIX
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.pipeline.shot_table import is_table
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from napari_shadowinv.stack import RunStatus, ShotOutcome

FILES, TABLE, FOLDER = "files", "table", "folder"
_MISSING = {
    FILES: "no files are selected: enter a pattern such as shots/*.tif, or choose files",
    TABLE: "no table is selected: choose a .csv file with a row for each shot, with the columns "
    "file and energy or wavelength",
    FOLDER: "no folder is selected: choose the folder in which the shots appear",
}
_ONCE = {"overwrite", "redo_failed"}  # choices that count for one run


def _place(title: str, dialog: str, example: str, description: str) -> type[CheckedModel]:
    """Return the model of a path."""
    extra: Any = {"path": dialog}
    words: Any = {"title": title, "description": description, "examples": [example]}
    return create_model(
        title, __base__=CheckedModel, path=(str, Field("", json_schema_extra=extra, **words))
    )


_PLACES: forms.Kinds = {
    FILES: (
        "Files…",
        _place(
            "Files",
            "files",
            "shots/*.tif",
            "A pattern such as shots/*.tif, files separated by ;, or a file of frames.",
        ),
    ),
    TABLE: (
        "Table (.csv)…",
        _place(
            "Table",
            "file",
            "shots.csv",
            "A table (.csv) with a row for each shot and the columns file, setup, energy or "
            "wavelength, brightness, mask, source, exclude.",
        ),
    ),
    FOLDER: (
        "Watched folder…",
        _place(
            "Folder",
            "folder",
            "folder",
            "Each new file in this folder is inverted as soon as it is complete, until you press "
            "Cancel.",
        ),
    ),
}
_STORE = _place(
    "Store",
    "new",
    f"results{STORE_SUFFIX}",
    f"Folder for the results, named …{STORE_SUFFIX}. If it exists, the run is resumed.",
)


class ShotPicker(layers.LayerPicker):
    """A layer, or another place that shots come from.

    Until one is chosen, it is the image of an object rather than that of a beam, by names or
    structure, whichever was opened first.
    """

    def __init__(self, viewer: Any) -> None:
        entries: forms.Kinds = {"": ("no image is open", None), LAYER: ("", None), **_PLACES}
        tip = (
            "Layer of a shot, or of a stack of shots; or shots in files, which are inverted into "
            "one store."
        )
        self._compared: list[Any] = []
        super().__init__(viewer, tip, suits=about.may_be_shot, label="Image", entries=entries)

    def _preferred(self, before: Any) -> Any:
        recorded = [layer for layer in self.offered if not about.belongs_to_result(layer)]
        candidates, best = [*recorded], before
        if before in recorded:
            candidates = [layer for layer in recorded if layer not in self._compared]
        elif candidates:
            best = candidates.pop()
        for layer in reversed(candidates):
            if layers.is_rather_shot(layer, best, is_pair=len(recorded) == 2):
                best = layer
        self._compared = recorded
        return self.chosen, best, *super()._preferred(before)

    @property
    def is_stack(self) -> bool:
        return self.kind in _MISSING or (self.layer is not None and self.layer.ndim > 2)

    @property
    def name(self) -> str:
        """The name of the shots, such as a path."""
        if self.form is not None:
            return str(self.form.state().get("path", "")).strip()
        return "" if self.layer is None else str(self.layer.name)

    @property
    def _paths(self) -> list[str]:
        parts = [part.strip() for part in self.name.split(forms.PATH_SEPARATOR.strip())]
        return [os.path.expanduser(part) for part in parts if part]

    @property
    def default_store(self) -> str:
        """The store beside the files; empty for a layer, or without files."""
        if self.form is None or not self._paths:
            return ""
        path = Path(self._paths[0])
        if self.kind == FILES:
            path = path.parent  # shots/*.tif
        return str(path.with_name(path.stem + STORE_SUFFIX)) if path.name else ""

    def choose_path(self) -> None:
        """Ask for the files, the table or the folder."""
        if self.form is not None:
            self.form.entries["path"].choose_path()

    def shots(self) -> Any:
        """Return the shots of a stack for a run, or raise an `InputError`."""
        if self.form is None:
            return layers.stack_of(self.layer)
        paths = self._paths
        if not paths:
            raise InputError(_MISSING[self.kind])
        if self.kind == FILES:
            return paths[0] if len(paths) == 1 else paths
        path = Path(self.name).expanduser()
        if self.kind == TABLE and not (path.is_file() and is_table(path)):
            reason = "is no table" if path.exists() else "does not exist"
            raise InputError(
                f"{path} {reason}: expected a .csv file that begins with names of columns, such as "
                "file and energy"
            )
        return path


class StoreSection(QWidget):
    """The store of a stack's results, and the choices of its run."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = forms.ModelForm(_STORE)
        self.run, self.watch = forms.ModelForm(RunOptions), forms.ModelForm(WatchOptions)
        self._proposed = ""
        qt.column(self, self.folder, forms.section("Run of many shots", self.run, self.watch))

    @property
    def path(self) -> Path:
        """The store, also if the dialog entered it; an `InputError` without one."""
        stated = str(self.folder.state().get("path", "")).strip()
        if not stated:
            raise InputError(
                "no store is selected for the results: choose a folder whose name ends with "
                f"{STORE_SUFFIX}"
            )
        path = Path(stated).expanduser()
        stores = [each for each in (path, *path.parents) if each.name.endswith(STORE_SUFFIX)]
        return stores[0] if stores else path

    def follow(self, shots: ShotPicker) -> None:
        """Show the choices for a kind of shots, and their store unless the user chose another."""
        if self.folder.state().get("path", "") in ("", self._proposed):
            self._proposed = shots.default_store
            self.folder.restore({"path": self._proposed})
        # Watched shots are inverted one by one, as they arrive.
        self.run.setVisible(shots.kind != FOLDER)
        self.watch.setVisible(shots.kind == FOLDER)

    def options(self, kind: str) -> Any:
        """Return the options of a run, or raise an `InputError`."""
        return (self.watch if kind == FOLDER else self.run).model()

    def begin(self) -> None:
        """Uncheck what counts for one run: another must not discard its shots."""
        for form in (self.run, self.watch):
            values = form.state()
            if _ONCE & values.keys():
                form.restore({key: value for key, value in values.items() if key not in _ONCE})


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
        self._applied: dict[str, Any] = {}  # limits by role; other contrast is the user's
        self._newest: int | None = None  # shot that was moved to
        self._shown: LayerData = []  # all layers of the store as it was
        self._refresh_timer = qt.timer(self, _REFRESH_INTERVAL_MS, self._refresh, once=True)
        self.failures_title, self.failures = QLabel("Failed shots"), panels.ReportView()
        qt.column(self, self.failures_title, self.failures)
        qt.while_alive(self, viewer.dims, "current_step", self._schedule)
        self.empty()

    @property
    def busy(self) -> bool:
        return self.results.busy or self._refresh_timer.isActive()

    @property
    def images(self) -> list[Any]:
        return [layer for layer in self.results.layers if kind_of(layer) == "image"]

    def empty(self) -> None:
        """Forget the failures of the last run; its layers stay."""
        self._show_failures([])

    def show_run(self, job: StackJob) -> None:
        """Show the failures and layers of a run."""
        self._show_failures(list(job.status.failures))
        if job.layer_data and job is not self.job:
            self._begin(job)
        if job.layer_data is not self._shown:
            self._schedule()

    def _schedule(self, _: Any = None) -> None:
        if not self._refresh_timer.isActive():
            self._refresh_timer.start()

    def _begin(self, job: StackJob) -> None:
        is_resumed = self.job is not None and self.job.out == job.out and bool(self.results.layers)
        if not is_resumed:
            self.results, self._applied, self._newest = ResultLayers(self._viewer, self), {}, None
            self.results.complete.connect(self._on_layers)
        self.job = job
        if job.image is not None and job.recipe.setup is not None:
            place_together(self._viewer, job.image, job.recipe.setup, job.companions)
        self._show(main_layers(job.layer_data, also=self.results.layer_keys), select=not is_resumed)

    def _refresh(self) -> None:
        """Show the shots that have ended since; layers that the user deleted stay so."""
        if self.results.busy:
            self._schedule()
            return
        if self.job is not None and self.job.layer_data is not self._shown:
            keys = self.results.layer_keys
            self._show([each for each in self.job.layer_data if layer_key(each[1]) in keys])
        self.show_report()

    def _show(self, layer_data: LayerData, *, select: bool = False) -> None:
        assert self.job is not None
        self._shown = self.job.layer_data
        current = {str(role_of(layer)): layer.contrast_limits for layer in self.images}
        for _, keywords, kind in self._shown:
            if kind != "image":
                continue
            role, limits = str(role_of(keywords)), keywords["contrast_limits"]
            applied: Any = self._applied.get(role, limits)
            change = np.subtract(current.get(role, applied), applied)
            if np.abs(change).max() > _SAME_LIMITS * np.ptp(applied):
                keywords["contrast_limits"] = current[role]
            else:
                self._applied[role] = limits
        self.results.show(layer_data, select=select)

    def _on_layers(self) -> None:
        job, shot, is_first = self.job, self.shot_in_view, self._newest is None
        if job is None:
            return
        # The setup places the results of files, perhaps far outside the view.
        if is_first and job.image is None:
            self._viewer.reset_view()
        # The newest shot is followed if it was in view; a failed one would leave a black canvas.
        is_followed = is_first or (shot is not None and shot >= (self._newest or 0))
        self._newest = max(self._newest or 0, min(job.newest, self._last))
        if job.is_watch and is_followed:
            self._viewer.dims.set_current_step(self._viewer.dims.ndim - 3, self._newest)
        follow_arrows(self._viewer)

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

    def show_report(self) -> None:
        """Show the origins of the results, and the quantities of the shot in view."""
        job, shot = self.job, self.shot_in_view
        if job is None or self.isHidden():
            return
        rows = list(job.origins.items())
        with suppress(FileFormatError):  # a damaged shot
            rows += [] if shot is None else shot_rows(job.out, shot)
        self._report.show_rows(rows)

    def _show_failures(self, failures: list[tuple[str, str]]) -> None:
        """Show the first failures, and the number of further ones."""
        hidden = failures[_MAX_FAILURES:]
        more = [("…", f"and {len(hidden)} more")] if hidden else []
        rows = failures[:_MAX_FAILURES] + more
        if rows != self.failures.rows:
            self.failures.show_rows(rows)
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
