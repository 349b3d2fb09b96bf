"""A run: every shot of a stack into one store, whatever happens on the way."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.locking import locked
from napari_shadowinv._system.machine import clear_up_when_terminated
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.validation import check_instance
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion.compilation import ensure_compiled
from napari_shadowinv.io import read_stack
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore, check_store_path
from napari_shadowinv.io.store_layout import create_store, remove_unfinished
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._engines import Engine, WorkerDied, engine_for, is_here
from napari_shadowinv.stack._plan import STORED, describe_stack
from napari_shadowinv.stack._resume import append_shots, contents_of, reopen_damaged, resume
from napari_shadowinv.stack._shots import Stack
from napari_shadowinv.stack._site_count import choose_sites
from napari_shadowinv.stack._sources import Reader, read_shot
from napari_shadowinv.stack._worker import Settings, ShotOutcome, run_shots

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Step

_POLL = 0.25  # seconds between two looks at the engine and at `should_stop`


@dataclass(frozen=True)
class RunProgress:
    """A sign of life from a run.

    Attributes
    ----------
    total, done, failed : int
        Shots of the stack, with those of earlier runs.
    engine : str
        Where the work is done.
    name, outcome : str, ShotOutcome or None
        The shot that has just ended, if one has, and what became of it.
    preparing : str
        Before all shots: what is being done.
    """

    total: int
    done: int
    failed: int
    engine: str
    name: str = ""
    outcome: ShotOutcome | None = None
    preparing: str = ""


OnRunProgress = Callable[[RunProgress], None]


def run_stack(
    shots: Any,
    out: str | Path,
    *,
    source: Any = None,
    mask: ArrayLike | None = None,
    recipe: Recipe | None = None,
    options: InversionOptions | None = None,
    setup: Setup | None = None,
    filters: Sequence[Step] = (),
    source_mask: ArrayLike | None = None,
    reader: Reader = read_shot,
    warm_start: int = 1,
    variables: Collection[str] | None = None,
    dtype: str = "float32",
    scheduler: Any = None,
    workers: int | None = None,
    overwrite: bool = False,
    redo_failed: bool = False,
    on_progress: OnRunProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset:
    """Invert, or fit, every shot into one store; run again, it goes on where it stopped.

    With a recipe that has a section `fit`, the forward model is fitted to each shot. A shot that
    cannot be inverted fails alone, with its reason. What is written of a shot counts once it is
    complete, so a run may be interrupted or killed at any time. Shots that have arrived since the
    store was begun are appended, whatever their names: a shot keeps its number.

    Parameters
    ----------
    shots, source, mask, recipe, options, setup, filters, source_mask, reader, warm_start
        As for `invert_stack`. They and earlier shots must be those of a store that is resumed. In
        a table of shots to fit, rows with the same ``shot`` are images of one object.
    out : str or Path
        The store, ``name.shadowinv.zarr``.
    variables : collection of str, optional
        What to store. Default: potential, displacement and caustic, at a million pixels 13 MB a
        shot before compression; the rest can be computed from them and the image. Of a fit
        potential, displacement and its error bars.
    dtype : {"float32", "float64"}, optional
        Type of stored images; sites, weights and numbers of a shot keep 64 bits.
    scheduler : str, distributed.Client, cluster or None, optional
        ``"threads"``, ``"processes"``, ``"synchronous"``, the address of a scheduler, a client or
        a cluster. Default: dask's current client, else threads. The values do not depend on it.
    workers : int, optional
        Shots that are inverted at once, on this machine. Default: as many as cores.
    overwrite, redo_failed : bool, optional
        Throw away what the store holds; try shots again that failed before.
    on_progress : callable, optional
        Receives a `RunProgress` at the start and when a shot has ended.
    should_stop : callable, optional
        Asked now and then; when it returns true the run ends.

    Returns
    -------
    xarray.Dataset
        The store, opened lazily; `status` tells what became of each shot.

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
    kept = stored_type(dtype)
    stack = describe_stack(
        shots,
        variables=stored_variables(variables, recipe, mask),
        source=source,
        mask=mask,
        recipe=recipe,
        options=options,
        setup=setup,
        filters=filters,
        source_mask=source_mask,
        reader=reader,
        warm_start=warm_start,
    )
    again = (PENDING, FAILED) if redo_failed else (PENDING,)

    def prepare(what: str) -> None:
        if on_progress is not None:
            on_progress(RunProgress(len(stack.shots), 0, 0, "", preparing=what))

    if is_here(scheduler):
        # Once for all workers, which would each be at it during their first shot.
        ensure_compiled(lambda news: prepare(f"compiling, {news.message}"), should_stop)
    with clear_up_when_terminated(), locked(path):
        remove_unfinished(path)
        store = StackStore(path) if path.exists() and not overwrite else None
        arrived = False
        if store is not None:
            stack = resume(store, stack, kept)
            store = reopen_damaged(store)
            arrived = len(stack.shots) > len(store.names)
            if not arrived and not np.isin(store.statuses(), again).any():
                _Run(stack, store, (), on_progress, should_stop).tell("nothing to do")
                return read_stack(path)
        # Before a store is made: a scheduler that does not answer shall leave nothing behind.
        with engine_for(scheduler, workers, should_stop) as engine:
            if store is None:
                if stack.chooses_sites:
                    prepare("how many sites the first shots need")
                stack = choose_sites(stack, should_stop)
                store = create_store(path, contents_of(stack, kept), overwrite=overwrite)
            elif arrived:
                store = append_shots(store, stack, kept)
            _Run(stack, store, again, on_progress, should_stop).on(engine)
    return read_stack(path)


