"""Watch a folder and invert each shot into a store as soon as it arrives: `watch_stack`.

- the loop over files that arrive: `Watch`
"""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated, defer_interrupts
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.files import sha256, text_of
from napari_shadowinv.io.frames import counts_text
from napari_shadowinv.io.store import DONE, FAILED, PENDING, SKIPPED, StackStore, check_store_path
from napari_shadowinv.io.store_writing import GrowingStore, create_store, remove_unfinished
from napari_shadowinv.pipeline.run_options import WatchOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._arrivals import Arrivals, checked_folder
from napari_shadowinv.stack._plan import (
    MAX_TRIED_SHOTS,
    Stack,
    describe_stack,
    needed_shares,
    with_enough_sites,
)
from napari_shadowinv.stack._run import (
    WATCHING,
    OnStatus,
    RunStatus,
    contents_of,
    match_store,
    stored_variables,
)
from napari_shadowinv.stack._shots import (
    Exposure,
    FileReference,
    ImageReference,
    Reader,
    Shots,
    read_shot,
    stamp,
)
from napari_shadowinv.stack._status_file import status_file
from napari_shadowinv.stack._worker import (
    AnyTask,
    Attempt,
    ShotOutcome,
    failure_text,
    try_shot,
    write_shot,
)

if TYPE_CHECKING:
    import xarray

_LANES = 2  # simultaneous shots
_CLOCK_RESOLUTION_S = 2.0  # of file times, on any file system


def _is_unchanged(file: FileReference, report: dict[str, Any], stamp_now: dict[str, int]) -> bool:
    # Within the resolution of file times it may have changed at the same time.
    if time.time() - stamp_now["mtime_ns"] / 1e9 < _CLOCK_RESOLUTION_S and "sha256" in report:
        return bool(sha256(file.path) == report["sha256"])
    return file.unchanged(report)


class _ShapeUnknownError(Exception):
    """The shape is unknown until a shot has arrived."""


class _NoImage(ImageReference):
    """Placeholder before any shot has arrived."""

    def shape(self) -> tuple[int, ...]:
        raise _ShapeUnknownError


@dataclass(frozen=True, eq=False)
class _RunningShot:
    name: str
    stamp_before: dict[str, int]  # of its file, before it was read
    attempt: Future[Attempt]


