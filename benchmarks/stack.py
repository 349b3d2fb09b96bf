"""How well stacks of shots use more workers, and what dask costs.

    python benchmarks/stack.py [--shots 10] [--side 100 120] [--stream 1000] [--sites N]

Three tables. First burner frames, summed over 2 × 2 pixels, with their reference beam (or
simulated plumes of the same size where the data are not there): the same run on one and on two
workers with one thread each; what dask adds to a shot's time; and what sites cost the first and
the later shots of a worker. Then a stream of small shots that exist only while they are needed:
memory of a worker against the number of shots, and the share of the time that workers compute.
Ratios do not depend on the machine as seconds do; nothing else should run beside it.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import dask
import numpy as np
import tifffile
from distributed import Client, LocalCluster

from napari_shadowinv import InversionOptions, plan_sites, run_stack, synthetic_image
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.stack import ShotOutcome, read_shot

BURNER = Path(__file__).resolve().parents[2] / "shared" / "data" / "burner" / "data"


def worker_memory() -> int:
    """Resident memory of this process in bytes now, or its peak where that is not told."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize()
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else 1024 * peak


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


def frames(
    folder: Path, count: int, shape: tuple[int, int], small: bool
) -> tuple[list[Path], Path, int, str]:
    """Return paths of shots and reference, how to bin them, and what they are."""
    reference, shots = BURNER / "Image_00000.bmp", sorted(BURNER.glob("Image_2*.bmp"))[:count]
    if len(shots) == count and not small:
        return shots, reference, 2, "burner, binned by 2"
    paths = []
    for number in range(count):
        paths.append(folder / f"shot_{number}.tif")
        tifffile.imwrite(paths[-1], plume(shape, number).astype(np.float32))
    reference_path = folder / "reference.tif"
    tifffile.imwrite(reference_path, np.full(shape, 1000, np.float32))
    return paths, reference_path, 1, "simulated plumes"


def on_workers(count: int, run: Callable[[Client], float], folder: Path) -> float:
    """Time a run on workers with one thread each that have done a few shots before."""
    with (
        # As `run_stack` has it: the profiler's records grow with time.
        dask.config.set({"distributed.worker.profile.enabled": False}),
        LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        few = np.ones((6 * count, 24, 24)) + np.eye(24)
        options = InversionOptions(n_sites=100, threads=1)
        warm = folder / "warm.shadowinv.zarr"
        run_stack(few, warm, options=options, scheduler=client, overwrite=True)
        return run(client)


def speedup(arguments: argparse.Namespace, folder: Path) -> None:
    shape = (arguments.side[0], arguments.side[1])
    small = shape != (464, 576)
    shots, source, factor, name = frames(folder, arguments.shots, shape, small)
    reader = partial(read_shot, channel="mean", factor=factor)
    beam = reader(source)
    options = InversionOptions(n_sites=arguments.sites, threads=1)
    n_sites = arguments.sites or beam.size
    size = f"{beam.shape[1]} × {beam.shape[0]} px, {n_sites:,} sites"
    print(f"\n{len(shots)} shots ({name}), {size}\n")

    times: dict[int, float] = {}
    for workers in (1, 2):
        out = folder / f"{workers}.shadowinv.zarr"
        outcomes: list[ShotOutcome] = []

        def run(client: Client, out: Path = out, ended: list[ShotOutcome] = outcomes) -> float:
            start = time.perf_counter()
            run_stack(
                shots,
                out,
                source=source,
                reader=reader,
                options=options,
                scheduler=client,
                on_progress=lambda told: told.outcome and ended.append(told.outcome),
            )
            return time.perf_counter() - start

        times[workers] = on_workers(workers, run, folder)
        assert (StackStore(out).statuses() == DONE).all()
        if workers == 1:
            spent = sum(outcome.seconds for outcome in outcomes)
            first = max(outcome.seconds for outcome in outcomes)
    reports = StackStore(folder / "1.shadowinv.zarr").reports()
    overhead = (times[1] - spent) / len(shots)
    per_shot = spent / len(shots)
    sites = sorted((report["stages"]["sites"] for report in reports), reverse=True)
    started = time.perf_counter()
    plan_sites(beam, options)
    alone = time.perf_counter() - started
    rest = (spent - first) / max(1, len(shots) - 1)
    print("| | |\n|---|---|")
    print(f"| one worker | {times[1]:.1f} s, {per_shot:.2f} s a shot |")
    print(f"| two workers | {times[2]:.1f} s |")
    print(f"| speed-up with two workers | {times[1] / times[2]:.2f} (wanted: 1.8) |")
    print(f"| dask, per shot | {1e3 * overhead:.0f} ms, {overhead / per_shot:.1%} (wanted: 3 %) |")
    print(f"| sites alone | {alone:.2f} s |")
    print(f"| a worker's first shot, later ones | {first:.2f} s, {rest:.2f} s |")
    print(
        f"| of it on sites | {sites[0]:.2f} s, {1e3 * max(sites[1:], default=0):.2f} ms at most |"
    )


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

    def run(client: Client) -> float:
        def note(progress):
            if progress.outcome is not None:
                busy[0] += progress.outcome.seconds
            ended = progress.done + progress.failed
            if ended and (ended % max(1, count // 10) == 0 or ended == count):
                workers = max(client.run(worker_memory).values())
                curve.append((ended, workers / 1e6, worker_memory() / 1e6))

        start = time.perf_counter()
        run_stack(
            paths,
            out,
            source=np.full((100, 100), 1000.0),
            options=InversionOptions(threads=1),
            reader=streamed,
            scheduler=client,
            on_progress=note,
        )
        return time.perf_counter() - start

    seconds = on_workers(2, run, folder)
    statuses = StackStore(out).statuses()
    print(f"\n{count} shots of 100 × 100 px on two workers\n")
    print("| shots done | memory of the largest worker, MB | of the client, MB |\n|---|---|---|")
    for ended, worker, client_memory in curve:
        print(f"| {ended} | {worker:.0f} | {client_memory:.0f} |")
    half = [row[1] for row in curve[len(curve) // 2 :]]
    growth = (half[-1] - half[0]) / max(1, count // 2) * 1000
    print("\n| | |\n|---|---|")
    print(f"| done | {int((statuses == DONE).sum())} of {count} |")
    print(f"| rate | {count / seconds:.1f} shots/s |")
    print(f"| growth of a worker in the second half | {growth:+.1f} kB a shot |")
    print(f"| workers computing | {busy[0] / (2 * seconds):.1%} of the time (wanted: 90 %) |")


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
