"""Commands for many shots: `batch`, `watch`, `status`, `export`, `movie`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Exit, Option

from napari_shadowinv.cli import _flags, _inputs
from napari_shadowinv.cli._terminal import notify_errors, say, warn_of_setups
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions

# Help of options, where it is longer than a line.
HELP = {
    "source": "Image of the undisturbed beam; batch also takes a glob matching one image per "
    "shot. Default: uniform.",
    "scheduler": "threads, processes, or the address of a dask scheduler (tcp://host:8786).",
    "format": "tiff (float32, one file per shot and component), pradformat or openpmd (one file "
    "per shot), or csv (a table with a row per shot).",
    "shots": "A quoted glob, a folder, a list of files, a file with many frames (multi-page TIFF, "
    "NPY, SPE, MATLAB), an array of frames in HDF5 (run.h5::/entry/data/data), or a table (.csv) "
    "of images with one row per shot.",
    "fit": "Fit the forward model to each shot instead of inverting it, with the recipe's section "
    "[fit]; table rows with the same shot are images of one object.",
    "resume": "Resume an interrupted run and append new shots.",
    "verify": "Read all files and compare their checksums; exit code 1 if any is damaged.",
    "variables": "For tiff: variables to export, separated by commas.",
    "variable": "Variable to show; for vectors, the magnitude. Default: the potential.",
    "limits": "Limits of the colour scale. Default: the range over all shots.",
    "out": "Output folder, or file for csv. Default: the store's name, in the current folder.",
}
BATCH_EPILOG = """
[bold]Examples[/bold]
shadowinv batch 'shots/*.tif' --source reference.tif --out night.shadowinv.zarr
shadowinv batch 'shots/*.tif' --source reference.tif --out night.shadowinv.zarr --resume
shadowinv batch 'shots/*.tif' --source-from polynomial --low-pass 1 --out night.shadowinv.zarr
shadowinv batch movie.tif --out movie.shadowinv.zarr --scheduler tcp://head:8786
shadowinv batch run.h5::/entry/data/data --out run.shadowinv.zarr
shadowinv batch pack.csv --setup setup.toml --out pack.shadowinv.zarr
shadowinv batch shots.csv --fit --recipe recipe.toml --out fits.shadowinv.zarr

[bold]pack.csv[/bold] (one inversion per row; flags apply where a cell is empty)
file, energy, brightness, mask, exclude
film1.tif, 4.3, 1, mask1.png,
film2.tif, 6.1, 1.2, mask2.png,
film3.tif, 7.6, 0.8, , yes
Columns: file, setup, energy (MeV) or wavelength (m), brightness, mask, source, exclude.

[bold]shots.csv[/bold] (one fit per shot; other columns as for shadowinv fit)
shot, file, energy, setup
7, shot7_low.tif, 14.7, setup.toml
7, shot7_high.tif, 30, setup.toml

[bold]Exit codes[/bold]
0 all done; 1 some shots failed, the others are written; 2 invalid input;
3 all done, but some did not converge or are not determined; 130 cancelled, continue with --resume.
"""
WATCH_EPILOG = """
[bold]Examples[/bold]
shadowinv watch shots --source reference.tif --out night.shadowinv.zarr
shadowinv watch shots --pattern '*.bmp' --channel mean --bin 2 --out night.shadowinv.zarr
shadowinv watch shots --source reference.tif --out night.shadowinv.zarr --idle 600
shadowinv watch shots --latest --status-file status.json --out night.shadowinv.zarr

Press Ctrl-C to stop. The same command continues with the same store.