class Watch:
    """The loop: inverts two files simultaneously, and writes them in the order of arrival.

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
        # Failures before the first good shot, which creates the store or proves that it fits.
        self._early: dict[str, dict[str, Any]] = {}
        self._doubtful: set[str] = set()
        self._failures: dict[str, str] = {}
        self._stack: Stack | None = None
        self._task: AnyTask | None = None  # once the number of sites is known
        self._pool = ThreadPoolExecutor(_LANES)
        self._abandoned = Event()
        self._running: deque[_RunningShot] = deque()
        self._redo: set[str] = set()
        self._skipped: dict[str, None] = {}  # not in the store yet, in order of arrival
        self._ended = 0
        self._last = self._busy_since = time.monotonic()
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
            seconds=self._busy_s + (time.monotonic() - self._busy_since if self._running else 0.0),
            scheduler=WATCHING,
            failures=tuple(self._failures.items()),
        )
        self._on_progress(replace(status, **news))

    def open(self) -> None:
        """Open or check the store before any shot arrives, as far as possible."""
        with suppress(_ShapeUnknownError):  # until a shot has arrived
            self._stack = self._stack_of([Exposure("", _NoImage())])
        if self._options.overwrite or not self._path.exists():
            return
        store = StackStore(self._path)
        again = (PENDING, SKIPPED, *([FAILED] if self._options.redo_failed else []))
        self._redo = {store.names[i] for i in np.flatnonzero(np.isin(store.statuses(), again))}
        for name, report in zip(store.names, store.reports(), strict=True):
            self._note_report(name, report)
        self.store = GrowingStore(store)
        if self._stack is not None:
            self._use_stack(match_store(store, self._stack))

    def _stack_of(self, shots: Iterable[Exposure]) -> Stack:
        """Return the stack of some shots, the first of which can be read."""
        stack = self._describe(Shots(list(shots), (0, 0)))
        return replace(stack, as_arrived=True, dtype=self._options.dtype)

    def _file(self, name: str) -> FileReference:
        return FileReference(self._arrivals.folder / name, self._reader)

    def _shot(self, name: str) -> Exposure:
        return Exposure(text_of(name), self._file(name))

    def run(self) -> None:
        """Invert existing and arriving files until the watch ends."""
        self._last = time.monotonic()
        self._arrivals.look()
        for name in () if self._options.latest else self._redo:
            self._arrivals.look_again(name)
        self.report()
        try:
            while not self._is_over():
                if self._arrivals.left_out.keys() - self._left_out.keys():
                    self._report_left_out()
                self._advance()
            if self._arrivals.left_out != self._left_out:
                self._report_left_out()
        except InversionCancelled:
            pass
        finally:
            self._abandoned.set()
            self._pool.shutdown(cancel_futures=True)
            if self._options.latest:
                names = [*(shot.name for shot in self._running), *self._arrivals.waiting]
                self._running.clear()
                self._arrivals.waiting.clear()
                self._skip(names)
            if self.store is not None:
                with suppress(OSError):  # a watch without this choice finds their files
                    self._store_skipped(self.store)
                with suppress(OSError):  # the folder's own copy has the length
                    self.store.close()
            self.report()

    def _report_left_out(self) -> None:
        """Count the files that are no shots in a sentence."""
        self._left_out = self._arrivals.left_out
        counts = counts_text(self._left_out) or "none"
        self.report(note=f"Left out: {counts}; choose others by a pattern of names")

    def _is_over(self) -> bool:
        idle, most = self._options.idle, self._options.max_shots
        if (most is not None and self._ended >= most) or self._is_stopped():
            return True
        quiet = time.monotonic() - max(self._arrivals.last_change, self._last)
        return idle is not None and quiet > idle and self._arrivals.is_quiet and not self._running

    def _is_stopped(self) -> bool:
        requested = self._should_stop is not None and self._should_stop()
        return requested or self._abandoned.is_set()

    def _advance(self) -> None:
        """Write the oldest shot once it is done, or start the next one, or wait."""
        if self._running and self._running[0].attempt.done():
            self._finish()
            return
        self._arrivals.look()
        if self._begin_next():
            self.report()
        elif self._running:
            wait([self._running[0].attempt], self._arrivals.poll_s)
        else:
            time.sleep(self._arrivals.poll_s)

    def _begin_next(self) -> bool:
        """Start the next shot that waits, if it can be now; return whether one waited."""
        waiting, begun, most = self._arrivals.waiting, len(self._running), self._options.max_shots
        is_full = begun == _LANES or (most is not None and self._ended + begun >= most)
        name = waiting[-1 if self._options.latest else 0] if waiting and not is_full else None
        # A file that was written again waits until its earlier version is in the store.
        if name is None or any(name == shot.name for shot in self._running):
            return False
        waiting.remove(name)
        if self._options.latest:
            self._skip(waiting)
            waiting.clear()
        self._begin(name)
        return True

    def _skip(self, names: Iterable[str]) -> None:
        """Note shots that are not inverted, unless an earlier version of them was."""
        store, running = self.store, {text_of(shot.name) for shot in self._running}
        for name in map(text_of, names):
            is_stored = store is not None and store.status(name) == SKIPPED
            if not is_stored and name not in running and self._previous_report(name) is None:
                self._skipped[name] = None

    def _store_skipped(self, store: GrowingStore, *following: str) -> None:
        """Number the skipped shots, and shots that follow them."""
        store.skip(self._skipped, *following)
        self._skipped.clear()

    def _begin(self, name: str) -> None:
        self._skipped.pop(text_of(name), None)
        file = self._file(name)
        try:
            stamp_now = stamp(file.path)
            report = self._previous_report(text_of(name))
            if report is not None and _is_unchanged(file, report, stamp_now):
                return
        except OSError:
            self._arrivals.check()
            return  # removed before its turn
        attempt = self._submit(name)
        self._busy_since = self._busy_since if self._running else time.monotonic()
        self._running.append(_RunningShot(name, stamp_now, attempt))
        if self._options.latest and self.store is not None:
            # Now, as the shot must not wait for it once it is done.
            with defer_interrupts():
                self._store_skipped(self.store, text_of(name))

    def _finish(self) -> None:
        """Take the oldest attempt, let the next one begin, and write the outcome."""
        running = self._running.popleft()
        attempt, stamp_before = running.attempt.result(), running.stamp_before
        if not self._running:
            self._busy_s += time.monotonic() - self._busy_since
        origin = stamp_after = {**stamp_before, **attempt.origin}
        if attempt.failure:
            with suppress(OSError):
                stamp_after = stamp(self._file(running.name).path)
        if not stamp_before.items() <= stamp_after.items():
            self._arrivals.look_again(running.name)  # it was written to while it was read
            return
        if attempt.failure:
            self._arrivals.check()
        self._ended += 1
        try:
            # The latest shot is numbered when it begins, and the first ones create the store.
            is_numbered = not self._options.latest and self.store is not None
            if is_numbered and self._task and running.name not in self._arrivals.waiting[:1]:
                self._begin_next()
        finally:
            self._store_outcome(running.name, replace(attempt, origin=origin))

    def _store_outcome(self, file: str, attempt: Attempt) -> None:
        name = text_of(file)
        again = self._previous_report(name) is not None
        with defer_interrupts():
            outcome = self._write(name, attempt)
        self._redo.discard(name)
        self._last = time.monotonic()
        self._note_report(name, {"reason": outcome.reason, "warnings": outcome.warnings})
        self.report(name=name, outcome=outcome, result=attempt.result, again=again)

    def _note_report(self, name: str, report: Mapping[str, Any]) -> None:
        """Note whether a shot has failed or is doubtful, instead of its earlier report."""
        self._failures.pop(name, None)
        self._doubtful.discard(name)
        if reason := report.get("reason"):
            self._failures[name] = reason
        elif report.get("warnings"):
            self._doubtful.add(name)

    def _previous_report(self, name: str) -> dict[str, Any] | None:
        """Return the report of a shot that has ended before; None if it has not."""
        store = self.store
        status = None if store is None else store.status(name)
        if store is None or status is None or name in self._early:
            return self._early.get(name)
        return None if name in self._redo or status in (PENDING, SKIPPED) else store.report(name)

    def _submit(self, name: str) -> Future[Attempt]:
        shot = self._shot(name)
        failed = self._prepare(name, shot) if self._task is None else None
        if failed is not None:
            done: Future[Attempt] = Future()
            done.set_result(failed)
            return done
        assert self._stack is not None
        assert self._task is not None
        beam = self._stack.beam
        # Alone, it has all the cores.
        workers = _LANES if self._running or self._arrivals.waiting else 1
        return self._pool.submit(try_shot, self._task, shot, beam, workers, self._is_stopped)

    def _prepare(self, name: str, shot: Exposure) -> Attempt | None:
        """Describe the stack by its first shot; return a failed attempt if that is impossible."""
        began = time.perf_counter()
        waiting = [*reversed(self._skipped), *self._arrivals.waiting[:MAX_TRIED_SHOTS]]
        names = [name, *waiting[: MAX_TRIED_SHOTS - 1]]
        stack = self._stack
        if stack is None:
            try:
                shot.images.shape()
            except Exception as error:
                return Attempt(began, time.perf_counter() - began, {}, failure=failure_text(error))
            store = self.store
            if store is not None:
                # Earlier shots are a better reference for the size of the images.
                done = (name for name in store.done_names() if self._file(name).path.exists())
                names = [*islice(done, MAX_TRIED_SHOTS), *names]
            stack = self._stack_of(map(self._shot, names))
            if store is not None:
                self._use_stack(match_store(StackStore(self._path), stack))
                return None
        if stack.chooses_sites:
            self.report(stage="how many sites the first shots need")
            shots = self._stack_of(map(self._shot, names)).shots
            shares = needed_shares(replace(stack, shots=shots), self._should_stop)
            if not shares:
                # It fails the same way, and a later shot decides.
                return try_shot(stack.task, shot, stack.beam, 1, self._should_stop)
            stack = with_enough_sites(stack, shares)
        self._use_stack(stack)
        return None

    def _use_stack(self, stack: Stack) -> None:
        self._stack = stack
        self._task = stack.shot_task

    def _write(self, name: str, attempt: Attempt) -> ShotOutcome:
        early = self._early
        if attempt.result is None and (self._task is None or self.store is None):
            early[name] = {**attempt.origin, "reason": attempt.failure, "seconds": attempt.seconds}
            return ShotOutcome(len(early) - 1, FAILED, attempt.seconds, attempt.failure)
        store = self.store or self._create_store([*early, *self._skipped, name])
        for early_name in list(early):
            report = early.pop(early_name)
            if early_name != name:
                store.write(store.append(early_name), {}, report, FAILED)
        if self._skipped:
            self._store_skipped(store)
        index = store.append(name)
        if store.status(name) == DONE:
            store.reopen(index)
        assert self._task is not None
        return write_shot(store, self._task, index, attempt)

    def _create_store(self, names: Sequence[str]) -> GrowingStore:
        assert self._stack is not None
        items = [Exposure(name, _NoImage()) for name in dict.fromkeys(names)]
        stack = replace(self._stack, shots=replace(self._stack.shots, items=items))
        created = create_store(self._path, contents_of(stack), overwrite=self._options.overwrite)
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
        The store, ``name.shadowinv.zarr``, created when the first shot has been inverted.
    recipe, source, mask, source_mask, reader
        As for `run_stack`; one source for all shots. Without a number of sites, the first shots
        decide it for all: up to three that exist at the start, or the first that arrives.
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
        The store, opened lazily; None if no shot could be inverted.

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
            remove_unfinished(path)
            loop.run()
        return None if loop.store is None else read_stack(path)
