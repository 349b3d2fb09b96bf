"""A run: every shot of a stack into one store, robust against errors and interruptions.

- the run: `run_stack`; its status: `RunStatus`
- a store that is filled, also by a watch: `StoreRun`
- a new store: `create`
- checks and order of a store to be continued: `resume`, `match_store`, `append_shots`
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv import __version__
from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError, RunInterruptedError
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.store import (
    DONE,
    FAILED,
    OWN_SETUPS,
    PENDING,
    StackStore,
    check_files,
    check_store_path,
)
from napari_shadowinv.io.store_writing import (
    ShotWriter,
    create_store,
    grow_store,
    remove_unfinished,
)
from napari_shadowinv.physics.arrays import checksum
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._plan import Stack, describe_stack, empty_results
from napari_shadowinv.stack._schedulers import Scheduler, scheduler_for
from napari_shadowinv.stack._shots import FILES, Exposure, Reader, differences
from napari_shadowinv.stack._worker import ShotOutcome, Task, TaskContext

if TYPE_CHECKING:
    import xarray

_ALTERNATIVES = "use the same, overwrite the store, or choose another name"


@dataclass(frozen=True)
class RunStatus:
    """Status of a run, or of a watched folder."""

    total: int = 0  # shots, including those of earlier runs, as are the next three
    done: int = 0
    failed: int = 0
    doubtful: int = 0  # done, with cautions
    waiting: int = 0  # shots that have not ended
    ended: int = 0  # shots, in this run
    seconds: float = 0.0  # of this run; of a watched folder, while shots were inverted
    scheduler: str = ""  # its name
    stage: str = ""  # of the preparation, before all shots
    name: str = ""  # of the shot that has just ended, if any
    outcome: ShotOutcome | None = None  # of this shot
    failures: tuple[tuple[str, str], ...] = ()  # names of the failed shots, with the reasons
    note: str = ""  # a sentence for the user

    @property
    def rate(self) -> float:
        """Shots per second in this run, 0 before the first has ended."""
        return self.ended / self.seconds if self.seconds > 0 else 0.0

    @property
    def text(self) -> str:
        """The numbers of shots."""
        numbers = [
            f"{self.done} of {self.total} done",
            f"{self.failed} failed" if self.failed else "",
            f"{self.doubtful} with warnings" if self.doubtful else "",
        ]
        return ", ".join(filter(None, numbers))


OnStatus = Callable[[RunStatus], None]


def run_stack(
    shots: Any,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    reader: Reader = FILES,
    run: RunOptions | None = None,
    scheduler: Any = None,
    on_progress: OnStatus | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset:
    """Invert every shot into one store; another call resumes it.

    A shot that cannot be inverted fails alone, with its reason. A shot counts only once it is
    written completely, so a run may be interrupted or killed at any time. Shots that have arrived
    since the store was created are appended, whatever their names: a shot keeps its number.

    Parameters
    ----------
    shots : array (shot, y, x), xarray.DataArray or Dataset, path or paths, or Shot
        A dask or numpy array; an xarray object with one such variable; paths of one image each;
        a glob such as ``"shots/*.tif"``, sorted so that 2 comes before 10; a TIFF with a page for
        each shot; or a table (CSV) with a row for each shot, which may have its own energy, setup,
        brightness, mask and source. A `Shot` with one of these as its image has the setup, the
        masks and the source of all shots.
        To resume a store, earlier shots must be the same, and so must recipe and reader.
    out : str or Path
        The store, ``name.shadowinv.zarr``.
    recipe : Recipe, optional
        Steps of each shot and of a measured source, setup and options. Without a source,
        intensities in the result are relative to each shot's mean. Without `threads` in the
        options, shots that are inverted simultaneously share the cores.
    reader : callable, optional
        Returns the image of a path. Default: files are read by their format;
        `napari_shadowinv.stack.FileReader` with ``channel="red"`` reads one of their colours.
    run : RunOptions, optional
        Choices of the run: stored variables and their type, workers, whether to overwrite the
        store or to repeat failed shots. A mapping is converted.
    scheduler : str, distributed.Client, cluster, callable or None, optional
        Any of dask: ``"threads"``, ``"processes"``, ``"synchronous"``, the address of a scheduler,
        a client, a cluster or a function. Default: dask's current client, its setting, or threads.
        The results do not depend on it.
    on_progress : callable, optional
        Receives a `RunStatus` at the start and after each shot.
    should_stop : callable, optional
        Called regularly by threads, also within a shot; after each shot of processes and clusters.
        The run ends when it returns true.

    Returns
    -------
    xarray.Dataset
        The store, opened lazily; `status` has the outcome of each shot.

    Raises
    ------
    InputError
        If the arguments do not fit together, or not to the store.
    FileFormatError
        If the store cannot be used, or another process is writing to it.
    RunInterruptedError
        An `OSError`, if the disk is full, or a worker or the cluster is lost; the store can be
        resumed.
    InversionCancelled
        If `should_stop` returned true; the store can be resumed.
    """
    path = check_store_path(out)
    run = as_model(RunOptions, run, "run")
    stack = describe_stack(shots, recipe, reader, run)
    again = [FAILED] if run.redo_failed else []
    on_progress = on_progress or (lambda _: None)
    with clear_up_when_terminated(), locked(path):
        filled = None
        if path.exists() and not run.overwrite:
            stack = resume(StackStore(path), stack)
            remove_unfinished(path)
            reopen_damaged(path)
            filled = StoreRun(StackStore(path), again)
            if len(stack.shots) == len(filled.names) and PENDING not in filled.statuses:
                on_progress(replace(filled.status, scheduler="nothing to do"))
                return read_stack(path)
        # Before the store is created: a scheduler that does not respond must leave nothing behind.
        with _resumable(), scheduler_for(scheduler, run.workers) as chosen:
            if chosen.is_local:  # once, instead of in all workers during their first shot
                ensure_compiled(
                    lambda news: on_progress(
                        RunStatus(total=len(stack.shots), stage=f"compiling, {news.message}")
                    ),
                    should_stop,
                )
            if filled is None:
                filled = StoreRun(create(path, stack, overwrite=run.overwrite))
            filled.append(stack.shots.names[len(filled.names) :])

            def report(outcome: ShotOutcome | None = None) -> None:
                name = "" if outcome is None else stack.shots.items[outcome.index].name
                status = replace(filled.status, scheduler=chosen.name, name=name, outcome=outcome)
                on_progress(status)

            report()
            pending = {
                index: shot
                for index, shot in enumerate(stack.shots.items)
                if filled.statuses[index] == PENDING
            }
            filled.run(pending, stack.task, chosen, report, should_stop)
    return read_stack(path)


@contextmanager
def _resumable() -> Iterator[None]:
    """Let an interruption name the option that resumes the run."""
    try:
        yield
    except RunInterruptedError as error:
        error.option = "resume"
        raise


class StoreRun:
    """A store that is filled: the status of each shot, and what is reported of them.

    Shots with a status of `again` are pending.
    """

    def __init__(self, store: StackStore, again: Collection[int] = ()) -> None:
        self.names = list(store.names)
        self.numbers = {name: index for index, name in enumerate(self.names)}
        self._path, self._store_id = store.path, store.attributes.get("store_id", "")
        self._failures: dict[int, str] = {}
        self._doubtful: set[int] = set()
        self._ended = 0
        self._seconds = 0.0
        self.statuses = bytearray(len(self.names))
        for index, (status, report) in enumerate(
            zip(store.statuses(), store.reports(), strict=True)
        ):
            self._note(index, PENDING if status in again else status, report)

    @property
    def writer(self) -> ShotWriter:
        """The writer of a shot into the store as it is now."""
        return ShotWriter(self._path, self._store_id, len(self.names))

    @property
    def status(self) -> RunStatus:
        """The numbers of shots."""
        return RunStatus(
            total=len(self.statuses),
            done=self.statuses.count(DONE),
            failed=len(self._failures),
            doubtful=len(self._doubtful),
            waiting=self.statuses.count(PENDING),
            ended=self._ended,
            seconds=self._seconds,
            failures=tuple((self.names[index], why) for index, why in self._failures.items()),
        )

    def _note(self, index: int, status: int, report: Mapping[str, Any]) -> None:
        """Note the status of a shot, with its report, in place of its earlier one."""
        self.statuses[index] = status
        self._failures.pop(index, None)
        self._doubtful.discard(index)
        if status == FAILED:
            self._failures[index] = report.get("reason", "unknown")
        elif status == DONE and report.get("warnings"):
            self._doubtful.add(index)

    def report(self, index: int) -> dict[str, Any]:
        """Return the report of a shot that has ended."""
        return dict(json.loads(str(self.writer.arrays()["report"][index]) or "{}"))

    def append(self, names: Sequence[str]) -> None:
        """Append pending shots."""
        if not names:
            return
        grow_store(self._path, names)
        self.numbers |= {name: index for index, name in enumerate(names, len(self.names))}
        self.names += names
        self.statuses.extend([PENDING] * len(names))

    def reopen(self, index: int) -> None:
        """Mark a shot as pending, and forget its report and fields."""
        if self.statuses[index] != PENDING:
            self.writer.reopen(index)
            self._note(index, PENDING, {})

    def run(
        self,
        shots: Mapping[int, Exposure],
        task: Task,
        scheduler: Scheduler,
        on_end: Callable[[ShotOutcome], None],
        should_stop: ShouldStop | None = None,
    ) -> None:
        """Run shots by their numbers; `on_end` takes each outcome."""
        workers = scheduler.workers and max(1, min(len(shots), scheduler.workers))
        began = time.monotonic() - self._seconds

        def end(outcome: ShotOutcome) -> None:
            self._ended += 1
            self._seconds = time.monotonic() - began
            self._note(outcome.index, outcome.status, outcome.report)
            on_end(outcome)

        context = TaskContext(self.writer, task, workers)
        scheduler.run(shots, context, end, should_stop or (lambda: False))


def create(path: Path, stack: Stack, *, overwrite: bool) -> StackStore:
    """Create the store of a stack, without a shot."""
    identity = {name: value for name, value in _identity(stack).items() if value}
    return create_store(path, empty_results(stack).assign_attrs(identity), overwrite=overwrite)


def _identity(stack: Stack) -> dict[str, str]:
    """Return the attributes that must agree for a store to be continued."""
    task, recipe, common = stack.task, stack.task.requested, stack.task.inputs.shot
    height, width = task.shape
    steps = [step.model_dump(mode="json") for step in task.recipe.steps]
    setup = "" if task.setup is None else task.setup.model_dump_json()
    instrument = recipe.instrument.stated
    setups = (
        {OWN_SETUPS: "a row for each shot"} if task.by_row else {OWN_SETUPS: "", "setup": setup}
    )
    return {
        **setups,
        "options": recipe.options.model_dump_json(exclude={"threads"}),
        "instrument": json.dumps(instrument) if instrument else "",
        "source_image": stack.source_text,
        "mask_image": _mask_text(common.mask) or "none",
        "steps": json.dumps(steps) if steps else "",
        "source_mask_image": _mask_text(common.source_mask),
        "image_size": f"{width} × {height} px",
        "stored": f"{', '.join(task.variables)} as {stack.dtype}",
        "reader": stack.reader,
    }


def _mask_text(mask: BoolArray | None) -> str:
    return "" if mask is None else f"sha256 {checksum(mask)}"


def resume(store: StackStore, stack: Stack) -> Stack:
    """Return the stack in the order of its store, new shots last; an `InputError` if it differs."""
    shots = stack.shots.reordered(_order(store, stack.shots.names))
    stack = replace(stack, shots=shots)
    match_store(store, stack)
    for index in np.flatnonzero(store.statuses() == DONE).tolist():
        if not shots.items[index].unchanged(store.report(index)):
            raise InputError(
                f"{shots.label(index)} has changed since it was inverted into {store.path}, or its "
                "row in a table or its setup: overwrite the store or choose another name"
            )
    return stack


def reopen_damaged(path: Path) -> None:
    """Read the files of a store, and mark damaged shots as pending.

    A `FileFormatError` if there is damage that cannot be repaired from the shots.
    """
    store = StackStore(path, every_byte=True)
    check_files(store)
    for index in store.damage.shots:
        ShotWriter.of(store).reopen(index)


def match_store(store: StackStore, stack: Stack) -> None:
    """Refuse a stack with an `InputError` that is not the store's."""
    for name, value in {**_identity(stack), "package_version": __version__}.items():
        before = str(store.attributes.get(name, ""))
        if before != value:
            article = "" if name.endswith("s") else "a "
            raise InputError(
                f"{store.path} was started with {article}different {name.replace('_', ' ')} "
                f"({_difference(before, value)}): {_ALTERNATIVES}"
            )


def _order(store: StackStore, names: tuple[str, ...]) -> list[int]:
    """Return the positions of the store's shots among `names`, then of the new ones."""
    # A shot keeps its number for good, so new ones go to the end wherever their names sort.
    count = len(store.names)
    if names[:count] == store.names:
        return list(range(len(names)))
    places = {name: place for place, name in enumerate(names)}
    lost = [name for name in store.names if name not in places]
    if lost or len(places) < len(names):
        missing = f"without {lost[0]}" if lost else "in a different order"
        raise InputError(
            f"{store.path} was started with different shots ({count} there, {len(names)} given, "
            f"{missing}): {_ALTERNATIVES}"
        )
    known_places = [places[name] for name in store.names]
    return [*known_places, *sorted(set(range(len(names))) - set(known_places))]


def _difference(before: str, now: str) -> str:
    try:
        return differences(json.loads(before or "{}"), json.loads(now or "{}"), "default")
    except (ValueError, AttributeError, TypeError):
        return f"{shorten(before or 'none', 80)} there, {shorten(now or 'none', 80)} now"
