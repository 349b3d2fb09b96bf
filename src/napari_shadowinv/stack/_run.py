"""A run: every shot of a stack into one store, robust against errors and interruptions."""

from __future__ import annotations

import queue
import time
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.locking import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore, check_store_path
from napari_shadowinv.io.store_writing import (
    ShotWriter,
    create_store,
    remove_unfinished,
    summarise,
)
from napari_shadowinv.pipeline.run_options import RunOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._engines import Engine, WorkerDiedError, engine_for, is_local
from napari_shadowinv.stack._plan import STORED, choose_sites, describe_stack
from napari_shadowinv.stack._resume import append_shots, contents_of, reopen_damaged, resume
from napari_shadowinv.stack._shots import Stack
from napari_shadowinv.stack._sources import Reader, read_shot
from napari_shadowinv.stack._status import OnStatus, RunStatus
from napari_shadowinv.stack._worker import ShotOutcome, TaskContext, run_shots

if TYPE_CHECKING:
    import xarray


_POLL_S = 0.25  # between two looks at the engine and at `should_stop`


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
        Choices of the run: stored variables and their type, workers, warm start, whether to
        overwrite the store or to repeat failed shots. A mapping is converted.
    scheduler : str, distributed.Client, cluster or None, optional
        ``"threads"``, ``"processes"``, ``"synchronous"``, the address of a scheduler, a client or
        a cluster. Default: dask's current client, else threads. The results do not depend on it.
    on_progress : callable, optional
        Receives a `RunStatus` at the start and after each shot.
    should_stop : callable, optional
        Called regularly; the run ends when it returns true.

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
    OSError
        If the disk is full or the cluster is lost; the store can be resumed.
    InversionCancelled
        If `should_stop` returned true; the store can be resumed.
    """
    path = check_store_path(out)
    run = as_model(RunOptions, run, "run")
    stored = np.dtype(run.dtype)
    stack = describe_stack(
        shots,
        recipe,
        variables=stored_variables(run.variables, recipe, mask),
        source=source,
        mask=mask,
        source_mask=source_mask,
        reader=reader,
        warm_start=run.warm_start,
    )
    again = (PENDING, FAILED) if run.redo_failed else (PENDING,)

    def prepare(stage: str) -> None:
        if on_progress is not None:
            on_progress(RunStatus(total=len(stack.shots), stage=stage))

    if is_local(scheduler):
        # Once, instead of in all workers during their first shot.
        ensure_compiled(lambda news: prepare(f"compiling, {news.message}"), should_stop)
    with clear_up_when_terminated(), locked(path):
        remove_unfinished(path)
        store = StackStore(path) if path.exists() and not run.overwrite else None
        arrived = False
        if store is not None:
            stack = resume(store, stack, stored)
            store = reopen_damaged(store)
            arrived = len(stack.shots) > len(store.names)
            if not arrived and not np.isin(store.statuses(), again).any():
                _Run(stack, store, (), on_progress, should_stop).report("nothing to do")
                return read_stack(path)
        # Before the store is created: a scheduler that does not respond must leave nothing behind.
        with engine_for(scheduler, run.workers, should_stop) as engine:
            if store is None:
                if stack.chooses_sites:
                    prepare("how many sites the first shots need")
                stack = choose_sites(stack, should_stop)
                store = create_store(path, contents_of(stack, stored), overwrite=run.overwrite)
            elif arrived:
                store = append_shots(store, stack, stored)
            _Run(stack, store, again, on_progress, should_stop).run_on(engine)
    return read_stack(path)


def stored_variables(
    variables: Collection[str] | None, recipe: Recipe | None, mask: ArrayLike | None
) -> Collection[str] | None:
    """Return the variables to store; None for the defaults of a fit."""
    check_instance(recipe, Recipe, "recipe")
    is_fit = recipe is not None and recipe.fit is not None
    if variables is not None or is_fit:
        return variables
    # Without it, fields under a mask would count as data.
    has_mask = mask is not None or (recipe is not None and recipe.mask is not None)
    return (*STORED, "mask") if has_mask else STORED


class _Run:
    """A run: submits shots to an engine, and counts their outcomes."""

    def __init__(
        self,
        stack: Stack,
        store: StackStore,
        again: tuple[int, ...],
        on_progress: OnStatus | None,
        should_stop: ShouldStop | None,
    ) -> None:
        self._stack = stack
        self._store, self._writer = store, ShotWriter.of(store)
        self._on_progress = on_progress
        self._should_stop = should_stop
        statuses, reports = store.statuses(), store.reports()
        self._todo = {int(index) for index in np.flatnonzero(np.isin(statuses, again))}
        self._counts = {
            status: 0 if status in again else int((statuses == status).sum())
            for status in (DONE, FAILED)
        }
        self._doubtful = sum(
            status == DONE and bool(report.get("warnings"))
            for status, report in zip(statuses, reports, strict=True)
        )
        self._failures = [
            (store.names[index], str(reports[int(index)].get("reason", "unknown")))
            for index in np.flatnonzero(statuses == FAILED)
            if index not in self._todo
        ]
        self._ended = 0
        self._began = time.monotonic()

    def report(self, engine: str, outcome: ShotOutcome | None = None) -> None:
        shots = self._stack.shots
        name = "" if outcome is None else shots.names[outcome.index]
        if outcome is not None:
            self._ended += 1
            self._counts[outcome.status] += 1
            self._doubtful += outcome.warnings > 0
            self._failures += [(name, outcome.reason)] if outcome.reason else []
        if self._on_progress is None:
            return
        done, failed = self._counts[DONE], self._counts[FAILED]
        status = RunStatus(
            total=len(shots),
            done=done,
            failed=failed,
            doubtful=self._doubtful,
            waiting=len(shots) - done - failed,
            ended=self._ended,
            seconds=time.monotonic() - self._began,
            engine=engine,
            name=name,
            outcome=outcome,
            failures=tuple(self._failures),
        )
        self._on_progress(status)

    def run_on(self, engine: Engine) -> None:
        """Invert all pending shots, and summarise their reports."""
        try:
            self._work_on(engine)
        except BaseException:
            with suppress(OSError):
                summarise(self._store)
            raise
        summarise(self._store)

    def _work_on(self, engine: Engine) -> None:
        self.report(engine.name)
        context, beam = self._shared(engine)
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        running: dict[Any, list[int]] = {}
        batches = self._batches()
        is_file = self._stack.shots.array is None
        try:
            window = engine.window(files=is_file)
            while True:
                while len(running) < window and (batch := next(batches, None)) is not None:
                    future = self._start(engine, batch, beam, context)
                    running[future] = batch
                    future.add_done_callback(ended.put)
                if not running:
                    return
                future = self._wait(engine, ended)
                window = engine.window(files=is_file) if engine.workers is None else window
                if future is None:
                    continue
                if self._end(engine, future, running[future]):
                    del running[future]
                else:
                    future.add_done_callback(ended.put)
        except BaseException:
            for future in running:
                future.cancel()
            raise

    def _shared(self, engine: Engine) -> tuple[Any, Any]:
        stack = self._stack
        per_shot = tuple(name for name in stack.variables if not stack.is_shared(name))
        context = TaskContext(self._writer, stack.work(per_shot), engine.workers)
        # A name that no earlier run has used: dask would reuse the earlier value.
        name = f"settings-{self._store.attributes['store_id']}-{time.time_ns()}"
        beam = stack.beam and engine.share(stack.beam, f"beam-{stack.beam.key}")
        return engine.share(context, name), beam

    def _batches(self) -> Iterator[list[int]]:
        """Yield the shots of a task: one, or a group in which each starts from the previous."""
        run = self._stack.warm_start
        for first in range(0, len(self._stack.shots), run):
            batch = range(first, min(first + run, len(self._stack.shots)))
            pending = [index for index in batch if index in self._todo]
            if pending:
                # From its beginning, so that the values do not depend on where a run stopped.
                yield list(range(first, pending[-1] + 1))

    def _start(self, engine: Engine, batch: list[int], beam: Any, context: Any) -> Any:
        shots = self._stack.shots
        labels = [(index, index in self._todo, self._stack.source_of(index)) for index in batch]
        items = [shots.items[index] for index in batch]
        return engine.submit(run_shots, items, labels, beam, context, engine.stop)

    def _wait(self, engine: Engine, ended: queue.SimpleQueue[Any]) -> Any:
        """Return a finished task, or None after a timeout."""
        if self._should_stop is not None and self._should_stop():
            raise InversionCancelled("stopped on request; run again to resume")
        try:
            return ended.get(timeout=_POLL_S)
        except queue.Empty:
            engine.check()
            return None

    def _end(self, engine: Engine, future: Any, batch: list[int]) -> bool:
        """Count the shots of a task, or return False if the task is repeated."""
        try:
            outcomes = engine.result(future)
        except WorkerDiedError as error:
            lost = [index for index in batch if index in self._todo]
            outcomes = [ShotOutcome(index, FAILED, 0.0, str(error)) for index in lost]
            for index in lost:
                self._writer.fail(index, {"reason": str(error)})
        if outcomes is None:
            return False
        for outcome in outcomes:
            self._todo.discard(outcome.index)
            self.report(engine.name, outcome)
        return True
