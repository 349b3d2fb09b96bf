"""The widget that turns a run of shots into a store of fields: `InvertStack`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike
from qtpy.QtCore import Qt
from qtpy.QtWidgets import QCheckBox, QFileDialog, QHeaderView, QLabel, QLineEdit, QSpinBox

from napari_shadowinv._napari.kinds import main_layers
from napari_shadowinv._napari.layer_metadata import may_be_shot, role_of
from napari_shadowinv._napari.stores import follow_shots
from napari_shadowinv._napari.widgets._forms import PathEdit, RowPicker, labelled
from napari_shadowinv._napari.widgets._inputs import InversionInputs
from napari_shadowinv._napari.widgets._layers import LayerPicker, stack_of
from napari_shadowinv._napari.widgets._panels import ReportTable, RunPanel, ToolPanel
from napari_shadowinv._napari.widgets._qt import beside, notify_errors, timer
from napari_shadowinv._napari.widgets._results import ResultLayers, place_together
from napari_shadowinv._napari.widgets._runner import Outcome
from napari_shadowinv._napari.widgets._saving import (
    MoreLayersButton,
    SaveButton,
    field_of,
    shot_to_save,
    shown_result,
)
from napari_shadowinv._napari.widgets._shot_table import ShotTable
from napari_shadowinv._napari.widgets._stacking import StackJob, StackRequest, place_on
from napari_shadowinv._napari.widgets._watching import (
    FolderEdit,
    WatchJob,
    WatchRequest,
    last_in_view,
    newest_of,
    show_shot,
)
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.store import STORE_SUFFIX

if TYPE_CHECKING:
    import napari
    from napari_shadowinv._typing import BoolArray
    from napari_shadowinv.preprocessing import Recipe

_REFRESH_AFTER = 200  # ms; many small shots may end in a second
_MOST_FAILURES = 100
_NAME_WIDTH = 110
_LAYER, _FILES, _TABLE, _FOLDER = "layer", "files", "table", "folder"
_HERE, _SCHEDULER = "threads", "scheduler"
_BETWEEN = "; "


class _FilesEdit(PathEdit):
    def ask(self) -> str:
        paths, _ = QFileDialog.getOpenFileNames(self, self._title)
        return _BETWEEN.join(paths)


class StoreEdit(PathEdit):
    """The folder that shots are written to, new or begun."""

    def __init__(self) -> None:
        super().__init__("Store of the results", f"results{STORE_SUFFIX}")
        self.edit.setToolTip(
            f"<qt>A folder named …{STORE_SUFFIX}. If it exists, the run is resumed.</qt>"
        )

    @property
    def store(self) -> Path:
        if not self.path:
            raise InputError(
                "no store is selected for the results: choose a folder whose name ends with "
                f"{STORE_SUFFIX}"
            )
        return Path(self.path).expanduser()

    def ask(self) -> str:
        # To go on with what is there is no danger: nothing is replaced without its box.
        path, _ = QFileDialog.getSaveFileName(
            self,
            self._title,
            self.path or f"results{STORE_SUFFIX}",
            f"stores (*{STORE_SUFFIX})",
            options=QFileDialog.Option.DontConfirmOverwrite,
        )
        if not path:
            return ""
        chosen = Path(path)
        # A store is a folder, which a dialog steps into.
        for folder in (chosen, *chosen.parents):
            if folder.name.endswith(STORE_SUFFIX):
                return str(folder)
        return path + STORE_SUFFIX


class ShotsPicker(RowPicker):
    def __init__(self, viewer: Any) -> None:
        tip = "Image layer (shot, y, x); data on disk are read one shot at a time."
        self.layers = LayerPicker(viewer, ("image",), tip, suits=may_be_shot)
        self.files = _FilesEdit("Files of the shots", "shots/*.tif")
        self.files.edit.setToolTip(
            "<qt>A pattern such as shots/*.tif, files separated by ;, or a multi-page TIFF.</qt>"
        )
        self.table = ShotTable()
        self.folder = FolderEdit()
        super().__init__(
            "Shots",
            {
                _LAYER: ("a stack layer", None),
                _FILES: ("files", None),
                _TABLE: ("a table (.csv)", None),
                _FOLDER: ("a folder, watched", None),
            },
            "Location of the shots.",
            {
                _LAYER: labelled("", self.layers),
                _FILES: labelled("", self.files),
                _TABLE: self.table,
                _FOLDER: self.folder,
            },
        )
        self.layers.picked.connect(self.changed)
        self.files.changed.connect(self.changed)
        self.table.changed.connect(self.changed)
        self.folder.changed.connect(self.changed)

    @property
    def layer(self) -> Any | None:
        """The chosen layer; None where files are chosen."""
        return self.layers.layer if self.picker.kind == _LAYER else None

    @property
    def is_watched(self) -> bool:
        """Whether the shots are still to arrive."""
        return bool(self.picker.kind == _FOLDER)

    @property
    def name(self) -> str:
        """What to call the shots."""
        if self.is_watched:
            return self.folder.folder.path
        if self.picker.kind == _FILES:
            return self.files.path
        if self.picker.kind == _TABLE:
            return self.table.file.path
        return "" if self.layer is None else str(self.layer.name)

    def shots(self) -> Any:
        if self.picker.kind == _LAYER:
            return stack_of(self.layers.layer)
        if self.picker.kind == _TABLE:
            return self.table.shots()
        parts = [part.strip() for part in self.files.path.split(_BETWEEN.strip())]
        paths = [os.path.expanduser(part) for part in parts if part]
        if not paths:
            raise InputError(
                "no files are selected: enter a pattern such as shots/*.tif, or choose"
            )
        return paths[0] if len(paths) == 1 else paths


class EnginePicker(RowPicker):
    """The computer in front of the user, or a scheduler of dask."""

    def __init__(self) -> None:
        self.workers = QSpinBox()
        self.workers.setRange(0, 1024)
        self.workers.setSuffix(" at once")
        self.workers.setSpecialValueText("one per core")
        self.workers.setToolTip("Number of shots inverted at the same time.")
        self.address = QLineEdit()
        self.address.setPlaceholderText("tcp://host:8786")
        self.address.setToolTip("Address printed by 'dask scheduler' when it starts.")
        self.address.setMinimumWidth(60)
        super().__init__(
            "Run on",
            {_HERE: ("this computer", None), _SCHEDULER: ("a dask cluster", None)},
            "This does not affect the results. Cluster workers must be able to access the shots "
            "and the store at the same paths.",
            {_HERE: labelled("Jobs", self.workers), _SCHEDULER: labelled("Address", self.address)},
        )
        self.workers.valueChanged.connect(lambda _: self.changed.emit())
        self.address.editingFinished.connect(self.changed)

    def engine(self) -> tuple[str, int | None]:
        """Scheduler and number of workers, as `run_stack` takes them, or an `InputError`."""
        if self.picker.kind == _HERE:
            return "threads", self.workers.value() or None
        address = self.address.text().strip()
        if "://" not in address:
            raise InputError(
                f"the scheduler's address is '{address}': expected one such as tcp://host:8786, "
                "as printed by 'dask scheduler'"
            )
        return address, None

    def state(self) -> dict[str, Any]:
        workers, address = self.workers.value(), self.address.text()
        return {"kind": self.picker.kind, "workers": workers, "address": address}

    def restore(self, state: Mapping[str, Any]) -> None:
        self.picker.set_kind(str(state.get("kind", _HERE)))
        self.workers.setValue(int(state.get("workers", 0)))
        self.address.setText(str(state.get("address", "")))


class FailureTable(ReportTable):
    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        # Names of files have no spaces to wrap at: their ends tell them apart.
        self.setTextElideMode(Qt.TextElideMode.ElideMiddle)
        self.horizontalHeader().setSectionResizeMode(0, QHeaderView.ResizeMode.Fixed)
        self.horizontalHeader().resizeSection(0, _NAME_WIDTH)

    def show_failures(self, failures: list[tuple[str, str]]) -> None:
        """Replace what is shown, by no more than can be looked through."""
        self.count = len(failures)
        more = self.count - _MOST_FAILURES
        rows = failures[:_MOST_FAILURES] + ([("…", f"and {more} more")] if more > 0 else [])
        self.show_rows(rows)
        self.setVisible(bool(rows))


class InvertStack(InversionInputs, ToolPanel):
    """Choose shots and a store, press Run; again to go on after an interruption."""

    def __init__(self, viewer: napari.viewer.Viewer) -> None:
        tip = "Invert all shots not yet in the store."
        # A cancelled run has all the time that it needs to leave the store.
        panel = RunPanel("Invert stack", "Run", tip, patience=math.inf)
        super().__init__(viewer, "invert-stack", panel)
        self.results = ResultLayers(viewer, self)
        self._shown: StackRequest | None = None
        self._heard, self._look_at = 0, False
        self._arrows: Any = None
        self._read_arrows: Callable[[], None] | None = None
        self._soon = timer(self, _REFRESH_AFTER, self._refresh, once=True)
        self._build()
        self._connect()
        self.restore_last()
        self._on_layer()
        self._ready = True

    def _build(self) -> None:
        self.shots = ShotsPicker(self.viewer)
        self.make_inputs(
            lambda: self.shots.layer,
            ("labels",),
            "Labels marking detector pixels in all shots. The inversion ignores masked pixels, "
            "so do not mask the object.",
            "Labels that hide the object from the source estimates only; the inversion still "
            "uses it.",
        )
        self.store = StoreEdit()
        self.overwrite = QCheckBox("overwrite the store")
        self.overwrite.setToolTip("<qt>Start from scratch. Otherwise the run is resumed.</qt>")
        self.redo_failed = QCheckBox("redo failed shots")
        self.redo_failed.setToolTip("<qt>Retry shots that failed in an earlier run.</qt>")
        self.engine = EnginePicker()
        self.report = ReportTable()
        self.save_result = SaveButton(
            self,
            lambda: shot_to_save(self.viewer, shown_result(self.viewer, self._fields_shown())),
            "Write the shot in view to a file of its own. The store holds all shots already.",
        )
        self.more_layers = MoreLayersButton(self, lambda: self.results)
        self.failures_title = QLabel("Failed shots")
        self.failures_title.setVisible(False)
        self.failures = FailureTable()
        self.add(self.shots, *self.beam, *self.how, labelled("Store", self.store))
        self.add(labelled("", self.overwrite), labelled("", self.redo_failed), self.engine)
        self.add(self.panel, beside((self.save_result, 1), (self.more_layers, 1)))
        self.add(self.report, self.failures_title, self.failures)

    def _connect(self) -> None:
        self.shots.changed.connect(self._on_layer)
        for part in (*self.inputs, self.engine):
            part.changed.connect(self.keep)
        self.panel.runner.progressed.connect(self._on_progress)

    def parts(self) -> dict[str, Any]:
        return {**super().parts(), "engine": self.engine}

    def request(self) -> StackRequest:
        layer = self.shots.layer
        recipe = self.recipe()
        mask = self.masks.usable(layer)
        self.source.check(mask)
        if self.shots.is_watched:
            return self._watch(recipe, mask)
        scheduler, workers = self.engine.engine()
        job = StackJob(
            shots=self.shots.shots(),
            out=self.store.store,
            recipe=recipe,
            source=self._source(layer),
            mask=mask,
            source_mask=self.hidden_from_source(layer),
            scheduler=scheduler,
            workers=workers,
            overwrite=self.overwrite.isChecked(),
            redo_failed=self.redo_failed.isChecked(),
        )
        return StackRequest(
            job,
            layer,
            self.companions(layer),
            {} if layer is None else place_on(layer, recipe),
            self.origins(layer, self.shots.name),
        )

    def _fields_shown(self) -> list[Any]:
        return field_of(self.results.layers)

    def _watch(self, recipe: Recipe, mask: BoolArray | None) -> WatchRequest:
        job = WatchJob(
            shots=self.shots.folder.path,
            out=self.store.store,
            pattern=self.shots.folder.pattern.text().strip(),
            recipe=recipe,
            source=self._source(None),
            mask=mask,
            source_mask=self.hidden_from_source(None),
            overwrite=self.overwrite.isChecked(),
            redo_failed=self.redo_failed.isChecked(),
        )
        origins = self.origins(None, self.shots.name)
        return WatchRequest(job, None, self.companions(None), {}, origins)

    def _source(self, layer: Any) -> ArrayLike | None:
        # A run may have a source for each shot.
        chosen = self.source.layers.layer
        if self.source.picker.kind == "layer" and chosen is not None and chosen.ndim == 3:
            return stack_of(chosen)
        beam = self.source.measured(layer)
        return None if beam is None else beam.image

    # A run

    def _on_progress(self, news: Progress) -> None:
        if news.stage == "shots" or (news.stage == "wait" and news.step):
            self._show(self.panel.runner.tag)

    def _show(self, request: StackRequest) -> None:
        # Once it is done: to press Run again must not throw these shots away.
        self.overwrite.setChecked(False)
        self.redo_failed.setChecked(False)
        books = request.job.books
        if len(books.failures) != self.failures.count:
            self._show_failures(list(books.failures))
        if request.described and request is not self._shown:
            self._show_layers(request)
        elif books.ended > self._heard and not self._soon.isActive():
            self._soon.start()
        self._heard = books.ended

    def _show_layers(self, request: StackRequest) -> None:
        earlier, self._shown = self._shown, request
        again = earlier is not None and earlier.job.out == request.job.out
        setup = request.job.recipe.setup
        if request.image is not None and setup is not None:
            place_together(self.viewer, request.image, setup, request.companions)
        if earlier is not None and again:
            request.go_on_from(earlier, self.results.layers)
        else:
            self.results = ResultLayers(self.viewer, self)
            self.results.complete.connect(self._on_layers)
        self._look_at = not again and request.image is None
        described = main_layers(request.described, also=self.results.slots)
        self.results.show(described, select=not again)

    def _on_layers(self) -> None:
        # Files lie where their setup puts them, which may be far from what is in view.
        if self._look_at:
            self._look_at = False
            self.viewer.reset_view()
            if isinstance(self._shown, WatchRequest):
                show_shot(self.viewer, newest_of(self.results.layers))
        arrows = next((one for one in self.results.layers if role_of(one) == "arrows"), None)
        if arrows is not self._arrows:
            self._arrows = arrows
            self._read_arrows = None if arrows is None else follow_shots(self.viewer, arrows)
        self._soon.start()

    def _refresh(self) -> None:
        if isinstance(self._shown, WatchRequest):
            self._grow(self._shown)
        if self._shown is not None:
            self._shown.follow(self.results.layers)
        for layer in self.results.layers:
            layer.refresh()
        if self._read_arrows is not None:
            self._read_arrows()

    def _grow(self, shown: WatchRequest) -> None:
        """Show what has arrived; who has stepped back to an earlier shot is left there."""
        if self.results.busy:
            self._soon.start()
            return
        at_end = last_in_view(self.viewer, self.results.layers)
        newest = shown.renew(self.results.layers)
        if at_end and newest is not None:
            show_shot(self.viewer, newest)

    def forget(self) -> None:
        self._heard = 0
        self.report.empty()
        self._show_failures([])
        self.panel.say("")

    def _show_failures(self, failures: list[tuple[str, str]]) -> None:
        self.failures.show_failures(failures)
        self.failures_title.setVisible(bool(failures))

    @notify_errors
    def _on_end(self, outcome: Outcome) -> None:
        request: StackRequest = outcome.tag
        books = request.job.books
        if not books.total:
            if outcome.error is not None:
                return  # the panel shows why
            if self.shots.is_watched:
                self.panel.say("Ended: no shot has arrived.")
            return
        self._show(request)
        self.report.show_rows(request.origins.rows())
        if outcome.cancelled:
            self.panel.say(f"Cancelled: {books.text}; press Run to resume.")
        else:
            self.panel.say(f"{books.text}, in {request.job.out.name}")
        self.panel.status.setToolTip(str(request.job.out.absolute()))

    # Layers

    def _on_layer(self) -> None:
        layer = self.shots.layer
        # In the order of their arrival there is nothing to distribute.
        self.engine.setVisible(not self.shots.is_watched)
        self.source.follow(layer)
        self.setup.follow(layer, "" if layer is not None else self.shots.name)
        if not self.panel.runner.running:
            self.forget()
        self.keep()
