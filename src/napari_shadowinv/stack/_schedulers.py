"""Schedulers of dask that run the tasks of a stack's shots: `scheduler_for`."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Executor, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from importlib import import_module
from typing import Any
from urllib.parse import urlsplit

from threadpoolctl import threadpool_limits

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv.errors import (
    FileFormatError,
    InputError,
    InversionCancelled,
    RunInterruptedError,
)
from napari_shadowinv.stack._shots import ArrayExposure, Exposure, failure_text
from napari_shadowinv.stack._worker import (
    ShotOutcome,
    TaskContext,
    run_shot,
    write_failure,
)

_CONNECT_TIMEOUT_S = 10.0
_STOPPED = "stopped on request; run again to resume"


class Scheduler:
    """A scheduler of dask on this machine; `_Cluster` is one elsewhere."""

    is_local = True

    def __init__(
        self,
        name: str,
        get: Any,
        workers: int | None,
        pool: Executor | None = None,
        stop: Any = None,
    ) -> None:
        self.name, self.workers = name, workers
        self._get, self._pool = get, pool
        self._stop = threading.Event() if stop is None else stop

    def run(
        self,
        shots: Mapping[int, Exposure],
        context: TaskContext,
        on_end: Callable[[ShotOutcome], None],
        should_stop: ShouldStop,
    ) -> None:
        """Run shots by their numbers; `on_end` takes the outcome of each as it ends."""

        def is_stopped() -> bool:
            return self._stop.is_set() or should_stop()

        def note(key: Any, value: Any, *_: Any) -> None:
            if isinstance(value, ShotOutcome):  # and not a value that tasks share
                pending.discard(value.index)
                on_end(value)
                _check(should_stop)

        # Tasks elsewhere cannot ask here.
        ways = {"threads": is_stopped, "synchronous": is_stopped, "processes": _is_worker_stopped}
        base: Any = import_module("dask.base")
        get = base.get_scheduler(scheduler=self._get)
        graph, keys = _graph(shots, context, ways.get(self._get))
        pending = set(shots)
        try:
            outcomes = get(
                graph,
                keys,
                pool=self._pool,
                chunksize=1,
                callbacks=[(None, None, None, note, None)],
            )
            for outcome in outcomes:  # a scheduler of the user's may know no callbacks
                if outcome.index in pending:
                    on_end(outcome)
        except BaseException as error:
            self._stop.set()
            if isinstance(error, BrokenProcessPool):
                raise RunInterruptedError(
                    "a worker process ended before its shot was done; it may have had too little "
                    "memory: use fewer workers, then run again to resume"
                ) from None
            if isinstance(error, InversionCancelled):  # by a task
                raise InversionCancelled(_STOPPED) from None
            raise


class _Cluster(Scheduler):
    """The scheduler of a client of dask.distributed."""

    is_local = False

    def __init__(self, client: Any) -> None:
        address = getattr(client.scheduler, "address", "?") if client.scheduler else "?"
        threads: Counter[str | None] = Counter()
        for worker, count in client.nthreads().items():
            threads[urlsplit(worker).hostname] += count
        # Of the fullest machine; an adaptive cluster may have none yet.
        most = max(threads.values(), default=None)
        super().__init__(f"the scheduler at {address}", None, most)
        self._client = client

    def run(
        self,
        shots: Mapping[int, Exposure],
        context: TaskContext,
        on_end: Callable[[ShotOutcome], None],
        should_stop: ShouldStop,
    ) -> None:
        distributed: Any = import_module("distributed")
        with self._as_interruption(), warnings.catch_warnings():
            # What shots share has to be sent, however large it is.
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            graph, keys = _graph(shots, context, blocks=True)
            running = dict(zip(self._client.get(graph, keys, sync=False), shots, strict=True))
        try:
            for future in distributed.as_completed(list(running), loop=self._client.loop):
                on_end(self._outcome(future, running.pop(future), context))
                _check(should_stop)
        finally:
            for future in running:
                future.cancel()

    def _outcome(self, future: Any, index: int, context: TaskContext) -> ShotOutcome:
        from distributed.scheduler import KilledWorker

        try:
            with self._as_interruption():
                outcome: ShotOutcome = future.result()
                return outcome
        except (RunInterruptedError, InversionCancelled):
            raise
        except KilledWorker:
            reason = (
                "the worker crashed on every attempt: it may have too little memory for this "
                "shot, or its machine may have gone down"
            )
        except Exception as error:  # of a dask array
            reason = failure_text(error)
        return write_failure(context.writer, index, reason)

    @contextmanager
    def _as_interruption(self) -> Iterator[None]:
        """Convert all of dask's errors of a lost scheduler."""
        from distributed import CancelledError as Cancelled
        from distributed.comm.core import CommClosedError

        try:
            yield
        except (Cancelled, CancelledError, CommClosedError, TimeoutError) as error:
            raise RunInterruptedError(
                f"lost the connection to {self.name}: restart it, then run again to resume"
            ) from error


