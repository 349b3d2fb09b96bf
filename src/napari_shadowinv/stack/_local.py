"""Worker processes on this machine: `local_client` starts some, connected.

Anyone who can connect to a dask scheduler or worker can make it run any code. So these processes
accept only each other: connections are encrypted with a key that exists only for the run.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from multiprocessing import resource_tracker
from typing import Any

from napari_shadowinv._system.hidden_files import temporary_folder
from napari_shadowinv._system.machine import defer_interrupts

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
        opened.enter_context(_without_variable(_TRIMMING, environment.get(_TRIMMING)))
        # Data spilled to disk when memory is short could be exchanged for code.
        spill_folder = str(opened.enter_context(temporary_folder("shadowinv")))
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
    """Return the changes to dask's configuration."""
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
def _without_variable(name: str, value: Any) -> Iterator[None]:
    """Remove a variable from the environment if an earlier cluster has left it there."""
    if os.environ.get(name) != str(value):
        yield
        return
    value_before = os.environ.pop(name)
    try:
        yield
    finally:
        os.environ.setdefault(name, value_before)


@contextmanager
def _hidden_from_workers() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all processes, from those that the block starts."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # They inherit the mask. Starting the very first process unblocks it, so that happens here.
    resource_tracker.ensure_running()
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C to the process that started this worker; dask calls it by its name."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
