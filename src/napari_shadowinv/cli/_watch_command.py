"""The command `watch`: inversion of shots as they arrive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from napari_shadowinv.cli import _flags, _outputs
from napari_shadowinv.cli._inputs import recipe_for_shots
from napari_shadowinv.cli._stack_commands import HELP
from napari_shadowinv.cli._terminal import notify_errors, warn_of_setups
from napari_shadowinv.io.formats import NEW_SHOTS

_SETTLE_HELP = (
    "Seconds without a change after which a file is complete, where the system does not report "
    "that it was closed (network file systems, macOS, Windows)."
)
_FIT_HELP = (
    "Fit the forward model to each shot instead of inverting it, with the recipe's section [fit]."
)
EPILOG = """
[bold]Examples[/bold]
shadowinv watch shots --source reference.tif --out night.shadowinv.zarr
shadowinv watch shots --pattern '*.bmp' --channel mean --bin 2 --out night.shadowinv.zarr
shadowinv watch shots --source reference.tif --out night.shadowinv.zarr --idle 600

Press Ctrl-C to stop. The same command continues with the same store.

[bold]Exit codes[/bold]
0 all shots that arrived are done; 1 some failed, the others are written; 2 invalid input, or the
folder disappeared; 3 all done, but some did not converge or are not determined; 130 stopped
by Ctrl-C while files were waiting.
"""


@notify_errors
@_flags.takes_recipe
def watch(
    folder: Annotated[
        Path, typer.Argument(help="Folder in which the shots appear.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Output store: name.shadowinv.zarr.")],
    pattern: Annotated[
        str, typer.Option(help="File name pattern of the shots, in quotes.")
    ] = NEW_SHOTS,
    source: _flags.SourceFile = None,
    mask: _flags.MaskFile = None,
    source_mask: _flags.SourceMask = None,
    recipe: _flags.RecipeFile = None,
    save_recipe: _flags.SaveRecipe = None,
    setup: _flags.SetupFile = None,
    options: _flags.OptionsFile = None,
    fit: Annotated[bool, typer.Option("--fit", help=_FIT_HELP)] = False,
    channel: _flags.Channel = None,
    variable: _flags.Variable = None,
    clip_negative: _flags.ClipNegative = False,
    variables: Annotated[str | None, typer.Option(help=HELP["variables"])] = None,
    warm_start: Annotated[
        bool,
        typer.Option(
            "--warm-start/--no-warm-start", help="Initialise each shot from the previous one."
        ),
    ] = True,
    settle: Annotated[float, typer.Option(metavar="S", help=_SETTLE_HELP)] = 1.0,
    polling: Annotated[
        bool,
        typer.Option(
            "--polling",
            help="Poll the folder once a second instead of relying on file-system events.",
        ),
    ] = False,
    idle: Annotated[
        float | None,
        typer.Option(metavar="S", help="Stop after this many seconds without a new file."),
    ] = None,
    most: Annotated[
        int | None,
        typer.Option("--max-shots", metavar="N", help="Stop after N shots, done or failed."),
    ] = None,
    skip_existing: Annotated[
        bool,
        typer.Option("--skip-existing", help="Skip files that are in the folder at the start."),
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Discard an earlier run.")] = False,
    redo_failed: Annotated[
        bool, typer.Option("--redo-failed", help="Retry the failed shots of the store.")
    ] = False,
    quiet: _flags.Quiet = False,
    *,
    flags: dict[str, Any],
) -> None:
    """Invert or fit each new shot in a folder, and append it to a store."""
    from napari_shadowinv.cli._watch import run_watch

    chosen = recipe_for_shots(
        flags,
        recipe,
        options,
        setup,
        fit=fit,
        clip_negative=clip_negative,
        source=source,
        mask=mask,
        source_mask=source_mask,
    )
    if save_recipe is not None:
        _outputs.save_recipe(save_recipe, chosen, [recipe, setup, options], overwrite)
    if not quiet:
        warn_of_setups([(chosen.setup, None)])
    run_watch(
        folder,
        out,
        channel=channel,
        variable=variable,
        variables=variables,
        pattern=pattern,
        quiet=quiet,
        recipe=chosen,
        warm_start=warm_start,
        settle=settle,
        polling=polling,
        idle=idle,
        shots=most,
        skip_existing=skip_existing,
        overwrite=overwrite,
        redo_failed=redo_failed,
    )
