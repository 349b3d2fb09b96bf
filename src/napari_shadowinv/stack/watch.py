"""Watch a folder and invert each shot into a store as soon as it arrives: `watch_stack`.

- the loop over files that arrive: `Watch`
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated, defer_interrupts
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model
from napari_shadowinv.errors import FileFormatError, InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.files import sha256, text_of
from napari_shadowinv.io.frames import counts_text
from napari_shadowinv.io.store import DONE, FAILED, PENDING, SKIPPED, StackStore, check_store_path
from napari_shadowinv.io.store_writing import (
    GrowingStore,
    create_store,
    remove_unfinished,
    summarise,
)
from napari_shadowinv.pipeline.run_options import WatchOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._arrivals import Arrivals, checked_folder
from napari_shadowinv.stack._plan import (
    Stack,
    describe_stack,
)
from napari_shadowinv.stack._run import (
    WATCHING,
    OnStatus,
    RunStatus,
    contents_of,
    match_store,
    stored_variables,
)
from napari_shadowinv.stack._schedulers import Scheduler, scheduler_for
from napari_shadowinv.stack._shots import (
    FileExposure,
    NoShotError,
    Reader,
    Shots,
    read_shot,
    stamp,
)
from napari_shadowinv.stack._status_file import status_file
from napari_shadowinv.stack._worker import ShotOutcome, TaskContext

if TYPE_CHECKING:
    import xarray

_CLOCK_RESOLUTION_S = 2.0  # of file times, on any file system


class Watch:
    """The loop over a folder: files that are complete are run like the shots of any stack.

    With `latest`, the newest file is next, and all others that wait are skipped.
    """

    def __init__(
        self,
        path: Path,
        options: WatchOptions,
        describe: Callable[[Shots], Stack],
        reader: Reader,
        arrivals: Arrivals,
        on_progress: OnStatus,
        should_stop: ShouldStop | None,
    ) -> None:
        self._path, self._options, self._describe, self._reader = path, options, describe, reader
        self._arrivals, self._on_progress, self._should_stop = arrivals, on_progress, should_stop
        self.store: GrowingStore | None = None
        self._stack: Stack | None = None
        # Reports of failures before the first good shot, which creates the store or fits it.
        self._early: dict[str, dict[str, Any]] = {}
        self._doubtful: set[str] = set()
        self._failures: dict[str, str] = {}
        self._redo: set[str] = set()
        self._skipped: dict[str, None] = {}  # not in the store yet, in order of arrival
        self._running: dict[int, str] = {}
        self._ended = 0
        self._last = time.monotonic()
        self._busy_s = 0.0
        self._left_out: Counter[str] = Counter()  # as reported

    def report(self, **news: Any) -> None:
        """Report the numbers of shots, and some news."""
        early, store = len(self._early), self.store
        status = RunStatus(
            total=early + (0 if store is None else len(store)),
            done=0 if store is None else store.count(DONE),
            failed=early + (0 if store is None else store.count(FAILED)),
            doubtful=len(self._doubtful),
            skipped=len(self._skipped) + (0 if store is None else store.count(SKIPPED)),
            waiting=len(self._arrivals.waiting) + len(self._running),
            ended=self._ended,
            seconds=self._busy_s,
            scheduler=WATCHING,
            failures=tuple(self._failures.items()),
        )
        self._on_progress(replace(status, **news))

    def open(self) -> None:
        """Open or check the store before any shot arrives, as far as possible."""
        with suppress(NoShotError):  # the shape is unknown until a shot has arrived
            self._stack = self._stack_of(())
        if self._options.overwrite or not self._path.exists():
            return
        store = StackStore(self._path)
        if self._stack is not None:
            match_store(store, self._stack)
        remove_unfinished(self._path)
        summarise(store)  # the last watch may have been killed before it did
        again = (PENDING, SKIPPED, *([FAILED] if self._options.redo_failed else []))
        self._redo = {store.names[i] for i in np.flatnonzero(np.isin(store.statuses(), again))}
        for name, report in zip(store.names, store.reports(), strict=True):
            self._note_outcome(name, report.get("reason", ""), bool(report.get("warnings")))
        self.store = GrowingStore(store)

    def _stack_of(self, names: Iterable[str]) -> Stack:
        stack = self._describe(Shots([self._shot(name) for name in names], (0, 0)))
        return replace(stack, dtype=self._options.dtype)

    def _shot(self, name: str) -> FileExposure:
        return FileExposure(text_of(name), self._arrivals.folder / name, self._reader)

    def run(self) -> None:
        """Invert existing and arriving files until the watch ends."""
        self._last = time.monotonic()
        self._arrivals.look()
        for name in () if self._options.latest else self._redo:
            self._arrivals.look_again(name)
        self.report()
        try:
            with scheduler_for("threads") as scheduler:
                while not self._is_over():
                    if self._arrivals.left_out.keys() - self._left_out.keys():
                        self._report_left_out()
                    self._arrivals.look()
                    if names := self._next():
                        self._invert(names, scheduler)
                    elif not self._arrivals.waiting:
                        time.sleep(self._arrivals.poll_s)
            if self._arrivals.left_out != self._left_out:
                self._report_left_out()
        except InversionCancelled:
            pass
        finally:
            if self.store is not None:
                with suppress(OSError):  # the folder's own copy has the length
                    self._close(self.store)
            elif self._options.latest:
                self._skip(self._arrivals.waiting)
            self.report()

    def _close(self, store: GrowingStore) -> None:
        """Note the shots that were still running, and what was skipped."""
        for index in self._running:
            store.end(index)
        names = self._running.values()
        unfinished = [name for name in names if store.status(text_of(name)) == PENDING]
        self._running.clear()
        if self._options.latest:
            self._skip([*unfinished, *self._arrivals.waiting])
            self._arrivals.waiting.clear()
        else:
            self._arrivals.waiting[:0] = unfinished
        store.skip(self._skipped)
        self._skipped.clear()
        store.close()

    def _report_left_out(self) -> None:
        """Count the files that are no shots in a sentence."""
        self._left_out = self._arrivals.left_out
        counts = counts_text(self._left_out) or "none"
        self.report(note=f"Left out: {counts}; choose others by a pattern of names")

    def _is_over(self) -> bool:
        idle, most = self._options.idle, self._options.max_shots
        if (most is not None and self._ended >= most) or (
            self._should_stop and self._should_stop()
        ):
            return True
        quiet = time.monotonic() - max(self._arrivals.last_change, self._last)
        return idle is not None and quiet > idle and self._arrivals.is_quiet

    def _next(self, most: int = 1000) -> list[str]:
        """Take the next files that wait."""
        waiting, names = self._arrivals.waiting, list[str]()
        if self._options.latest:
            self._skip(waiting[:-1])
            del waiting[:-1]
        if self._options.latest or self.store is None:
            most = 1
        if self._options.max_shots is not None:
            most = min(most, self._options.max_shots - self._ended)
        while waiting and len(names) < most:
            name = waiting.pop(0)
            if self._has_changed(name):
                names.append(name)
        return names

    def _skip(self, names: Iterable[str]) -> None:
        """Note shots that are not inverted, unless an earlier version of them was."""
        for name in map(text_of, names):
            is_stored = self.store is not None and self.store.status(name) == SKIPPED
            if not is_stored and self._previous_report(name) is None:
                self._skipped[name] = None

    def _has_changed(self, name: str) -> bool:
        """Return whether a file is new, or another than the one that was inverted."""
        self._skipped.pop(text_of(name), None)
        file = self._shot(name)
        try:
            report = self._previous_report(text_of(name))
            age_s = time.time() - file.path.stat().st_mtime
            if report is None:
                return True
            # Within the resolution of file times it may have changed at the same time.
            if age_s < _CLOCK_RESOLUTION_S and "sha256" in report:
                return bool(sha256(file.path) != report["sha256"])
            return not file.unchanged(report)
        except OSError:
            self._arrivals.check()
            return False  # removed before its turn

    def _previous_report(self, name: str) -> dict[str, Any] | None:
        """Return the report of a shot that has ended before; None if it has not."""
        store = self.store
        status = None if store is None else store.status(name)
        if store is None or status is None or name in self._early:
            return self._early.get(name)
        return None if name in self._redo or status in (PENDING, SKIPPED) else store.report(name)

    def _invert(self, files: list[str], scheduler: Scheduler) -> None:
        """Run some shots like those of any stack, and note their outcomes."""
        began = time.monotonic()
        if reason := self._prepare(files[0]):
            self._fail_early(text_of(files[0]), reason)
            return
        assert self._stack is not None
        shots = [self._shot(name) for name in files]
        again = {shot.name for shot in shots if self._previous_report(shot.name) is not None}
        store = self.store or self._create_store(shots[0].name)
        with defer_interrupts():
            store.skip(self._skipped, *self._early, *(shot.name for shot in shots))
            self._skipped.clear()
            numbered = {store.reopen(shot.name): shot for shot in shots}
            for name, report in self._early.items():
                if name not in again:  # else its file has changed since
                    store.fail(name, report)
            self._early.clear()
        self._running = dict(zip(numbered, files, strict=True))
        # Alone, a shot has all the cores.
        workers = min(len(files), scheduler.workers or 1)
        results: dict[int, Any] = {}
        context = TaskContext(store.writer, self._stack.task, workers, results)
        outcomes = scheduler.outcomes(numbered, self._stack.beam, context, self._should_stop)
        with closing(outcomes):
            for outcome in outcomes:
                if outcome.reason:
                    self._check_folder(store, outcome)
                store.end(outcome.index)
                del self._running[outcome.index]
                self._ended += 1
                self._last = time.monotonic()
                self._busy_s += self._last - began
                began = self._last
                name = numbered[outcome.index].name
                self._redo.discard(name)
                self._note_outcome(name, outcome.reason, bool(outcome.warnings))
                result = results.pop(outcome.index)
                self.report(name=name, outcome=outcome, result=result, again=name in again)

    def _check_folder(self, store: GrowingStore, outcome: ShotOutcome) -> None:
        """Raise an error if a shot failed because the folder disappeared; it stays pending."""
        try:
            self._arrivals.check()
        except FileFormatError:
            store.reopen(self._running[outcome.index])
            raise

    def _note_outcome(self, name: str, reason: str, is_doubtful: bool) -> None:
        """Note whether a shot has failed or is doubtful, instead of its earlier outcome."""
        self._failures.pop(name, None)
        self._doubtful.discard(name)
        if reason:
            self._failures[name] = reason
        elif is_doubtful:
            self._doubtful.add(name)

    def _fail_early(self, name: str, reason: str) -> None:
        self._early[name] = {"reason": reason}
        with suppress(OSError):  # it may be gone
            self._early[name] |= stamp(self._arrivals.folder / name)
        self._ended += 1
        self._last = time.monotonic()
        self._note_outcome(name, reason, is_doubtful=False)
        self.report(name=name, outcome=ShotOutcome(len(self._early) - 1, FAILED, 0.0, reason))

    def _prepare(self, name: str, most: int = 10) -> str:
        """Describe the stack by its first shots; return why that is impossible so far."""
        if self._stack is not None:
            return ""
        known: Iterable[str] = ()
        if self.store is not None:
            # Earlier shots are a better reference for the size of the images.
            known = (done for done in self.store.names_of(DONE) if self._is_there(done))
        names = [name, *self._arrivals.waiting, *self._skipped]
        try:
            self._stack = self._stack_of([*islice(known, most), *names[:most]])
        except NoShotError as error:
            return error.reason
        if self.store is not None:
            match_store(StackStore(self._path), self._stack)
        return ""

    def _is_there(self, name: str) -> bool:
        return (self._arrivals.folder / name).exists()

    def _create_store(self, name: str) -> GrowingStore:
        assert self._stack is not None
        names = dict.fromkeys([*self._early, *self._skipped, name])
        shots = replace(self._stack.shots, items=[self._shot(each) for each in names])
        contents = contents_of(replace(self._stack, shots=shots))
        created = create_store(self._path, contents, overwrite=self._options.overwrite)
        self.store = GrowingStore(created)
        return self.store


def watch_stack(
    folder: str | Path,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    source: Any = None,
    mask: ArrayLike | None = None,
    source_mask: ArrayLike | None = None,
    reader: Reader = read_shot,
    watch: WatchOptions | None = None,
    on_progress: OnStatus | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset | None:
    """Invert, or fit, each file that arrives in a folder as soon as it is completely written.

    Existing files come first, in counting order of their names, then new ones in the order in
    which they were completed; each gets the next number of the store. With `WatchOptions.latest`,
    the newest file comes first, and those that came meanwhile are skipped until a call without it.
    A file that cannot be inverted fails alone, with its reason. A file that is written again later
    is inverted again, under the same number. Another call with the same store resumes it, without
    repeating shots.

    Parameters
    ----------
    folder : str or Path
        Folder in which the files appear. Its subfolders are ignored.
    out : str or Path
        The store, ``name.shadowinv.zarr``, created once a shot can be read.
    recipe, source, mask, source_mask, reader
        As for `run_stack`; one source for all shots.
    watch : WatchOptions, optional
        Choices of the watch: names of the files, when to stop, and the store. A mapping
        is converted.
    on_progress : callable, optional
        Receives a `RunStatus` at the start, after each shot, and at the end.
    should_stop : callable, optional
        Called regularly, also in other threads; the watch ends when it returns true. Unfinished
        shots are inverted when it is resumed.

    Returns
    -------
    xarray.Dataset or None
        The store, opened lazily; None if no shot could be read.

    Raises
    ------
    InputError
        If the arguments do not fit together, or not to the store.
    FileFormatError
        If the store cannot be used, another process is writing to it, or the folder disappears.
    OSError
        If the disk is full; the store can be resumed.
    """
    watch = as_model(WatchOptions, watch, "watch")
    place = checked_folder(folder, watch.pattern)
    path = check_store_path(out)
    variables = stored_variables(watch.variables, recipe)

    def describe(arrived: Shots) -> Stack:
        return describe_stack(arrived, recipe, source, mask, source_mask, reader, variables)

    arrivals = Arrivals(place, watch.pattern, settle=watch.settle, existing=not watch.skip_existing)
    on_progress = on_progress or (lambda _: None)
    with ExitStack() as opened:
        if watch.status_file is not None:
            status = status_file(watch.status_file, arrivals, path, on_progress)
            on_progress = opened.enter_context(status)
        loop = Watch(path, watch, describe, reader, arrivals, on_progress, should_stop)
        try:
            ensure_compiled(
                lambda news: loop.report(stage=f"compiling, {news.message}"), should_stop
            )
        except InversionCancelled:
            return None
        with clear_up_when_terminated(), locked(path):
            loop.open()
            loop.run()
        return None if loop.store is None else read_stack(path)
