"""A night of many small shots in shards, some of which are killed, against a single run.

    python benchmarks/facility_night.py [--shots 10000] [--shards 40] [--killed 10] [--seed 0]

Simulated shots of 32 × 32 px are inverted with 300 sites each: once by a single run, and once in
shards, each a process of its own with one thread, two at a time, in random order. Some shards are
killed (SIGKILL) at random moments and repeated, the first of all while it creates the store. Then
the store is merged, each of its files is compared with that of the single run, and the folder is
searched for leftovers. One in 500 shots is empty and fails.

Bytes must be equal, except for times and the store's identifier: `created`, `store_id` and the
seal over both in `zarr.json`, seconds in reports and their column, the identifier in reports.

CPU times, which depend less on other work of the machine, are those of all processes with their
start.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob

SIDE = 32
SITES = 300
EMPTY_PERIOD = 500  # one shot of as many is empty
AT_ONCE = 2
PATIENCE_S = 600.0
MAX_DELAY_S = 0.2  # of a kill, after the shot that triggers it
# Values that are new in each run
RUN_ATTRIBUTES = ("created", "store_id", "metadata_sha256")
RUN_ENTRIES = ("seconds", "stages")  # of a shot's report
RUN_COLUMNS = ("seconds",)


def write_shots(folder: Path, count: int) -> None:
    """Write noisy shots of a plume that wanders, and their reference."""
    shape = (SIDE, SIDE)
    (folder / "shots").mkdir()
    np.save(folder / "reference.npy", np.full(shape, 1000.0))
    for number in range(count):
        rng = np.random.default_rng(number)
        centre = tuple(SIDE / 2 + rng.normal(0, 2, 2))
        blob = gaussian_blob(shape, 15 * (1 + 0.2 * rng.random()), 0.14 * SIDE, centre)
        image = rng.poisson(1000 * synthetic_image(blob.displacement, threads=1))
        is_empty = number % EMPTY_PERIOD == EMPTY_PERIOD - 1
        np.save(folder / "shots" / f"shot_{number:05d}.npy", image * (not is_empty))


def contents(store: Path) -> dict[str, Any]:
    """Return the content of each file of a store, without what is new in each run."""
    files: dict[str, Any] = {}
    for path in sorted(store.rglob("*")):
        if not path.is_file():
            continue
        key = path.relative_to(store).as_posix()
        raw = path.read_bytes()
        if key == "zarr.json":
            document = json.loads(raw)
            for name in RUN_ATTRIBUTES:
                document["attributes"].pop(name)
            files[key] = json.dumps(document)  # with the order of its entries
        elif key.startswith("report/c/"):
            (length,) = struct.unpack("<I", raw[4:8])
            report = json.loads(raw[8 : 8 + length] or b"{}")
            entries = {k: v for k, v in report.items() if k not in RUN_ENTRIES}
            entries["place"] = entries.get("place", [None])[1:]  # without the store's identifier
            files[key] = json.dumps(entries)
        elif key.partition("/c/")[0] in RUN_COLUMNS and "/c/" in key:
            files[key] = "times"
        else:
            files[key] = raw
    return files


def differences(store: Path, expected: Path) -> list[str]:
    """Return the names of the files that only one of two stores has, or that differ."""
    first, second = contents(store), contents(expected)
    return sorted(key for key in first.keys() | second.keys() if first.get(key) != second.get(key))


def leftovers(folder: Path, names: Sequence[str]) -> list[str]:
    """Return what is in a folder except some names, and unfinished or hidden files below it."""
    beside = [path.name for path in folder.iterdir() if path.name not in names]
    below = [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.name.startswith(".") or path.name.endswith(".partial")
    ]
    return sorted({*beside, *below})


@dataclass(frozen=True)
class Kill:
    """Moment at which a shard is killed: some time after a share of its shots, or its draft."""

    share: float | None  # None: while it creates the store
    delay_s: float


@dataclass(frozen=True)
class Night:
    """The folder of a night, and how its shots are inverted."""

    folder: Path
    shots: int
    shards: int

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """Start the command in a process of its own."""
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
        program = "from napari_shadowinv.cli import app; app()"
        return subprocess.Popen(
            [sys.executable, "-c", program, *arguments],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    def batch(self, out: str, *arguments: str) -> subprocess.Popen[str]:
        """Start a run of the shots."""
        return self.start(
            "batch", "shots/*.npy", "--source", "reference.npy", "--n-sites", str(SITES),
            "--threads", "1", "--workers", "1", "--scheduler", "threads", "--quiet",
            "--out", out, *arguments,
        )  # fmt: skip

    def run_shard(self, number: int, kill: Kill | None) -> bool:
        """Run a shard to its end; return whether it was killed before, and repeated."""
        arguments = ("night.shadowinv.zarr", "--shard", f"{number}/{self.shards}")
        was_killed = False
        if kill is not None:
            process = self.batch(*arguments)
            end = time.monotonic() + PATIENCE_S
            while process.poll() is None and time.monotonic() < end:
                if self._is_due(kill, number):
                    break
                time.sleep(0.002)
            time.sleep(kill.delay_s)
            process.send_signal(signal.SIGKILL)
            process.communicate()
            was_killed = process.returncode == -signal.SIGKILL
        check(self.batch(*arguments))
        return was_killed

    def _is_due(self, kill: Kill, number: int) -> bool:
        if kill.share is None:
            return any(self.folder.glob(".night*"))
        shots = range(number - 1, self.shots, self.shards)
        last = shots[int(kill.share * len(shots))]
        return (self.folder / "night.shadowinv.zarr" / "status" / "c" / str(last)).exists()


@dataclass
class Times:
    """Time of a part of the night, and CPU time of the processes that it started (s)."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0

    def text(self, shots: int) -> str:
        """Return both, and the CPU time of a shot."""
        per_shot = 1e3 * self.cpu_seconds / shots
        return f"{self.seconds:.0f} s, CPU {self.cpu_seconds:.0f} s, {per_shot:.1f} ms a shot"


