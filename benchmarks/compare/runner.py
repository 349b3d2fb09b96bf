"""Run solvers on images in processes of their own, with limits: `run`.

A pair of solver and image that was solved or has failed is not run again. Failures have names:
`out of time`, `out of memory`, `not finite`, `diverged`, or the error's message.
"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import re
import subprocess
import threading
import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compare.images import Case

Array = NDArray[np.float64]
Result = dict[str, Any]

WORKER = Path(__file__).with_name("worker.py")
OUT_OF_TIME, OUT_OF_MEMORY = "out of time", "out of memory"
_POLL_S = 0.05
_START_S = 300.0  # to import and compile
_LARGEST_ERROR = 100.0  # per cent; beyond it, no displacement at all would be better
_OBJECT = re.compile(r"<\S+ object at 0x[0-9a-f]+>")  # in messages
_MOST_EXHAUSTED = 3  # of a size, before a solver leaves it and larger ones
_ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA", "VECLIB")
}


@dataclass(frozen=True)
class Limits:
    """Limits of an image in s and bytes, and of all images of a size in s."""

    seconds: float = 120.0
    memory: int = 8 * 2**30
    budget: float = float("inf")


@dataclass
class Worker:
    """A solver's process, started again after it was stopped."""

    python: str
    module: str
    limits: Limits
    version: str = ""
    process: subprocess.Popen[str] | None = None
    replies: queue.SimpleQueue[str] = field(default_factory=queue.SimpleQueue)

    def ask(self, job: dict[str, str]) -> Result:
        """Solve an image; the reply is a measurement or has the key `error`."""
        if self.process is None and (failure := self._start()):
            return {"error": failure}
        assert self.process is not None
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(job) + "\n")
        self.process.stdin.flush()
        return self._reply(self.limits.seconds)

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def _start(self) -> str:
        environment = {**os.environ, **_ONE_THREAD, "COMPARE_LIMIT": f"{self.limits.seconds:g}"}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        self.replies = queue.SimpleQueue()
        self.process = subprocess.Popen(
            [self.python, str(WORKER), self.module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=environment,
        )
        threading.Thread(target=_collect, args=(self.process, self.replies), daemon=True).start()
        reply = self._reply(_START_S)
        self.version = reply.get("version", "")
        if failure := reply.get("error"):
            self.stop()
        return str(failure or "")

    def _reply(self, limit: float) -> Result:
        """Wait for a line; stop the process when a limit is passed."""
        end = time.monotonic() + limit
        while True:
            with contextlib.suppress(queue.Empty):
                line = self.replies.get(timeout=_POLL_S)
                if line:
                    return dict(json.loads(line))
                self.stop()
                return {"error": "the process died"}
            assert self.process is not None
            if time.monotonic() > end:
                self.stop()
                return {"error": OUT_OF_TIME}
            if resident_memory(self.process.pid) > self.limits.memory:
                self.stop()
                return {"error": OUT_OF_MEMORY}


def _collect(process: subprocess.Popen[str], replies: queue.SimpleQueue[str]) -> None:
    assert process.stdout is not None
    for line in process.stdout:
        replies.put(line)
    replies.put("")


def resident_memory(pid: int) -> int:
    """Memory of a process in bytes; 0 where the system does not report it."""
    with contextlib.suppress(OSError, IndexError):
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE")
    return 0


def relative_error(displacement: Array, truth: Array, source: Array) -> float:
    """L2 error where there is light in the source, in per cent of the true displacement."""
    lit = source > 1e-2 * source.mean()
    difference = np.linalg.norm((displacement - truth)[:, lit])
    return float(100 * difference / np.linalg.norm(truth[:, lit]))


def judge(reply: Result, output: Path, image: Path) -> Result:
    """Result of a reply: its measurements, with the error or the name of the failure."""
    if "error" in reply:
        return {"failure": _OBJECT.sub("", reply["error"]).rstrip(": ")}
    with np.load(image) as file:
        error = relative_error(np.load(output), file["displacement"], file["source"])
    if not np.isfinite(error):
        return {**reply, "failure": "not finite"}
    if error > _LARGEST_ERROR:
        return {**reply, "error_percent": error, "failure": "diverged"}
    return {**reply, "error_percent": error}


@dataclass
class Effort:
    """Cost of a solver so far, by the size of the images: limits passed, seconds, images left."""

    budget: float
    exhausted: Counter[int] = field(default_factory=Counter)
    seconds: dict[int, float] = field(default_factory=lambda: defaultdict(float))
    images: Counter[int] = field(default_factory=Counter)
    left: Counter[int] = field(default_factory=Counter)

    def reason_to_skip(self, size: int) -> str:
        """Say why an image of a size is not tried, or nothing."""
        for tried in sorted(self.images):
            if tried <= size and self.exhausted[tried] >= _MOST_EXHAUSTED:
                count = self.exhausted[tried]
                return f"{count} images of {tried}² px ran out of time or memory"
            if tried < size and 2 * self.left[tried] > self.images[tried]:
                return f"{self.budget:g} s did not do for half of the images of {tried}² px"
        if self.seconds[size] > self.budget:
            return f"the {self.budget:g} s for images of {size}² px were over"
        return ""


def run(
    worker: Worker, cases: list[Case], results: dict[str, Result], folder: Path, save: Any
) -> None:
    """Solve all images, small ones first, and put each result under the image's key."""
    effort = Effort(worker.limits.budget)
    output = folder / "displacement.npy"
    for case in sorted(cases, key=lambda case: case.size):
        result = results.get(case.key, {})
        if not result or "skipped" in result:
            if reason := effort.reason_to_skip(case.size):
                result = {"skipped": reason}
            else:
                image = folder / "images" / f"{case.key}.npz"
                begun = time.monotonic()
                reply = worker.ask({"image": str(image), "output": str(output)})
                result = judge(reply, output, image)
                effort.seconds[case.size] += time.monotonic() - begun
            results[case.key] = result
            save()
        effort.images[case.size] += 1
        effort.left[case.size] += "skipped" in result
        effort.exhausted[case.size] += result.get("failure") in (OUT_OF_TIME, OUT_OF_MEMORY)
    worker.stop()
