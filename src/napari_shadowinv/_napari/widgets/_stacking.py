"""A run over many shots, and the layers over its store."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._napari.layer_metadata import KEY, role_of
from napari_shadowinv._napari.widgets._layers import kind_of
from napari_shadowinv._napari.widgets._results import Origins, result_frame
from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import Recipe

if TYPE_CHECKING:
    from napari_shadowinv._napari.layers import FullLayerData
    from napari_shadowinv.stack import RunProgress


@dataclass
class RunBooks:
    """What is known of a run. Its thread writes, the window reads."""

    # Shots of the stack, with those of earlier runs
    total: int = 0
    done: int = 0
    failed: int = 0
    ended: int = 0  # in this run
    failures: list[tuple[str, str]] = field(default_factory=list)  # names, and why

    @property
    def text(self) -> str:
        failed = f", {self.failed} failed" if self.failed else ""
        return f"{self.done} of {self.total} done{failed}"

    def take(self, news: RunProgress) -> None:
        if news.outcome is not None:
            self.ended += 1
            if news.outcome.reason:
                self.failures.append((news.name, news.outcome.reason))
        self.total, self.done, self.failed = news.total, news.done, news.failed


@dataclass(frozen=True, eq=False)
class StackJob:
    """Many shots to invert into a store: the arguments of `stack.run_stack`, and its books."""

    shots: Any  # an array (shot, y, x), also a lazy one, files, or rows of a table
    out: Path
    recipe: Recipe = field(default_factory=Recipe)
    source: ArrayLike | None = None  # measured; also one for each shot
    mask: BoolArray | None = None
    source_mask: BoolArray | None = None
    scheduler: str = "threads"
    workers: int | None = None
    overwrite: bool = False
    redo_failed: bool = False
    books: RunBooks = field(default_factory=RunBooks)

    def run(
        self,
        on_progress: OnProgress,
        should_stop: ShouldStop,
        on_done: Callable[[int | None], None] = lambda _: None,
    ) -> RunBooks:
        """Invert what is not done; `on_done` gets a shot that ended well before the window does."""
        from napari_shadowinv.stack import run_stack

        def tell(news: RunProgress) -> None:
            if news.preparing:
                on_progress(Progress("prepare", 0, None, news.preparing))
                return
            if news.outcome is None:
                self._recall()
            # The window looks into the books at any time: what they tell of must be seen to.
            if news.done:
                ended = news.outcome
                on_done(None if ended is None or ended.reason else ended.index)
            self.books.take(news)
            step = news.done + news.failed
            on_progress(Progress("shots", step, news.total, self.books.text))

        on_progress(Progress("prepare", 0, None, "shots and source"))
        told = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "books"}
        run_stack(**told, on_progress=tell, should_stop=should_stop)
        return self.books

    def _recall(self) -> None:
        """Enter the failures of earlier runs that are not tried again."""
        from napari_shadowinv.io.store import FAILED, StackStore

        if self.redo_failed:
            return
        store = StackStore(self.out)
        for index in np.flatnonzero(store.statuses() == FAILED):
            reason = str(store.report(int(index)).get("reason", "unknown"))
            self.books.failures.append((store.names[index], reason))


@dataclass(frozen=True, eq=False)
class StackRequest:
    """A run, and all that it takes to show its results in layers over its store."""

    job: StackJob
    image: Any
    companions: tuple[Any, ...]
    place: dict[str, Any]
    origins: Origins
    # Empty until a shot is finished.
    described: list[FullLayerData] = field(default_factory=list)
    # Written by the run's thread, so that the window only reads them.
    _limits: dict[str, tuple[float, float]] = field(default_factory=dict)
    _earlier: dict[str, tuple[float, float]] = field(default_factory=dict)
    _given: set[tuple[float, float]] = field(default_factory=set)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Any:
        """Invert the shots, and describe the layers once one is done, beside the window."""
        return self.job.run(on_progress, should_stop, self._look)

    def follow(self, layers: Sequence[Any]) -> None:
        """Let layers whose limits the user left alone reach to the strongest shot so far."""
        for layer in filter(_is_image, layers):
            role = str(role_of(layer))
            if role not in self._limits:
                continue
            wanted = self._wanted(role)
            if wanted == tuple(layer.contrast_limits):
                continue
            if tuple(layer.contrast_limits) in self._given:
                self._given.add(wanted)
                layer.contrast_limits = wanted

    def go_on_from(self, earlier: StackRequest, layers: Sequence[Any]) -> None:
        """Take over the colours of an earlier run into the same store."""
        self._given.update(earlier._given)
        now = {role_of(one): tuple(one.contrast_limits) for one in layers if _is_image(one)}
        for _, keywords, kind in self.described:
            role = str(role_of(keywords))
            if kind == "image" and role in earlier._limits:
                self._earlier[role] = earlier._wanted(role)
                limits = self._wanted(role)
                self._given.add(limits)
                keywords["contrast_limits"] = now.get(role, limits)

    def _wanted(self, role: str) -> tuple[float, float]:
        """Limits that hold all shots of this run, and of earlier ones into the same store."""
        limits = self._limits[role]
        earlier = self._earlier.get(role)
        return limits if earlier is None else _widened(limits, np.array(earlier))

    def _look(self, index: int | None) -> None:
        """Describe the layers once a shot is done, and look how strong each one is."""
        if not self.described:
            self._describe()
        if index is None:
            return
        self._widen(self.described, index)

    def _widen(self, described: Sequence[FullLayerData], index: int) -> None:
        """Let the limits hold one more shot."""
        for data, keywords, kind in described:
            if kind == "image":
                role = str(role_of(keywords))
                self._limits[role] = _widened(self._limits[role], np.asarray(data[index]))

    def _describe(self, first: int | None = None) -> None:
        from napari_shadowinv._napari.stores import store_layers

        try:
            layers = store_layers(self.job.out, first=first)
        except (InputError, OSError):
            return  # the next shot may do, and the run goes on without
        # What napari remembers of a pending shot would hide that it is done.
        more = {"cache": False, **self.place}
        for _, keywords, kind in layers:
            keywords["metadata"][KEY]["made_from"] = self.origins.attributes()
            if kind == "image":
                limits = keywords["contrast_limits"]
                self._limits[str(role_of(keywords))] = limits
                self._given.add(limits)
        self.described.extend((data, keywords | more, kind) for data, keywords, kind in layers)


def _is_image(layer: Any) -> bool:
    return kind_of(layer) == "image"


def _widened(limits: tuple[float, float], plane: AnyArray) -> tuple[float, float]:
    """Limits that hold a plane, too; around zero if they were."""
    finite = plane[np.isfinite(plane)]
    low = min(limits[0], float(finite.min(initial=np.inf)))
    high = max(limits[1], float(finite.max(initial=-np.inf)))
    if limits[0] == -limits[1]:
        return -max(-low, high), max(-low, high)
    return low, high


def place_on(layer: Any, recipe: Recipe) -> dict[str, Any]:
    """Keywords that lay results on their stack, once that is placed by the setup."""
    keywords = result_frame(layer, recipe).keywords(stacked=True)
    first = {"scale": layer.scale, "translate": layer.translate, "units": layer.units}
    for name, values in first.items():
        keywords[name] = (values[0], *keywords[name][1:])
    return keywords
