"""A command on the terminal: what it prints, its progress, Ctrl-C, and how it ends.

Names and messages may come from files of others; a bracket in them is no markup, and an escape
sequence must not reach the terminal.
"""

from __future__ import annotations

import functools
import signal
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import typer
from pydantic import ValidationError

from napari_shadowinv._system.machine import ENDING_SIGNALS, handling
from napari_shadowinv.errors import InputError, InversionCancelled

if TYPE_CHECKING:
    from rich.progress import TaskID
    from rich.table import Table
    from rich.text import Text

    from napari_shadowinv._system.progress import OnProgress, Progress
    from napari_shadowinv.inversion import Inversion, Report
    from napari_shadowinv.preprocessing import Radiograph, Recipe

EXIT_MISTAKE = 2
EXIT_NOT_CONVERGED = 3

# Controls, invisible marks of direction, halves of characters, and ends of lines.
_UNSEEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
_ONE_WISH = 2.0  # seconds in which impatient fingers mean one and the same Ctrl-C

P = ParamSpec("P")

_ctrl_c = threading.Event()
_ending_signal: int = signal.SIGINT


def plain(text: object, style: str = "") -> Text:
    """Text to print as it is, without markup; what cannot be seen becomes a visible escape."""
    from rich.text import Text

    return Text(visible(text), style=style)


def visible(text: object) -> str:
    """Text in which characters that cannot be seen are escapes."""
    return "".join(
        character.encode("unicode_escape").decode()
        if unicodedata.category(character) in _UNSEEN
        else character
        for character in str(text)
    )


def say(content: str | Table) -> None:
    """Print a sentence or a table."""
    from rich.console import Console

    if isinstance(content, str):
        Console().print(plain(content), soft_wrap=True, highlight=False)
    else:
        Console().print(content, highlight=False)


def say_on_stderr(text: str) -> None:
    """Print what went wrong, in one line."""
    from rich.console import Console

    line = plain(" ".join(text.split()), "bold red")
    Console(stderr=True).print(line, soft_wrap=True, highlight=False)


def inverted(
    recipe: Recipe,
    shot: Radiograph,
    source: Radiograph | None = None,
    quiet: bool = False,
    **masks: Any,
) -> Inversion:
    """Apply a recipe to a shot; a mistake is told with the file's name."""
    from napari_shadowinv.pipeline import run

    with nullcontext() if quiet else progress_bars() as show:
        try:
            return run(
                recipe, shot, source=source, **masks, on_progress=show, should_stop=interrupted
            )
        except InputError as error:
            raise InputError(f"{shot.path}: {error}" if shot.path else str(error)) from error


@contextmanager
def progress_bars() -> Iterator[OnProgress | None]:
    """One bar for each stage, on a terminal only."""
    from rich import progress as bar
    from rich.console import Console
    from rich.table import Column

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    cut = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # so that a line stays one line
    columns = (
        bar.TextColumn("{task.description:<10}", markup=False),
        bar.BarColumn(bar_width=30),
        bar.TimeElapsedColumn(),
        bar.TextColumn("{task.fields[message]}", style="dim", markup=False, table_column=cut),
    )
    with bar.Progress(*columns, console=console, expand=True) as bars:
        tasks: dict[str, TaskID] = {}

        def finish_all() -> None:
            for task in tasks.values():
                bars.update(task, total=1, completed=1)
                bars.stop_task(task)

        def show(news: Progress) -> None:
            if news.stage not in tasks:
                finish_all()
                tasks[news.stage] = bars.add_task(news.stage, total=None, message="")
            task = tasks[news.stage]
            bars.update(task, total=news.total, completed=news.step, message=news.text)

        yield show
        finish_all()


def notify_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Turn a user's mistake into one sentence, and Ctrl-C into a word."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            with _noting_interrupts():
                command(*args, **kwargs)
        except typer.Exit:
            raise
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt | InversionCancelled) or (
                # Some libraries make another error of Ctrl-C.
                isinstance(error, Exception) and interrupted()
            ):
                code, text = cancelled_code(), "Cancelled"
            elif isinstance(error, OSError | MemoryError | InputError | ValidationError):
                code, text = EXIT_MISTAKE, str(error) or "There is not enough memory for this"
            else:
                raise  # a mistake of ours deserves its traceback
            with suppress(OSError):  # a terminal that was closed
                say_on_stderr(text)
            raise typer.Exit(code) from None

    return run


def alarm_unless_converged(report: Report, out: Path) -> None:
    """End with an exit code of its own if what was written is not to be trusted."""
    if not report.converged:
        say_on_stderr(
            f"NOT CONVERGED: {out} was written, but its flux residual is {report.residual:.2g} "
            f"(tolerance {report.tolerance:.2g}): do not trust the field"
        )
        raise typer.Exit(EXIT_NOT_CONVERGED)


def interrupted() -> bool:
    """Whether Ctrl-C was pressed since the command began; for `should_stop`."""
    return _ctrl_c.is_set()


def cancelled_code() -> int:
    """Return the exit code of a command that a signal has ended, as shells count."""
    return 128 + _ending_signal


@contextmanager
def _noting_interrupts() -> Iterator[None]:
    """Note Ctrl-C for `interrupted`, should compiled code swallow it, and raise it as usual.

    SIGTERM and SIGHUP count as Ctrl-C, so that nothing half written is left behind.
    """
    _ctrl_c.clear()
    pressed = float("-inf")
    global _ending_signal
    _ending_signal = signal.SIGINT

    def stop(number: int, frame: object) -> None:
        global _ending_signal
        nonlocal pressed
        _ctrl_c.set()
        _ending_signal = number
        if time.monotonic() < pressed + _ONE_WISH:
            return  # it would interrupt the clearing up after the first
        pressed = time.monotonic()
        # What is half made now complains when Python clears up.
        sys.unraisablehook = lambda _: None
        raise KeyboardInterrupt

    with handling(ENDING_SIGNALS, stop):
        yield