[bold]Exit codes[/bold]
0 all shots that arrived are done; 1 some failed, the others are written; 2 invalid input, or the
folder disappeared; 3 all done, but some did not converge or are not determined; 130 stopped
by Ctrl-C while files were waiting.
"""


def _stack_inputs(
    source: Annotated[Path | None, Option(help=HELP["source"])] = None,
    mask: _flags.MaskFile = None,
    source_mask: _flags.SourceMask = None,
    recipe: _flags.RecipeFile = None,
    save_recipe: _flags.SaveRecipe = None,
    setup: _flags.SetupFile = None,
    options: _flags.OptionsFile = None,
    fit: Annotated[bool, Option("--fit", help=HELP["fit"])] = False,
    channel: _flags.Channel = None,
    variable: _flags.Variable = None,
    clip_negative: _flags.ClipNegative = False,
    quiet: _flags.Quiet = False,
    *,
    run: RunOptions | WatchOptions,
    flags: dict[str, Any],
) -> dict[str, Any]:
    """Return the inputs of `batch` and `watch`, and save their recipe."""
    from napari_shadowinv.pipeline.files import setup_from, write_recipe

    files: dict[str, Any] = {"source": source, "mask": mask, "source_mask": source_mask}
    chosen = _inputs.recipe_from(flags, recipe, options, clip_negative=clip_negative, **files)
    if fit or chosen.fit is not None:
        chosen = _inputs.fit_recipe(chosen, flags, options, clip_negative=clip_negative)
    if setup is not None:
        chosen = chosen.model_copy(update={"setup": setup_from(setup)})
    if save_recipe is not None:
        _inputs.check_outputs([(save_recipe, (".toml",))], run.overwrite)
        _inputs.protect([save_recipe], [recipe, setup, options])
        _inputs.protect_files_of(chosen, [save_recipe])
        write_recipe(save_recipe, chosen, overwrite=run.overwrite)
    if not quiet:
        warn_of_setups([(chosen.setup, None)])
    from napari_shadowinv.stack import read_shot

    # A reader is part of a store's identity: only a variable that is there names itself.
    named: dict[str, Any] = {} if variable is None else {"variable": variable}
    reader = partial(read_shot, channel=channel, **named)
    return {"recipe": chosen, "reader": reader, "quiet": quiet}


@notify_errors
@_flags.takes_run(RunOptions, _stack_inputs)
def batch(
    shots: Annotated[list[str], _flags.argument(help=HELP["shots"])],
    out: Annotated[Path, Option(help="Output store: name.shadowinv.zarr.")],
    scheduler: Annotated[str, Option(help=HELP["scheduler"])] = "threads",
    resume: Annotated[bool, Option("--resume", help=HELP["resume"])] = False,
    *,
    run: RunOptions,
    **inputs: Any,
) -> None:
    """Invert or fit many shots into one store; an interrupted run can be resumed."""
    from napari_shadowinv.cli._batch import run_batch

    resume = resume or run.redo_failed
    run_batch(shots, out, run, resume=resume, scheduler=scheduler, **inputs)


@notify_errors
@_flags.takes_run(WatchOptions, _stack_inputs)
def watch(
    folder: Annotated[Path, _flags.argument(help="Folder in which the shots appear.")],
    out: Annotated[Path, Option(help="Output store: name.shadowinv.zarr.")],
    *,
    run: WatchOptions,
    **inputs: Any,
) -> None:
    """Invert or fit each new shot in a folder, and append it to a store."""
    from napari_shadowinv.cli._batch import run_watch

    run_watch(folder, out, run, **inputs)


@notify_errors
def status(
    store: _flags.StoreFolder,
    every: Annotated[bool, Option("--all", help="Show one line per shot.")] = False,
    verify: Annotated[bool, Option("--verify", help=HELP["verify"])] = False,
) -> None:
    """Show which shots of a store are done, pending, failed or damaged, and why."""
    from napari_shadowinv.cli._batch import EXIT_FAILED_SHOTS, status_tables

    tables, is_damaged = status_tables(store, every, verify)
    for table in tables:
        say(table)
    if verify and is_damaged:
        raise Exit(EXIT_FAILED_SHOTS)


@notify_errors
def export(
    store: _flags.StoreFolder,
    form: Annotated[str, Option("--format", metavar="tiff|pradformat|…", help=HELP["format"])],
    shots: _flags.ChosenShots = None,
    variables: Annotated[str, Option(help=HELP["variables"])] = "potential",
    out: Annotated[Path | None, Option(help=HELP["out"])] = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Write shots of a store in another format."""
    from napari_shadowinv.cli._export import export_shots
    from napari_shadowinv.io.formats import SITES, STORE

    stem = store.name.removesuffix(STORE.suffix)
    target = Path(f"{stem}{SITES.suffix}" if form == "csv" else stem) if out is None else out
    names = [name.strip() for name in variables.split(",")]
    written = export_shots(store, target, form, shots, names, overwrite)
    if not quiet:
        say(f"Wrote {target}: {len(written)} {'file' if len(written) == 1 else 'files'}")


@notify_errors
def movie(
    store: _flags.StoreFolder,
    out: Annotated[Path, Option("--out", "-o", help="Output movie: .mp4 or .gif.")],
    variable: Annotated[str | None, Option(help=HELP["variable"])] = None,
    shots: _flags.ChosenShots = None,
    rate: Annotated[float, Option(help="Shots per second.")] = 10.0,
    limits: Annotated[
        tuple[float, float] | None, Option(metavar="MIN MAX", help=HELP["limits"])
    ] = None,
    overwrite: _flags.Overwrite = False,
    quiet: _flags.Quiet = False,
) -> None:
    """Make a movie of a store, with all shots on one colour scale."""
    from napari_shadowinv.cli._export import write_movie

    frames = write_movie(store, out, variable, shots, rate, limits, overwrite)
    if not quiet:
        say(f"Wrote {out}: {frames} shots, {frames / rate:.1f} s")
