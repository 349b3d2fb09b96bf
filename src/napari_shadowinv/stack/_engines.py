"""Engines that invert shots: threads, processes or a cluster; see `engine_for`.

Anyone who can connect to a dask scheduler or worker can make it run any code. So the worker
processes that `local_client` starts accept only each other: connections are encrypted with a key
that exists only for the run.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from multiprocessing import resource_tracker
from tempfile import TemporaryDirectory
from typing import Any

from napari_shadowinv._system.machine import available_threads, defer_interrupts
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.stack._shots import BlockReference, Exposure, ImageReference

_ENVIRONMENT = "distributed.nanny.pre-spawn-environ"
_TRIMMING = "MALLOC_TRIM_THRESHOLD_"


@contextmanager
def local_client(count: int) -> Iterator[Any]:
    """Start worker processes of one thread each, which end with the block; yield a client."""
    distributed: Any = import_module("distributed")
    dask: Any = import_module("dask")
    with ExitStack() as opened:
        environment = dask.config.get(_ENVIRONMENT)
        opened.enter_context(dask.config.set(_dask_settings(environment)))
        # An earlier cluster may have left it there.
        if os.environ.get(_TRIMMING) == str(environment.get(_TRIMMING)):
            opened.callback(os.environ.setdefault, _TRIMMING, os.environ.pop(_TRIMMING))
        # Data spilled to disk when memory is short could be exchanged for code.
        spill_folder = opened.enter_context(TemporaryDirectory(prefix="shadowinv-"))
        opened.enter_context(dask.config.set({"temporary-directory": spill_folder}))
        # A partly started cluster cannot be closed.
        with defer_interrupts(), _hidden_from_workers():
            cluster = distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                protocol="tls://",
                security=distributed.Security.temporary(),
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                local_directory=spill_folder,
                # Workers that die are reported by the shots they were working on.
                silence_logs=logging.CRITICAL,
                preload=[__name__],
            )
            opened.enter_context(cluster)
            client = opened.enter_context(distributed.Client(cluster, set_as_default=False))
        yield client


def _dask_settings(environment: dict[str, Any]) -> dict[str, Any]:
    return {
        # They show the work to all users of the machine, and nobody needs them.
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        # Its records grow by megabytes a minute, and nobody needs them.
        "distributed.worker.profile.enabled": False,
        # Dask monitors each process fifty times a second, which takes a twentieth of two cores.
        "distributed.admin.tick.interval": "500ms",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.memory.monitor-interval": "500ms",
        # Dask returns the memory of each array to the system at once, although the next array
        # has the same size: that takes an eighth of the time of a shot.
        _ENVIRONMENT: {name: value for name, value in environment.items() if name != _TRIMMING},
    }


@contextmanager
def _hidden_from_workers() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all processes, from those that the block starts."""
    with ExitStack() as opened:
        if hasattr(signal, "pthread_sigmask"):
            # They inherit the mask. Starting the very first process unblocks it: that happens here.
            resource_tracker.ensure_running()
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            opened.callback(signal.pthread_sigmask, signal.SIG_SETMASK, mask)
        yield


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C to the process that started this worker; dask calls it by its name."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


_CONNECT_TIMEOUT_S = 10.0
_POLL_S = 0.1  # between two looks at `should_stop` while connecting
_REFRESH_S = 2.0  # clusters grow and shrink
_TASKS_PER_SLOT = 2  # tasks for each slot: one that runs, one that waits for it to end
_MIN_FILE_TASKS = 64  # references are small, and adaptive clusters grow by their queue


class EngineError(OSError):
    """The cluster is gone: the run must end, and can be resumed."""


class WorkerDiedError(Exception):
    """All attempts at a shot ended with the death of the worker."""


