"""Watch a folder and invert each shot into a store as soon as it arrives: `watch_stack`.

- the loop over files that arrive: `Watch`
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated, defer_interrupts
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.files import text_of
from napari_shadowinv.io.frames import FileFrame, counts_text
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore, check_store_path
from napari_shadowinv.io.store_writing import remove_unfinished
from napari_shadowinv.pipeline.run_options import WatchOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack._arrivals import Arrivals, checked_folder
from napari_shadowinv.stack._plan import (
    Stack,
    describe_stack,
)
from napari_shadowinv.stack._run import (
    WATCHING,
    OnStatus,
    RunStatus,
    StoreRun,
    create,
    match_store,
    stored_variables,
)
from napari_shadowinv.stack._schedulers import Scheduler, scheduler_for
from napari_shadowinv.stack._shots import (
    FILES,
    FileExposure,
    FileReader,
    NoShotError,
    Reader,
    Shots,
)
from napari_shadowinv.stack._status_file import status_file
from napari_shadowinv.stack._worker import ShotOutcome

if TYPE_CHECKING:
    import xarray


class Watch:
    """The loop over a folder: files that are complete are run like the shots of any stack.

    With `latest`, the newest file is next, and all others that wait are passed over.
    """

    def __init__(
        self,
        path: Path,
        options: WatchOptions,
        describe: Callable[[Shots], Stack],
        reader: FileReader,
        arrivals: Arrivals,
        on_progress: OnStatus,
        should_stop: ShouldStop | None,
    ) -> None:
        self._path, self._options, self._describe, self._reader = path, options, describe, reader
        self._arrivals, self._on_progress, self._should_stop = arrivals, on_progress, should_stop
        self.filled: StoreRun | None = None  # once a shot can be read
        self._stack: Stack | None = None
        self._unreadable: list[str] = []  # files by which the stack could not be described
        self._skipped: set[str] = set()  # names of files that were passed over, not in the store
        self._running: dict[int, str] = {}  # files of the shots in work
        self._last_end = time.monotonic()
        self._left_out: Counter[str] = Counter()

    def report(self, **news: Any) -> None:
        """Report the numbers of shots, and some news."""
        status = RunStatus() if self.filled is None else self.filled.status
        waiting = len(self._arrivals.waiting) + len(self._running)
        skipped = len(self._skipped)
        status = replace(status, skipped=skipped, waiting=waiting, scheduler=WATCHING)
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
        self.filled = StoreRun(store, [FAILED] if self._options.redo_failed else ())

    def _stack_of(self, files: Iterable[str]) -> Stack:
        stack = self._describe(Shots([self._shot(file) for file in files], (0, 0)))
        return replace(stack, dtype=self._options.dtype)

    def _shot(self, file: str) -> FileExposure:
        name = text_of(file)
        frame = FileFrame(self._arrivals.folder / file, name, variable=self._reader.variable)
        return FileExposure(name, frame, self._reader)

    def run(self) -> None:
        """Invert existing and arriving files until the watch ends."""
        self._last_end = time.monotonic()
        self._arrivals.look()
        if self.filled is not None and not self._options.latest:
            for name in self.filled.names_of(PENDING):
                self._arrivals.look_again(name)
        self.report()
        try:
            with scheduler_for("threads") as scheduler:
                while not self._is_over():
                    self._arrivals.look()
                    if self._arrivals.left_out.keys() - self._left_out.keys():
                        self._report_left_out()
                    if files := self._next():
                        self._invert(files, scheduler)
                    else:
                        time.sleep(self._arrivals.poll_s)
            if self._arrivals.left_out != self._left_out:
                self._report_left_out()
        except InversionCancelled:
            pass
        except BaseException:
            with suppress(OSError):  # the first error is the one to report
                self._close()
            self.report()
            raise
        self._close()
        self.report()

    def _report_left_out(self) -> None:
        """Count the files that are no shots in a sentence."""
        self._left_out = self._arrivals.left_out
        counts = counts_text(self._left_out) or "none"
        self.report(note=f"Left out: {counts}; choose others by a pattern of names")

    def _close(self) -> None:
        """Note what was passed over, and the shots that were still running."""
        if self.filled is not None:
            statuses = self.filled.writer.arrays()["status"]
            unfinished = [file for k, file in self._running.items() if statuses[k] == PENDING]
            self._arrivals.waiting[:0] = unfinished
        self._running.clear()
        if self._options.latest:
            self._skip(self._arrivals.waiting)
            self._arrivals.waiting.clear()
        if self.filled is not None:
            self.filled.refresh(StackStore(self._path))

    def _is_over(self) -> bool:
        idle, most = self._options.idle, self._options.max_shots
        if most is not None and self._ended >= most:
            return True
        if self._should_stop is not None and self._should_stop():
            return True
        quiet = time.monotonic() - max(self._arrivals.last_change, self._last_end)
        is_quiet = self._arrivals.is_quiet or bool(self._unreadable)
        return idle is not None and quiet > idle and is_quiet

    @property
    def _ended(self) -> int:
        return 0 if self.filled is None else self.filled.status.ended

    def _next(self, most: int = 1000) -> list[str]:
        """Take the next files that wait."""
        waiting, files = self._arrivals.waiting, list[str]()
        if self._options.latest:
            self._skip(waiting[:-1])
            del waiting[:-1]
        if self._stack is None and not self._can_describe(waiting):
            return []
        if self._options.latest or self.filled is None:
            most = 1
        if self._options.max_shots is not None:
            most = min(most, self._options.max_shots - self._ended)
        while waiting and len(files) < most:
            file = waiting.pop(0)
            if self._has_changed(file):
                files.append(file)
        return files

    def _can_describe(self, waiting: list[str], most: int = 10) -> bool:
        """Describe the stack by its first shots, if one of them can be read."""
        if not waiting or waiting == self._unreadable:
            return False
        earlier: Iterable[str] = ()
        if self.filled is not None:
            # Earlier shots are a better reference for the size of the images.
            done = self.filled.names_of(DONE)
            earlier = (name for name in done if (self._arrivals.folder / name).exists())
        try:
            self._stack = self._stack_of([*islice(earlier, most), *waiting[:most], *self._skipped])
        except NoShotError as error:
            self._unreadable = list(waiting)
            self.report(note=str(error))
            return False
        if self.filled is not None:
            match_store(StackStore(self._path), self._stack)
        self._unreadable.clear()
        return True

    def _skip(self, files: Iterable[str]) -> None:
        """Note shots that are not inverted, unless an earlier version of them was."""
        names = map(text_of, files)
        self._skipped |= {name for name in names if self._status_of(name) not in (DONE, FAILED)}

    def _status_of(self, name: str) -> int | None:
        """Return the status of a shot; None if it is not in the store."""
        return None if self.filled is None else self.filled.status_of(name)

    def _has_changed(self, file: str) -> bool:
        """Return whether a file is new, or another than the one that was inverted."""
        name, shot = text_of(file), self._shot(file)
        try:
            shot.frame.path.stat()
            if self.filled is None or self._status_of(name) not in (DONE, FAILED):
                return True
            return not shot.unchanged(self.filled.report(self.filled.numbers[name]))
        except OSError:
            self._arrivals.check()
            return False  # removed before its turn

    def _invert(self, files: list[str], scheduler: Scheduler) -> None:
        """Run some shots as any stack does, and note their outcomes."""
        assert self._stack is not None
        shots = {text_of(file): self._shot(file) for file in files}
        again = {name for name in shots if self._status_of(name) in (DONE, FAILED)}
        self._skipped -= shots.keys()
        with defer_interrupts():
            if self.filled is None:
                first = replace(self._stack.shots, items=list(shots.values()))
                stack = replace(self._stack, shots=first)
                self.filled = StoreRun(create(self._path, stack, overwrite=self._options.overwrite))
            filled = self.filled
            new = [name for name in shots if name not in filled.numbers]
            numbers = len(filled.names) + np.arange(len(new))
            filled.append({"shot": numbers, "name": np.array(new, np.dtypes.StringDType())})
            for name in shots:
                filled.reopen(filled.numbers[name])
        self._running = {filled.numbers[text_of(file)]: file for file in files}

        def end(outcome: ShotOutcome) -> None:
            del self._running[outcome.index]
            self._last_end = time.monotonic()
            name = filled.names[outcome.index]
            self.report(name=name, outcome=outcome, again=name in again)

        numbered = {filled.numbers[name]: shot for name, shot in shots.items()}
        task = self._stack.task
        filled.run(numbered, task, scheduler, end, self._should_stop)


def watch_stack(
    folder: str | Path | Shot,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    reader: Reader = FILES,
    watch: WatchOptions | None = None,
    on_progress: OnStatus | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset | None:
    """Invert, or fit, each file that arrives in a folder as soon as it is completely written.

    Existing files come first, in counting order of their names, then new ones in the order in
    which they were completed; each gets the next number of the store. With `WatchOptions.latest`,
    the newest file comes first, and those that came meanwhile are left to a call without it.
    A file that cannot be inverted fails alone, with its reason. A file that is written again later
    is inverted again, under the same number. Another call with the same store resumes it, without
    repeating shots.

    Parameters
    ----------
    folder : str, Path or Shot
        Folder in which the files appear. Its subfolders are ignored. A `Shot` with it as its image
        has the setup, the masks and the source of all shots.
    out : str or Path
        The store, ``name.shadowinv.zarr``, created once a shot can be read.
    recipe, reader
        As for `run_stack`.
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
    common = folder if isinstance(folder, Shot) else Shot(folder)
    pattern, _, variable = watch.pattern.partition("::")
    files = replace(FileReader.of(reader), variable=variable or None)
    place = checked_folder(common.image, pattern)
    path = check_store_path(out)
    variables = stored_variables(watch.variables, recipe)

    def describe(arrived: Shots) -> Stack:
        return describe_stack(replace(common, image=arrived), recipe, files, variables)

    arrivals = Arrivals(place, pattern, settle=watch.settle, existing=not watch.skip_existing)
    on_progress = on_progress or (lambda _: None)
    with ExitStack() as opened:
        if watch.status_file is not None:
            status = status_file(watch.status_file, arrivals, path, on_progress)
            on_progress = opened.enter_context(status)
        loop = Watch(path, watch, describe, files, arrivals, on_progress, should_stop)
        try:
            ensure_compiled(
                lambda news: loop.report(stage=f"compiling, {news.message}"), should_stop
            )
        except InversionCancelled:
            return None
        with clear_up_when_terminated(), locked(path):
            loop.open()
            loop.run()
        return None if loop.filled is None else read_stack(path)
