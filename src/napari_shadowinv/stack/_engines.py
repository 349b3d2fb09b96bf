"""Where shots are inverted: in this process, in others, on a cluster; see `engine_for`."""

from __future__ import annotations

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from typing import Any

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.stack._local import local_client
from napari_shadowinv.stack._sources import BlockShot, Shot

_CONNECT_SECONDS = 10.0
_POLL = 0.1  # seconds between two looks at `should_stop` while connecting
_ASKED_AGAIN_AFTER = 2.0  # seconds: clusters grow and shrink
_AHEAD = 2  # tasks for each slot: one that runs, one that waits for it to end
_AHEAD_OF_FILES = 64  # references to files are small; a cluster that grows wants to see work


class EngineError(OSError):
    """The cluster is gone: the run must end, and can be resumed."""


class WorkerDied(Exception):  # noqa: N818 - it is what happened to a shot
    """A shot was tried several times and each time the worker died."""


class _Threads:
    """Threads of this process; what the methods promise, those of `_Cluster` do too."""

    stop: threading.Event | None  # set to end tasks that run, if they share this process
    workers: int | None  # on this machine, if it is known that all of them are

    def __init__(self, pool: ThreadPoolExecutor, workers: int) -> None:
        self.name = f"{workers} thread{'s' if workers > 1 else ''}"
        self.workers = workers
        self.stop = threading.Event()
        self._pool = pool

    def window(self, *, files: bool) -> int:
        """Return how many tasks to hand over at once."""
        return _AHEAD * (self.workers or 1)

    def share(self, value: Any, name: str) -> Any:
        """Bring a value to where the tasks are, and return what stands for it."""
        return value

    def submit(self, task: Callable[..., Any], shots: list[Shot], *args: Any) -> Any:
        """Start ``task(shots, *args)``; the future has `add_done_callback` and `cancel`."""
        return self._pool.submit(task, shots, *args)

    def result(self, future: Any) -> Any:
        """Return what a task returned, or None if its worker died since and it is done again.

        Raises `WorkerDied`, or `EngineError` if all is lost.
        """
        return future.result()

    def check(self) -> None:
        """Raise `EngineError` if the engine is gone."""


class _Cluster:
    """Workers of `dask.distributed`."""

    stop = None

    def __init__(self, client: Any, name: str = "", workers: int | None = None) -> None:
        address = getattr(client.scheduler, "address", "?") if client.scheduler else "?"
        self.name = name or f"the scheduler at {address}"
        self.workers = workers
        self._client = client
        self._shared: list[Any] = []
        self._asked = -_ASKED_AGAIN_AFTER
        self._known = 0

    def window(self, *, files: bool) -> int:
        return max(_AHEAD * self._slots(), _AHEAD_OF_FILES if files else _AHEAD)

    def _slots(self) -> int:
        if self.workers is not None:
            return self.workers
        if time.monotonic() > self._asked + _ASKED_AGAIN_AFTER:
            self._asked = time.monotonic()
            try:
                self._known = sum(self._client.nthreads().values())
            except (OSError, ValueError, TimeoutError):
                self.check()
        return self._known

    def share(self, value: Any, name: str) -> Any:
        # A task and not scattered data: it is made again when the worker that had it dies.
        with self._connected_or_lost():
            future = self._client.submit(_same, value, key=name)
        self._shared.append(future)
        if self._slots():
            distributed: Any = import_module("distributed")
            # To all workers at once, because dask gives tasks to those that have it first. Only
            # to save time: a worker or scheduler that dies meanwhile shows where it matters.
            with suppress(Exception), self._client.as_current():
                distributed.wait([future], timeout=_CONNECT_SECONDS)
                self._client.replicate([future])
        return future

    def submit(self, task: Callable[..., Any], shots: list[Shot], *args: Any) -> Any:
        # A dask array may live on the cluster already, so its blocks are the cluster's tasks.
        with self._connected_or_lost():
            handed = [
                self._client.compute(shot.block.to_delayed().ravel()[0])
                if isinstance(shot, BlockShot)
                else shot
                for shot in shots
            ]
            return self._client.submit(task, handed, *args, pure=False)

    def result(self, future: Any) -> Any:
        from distributed.scheduler import KilledWorker

        try:
            with self._connected_or_lost(), suppress(TimeoutError):
                return future.result(timeout=_CONNECT_SECONDS)
            self.check()
        except KilledWorker as error:
            if str(error.task) in {shared.key for shared in self._shared}:
                raise EngineError(
                    f"the workers of {self.name} crash before starting a shot: give them more "
                    "memory, or check their logs, then run again to resume"
                ) from error
            raise WorkerDied(
                "the worker crashed on every attempt: it may have too little memory for this "
                "shot, or its machine may have gone down"
            ) from error
        return None

    def check(self) -> None:
        if self._client.status != "running":
            raise self._lost()

    def _lost(self) -> EngineError:
        return EngineError(
            f"lost the connection to {self.name}: restart it, then run again to resume"
        )

    @contextmanager
    def _connected_or_lost(self) -> Iterator[None]:
        """Turn all the ways in which dask says that the scheduler is gone into one."""
        from distributed import CancelledError as Cancelled
        from distributed.comm.core import CommClosedError

        try:
            yield
        except (Cancelled, CancelledError, CommClosedError, TimeoutError) as error:
            raise self._lost() from error


