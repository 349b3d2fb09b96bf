"""Processes of tests, forked from one that has imported and loaded what they need.

- their context: `forking`; functions that they run: `run_files`, `serve`
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import dask
import numpy as np

from helpers.night import OPTIONS
from helpers.slow_reading import hang_once
from napari_shadowinv import Recipe, Shot, run_stack

TESTS = Path(__file__).parents[1]
SOURCES = Path(sys.modules["napari_shadowinv"].__file__ or "").parents[1]
SEARCHED = os.pathsep.join([str(SOURCES), str(TESTS)])  # by Python for modules


@contextmanager
def forking() -> Iterator[Any]:
    """Provide multiprocessing's context of such processes, also for the workers of dask."""
    if sys.platform != "linux":  # libraries elsewhere may not be forked
        yield multiprocessing.get_context("spawn")
        return
    from distributed.utils import get_mp_context

    with dask.config.set({"distributed.worker.multiprocessing-method": "forkserver"}):
        context: Any = get_mp_context()
        context.set_forkserver_preload(["helpers.preloaded"])
        with patch.dict(os.environ, PYTHONPATH=SEARCHED, PRELOADING="1"):
            multiprocessing.forkserver.ensure_running()  # type: ignore[attr-defined]
        yield context


def run_files(folder: Path, out: Path, scheduler: str, kill_at: int = 0) -> None:
    """Invert the shots of a folder; be killed before a change of a file of the store."""
    count = 0

    def kill_before(event: str, arguments: Any) -> None:
        nonlocal count
        is_writing = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        is_writing |= event in ("os.rename", "os.mkdir", "os.remove", "os.rmdir")
        if is_writing and ".shadowinv.zarr" in str(arguments[0]):
            count += 1
            if count == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(kill_before)
    shots = Shot(f"{folder}/shot_*.npy", source=np.load(folder / "source.npy"))
    run_stack(shots, out, Recipe(options=OPTIONS), reader=hang_once, scheduler=scheduler)


def serve(port: int) -> None:
    """Run a scheduler of dask and a worker until this process is killed."""
    from distributed import LocalCluster

    choices: dict[str, Any] = {"dashboard_address": "127.0.0.1:0", "scheduler_port": port}
    choices |= {"n_workers": 1, "threads_per_worker": 1, "processes": False}
    with LocalCluster(host="127.0.0.1", **choices):
        time.sleep(600)
