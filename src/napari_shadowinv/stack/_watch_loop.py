"""What is done with each file that arrives while a folder is watched: `Watch`.

- a sign of life, and who is told: `WatchProgress`, `Books`
- what all shots share, as soon as it is known: `StackMaker`
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.machine import interrupts_put_off
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.io.files import sha256, text_of
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.io.store_growing import GrowingStore
from napari_shadowinv.io.store_layout import create_store
from napari_shadowinv.stack._discovery import Shots
from napari_shadowinv.stack._folder_events import Arrivals
from napari_shadowinv.stack._resume import NUMBERED_AS_ARRIVED, contents_of, made_alike
from napari_shadowinv.stack._run import RunProgress
from napari_shadowinv.stack._shots import FitStack, Stack
from napari_shadowinv.stack._site_count import TRIED, shares_needed, with_chosen
from napari_shadowinv.stack._sources import FileShot, Reader, Shot, stamp
from napari_shadowinv.stack._worker import ShotOutcome, Tried, reason_of, try_shot, write_shot

if TYPE_CHECKING:
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion

# Shots at once. It is fixed, because each starts from the one so many before, and what is found
# shall not depend on the machine.
_ABREAST = 2
_TICK = 2.0  # seconds in which times of files may be the same, on any file system
_POLL = 0.25  # seconds between two looks at `should_stop` while nothing arrives


@dataclass(frozen=True)
class WatchProgress(RunProgress):
    """A sign of life from a folder that is watched; see also `RunProgress`.

    Attributes
    ----------
    waiting : int
        Files that have arrived and were not inverted yet.
    again : bool
        Whether the shot was inverted before and its file has changed since.
    result : Inversion, Fit or None
        What came of the shot that has just ended; do not keep it.
    note : str
        Something the user should know of, in a sentence.
    """

    waiting: int = 0
    again: bool = False
    result: Inversion | Fit | None = None
    note: str = ""


OnWatchProgress = Callable[[WatchProgress], None]


class Books:
    """What has come of the shots, and who is told of it."""

    def __init__(self, arrivals: Arrivals, on_progress: OnWatchProgress | None) -> None:
        self._arrivals = arrivals
        self._on_progress = on_progress
        self.store: GrowingStore | None = None
        # What failed before the first good shot, which makes the store or shows that it fits.
        self.early: dict[str, dict[str, Any]] = {}
        self.in_work = 0  # shots that are being inverted

    def prepare(self, what: str) -> None:
        self.tell(preparing=what)

    def note(self, sentence: str) -> None:
        self.tell(note=sentence)

    def tell(self, **news: Any) -> None:
        """Tell how many shots there are, and some news."""
        if self._on_progress is None:
            return
        early, store = len(self.early), self.store
        total = early + (0 if store is None else len(store))
        done = 0 if store is None else store.count(DONE)
        failed = early + (0 if store is None else store.count(FAILED))
        waiting = self._arrivals.waiting + self.in_work
        told: dict[str, Any] = {"engine": "watching", "waiting": waiting, **news}
        self._on_progress(WatchProgress(total, done, failed, **told))


def _unchanged(shot: FileShot, known: dict[str, Any], seen: dict[str, int]) -> bool:
    """Whether a file is still the one of which this is known."""
    # Within a tick of the file system's clock it may have changed without looking so.
    if time.time() - seen["mtime_ns"] / 1e9 < _TICK and "sha256" in known:
        return bool(sha256(shot.path) == known["sha256"])
    return shot.unchanged(known)


class _ShapeUnknown(Exception):  # noqa: N818 - nothing is wrong yet
    """No shot has arrived that could tell its shape."""


class _NoShot(Shot):
    """Stands for the shots while there are none."""

    def shape(self) -> tuple[int, ...]:
        raise _ShapeUnknown


@dataclass(frozen=True)
class StackMaker:
    """Describes what the shots of a folder share."""

    describe: Callable[[Shots], Stack]
    folder: Path
    reader: Reader
    chained: bool  # whether each shot shall start from an earlier one

    def shot(self, name: str) -> FileShot:
        return FileShot(self.folder / name, self.reader)

    def before_any(self) -> Stack | None:
        """Return what is known before a shot has arrived; None without its shape."""
        try:
            return self._made([_NoShot()], [""])
        except _ShapeUnknown:
            return None

    def of(self, names: Sequence[str]) -> Stack:
        """Return what the shots share, the first of which can be read."""
        return self._made([self.shot(name) for name in names], names)

    def _made(self, items: Sequence[Shot], names: Sequence[str]) -> Stack:
        stack = self.describe(Shots(items, tuple(map(text_of, names)), (0, 0)))
        # Shots start from each other only on the same sites.
        chained = self.chained and stack.beam is not None and not isinstance(stack, FitStack)
        return replace(stack, as_arrived=True, chained=chained)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A shot that is being inverted."""

    name: str
    shot: FileShot
    seen: dict[str, int]  # of its file, before it was read
    lane: int
    tried: Future[Tried]


