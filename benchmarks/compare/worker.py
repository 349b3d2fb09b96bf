"""Run one solver in its own environment: images come in as lines, measurements go out.

    python worker.py SOLVER

Each line of the input is a JSON object with `image`, an .npz file with `source` and `image`, and
`output`, where the displacement goes. Each line of the output says how it went.
Needs nothing but NumPy and the solver's own package.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import os
import resource
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

_AGAIN_S = 10.0  # a faster solve of the first image of a size runs twice, as the first may compile
_STATUS = Path("/proc/self/status")


def peak_memory() -> int:
    """Largest resident memory of this process in bytes, since `forget_peak` where it works."""
    if _STATUS.exists():
        for line in _STATUS.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def forget_peak() -> None:
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def processor_time() -> float:
    """Seconds of this process and of the programs that it has run."""
    of_programs = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + of_programs.ru_utime + of_programs.ru_stime


def tiny_pair() -> tuple[np.ndarray, np.ndarray]:
    y, x = (np.indices((32, 32)) - 15.5) / 6
    return np.ones((32, 32)), 1 + 0.1 * np.exp(-(y**2) - x**2)


def measure(
    solver: ModuleType, job: dict[str, str], idle: int, shapes: set[tuple[int, ...]]
) -> dict[str, Any]:
    with np.load(job["image"]) as file:
        source, image = file["source"], file["image"]
    runs = 1 if image.shape in shapes else 2
    shapes.add(image.shape)
    for _ in range(runs):
        forget_peak()
        wall, processor = time.perf_counter(), processor_time()
        displacement = np.asarray(solver.solve(source.copy(), image.copy()), dtype=float)
        wall, processor = time.perf_counter() - wall, processor_time() - processor
        if wall > _AGAIN_S:
            break
    np.save(job["output"], displacement)
    unit = 1 if sys.platform == "darwin" else 1024
    of_programs = unit * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    memory = max(peak_memory() - idle, of_programs)
    return {"seconds": wall, "processor_seconds": processor, "memory_bytes": memory}


def main() -> None:
    replies = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a solver prints is no measurement
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    sys.path.insert(0, str(Path(__file__).parent / "solvers"))
    try:
        solver = importlib.import_module(sys.argv[1])
        with contextlib.suppress(Exception):
            solver.solve(*tiny_pair())
        forget_peak()
        idle = peak_memory()
        reply: dict[str, Any] = {"version": solver.VERSION}
    except Exception as error:
        reply = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(reply), file=replies, flush=True)
    shapes: set[tuple[int, ...]] = set()
    for line in sys.stdin:
        job = json.loads(line)
        try:
            reply = measure(solver, job, idle, shapes)
        except MemoryError:
            reply = {"error": "out of memory"}
        except Exception as error:
            reply = {"error": f"{type(error).__name__}: {error}".splitlines()[0]}
        print(json.dumps(reply), file=replies, flush=True)


if __name__ == "__main__":
    main()
