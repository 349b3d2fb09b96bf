"""A run: every shot of a stack into one store, whatever happens on the way."""

from __future__ import annotations

import dataclasses
import json
import queue
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io.dataset import variable_labels
from napari_shadowinv.io.locking import locked
from napari_shadowinv.io.store import (
    DONE,
    FAILED,
    PENDING,
    ShotWriter,
    StackStore,
    Variable,
    check_store_path,
    create_store,
    read_stack,
)
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.progress import ShouldStop
from napari_shadowinv.stack._engines import Engine, WorkerDied, engine_for
from napari_shadowinv.stack._lazy import (
    Stack,
    attributes_of,
    coordinates_of,
    describe_stack,
    dtype_of,
    values_of_beam,
)
from napari_shadowinv.stack._shots import Reader, Shot, checksum, described_reader, read_shot
from napari_shadowinv.stack._work import Beam, arrays_of, invert_shot, threads_here

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = ["STORED", "RunProgress", "ShotOutcome", "run_stack"]

STORED = ("potential", "displacement", "caustic")

_POLL = 0.25  # seconds between two looks at the engine and at `should_stop`


@dataclass(frozen=True)
class ShotOutcome:
    """What became of one shot.

    Attributes
    ----------
    index : int
        Which.
    status : int
        DONE or FAILED of `napari_shadowinv.io.store`.
    seconds : float
        Time that its worker spent on it, reading and writing included.
    reason : str
        Why it failed.
    converged : bool
        Whether the solver reached its tolerance.
    """

    index: int
    status: int
    seconds: float
    reason: str = ""
    converged: bool = True


@dataclass(frozen=True)
class RunProgress:
    """A sign of life from a run.

    Attributes
    ----------
    total, done, failed : int
        Shots of the stack, with those of earlier runs.
    engine : str
        Where the work is done.
    name : str
        The shot that has just ended; empty at the start and while nothing has ended.
    outcome : ShotOutcome or None
        What became of it.
    """

    total: int
    done: int
    failed: int
    engine: str
    name: str = ""
    outcome: ShotOutcome | None = None


OnRunProgress = Callable[[RunProgress], None]


