"""Memory of a worker that inverts thousands of frames, read lazily.

    python benchmarks/lazy_memory.py [--frames 2000] [--side 128] [--sites 200] [--kinds hdf5 ...]

Frames of a plume in one HDF5 file, one multi-page TIFF, a folder, and an xarray dataset of the
HDF5 file are inverted by one worker process. For each: resident memory of the worker around the
first hundreds and at the end, the growth between the two (wanted: less than 5 %), the size of all
frames as the solver would hold them, the rate and the processor time of the worker. Memory does
not depend on what else the machine does; times do.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
import tifffile

from napari_shadowinv import InversionOptions, Recipe, Shot, read, run_stack
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.pipeline import RunOptions
from napari_shadowinv.stack import RunStatus
from stack import local_client, plume, warm_up

_SAMPLES = 40  # of the memory, over all frames


def frames(count: int, side: int) -> np.ndarray:
    """Return frames with noise of their own, as a camera stores them."""
    rng = np.random.default_rng(0)
    plumes = [plume((side, side), number) for number in range(10)]
    return np.stack([rng.poisson(plumes[k % 10]) for k in range(count)]).astype(np.uint16)


def write_hdf5(images: np.ndarray, folder: Path) -> str:
    path = folder / "run.h5"
    with h5py.File(path, "w") as file:
        chunks = (1, *images.shape[1:])
        file.create_dataset("entry/data/data", data=images, chunks=chunks, compression="gzip")
    return f"{path}::/entry/data/data"


def write_tiff(images: np.ndarray, folder: Path) -> Path:
    path = folder / "run.tif"
    with tifffile.TiffWriter(path) as tiff:
        for image in images:
            tiff.write(image, photometric="minisblack", contiguous=False)
    return path


def write_folder(images: np.ndarray, folder: Path) -> Path:
    place = folder / "shots"
    place.mkdir()
    for number, image in enumerate(images):
        tifffile.imwrite(place / f"shot_{number:05d}.tif", image)
    return place


KINDS: dict[str, Callable[[np.ndarray, Path], Any]] = {
    "hdf5": write_hdf5,
    "tiff": write_tiff,
    "folder": write_folder,
    "xarray": lambda images, folder: read(write_hdf5(images, folder)),
}


def usage() -> tuple[int, float]:
    """Resident memory of this process in bytes, and its processor time in s."""
    process = psutil.Process()
    times = process.cpu_times()
    return process.memory_info().rss, times.user + times.system


def measure(shots: Any, folder: Path, arguments: argparse.Namespace) -> dict[str, float]:
    """Invert all frames on one worker; return its memory, times and the number of failed shots."""
    out = folder / "run.shadowinv.zarr"
    options = InversionOptions(n_sites=arguments.sites, threads=1)
    source = np.full((arguments.side, arguments.side), 1000.0)
    curve: list[tuple[int, int]] = []
    step = max(1, arguments.frames // _SAMPLES)
    with local_client(1) as client:
        warm_up(6, folder, client)

        def note(news: RunStatus) -> None:
            if news.outcome is not None and news.ended % step == 0:
                (memory, _), *_ = client.run(usage).values()
                curve.append((news.ended, memory))

        _, cpu_before = next(iter(client.run(usage).values()))
        began = time.perf_counter()
        run_stack(
            Shot(shots, source=source),
            out,
            Recipe(options=options),
            scheduler=client,
            on_progress=note,
            run=RunOptions(variables=["potential"]),
        )
        seconds = time.perf_counter() - began
        _, cpu_after = next(iter(client.run(usage).values()))
    ended, memory = np.array(curve).T
    early = memory[(ended >= 0.1 * arguments.frames) & (ended <= 0.25 * arguments.frames)].mean()
    late = memory[ended > 0.9 * arguments.frames].mean()
    return {
        "failed": float((StackStore(out).statuses() != DONE).sum()),
        "early": early / 1e6,
        "late": late / 1e6,
        "most": memory.max() / 1e6,
        "growth": late / early - 1,
        "rate": arguments.frames / seconds,
        "cpu": (cpu_after - cpu_before) / arguments.frames,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--side", type=int, default=128, help="of a frame in px")
    parser.add_argument("--sites", type=int, default=200)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    arguments = parser.parse_args()
    images = frames(arguments.frames, arguments.side)
    size = 8 * images.size / 1e6
    print(f"{arguments.frames} frames of {arguments.side} × {arguments.side} px: {size:.0f} MB\n")
    print(
        "| frames in | worker after a tenth to a quarter, MB | at the end, MB | most, MB | growth "
        "| shots/s | processor, ms a shot | failed |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for kind in arguments.kinds:
        with tempfile.TemporaryDirectory() as name:
            row = measure(KINDS[kind](images, Path(name)), Path(name), arguments)
        print(
            f"| {kind} | {row['early']:.1f} | {row['late']:.1f} | {row['most']:.1f} | "
            f"{row['growth']:+.1%} | {row['rate']:.1f} | {1e3 * row['cpu']:.0f} | "
            f"{row['failed']:.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
