"""A run: every shot of a stack into one store, robust against errors and interruptions.

- the run: `run_stack`; its status: `RunStatus`
- the content of a new store: `contents_of`
- checks and order of a store to be continued: `resume`, `match_store`, `append_shots`
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv import __version__
from napari_shadowinv._system.arrays import checksum
from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv._typing import BoolArray
from napari_shadowinv.errors import InputError, RunInterruptedError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.store import (
    DONE,
    FAILED,
    OWN_SETUPS,
    PENDING,
    SKIPPED,
    StackStore,
    check_files,
    check_store_path,
)
from napari_shadowinv.io.store_writing import (
    Contents,
    ShotWriter,
    StoreArray,
    create_store,
    grow_store,
    remove_unfinished,
    summarise,
)
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._plan import (
    STORED,
    Stack,
    attributes_of,
    coordinates_of,
    describe_stack,
    dtype_of,
)
from napari_shadowinv.stack._schedulers import Scheduler, is_local, scheduler_for
from napari_shadowinv.stack._shots import Reader, differences, read_shot
from napari_shadowinv.stack._worker import ShotOutcome, TaskContext

if TYPE_CHECKING:
    import xarray

WATCHING = "watching"  # in place of the scheduler's name
_ALTERNATIVES = "use the same, overwrite the store, or choose another name"


@dataclass(frozen=True)
class RunStatus:
    """Status of a run, or of a watched folder.

    Attributes
    ----------
    total, done, failed : int
        Numbers of shots, including earlier runs.
    doubtful : int
        Shots that are done, with warnings.
    skipped : int
        Shots of a watched folder that came while newer ones were inverted.
    waiting : int
        Shots that have not ended; of a watched folder, files that have arrived.
    ended : int
        Shots that have ended in this run.
    seconds : float
        Time of this run; of a watched folder, the time during which shots were inverted.
    scheduler : str
        Name of the scheduler that runs the shots.
    stage : str
        Current stage of the preparation, before all shots.
    name, outcome : str, ShotOutcome or None
        The shot that has just ended, if any, and its outcome.
    result : Inversion, Fit or None
        Its result, for a watched folder; do not keep a reference.
    again : bool
        Whether the shot was inverted before and its file has changed since.
    failures : tuple of (str, str)
        Names of the failed shots, with the reasons.
    note : str
        A sentence for the user.
    """

    total: int = 0
    done: int = 0
    failed: int = 0
    doubtful: int = 0
    skipped: int = 0
    waiting: int = 0
    ended: int = 0
    seconds: float = 0.0
    scheduler: str = ""
    stage: str = ""
    name: str = ""
    outcome: ShotOutcome | None = None
    result: Inversion | Fit | None = None
    again: bool = False
    failures: tuple[tuple[str, str], ...] = ()
    note: str = ""

    @property
    def rate(self) -> float:
        """Shots per second in this run, 0 before the first has ended."""
        return self.ended / self.seconds if self.seconds > 0 else 0.0

    @property
    def remaining(self) -> float | None:
        """Seconds until the waiting shots have ended at the same rate; None if unknown."""
        return self.waiting / self.rate if self.rate else None

    @property
    def text(self) -> str:
        """The numbers of shots."""
        is_watch = self.scheduler == WATCHING
        numbers = [
            f"{self.done} done" if is_watch else f"{self.done} of {self.total} done",
            f"{self.failed} failed" if self.failed else "",
            f"{self.doubtful} with warnings" if self.doubtful else "",
            f"{self.skipped} skipped" if self.skipped else "",
            f"{self.waiting} waiting" if is_watch and self.waiting else "",
        ]
        return ", ".join(filter(None, numbers))


OnStatus = Callable[[RunStatus], None]


def run_stack(
    shots: Any,
    out: str | Path,
    recipe: Recipe | None = None,
    *,
    source: Any = None,
    mask: ArrayLike | None = None,
    source_mask: ArrayLike | None = None,
    reader: Reader = read_shot,
    run: RunOptions | None = None,
    scheduler: Any = None,
    on_progress: OnStatus | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset:
    """Invert, or fit, every shot into one store; another call resumes it.

    With a recipe that has a section `fit`, the forward model is fitted to each shot. A shot that
    cannot be inverted fails alone, with its reason. A shot counts only once it is written
    completely, so a run may be interrupted or killed at any time. Shots that have arrived since the
    store was created are appended, whatever their names: a shot keeps its number.

    Parameters
    ----------
    shots, recipe, source, mask, source_mask, reader
        As for `invert_stack`. To resume a store, they and earlier shots must be the same. In
        a table of shots to fit, rows with the same ``shot`` are images of one object.
    out : str or Path
        The store, ``name.shadowinv.zarr``.
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
        Called regularly, also in other threads; the run ends when it returns true.

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
    variables = stored_variables(run.variables, recipe)
    stack = describe_stack(shots, recipe, source, mask, source_mask, reader, variables)
    stack = replace(stack, dtype=run.dtype)
    again = (PENDING, SKIPPED, *([FAILED] if run.redo_failed else []))

    on_progress = on_progress or (lambda _: None)

    def prepare(stage: str) -> None:
        on_progress(RunStatus(total=len(stack.shots), stage=stage))

    if is_local(scheduler):
        # Once, instead of in all workers during their first shot.
        ensure_compiled(lambda news: prepare(f"compiling, {news.message}"), should_stop)
    with clear_up_when_terminated(), locked(path):
        store = StackStore(path) if path.exists() and not run.overwrite else None
        arrived = False
        if store is not None:
            stack = resume(store, stack)
            remove_unfinished(path)
            store = reopen_damaged(store)
            arrived = len(stack.shots) > len(store.names)
            if not arrived and not np.isin(store.statuses(), again).any():
                summarise(store)  # the last run may have been killed before it did
                _Run(stack, store, (), on_progress, should_stop).report("nothing to do")
                return read_stack(path)
        # Before the store is created: a scheduler that does not respond must leave nothing behind.
        with _resumable(), scheduler_for(scheduler, run.workers) as chosen:
            if store is None:
                store = create_store(path, contents_of(stack), overwrite=run.overwrite)
            elif arrived:
                store = append_shots(store, stack)
            _Run(stack, store, again, on_progress, should_stop).run_on(chosen)
    return read_stack(path)


