"""Commands for many shots: `batch`, `watch`, `export`, `movie`."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Annotated, Any

from typer import Option

from napari_shadowinv.cli import _flags
from napari_shadowinv.cli._inputs import read_setup, recipe_from
from napari_shadowinv.cli._outputs import Outputs
from napari_shadowinv.cli._settings import (
    FILE_KEYS,
    INVERSION_SECTIONS,
    Sections,
    Settings,
    settings_of,
)
from napari_shadowinv.cli._terminal import notify_errors, say
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions

# Help of options, where it is longer than a line.
HELP = {
    "format": "tiff (float32, one file per shot and component), pradformat, csv (a row per shot).",
    "shots": "A quoted glob, a folder, files, a file of frames, an array of frames in HDF5, or a "
    "table (.csv) with a row per shot.",
    "workers": "Shots at once. Default: one per core.",
    "latest": "Invert the newest file next.",
    "idle": "Stop after SECONDS without a new file.",
    "variables": "For tiff: variables to export, separated by commas.",
    "variable": "Variable to show; for vectors, the magnitude. Default: the potential.",
    "limits": "Limits of the colour scale. Default: the range over all shots.",
    "out": "Output folder, or file for csv. Default: the store's name, in the current folder.",
}
BATCH_SECTIONS: Sections = {**INVERSION_SECTIONS, "run": RunOptions}
WATCH_SECTIONS: Sections = {**INVERSION_SECTIONS, "run": WatchOptions}
_EXAMPLE = "run.variables=weights"
Store = Annotated[Path, Option(help="Store: name.shadowinv.zarr.")]
BATCH_EPILOG = """
shadowinv batch 'shots/*.tif' --source reference.tif --out n.shadowinv.zarr

Exit codes: 0 all done; 1 some failed; 2 invalid input; 3 some are doubtful.
"""
WATCH_EPILOG = """
shadowinv watch shots --source reference.tif --out night.shadowinv.zarr

Press Ctrl-C to stop; the same command continues. Exit codes as for batch.
"""


def _stack_inputs(
    flags: _flags.InversionFlags, settings: Settings, outputs: Outputs
) -> dict[str, Any]:
    """Return the inputs of `batch` and `watch`."""
    recipe = recipe_from(flags, settings)
    if flags.setup is not None:
        recipe = recipe.model_copy(update={"setup": read_setup(flags.setup)})
    outputs.warn_of_setups([(recipe.setup, None)])
    return {"recipe": recipe, "channel": flags.channel, "quiet": outputs.quiet}


@notify_errors
@_flags.takes_flags
def batch(
    shots: Annotated[list[str], _flags.argument(help=HELP["shots"])],
    out: Store,
    flags: _flags.InversionFlags,
    outputs: Outputs,
    scheduler: Annotated[str, Option(help="threads, processes or tcp://host:8786.")] = "threads",
    workers: Annotated[int | None, Option(metavar="N", help=HELP["workers"])] = None,
    resume: Annotated[bool, Option("--resume", help="Continue a run, append new shots.")] = False,
    settings: Annotated[
        list[str] | None, _flags.setting(BATCH_SECTIONS, _EXAMPLE, FILE_KEYS)
    ] = None,
) -> None:
    """Invert many shots into one store; an interrupted run can be resumed."""
    from napari_shadowinv.cli._batch import run_batch

    run_keys = {"run.workers": ("--workers", workers)}
    chosen = settings_of(settings or (), BATCH_SECTIONS, flags.by_key | run_keys, FILE_KEYS)
    run = chosen.change("run", RunOptions(overwrite=outputs.overwrite))
    inputs = _stack_inputs(flags, chosen, outputs)
    run_batch(shots, out, run, resume=resume or run.redo_failed, scheduler=scheduler, **inputs)


@notify_errors
@_flags.takes_flags
def watch(
    folder: Annotated[Path, _flags.argument(help="Folder in which the shots appear.")],
    out: Store,
    flags: _flags.InversionFlags,
    outputs: Outputs,
    pattern: Annotated[str | None, Option(help="Names of the shots, in quotes.")] = None,
    latest: Annotated[bool, Option("--latest", help=HELP["latest"])] = False,
    idle: Annotated[float | None, Option(metavar="SECONDS", help=HELP["idle"])] = None,
    settings: Annotated[
        list[str] | None, _flags.setting(WATCH_SECTIONS, _EXAMPLE, FILE_KEYS)
    ] = None,
) -> None:
    """Invert each new shot in a folder, and append it to a store."""
    from napari_shadowinv.cli._batch import run_watch

    run_keys = {
        "run.pattern": ("--pattern", pattern),
        "run.latest": ("--latest", latest or None),
        "run.idle": ("--idle", idle),
    }
    chosen = settings_of(settings or (), WATCH_SECTIONS, flags.by_key | run_keys, FILE_KEYS)
    run = chosen.change("run", WatchOptions(overwrite=outputs.overwrite))
    run_watch(folder, out, run, **_stack_inputs(flags, chosen, outputs))


@notify_errors
@_flags.takes_flags
def export(
    store: _flags.StoreFolder,
    form: Annotated[str, Option("--format", metavar="tiff|pradformat|csv", help=HELP["format"])],
    outputs: Outputs,
    shots: _flags.ChosenShots = None,
    variables: Annotated[str, Option(help=HELP["variables"])] = "potential",
    out: Annotated[Path | None, Option(help=HELP["out"])] = None,
) -> None:
    """Write shots of a store in another format."""
    from napari_shadowinv.cli._export import export_shots
    from napari_shadowinv.io.formats import STORE, TABLE

    stem = store.name.removesuffix(STORE.suffix)
    target = Path(f"{stem}{TABLE.suffix}" if form == "csv" else stem) if out is None else out
    names = [name.strip() for name in variables.split(",")]
    written = export_shots(store, target, form, shots, names, outputs.overwrite)
    if not outputs.quiet:
        say(f"Wrote {target}: {len(written)} {'file' if len(written) == 1 else 'files'}")


@notify_errors
@_flags.takes_flags
def movie(
    store: _flags.StoreFolder,
    out: Annotated[Path, Option("--out", "-o", help="Output movie: .mp4 or .gif.")],
    outputs: Outputs,
    variable: Annotated[str | None, Option(help=HELP["variable"])] = None,
    shots: _flags.ChosenShots = None,
    rate: Annotated[float, Option(help="Shots per second.")] = 10.0,
    limits: Annotated[
        tuple[float, float] | None, Option(metavar="MIN MAX", help=HELP["limits"])
    ] = None,
) -> None:
    """Make a movie of a store, with all shots on one colour scale."""
    from napari_shadowinv.io import check_output
    from napari_shadowinv.io.store_shots import open_shots
    from napari_shadowinv.plotting import stack_frames, write_film

    if not 0.1 <= rate <= 120:
        raise InputError(f"--rate is {rate:g}: expected 0.1 to 120 shots per second")
    check_output(out, outputs.overwrite, suffixes=(".mp4", ".gif"))
    if out.suffix.lower() == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise FileFormatError(
            f"{out} needs the package imageio-ffmpeg: install it with pip install "
            "'napari-shadowinv[movie]', or write a .gif"
        )
    frames = stack_frames(open_shots(store, shots), variable, limits=limits)
    count = write_film(out, frames, rate, overwrite=outputs.overwrite)
    if not outputs.quiet:
        say(f"Wrote {out}: {count} shot{'s' * (count != 1)}, {count / rate:.1f} s")