def _graph(
    shots: Mapping[int, Exposure],
    context: TaskContext,
    should_stop: ShouldStop | None = None,
    *,
    blocks: bool = False,
) -> tuple[dict[Any, Any], list[str]]:
    """Return a graph with a task for each shot, and their keys.

    Blocks of a dask array are tasks of their own if asked for.
    """
    # New in each run: dask would reuse the earlier values.
    name = f"{context.writer.store_id}-{time.time_ns()}"
    shared, keys = f"context-{name}", list[str]()
    graph: dict[Any, Any] = {shared: context}  # each worker gets it once
    for index, shot in shots.items():
        parts = []
        if blocks and isinstance(shot, ArrayExposure) and shot.is_lazy:
            block = shot.block
            graph |= block.dask
            parts = [(block.name, 0, 0, 0)]
            shot = Exposure(shot.name)
        keys.append(f"shot-{2 * 10**9 - index}-{name}")  # of ten digits each: the last is first
        graph[keys[-1]] = (partial(run_shot, shot, index, should_stop), shared, *parts)
    return graph, keys


def _check(should_stop: ShouldStop) -> None:
    if should_stop():
        raise InversionCancelled(_STOPPED)


@contextmanager
def scheduler_for(scheduler: Any = None, workers: int | None = None) -> Iterator[Scheduler]:
    """Find a scheduler, or start a pool for it, which ends with the block.

    By default it is dask's current client, its setting, or threads.
    """
    if scheduler is None and "distributed" in sys.modules:
        with suppress(ValueError):
            scheduler = import_module("distributed").default_client()
    dask: Any = import_module("dask")
    chosen = scheduler or dask.config.get("scheduler", None) or "threads"
    is_name = isinstance(chosen, str) and "://" not in chosen
    is_local = is_name or callable(chosen) or isinstance(chosen, Executor)
    count = workers or available_threads(None)
    with _local(chosen, count) if is_local else _cluster(chosen) as found:
        yield found


@contextmanager
def _cluster(scheduler: Any) -> Iterator[Scheduler]:
    try:
        distributed: Any = import_module("distributed")
    except ImportError:
        raise InputError(
            f"the scheduler {scheduler} needs distributed: install it with pip install "
            "'napari-shadowinv[cluster]', or use threads or processes"
        ) from None
    if isinstance(scheduler, distributed.Client):
        yield _Cluster(scheduler)
        return
    with ExitStack() as opened:
        # No tracebacks of a lost connection in the terminal: our errors report it.
        for logger in map(logging.getLogger, ("distributed", "distributed.client")):
            opened.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL)
        try:
            client = distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
        except (OSError, RuntimeError, TypeError, ValueError) as error:
            raise FileFormatError(
                f"no scheduler responds at {scheduler} ({type(error).__name__}): start it with "
                "'dask scheduler', and check the address and, for tls://, the keys"
            ) from None
        yield _Cluster(opened.enter_context(client))


@contextmanager
def _local(scheduler: Any, count: int) -> Iterator[Scheduler]:
    if not isinstance(scheduler, str):
        yield Scheduler("the given scheduler", scheduler, count)
    elif scheduler == "synchronous":
        yield Scheduler("1 thread", scheduler, 1)
    elif scheduler == "threads":
        name = "1 thread" if count == 1 else f"{count} threads"
        with ThreadPoolExecutor(count, thread_name_prefix="shot") as pool:
            yield Scheduler(name, scheduler, count, pool)
    elif scheduler == "processes":
        name = "1 process" if count == 1 else f"{count} processes"
        spawn = multiprocessing.get_context("spawn")
        stop = spawn.Event()
        with ProcessPoolExecutor(count, spawn, _begin_worker, (stop,)) as pool:
            with _blocked_interrupts():
                for _ in range(count):
                    pool.submit(int)
            yield Scheduler(name, scheduler, count, pool, stop)
    else:
        raise InputError(
            f"scheduler is {scheduler!r}: expected 'threads', 'processes', 'synchronous', an "
            "address such as tcp://host:8786, a Client or a cluster"
        )


_stop_of_worker: Any = None  # of a worker process: the event that ends its shot


@contextmanager
def _blocked_interrupts() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all, from processes that start in this block."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin_worker(stop: Any) -> None:
    """Let a worker process end its shot with an event, and itself with the process above it."""
    global _stop_of_worker
    _stop_of_worker = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threadpool_limits(limits=1, user_api="blas")  # the shots side by side use the cores
    parent: Any = multiprocessing.parent_process()

    def end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=end, daemon=True).start()


def _is_worker_stopped() -> bool:
    return bool(_stop_of_worker.is_set())
