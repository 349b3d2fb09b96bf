"""Schedulers of dask that run the tasks of a stack's shots: `scheduler_for`."""

from __future__ import annotations

import logging
import multiprocessing
import os
import queue
import signal
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
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
_POLL_S = 0.25  # between two looks at `should_stop`
_STOPPED = "stopped on request; run again to resume"


class Scheduler:
    """A scheduler of dask on this machine; `_Cluster` is one elsewhere."""

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

    def outcomes(
        self,
        shots: Mapping[int, Exposure],
        context: TaskContext,
        should_stop: ShouldStop | None,
    ) -> Generator[ShotOutcome, None, None]:
        """Run shots by their numbers, and yield the outcome of each as it ends."""

        def is_stopped() -> bool:
            return self._stop.is_set() or (should_stop is not None and should_stop())

        def note(key: Any, value: Any, *_: Any) -> None:
            ended.put(value)
            if self._stop.is_set():
                raise InversionCancelled(_STOPPED)

        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        # Tasks elsewhere cannot ask here.
        ways = {"threads": is_stopped, "synchronous": is_stopped, "processes": _is_worker_stopped}
        tasks = _tasks(shots, context, ways.get(self._get))
        dask: Any = import_module("dask")
        pending = set(shots)
        with ThreadPoolExecutor(1, "dask", _block_interrupts) as caller:
            run = caller.submit(
                dask.compute,
                *tasks,
                scheduler=self._get,
                pool=self._pool,
                chunksize=1,
                callbacks=[(None, None, None, note, None)],
            )
            run.add_done_callback(ended.put)
            try:
                while (outcome := _next_of(ended, should_stop)) is not run:
                    if isinstance(outcome, ShotOutcome):  # and not a value that tasks share
                        pending.discard(outcome.index)
                        yield outcome
                # A scheduler of the user's may know no callbacks.
                yield from (outcome for outcome in run.result() if outcome.index in pending)
            except BaseException as error:
                self._stop.set()
                if not isinstance(error, BrokenProcessPool):
                    raise
                raise RunInterruptedError(
                    "a worker process ended before its shot was done; it may have had too little "
                    "memory: use fewer workers, then run again to resume"
                ) from None


class _Cluster(Scheduler):
    """The scheduler of a client of dask.distributed."""

    def __init__(self, client: Any) -> None:
        address = getattr(client.scheduler, "address", "?") if client.scheduler else "?"
        threads: Counter[str | None] = Counter()
        for worker, count in client.nthreads().items():
            threads[urlsplit(worker).hostname] += count
        # Of the fullest machine; an adaptive cluster may have none yet.
        most = max(threads.values(), default=None)
        super().__init__(f"the scheduler at {address}", None, most)
        self._client = client

    def outcomes(
        self,
        shots: Mapping[int, Exposure],
        context: TaskContext,
        should_stop: ShouldStop | None,
    ) -> Generator[ShotOutcome, None, None]:
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        with self._as_interruption(), warnings.catch_warnings():
            # What shots share has to be sent, however large it is.
            warnings.filterwarnings("ignore", "Sending large graph", UserWarning)
            tasks = _tasks(shots, context, blocks=True)
            running = dict(zip(self._client.compute(tasks), shots, strict=True))
        for future in running:
            future.add_done_callback(ended.put)
        try:
            while running:
                future = _next_of(ended, should_stop, self._check)
                yield self._outcome(future, running.pop(future), context)
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

    def _check(self) -> None:
        if self._client.status != "running":
            raise self._lost()

    def _lost(self) -> RunInterruptedError:
        return RunInterruptedError(
            f"lost the connection to {self.name}: restart it, then run again to resume"
        )

    @contextmanager
    def _as_interruption(self) -> Iterator[None]:
        """Convert all of dask's errors of a lost scheduler."""
        from distributed import CancelledError as Cancelled
        from distributed.comm.core import CommClosedError

        try:
            yield
        except (Cancelled, CancelledError, CommClosedError, TimeoutError) as error:
            raise self._lost() from error


