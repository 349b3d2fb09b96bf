"""How much damage to results is noticed when they are read.

    python benchmarks/damage.py [--trials 500] [--seed 0]

A small store of shots and a result file are damaged at random, one damage at a time: bits flipped
in chunks, in descriptions and in result files, chunks lost, chunks exchanged. Then everything is
read. Damage is noticed if reading ends in an error, or if a shot is no longer reported as done.
Damage that changes nothing of what is read (white space in a description, an array's second
description, exchanged chunks with equal content) is harmless and counts as noticed; the table gives
its number. Damage is unnoticed only if values or attributes differ from what was written.
"""

from __future__ import annotations

import argparse
import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from napari_shadowinv import (
    InversionOptions,
    ProtonSetup,
    Recipe,
    Shot,
    invert,
    read,
    run_stack,
    synthetic_image,
    write,
)
from napari_shadowinv.io.store import DONE
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import RunOptions

SHAPE = (24, 28)
OPTIONS = InversionOptions(n_sites=60)
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
)
VARIABLES = ("potential", "displacement", "caustic", "reprojection", "weights")

Damage = Callable[[Path, random.Random], None]


def flip_bit(file: Path, rng: random.Random) -> None:
    """Turn one bit of a file over."""
    content = bytearray(file.read_bytes())
    place = rng.randrange(8 * len(content))
    content[place // 8] ^= 1 << (place % 8)
    file.write_bytes(content)


def chunks(store: Path) -> list[Path]:
    """Return the files with values."""
    return sorted(file for file in store.glob("*/c/**/*") if file.is_file())


def descriptions(store: Path) -> list[Path]:
    """Return the files that describe arrays, and three times the one that describes all."""
    return [*sorted(store.rglob("zarr.json")), *[store / "zarr.json"] * 2]


def flip_in_chunk(store: Path, rng: random.Random) -> None:
    """Turn one bit of a chunk over."""
    flip_bit(rng.choice(chunks(store)), rng)


def flip_in_description(store: Path, rng: random.Random) -> None:
    """Turn one bit of a description over."""
    flip_bit(rng.choice(descriptions(store)), rng)


def lose_chunk(store: Path, rng: random.Random) -> None:
    """Delete a chunk."""
    rng.choice(chunks(store)).unlink()


def cut_chunk(store: Path, rng: random.Random) -> None:
    """Lose the end of a chunk."""
    file = rng.choice(chunks(store))
    content = file.read_bytes()
    file.write_bytes(content[: rng.randrange(len(content))])


def exchange_chunks(store: Path, rng: random.Random) -> None:
    """Exchange two chunks, mostly of one array."""
    files = chunks(store)
    first = rng.choice(files)
    array = first.relative_to(store).parts[0]
    alike = [file for file in files if file.relative_to(store).parts[0] == array and file != first]
    second = rng.choice(alike if alike and rng.random() < 0.7 else files)
    contents = first.read_bytes(), second.read_bytes()
    second.write_bytes(contents[0])
    first.write_bytes(contents[1])


STORE_DAMAGES: dict[str, Damage] = {
    "bit of a chunk": flip_in_chunk,
    "bit of a description": flip_in_description,
    "lost chunk": lose_chunk,
    "shortened chunk": cut_chunk,
    "exchanged chunks": exchange_chunks,
}
RESULT_DAMAGES: dict[str, Damage] = {"bit of a result file": flip_bit}


def make_store(path: Path) -> None:
    """Invert four shots into a store."""
    rng = np.random.default_rng(0)
    source = 100 + 10 * rng.random(SHAPE)
    blobs = [gaussian_blob(SHAPE, 2 + n, 4.0, (10, 12 + n)) for n in range(4)]
    shots = np.stack([synthetic_image(blob.displacement, source) for blob in blobs])
    run_stack(
        Shot(shots, source=source),
        path,
        Recipe(setup=SETUP, options=OPTIONS),
        run=RunOptions(variables=VARIABLES),
    )


def make_result(path: Path) -> None:
    """Invert a shot into a result file."""
    blob = gaussian_blob(SHAPE, 3.0, 4.0, (10, 12))
    write(path, invert(synthetic_image(blob.displacement), options=OPTIONS), setup=SETUP)


def outcome(path: Path, original: Path) -> str:
    """Read all of a damaged store or file, and say whether the damage was noticed."""
    expected = read(original).load()
    try:
        found = read(path)
        if "status" in found and (found["status"].values != DONE).any():
            return "noticed"
        found = found.load()
    except Exception:
        return "noticed"
    return "harmless" if found.identical(expected) else "unnoticed"


def count_outcomes(trials: int, seed: int, folder: Path) -> dict[str, Counter[str]]:
    """Damage copies of a store and a result in turn, and count what became of each damage."""
    store, result = folder / "intact.shadowinv.zarr", folder / "intact.shadowinv"
    make_store(store)
    make_result(result)
    rng = random.Random(seed)
    damages = {**STORE_DAMAGES, **RESULT_DAMAGES}
    counts: dict[str, Counter[str]] = {name: Counter() for name in damages}
    for trial in range(trials):
        name, damage = list(damages.items())[trial % len(damages)]
        original = store if name in STORE_DAMAGES else result
        copy = folder / f"copy{''.join(original.suffixes)}"
        if original is store:
            shutil.copytree(original, copy)
        else:
            shutil.copy(original, copy)
        damage(copy, rng)
        counts[name][outcome(copy, original)] += 1
        if original is store:
            shutil.rmtree(copy)
        else:
            copy.unlink()
    return counts


def main() -> None:
    """Print a table of what was noticed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        counts = count_outcomes(arguments.trials, arguments.seed, Path(folder))
    print("| damage | trials | noticed | of them harmless | unnoticed |")
    print("|---|---|---|---|---|")
    total: Counter[str] = sum(counts.values(), Counter())
    for name, count in [*counts.items(), ("all", total)]:
        noticed = count["noticed"] + count["harmless"]
        print(
            f"| {name} | {count.total()} | {noticed} | {count['harmless']} | {count['unnoticed']} |"
        )


if __name__ == "__main__":
    main()
