"""Watch a folder and invert each shot into a store as soon as it arrives: `watch_stack`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated, defer_interrupts
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.files import check_output, replacing, text_of
from napari_shadowinv.io.frames import FileFrame, counts_text
from napari_shadowinv.io.store import DONE, FAILED, StackStore, check_store_path
from napari_shadowinv.io.store_writing import remove_unfinished
from napari_shadowinv.pipeline.run_options import WatchOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack._arrivals import Arrivals
from napari_shadowinv.stack._plan import Stack, describe_stack
from napari_shadowinv.stack._run import (
    OnStatus,
    RunStatus,
    StoreRun,
    create,
    match_store,
)
from napari_shadowinv.stack._schedulers import Scheduler, scheduler_for
from napari_shadowinv.stack._shots import (
    FILES,
    Exposure,
    FileExposure,
    FileReader,
    NoShotError,
    Reader,
    Shots,
)
from napari_shadowinv.stack._worker import ShotOutcome

if TYPE_CHECKING:
    import xarray

POLL_S = 0.1  # between two looks into the folder


@dataclass
class _GrowingRun:
    """A run whose shots arrive while it goes on."""

    path: Path
    options: WatchOptions
    describe: Callable[[Collection[Exposure]], Stack]
    on_progress: OnStatus
    filled: StoreRun | None = None  # once a shot can be read
    stack: Stack | None = None
    pending: dict[str, Exposure] = field(default_factory=dict)  # by name, the newest last
    last_end: float = field(default_factory=time.monotonic)

    def report(self, **news: Any) -> None:
        """Report the numbers of shots, and some news."""
        waiting = RunStatus(waiting=len(self.pending))
        status = replace(waiting if self.filled is None else self.filled.status, **news)
        if self.options.status_file is not None and not (status.note or status.stage):
            _write_status(self.options.status_file, status)
        self.on_progress(status)

    def open(self) -> None:
        """Open the store, and check all that can be checked before a shot arrives."""
        if self.path.exists() and not self.options.overwrite:
            remove_unfinished(self.path)
            again = [FAILED] if self.options.redo_failed else []
            self.filled = StoreRun(StackStore(self.path), again)
        self.take({})
        self.report()

    def take(self, shots: dict[str, Exposure]) -> None:
        """Append shots to the store, once one can be read; repeat those whose files changed."""
        if self.stack is None:
            shots = self.pending | shots
            try:
                self.stack = self.describe(shots.values())
            except NoShotError as error:
                is_news = len(shots) > len(self.pending)
                self.pending = shots
                if is_news:
                    self.report(note=str(error))
                return
            if self.filled is not None:
                match_store(StackStore(self.path), self.stack)
        if not shots:
            return
        with defer_interrupts():
            if self.filled is None:
                store = create(self.path, self.stack, overwrite=self.options.overwrite)
                self.filled = StoreRun(store)
            self.filled.append([name for name in shots if name not in self.filled.numbers])
            for name, shot in shots.items():
                if self._is_to_run(self.filled, name, shot):
                    self.filled.reopen(self.filled.numbers[name])
                    self.pending.pop(name, None)
                    self.pending[name] = shot

    @staticmethod
    def _is_to_run(filled: StoreRun, name: str, shot: Exposure) -> bool:
        index = filled.numbers[name]
        try:
            is_done = filled.statuses[index] in (DONE, FAILED)
            return not (is_done and shot.unchanged(filled.report(index)))
        except OSError:  # its outcome will say why
            return True

    def run(self, scheduler: Scheduler, should_stop: ShouldStop | None) -> bool:
        """Run the pending shots, or the newest; return whether there are any."""
        names = list(self.pending)[-1:] if self.options.latest else list(self.pending)
        if not names or self.stack is None or self.filled is None:
            return False
        filled = self.filled

        def end(outcome: ShotOutcome) -> None:
            name = filled.names[outcome.index]
            del self.pending[name]
            self.last_end = time.monotonic()
            self.report(name=name, outcome=outcome)

        shots = {filled.numbers[name]: self.pending[name] for name in names}
        filled.run(shots, self.stack.task, scheduler, end, should_stop)
        return True


def _write_status(path: Path, status: RunStatus) -> None:
    """Replace the file that another program shows."""
    outcome = status.outcome
    content = {
        "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
        **{name: getattr(status, name) for name in ("done", "failed", "doubtful", "waiting")},
        "rate_per_s": round(status.rate, 3),
        "newest": outcome and {"shot": outcome.index, "name": status.name, **outcome.report},
    }
    # The other program may have it open; the next shot replaces it.
    with suppress(OSError), replacing(path, overwrite=True) as draft:
        draft.write_text(json.dumps(content, indent=2, ensure_ascii=False), encoding="utf-8")


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
    """Invert each file that arrives in a folder as soon as it is completely written.

    It is a run of `run_stack` whose shots arrive while it goes on. Existing files come first, in
    counting order of their names, then new ones in the order in which they were completed; each
    gets the next number of the store. A file that cannot be inverted fails alone, with its reason.
    A file that is written again later is inverted again, under the same number. Another call with
    the same store resumes it, without repeating shots.

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
        Receives a `RunStatus` at the start and after each shot.
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
    arrivals = Arrivals(common.image, pattern, watch.settle)
    path = check_store_path(out)
    if watch.status_file is not None:
        check_output(watch.status_file, overwrite=True)

    def describe(shots: Collection[Exposure]) -> Stack:
        arrived = replace(common, image=Shots(list(shots), (0, 0)))
        return describe_stack(arrived, recipe, files, watch)

    def shots_of(names: Iterable[str]) -> dict[str, Exposure]:
        paths = {text_of(name): arrivals.folder / name for name in names}
        frames = [FileFrame(path, name, variable=files.variable) for name, path in paths.items()]
        return {frame.name: FileExposure(frame.name, frame, files) for frame in frames}

    def is_over() -> bool:
        quiet = time.monotonic() - max(arrivals.last_change, growing.last_end)
        is_idle = watch.idle is not None and quiet > watch.settle + watch.idle
        return is_idle or (should_stop is not None and should_stop())

    growing = _GrowingRun(path, watch, describe, on_progress or (lambda _: None))
    endings = set[str]()  # endings of files that are left out
    with suppress(InversionCancelled):
        ensure_compiled(
            lambda news: growing.report(stage=f"compiling, {news.message}"), should_stop
        )
        with (
            clear_up_when_terminated(),
            locked(path),
            scheduler_for("threads") as scheduler,
        ):
            growing.open()
            while not is_over():
                growing.take(shots_of(arrivals.look()))
                if arrivals.left_out.keys() - endings:
                    endings |= arrivals.left_out.keys()
                    counts = counts_text(arrivals.left_out)
                    growing.report(note=f"Left out: {counts}; choose others by a pattern of names")
                if not growing.run(scheduler, should_stop):
                    time.sleep(POLL_S)
    return None if growing.filled is None else read_stack(path)