def _tasks(
    shots: Mapping[int, Exposure],
    context: TaskContext,
    should_stop: ShouldStop | None = None,
    *,
    blocks: bool = False,
) -> list[Any]:
    """Return a task for each shot; blocks of a dask array are tasks of their own if asked for."""
    from dask.delayed import delayed

    # New in each run: dask would reuse the earlier values.
    name = f"{context.writer.store_id}-{time.time_ns()}"
    # Each worker gets it once.
    shared = delayed(context, name=f"context-{name}", traverse=False)
    tasks = []
    for index, shot in shots.items():
        block = []
        if blocks and isinstance(shot, ArrayExposure) and shot.is_lazy:
            block = [shot.block.to_delayed().ravel()[0]]
            shot = Exposure(shot.name, source=shot.source)
        key = f"{2 * 10**9 - index}-{name}"  # of ten digits each: dask begins with the last
        run = partial(run_shot, shot, index, should_stop)
        task = delayed(run, name=f"run-{key}", traverse=False)
        tasks.append(task(shared, *block, dask_key_name=f"shot-{key}"))
    return tasks


def _next_of(
    ended: queue.SimpleQueue[Any],
    should_stop: ShouldStop | None,
    check: Callable[[], None] = lambda: None,
) -> Any:
    """Wait for the next entry; look regularly whether to stop."""
    while True:
        if should_stop is not None and should_stop():
            raise InversionCancelled(_STOPPED)
        with suppress(queue.Empty):
            return ended.get(timeout=_POLL_S)
        check()


@contextmanager
def scheduler_for(scheduler: Any = None, workers: int | None = None) -> Iterator[Scheduler]:
    """Find a scheduler, or start a pool for it, which ends with the block."""
    chosen = _resolve(scheduler)
    count = workers or available_threads(None)
    with ExitStack() as opened:
        if is_local(chosen):
            yield opened.enter_context(_local(chosen, count))
            return
        try:
            distributed: Any = import_module("distributed")
        except ImportError:
            raise InputError(
                f"the scheduler {scheduler} needs distributed: install it with pip install "
                "'napari-shadowinv[cluster]', or use threads or processes"
            ) from None
        if not isinstance(chosen, distributed.Client):
            # No tracebacks of a lost connection in the terminal: our errors report it.
            for logger in map(logging.getLogger, ("distributed", "distributed.client")):
                opened.callback(logger.setLevel, logger.level)
                logger.setLevel(logging.CRITICAL)
            chosen = opened.enter_context(_connected(distributed, chosen))
        yield _Cluster(chosen)


def is_local(scheduler: Any) -> bool:
    """Return whether `scheduler_for` finds a scheduler on this machine."""
    chosen = _resolve(scheduler)
    is_name = isinstance(chosen, str) and "://" not in chosen
    return is_name or callable(chosen) or isinstance(chosen, Executor)


def _resolve(scheduler: Any) -> Any:
    """Return the scheduler; by default dask's current client, its setting, or threads."""
    if scheduler is None and "distributed" in sys.modules:
        with suppress(ValueError):
            return import_module("distributed").default_client()
    dask: Any = import_module("dask")
    return scheduler or dask.config.get("scheduler", None) or "threads"


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
            yield Scheduler(name, scheduler, count, pool, stop)
    else:
        raise InputError(
            f"scheduler is {scheduler!r}: expected 'threads', 'processes', 'synchronous', an "
            "address such as tcp://host:8786, a Client or a cluster"
        )


_stop_of_worker: Any = None  # of a worker process: the event that ends its shot


def _block_interrupts() -> None:
    """Keep Ctrl-C, which a terminal sends to all, from processes that this thread starts."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})


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


def _connected(distributed: Any, scheduler: Any) -> Any:
    try:
        return distributed.Client(scheduler, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"no scheduler responds at {scheduler} ({type(error).__name__}): start it with 'dask "
            "scheduler', and check the address and, for tls://, the keys"
        ) from None