def stored_type(dtype: str) -> np.dtype[Any]:
    """Return the type of stored images that was asked for."""
    if dtype not in ("float32", "float64"):
        raise InputError(f"dtype is {dtype!r}: expected 'float32' or 'float64'")
    return np.dtype(dtype)


def stored_variables(
    variables: Collection[str] | None, recipe: Recipe | None, mask: ArrayLike | None
) -> Collection[str] | None:
    """Return what is stored of each shot; None for what is usual of a fit."""
    check_instance(recipe, Recipe, "recipe")
    is_fit = recipe is not None and recipe.fit is not None
    if variables is not None or is_fit:
        return variables
    # Without it, fields under a mask would count as data.
    has_mask = mask is not None or (recipe is not None and recipe.mask is not None)
    return (*STORED, "mask") if has_mask else STORED


class _Run:
    """Hands shots to an engine and keeps the books."""

    def __init__(
        self,
        stack: Stack,
        store: StackStore,
        again: tuple[int, ...],
        on_progress: OnRunProgress | None,
        should_stop: ShouldStop | None,
    ) -> None:
        self._stack = stack
        self._store = store
        self._on_progress = on_progress
        self._should_stop = should_stop
        statuses = store.statuses()
        self._todo = {int(index) for index in np.flatnonzero(np.isin(statuses, again))}
        self._counts = {
            status: 0 if status in again else int((statuses == status).sum())
            for status in (DONE, FAILED)
        }

    def tell(self, engine: str, outcome: ShotOutcome | None = None) -> None:
        if outcome is not None:
            self._counts[outcome.status] += 1
        if self._on_progress is not None:
            shots = self._stack.shots
            name = "" if outcome is None else shots.names[outcome.index]
            done, failed = self._counts[DONE], self._counts[FAILED]
            self._on_progress(RunProgress(len(shots), done, failed, engine, name, outcome))

    def on(self, engine: Engine) -> None:
        """Invert all shots that are to be inverted, and gather what their reports say."""
        try:
            self._work_on(engine)
        except BaseException:
            with suppress(OSError):
                self._store.summarise()
            raise
        self._store.summarise()

    def _work_on(self, engine: Engine) -> None:
        self.tell(engine.name)
        settings, beam = self._shared(engine)
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        running: dict[Any, list[int]] = {}
        batches = self._batches()
        is_file = self._stack.shots.array is None
        try:
            window = engine.window(files=is_file)
            while True:
                while len(running) < window and (batch := next(batches, None)) is not None:
                    future = self._start(engine, batch, beam, settings)
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
        own = tuple(name for name in stack.variables if not stack.is_shared(name))
        settings = Settings(self._store.writer, stack.work(own), engine.workers)
        # A name that no earlier run has used: what dask has under a name it does not take again.
        name = f"settings-{self._store.attributes['store_id']}-{time.time_ns()}"
        beam = stack.beam and engine.share(stack.beam, f"beam-{stack.beam.key}")
        return engine.share(settings, name), beam

    def _batches(self) -> Iterator[list[int]]:
        """Yield the shots that go to one task: one, or a run that starts from each other."""
        run = self._stack.warm_start
        for first in range(0, len(self._stack.shots), run):
            batch = range(first, min(first + run, len(self._stack.shots)))
            wanted = [index for index in batch if index in self._todo]
            if wanted:
                # From its beginning, so that the values do not depend on where a run stopped.
                yield list(range(first, wanted[-1] + 1))

    def _start(self, engine: Engine, batch: list[int], beam: Any, settings: Any) -> Any:
        shots = self._stack.shots
        labels = [(index, index in self._todo, self._stack.source_of(index)) for index in batch]
        items = [shots.items[index] for index in batch]
        return engine.submit(run_shots, items, labels, beam, settings, engine.stop)

    def _wait(self, engine: Engine, ended: queue.SimpleQueue[Any]) -> Any:
        """Return a task that has ended, or None after a while."""
        if self._should_stop is not None and self._should_stop():
            raise InversionCancelled("stopped on request; run again to resume")
        try:
            return ended.get(timeout=_POLL)
        except queue.Empty:
            engine.check()
            return None

    def _end(self, engine: Engine, future: Any, batch: list[int]) -> bool:
        """Count the shots of a task, or return False if it is being done again."""
        try:
            outcomes = engine.result(future)
        except WorkerDied as error:
            lost = [index for index in batch if index in self._todo]
            outcomes = [ShotOutcome(index, FAILED, 0.0, str(error)) for index in lost]
            for index in lost:
                self._store.writer.fail(index, {"reason": str(error)})
        if outcomes is None:
            return False
        for outcome in outcomes:
            self._todo.discard(outcome.index)
            self.tell(engine.name, outcome)
        return True
