"""The command `shadowinv`: invert one shot or many, fit several, predict, look at files.

Every heavy import waits until a command needs it, so that ``--help`` and errors about bad input
appear at once.
"""

from __future__ import annotations

import os
import sys
from io import TextIOWrapper
from typing import Annotated

import typer

from napari_shadowinv import __version__
from napari_shadowinv.cli import (
    _analyse_command,
    _film_command,
    _fit_command,
    _forward_command,
    _plan_command,
    _shot_commands,
    _stack_commands,
)
from napari_shadowinv.cli._terminal import EXIT_MISTAKE

__all__ = ["app"]

app = typer.Typer(
    name="shadowinv",
    help="Retrieve deflection potentials and fields from shadowgrams and proton radiographs.",
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _show_version(is_requested: bool) -> None:
    if is_requested:
        typer.echo(f"shadowinv {__version__}")
        raise typer.Exit


@app.callback()
def main(
    ctx: typer.Context,
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Retrieve deflection potentials and fields from shadowgrams and proton radiographs."""
    # Figures go to files; an unknown backend would break the import of matplotlib.
    os.environ.pop("MPLBACKEND", None)
    if ctx.invoked_subcommand is None:
        typer.echo(ctx.get_help())
        raise typer.Exit(EXIT_MISTAKE)
    for stream in (sys.stdout, sys.stderr):
        # A terminal without ∫ or µ must not end a finished run with an error.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


app.command(epilog=_shot_commands.INVERT_EPILOG)(_shot_commands.invert)
app.command()(_shot_commands.rerun)
app.command(epilog=_fit_command.EPILOG)(_fit_command.fit)
app.command(epilog=_film_command.EPILOG)(_film_command.film)
app.command(epilog=_forward_command.EPILOG)(_forward_command.forward)
app.command(epilog=_analyse_command.EPILOG)(_analyse_command.analyse)
app.command(epilog=_plan_command.EPILOG)(_plan_command.plan)
app.command()(_shot_commands.info)
app.command()(_shot_commands.demo)
app.command(epilog=_stack_commands.BATCH_EPILOG)(_stack_commands.batch)
app.command(epilog=_stack_commands.WATCH_EPILOG)(_stack_commands.watch)
app.command()(_stack_commands.export)
app.command()(_stack_commands.movie)
