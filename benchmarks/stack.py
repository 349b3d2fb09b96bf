"""How well stacks of shots use more workers, and what dask costs.

    python benchmarks/stack.py [--shots 10] [--side 464 576] [--stream 1000] [--sites N]

First burner frames, summed over 2 × 2 pixels, with their reference beam (or simulated plumes):
the same run on one and on two workers with one thread each, beside what the machine itself gains
where two processes without dask do the same; what dask, reading and writing add to a shot; and
what sites cost the first and the later shots of a worker. Then a stream of small shots that exist
only while they are needed: memory of a worker against the number of shots, and the share of the
time that workers compute. Ratios do not depend on the machine as seconds do; nothing else should
run beside it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil  # dask needs it, too
from distributed import Client, LocalCluster

from napari_shadowinv import InversionOptions, Recipe, Shot, run, run_stack, synthetic_image
from napari_shadowinv.io import read_shot
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import Cache, RunOptions
from napari_shadowinv.preprocessing import Bin
from napari_shadowinv.stack import FileReader, ShotOutcome

BURNER = Path(__file__).resolve().parents[2] / "shared" / "data" / "burner" / "data"


def worker_memory() -> int:
    """Resident memory of this process in bytes."""
    return int(psutil.Process().memory_info().rss)


def plume(shape: tuple[int, int], number: int) -> np.ndarray:
    """One shot of a plume that wanders; the same for the same number."""
    rng = np.random.default_rng(number)
    height, width = shape
    centre = (0.5 * height + rng.normal(0, 2), width * (0.3 + 0.04 * (number % 10)))
    strength = 0.02 * min(shape) ** 2 * (1 + 0.2 * rng.random())
    blob = gaussian_blob(shape, strength, 0.14 * min(shape), centre)
    image = 1000 * synthetic_image(blob.displacement, threads=1)
    return rng.poisson(image).astype(np.float64)


def streamed(path: Path) -> np.ndarray:
    """Read a shot of the stream: only its number is in the file."""
    return plume((100, 100), int(path.read_text()))


@dataclass(frozen=True)
class Night:
    """Shots, their source, and how to read and invert them."""

    shots: list[Path]
    source: Path
    channel: str | None
    recipe: Recipe
    name: str


def night(folder: Path, count: int, shape: tuple[int, int], sites: int | None) -> Night:
    """Return burner frames, or plumes of another size or where there are no frames."""
    options = InversionOptions(n_sites=sites, threads=1)
    reference, shots = BURNER / "Image_00000.bmp", sorted(BURNER.glob("Image_2*.bmp"))[:count]
    if len(shots) == count and shape == (464, 576):
        recipe = Recipe(steps=(Bin(factor=2),), options=options)
        return Night(shots, reference, "mean", recipe, "burner, binned by 2")
    shots = [folder / f"shot_{number}.npy" for number in range(count)]
    for number, path in enumerate(shots):
        np.save(path, plume(shape, number))
    np.save(folder / "reference.npy", np.full(shape, 1000.0))
    recipe = Recipe(options=options)
    return Night(shots, folder / "reference.npy", None, recipe, "simulated plumes")


def warm_up(shots: int, folder: Path, scheduler: Any) -> None:
    """Let processes load what they need with a few tiny shots."""
    few = np.ones((shots, 24, 24)) + np.eye(24)
    options = InversionOptions(n_sites=100, threads=1)
    out = folder / "warm.shadowinv.zarr"
    run_stack(
        few, out, Recipe(options=options), scheduler=scheduler, run=RunOptions(overwrite=True)
    )


@contextmanager
def local_client(count: int) -> Iterator[Client]:
    """Start workers with one thread each."""
    local = {"host": "127.0.0.1", "dashboard_address": None, "threads_per_worker": 1}
    with LocalCluster(n_workers=count, **local) as cluster, Client(cluster) as client:
        yield client


def on_workers(count: int, timed: Callable[[Client], float], folder: Path) -> float:
    """Time a run on workers with one thread each that have done a few shots before."""
    with local_client(count) as client:
        warm_up(6 * count, folder, client)
        return timed(client)


def plainly(night: Night, shots: list[Path], folder: Path, start: Any, ended: Any) -> None:
    """Invert shots in this process, as a worker does but without dask and store."""
    folder.mkdir()
    warm_up(3, folder, "synchronous")
    start.wait()
    began = time.perf_counter()
    source, cache = read_shot(night.source, channel=night.channel).image, Cache()
    for path in shots:
        run(
            night.recipe,
            Shot(read_shot(path, channel=night.channel).image, source=source),
            cache=cache,
        )
    ended.put(time.perf_counter() - began)


def in_processes(count: int, night: Night, folder: Path) -> float:
    """Time the same shots in so many processes that know nothing of each other."""
    context = multiprocessing.get_context("spawn")
    start, ended = context.Barrier(count), context.SimpleQueue()
    processes = []
    for number in range(count):
        own = folder / f"plain_{count}_{number}"
        arguments = (night, night.shots[number::count], own, start, ended)
        processes.append(context.Process(target=plainly, args=arguments))
        processes[-1].start()
    for process in processes:
        process.join()
    return max(ended.get() for _ in processes)


def speedup(arguments: argparse.Namespace, folder: Path) -> None:
    shots = night(folder, arguments.shots, tuple(arguments.side), arguments.sites)
    height, width = shots.recipe.shape_after(read_shot(shots.source, channel=shots.channel).shape)
    sites = shots.recipe.options.n_sites or height * width
    size = f"{width} × {height} px, {sites:,} sites"
    print(f"\n{arguments.shots} shots ({shots.name}), {size}\n")

    def timed(client: Client) -> float:
        start = time.perf_counter()
        run_stack(
            Shot(shots.shots, source=shots.source),
            folder / "night.shadowinv.zarr",
            shots.recipe,
            reader=FileReader(channel=shots.channel),
            scheduler=client,
            on_progress=lambda told: told.outcome and ended.append(told.outcome),
            run=RunOptions(overwrite=True),
        )
        return time.perf_counter() - start

    times: dict[int, float] = {}
    for workers in (2, 1):
        ended: list[ShotOutcome] = []
        times[workers] = on_workers(workers, timed, folder)
        assert all(outcome.status == DONE for outcome in ended)
    plain = {count: in_processes(count, shots, folder) for count in (1, 2)}
    # Of the run on one worker.
    spent = [outcome.seconds for outcome in ended]
    reports = StackStore(folder / "night.shadowinv.zarr").reports()
    sites = sorted((report["stages"]["sites"] for report in reports), reverse=True)
    inverting = sum(sum(report["stages"].values()) for report in reports)
    mean, overhead = sum(spent) / len(spent), (times[1] - sum(spent)) / len(spent)
    gain, possible = times[1] / times[2], plain[1] / plain[2]
    rest = (sum(spent) - max(spent)) / max(1, len(spent) - 1)
    around = 1 - inverting / sum(spent)
    table(
        ("one worker", f"{times[1]:.1f} s, {mean:.2f} s a shot"),
        ("two workers", f"{times[2]:.1f} s"),
        ("speed-up with two workers", f"{gain:.2f} (wanted: 1.8)"),
        ("one plain process, two at once", f"{plain[1]:.1f} s, {plain[2]:.1f} s"),
        ("speed-up of the machine itself", f"{possible:.2f}"),
        ("share of it that dask reaches", f"{gain / possible:.1%}"),
        ("dask, per shot", f"{1e3 * overhead:.0f} ms, {overhead / mean:.1%} (wanted: 3 %)"),
        ("reading and writing, per shot", f"{1e3 * around * mean:.0f} ms, {around:.1%}"),
        ("a worker's first shot, later ones", f"{max(spent):.2f} s, {rest:.2f} s"),
        ("of it on sites", f"{sites[0]:.2f} s, {1e3 * max(sites[1:], default=0):.2f} ms at most"),
    )


def table(*rows: tuple[str, str]) -> None:
    print("| | |\n|---|---|")
    for row in rows:
        print("| {} | {} |".format(*row))


def stream(arguments: argparse.Namespace, folder: Path) -> None:
    count = arguments.stream
    inputs = folder / "stream"
    inputs.mkdir()
    paths = []
    for number in range(count):
        paths.append(inputs / f"shot_{number}.txt")
        paths[-1].write_text(str(number))
    out = folder / "stream.shadowinv.zarr"
    curve: list[tuple[int, float, float]] = []
    busy = [0.0]

    def timed(client: Client) -> float:
        def note(progress):
            if progress.outcome is not None:
                busy[0] += progress.outcome.seconds
            ended = progress.done + progress.failed
            if ended and (ended % max(1, count // 10) == 0 or ended == count):
                workers = max(client.run(worker_memory).values())
                curve.append((ended, workers / 1e6, worker_memory() / 1e6))

        start = time.perf_counter()
        run_stack(
            Shot(paths, source=np.full((100, 100), 1000.0)),
            out,
            Recipe(options=InversionOptions(threads=1)),
            reader=streamed,
            scheduler=client,
            on_progress=note,
        )
        return time.perf_counter() - start

    seconds = on_workers(2, timed, folder)
    statuses = StackStore(out).statuses()
    print(f"\n{count} shots of 100 × 100 px on two workers\n")
    print("| shots done | memory of the largest worker, MB | of the client, MB |\n|---|---|---|")
    for ended, worker, client_memory in curve:
        print(f"| {ended} | {worker:.0f} | {client_memory:.0f} |")
    half = [row[1] for row in curve[len(curve) // 2 :]]
    growth = (half[-1] - half[0]) / max(1, count // 2) * 1000
    print()
    table(
        ("done", f"{int((statuses == DONE).sum())} of {count}"),
        ("rate", f"{count / seconds:.1f} shots/s"),
        ("growth of a worker in the second half", f"{growth:+.1f} kB a shot"),
        ("workers computing", f"{busy[0] / (2 * seconds):.1%} of the time (wanted: 90 %)"),
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--shots", type=int, default=10, help="0 leaves the first tables out")
    parser.add_argument(
        "--side", type=int, nargs=2, default=(464, 576), help="simulated instead, so large"
    )
    parser.add_argument("--sites", type=int, default=None)
    parser.add_argument("--stream", type=int, default=1000)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if arguments.shots:
            speedup(arguments, Path(folder))
        stream(arguments, Path(folder))


if __name__ == "__main__":
    main()