class Watch:
    """Takes file after file, inverts two at once, and writes them in the order of arrival.

    Shots begin in the two lanes by turns; each starts from what came of the last one in its lane.
    """

    def __init__(
        self,
        path: Path,
        dtype: np.dtype[Any],
        stacks: StackMaker,
        arrivals: Arrivals,
        books: Books,
        should_stop: ShouldStop | None,
    ) -> None:
        self._path, self._dtype, self._stacks = path, dtype, stacks
        self._arrivals, self._books, self._should_stop = arrivals, books, should_stop
        self._overwrite = False
        self._stack: Stack | None = None
        self._work: Any = None  # known once the number of sites is
        self._pool = ThreadPoolExecutor(_ABREAST)
        self._abandoned = Event()
        self._attempts: deque[_Attempt] = deque()
        self._lanes: list[Inversion | Fit | None] = [None] * _ABREAST
        self._redo: set[str] = set()
        self._begun = self._ended = 0
        self._last = time.monotonic()

    def open(self, *, overwrite: bool, redo_failed: bool) -> None:
        """Refuse what cannot work before anything arrives, as far as that is known by then."""
        self._overwrite = overwrite
        self._stack = self._stacks.before_any()
        if overwrite or not self._path.exists():
            return
        store = StackStore(self._path)
        again = (PENDING, FAILED) if redo_failed else (PENDING,)
        self._redo = {store.names[i] for i in np.flatnonzero(np.isin(store.statuses(), again))}
        self._books.store = GrowingStore(store, NUMBERED_AS_ARRIVED)
        if self._stack is not None:
            self._use(made_alike(store, self._stack, self._dtype))

    def run(self, idle: float | None = None, most: int | None = None) -> None:
        """Invert what is there and what arrives, until it is over."""
        for name in sorted(self._redo):
            self._arrivals.put_back(name)
        self._books.tell()
        try:
            while not self._is_over(idle, most):
                self._go_on(most)
        except InversionCancelled:
            pass
        finally:
            self._abandoned.set()
            self._pool.shutdown(cancel_futures=True)
            self._books.tell()

    def _is_over(self, idle: float | None, most: int | None) -> bool:
        if most is not None and self._ended >= most:
            return True
        if self._should_stop is not None and self._should_stop():
            return True
        quiet = time.monotonic() - max(self._arrivals.heard, self._last)
        is_quiet = self._arrivals.is_quiet and not self._attempts
        return idle is not None and quiet > idle and is_quiet

    def _is_stopped(self) -> bool:
        asked = self._should_stop is not None and self._should_stop()
        return asked or self._abandoned.is_set()

    def _go_on(self, most: int | None) -> None:
        """Write the oldest shot once it is done, or begin the next one."""
        begun = len(self._attempts)
        is_full = begun == _ABREAST or (most is not None and self._ended + begun == most)
        if begun and (is_full or self._attempts[0].tried.done()):
            self._finish()
            return
        arrived = self._arrivals.take(_POLL)
        if arrived is not None:
            self._begin(arrived)

    def _begin(self, name: str) -> None:
        while any(name == one.name for one in self._attempts):
            self._finish()  # it may have changed since it was read
        shot = self._stacks.shot(name)
        try:
            seen = stamp(shot.path)
            known = self._known(text_of(name))
            if known is not None and _unchanged(shot, known, seen):
                if not self._arrivals.waiting:
                    self._books.tell()
                return
        except OSError:
            self._arrivals.check()
            return  # removed before its turn
        lane = self._begun % _ABREAST
        self._begun += 1
        self._books.in_work += 1
        tried = self._trying(name, shot, lane)
        tried.add_done_callback(lambda _: self._arrivals.wake())
        self._attempts.append(_Attempt(name, shot, seen, lane, tried))
        self._books.tell()

    def _finish(self) -> None:
        """Wait for the oldest attempt, and write what came of it."""
        attempt = self._attempts[0]
        tried, seen = attempt.tried.result(), attempt.seen
        self._attempts.popleft()
        self._books.in_work -= 1
        changed = {**seen, **tried.origin}
        with suppress(OSError):
            changed = stamp(attempt.shot.path) if tried.failure else changed
        if not seen.items() <= changed.items():
            self._arrivals.put_back(attempt.name)  # it was written to while it was read
            return
        if tried.failure:
            self._arrivals.check()
        name = text_of(attempt.name)
        again = self._known(name) is not None
        with interrupts_put_off():
            outcome = self._write(name, replace(tried, origin={**seen, **tried.origin}))
        self._redo.discard(name)
        self._lanes[attempt.lane] = self._start_for_next(tried)
        self._ended += 1
        self._last = time.monotonic()
        self._books.tell(name=name, outcome=outcome, result=tried.result, again=again)

    def _known(self, name: str) -> dict[str, Any] | None:
        """What was told of a shot that has ended before; None of one that has not."""
        store = self._books.store
        index = None if store is None else store.number(name)
        if store is None or index is None or name in self._books.early:
            return self._books.early.get(name)
        pending = name in self._redo or store.status(index) == PENDING
        return None if pending else store.report(index)

    def _trying(self, name: str, shot: FileShot, lane: int) -> Future[Tried]:
        failed = self._prepare(name, shot) if self._work is None else None
        if failed is not None:
            known: Future[Tried] = Future()
            known.set_result(failed)
            return known
        stack = self._stack
        assert stack is not None
        source, start = stack.source_of(0), self._lanes[lane]
        # Alone, it has all the cores.
        workers = _ABREAST if self._attempts or self._arrivals.waiting else 1
        return self._pool.submit(
            try_shot, self._work, shot, stack.beam, source, start, workers, self._is_stopped
        )

    def _prepare(self, name: str, shot: FileShot) -> Tried | None:
        """Find out what all shots share by the first one; or why that one tells nothing."""
        began = time.perf_counter()
        names = [name, *self._arrivals.peek(TRIED - 1)]
        stack = self._stack
        if stack is None:
            try:
                shot.shape()
            except Exception as error:
                return Tried(began, time.perf_counter() - began, {}, failure=reason_of(error))
            store = self._books.store
            if store is not None:
                # Earlier shots know better how large an image is.
                there = (one for one in store.done() if self._stacks.shot(one).path.exists())
                names = [*islice(there, TRIED), *names]
            stack = self._stacks.of(names)
            if store is not None:
                self._use(made_alike(StackStore(self._path), stack, self._dtype))
                return None
        if stack.chooses_sites:
            self._books.prepare("how many sites the first shots need")
            shots = self._stacks.of(names).shots
            shares = shares_needed(replace(stack, shots=shots), self._should_stop)
            if not shares:
                # It fails the same way, and a later one decides.
                return try_shot(stack.work(()), shot, stack.beam, None, None, 1, self._should_stop)
            stack = with_chosen(stack, shares)
        self._use(stack)
        return None

    def _use(self, stack: Stack) -> None:
        self._stack = stack
        own = tuple(name for name in stack.variables if not stack.is_shared(name))
        self._work = stack.work(own)

    def _write(self, name: str, tried: Tried) -> ShotOutcome:
        early = self._books.early
        if tried.result is None and (self._work is None or self._books.store is None):
            early[name] = {**tried.origin, "reason": tried.failure, "seconds": tried.seconds}
            return ShotOutcome(len(early) - 1, FAILED, tried.seconds, tried.failure)
        store = self._books.store or self._made([*early, name])
        for other in list(early):
            index = store.number(other)
            report = early.pop(other)
            if other != name:
                store.fail(store.append(other) if index is None else index, report)
        found = store.number(name)
        index = store.append(name) if found is None else found
        if store.status(index) == DONE:
            store.reopen(index)
        return write_shot(store, self._work, index, tried)

    def _made(self, names: Sequence[str]) -> GrowingStore:
        """Make the store with its first shots."""
        assert self._stack is not None
        first = tuple(dict.fromkeys(names))
        shots = replace(self._stack.shots, items=[_NoShot()] * len(first), names=first)
        stack = replace(self._stack, shots=shots)
        made = create_store(self._path, contents_of(stack, self._dtype), overwrite=self._overwrite)
        self._overwrite = False
        self._books.store = GrowingStore(made, NUMBERED_AS_ARRIVED)
        return self._books.store

    def _start_for_next(self, tried: Tried) -> Inversion | Fit | None:
        chained = self._stack is not None and self._stack.chained
        good = tried.result is not None and tried.result.report.converged
        return tried.result if chained and good else None
