"""A run over many shots, without napari and Qt.

- what to do: `StackJob`
- what has come of it so far, for the window to look at: `RunBooks`
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._system.progress import OnProgress, Progress, ShouldStop
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.preprocessing import Estimate, Filter, UniformEstimate

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.stack import RunProgress

__all__ = ["RunBooks", "StackJob"]

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass
class RunBooks:
    """What is known of a run. Its thread writes, the window reads.

    Attributes
    ----------
    total, done, failed : int
        Shots of the stack, with those of earlier runs.
    ended : int
        Shots that ended in this run.
    failures : list of (str, str)
        Names of failed shots, and why.
    """

    total: int = 0
    done: int = 0
    failed: int = 0
    ended: int = 0
    failures: list[tuple[str, str]] = field(default_factory=list)

    @property
    def text(self) -> str:
        """One line of it."""
        failed = f", {self.failed} failed" if self.failed else ""
        return f"{self.done} of {self.total} done{failed}"

    def take(self, news: RunProgress) -> None:
        """Enter what became of a shot."""
        if news.outcome is not None:
            self.ended += 1
            if news.outcome.reason:
                self.failures.append((news.name, news.outcome.reason))
        self.total, self.done, self.failed = news.total, news.done, news.failed


@dataclass(frozen=True, eq=False)
class StackJob:
    """Many shots to invert into a store.

    Attributes
    ----------
    shots : array of shape (shots, H, W), str or list of Path
        The images, also lazy ones, or their files.
    out : Path
        The store.
    source : array_like, Path or Estimate
        The undisturbed beam, of all shots or of each, or how to guess it for each.
    cleaning : Filter, optional
        What is done to the images first.
    mask, source_mask : ndarray of bool, shape (H, W), optional
        True where a pixel is usable, and where an estimate of the source may look.
    options, setup, scheduler, workers, overwrite, redo_failed
        See `napari_shadowinv.stack.run_stack`.
    books : RunBooks
        What becomes of it.
    """

    shots: Any
    out: Path
    source: ArrayLike | Path | Estimate = field(default_factory=UniformEstimate)
    mask: Mask | None = None
    cleaning: Filter | None = None
    options: InversionOptions = field(default_factory=InversionOptions)
    setup: Setup | None = None
    scheduler: str = "threads"
    workers: int | None = None
    overwrite: bool = False
    redo_failed: bool = False
    books: RunBooks = field(default_factory=RunBooks)
    source_mask: Mask | None = None

    def run(
        self,
        on_progress: OnProgress,
        should_stop: ShouldStop,
        on_done: Callable[[int | None], None] = lambda _: None,
    ) -> RunBooks:
        """Invert all shots that are not done yet.

        Parameters
        ----------
        on_progress, should_stop
            See `napari_shadowinv._system.progress`.
        on_done : callable, optional
            Called before it is told that there are finished shots, with the one that has just
            ended well, if any.

        Raises
        ------
        InputError, OSError
            See `napari_shadowinv.stack.run_stack`.
        InversionCancelled
            If `should_stop` returned true.
        """
        from napari_shadowinv.stack import run_stack

        def tell(news: RunProgress) -> None:
            if news.compiling:
                on_progress(Progress("compile", 0, None, news.compiling))
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
        run_stack(
            self.shots,
            self.out,
            source=self.source,
            mask=self.mask,
            source_mask=self.source_mask,
            filters=() if self.cleaning is None else (self.cleaning,),
            options=self.options,
            setup=self.setup,
            scheduler=self.scheduler,
            workers=self.workers,
            overwrite=self.overwrite,
            redo_failed=self.redo_failed,
            on_progress=tell,
            should_stop=should_stop,
        )
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
