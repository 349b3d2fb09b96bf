"""Speed of two versions, and their errors.

    python benchmarks/against.py OLD_PYTHON [--repeat 5] [--only burner] [--threads 2]

OLD_PYTHON is the interpreter of an environment with the other version. Both run the same work, one
after the other in turn, each in one process that has done it once before. A row for each work: the
median seconds of both, how many times as fast this version is (median of the ratios of
neighbouring runs, and their range), and the displacement's L2 error in both, in per cent: against
the truth, or for real frames against this version's with one site a pixel; and the most memory of
each process so far.

Images are those of the reference toroid, and of the burner's frames where they are present. Those
of fits are rays counted as in fit.py, for minutes; `--only "fit, three"` counts those of one fit,
`--only 4096` enlarges a burner's frame.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fit import SIDE, Case, FloatArray, blobs, cases, counted
from fit_large import BLOBS, RAYS

FRAMES = 6  # of the stream
Work = dict[str, Any]


def works(folder: Path, only: str) -> dict[str, Work]:
    """What is to be done, by name; images are written into a folder.

    Those of fits are made for names that contain `only`.
    """
    from PIL import Image

    from reference import DATA, toroid_case

    found: dict[str, Work] = {}
    for peak, noise in ((97, False), (97, True), (194, True)):
        case = toroid_case(peak, noise)
        name = f"{peak}{' noise' if noise else ''}"
        np.save(folder / f"{name}.npy", np.maximum(case.image, 0.0))
        np.save(folder / f"{name} truth.npy", case.displacement)
        found[name] = {"image": name, "truth": f"{name} truth"}
        if noise:
            found[f"{name}, 40,000 sites"] = {**found[name], "n_sites": 40_000}
    for title, case, noise, size in fits():
        name = f"fit, {title}"
        if only not in name:
            continue
        images = case.images() if size == (SIDE, SIDE) else large_images(case, size)
        images += noise * np.random.default_rng(0).normal(size=images.shape)
        np.savez(folder / name, images=images, strengths=case.strengths())
        places = np.indices(size, dtype=np.float64)
        np.save(folder / f"{name} truth.npy", [field(*places) for field in case.fields])
        found[name] = {"fit": name, "noise": noise, "keywords": case.keywords}
    files = sorted((DATA / "burner").rglob("*.bmp"))
    if not files:
        return found
    frames = [np.asarray(Image.open(file).convert("F"), np.float64) for file in files]
    frames = frames[: FRAMES + 1]
    np.save(folder / "beam.npy", frames[0])
    np.save(folder / "frame.npy", frames[3])
    binned = [frame.reshape(464, 2, 576, 2).sum(axis=(1, 3)) for frame in frames]
    np.save(folder / "binned.npy", np.stack(binned))
    burner = {"image": "frame", "source": "beam", "truth": "finest"}
    found["burner"] = burner
    for n_sites in (66_816, 1_069_056):
        one = {**burner, "n_sites": n_sites}
        found[f"burner, {n_sites:,} sites"] = one
        found[f"burner, {n_sites:,} sites, read-out"] = {**one, "stage": "read-out"}
    found["burner, a frame of a stream"] = {"stream": "binned"}
    if "4096" in only:
        for file, plane in (("large beam", files[0]), ("large frame", files[3])):
            large = Image.open(plane).convert("F").resize((4096, 4096), Image.Resampling.BICUBIC)
            np.save(folder / f"{file}.npy", np.maximum(np.asarray(large, np.float64), 1.0))
        sources = {"source": "large beam", "truth": "large"}
        found["burner, 4096²"] = {"image": "large frame", **sources}
    return found


def fits() -> Iterator[tuple[str, Case, float, tuple[int, int]]]:
    """Images of fits, with their noise and shape."""
    folded = [(700, 14, 24, 0.35, 80, 70), (650, 22, 13, 0.2, 125, 130)]
    small, three = (SIDE, SIDE), (14.7, 30.0, 60.0)
    yield "three energies", Case("", [blobs(folded)], three), 0.1, small
    # The first object reaches the edge of the image, the second does not.
    inside = [(500, 14, 20, 0.35, 85, 85), (450, 20, 13, 0.2, 115, 115)]
    yield "three energies, object inside", Case("", [blobs(inside)], three), 0.1, small
    by_name = {case.name: case for case in cases()}
    yield "unknown beam", by_name["toroid 97, beam unknown, 2 energies"], 0.03, small
    yield "B and E", by_name["B and E × 1, four energies"], 0.03, small
    yield "576×464, two energies", Case("", [blobs(BLOBS)], (14.7, 30.0)), 0.05, (464, 576)
    for count in (5, 17):
        energies = tuple(np.linspace(14.7, 60, count))
        centred = [(60, 7, 7, 0, 27.5, 27.5)]
        yield f"{count} layers", Case("", [blobs(centred)], energies), 0.05, (56, 56)
    mild = [(1500, 90, 90, 0, 450, 500), (-1200, 70, 80, 0, 600, 620)]
    yield "1024², two energies", Case("", [blobs(mild)], (14.7, 30.0)), 0.05, (1024, 1024)


def worker() -> None:
    """Do what is asked for line by line, and tell the seconds, and the error where there is one."""
    from napari_shadowinv import FitOptions, InversionOptions, fit, invert
    from napari_shadowinv.inversion import plan_sites
    from napari_shadowinv.shot import shots_of

    def inverted(work: Work, folder: Path) -> tuple[float, float]:
        known = {
            key: np.load(folder / f"{work[key]}.npy") for key in ("image", "source") if key in work
        }
        chosen = {key: work[key] for key in ("n_sites", "threads") if work.get(key)}
        options = InversionOptions(**chosen)
        begun = time.perf_counter()
        found = invert(**known, options=options)
        seconds = time.perf_counter() - begun
        if "stage" in work:
            seconds = found.report.seconds[work["stage"]]
        truth = folder / f"{work['truth']}.npy"
        if not truth.exists():
            np.save(truth, found.displacement)
        true = np.load(truth)
        return seconds, length(found.displacement - true) / length(true)

    def streamed(work: Work, folder: Path) -> tuple[float, float]:
        beam, *frames = np.load(folder / f"{work['stream']}.npy")
        options = InversionOptions(threads=work.get("threads"))
        plan = plan_sites(beam, options)
        last = invert(frames[0], plan=plan, options=options)
        begun = time.perf_counter()
        for frame in frames[1:]:
            last = invert(frame, plan=plan, options=options, start=last)
        return (time.perf_counter() - begun) / (len(frames) - 1), float("nan")

    def fitted(work: Work, folder: Path) -> tuple[float, float]:
        shots = np.load(folder / f"{work['fit']}.npz")
        truth = np.load(folder / f"{work['fit']} truth.npy")
        known = {"source": np.ones(truth.shape[-2:]), "noise": work["noise"], **work["keywords"]}
        images = shots_of(shots["images"], strength=list(shots["strengths"]), **known)
        options = FitOptions(threads=work.get("threads"))
        begun = time.perf_counter()
        result = fit(images, options=options)
        seconds = time.perf_counter() - begun
        pairs = zip(result.fields, truth, strict=True)
        shares = [length(f.displacement - t) / length(t) for f, t in pairs]
        return seconds, float(max(shares))

    for line in sys.stdin:
        work = json.loads(line)
        done = streamed if "stream" in work else fitted if "fit" in work else inverted
        measured = done(work, Path(work["folder"]))
        gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(json.dumps([*measured, gigabytes]), flush=True)


def length(vector: FloatArray) -> float:
    """Root of the sum of squares, without BLAS: its threads would spin into the next work."""
    return float(np.sqrt(np.sum(vector * vector)))


def large_images(case: Case, size: tuple[int, int]) -> FloatArray:
    lines = case.strengths()
    return np.stack([counted(case.fields, line, case.beam, size, RAYS) for line in lines])


class Version:
    """A process that works with one version of the package."""

    def __init__(self, python: str) -> None:
        command = [python, __file__, "--worker"]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def does(self, work: Work) -> tuple[float, float, float]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(work) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            sys.exit(f"the worker of {self._process.args} has ended: see its message above")
        seconds, error, gigabytes = json.loads(answer)
        return seconds, error, gigabytes

    def close(self) -> None:
        self._process.communicate()


def row(name: str, work: Work, old: Version, new: Version, repeat: int) -> str:
    new.does(work), old.does(work)
    pairs = np.array([(old.does(work), new.does(work)) for _ in range(repeat)])
    (before, *_, of_before), (now, *_, of_now) = np.median(pairs, axis=0)
    ratios = pairs[:, 0, 0] / pairs[:, 1, 0]
    shares = ("" if np.isnan(error) else f"{100 * error:.2f}" for error in pairs[0, :, 1])
    times = f"{np.median(ratios):.2f} ({ratios.min():.2f} to {ratios.max():.2f})"
    memory = f"{of_before:.2f} | {of_now:.2f}"
    return f"| {name} | {before:.3f} | {now:.3f} | {times} | {' | '.join(shares)} | {memory} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", nargs="?", help="interpreter of the other version's environment")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--only", default="", help="rows whose name contains this")
    parser.add_argument("--threads", type=int, help="default: all cores")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker:
        worker()
        return
    if given.old is None:
        parser.error("give the interpreter of the other version's environment")
    with tempfile.TemporaryDirectory() as folder:
        all_works = works(Path(folder), given.only)
        chosen = {name: work for name, work in all_works.items() if given.only in name}
        old, new = Version(given.old), Version(sys.executable)
        common = {"folder": folder, "threads": given.threads}
        if any(work.get("truth") == "finest" for work in chosen.values()):
            finest = {"image": "frame", "source": "beam", "truth": "finest", "n_sites": 1_069_056}
            new.does({**finest, **common})
        print(
            "| work | s before | s now | times as fast | error before, % | error now, % "
            "| GB before | GB now |"
        )
        print(f"|{'---|' * 8}")
        for name, work in chosen.items():
            print(row(name, {**work, **common}, old, new, given.repeat), flush=True)
        old.close()
        new.close()


if __name__ == "__main__":
    main()