Engine = _Threads | _Cluster


def _same(value: Any) -> Any:
    return value


@contextmanager
def engine_for(
    scheduler: Any = None, workers: int | None = None, should_stop: ShouldStop | None = None
) -> Iterator[Engine]:
    """Make or find an engine; what was made here is taken down at the end."""
    if workers is not None and workers < 1:
        raise InputError(f"workers is {workers}: expected 1 or more")
    scheduler = _chosen(scheduler)
    count = workers or available_threads(None)
    if scheduler in ("threads", "synchronous"):
        yield from _threads(1 if scheduler == "synchronous" else count)
    elif scheduler == "processes":
        yield from _processes(count)
    elif isinstance(scheduler, str) and "://" not in scheduler:
        raise InputError(
            f"scheduler is {scheduler!r}: expected 'threads', 'processes', 'synchronous', an "
            "address such as tcp://host:8786, a Client or a cluster"
        )
    elif isinstance(scheduler, import_module("distributed").Client):
        yield _Cluster(scheduler)
    else:
        with _quiet_dask(), _connected(scheduler, should_stop) as client:
            yield _Cluster(client)


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Keep dask's tracebacks of a lost connection from the terminal: `EngineError` reports it."""
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def is_here(scheduler: Any) -> bool:
    """Whether `engine_for` makes an engine on this machine of this."""
    chosen = _chosen(scheduler)
    return isinstance(chosen, str) and chosen in ("threads", "synchronous", "processes")


def _chosen(scheduler: Any) -> Any:
    """What is meant: by default dask's current client, else threads."""
    if scheduler is None and "distributed" in sys.modules:
        distributed: Any = sys.modules["distributed"]
        with suppress(ValueError):
            return distributed.default_client()
    return "threads" if scheduler is None else scheduler


def _threads(count: int) -> Iterator[Engine]:
    pool = ThreadPoolExecutor(count, thread_name_prefix="shot")
    engine = _Threads(pool, count)
    try:
        yield engine
    except BaseException:
        if engine.stop is not None:
            engine.stop.set()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _processes(count: int) -> Iterator[Engine]:
    name = f"{count} process{'es' if count > 1 else ''}"
    with ExitStack() as opened:
        try:
            client = opened.enter_context(local_client(count))
        except (OSError, RuntimeError) as error:
            raise EngineError(
                f"{name} for the shots could not be started ({_last_cause(error)}): if memory is "
                "short use fewer workers, then run again to resume"
            ) from error
        yield _Cluster(client, name, count)


def _last_cause(error: BaseException) -> str:
    """What dask wraps in what it says itself."""
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).rstrip(".") or type(error).__name__


def _connected(scheduler: Any, should_stop: ShouldStop | None) -> Any:
    """Connect in a thread: only so can the wait for a scheduler that is not there be ended."""
    distributed: Any = import_module("distributed")
    if isinstance(scheduler, str) and scheduler.startswith("tls://"):
        keys = distributed.Security().get_connection_args("client")
        if keys.get("ssl_context") is None:
            raise EngineError(
                f"no scheduler can be reached at {scheduler} without keys: set "
                "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, __CLIENT__CERT and __CLIENT__KEY"
            )
    answer: Future[Any] = Future()

    def connect() -> None:
        try:
            answer.set_result(
                distributed.Client(scheduler, timeout=_CONNECT_SECONDS, set_as_default=False)
            )
        except BaseException as error:
            answer.set_exception(error)

    def hang_up(answer: Future[Any]) -> None:
        if answer.exception() is None:
            answer.result().close()

    threading.Thread(target=connect, name="connect", daemon=True).start()
    try:
        while not wait([answer], timeout=_POLL).done:
            if should_stop is not None and should_stop():
                raise InversionCancelled("stopped on request; run again to resume")
    except BaseException:
        answer.add_done_callback(hang_up)
        raise
    try:
        return answer.result()
    except (OSError, TypeError, ValueError) as error:
        raise EngineError(
            f"no scheduler responds at {scheduler} ({type(error).__name__}): start it with 'dask "
            "scheduler', and check the address and, for tls://, the keys"
        ) from None