class _Threads:
    """Threads of this process; `_Cluster` has the same methods."""

    def __init__(self, pool: ThreadPoolExecutor, workers: int) -> None:
        self.name = f"{workers} thread{'s' if workers > 1 else ''}"
        self.workers = workers  # None where they may be on other machines
        self.stop = threading.Event()  # ends tasks that run; None where they have their own process
        self._pool = pool

    def window(self, *, files: bool) -> int:
        """Return the number of tasks to submit ahead."""
        return _TASKS_PER_SLOT * self.workers

    def share(self, value: Any, name: str) -> Any:
        """Send a value to the workers, and return its representative for tasks."""
        return value

    def submit(self, task: Callable[..., Any], shot: Exposure, *args: Any) -> Any:
        """Start ``task(shot, block, *args)``, where a block is the computed image of a shot.

        The future has `add_done_callback` and `cancel`.
        """
        return self._pool.submit(task, shot, None, *args)

    def result(self, future: Any) -> Any:
        """Return the result of a task, or None if its worker died and it is repeated.

        Raises `WorkerDiedError`, or `EngineError` if all is lost.
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
        self._queried = -_REFRESH_S
        self._n_threads = 0

    def window(self, *, files: bool) -> int:
        return max(_TASKS_PER_SLOT * self._slots(), _MIN_FILE_TASKS if files else _TASKS_PER_SLOT)

    def _slots(self) -> int:
        if self.workers is not None:
            return self.workers
        if time.monotonic() > self._queried + _REFRESH_S:
            self._queried = time.monotonic()
            try:
                self._n_threads = sum(self._client.nthreads().values())
            except (OSError, ValueError, TimeoutError):
                self.check()
        return self._n_threads

    def share(self, value: Any, name: str) -> Any:
        # A task instead of scattered data: it is repeated if its worker dies.
        with self._as_engine_error():
            future = self._client.submit(_identity_task, value, key=name)
        self._shared.append(future)
        if self._slots():
            distributed: Any = import_module("distributed")
            # To all workers at once, because dask prefers workers that have it. This only saves
            # time: errors of workers or scheduler are handled with the tasks.
            with suppress(Exception), self._client.as_current():
                distributed.wait([future], timeout=_CONNECT_TIMEOUT_S)
                self._client.replicate([future])
        return future

    def submit(self, task: Callable[..., Any], shot: Exposure, *args: Any) -> Any:
        # A dask array may live on the cluster already, so its blocks are the cluster's tasks.
        with self._as_engine_error():
            block = None
            if isinstance(shot.images, BlockReference):
                block = self._client.compute(shot.images.block.to_delayed().ravel()[0])
                shot = replace(shot, images=ImageReference())
            return self._client.submit(task, shot, block, *args, pure=False)

    def result(self, future: Any) -> Any:
        from distributed.scheduler import KilledWorker

        try:
            with self._as_engine_error(), suppress(TimeoutError):
                return future.result(timeout=_CONNECT_TIMEOUT_S)
            self.check()
        except KilledWorker as error:
            if str(error.task) in {shared.key for shared in self._shared}:
                raise EngineError(
                    f"the workers of {self.name} crash before starting a shot: give them more "
                    "memory, or check their logs, then run again to resume"
                ) from error
            raise WorkerDiedError(
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
    def _as_engine_error(self) -> Iterator[None]:
        """Convert all of dask's errors of a lost scheduler to an `EngineError`."""
        from distributed import CancelledError as Cancelled
        from distributed.comm.core import CommClosedError

        try:
            yield
        except (Cancelled, CancelledError, CommClosedError, TimeoutError) as error:
            raise self._lost() from error


Engine = _Threads | _Cluster


def _identity_task(value: Any) -> Any:
    return value


@contextmanager
def engine_for(
    scheduler: Any = None, workers: int | None = None, should_stop: ShouldStop | None = None
) -> Iterator[Engine]:
    """Start or find an engine; an engine that was started here is closed at the end."""
    scheduler = _resolve_scheduler(scheduler)
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
        with ExitStack() as opened:
            # No tracebacks of a lost connection in the terminal: `EngineError` reports it.
            for logger in map(logging.getLogger, ("distributed", "distributed.client")):
                opened.callback(logger.setLevel, logger.level)
                logger.setLevel(logging.CRITICAL)
            yield _Cluster(opened.enter_context(_connected(scheduler, should_stop)))


def is_local(scheduler: Any) -> bool:
    """Return whether `engine_for` starts an engine on this machine."""
    chosen = _resolve_scheduler(scheduler)
    return isinstance(chosen, str) and chosen in ("threads", "synchronous", "processes")


def _resolve_scheduler(scheduler: Any) -> Any:
    """Return the scheduler; by default dask's current client, else threads."""
    if scheduler is None and "distributed" in sys.modules:
        with suppress(ValueError):
            return import_module("distributed").default_client()
    return "threads" if scheduler is None else scheduler


def _threads(count: int) -> Iterator[Engine]:
    pool = ThreadPoolExecutor(count, thread_name_prefix="shot")
    engine = _Threads(pool, count)
    try:
        yield engine
    except BaseException:
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
            cause: BaseException = error
            while cause.__cause__ is not None:  # dask has wrapped it
                cause = cause.__cause__
            reason = str(cause).rstrip(".") or type(cause).__name__
            raise EngineError(
                f"{name} for the shots could not be started ({reason}): if memory is short use "
                "fewer workers, then run again to resume"
            ) from error
        yield _Cluster(client, name, count)


def _connected(scheduler: Any, should_stop: ShouldStop | None) -> Any:
    """Connect in a thread, so that the wait for a missing scheduler can be cancelled."""
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
                distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
            )
        except BaseException as error:
            answer.set_exception(error)

    def hang_up(answer: Future[Any]) -> None:
        if answer.exception() is None:
            answer.result().close()

    threading.Thread(target=connect, name="connect", daemon=True).start()
    try:
        while not wait([answer], timeout=_POLL_S).done:
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
