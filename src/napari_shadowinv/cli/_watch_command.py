"""The command `watch`: inversion of shots as they arrive."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from napari_shadowinv.cli import _flags, _inputs
from napari_shadowinv.cli._inputs import recipe_for_shots
from napari_shadowinv.cli._terminal import notify_errors, warn_of_setups
from napari_shadowinv.pipeline.run_options import WatchOptions

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
@_flags.takes_run(WatchOptions)
def watch(
    folder: Annotated[
        Path, typer.Argument(help="Folder in which the shots appear.", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Output store: name.shadowinv.zarr.")],
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
    quiet: _flags.Quiet = False,
    *,
    flags: dict[str, Any],
) -> None:
    """Invert or fit each new shot in a folder, and append it to a store."""
    from napari_shadowinv.cli._watch import run_watch

    watch_options = _flags.run_options(WatchOptions, flags)
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
        _inputs.save_recipe(save_recipe, chosen, [recipe, setup, options], watch_options.overwrite)
    if not quiet:
        warn_of_setups([(chosen.setup, None)])
    run_watch(folder, out, chosen, watch_options, channel=channel, variable=variable, quiet=quiet)
