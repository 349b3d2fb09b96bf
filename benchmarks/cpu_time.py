"""CPU time of fits and inversions by two versions of the package, in alternating pairs.

    git worktree add ../before COMMIT
    python benchmarks/cpu_time.py ../before/src [--pairs 4] [--only fit …]

Each measurement is the second call in a process on one thread, with kernels compiled. The versions
take turns, and the order is reversed in every second pair. A row for each work: user CPU seconds of
the call in both versions (least), the ratios of the least and the median ratio of the pairs, the
ratio of the least for whole processes of both calls, and the largest change of the displacement
relative to its peak. Other work on the machine moves single figures by some 10 %.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Callable
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

THIS = Path(__file__).resolve().parents[1] / "src"
FloatArray = NDArray[np.float64]
Work = dict[str, Any]


def fit_works(folder: Path) -> dict[str, Work]:
    """One to three energies of a plain and of a folded object, in an even beam, recorded or not."""
    from fit import blobs, counted

    works: dict[str, Work] = {}
    energies = {1: [1.0], 2: [1.0, 0.6], 3: [1.0, 0.7, 0.5]}
    cases = [(96, count) for count in energies] + [(64, 2), (128, 2)]
    for side, count in cases:
        unit, strengths = side / 100, energies[count]
        for kind, amplitude in (("unfolded", 60.0), ("folded", 260.0)):
            lumps = [
                (amplitude * unit**2, 12 * unit, 15 * unit, 0.3, 44 * unit, 45 * unit),
                (-amplitude / 2 * unit**2, 10 * unit, 10 * unit, 0.0, 65 * unit, 62 * unit),
            ]
            lit = [
                counted([blobs(lumps)], np.array([s]), None, (side, side), 20) for s in strengths
            ]
            noise = 0.05 * np.random.default_rng(side).normal(size=(count, side, side))
            name = f"fit, {kind}, {side} px, {count}"
            np.save(folder / f"{name}.npy", np.stack(lit) + noise)
            work: Work = {"fit": name, "strengths": strengths}
            if count > 1:
                works[f"{name}, beam assumed"] = work
            if side == 96:
                works[f"{name}, beam recorded"] = {**work, "flat": 1.0}
    return works


def invert_works(folder: Path) -> dict[str, Work]:
    """The paper's toroid, the same with a recorded source, and a burner's frame if there is one."""
    from reference import DATA, toroid_case

    image = np.maximum(toroid_case(97, noise=True).image, 0.0)
    source = 1 + 0.02 * np.random.default_rng(1).normal(size=image.shape)
    np.save(folder / "toroid.npy", image)
    np.save(folder / "beam.npy", source * image.mean())
    works: dict[str, Work] = {
        "invert, toroid": {"invert": "toroid"},
        "invert, toroid, recorded source": {"invert": "toroid", "source": "beam"},
    }
    files = sorted((DATA / "burner").rglob("*.bmp"))
    if files:
        from PIL import Image

        for name, number in (("burner beam", 0), ("burner", 3)):
            frame = np.asarray(Image.open(files[number]).convert("F"), np.float64)
            binned = frame.reshape(464, 2, 576, 2).sum(axis=(1, 3))
            np.save(folder / f"{name}.npy", binned)
        works["invert, burner"] = {"invert": "burner", "source": "burner beam"}
    return works


def user_seconds(who: int = resource.RUSAGE_SELF) -> float:
    return resource.getrusage(who).ru_utime


def call(work: Work) -> Callable[[], FloatArray]:
    """Return a function that does the work and returns the displacement."""
    from napari_shadowinv import fit, invert

    fit_images: Callable[..., Any] = fit  # its parameters differ between versions
    folder = Path(work["folder"])
    if "invert" in work:
        names = {"image": work["invert"]}
        if "source" in work:
            names["source"] = work["source"]
        arrays = {key: np.load(folder / f"{name}.npy") for key, name in names.items()}
        return lambda: invert(**arrays).displacement
    images = np.load(folder / f"{work['fit']}.npy")
    source = np.full(images.shape[1:], work["flat"]) if "flat" in work else None
    stated: Work = {"source": source, "noise": 0.05}
    strengths = work["strengths"] if len(images) > 1 else None
    if "strengths" in signature(fit).parameters:  # of versions without shots
        return lambda: fit_images(images, strengths=strengths, **stated).fields[0].displacement
    from napari_shadowinv.shot import shots_of

    shots = shots_of(images, strength=strengths, **stated)
    return lambda: fit_images(shots).fields[0].displacement


def worker(work: Work) -> None:
    """Do the work twice; print the seconds of the second time, when all is imported."""
    do = call(work)
    do()
    begun = user_seconds()
    displacement = do()
    seconds = user_seconds() - begun
    np.save(Path(work["folder"]) / f"{work['result']}.npy", displacement)
    print(json.dumps(seconds))


def measure(source: Path, work: Work) -> tuple[float, float]:
    """User CPU seconds of the call and of its process."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(source),
        "NUMBA_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    command = [sys.executable, __file__, "--worker", json.dumps(work)]
    begun = user_seconds(resource.RUSAGE_CHILDREN)
    ended = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    total = user_seconds(resource.RUSAGE_CHILDREN) - begun
    return float(json.loads(ended.stdout.splitlines()[-1])), total


def row(name: str, work: Work, old: Path, pairs: int) -> str:
    versions = {"old": old, "new": THIS}
    for version, source in versions.items():  # compile
        measure(source, {**work, "result": version})
    seconds: dict[str, list[tuple[float, float]]] = {"old": [], "new": []}
    for k in range(pairs):
        for version in ("old", "new")[:: -1 if k % 2 else 1]:
            seconds[version].append(measure(versions[version], {**work, "result": version}))
    before, now = np.array(seconds["old"]), np.array(seconds["new"])
    least, median = now.min(axis=0) / before.min(axis=0), np.median(now / before, axis=0)
    one, two = (np.load(Path(work["folder"]) / f"{version}.npy") for version in versions)
    change = np.abs(one - two).max() / np.abs(one).max()
    return (
        f"| {name} | {before[:, 0].min():.2f} | {now[:, 0].min():.2f} | {least[0]:.3f} "
        f"| {median[0]:.3f} | {least[1]:.3f} | {change:.1e} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", nargs="?", type=Path, help="the other version's folder src")
    parser.add_argument("--pairs", type=int, default=4)
    parser.add_argument("--only", nargs="*", default=[], help="all of these parts of rows' names")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        worker(json.loads(arguments.worker))
        return
    if arguments.old is None or not (arguments.old / "napari_shadowinv").is_dir():
        parser.error("give the folder src of the other version")
    print("| work | s before | s now | least, ratio | median, ratio | whole process | change |")
    print(f"|{'---|' * 7}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        works = {**fit_works(folder), **invert_works(folder)}
        for title, work in works.items():
            if all(part in title for part in arguments.only):
                work = {**work, "folder": name}
                print(row(title, work, arguments.old.resolve(), arguments.pairs), flush=True)


if __name__ == "__main__":
    main()
