"""Runs over many shots or a watched folder, and the layers over their store."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike
from qtpy import QtWidgets
from qtpy.QtCore import Signal

from napari_shadowinv._napari.form import PathEdit, labelled
from napari_shadowinv._napari.jobs import Job
from napari_shadowinv._napari.layer_metadata import KEY, role_of
from napari_shadowinv._napari.layers import FullLayerData, LayerData, widen_limits
from napari_shadowinv._napari.stores import first_shot, store_layers
from napari_shadowinv._napari.widgets._layers import kind_of
from napari_shadowinv._napari.widgets._qt import column
from napari_shadowinv._napari.widgets._results import result_frame
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

if TYPE_CHECKING:
    from napari_shadowinv.stack import RunStatus


def _empty_status() -> RunStatus:
    from napari_shadowinv.stack import RunStatus

    return RunStatus()


@dataclass(eq=False)
class StackJob(Job):
    """Shots to invert into a store, the status of the run, and the layers over the store."""

    shots: Any  # an array (shot, y, x), also a lazy one, files, or rows of a table
    out: Path
    recipe: Recipe = field(default_factory=Recipe)
    source: ArrayLike | None = None  # measured; for all shots, or one for each
    mask: BoolArray | None = None
    source_mask: BoolArray | None = None
    run_options: RunOptions = field(default_factory=RunOptions)
    scheduler: str = "threads"
    image: Any = None  # the layer of the shots
    companions: tuple[Any, ...] = ()  # layers that lie on the image
    placement: Mapping[str, Any] = field(default_factory=dict)  # keywords of the layers
    inputs: Sequence[tuple[str, str]] = ()  # rows of the report
    attributes: Mapping[str, str] = field(default_factory=dict)  # origins that are saved
    status: RunStatus = field(default_factory=_empty_status)  # the window reads it at any time
    waiting: int = 0  # shots that have not ended, or files that have arrived
    note: str = ""
    layer_data: LayerData = field(default_factory=list)  # empty until a shot is finished
    # Written by the run's thread; the window only reads them.
    _limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _earlier: dict[str, tuple[float, float]] = field(default_factory=dict)
    _applied: set[tuple[float, float]] = field(default_factory=set)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> RunStatus:
        """Invert the pending shots, and describe the layers once one shot is done."""

        def update(status: RunStatus) -> None:
            if status.stage:
                on_progress(Progress("prepare", 0, None, status.stage))
                return
            self.waiting, self.note = status.waiting, status.note or self.note
            # The layers must be ready before the window reads the status.
            if self._changes_layers(status):
                outcome = status.outcome
                self._update(None if outcome is None or outcome.reason else outcome.index)
            self.status = status
            on_progress(self._progress(status))

        on_progress(Progress("prepare", 0, None, "shots and source"))
        shots = Shot(self.shots, source=self.source, mask=self.mask, source_mask=self.source_mask)
        self._start(shots, self.out, self.recipe, on_progress=update, should_stop=should_stop)
        return self.status

    def _start(self, *args: Any, **keywords: Any) -> None:
        from napari_shadowinv.stack import run_stack

        run_stack(*args, run=self.run_options, scheduler=self.scheduler, **keywords)

    def _changes_layers(self, status: RunStatus) -> bool:
        """Whether the layers may change with a status that follows the current one."""
        return bool(status.done)

    def _progress(self, status: RunStatus) -> Progress:
        return Progress("shots", status.done + status.failed, status.total, status.text)

    def layers(self, content: RunStatus) -> LayerData:
        """Return the layers described by the run, which grow with it."""
        return self.layer_data

    def update_limits(self, layers: Sequence[Any]) -> None:
        """Extend limits that the user has not changed to the strongest shot so far."""
        for layer in filter(is_image, layers):
            role, current = str(role_of(layer)), tuple(layer.contrast_limits)
            if role in self._limits and current in self._applied:
                limits = self._run_limits(role)
                self._applied.add(limits)
                if limits != current:
                    layer.contrast_limits = limits

    def continue_from(self, earlier: StackJob, layers: Sequence[Any]) -> None:
        """Take over the contrast of an earlier run into the same store."""
        self._applied.update(earlier._applied)
        images = filter(is_image, layers)
        current = {role_of(layer): tuple(layer.contrast_limits) for layer in images}
        for _, keywords, kind in self.layer_data:
            role = str(role_of(keywords))
            if kind == "image" and role in earlier._limits:
                self._earlier[role] = earlier._run_limits(role)
                limits = self._run_limits(role)
                self._applied.add(limits)
                keywords["contrast_limits"] = current.get(role, limits)

    def _run_limits(self, role: str) -> tuple[float, float]:
        """Limits over all shots of this run and of earlier runs into the same store."""
        limits = self._limits[role]
        earlier = self._earlier.get(role, limits)
        return min(limits[0], earlier[0]), max(limits[1], earlier[1])

    def _update(self, index: int | None) -> None:
        """Describe the layers once a shot is done, and include each shot in the limits."""
        if not self.layer_data:
            self._describe()
        if index is not None:
            self._include_shot(self.layer_data, index)

    def _include_shot(self, layer_data: Sequence[FullLayerData], index: int) -> None:
        for data, keywords, kind in layer_data:
            if kind == "image":
                role = str(role_of(keywords))
                self._limits[role] = widen_limits(self._limits[role], np.asarray(data[index]))

    def _store_layers(self, shot: int | None) -> LayerData:
        """Describe the layers of the store; none if that has to wait for the next shot."""
        try:
            layers = store_layers(self.out, shot=shot)
        except (InputError, OSError):
            return []
        for _, keywords, _kind in layers:
            keywords["metadata"][KEY]["made_from"] = dict(self.attributes)
        return layers

    def _describe(self, shot: int | None = None) -> None:
        layers = self._store_layers(shot)
        # napari's cache of a pending shot would hide that it is done.
        placement = {"cache": False, **self.placement}
        for _, keywords, kind in layers:
            if kind == "image":
                limits = keywords["contrast_limits"]
                self._limits[str(role_of(keywords))] = limits
                self._applied.add(limits)
        self.layer_data += [(data, keywords | placement, kind) for data, keywords, kind in layers]


def is_image(layer: Any) -> bool:
    return kind_of(layer) == "image"


def placement_on(layer: Any, recipe: Recipe) -> dict[str, Any]:
    """Return the keywords that place results on their stack, with the setup's pixels."""
    keywords = result_frame(layer, recipe).keywords(stacked=True)
    for name in ("scale", "translate", "units"):
        keywords[name] = (getattr(layer, name)[0], *keywords[name][1:])
    return keywords


