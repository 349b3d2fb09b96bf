"""The widget that inverts a run of shots into a store: `InvertStack`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from numpy.typing import ArrayLike
from qtpy.QtWidgets import QCheckBox, QFileDialog, QLabel, QLineEdit, QSpinBox

from napari_shadowinv._napari.form import ModelPicker, PathEdit, labelled
from napari_shadowinv._napari.layer_metadata import main_layers, may_be_shot, role_of
from napari_shadowinv._napari.placement import source_on
from napari_shadowinv._napari.run import Outcome, Run
from napari_shadowinv._napari.stores import follow_shots, shot_rows
from napari_shadowinv._napari.widgets import _stack_jobs as stack_jobs
from napari_shadowinv._napari.widgets._files import result_buttons, shot_to_save
from napari_shadowinv._napari.widgets._inputs import InversionInputs
from napari_shadowinv._napari.widgets._layers import LayerPicker, stack_of
from napari_shadowinv._napari.widgets._panels import ReportView, ToolPanel
from napari_shadowinv._napari.widgets._qt import notify_errors, side_by_side, timer, while_alive
from napari_shadowinv._napari.widgets._results import ResultLayers, place_together
from napari_shadowinv._napari.widgets._tables import ShotTable
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.store import STORE_SUFFIX
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions

_REFRESH_INTERVAL_MS = 200  # many small shots may finish within a second
_MAX_FAILURES = 100
_LAYER, _FILES, _TABLE, _FOLDER = "layer", "files", "table", "folder"
_LOCAL, _SCHEDULER = "threads", "scheduler"
_SEPARATOR = "; "


class _FilesEdit(PathEdit):
    def ask(self) -> str:
        paths, _ = QFileDialog.getOpenFileNames(self, self._title)
        return _SEPARATOR.join(paths)


class StoreEdit(PathEdit):
    """The folder to which results are written, new or to be resumed."""

    def __init__(self) -> None:
        tip = f"Folder for the results, named …{STORE_SUFFIX}. If it exists, the run is resumed."
        super().__init__("Store of the results", f"results{STORE_SUFFIX}", tip)

    @property
    def store(self) -> Path:
        if not self.path:
            raise InputError(
                "no store is selected for the results: choose a folder whose name ends with "
                f"{STORE_SUFFIX}"
            )
        return Path(self.path).expanduser()

    def ask(self) -> str:
        # Choosing an existing store is safe: it is resumed unless 'overwrite' is checked.
        path, _ = QFileDialog.getSaveFileName(
            self,
            self._title,
            self.path or f"results{STORE_SUFFIX}",
            f"stores (*{STORE_SUFFIX})",
            options=QFileDialog.Option.DontConfirmOverwrite,
        )
        if not path:
            return ""
        selected = Path(path)
        # A store is a folder, which the dialog enters.
        for folder in (selected, *selected.parents):
            if folder.name.endswith(STORE_SUFFIX):
                return str(folder)
        return path + STORE_SUFFIX


class _StackPicker(LayerPicker):
    def _default(self) -> Any:
        stacks = [layer for layer in self.offered if layer.ndim == 3]
        return (stacks or self.offered)[-1]


class ShotsPicker(ModelPicker):
    def __init__(self, viewer: Any) -> None:
        tip = "Stack of images (shot, y, x); data on disk are read one shot at a time."
        self.layers = _StackPicker(viewer, tip, suits=may_be_shot)
        tip = "A pattern such as shots/*.tif, files separated by ;, or a file of frames."
        self.files = _FilesEdit("Files of the shots", "shots/*.tif", tip)
        self.table = ShotTable()
        self.folder = stack_jobs.FolderEdit()
        super().__init__(
            "Shots",
            {
                _LAYER: ("a stack layer", labelled("", self.layers)),
                _FILES: ("files", labelled("", self.files)),
                _TABLE: ("a table (.csv)", self.table),
                _FOLDER: ("a watched folder", self.folder),
            },
            "Where the shots come from.",
        )
        self.layers.picked.connect(self.changed)
        for control in (self.files, self.table, self.folder):
            control.changed.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        """The chosen layer; None for files."""
        return self.layers.layer if self.kind == _LAYER else None

    @property
    def name(self) -> str:
        """The name of the shots, such as a path."""
        edits = {_FOLDER: self.folder.folder, _FILES: self.files, _TABLE: self.table.file}
        if self.kind in edits:
            return edits[self.kind].path
        return "" if self.layer is None else str(self.layer.name)

    def shots(self) -> Any:
        if self.kind == _LAYER:
            return stack_of(self.layers.layer)
        if self.kind == _TABLE:
            return self.table.shots()
        parts = [part.strip() for part in self.files.path.split(_SEPARATOR.strip())]
        paths = [os.path.expanduser(part) for part in parts if part]
        if not paths:
            raise InputError(
                "no files are selected: enter a pattern such as shots/*.tif, or choose files"
            )
        return paths[0] if len(paths) == 1 else paths


class EnginePicker(ModelPicker):
    """The computer of the run: this one, or a dask cluster."""

    def __init__(self) -> None:
        tip = "Number of shots to invert at the same time."
        self.workers = QSpinBox(maximum=1024, suffix=" at once", toolTip=tip)
        self.workers.setSpecialValueText("one per core")
        tip = "Address that 'dask scheduler' prints when it starts."
        self.address = QLineEdit(placeholderText="tcp://host:8786", toolTip=tip, minimumWidth=60)
        super().__init__(
            "Run on",
            {
                _LOCAL: ("this computer", labelled("Jobs", self.workers)),
                _SCHEDULER: ("a dask cluster", labelled("Address", self.address)),
            },
            "Where to run the inversions. The results are the same. Cluster workers need access to "
            "the shots and the store at the same paths.",
        )
        self.workers.valueChanged.connect(lambda _: self.changed.emit())
        self.address.editingFinished.connect(self.changed)

    def engine(self) -> tuple[str, int | None]:
        """Return scheduler and number of workers for `run_stack`, or raise an `InputError`."""
        if self.kind == _LOCAL:
            return "threads", self.workers.value() or None
        address = self.address.text().strip()
        if "://" not in address:
            raise InputError(
                f"the scheduler's address is '{address}': expected an address such as "
                "tcp://host:8786, as printed by 'dask scheduler'"
            )
        return address, None

    def state(self) -> dict[str, Any]:
        workers, address = self.workers.value(), self.address.text()
        return {"kind": self.kind, "workers": workers, "address": address}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.set_kind(str(state.get("kind", _LOCAL)))
        self.workers.setValue(int(state.get("workers", 0)))
        self.address.setText(str(state.get("address", "")))


class InvertStack(InversionInputs, ToolPanel):
    """Choose shots and a store, then press Run; press it again to resume after an interruption."""

    def __init__(self, napari_viewer: Any) -> None:
        tip = "Invert all shots that are not in the store yet."
        # A cancelled run may take as long as it needs to finish writing to the store.
        panel = Run("Invert stack", "Run", tip, patience=math.inf)
        super().__init__(napari_viewer, "invert-stack", panel)
        self._shown: stack_jobs.StackJob | None = None
        self._ended, self._failed, self._resets_view, self._newest = 0, 0, False, 0
        self._arrows: Any = None
        self._read_arrows: Callable[[], None] | None = None
        self._refresh_timer = timer(self, _REFRESH_INTERVAL_MS, self._refresh, once=True)
        self._report_timer = timer(self, _REFRESH_INTERVAL_MS, self._show_report, once=True)
        self._build()
        self.shots.changed.connect(self._on_layer)
        self.setup.changed.connect(lambda: self.shots.table.show_kind(self.setup.picker.kind))
        for part in self.parts().values():
            part.changed.connect(self.keep)
        self.panel.progressed.connect(self._on_progress)
        while_alive(self, self.viewer.dims, "current_step", self._on_step)
        self.restore_last()
        self._on_layer()
        self._ready = True

    def _build(self) -> None:
        self.shots = ShotsPicker(self.viewer)
        self.make_inputs(
            lambda: self.shots.layer,
            ("labels",),
            "Labels on bad detector pixels, for all shots. The inversion ignores masked pixels, so "
            "do not mask the object.",
            "Labels that exclude the object from the source estimates only; the inversion still "
            "uses these pixels.",
        )
        self.store = StoreEdit()
        tip = "<qt>Delete the results in the store first. Otherwise the run is resumed.</qt>"
        self.overwrite = QCheckBox("overwrite the store", toolTip=tip)
        tip = "<qt>Retry the shots that failed in an earlier run.</qt>"
        self.redo_failed = QCheckBox("retry failed shots", toolTip=tip)
        self.engine = EnginePicker()
        self.report = ReportView()
        self.save_result, self.more_layers = result_buttons(
            self,
            lambda: self.results,
            "Save the displayed shot to a separate file. The store already contains all shots.",
            shot_to_save,
        )
        self.failures_title = QLabel("Failed shots")
        self.failures_title.setVisible(False)
        self.failures = ReportView()
        self.add(self.shots, *self.beam, *self.settings, labelled("Store", self.store))
        self.add(labelled("", self.overwrite), labelled("", self.redo_failed), self.engine)
        self.add(self.panel, side_by_side((self.save_result, 1), (self.more_layers, 1)))
        self.add(self.report, self.failures_title, self.failures)

    def parts(self) -> dict[str, Any]:
        return {**super().parts(), "engine": self.engine}

    def choose_folder(self) -> None:
        """Take the shots from a watched folder, and ask which."""
        self.shots.set_kind(_FOLDER)
        self.shots.folder.folder.choose()

    def request(self) -> stack_jobs.StackJob:
        layer = self.shots.layer
        self.setup.keep()
        recipe = self.recipe()
        mask = self.masks.usable(layer)
        self.source.check(mask)
        common: dict[str, Any] = {
            "out": self.store.store,
            "source": self._source(layer),
            "mask": mask,
            "source_mask": self.hidden_from_source(layer),
            "placement": {} if layer is None else stack_jobs.placement_on(layer, recipe),
            **self.job_inputs(layer, self.shots.name, recipe),
        }
        choices: dict[str, Any] = {
            "overwrite": self.overwrite.isChecked(),
            "redo_failed": self.redo_failed.isChecked(),
        }
        if self.shots.kind == _FOLDER:
            folder = self.shots.folder
            watch = WatchOptions(pattern=folder.pattern.text().strip(), **choices)
            return stack_jobs.WatchJob(shots=folder.path, watch_options=watch, **common)
        scheduler, workers = self.engine.engine()
        options = RunOptions(workers=workers, **choices)
        shots = self.shots.shots()
        return stack_jobs.StackJob(shots=shots, run_options=options, scheduler=scheduler, **common)

    def _source(self, layer: Any) -> ArrayLike | None:
        # A stack of sources has one for each shot.
        layer_of_source = self.source.layer
        if layer_of_source is not None and layer_of_source.ndim == 3:
            beams = stack_of(layer_of_source)
            return beams if layer is None else source_on(layer_of_source, beams, layer)
        beam = self.source.measured(layer)
        return None if beam is None else beam.image

    def _on_progress(self, progress: Progress) -> None:
        if progress.stage == "shots" or (progress.stage == "wait" and progress.step):
            self._show(self.panel.tag)

    def _show(self, job: stack_jobs.StackJob) -> None:
        # Once only: pressing Run again must not discard these shots.
        self.overwrite.setChecked(False)
        self.redo_failed.setChecked(False)
        status = job.status
        if len(status.failures) != self._failed:
            self._show_failures(list(status.failures))
        if job.layer_data and job is not self._shown:
            self._show_layers(job)
        elif status.ended > self._ended and not self._refresh_timer.isActive():
            self._refresh_timer.start()
        self._ended = status.ended

    def _show_layers(self, job: stack_jobs.StackJob) -> None:
        earlier, self._shown = self._shown, job
        is_resumed = earlier is not None and earlier.out == job.out
        setup = job.recipe.setup
        if job.image is not None and setup is not None:
            place_together(self.viewer, job.image, setup, job.companions)
        if earlier is not None and is_resumed:
            job.continue_from(earlier, self.results.layers)
        else:
            self.results = ResultLayers(self.viewer, self)
            self.results.complete.connect(self._on_layers)
        self._resets_view = not is_resumed and job.image is None
        layer_data = main_layers(job.layer_data, also=self.results.layer_keys)
        self.results.show(layer_data, select=not is_resumed)

    def _on_layers(self) -> None:
        # The setup places the results of files, perhaps far outside the view.
        if self._resets_view:
            self._resets_view = False
            self.viewer.reset_view()
            if isinstance(self._shown, stack_jobs.WatchJob):
                self._follow(self._shown)
        layers = self.results.layers
        arrows = next((layer for layer in layers if role_of(layer) == "arrows"), None)
        if arrows is not self._arrows:
            self._arrows = arrows
            self._read_arrows = None if arrows is None else follow_shots(self.viewer, arrows)
        self._refresh_timer.start()

    def _refresh(self) -> None:
        if isinstance(self._shown, stack_jobs.WatchJob):
            self._grow(self._shown)
        if self._shown is not None:
            self._shown.update_limits(self.results.layers)
        for layer in self.results.layers:
            layer.refresh()
        if self._read_arrows is not None:
            self._read_arrows()

    def _grow(self, shown: stack_jobs.WatchJob) -> None:
        """Add new shots to the layers; follow them only if the newest shot was in view."""
        if self.results.busy:
            self._refresh_timer.start()
            return
        shot = stack_jobs.shot_in_view(self.viewer, self.results.layers)
        shown.add_new_shots(self.results.layers)
        self._follow(shown, moves=shot is not None and shot >= self._newest)

    def _follow(self, shown: stack_jobs.WatchJob, *, moves: bool = True) -> None:
        """Show the newest shot that could be inverted; a failed one would leave a black canvas."""
        self._newest = min(shown.newest, stack_jobs.newest_shot(self.results.layers))
        if moves:
            stack_jobs.show_shot(self.viewer, self._newest)

    def forget(self) -> None:
        self._ended = 0
        self.report.empty()
        self._show_failures([])
        self.panel.say("")

    def _on_step(self, _: Any) -> None:
        self._report_timer.start()

    def _show_report(self) -> None:
        """Show the origins of the results, and the quantities of the shot in view."""
        job = self._shown
        if job is None or self.panel.running:
            return
        rows = list(job.inputs)
        shot = stack_jobs.shot_in_view(self.viewer, self.results.layers)
        with suppress(FileFormatError):  # a damaged shot
            rows += [] if shot is None else shot_rows(job.out, shot)
        self.report.show_rows(rows)

    def _show_failures(self, failures: list[tuple[str, str]]) -> None:
        """Show the first failures, and the number of further ones."""
        self._failed = len(failures)
        hidden = failures[_MAX_FAILURES:]
        more = [("…", f"and {len(hidden)} more")] if hidden else []
        self.failures.show_rows(failures[:_MAX_FAILURES] + more)
        self.failures_title.setVisible(bool(failures))

    @notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        job = outcome.tag
        if not isinstance(job, stack_jobs.StackJob):  # but the repetition of a result
            return
        status = job.status
        if not status.total:
            # The panel shows an error.
            if outcome.error is None and self.shots.kind == _FOLDER:
                self.panel.say("Stopped: no shot has arrived.")
            return
        self._show(job)
        self._show_report()
        if outcome.cancelled:
            self.panel.say(f"Cancelled: {status.text}. Press Run to resume.")
        else:
            self.panel.say(f"{status.text}, in {job.out.name}")
        self.panel.status.setToolTip(str(job.out.absolute()))

    def _on_layer(self) -> None:
        layer = self.shots.layer
        # Watched shots are inverted one by one, as they arrive.
        self.engine.setVisible(self.shots.kind != _FOLDER)
        self.source.follow(layer)
        self.setup.follow(layer, "" if layer is not None else self.shots.name)
        if not self.panel.running:
            self.forget()
        self.keep()
