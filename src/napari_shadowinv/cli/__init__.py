"""The command `shadowinv`: invert one shot or many, fit several, predict, look at files.

Every heavy import waits until a command needs it, so that ``--help`` and the refusal of a
mistake answer at once.
"""

from __future__ import annotations

import sys
from io import TextIOWrapper
from typing import Annotated

import typer

from napari_shadowinv import __version__
from napari_shadowinv.cli import (
    _film_command,
    _fit_command,
    _shot_commands,
    _stack_commands,
    _watch_command,
)

__all__ = ["app"]

app = typer.Typer(
    name="shadowinv",
    help="Shadowgrams and proton radiographs to deflection potentials and fields.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"shadowinv {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Show the version and exit."
        ),
    ] = False,
) -> None:
    """Shadowgrams and proton radiographs to deflection potentials and fields."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal that knows no ∫ or µ is no reason to fail after the work is done.
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


app.command(epilog=_shot_commands.INVERT_EPILOG)(_shot_commands.invert)
app.command()(_shot_commands.rerun)
app.command(epilog=_fit_command.EPILOG)(_fit_command.fit)
app.command(epilog=_film_command.EPILOG)(_film_command.film)
app.command(epilog=_shot_commands.FORWARD_EPILOG)(_shot_commands.forward)
app.command()(_shot_commands.info)
app.command()(_shot_commands.demo)
app.command(epilog=_stack_commands.BATCH_EPILOG)(_stack_commands.batch)
app.command(epilog=_watch_command.EPILOG)(_watch_command.watch)
app.command()(_stack_commands.status)
app.command()(_stack_commands.export)
app.command()(_stack_commands.movie)
