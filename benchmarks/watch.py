"""How well a watched folder keeps up with a camera.

    python benchmarks/watch.py [--frames 40] [--rates 1 2 3 5] [--binning 2] [--sites N]
        [--seconds 300] [--latest-rate 20] [--stack-frames 30] [--stack-sites 0 40000]

Burner frames, written as TIFF at a given rate into a folder that is watched with their reference
beam; each frame is summed over `--binning` pixels. For each rate: how many shots a second were
stored, the time from a file being closed to its shot being stored, and how many files waited at
most. Then late shots against early ones for many small frames.

Then a watch that inverts the newest of small simulated frames next, written by another process
faster than they can be inverted: the age of a result when it is stored, from the time stamp of its
file, in s and in the time of a shot. Last, a stack of
frames of 512 × 512 px from one HDF5 file on all cores: the rate, and that of six cores by the
processor time of a shot; 0 sites stand for as many as the accuracy needs.

Nothing else should run beside it. Where other programs do, processor times still hold.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import threading
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import psutil
import tifffile

from napari_shadowinv import InversionOptions, Recipe, Shot, run_stack
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.pipeline import RunOptions, WatchOptions
from napari_shadowinv.preprocessing import Bin
from napari_shadowinv.stack import RunStatus, watch_stack
from stack import local_client, plume, warm_up

BURNER = Path(__file__).resolve().parents[2] / "shared" / "data" / "burner" / "data"


def frames() -> list[np.ndarray]:
    """Return the frames, back and forth, so that neighbours are always alike."""
    files = sorted(BURNER.glob("Image_2*.bmp"))
    images = [iio.imread(file) for file in files]
    grey = [image if image.ndim == 2 else image.mean(axis=-1) for image in images]
    return [*grey, *grey[-2:0:-1]]


def write(folder: Path, images: list[np.ndarray], count: int, rate: float) -> dict[str, float]:
    """Write frames at a rate as a camera does; return when each was closed."""
    closed: dict[str, float] = {}
    began = time.perf_counter()
    for number in range(count):
        time.sleep(max(0.0, began + number / rate - time.perf_counter()))
        path = folder / f"shot_{number:05d}.tif"
        tifffile.imwrite(path, images[number % len(images)].astype(np.uint8))
        closed[path.name] = time.perf_counter()
    return closed


def kept_up(folder: Path, recipe: Recipe, count: int, rate: float) -> str:
    """Watch while a camera writes; one row of the table."""
    live = folder / f"live_{rate:g}"
    live.mkdir()
    images = frames()
    closed: dict[str, float] = {}
    stored: dict[str, float] = {}
    most = 0
    started = threading.Event()

    def note(news: RunStatus) -> None:
        nonlocal most
        if not news.stage:
            started.set()
        if news.outcome is not None:
            stored[news.name] = time.perf_counter()
            most = max(most, news.waiting)

    def camera() -> None:
        started.wait()
        closed.update(write(live, images, count, rate))

    thread = threading.Thread(target=camera)
    thread.start()
    watch_stack(
        Shot(live, source=iio.imread(BURNER / "Image_00000.bmp").astype(float)),
        folder / f"live_{rate:g}.shadowinv.zarr",
        recipe,
        on_progress=note,
        should_stop=lambda: len(stored) == count,
    )
    thread.join()
    names = sorted(stored)[3:]  # the first decide on sites
    late = np.array([stored[name] - closed[name] for name in names])
    done = (len(names) - 1) / (stored[names[-1]] - stored[names[0]])
    return (
        f"| {rate:g} | {done:.2f} | {np.median(late):.2f} | {late.max():.2f} | {most} | "
        f"{late[-1]:.2f} |"
    )


def many(folder: Path, count: int) -> None:
    """Watch many small frames: what a shot costs must not grow with their number."""
    live = folder / "many"
    live.mkdir()
    rng = np.random.default_rng(0)
    for number in range(count):
        np.save(live / f"shot_{number:05d}.npy", rng.poisson(1000, (48, 48)).astype(float))
    ends: list[float] = []
    watch_stack(
        live,
        folder / "many.shadowinv.zarr",
        Recipe(options=InversionOptions(n_sites=200)),
        on_progress=lambda news: ends.append(time.perf_counter()) if news.outcome else None,
        should_stop=lambda: len(ends) == count,
        watch=WatchOptions(pattern="*.npy"),
    )
    part = max(1, count // 10)
    early, late = (
        1e3 * (last - first) / part
        for first, last in ((ends[0], ends[part]), (ends[-part - 1], ends[-1]))
    )
    print(f"\n{count} frames of 48 × 48 px: {early:.0f} ms a shot at first, {late:.0f} ms at last")


def camera(folder: Path, images: np.ndarray, count: int, rate: float, start: Any) -> None:
    """Write frames at a rate in a process of its own."""
    start.wait()
    write(folder, list(images), count, rate)


def latest(folder: Path, seconds: float, rate: float, side: int, sites: int) -> None:
    """Watch the latest of frames that come faster than they can be inverted."""
    live = folder / "latest"
    live.mkdir()
    images = np.stack([plume((side, side), number) for number in range(20)]) / 8
    count = round(seconds * rate)
    context = multiprocessing.get_context("spawn")
    start = context.Event()
    writer = context.Process(target=camera, args=(live, images, count, rate, start))
    writer.start()
    stored: list[tuple[str, float]] = []

    def note(news: RunStatus) -> None:
        if not news.stage:
            start.set()
        if news.outcome is not None:
            stored.append((news.name, time.time()))

    def is_over() -> bool:
        return not writer.is_alive()

    out = folder / "latest.shadowinv.zarr"
    cpu = time.process_time()
    watch_stack(
        Shot(live, source=np.full((side, side), 1000.0 / 8)),
        out,
        Recipe(options=InversionOptions(n_sites=sites or None)),
        on_progress=note,
        should_stop=is_over,
        watch=WatchOptions(latest=True),
    )
    cpu = time.process_time() - cpu
    writer.join()
    store = StackStore(out)
    names = {name for name, _ in stored}
    written = {name: (live / name).stat().st_mtime for name, _ in stored}
    late = stored[5:]  # the first ones read the kernels
    ages = np.array([end - written[name] for name, end in late])
    replaced = np.array([following - written[name] for (name, _), (_, following) in pairwise(late)])
    seconds_of = dict(zip(store.names, (r.get("seconds") for r in store.reports()), strict=True))
    shot = float(np.median([seconds_of[name] for name, _ in late]))
    n_sites = next(report["n_sites"] for report in store.reports() if "n_sites" in report)
    size = f"{side} × {side} px, {n_sites} sites"
    print(f"\n{count} frames of {size}, {rate:g} a second, the newest next\n")
    print("| | |\n|---|---|")
    print(
        f"| inverted | {len(names)}, {(len(late) - 1) / (late[-1][1] - late[0][1]):.1f} a second |"
    )
    print(f"| time of a shot until it is written, median | {1e3 * shot:.0f} ms |")
    print(f"| its processor time, all of the watch included | {1e3 * cpu / len(names):.0f} ms |")
    for label, values in (("when stored", ages), ("when replaced", replaced)):
        for name, value in (("median", np.median(values)), ("95 %", np.quantile(values, 0.95))):
            print(
                f"| age of the newest result {label}, {name} | {1e3 * value:.0f} ms, "
                f"{value / shot:.2f} shots' time |"
            )
    load = os.getloadavg()[0]
    print(f"| load of the machine at the end | {load:.1f} on {os.cpu_count()} cores |")


def cpu_time() -> float:
    """Processor time of this process in s."""
    times = psutil.Process().cpu_times()
    return float(times.user + times.system)


def stack_rate(folder: Path, count: int, sites: int | None, side: int = 512) -> None:
    """Invert frames of one file on all cores; one row of the table."""
    path = folder / "run.h5"
    if not path.exists():
        rng = np.random.default_rng(0)
        plumes = [plume((side, side), number) for number in range(5)]
        images = np.stack([rng.poisson(plumes[k % 5]) for k in range(count)]).astype(np.uint16)
        with h5py.File(path, "w") as file:
            file.create_dataset("data", data=images, chunks=(1, side, side))
    options = InversionOptions(n_sites=sites, threads=1)
    cores = os.cpu_count() or 1
    ends: list[float] = []
    spent: list[float] = []

    def note(news: RunStatus) -> None:
        if news.outcome is not None:
            ends.append(time.perf_counter())
            spent.append(sum(client.run(cpu_time).values()))

    out = folder / "rate.shadowinv.zarr"
    with local_client(cores) as client:
        warm_up(6 * cores, folder, client)
        run_stack(
            Shot(f"{path}::data", source=np.full((side, side), 1000.0)),
            out,
            Recipe(options=options),
            scheduler=client,
            on_progress=note,
            run=RunOptions(overwrite=True),
        )
    store = StackStore(out)
    assert (store.statuses() == DONE).all()
    first = 2 * cores  # they make the sites
    rate = (count - first) / (ends[-1] - ends[first - 1])
    processor = (spent[-1] - spent[first - 1]) / (count - first)
    n_sites = store.report(0)["n_sites"]
    error = np.median([report["total_error"] for report in store.reports()])
    print(
        f"| {n_sites:,} | {rate:.2f} | {processor:.2f} | {cores / processor:.2f} | "
        f"{6 / processor:.2f} | {error:.1%} |",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40, help="of the burner, at each rate")
    parser.add_argument("--rates", type=float, nargs="+", default=(1.0, 2.0, 3.0, 5.0))
    parser.add_argument("--binning", type=int, default=2)
    parser.add_argument("--sites", type=int, default=None)
    parser.add_argument("--many", type=int, default=1000, help="small frames; 0 leaves them out")
    parser.add_argument(
        "--seconds", type=float, default=300, help="of the latest shots; 0 leaves them out"
    )
    parser.add_argument("--latest-rate", type=float, default=20, help="frames written a second")
    parser.add_argument("--latest-side", type=int, default=128, help="of a frame in px")
    parser.add_argument("--latest-sites", type=int, default=0, help="0 for the accuracy's number")
    parser.add_argument("--stack-frames", type=int, default=30, help="0 leaves them out")
    parser.add_argument("--stack-sites", type=int, nargs="+", default=(0, 40_000, 10_000))
    arguments = parser.parse_args()
    recipe = Recipe(
        steps=(Bin(factor=arguments.binning),), options=InversionOptions(n_sites=arguments.sites)
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if BURNER.is_dir() and arguments.frames:
            print(
                "| written, 1/s | stored, 1/s | s until stored, median | longest | files waiting, "
                "most | s until stored, last |"
            )
            print("|---|---|---|---|---|---|")
            for rate in arguments.rates:
                print(kept_up(folder, recipe, arguments.frames, rate), flush=True)
        if arguments.many:
            many(folder, arguments.many)
        if arguments.seconds:
            latest(
                folder,
                arguments.seconds,
                arguments.latest_rate,
                arguments.latest_side,
                arguments.latest_sites,
            )
        if arguments.stack_frames:
            print(f"\n{arguments.stack_frames} frames of 512 × 512 px from one HDF5 file\n")
            print(
                "| sites | shots/s here | processor time of a shot, s | shots/s of these cores by "
                "it | of six cores | total error |"
            )
            print("|---|---|---|---|---|---|")
            for sites in arguments.stack_sites:
                stack_rate(folder, arguments.stack_frames, sites or None)


if __name__ == "__main__":
    main()