@contextmanager
def _resumable() -> Iterator[None]:
    """Let an interruption name the option that resumes the run."""
    try:
        yield
    except RunInterruptedError as error:
        error.option = "resume"
        raise


def stored_variables(
    variables: Collection[str] | None, recipe: Recipe | None
) -> Collection[str] | None:
    """Return the variables to store; None for the defaults of a fit."""
    check_instance(recipe, Recipe, "recipe")
    is_fit = recipe is not None and recipe.fit is not None
    return STORED if variables is None and not is_fit else variables


class _Run:
    """A run: gives shots to a scheduler, and counts their outcomes."""

    def __init__(
        self,
        stack: Stack,
        store: StackStore,
        again: tuple[int, ...],
        on_progress: OnStatus,
        should_stop: ShouldStop | None,
    ) -> None:
        self._stack = stack
        self._store = store
        self._on_progress, self._should_stop = on_progress, should_stop
        statuses, reports = store.statuses(), store.reports()
        self._todo = [int(index) for index in np.flatnonzero(np.isin(statuses, again))]
        self._failures = [
            (store.names[index], str(reports[int(index)].get("reason", "unknown")))
            for index in np.flatnonzero(statuses == FAILED)
            if FAILED not in again
        ]
        self._status = RunStatus(
            total=len(statuses),
            done=int((statuses == DONE).sum()),
            doubtful=sum(
                status == DONE and bool(report.get("warnings"))
                for status, report in zip(statuses, reports, strict=True)
            ),
        )
        self._began = time.monotonic()

    def report(self, scheduler: str, outcome: ShotOutcome | None = None) -> None:
        status, name = self._status, ""
        if outcome is not None:
            name = self._stack.shots.items[outcome.index].name
            self._failures += [(name, outcome.reason)] if outcome.reason else []
            status = self._status = replace(
                status,
                done=status.done + (outcome.status == DONE),
                doubtful=status.doubtful + (outcome.warnings > 0),
                ended=status.ended + 1,
            )
        failed, seconds = len(self._failures), time.monotonic() - self._began
        waiting, failures = status.total - status.done - failed, tuple(self._failures)
        status = replace(status, failed=failed, waiting=waiting, failures=failures)
        self._on_progress(
            replace(status, seconds=seconds, scheduler=scheduler, name=name, outcome=outcome)
        )

    def run_on(self, scheduler: Scheduler, portion: int = 1000) -> None:
        """Run all pending shots, a portion at a time, and summarise their reports."""
        stack, items = self._stack, self._stack.shots.items
        context = TaskContext(ShotWriter.of(self._store), stack.task, scheduler.workers)
        self.report(scheduler.name)
        try:
            for first in range(0, len(self._todo), portion):
                shots = {index: items[index] for index in self._todo[first : first + portion]}
                outcomes = scheduler.outcomes(shots, stack.beam, context, self._should_stop)
                with closing(outcomes):  # at once, if a report raises an error
                    for outcome in outcomes:
                        self.report(scheduler.name, outcome)
        except BaseException:
            with suppress(OSError):
                summarise(self._store)
            raise
        summarise(self._store)


