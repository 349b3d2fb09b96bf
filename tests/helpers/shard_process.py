"""Processes that write shards, each forked from one that has already loaded what they need.

    python -m helpers.shard_process

Each line on its input is a list of jobs to run at the same time; a line of its output has their
exit codes. A job is killed at its n-th change of a file of the store, if asked for.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from helpers.night import OPTIONS, make_shots
from napari_shadowinv import Recipe, RunOptions, invert, merge_stack, run_stack

_CHANGES = {"os.rename", "os.mkdir", "os.remove", "os.rmdir"}


class ShardProcesses:
    """The process that forks shards."""

    def __init__(self) -> None:
        tests = Path(__file__).parents[1]
        self._server = subprocess.Popen(
            [sys.executable, "-m", __name__],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tests), *sys.path])},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def run(self, *jobs: dict[str, Any]) -> list[int]:
        """Run jobs at the same time and return their exit codes, -9 of one that was killed."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.write(json.dumps(jobs) + "\n")
        self._server.stdin.flush()
        codes: list[int] = json.loads(self._server.stdout.readline())
        return codes

    def close(self) -> None:
        self._server.communicate()


@contextmanager
def shard_processes() -> Iterator[ShardProcesses]:
    processes = ShardProcesses()
    try:
        yield processes
    finally:
        processes.close()


def note_changes(note: Callable[[], None]) -> None:
    """Call a function before each change of a file of a store in this process."""

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        is_writing = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if (is_writing or event in _CHANGES) and ".shadowinv.zarr" in str(arguments[0]):
            note()

    sys.addaudithook(hook)


def _kill_at(change: int) -> None:
    """Kill this process when it begins a change of a file of a store."""
    count = 0

    def note() -> None:
        nonlocal count
        count += 1
        if count == change:
            os.kill(os.getpid(), signal.SIGKILL)

    note_changes(note)


def _work(out: str, shots: str, source: str, shard: str | None, kill_at: int | None) -> None:
    if kill_at is not None:
        _kill_at(kill_at)
    if shard is None:
        merge_stack(out)
        return
    run_stack(
        shots,
        out,
        Recipe(options=OPTIONS),
        source=np.load(source),
        run=RunOptions(shard=shard),
        scheduler="synchronous",
    )


def _fork(job: dict[str, Any]) -> int:
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        _work(**job)
        code = 0
    finally:
        os._exit(code)


def main() -> None:
    # Load kernels and modules; a store would start threads, which are not forked.
    images, source = make_shots(1)
    invert(images[0], source=source, options=OPTIONS)
    import_module("dask.array")
    import_module("xarray").backends.list_engines()
    for line in sys.stdin:
        pids = [_fork(job) for job in json.loads(line)]
        codes = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids]
        print(json.dumps(codes), flush=True)


if __name__ == "__main__":
    main()
