"""A folder that is watched, and the layers over its store, which grow: `WatchRequest`."""

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
from napari_shadowinv._napari.widgets._stacking import RunBooks, StackJob, StackRequest
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.formats import NEW_SHOTS

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.stack import RunProgress, WatchProgress

_LOOK_AFTER = 0.5  # seconds between two looks at a store that falls behind its folder


class _FolderEdit(PathEdit):
    def ask(self) -> str:
        return str(QtWidgets.QFileDialog.getExistingDirectory(self, self._title, self.path))


class FolderEdit(QtWidgets.QWidget):
    """The folder in which shots appear, and what their names look like."""

    changed = Signal()

    def __init__(self) -> None:
        super().__init__()
        self.folder = _FolderEdit("Folder to watch", "folder")
        self.folder.edit.setToolTip(
            "<qt>Each file that appears here is inverted as soon as it is complete, until you "
            "press Cancel.</qt>"
        )
        self.pattern = QtWidgets.QLineEdit(NEW_SHOTS)
        self.pattern.setToolTip("Names of the shots.")
        self.pattern.setMinimumWidth(60)
        column(self, labelled("", self.folder), labelled("Names", self.pattern))
        self.folder.changed.connect(self.changed)
        self.pattern.editingFinished.connect(self.changed)

    @property
    def path(self) -> Path:
        if not self.folder.path:
            raise InputError("no folder is selected: choose the one in which the shots appear")
        return Path(self.folder.path).expanduser()


@dataclass
class WatchBooks(RunBooks):
    """What is known of a folder that is watched."""

    waiting: int = 0
    note: str = ""

    @property
    def text(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        waiting = f", {self.waiting} waiting" if self.waiting else ""
        note = f" ({self.note})" if self.note else ""
        return f"{self.done} done{failed}{waiting}{note}"

    def take(self, news: RunProgress) -> None:
        told: WatchProgress = news  # type: ignore[assignment]
        # A shot that failed before may have been written anew.
        if any(name == news.name for name, _ in self.failures):
            self.failures = [one for one in self.failures if one[0] != news.name]
        super().take(news)
        self.waiting, self.note = told.waiting, told.note or self.note


@dataclass(frozen=True, eq=False)
class WatchJob(StackJob):
    """A folder to watch, as `shots`: arguments of `stack.watch_stack`, and the books."""

    pattern: str = NEW_SHOTS
    books: RunBooks = field(default_factory=WatchBooks)

    def run(
        self,
        on_progress: OnProgress,
        should_stop: ShouldStop,
        on_done: Callable[[int | None], None] = lambda _: None,
    ) -> RunBooks:
        """Watch until it is stopped; `on_done` gets a shot that ended well, as in a run."""
        from napari_shadowinv.stack import watch_stack

        books = self.books
        assert isinstance(books, WatchBooks)

        def tell(news: WatchProgress) -> None:
            if news.preparing:
                on_progress(Progress("prepare", 0, None, news.preparing))
                return
            books.waiting = news.waiting
            ended = news.outcome
            if news.done and (ended is not None or not books.total):
                on_done(None if ended is None or ended.reason else ended.index)
            books.take(news)
            stage = "shots" if books.ended and books.waiting else "wait"
            on_progress(Progress(stage, books.ended, None, books.text))

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
            on_progress=tell,
            should_stop=should_stop,
        )
        return books


@dataclass
class _Growth:
    """How far the layers have followed the store; the run's thread writes, the window reads."""

    first: int = 0  # the shot that decides on units
    unseen: list[int] = field(default_factory=list)
    looked: float = 0.0
    described: list[FullLayerData] | None = None  # longer than what the layers show


@dataclass(frozen=True, eq=False)
class WatchRequest(StackRequest):
    """A folder that is watched; the layers get longer as shots arrive."""

    growth: _Growth = field(default_factory=_Growth)

    def renew(self, layers: Sequence[Any]) -> int | None:
        """Give layers the shots that have arrived since; return the newest if there are any."""
        described, self.growth.described = self.growth.described, None
        if described is None:
            return None
        content = {role_of(keywords): (data, keywords) for data, keywords, _ in described}
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

    def _look(self, index: int | None) -> None:
        """Describe the layers anew now and then, so that a window that is slow holds up nothing."""
        growth = self.growth
        if index is not None:
            growth.unseen.append(index)
        if not self.described:
            self._begin(index)
        elif index is not None and not self._is_due():
            return
        else:
            growth.described = self._longer()
        current = growth.described or self.described
        for number in growth.unseen if current else ():
            self._widen(current, number)
        growth.unseen.clear()
        growth.looked = time.monotonic()

    def _begin(self, index: int | None) -> None:
        from napari_shadowinv._napari.stores import first_shot

        with suppress(InputError, OSError):
            self.growth.first = first_shot(self.job.out) if index is None else index
            self._describe(self.growth.first)

    def _is_due(self) -> bool:
        books = self.job.books
        behind = isinstance(books, WatchBooks) and books.waiting > 1
        return not behind or time.monotonic() > self.growth.looked + _LOOK_AFTER

    def _longer(self) -> list[FullLayerData] | None:
        from napari_shadowinv._napari.stores import store_layers

        try:
            described = store_layers(self.job.out, first=self.growth.first)
        except (InputError, OSError):
            return None  # the next shot may do
        for _, keywords, _kind in described:
            keywords["metadata"][KEY]["made_from"] = self.origins.attributes()
        return described


def last_in_view(viewer: Any, layers: Sequence[Any]) -> bool:
    """Whether the viewer shows the newest shot of these layers."""
    lengths = [len(layer.data) for layer in layers if kind_of(layer) == "image"]
    axis = viewer.dims.ndim - 3
    return bool(lengths) and viewer.dims.current_step[axis] >= max(lengths) - 1


def show_shot(viewer: Any, shot: int) -> None:
    """Move the slider along the shots."""
    viewer.dims.set_current_step(viewer.dims.ndim - 3, shot)


def newest_of(layers: Sequence[Any]) -> int:
    """Return the number of the last shot of layers."""
    return max((len(one.data) - 1 for one in layers if kind_of(one) == "image"), default=0)