@contextmanager
def timed() -> Iterator[Times]:
    """Time a block; its times are known after it."""
    times, began, before = Times(), time.perf_counter(), cpu_seconds()
    yield times
    times.seconds, times.cpu_seconds = time.perf_counter() - began, cpu_seconds() - before


def cpu_seconds() -> float:
    """Return the CPU time of all processes that were started and have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def check(process: subprocess.Popen[str]) -> None:
    """Wait for a command, and end the benchmark unless it has written its shots."""
    _, errors = process.communicate()
    if process.returncode not in (0, 1, 3):  # failed or doubtful shots are no failure of the run
        raise SystemExit(f"exit code {process.returncode}: {errors}")


def compare(night: Night, killed: int, seed: int) -> list[tuple[str, str]]:
    """Invert the shots both ways, and return the rows of the table."""
    rng = random.Random(seed)
    with timed() as single:
        check(night.batch("single.shadowinv.zarr"))

    order = rng.sample(range(1, night.shards + 1), night.shards)
    kills = {
        number: Kill(rng.random(), rng.uniform(0, MAX_DELAY_S))
        for number in rng.sample(order[1:], min(killed, night.shards) - 1)
    }
    kills[order[0]] = Kill(None, rng.uniform(0, MAX_DELAY_S))
    with timed() as sharded, ThreadPoolExecutor(AT_ONCE) as pool:
        runs = list(pool.map(lambda number: night.run_shard(number, kills.get(number)), order))
    names = ("shots", "reference.npy", "night.shadowinv.zarr", "single.shadowinv.zarr")
    unfinished = len(leftovers(night.folder, names))
    with timed() as merging:
        check(night.start("merge", "night.shadowinv.zarr", "--quiet"))

    store, expected = (night.folder / f"{name}.shadowinv.zarr" for name in ("night", "single"))
    files = sum(path.is_file() for path in store.rglob("*"))
    unequal = differences(store, expected)
    remains = leftovers(night.folder, names)
    return [
        ("shots, shards", f"{night.shots}, {night.shards}"),
        ("single run, one thread", single.text(night.shots)),
        (f"shards, {AT_ONCE} at once, with repeats", sharded.text(night.shots)),
        ("shards killed and repeated", str(sum(runs))),
        ("leftovers before the merge", str(unfinished)),
        ("merge", merging.text(night.shots)),
        ("files that differ from the single run", f"{len(unequal)} of {files} {unequal[:3] or ''}"),
        ("leftovers after it", f"{len(remains)} {remains[:3] or ''}"),
    ]


def main() -> None:
    """Print a table of the times and of everything that differs."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--shots", type=int, default=10_000)
    parser.add_argument("--shards", type=int, default=40)
    parser.add_argument("--killed", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        night = Night(Path(name), arguments.shots, arguments.shards)
        write_shots(night.folder, night.shots)
        rows = compare(night, arguments.killed, arguments.seed)
    print("| | |\n|---|---|")
    for row in rows:
        print("| {} | {} |".format(*row))


if __name__ == "__main__":
    main()