def run_stack(
    shots: Any,
    out: str | Path,
    *,
    source: Any = None,
    mask: ArrayLike | None = None,
    options: InversionOptions | None = None,
    setup: ProtonSetup | OpticalSetup | None = None,
    variables: Collection[str] = STORED,
    dtype: str = "float32",
    reader: Reader = read_shot,
    warm_start: int = 1,
    scheduler: Any = None,
    workers: int | None = None,
    overwrite: bool = False,
    redo_failed: bool = False,
    on_progress: OnRunProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> xarray.Dataset:
    """Invert every shot into one store; run again, it goes on where it stopped.

    A shot that cannot be inverted fails alone, with its reason. What is written of a shot counts
    once it is complete, so a run may be interrupted or killed at any time.

    Parameters
    ----------
    shots, source, mask, options, setup, reader, warm_start
        See `invert_stack`. Options, setup, source, mask and shots must be those of the store
        where it is resumed.
    out : str or Path
        The store, ``name.shadowinv.zarr``.
    variables : collection of str, optional
        What to store. Default: potential, displacement and caustic; at a million pixels these
        are 13 MB a shot before compression, and the rest can be computed from them and the image.
    dtype : {"float32", "float64"}, optional
        Type of stored images. Seven digits are more than the inversion has. Sites, weights and
        numbers of a shot keep 64 bits.
    scheduler : str, distributed.Client, cluster or None, optional
        ``"threads"``, ``"processes"``, ``"synchronous"``, the address of a scheduler, a client or
        a cluster. Default: dask's current client, else threads. The values do not depend on it.
    workers : int, optional
        Shots that are inverted at once, on this machine. Default: as many as cores.
    overwrite : bool, optional
        Throw away what the store holds and begin anew.
    redo_failed : bool, optional
        Try shots again that failed before.
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
    if dtype not in ("float32", "float64"):
        raise InputError(f"dtype is {dtype!r}: expected 'float32' or 'float64'")
    stack = describe_stack(shots, source, mask, options, setup, variables, reader, warm_start)
    identity = _identity(stack, np.dtype(dtype), described_reader(reader))
    again = (PENDING, FAILED) if redo_failed else (PENDING,)
    with locked(path) as live:
        store = None
        if path.exists() and not overwrite:
            store = StackStore(path)
            _refuse_others(store, stack, identity)
            if not np.isin(store.statuses(), again).any():
                _Run(stack, store, (), on_progress, should_stop, live).tell("nothing to do")
                return read_stack(path)
        # Before a store is made: a scheduler that does not answer shall leave nothing behind.
        with engine_for(scheduler, workers) as engine:
            if store is None:
                store = _new_store(path, stack, np.dtype(dtype), identity, overwrite)
            _Run(stack, store, again, on_progress, should_stop, live).on(engine)
    return read_stack(path)


def _new_store(
    path: Path, stack: Stack, dtype: np.dtype[Any], identity: dict[str, str], overwrite: bool
) -> StackStore:
    """Make the store, all its shots pending."""
    coordinates = {
        name: Variable(*_dims_and_values(coordinate))
        for name, coordinate in coordinates_of(stack).items()
    }
    return create_store(
        path,
        stack.sizes,
        _variables(stack, dtype),
        coordinates,
        {**attributes_of(stack), **{name: value for name, value in identity.items() if value}},
        overwrite=overwrite,
    )


def _dims_and_values(coordinate: Any) -> tuple[tuple[str, ...], Any, dict[str, Any], Any]:
    if isinstance(coordinate, tuple):
        dim, values, attributes = coordinate
        dims: tuple[str, ...] = (dim,)
    else:
        dims, values, attributes = coordinate.dims, coordinate.values, dict(coordinate.attrs)
    values = np.asarray(values)
    if values.dtype.kind in "UO":
        return dims, str, attributes, values.astype(object)
    if values.dtype.kind in "mM":
        # As numbers, because Zarr has no times; the units say which.
        attributes = {**attributes, "units": "ns since 1970-01-01"}
        return dims, np.dtype("int64"), attributes, values.astype("datetime64[ns]").astype("int64")
    return dims, values.dtype, attributes, values


def _variables(stack: Stack, dtype: np.dtype[Any]) -> dict[str, Variable]:
    found: dict[str, Variable] = {}
    for name, (dims, labels) in variable_labels(stack.setup).items():
        if name not in stack.variables:
            continue
        exact = dtype_of(name).kind != "f" or "site" in dims
        kept = dtype_of(name) if exact else dtype
        shared = stack.is_shared(name)
        values = _shared_values(stack, name) if shared else None
        found[name] = Variable(dims if shared else ("shot", *dims), kept, labels, values)
    return found


def _shared_values(stack: Stack, name: str) -> NDArray[Any]:
    assert stack.beam is not None
    return np.asarray(values_of_beam(stack.beam, stack.options)[name])


def _identity(stack: Stack, dtype: np.dtype[Any], reader: str) -> dict[str, str]:
    """What must be the same for a store to be continued."""
    height, width = stack.shape
    sources = stack.sources
    source = "uniform"
    if sources is not None:
        source = f"one for each shot: {', '.join(sources.names)}"
    elif stack.beam is not None and stack.beam.source is not None:
        source = f"sha256 {checksum(stack.beam.source)}"
    return {
        "options": stack.options.model_dump_json(exclude={"threads"}),
        "setup": "" if stack.setup is None else stack.setup.model_dump_json(),
        "source_image": source,
        "mask_image": "none" if stack.mask is None else f"sha256 {checksum(stack.mask)}",
        "image_size": f"{width} × {height} px",
        "stored": f"{', '.join(stack.variables)} as {dtype}",
        "reader": reader,
        "warm_start": str(stack.warm_start),
    }


def _refuse_others(store: StackStore, stack: Stack, identity: dict[str, str]) -> None:
    """Refuse to mix what does not belong together in one store."""
    from importlib.metadata import version

    expected = {**identity, "package_version": version("napari-shadowinv")}
    for name, value in expected.items():
        found = str(store.attributes.get(name, ""))
        if found != value:
            raise InputError(
                f"{store.path} was begun with another {name.replace('_', ' ')} "
                f"({_difference(found, value)}): give the same again, overwrite it, or choose "
                "another name"
            )
    if store.names != stack.shots.names:
        raise InputError(
            f"{store.path} was begun with other shots ({_other_names(store.names, stack)}): give "
            "the same again, overwrite it, or choose another name"
        )
    for index in np.flatnonzero(store.statuses() == DONE):
        if not stack.shots.items[int(index)].unchanged(store.report(int(index))):
            raise InputError(
                f"{stack.shots.label(int(index))} has changed since it was inverted into "
                f"{store.path}: overwrite the store or choose another name"
            )


def _difference(found: str, value: str) -> str:
    try:
        before, now = json.loads(found), json.loads(value)
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        return ", ".join(f"{name}: {before.get(name)} there, {now.get(name)} now" for name in names)
    except (ValueError, AttributeError):
        return f"{shorten(found or 'none', 80)} there, {shorten(value or 'none', 80)} now"


def _other_names(before: tuple[str, ...], stack: Stack) -> str:
    now = stack.shots.names
    if len(before) != len(now):
        return f"{len(before)} there, {len(now)} now"
    index = next(i for i, (a, b) in enumerate(zip(before, now, strict=True)) if a != b)
    return f"shot {index}: {before[index]} there, {now[index]} now"


@dataclass(frozen=True)
class _Settings:
    """What the task of every shot needs to know."""

    writer: ShotWriter
    options: InversionOptions
    setup: Any
    variables: tuple[str, ...]
    mask: NDArray[np.bool_] | None
    workers: int | None


class _Run:
    """Hands shots to an engine and keeps the books."""

    def __init__(
        self,
        stack: Stack,
        store: StackStore,
        again: tuple[int, ...],
        on_progress: OnRunProgress | None,
        should_stop: ShouldStop | None,
        live: Callable[[], None],
    ) -> None:
        self._stack = stack
        self._store = store
        self._on_progress = on_progress
        self._should_stop = should_stop
        self._live = live
        statuses = store.statuses()
        self._todo = {int(index) for index in np.flatnonzero(np.isin(statuses, again))}
        self._counts = {
            status: 0 if status in again else int((statuses == status).sum())
            for status in (DONE, FAILED)
        }

    def tell(self, engine: str, outcome: ShotOutcome | None = None) -> None:
        """Count an outcome and tell of it."""
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
        stack = self._stack
        variables = tuple(name for name in stack.variables if not stack.is_shared(name))
        settings = engine.share(
            _Settings(
                self._store.writer,
                stack.options,
                stack.setup,
                variables,
                stack.mask,
                engine.workers,
            ),
            f"settings-{self._store.attributes['store_id']}-{time.time_ns()}",
        )
        beam = None
        if stack.beam is not None:
            beam = engine.share(stack.beam, f"beam-{stack.beam.key}")
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        running: dict[Any, list[int]] = {}
        batches = self._batches()
        is_file = stack.shots.array is None
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
                if future is not None:
                    self._end(engine, future, running.pop(future))
        except BaseException:
            for future in running:
                future.cancel()
            raise

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
        return engine.submit(_run_shots, items, labels, beam, settings, engine.stop)

    def _wait(self, engine: Engine, ended: queue.SimpleQueue[Any]) -> Any:
        """Return a task that has ended, or None after a while."""
        if self._should_stop is not None and self._should_stop():
            raise InversionCancelled("stopped on request; run again to resume")
        self._live()
        try:
            return ended.get(timeout=_POLL)
        except queue.Empty:
            engine.check()
            return None

    def _end(self, engine: Engine, future: Any, batch: list[int]) -> None:
        try:
            outcomes = engine.result(future)
        except WorkerDied as error:
            outcomes = [self._fail(index, str(error)) for index in batch if index in self._todo]
        for outcome in outcomes:
            self._todo.discard(outcome.index)
            self.tell(engine.name, outcome)

    def _fail(self, index: int, reason: str) -> ShotOutcome:
        self._store.writer.fail(index, {"reason": reason})
        return ShotOutcome(index, FAILED, 0.0, reason)


def _run_shots(
    shots: list[Any],
    labels: list[tuple[int, bool, Shot | None]],
    beam: Beam | None,
    settings: _Settings,
    stop: Any = None,
) -> list[ShotOutcome]:
    """Task: invert some shots one after the other and write each."""
    options = _with_threads(settings)
    previous: Inversion | None = None
    outcomes = []
    for shot, (index, wanted, source) in zip(shots, labels, strict=True):
        start = time.perf_counter()
        try:
            image, origin = _loaded(shot)
            here = beam
            if here is None:
                assert source is not None
                here = Beam.of(np.shape(image), source.load()[0], settings.mask)
            previous = invert_shot(
                image,
                here,
                options,
                start=previous,
                should_stop=None if stop is None else stop.is_set,
            )
        except InversionCancelled:
            raise
        except MemoryError:
            failure = "there is not enough memory for this shot on its worker"
        except (InputError, OSError) as error:
            failure = str(error) or type(error).__name__
        except Exception as error:
            # Whatever a reader or a solver stumbles over, the other shots shall go on.
            failure = f"{type(error).__name__}: {error}"
        else:
            failure = ""
        if failure:
            previous = None
        if not wanted:
            continue
        seconds = time.perf_counter() - start
        if failure or previous is None:
            settings.writer.fail(index, {"reason": failure, "seconds": seconds})
            outcomes.append(ShotOutcome(index, FAILED, seconds, failure))
        else:
            _write(settings, index, previous, origin, seconds)
            spent = time.perf_counter() - start
            outcomes.append(ShotOutcome(index, DONE, spent, converged=previous.report.converged))
    return outcomes


def _loaded(shot: Any) -> tuple[NDArray[Any], dict[str, Any]]:
    """Image of a shot; a block of a dask array on a cluster has been computed already."""
    if isinstance(shot, np.ndarray):
        return shot[0], {"sha256": checksum(shot[0])}
    image, origin = shot.load()
    return image, origin


def _with_threads(settings: _Settings) -> InversionOptions:
    if settings.options.threads is not None:
        return settings.options
    threads = threads_here(settings.workers)
    return settings.options.model_copy(update={"threads": threads})


def _write(
    settings: _Settings,
    index: int,
    inversion: Inversion,
    origin: dict[str, Any],
    seconds: float,
) -> None:
    names = dict.fromkeys(settings.variables)
    report = {
        **dataclasses.asdict(inversion.report),
        "stages": inversion.report.seconds,
        "seconds": seconds,
        **origin,
    }
    settings.writer.write(index, arrays_of(inversion, names, settings.setup), report)
