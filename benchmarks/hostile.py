"""Give the package input that is wrong on purpose, and see that it answers in one sentence.

    python benchmarks/hostile.py [--only tables packs recipes instruments setups …]

Prints a Markdown table: of each kind of input how many cases there are, how many were refused in
one sentence, how many were accepted, and what failed: any other error, several lines, more than
20 s of processor time, more than 2 GB, or no answer within two minutes. Each case has a process and
a folder of its own. Ends with 1 if one failed.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

MAX_SECONDS, MAX_BYTES = 20.0, 2_000_000_000
PATIENCE_S = 120.0  # other programs may be at work
# Numba and the threads of BLAS reserve addresses that they do not use.
_RESERVED_BYTES = 4_000_000_000

# Commands import them when they need them.
_IMPORTED = (
    "cli",
    "film",
    "fitting",
    "inversion",
    "pipeline",
    "plotting",
    "preprocessing",
    "stack",
)

Case = Callable[[], object]

SETUP = {
    "kind": '"proton"',
    "energy": "14.7",
    "source_object_distance": "0.01",
    "object_image_distance": "0.28",
    "pixel_size": "1e-5",
}
NUMBERS = ("nan", "inf", "-inf", "-1", "0", "1e308", "1e-308", '"x"', "[]", "{}", "true", '""')
FEW = "--set=options.n_sites=60"
HASTY = ("--set=fit.options.samples=0", "--set=fit.options.max_iterations=1")
CELLS = ("nan", "inf", "1e300", "-1e300", "1e-300", "x", "=1+1", "\x1b[31m", "\0", "a" * 140_000)
DEEP = ".".join(["a"] * 60_000) + " = 1\n"
NESTED = "x = " + "[" * 50_000 + "]" * 50_000 + "\n"
TEXTS = (
    DEEP,
    NESTED,
    f"x = {{{DEEP.strip()}}}\n",
    "\0" * 1000,
    "a" * 1_100_000,
    "[[" * 1000,
    "\ufeff",
)


def _shot(shape: tuple[int, int] = (32, 40)) -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).poisson(300, shape).astype(float)


def _command(*arguments: object) -> None:
    from typer.testing import CliRunner

    from napari_shadowinv.cli import app
    from napari_shadowinv.errors import InputError

    np.save("shot.npy", _shot())
    ended = CliRunner().invoke(app, list(map(str, arguments)))
    if ended.exception is not None and not isinstance(ended.exception, SystemExit):
        raise ended.exception
    if ended.exit_code == 2:
        raise InputError(ended.stderr.strip())


def _with_text(name: str, text: str, *arguments: object) -> Case:
    def run() -> None:
        Path(name).write_text(text)
        _command(*arguments)

    return run


def tables() -> Iterator[Case]:
    """Tables of shots, fiducials and calibrations with hostile cells."""
    columns = {"file": "shot.npy", "energy": "14.7", "strength": "1", "brightness": "1", "psf": "0"}
    columns |= {"mask": "", "source": "", "noise": "poisson", "setup": "", "exclude": ""}
    commands = (
        ["fit", "t.csv", *HASTY],
        ["batch", "t.csv", "--out", "o.zarr"],
    )
    for name, cell, command in itertools.product(columns, CELLS, commands):
        row = {**columns, name: cell}
        text = f"{','.join(row)}\n{','.join(row.values())}\n"
        yield _with_text("t.csv", text, *command)
    for name, cell in itertools.product(("y", "x", "dy", "dx", "sigma"), CELLS):
        row = {**dict.fromkeys(("y", "x", "dy", "dx", "sigma"), "3"), name: cell}
        text = f"{','.join(row)}\n{','.join(row.values())}\n"
        yield _with_text("f.csv", text, "fit", "shot.npy", "--fiducials", "f.csv")
    for column, cell in itertools.product(range(4), CELLS):
        rows = [[str(2.0**n), *[str(40000 - 4000 * n)] * 3] for n in range(5)]
        rows[2][column] = cell
        yield _calibration("\n".join(",".join(row) for row in rows))


def _calibration(rows: str) -> Case:
    def run() -> None:
        from napari_shadowinv.film import Calibration, combined_dose

        Path("c.csv").write_text(f"Dose,Red,Green,Blue\n{rows}\n")
        combined_dose(np.full((8, 8, 3), 20_000, np.uint16), Calibration.from_csv("c.csv"))

    return run


def setups() -> Iterator[Case]:
    """Setups with hostile numbers."""
    for name, number in itertools.product([*SETUP][1:], NUMBERS):
        text = "\n".join(f"{key} = {value}" for key, value in {**SETUP, name: number}.items())
        yield _with_text("s.toml", text, "invert", "shot.npy", "--setup", "s.toml", FEW)
    for text in TEXTS:
        yield _with_text("s.toml", text, "invert", "shot.npy", "--setup", "s.toml")


def recipes() -> Iterator[Case]:
    """Recipes and settings that are no such thing."""
    entries = ("mask = {}", "source = {}", "steps = {}", "options = {}", "fit = {}", "setup = {}")
    for entry, number in itertools.product(entries, (*NUMBERS, '"a\\u0000b"', '"/dev/zero"')):
        text = entry.format(number)
        yield _with_text("r.toml", text, "invert", "shot.npy", "--recipe", "r.toml", FEW)
    for text in TEXTS:
        yield _with_text("r.toml", text, "invert", "shot.npy", "--recipe", "r.toml")
        yield lambda text=text: _command("invert", "shot.npy", f"--set={text}")
        yield lambda text=text: _command("invert", "shot.npy", f"--step={text}")


def instruments() -> Iterator[Case]:
    """Instruments with hostile numbers: in Python, in recipes and as flags."""
    from napari_shadowinv import Instrument, invert

    junk = ("x", -1, 1e300, 1e-300, float("nan"), float("inf"), 2**70, None, [], {}, object())
    image, names = _shot(), (*Instrument.model_fields, "beam", "bakground")
    for name, value in itertools.product(names, junk):
        yield lambda name=name, value=value: invert(
            image, options={"n_sites": 60}, instrument={name: value}
        )
    for value in ("x", -1, [], {1: 2}, object(), Instrument):
        yield lambda value=value: invert(image, options={"n_sites": 60}, instrument=value)
    invert_shot = ["invert", "shot.npy", FEW]
    for name, number in itertools.product(names, NUMBERS):
        text = f"[instrument]\n{name} = {number}\n"
        yield _with_text("r.toml", text, *invert_shot, "--recipe", "r.toml")
    for number in NUMBERS:
        text = f"instrument = {number}\n"
        yield _with_text("r.toml", text, *invert_shot, "--recipe", "r.toml")
    texts = ("nan", "inf", "-1", "1e308", "1e-308", "x", "")
    for name, number in itertools.product(Instrument.model_fields, texts):
        setting = f"--set=instrument.{name}={number}"
        yield lambda setting=setting: _command(*invert_shot, setting)


def packs() -> Iterator[Case]:
    """Descriptions of film packs."""
    layer = '[[layers]]\nfilm = "HDV2"\nfile = "shot.npy"\n'
    for name, number in itertools.product(("rim", "pixel_size", "corners", "fiducials"), NUMBERS):
        yield _with_text("p.toml", f"{name} = {number}\n{layer}", "film", "p.toml")
    for name, number in itertools.product(("film", "file", "mask", "filters"), NUMBERS):
        entries = {"film": '"HDV2"', "file": '"shot.npy"', name: number}
        lines = "\n".join(f"{key} = {value}" for key, value in entries.items())
        yield _with_text("p.toml", f"[[layers]]\n{lines}\n", "film", "p.toml")
    for text in TEXTS:
        yield _with_text("p.toml", text, "film", "p.toml")


def options() -> Iterator[Case]:
    """Options in Python of wrong kind and size."""
    from napari_shadowinv import FitOptions, InversionOptions, Recipe
    from napari_shadowinv.options import FitChoices

    junk = ("x", -1, 1e300, 1e-300, float("nan"), float("inf"), 2**70, [], object())
    for model in (InversionOptions, FitOptions, FitChoices, Recipe):
        for name, value in itertools.product(model.model_fields, junk):
            yield lambda model=model, name=name, value=value: model(**{name: value})


def arrays() -> Iterator[Case]:
    """Arrays of wrong kind, shape, size and content."""
    import xarray as xr

    from napari_shadowinv import Shot, fit, invert, poisson_invert, synthetic_image
    from napari_shadowinv.inversion import plan_sites

    image = _shot()
    content = (
        np.broadcast_to(np.float64(1), (200_000, 200_000)),
        np.empty((0, 0)),
        np.empty((3, 0)),
        image.astype(complex),
        image.astype(str),
        image.astype(object),
        np.full(image.shape, np.nan),
        np.full(image.shape, 1e308),
        np.full(image.shape, 1e-308),
        -image,
        np.zeros(image.shape),
        image[None],
        np.ma.masked_all(image.shape),
        np.ma.masked_greater(image, 300),
        xr.DataArray(image, dims=("a", "b")),
        xr.DataArray(image, dims=("y", "x"), coords={"y": np.arange(32.0) ** 2}),
        [[1, 2], [3]],
        "x",
        None,
        5,
    )
    calls: tuple[Callable[[Any], object], ...] = (
        lambda array: invert(array, options={"n_sites": 60}),
        lambda array: invert(image, source=array, options={"n_sites": 60}),
        lambda array: invert(image, mask=array, options={"n_sites": 60}),
        lambda array: plan_sites(array, {"n_sites": 60}),
        lambda array: fit(Shot(array, source=array)),
        poisson_invert,
        lambda array: synthetic_image(np.zeros((2, 32, 40)), array),
    )
    for call, array in itertools.product(calls, content):
        yield lambda call=call, array=array: call(array)


def files() -> Iterator[Case]:
    """Pipes, devices, loops of links and folders where files are expected."""
    commands = (
        ["invert", "{}"],
        ["info", "{}"],
        ["rerun", "{}"],
        ["forward", "{}"],
        ["film", "{}"],
        ["fit", "{}"],
        ["batch", "{}", "--out", "o.shadowinv.zarr"],
        ["invert", "shot.npy", "--source", "{}"],
        ["invert", "shot.npy", "--mask", "{}"],
        ["invert", "shot.npy", "--setup", "{}"],
        ["invert", "shot.npy", "--recipe", "{}"],
        ["fit", "shot.npy", "--fiducials", "{}"],
    )
    for command, name in itertools.product(
        commands, ("pipe.npy", "/dev/zero", "loop.npy", "folder.npy", "a" * 300, "pipe.csv")
    ):
        yield _with_places([part.format(name) for part in command])


def _with_places(arguments: list[str]) -> Case:
    def run() -> None:
        os.mkfifo("pipe.npy")
        os.mkfifo("pipe.csv")
        os.symlink("loop.npy", "loop.npy")
        os.mkdir("folder.npy")
        _command(*arguments)

    return run


KINDS = {
    kind.__name__: kind
    for kind in (tables, packs, recipes, instruments, setups, options, arrays, files)
}


def outcome(case: Case) -> str:
    """What becomes of a case in a process and a folder of its own."""
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    with tempfile.TemporaryDirectory() as folder:
        process = context.Process(target=_run, args=(case, folder, there))
        process.start()
        there.close()
        text = "no answer"
        if here.poll(PATIENCE_S):
            try:
                text = here.recv()
            except EOFError:
                text = "crashed"
        process.kill()
        process.join()
    return text


def _run(case: Case, folder: str, answer: Any) -> None:
    from napari_shadowinv.errors import FileFormatError, InputError

    warnings.simplefilter("ignore")
    os.chdir(folder)
    resource.setrlimit(resource.RLIMIT_AS, (_RESERVED_BYTES, _RESERVED_BYTES))
    before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    try:
        case()
        text = "accepted"
    except (InputError, FileFormatError) as error:
        is_usage = "Usage:" in str(error)  # typer's own box
        text = "refused" if is_usage or "\n" not in str(error) else f"several lines: {error}"
    except BaseException as error:
        text = f"{type(error).__name__}: {' '.join(str(error).split())[:150]}"
    seconds = time.process_time() - began
    text = text if seconds < MAX_SECONDS else f"{text} after {seconds:.0f} s"
    taken = 1024 * (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
    answer.send(text if taken < MAX_BYTES else f"{text} with {taken / 1e9:.1f} GB")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=list(KINDS), choices=list(KINDS))
    failures: dict[str, list[str]] = {}
    print("| input | cases | refused | accepted | failures |")
    print("|---|---|---|---|---|")
    for name in _IMPORTED:  # once, before the forks
        import_module(f"napari_shadowinv.{name}")
    for arguments in (("invert", FEW), ("fit", *HASTY)):  # to compile counts for no case
        outcome(partial(_command, arguments[0], "shot.npy", *arguments[1:]))
    for kind in parser.parse_args().only:
        outcomes = [outcome(case) for case in KINDS[kind]()]
        refused, accepted = (outcomes.count(text) for text in ("refused", "accepted"))
        failures[kind] = [
            f"{number}: {text}"
            for number, text in enumerate(outcomes)
            if text not in ("refused", "accepted")
        ]
        print(
            f"| {kind} | {len(outcomes)} | {refused} | {accepted} | {len(failures[kind])} |",
            flush=True,
        )
    for kind, texts in failures.items():
        print(*(f"{kind} {text}" for text in texts), sep="\n", file=sys.stderr)
    return 1 if any(failures.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