_UPDATE_INTERVAL_S = 0.5  # while the inversion falls behind the folder


class _FolderEdit(PathEdit):
    def ask(self) -> str:
        return str(QtWidgets.QFileDialog.getExistingDirectory(self, self._title, self.path))


class FolderEdit(QtWidgets.QWidget):
    """The folder in which shots appear, and the pattern of their names."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.folder = _FolderEdit(
            "Folder to watch",
            "folder",
            "Each new file in this folder is inverted as soon as it is complete, until you press "
            "Cancel.",
        )
        tip = "Pattern of the shots' file names, such as *.tif."
        self.pattern = QtWidgets.QLineEdit(WatchOptions().pattern, toolTip=tip, minimumWidth=60)
        column(self, labelled("", self.folder), labelled("Names", self.pattern))
        self.folder.changed.connect(self.changed)
        self.pattern.editingFinished.connect(self.changed)

    @property
    def path(self) -> Path:
        if not self.folder.path:
            raise InputError("no folder is selected: choose the folder in which the shots appear")
        return Path(self.folder.path).expanduser()


@dataclass(eq=False)
class WatchJob(StackJob):
    """A folder to watch, as `shots`; the layers grow as shots arrive."""

    watch_options: WatchOptions = field(default_factory=WatchOptions)
    newest: int = 0  # the last shot that could be inverted
    _reference_shot: int = 0  # decides on units and contrast
    _new_shots: list[int] = field(default_factory=list)  # not in the limits yet
    _updated_at: float = 0.0  # s
    # With shots that the layers do not show yet; the window takes it from the run's thread.
    _longer_data: LayerData | None = None

    def _start(self, *args: Any, **keywords: Any) -> None:
        from napari_shadowinv.stack import watch_stack

        watch_stack(*args, watch=self.watch_options, **keywords)

    def _changes_layers(self, status: RunStatus) -> bool:
        return bool(status.done) and (status.outcome is not None or not self.status.total)

    def _progress(self, status: RunStatus) -> Progress:
        stage = "shots" if status.ended and status.waiting else "wait"
        note = f" ({self.note})" if self.note else ""
        return Progress(stage, status.ended, None, f"{status.text}{note}")

    def add_new_shots(self, layers: Sequence[Any]) -> None:
        """Add the shots that have arrived to the layers."""
        layer_data, self._longer_data = self._longer_data, None
        if layer_data is None:
            return
        content = {role_of(keywords): (data, keywords) for data, keywords, _ in layer_data}
        for layer in layers:
            if role_of(layer) not in content:
                continue
            data, keywords = content[role_of(layer)]
            layer.metadata[KEY].update(keywords["metadata"][KEY])
            if kind_of(layer) in ("image", "labels"):
                layer.data = data

    def _update(self, index: int | None) -> None:
        """Describe the longer layers from time to time, so that the shots need not wait."""
        if index is not None:
            self._new_shots.append(index)
            self.newest = max(self.newest, index)
        is_behind = self.waiting > 1 and time.monotonic() <= self._updated_at + _UPDATE_INTERVAL_S
        if not self.layer_data:
            with suppress(InputError, OSError):
                self._reference_shot = first_shot(self.out) if index is None else index
                self.newest = max(self.newest, self._reference_shot)
                self._describe(self._reference_shot)
        elif index is not None and is_behind:
            return
        else:
            self._longer_data = self._store_layers(self._reference_shot) or None
        current = self._longer_data or self.layer_data
        for number in self._new_shots if current else ():
            self._include_shot(current, number)
        self._new_shots.clear()
        self._updated_at = time.monotonic()


def shot_in_view(viewer: Any, layers: Sequence[Any]) -> int | None:
    """Return the shot of the layers that the viewer shows; None without a shot in view."""
    shot = int(viewer.dims.current_step[viewer.dims.ndim - 3]) if viewer.dims.ndim > 2 else -1
    return shot if 0 <= shot <= newest_shot(layers) and any(map(is_image, layers)) else None


def show_shot(viewer: Any, shot: int) -> None:
    """Move the slider along the shots."""
    viewer.dims.set_current_step(viewer.dims.ndim - 3, shot)


def newest_shot(layers: Sequence[Any]) -> int:
    """Return the index of the last shot of the layers."""
    return max((len(layer.data) - 1 for layer in filter(is_image, layers)), default=0)
