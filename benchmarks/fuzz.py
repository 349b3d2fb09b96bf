"""Damage good files of every format at random, and see how the readers take it.

    python benchmarks/fuzz.py [--mutants 200] [--seed 0] [--formats shot.tif run.shadowinv.zarr …]

Prints a Markdown table: of each format how many damaged files were refused in one sentence, how
many were read (a flipped bit of a pixel is still a picture), the worst processor time and memory,
and what failed: any other error, a crash, no answer in 20 s, more than 2 s or more than 500 MB.
Everything is read in a process of its own. Ends with 1 if something failed.
"""

from __future__ import annotations

import argparse
import json
import random
import select
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

MOST_SECONDS = 2.0
MOST_MEGABYTES = 500.0
_GIVEN_UP_AFTER = 20.0
_MOST_ADDRESSES = 6_000_000_000

Writer = Callable[[Path], object]

# Good files


def _shot() -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).poisson(300, (48, 64)).astype(np.uint16)


def _tiff(**options: Any) -> Writer:
    import tifffile

    return lambda path: tifffile.imwrite(path, _shot(), photometric="minisblack", **options)


def _picture(path: Path) -> None:
    import imageio.v3 as iio

    iio.imwrite(path, (_shot() // 4).astype(np.uint8))


def _mat(packed: bool) -> Writer:
    from scipy.io import savemat

    return lambda path: savemat(path, {"shot": _shot(), "x": 1.0}, do_compression=packed)


def _hdf5(path: Path, **root: str) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file.create_dataset("image", data=_shot(), chunks=(16, 16), compression="gzip")
        file["image"].attrs["MATLAB_class"] = np.bytes_(b"uint16")
        file.attrs.update(root)


def _camera(header: bytes) -> Writer:
    return lambda path: path.write_bytes(header + _shot().tobytes())


def _b16(path: Path) -> None:
    height, width = _shot().shape
    numbers = np.array([24 + _shot().nbytes, 24, width, height, 0], "<i4")
    _camera(b"PCO-" + numbers.tobytes())(path)


def _spe(path: Path) -> None:
    header = bytearray(4100)
    height, width = _shot().shape
    for at, value, kind in ((42, width, "<u2"), (656, height, "<u2"), (108, 3, "<i2")):
        header[at : at + 2] = np.array(value, kind).tobytes()
    header[1446:1450] = np.array(1, "<i4").tobytes()
    header[2996:3000] = b"\x67\x45\x23\x01"
    _camera(bytes(header))(path)


def _cpsa(path: Path) -> None:
    rng = np.random.default_rng(0)
    content = np.array([-104, 8, 6, 0], "<i4").tobytes() + np.array([0.3, 0.5], "<f4").tobytes()
    content += np.array([85, 75, 40, 2, 1000, 800], "<i4").tobytes()
    for number in range(48):
        row, column = divmod(number, 8)
        hits = int(rng.integers(0, 40))
        place = [3000 * column, -2400 * row, hits, 0, 0, 0, 55, column, row]
        content += np.array([number + 1, *place], "<i4").tobytes()
        content += rng.integers(500, 2000, hits).astype("<i2").tobytes()
        content += rng.integers(0, 100, 3 * hits).astype("u1").tobytes()
        content += rng.integers(0, 800, 2 * hits).astype("<i2").tobytes()
    path.write_bytes(content + np.array(-1, "<i4").tobytes() + b"Scan")


def _table(path: Path) -> None:
    np.savetxt(path, _shot(), header="a shot", fmt="%d")


def _inversion() -> Any:
    from napari_shadowinv import invert

    return invert(_shot().astype(float), options=_few_sites())


def _few_sites() -> Any:
    from napari_shadowinv import InversionOptions

    return InversionOptions(n_sites=200)


def _setup() -> Any:
    from napari_shadowinv import ProtonSetup

    return ProtonSetup(
        energy=14.7,
        source_object_distance=0.01,
        object_image_distance=0.28,
        pixel_size=1e-5,
    )


def _result(path: Path) -> None:
    from napari_shadowinv.io import write

    write(path, _inversion(), setup=_setup())


def _store(path: Path) -> None:
    from napari_shadowinv import Recipe, run_stack
    from napari_shadowinv.pipeline import RunOptions

    shots = np.stack([_shot(), _shot()[::-1]]).astype(float)
    run_stack(
        shots,
        path,
        Recipe(options=_few_sites(), setup=_setup()),
        scheduler="threads",
        run=RunOptions(workers=1),
    )


def _toml(path: Path) -> None:
    path.write_text(
        'kind = "proton"\nenergy = 14.7\nsource_object_distance = 0.01\n'
        "object_image_distance = 0.28\npixel_size = 1e-5\n"
    )


def _calibration(path: Path) -> None:
    rows = "".join(f"{2**n},{60000 - 5000 * n},{61000 - 4000 * n},59000\n" for n in range(8))
    path.write_text("Dose (Gy),Red,Green,Blue\n" + rows)


FORMATS: dict[str, Writer] = {
    "shot.tif": _tiff(),
    "packed.tif": _tiff(compression="zlib", tile=(16, 16)),
    "shot.png": _picture,
    "shot.bmp": _picture,
    "shot.jpg": _picture,
    "shot.npy": lambda path: np.save(path, _shot()),
    "five.mat": _mat(packed=False),
    "seven.mat": _mat(packed=True),
    "seven_three.mat": _hdf5,
    "shot.b16": _b16,
    "shot.spe": _spe,
    "scan.cpsa": _cpsa,
    "shot.txt": _table,
    "pradformat.h5": lambda path: _hdf5(path, object_type="radiograph"),
    "result.shadowinv": _result,
    "run.shadowinv.zarr": _store,
    "setup.toml": _toml,
    "calibration.csv": _calibration,
}

# Damage


def damaged(good: bytes, rng: random.Random) -> bytes:
    """One of several kinds of damage, each of which some disk or mailer has done."""
    content = bytearray(good)
    kind = rng.choice(("bits", "bits", "cut", "head", "size", "size", "hole", "twice", "junk"))
    at = rng.randrange(max(1, len(content)))
    near = rng.randrange(max(1, min(len(content), 512)))
    if kind == "bits":
        # Headers are short but matter most.
        for _ in range(rng.choice((1, 1, 3, 30))):
            place = rng.randrange(len(content)) if rng.random() < 0.5 else near
            content[place] ^= 1 << rng.randrange(8)
    elif kind == "cut":
        del content[at:]
    elif kind == "head":
        content[:near] = rng.randbytes(near)
    elif kind == "size":
        width = rng.choice((2, 4, 8))
        place = near if rng.random() < 0.7 else at
        value = rng.choice((0, 1, 255, 65535, 2**31 - 1, 2**32 - 1, 2**40, 2**63 - 1))
        number = (value % 256**width).to_bytes(width, rng.choice(("little", "big")))
        content[place : place + width] = number
    elif kind == "hole":
        content[at : at + 512] = bytes(len(content[at : at + 512]))
    elif kind == "twice":
        content[at:at] = content[near : near + rng.randrange(1, 300)]
    else:
        content[at:at] = rng.randbytes(rng.randrange(1, 300))
    return bytes(content)


def damage(path: Path, rng: random.Random) -> None:
    """Damage a file, or one file of a folder."""
    if path.is_dir():
        files = sorted(file for file in path.rglob("*") if file.is_file())
        # What tells of the whole store matters more than one chunk.
        path = rng.choice([*files, *(file for file in files if file.name == "zarr.json")])
    path.write_bytes(damaged(path.read_bytes(), rng))


# Reading, in a process of its own


def read_whole(path: Path) -> None:
    """Read all that the package reads of a file."""
    from napari_shadowinv.cli._batch import status_table
    from napari_shadowinv.cli._info import file_table
    from napari_shadowinv.film import Calibration
    from napari_shadowinv.io import read, read_toml
    from napari_shadowinv.physics.setup import setup_from_dict

    if path.suffix == ".toml":
        setup_from_dict(read_toml(path), str(path))
        return
    if path.name == "calibration.csv":
        Calibration.from_csv(path).curve()
        return
    content = read(path)
    if path.is_dir():
        status_table(path)
        _load_shots(path, content)
    else:
        file_table(path)


def _load_shots(path: Path, dataset: Any) -> None:
    from napari_shadowinv._system.safety import as_file_errors

    as_file_errors(lambda _: dataset[["displacement", "caustic"]].load(scheduler="sync"))(path)


def serve() -> None:
    """Read the paths of standard input; tell what became of each."""
    import resource
    import warnings

    from napari_shadowinv.errors import FileFormatError, InputError

    warnings.simplefilter("ignore")
    answers = sys.stdout
    sys.stdout = sys.stderr
    for line in sys.stdin:
        path = Path(line.strip())
        before = _memory("VmRSS")
        Path("/proc/self/clear_refs").write_text("5")
        start = time.process_time()
        try:
            read_whole(path)
            outcome = "read"
        except (FileFormatError, InputError) as error:
            outcome = "refused" if "\n" not in str(error) else f"several lines: {error}"
        except Exception as error:
            outcome = f"{type(error).__name__}: {error}"
        seconds = time.process_time() - start
        print(json.dumps([outcome, seconds, _memory("VmHWM") - before]), file=answers, flush=True)
        # Good files come first: what the imports take is theirs.
        resource.setrlimit(resource.RLIMIT_AS, (_MOST_ADDRESSES, _MOST_ADDRESSES))


def _memory(name: str) -> float:
    """A line of what Linux tells of this process, in MB."""
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in status if line.startswith(f"{name}:")) / 1024


class Reader:
    """A process that reads, and is started again when it dies."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None

    def read(self, path: Path, patience: float = _GIVEN_UP_AFTER) -> tuple[str, float, float]:
        """Return what became of a file, seconds and MB."""
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, __file__, "--serve"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{path}\n")
        process.stdin.flush()
        ready, _, _ = select.select([process.stdout], [], [], patience)
        line = process.stdout.readline() if ready else ""
        if line:
            outcome, seconds, megabytes = json.loads(line)
            return outcome, seconds, megabytes
        self.close()
        return ("crashed" if ready else "hung"), 0.0 if ready else patience, 0.0

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None


@dataclass
class Tally:
    """What became of the damaged files of one format."""

    refused: int = 0
    read: int = 0
    seconds: float = 0.0
    megabytes: float = 0.0
    failures: list[str] = field(default_factory=list)

    @property
    def files(self) -> int:
        return self.refused + self.read + len(self.failures)

    def count(self, number: int, outcome: str, seconds: float, megabytes: float) -> None:
        self.seconds = max(self.seconds, seconds)
        self.megabytes = max(self.megabytes, megabytes)
        if seconds > MOST_SECONDS or megabytes > MOST_MEGABYTES:
            outcome = f"{outcome} after {seconds:.1f} s, {megabytes:.0f} MB"
        if outcome in ("refused", "read"):
            setattr(self, outcome, getattr(self, outcome) + 1)
        else:
            self.failures.append(f"{number}: {outcome}")


def fuzz(
    name: str, mutants: int, seed: int, folder: Path, reader: Reader, good: Path | None = None
) -> Tally:
    """Damage the good file of a format so many times, and read each."""
    if good is None:
        good = folder / "good" / name
        good.parent.mkdir()
        FORMATS[name](good)
    bad, tally, is_warm = folder / name, Tally(), False
    for number in range(mutants):
        if not is_warm and (outcome := reader.read(good, 120)[0]) != "read":
            raise RuntimeError(f"{good} is good, but: {outcome}")
        if good.is_dir():
            shutil.rmtree(bad, ignore_errors=True)
            shutil.copytree(good, bad)
        else:
            shutil.copyfile(good, bad)
        damage(bad, random.Random(f"{name} {seed} {number}"))
        outcome, seconds, megabytes = reader.read(bad)
        tally.count(number, outcome, seconds, megabytes)
        is_warm = outcome not in ("crashed", "hung")
    return tally


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--mutants", type=int, default=200, help="damaged files of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--formats", nargs="*", default=list(FORMATS), choices=list(FORMATS))
    arguments = parser.parse_args()
    if arguments.serve:
        serve()
        return 0
    failures: dict[str, list[str]] = {}
    reader = Reader()
    print("| format | files | refused | read | worst s | worst MB | failures |")
    print("|---|---|---|---|---|---|---|")
    for name in arguments.formats:
        with tempfile.TemporaryDirectory() as folder:
            tally = fuzz(name, arguments.mutants, arguments.seed, Path(folder), reader)
        print(
            f"| {name} | {tally.files} | {tally.refused} | {tally.read} | {tally.seconds:.2f} | "
            f"{tally.megabytes:.0f} | {len(tally.failures)} |",
            flush=True,
        )
        if tally.failures:
            failures[name] = tally.failures
    reader.close()
    for name, texts in failures.items():
        print(f"\n{name}:", *texts, sep="\n  ", file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
