"""How well a watched folder keeps up with a camera.

    python benchmarks/watch.py [--frames 40] [--rates 1 2 3 5] [--binning 2] [--sites N]

Burner frames, written as TIFF at a given rate into a folder that is watched with their reference
beam; each frame is summed over `--binning` pixels. For each rate: how many shots a second were
stored, the time from a file being closed to its shot being stored, and how many files waited at
most. Then the mean time of a shot where all files are there, against a run over them in one group
of warm starts, and late shots against early ones for many small frames. Nothing else should run
beside it.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from functools import partial
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import tifffile

from napari_shadowinv import (
    InversionOptions,
    Recipe,
    RunOptions,
    WatchOptions,
    run_stack,
    watch_stack,
)
from napari_shadowinv.preprocessing import Bin
from napari_shadowinv.stack import RunStatus, read_shot

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
        live,
        folder / f"live_{rate:g}.shadowinv.zarr",
        recipe,
        source=iio.imread(BURNER / "Image_00000.bmp").astype(float),
        reader=partial(read_shot, channel=None),
        on_progress=note,
        watch=WatchOptions(max_shots=count),
    )
    thread.join()
    names = sorted(stored)[3:]  # the first decide on sites
    late = np.array([stored[name] - closed[name] for name in names])
    done = (len(names) - 1) / (stored[names[-1]] - stored[names[0]])
    return (
        f"| {rate:g} | {done:.2f} | {np.median(late):.2f} | {late.max():.2f} | {most} | "
        f"{late[-1]:.2f} |"
    )


def against_a_run(folder: Path, recipe: Recipe, count: int) -> None:
    """Compare with a run over files that are all there."""
    live = folder / "there"
    live.mkdir()
    write(live, frames(), count, 1e6)
    source = iio.imread(BURNER / "Image_00000.bmp").astype(float)
    ends: list[float] = []

    def note(news: RunStatus) -> None:
        if news.result is not None:
            ends.append(time.perf_counter())

    out = folder / "there.shadowinv.zarr"
    watch_stack(
        live, out, recipe, source=source, on_progress=note, watch=WatchOptions(max_shots=count)
    )
    watched = (ends[-1] - ends[2]) / (count - 3)  # the first decide on sites
    times: list[float] = []
    files = sorted(live.glob("*.tif"))
    # All threads for the one worker.
    with_all = recipe.model_copy(
        update={"options": recipe.options.model_copy(update={"threads": 2})}
    )
    for some in (files[:1], files):
        began = time.perf_counter()
        run_stack(
            some,
            folder / "run.shadowinv.zarr",
            with_all,
            source=source,
            scheduler="synchronous",
            run=RunOptions(warm_start=count, overwrite=True),
        )
        times.append(time.perf_counter() - began)
    run = (times[1] - times[0]) / (count - 1)
    print("\n| a shot, warm-started | s |\n|---|---|")
    print(f"| watched | {watched:.3f} |")
    print(f"| in a run over all files, one worker | {run:.3f} |")


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
        watch=WatchOptions(pattern="*.npy", max_shots=count),
    )
    part = max(1, count // 10)
    early, late = (
        1e3 * (last - first) / part
        for first, last in ((ends[0], ends[part]), (ends[-part - 1], ends[-1]))
    )
    print(f"\n{count} frames of 48 × 48 px: {early:.0f} ms a shot at first, {late:.0f} ms at last")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=40, help="of the burner, at each rate")
    parser.add_argument("--rates", type=float, nargs="+", default=(1.0, 2.0, 3.0, 5.0))
    parser.add_argument("--binning", type=int, default=2)
    parser.add_argument("--sites", type=int, default=None)
    parser.add_argument("--many", type=int, default=1000, help="small frames; 0 leaves them out")
    arguments = parser.parse_args()
    recipe = Recipe(
        steps=(Bin(factor=arguments.binning),), options=InversionOptions(n_sites=arguments.sites)
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if BURNER.is_dir():
            print(
                "| written, 1/s | stored, 1/s | s until stored, median | longest | files waiting, "
                "most | s until stored, last |"
            )
            print("|---|---|---|---|---|---|")
            for rate in arguments.rates:
                print(kept_up(folder, recipe, arguments.frames, rate), flush=True)
            against_a_run(folder, recipe, arguments.frames)
        if arguments.many:
            many(folder, arguments.many)


if __name__ == "__main__":
    main()
