"""Whether two versions give the same answers: stores, results, tables and sentences of commands.

    python benchmarks/golden.py write FOLDER        # with the version of this checkout
    python benchmarks/golden.py compare FOLDER FOLDER

`write` runs the commands below on images of formulae (`exact_shots.py`) and on the reference
images, where they are present, and keeps all that they write and print. `compare` names each array
that differs, and by how much, and each line of text. Seconds, paths and checksums are left out.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from exact_shots import Gaussian, correlated_noise, gaussians, image_of, scaled

SIDE = 80
# Seconds, versions, checksums, times of files, and processes.
PASSING = re.compile(
    r"\d+(\.\d+)? (ms|s|min|h)\b|\bin [\d.]+ s\b|[0-9a-f]{40,}|\"(seconds|stages|mtime_ns|size)\": "
    r"(\{[^}]*\}|\d+)|\d{4}-\d\d-\d\d[T ][\d:.]+\S*"
)
SETUP = """kind = "proton"
energy = {energy}
source_object_distance = 0.01
object_image_distance = 0.1
pixel_size = 33e-6
"""
# Name, and arguments of the command.
COMMANDS = {
    "demo": "demo --out demo",
    "plain": "invert low.npy --set options.n_sites=3000 --out plain.shadowinv",
    "recorded": "invert low.npy --source beam.npy --setup low.toml --set options.n_sites=4000 "
    "--out a.shadowinv",
    "free": "invert low.npy --source beam.npy --boundary free --set options.n_sites=3000 "
    "--out free.shadowinv",
    "steps": 'invert low.npy --setup low.toml --step "hot-pixels 6" --bin 2 '
    "--source-from polynomial --mask mask.png --set options.n_sites=1500 "
    "--out steps.shadowinv --save-recipe steps.toml",
    "instrument": "invert low.npy --source beam.npy --set instrument.background=0.03 "
    "--set instrument.beam_rms=0.01 --set options.n_sites=2000 --out instrument.shadowinv",
    "blurred": "invert blurred.npy --set options.n_sites=2000 --out blurred.shadowinv",
    "toroid": "invert toroid.npy --set options.n_sites=10000 --out toroid.shadowinv",
    "burner": "invert burner.png --source-from low-pass --set options.n_sites=10000 "
    "--out burner.shadowinv",
    "rerun": "rerun steps.shadowinv",
    "forward": "forward a.shadowinv --setup high.toml --out forward.npy",
    "products": 'analyse a.shadowinv "profile 40,10 40,70 width=3" '
    '"current center=40,40 radius=20" current-density --csv products.csv --samples 20',
    "one": "fit low.npy --source beam.npy --setup low.toml --out one.shadowinv",
    "pair": "fit low.npy high.npy --energies 14.7,30 --setup low.toml --source beam.npy "
    "--out pair.shadowinv",
    "unknown": "fit low.npy high.npy --energies 14.7,30 --setup low.toml --source unknown "
    "--noise poisson --out unknown.shadowinv",
    "assumed": "fit low.npy high.npy --energies 14.7,30 --setup low.toml --out assumed.shadowinv",
    "batch": "batch low.npy high.npy blurred.npy --source beam.npy --set options.n_sites=1500 "
    "--out run.shadowinv.zarr",
    "table": "batch shots.csv --setup low.toml --set options.n_sites=1500 "
    "--out table.shadowinv.zarr",
    "status": "info run.shadowinv.zarr",
    "verify": "info table.shadowinv.zarr --verify",
    "export": "export run.shadowinv.zarr --format csv --out run.csv",
    "plan": "plan toroid:peak=60,radius=20e-6 --setup low.toml --size 64x64 --set plan.draws=2 "
    "--out plan.csv",
    "info": "info a.shadowinv",
    "info fit": "info pair.shadowinv",
    "wrong": "invert low.npy --source missing.npy",
    "wrong number": "invert low.npy --set options.n_sites=-3",
    "wrong key": "invert low.npy --recipe wrong.toml",
}


def write_inputs(folder: Path) -> None:
    """Write images, setups and tables."""
    generator = np.random.default_rng(5)
    beam = 900 + 60 * np.sin(np.arange(SIDE) / 17)[:, None] * np.cos(np.arange(SIDE) / 23)[None]
    object_ = gaussians([Gaussian(90, 9, 7, 0.4, 38.0, 36.0), Gaussian(-45, 6, 8, 0.0, 46.0, 48.0)])
    flat = image_of(object_, SIDE)
    for name, share in (("low", 1.0), ("high", 0.7)):
        expected = image_of(scaled(object_, share), SIDE) * beam
        np.save(folder / f"{name}.npy", generator.poisson(expected).astype(float))
    np.save(folder / "beam.npy", generator.poisson(beam).astype(float))
    noise = correlated_noise(generator, SIDE, 1.5)
    np.save(folder / "blurred.npy", np.maximum(900 * (flat + 0.02 * noise), 1.0))
    import imageio.v3 as iio

    mask = np.full((SIDE, SIDE), 255, np.uint8)
    mask[5:9, 60:70] = 0
    iio.imwrite(folder / "mask.png", mask)
    for name, energy in (("low", 14.7), ("high", 30.0)):
        (folder / f"{name}.toml").write_text(SETUP.format(energy=energy))
    (folder / "shots.csv").write_text("file,source,energy\nlow.npy,beam.npy,14.7\nhigh.npy,,30\n")
    (folder / "wrong.toml").write_text("[options]\nn_site = 3\n")
    data = Path(os.environ.get("SHADOWINV_DATA", "../shared/data"))
    if (data / "toroid/dm097_noise.npy").exists():
        np.save(folder / "toroid.npy", np.maximum(np.load(data / "toroid/dm097_noise.npy"), 0.0))
    frames = sorted((data / "burner").rglob("*.bmp"))
    if frames:
        iio.imwrite(folder / "burner.png", iio.imread(frames[0])[:400, :400])


def write(folder: Path) -> None:
    """Run all commands in a folder, and keep what they print."""
    folder.mkdir(parents=True)
    write_inputs(folder)
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2", "COLUMNS": "100"}
    for name, arguments in COMMANDS.items():
        done = subprocess.run(
            [sys.executable, "-m", "napari_shadowinv", *split(arguments)],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        text = f"exit {done.returncode}\n{done.stdout}\n--\n{done.stderr}"
        (folder / f"{name}.said").write_text(text)
        print(f"{name}: exit {done.returncode}", flush=True)


def split(arguments: str) -> list[str]:
    """Split arguments at spaces outside of quotes."""
    return [part.strip('"') for part in re.findall(r'"[^"]*"|\S+', arguments)]


def contents(folder: Path) -> Iterator[tuple[str, Any]]:
    """Yield all arrays and texts below a folder by their names."""
    import h5py
    import zarr

    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".zarr":
            group = zarr.open_group(str(path), mode="r")
            yield f"{name} attributes", json.dumps(dict(group.attrs), sort_keys=True)
            for key, array in sorted(group.arrays()):
                yield f"{name}/{key}", array[...]
        elif ".zarr" in name or path.is_dir():
            continue
        elif path.suffix in (".shadowinv", ".h5"):
            with h5py.File(path) as file:
                yield f"{name} attributes", repr(sorted(file.attrs.items()))
                found: list[tuple[str, Any]] = []
                file.visititems(
                    lambda key, item, found=found: (
                        found.append((key, item[...])) if isinstance(item, h5py.Dataset) else None
                    )
                )
            yield from ((f"{name}/{key}", array) for key, array in sorted(found))
        elif path.suffix == ".npy":
            yield name, np.load(path)
        elif path.suffix in (".said", ".csv", ".toml", ".json"):
            yield name, path.read_text()


def compare(first: Path, second: Path) -> int:
    """Print what differs; return how many arrays and texts do."""
    before, now = dict(contents(first)), dict(contents(second))
    differing = 0
    for name in sorted(before.keys() | now.keys()):
        if name not in before or name not in now:
            print(f"{name}: only in {first if name in before else second}")
            differing += 1
            continue
        text = difference(before[name], now[name], (first, second))
        if text:
            differing += 1
            print(f"{name}: {text}")
    print(f"{differing} of {len(before)} differ")
    return differing


def difference(before: Any, now: Any, folders: tuple[Path, Path]) -> str:
    """Say by how much two arrays differ, or which lines of two texts; "" if they are equal."""
    if isinstance(before, str):
        lines = [
            PASSING.sub("…", str(text).replace(str(folder.resolve()), "")).splitlines()
            for text, folder in zip((before, now), folders, strict=True)
        ]
        if lines[0] == lines[1]:
            return ""
        pairs = [
            f"\n    - {one}\n    + {other}"
            for one, other in zip(*(part + [""] * 400 for part in lines), strict=False)
            if one != other
        ]
        return "".join(pairs[:6])
    before, now = np.asarray(before), np.asarray(now)
    if before.shape != now.shape or before.dtype != now.dtype:
        return f"{before.dtype}{before.shape} became {now.dtype}{now.shape}"
    if before.dtype.kind not in "fciub":
        texts = [" ".join(map(str, array.ravel())) for array in (before, now)]
        return difference(*texts, folders)
    if np.array_equal(before, now, equal_nan=before.dtype.kind == "f"):
        return ""
    gap, size = np.nanmax(np.abs(now - before * 1.0)), np.nanmax(np.abs(before * 1.0))
    return f"differs by {gap / size if size else np.inf:.2g} of its largest value"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    arguments = parser.parse_args()
    if arguments.action == "write":
        write(arguments.folders[0].resolve())
    else:
        sys.exit(bool(compare(*arguments.folders)))


if __name__ == "__main__":
    main()
