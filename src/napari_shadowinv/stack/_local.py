"""Worker processes on this machine: `local_client` starts some, connected.

Anyone who can talk to a dask scheduler or worker can have it run any code. So these talk among
themselves only: encrypted, with a key that is made for the run and exists nowhere but in them.
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
from napari_shadowinv._system.machine import interrupts_put_off

_ENVIRONMENT = "distributed.nanny.pre-spawn-environ"
_TRIMMING = "MALLOC_TRIM_THRESHOLD_"


@contextmanager
def local_client(count: int) -> Iterator[Any]:
    """Start worker processes of one thread each, which end with the block; yield a client."""
    distributed: Any = import_module("distributed")
    dask: Any = import_module("dask")
    with ExitStack() as opened:
        environment = dask.config.get(_ENVIRONMENT)
        opened.enter_context(dask.config.set(_settings(environment)))
        opened.enter_context(_forgotten(_TRIMMING, environment.get(_TRIMMING)))
        # Data spilled to disk when memory is short could be exchanged for code.
        own = str(opened.enter_context(temporary_folder("shadowinv")))
        opened.enter_context(dask.config.set({"temporary-directory": own}))
        # A cluster that is half made cannot be closed.
        with interrupts_put_off(), _hidden_from_workers():
            cluster = distributed.LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                host="127.0.0.1",
                protocol="tls://",
                security=distributed.Security.temporary(),
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                local_directory=own,
                # Workers that die are reported by the shots they were working on.
                silence_logs=logging.CRITICAL,
                preload=[__name__],
            )
            opened.enter_context(cluster)
            client = opened.enter_context(distributed.Client(cluster, set_as_default=False))
        yield client


def _settings(environment: dict[str, Any]) -> dict[str, Any]:
    """What differs from dask's own settings."""
    return {
        # They tell all the machine what is at work, to nobody's use.
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
        # Its records grow by megabytes a minute, and nobody would look at them.
        "distributed.worker.profile.enabled": False,
        # Dask looks at itself fifty times a second in each process, and writes down what it sees:
        # a twentieth of two cores.
        "distributed.admin.tick.interval": "500ms",
        "distributed.admin.system-monitor.interval": "5s",
        "distributed.worker.memory.monitor-interval": "500ms",
        # Dask has every array given back to the system at once. One of the same size is wanted
        # in the next moment: that takes an eighth of the time of a shot.
        _ENVIRONMENT: {name: value for name, value in environment.items() if name != _TRIMMING},
    }


@contextmanager
def _forgotten(name: str, value: Any) -> Iterator[None]:
    """Take a variable out of the environment if an earlier cluster has left it there."""
    if os.environ.get(name) != str(value):
        yield
        return
    kept = os.environ.pop(name)
    try:
        yield
    finally:
        os.environ.setdefault(name, kept)


@contextmanager
def _hidden_from_workers() -> Iterator[None]:
    """Keep Ctrl-C, which a terminal sends to all processes, from those that the block starts."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # They inherit the mask. Whatever starts the first process of all lifts it: let it be now.
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