def contents_of(stack: Stack) -> Contents:
    identity = {name: value for name, value in _identity(stack).items() if value}
    attributes = {**attributes_of(stack), **identity}
    return Contents(stack.sizes, _variables(stack), _coordinates(stack), attributes)


def _coordinates(stack: Stack) -> dict[str, StoreArray]:
    import xarray as xr

    coordinates = {}
    for name, coordinate in coordinates_of(stack).items():
        labelled = xr.as_variable(coordinate)
        values, attributes = labelled.values, dict(labelled.attrs)
        if values.dtype.kind in "mM":
            # As numbers, because Zarr has no times; the units say which.
            attributes["units"] = "ns since 1970-01-01"
            values = values.astype("datetime64[ns]").astype("int64")
        is_text = values.dtype.kind in "UO"
        values = values.astype(object) if is_text else values
        dims, dtype = tuple(map(str, labelled.dims)), str if is_text else values.dtype
        coordinates[name] = StoreArray(dims, dtype, attributes, values)
    return coordinates


def _variables(stack: Stack) -> dict[str, StoreArray]:
    variables: dict[str, StoreArray] = {}
    for name, (dims, labels) in stack.task.labels.items():
        if name not in stack.task.variables:
            continue
        exact = dtype_of(name).kind != "f" or "site" in dims
        stored = dtype_of(name) if exact else np.dtype(stack.dtype)
        variables[name] = StoreArray(("shot", *dims), stored, labels)
    for name, (dims, pixels, labels) in stack.task.masks.items():
        variables[name] = StoreArray(dims, np.dtype(bool), labels, pixels)
    return variables


def _identity(stack: Stack, shots: int | None = None) -> dict[str, str]:
    """Return the attributes that must agree for a store with `shots` shots to be continued."""
    height, width = stack.task.shape
    shot = stack.task.inputs.shot
    steps = [step.model_dump(mode="json") for step in stack.task.recipe.steps]
    setup = "" if stack.task.setup is None else stack.task.setup.model_dump_json()
    setups = {OWN_SETUPS: "", "setup": setup}
    if stack.task.by_row:
        setups = {OWN_SETUPS: "a row for each shot"}
    return {
        **stack.task.identity,
        **setups,
        "source_image": stack.source_text(shots),
        "mask_image": _mask_text(shot.mask) or "none",
        "steps": json.dumps(steps) if steps else "",
        "source_mask_image": _mask_text(shot.source_mask),
        "image_size": f"{width} × {height} px",
        "stored": f"{', '.join(stack.task.variables)} as {stack.dtype}",
        "reader": stack.reader,
    }


def _mask_text(mask: BoolArray | None) -> str:
    return "" if mask is None else f"sha256 {checksum(mask)}"


def resume(store: StackStore, stack: Stack) -> Stack:
    """Return the stack in the order of its store, new shots last; an `InputError` if it differs."""
    shots = stack.shots.reordered(_order(store, stack.shots.names))
    stack = replace(stack, shots=shots)
    match_store(store, stack)
    for index in np.flatnonzero(store.statuses() == DONE):
        changed = stack.changed(int(index), store.report(int(index)))
        if changed:
            raise InputError(
                f"{changed} has changed since it was inverted into {store.path}: overwrite the "
                "store or choose another name"
            )
    return stack


def reopen_damaged(store: StackStore) -> StackStore:
    """Read the files of a store, mark damaged shots as pending, and return it as it is now.

    A `FileFormatError` if there is damage that cannot be repaired from the shots.
    """
    damage = StackStore(store.path, every_byte=True).damage
    for index in damage.shots:
        ShotWriter.of(store).reopen(index)
    if not (damage.shots or damage.files):
        return store
    store = StackStore(store.path)
    if damage.files:
        summarise(store)
        check_files(store := StackStore(store.path, every_byte=True))
    return store


def match_store(store: StackStore, stack: Stack) -> None:
    """Refuse a stack with an `InputError` that is not the store's."""
    identity = _identity(stack, len(store.names))
    for name, value in {**identity, "package_version": __version__}.items():
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


def append_shots(store: StackStore, stack: Stack) -> StackStore:
    """Append shots that arrived since the last run, as pending, to the store."""
    count, coordinates = len(store.names), _coordinates(stack).items()
    along_shots = {name: variable for name, variable in coordinates if variable.along_shots}
    values = {name: np.asarray(variable.values)[count:] for name, variable in along_shots.items()}
    grow_store(store.path, values, {"source_image": stack.source_text(None)})
    return StackStore(store.path)
