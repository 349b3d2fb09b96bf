"""A watched folder, and the growing layers over its store: `WatchRequest`."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qtpy import QtWidgets
from qtpy.QtCore import Signal

from napari_shadowinv._napari.layer_metadata import KEY, role_of
from napari_shadowinv._napari.widgets._forms import PathEdit, labelled
from napari_shadowinv._napari.widgets._layers import kind_of
from napari_shadowinv._napari.widgets._qt import column
from napari_shadowinv._napari.widgets._stacking import StackJob, StackRequest, is_image
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import NEW_SHOTS

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.stack import RunStatus

_UPDATE_INTERVAL_S = 0.5  # while the inversion falls behind the folder


class _FolderEdit(PathEdit):
    def ask(self) -> str:
        return str(QtWidgets.QFileDialog.getExistingDirectory(self, self._title, self.path))


class FolderEdit(QtWidgets.QWidget):
    """The folder in which shots appear, and the pattern of their names."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.folder = _FolderEdit("Folder to watch", "folder")
        self.folder.edit.setToolTip(
            "<qt>Each new file in this folder is inverted as soon as it is complete, until you "
            "press Cancel.</qt>"
        )
        self.pattern = QtWidgets.QLineEdit(NEW_SHOTS)
        self.pattern.setToolTip("Pattern of the shots' file names, such as *.tif.")
        self.pattern.setMinimumWidth(60)
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
    """A folder to watch, as `shots`: the arguments of `stack.watch_stack`, and the status."""

    pattern: str = NEW_SHOTS
    waiting: int = 0  # files that have arrived
    note: str = ""

    def run(
        self,
        on_progress: OnProgress,
        should_stop: ShouldStop,
        on_done: Callable[[int | None], None] = lambda _: None,
    ) -> RunStatus:
        """Watch until stopped; `on_done` gets each finished shot, as in a run."""
        from napari_shadowinv.stack import watch_stack

        def update(status: RunStatus) -> None:
            if status.stage:
                on_progress(Progress("prepare", 0, None, status.stage))
                return
            self.waiting, self.note = status.waiting, status.note or self.note
            outcome = status.outcome
            if status.done and (outcome is not None or not self.status.total):
                on_done(None if outcome is None or outcome.reason else outcome.index)
            self.status = status
            stage = "shots" if status.ended and status.waiting else "wait"
            note = f" ({self.note})" if self.note else ""
            on_progress(Progress(stage, status.ended, None, f"{status.text}{note}"))

        watch_stack(
            self.shots,
            self.out,
            pattern=self.pattern,
            recipe=self.recipe,
            source=self.source,
            mask=self.mask,
            source_mask=self.source_mask,
            overwrite=self.overwrite,
            redo_failed=self.redo_failed,
            on_progress=update,
            should_stop=should_stop,
        )
        return self.status


@dataclass
class _Growth:
    """New shots for the layers: the run's thread writes them, the window reads them."""

    reference_shot: int = 0  # decides on units and contrast
    new_shots: list[int] = field(default_factory=list)  # not in the limits yet
    updated_at: float = 0.0  # s
    layer_data: list[FullLayerData] | None = None  # with shots that the layers do not show yet


@dataclass(frozen=True, eq=False)
class WatchRequest(StackRequest):
    """A watched folder; the layers grow as shots arrive."""

    growth: _Growth = field(default_factory=_Growth)

    def add_new_shots(self, layers: Sequence[Any]) -> int | None:
        """Add the shots that have arrived to the layers; return the newest, or None."""
        layer_data, self.growth.layer_data = self.growth.layer_data, None
        if layer_data is None:
            return None
        content = {role_of(keywords): (data, keywords) for data, keywords, _ in layer_data}
        length = 0
        for layer in layers:
            if role_of(layer) not in content:
                continue
            data, keywords = content[role_of(layer)]
            layer.metadata[KEY].update(keywords["metadata"][KEY])
            if kind_of(layer) in ("image", "labels"):
                layer.data = data
                length = len(data)
        return length - 1 if length else None

    def _update(self, index: int | None) -> None:
        """Describe the longer layers from time to time, so that the shots need not wait."""
        growth = self.growth
        if index is not None:
            growth.new_shots.append(index)
        if not self.layer_data:
            self._begin(index)
        elif index is not None and not self._is_due():
            return
        else:
            growth.layer_data = self._describe_longer()
        current = growth.layer_data or self.layer_data
        for number in growth.new_shots if current else ():
            self._include_shot(current, number)
        growth.new_shots.clear()
        growth.updated_at = time.monotonic()

    def _begin(self, index: int | None) -> None:
        from napari_shadowinv._napari.stores import first_shot

        with suppress(InputError, OSError):
            self.growth.reference_shot = first_shot(self.job.out) if index is None else index
            self._describe(self.growth.reference_shot)

    def _is_due(self) -> bool:
        is_behind = isinstance(self.job, WatchJob) and self.job.waiting > 1
        return not is_behind or time.monotonic() > self.growth.updated_at + _UPDATE_INTERVAL_S

    def _describe_longer(self) -> list[FullLayerData] | None:
        from napari_shadowinv._napari.stores import store_layers

        try:
            layer_data = store_layers(self.job.out, shot=self.growth.reference_shot)
        except (InputError, OSError):
            return None  # try again after the next shot
        for _, keywords, _kind in layer_data:
            keywords["metadata"][KEY]["made_from"] = self.origins.attributes()
        return layer_data


def shot_in_view(viewer: Any, layers: Sequence[Any]) -> int | None:
    """Return the shot of the layers that the viewer shows; None without a shot in view."""
    shot = int(viewer.dims.current_step[viewer.dims.ndim - 3]) if viewer.dims.ndim > 2 else -1
    return shot if 0 <= shot <= newest_shot(layers) and any(map(is_image, layers)) else None


def is_newest_in_view(viewer: Any, layers: Sequence[Any]) -> bool:
    """Whether the viewer shows the newest shot of the layers."""
    axis = viewer.dims.ndim - 3
    return any(map(is_image, layers)) and viewer.dims.current_step[axis] >= newest_shot(layers)


def show_shot(viewer: Any, shot: int) -> None:
    """Move the slider along the shots."""
    viewer.dims.set_current_step(viewer.dims.ndim - 3, shot)


def newest_shot(layers: Sequence[Any]) -> int:
    """Return the index of the last shot of the layers."""
    return max((len(layer.data) - 1 for layer in filter(is_image, layers)), default=0)
