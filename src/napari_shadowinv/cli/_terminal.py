"""Terminal of a command: messages, progress bars, Ctrl-C and exit codes.

Names and messages may come from untrusted files: a bracket in them is not markup, and an escape
sequence must not reach the terminal.
"""

from __future__ import annotations

import functools
import signal
import sys
import time
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec

import typer
from pydantic import ValidationError

from napari_shadowinv._system.machine import ENDING_SIGNALS, handling
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.facts import ResultKind, to_figures
from napari_shadowinv.physics.beam import setup_warnings

if TYPE_CHECKING:
    from rich.progress import TaskID
    from rich.table import Table
    from rich.text import Text

    from napari_shadowinv._system.progress import OnProgress, Progress
    from napari_shadowinv.fitting import LeaveOneOut
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Recipe
    from napari_shadowinv.shot import Shot

EXIT_MISTAKE = 2
EXIT_NOT_CONVERGED = 3

# Control characters, marks of direction, lone surrogates, and ends of lines.
_INVISIBLE_CATEGORIES = {"Cc", "Cf", "Cs", "Zl", "Zp"}
_REPEAT_S = 2.0  # repeated presses of Ctrl-C within this time count once

P = ParamSpec("P")

_ending_signal: int | None = None  # that has come since the command began


def plain(text: object, style: str = "") -> Text:
    """Return text to print without markup, with invisible characters escaped."""
    from rich.text import Text

    return Text(escape_invisible(text), style=style)


def escape_invisible(text: object) -> str:
    """Replace invisible characters by escape sequences."""
    return "".join(
        character.encode("unicode_escape").decode()
        if unicodedata.category(character) in _INVISIBLE_CATEGORIES
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


def say_on_stderr(text: str, style: str = "bold red") -> None:
    """Print an error, or a warning in another style, in one line."""
    from rich.console import Console

    line = plain(" ".join(text.split()), style)
    Console(stderr=True).print(line, soft_wrap=True, highlight=False)


def invert_shot(recipe: Recipe, shot: Shot, quiet: bool = False) -> Inversion:
    """Apply a recipe to a shot; errors name the file."""
    from napari_shadowinv.pipeline import run

    with work_callbacks(quiet) as callbacks:
        try:
            return run(recipe, shot, **callbacks)
        except InputError as error:
            if shot.path is None:
                raise
            raise error.about(shot.path) from error


def warn_of_setups(
    experiments: Iterable[tuple[Setup | None, tuple[int, int] | None]],
) -> tuple[str, ...]:
    """Print and return the doubts about setups and their images' shapes, before the work begins."""
    texts = dict.fromkeys(
        caution.text
        for setup, shape in experiments
        if setup is not None
        for caution in setup_warnings(setup, shape)
    )
    for text in texts:
        say_on_stderr(text, "yellow")
    return tuple(texts)


@contextmanager
def work_callbacks(quiet: bool) -> Iterator[dict[str, Any]]:
    """Provide the callbacks of long work as keywords: bars of its progress, and Ctrl-C."""
    with nullcontext() if quiet else progress_bars() as show:
        yield {"on_progress": show, "should_stop": is_interrupted}


@contextmanager
def progress_bars() -> Iterator[OnProgress | None]:
    """Show a bar for each stage, on a terminal only."""
    from rich import progress as bar
    from rich.console import Console
    from rich.table import Column

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    flexible = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # keeps each bar on one line
    columns = (
        bar.TextColumn("{task.description:<10}", markup=False),
        bar.BarColumn(bar_width=30),
        bar.TimeElapsedColumn(),
        bar.TextColumn("{task.fields[message]}", style="dim", markup=False, table_column=flexible),
    )
    with bar.Progress(*columns, console=console, expand=True) as bars:
        tasks: dict[str, TaskID] = {}

        def finish_all() -> None:
            for task in tasks.values():
                bars.update(task, total=1, completed=1)
                bars.stop_task(task)

        def show(progress: Progress) -> None:
            if progress.stage not in tasks:
                finish_all()
                tasks[progress.stage] = bars.add_task(progress.stage, total=None, message="")
            task = tasks[progress.stage]
            bars.update(task, total=progress.total, completed=progress.step, message=progress.text)

        yield show
        finish_all()


def notify_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Print bad input as one sentence and Ctrl-C as one word, with an exit code."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            with _handle_interrupts():
                command(*args, **kwargs)
        except typer.Exit:
            raise
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt | InversionCancelled) or (
                # Some libraries convert Ctrl-C to another error.
                isinstance(error, Exception) and is_interrupted()
            ):
                code, text = cancel_exit_code(), "Cancelled"
            elif isinstance(error, OSError | MemoryError | InputError | ValidationError):
                code, text = EXIT_MISTAKE, str(error) or "There is not enough memory for this"
                if option := getattr(error, "option", ""):
                    flag = f"set {option}" if "." in option else option.replace("_", "-")
                    text = f"{text} (--{flag})"
            else:
                raise  # a bug deserves its traceback
            with suppress(OSError):  # the terminal was closed
                say_on_stderr(text)
            raise typer.Exit(code) from None

    return run


def exit_unless_sound(result: Any, out: Path, left_out: LeaveOneOut | None = None) -> None:
    """Exit with an error code if an inversion did not converge or a fit is doubtful.

    Also if a static field does not explain an image that was left out.
    """
    is_inversion = result.kind is ResultKind.INVERSION
    # Of a fit; a film pack has none.
    verdict: Any = None if is_inversion else getattr(result, "verdict", None)
    if left_out is not None and not left_out.explained.all():
        text = f"NOT STATIC: {out} was written, but {left_out.explanation}"
    elif is_inversion and not result.report.converged:
        report = result.report
        text = (
            f"NOT CONVERGED: {out} was written, but its flux residual is "
            f"{to_figures(report.residual)} (tolerance {to_figures(report.tolerance)}): do not "
            "trust the field"
        )
    elif verdict is not None and not verdict.level.is_success:
        text = f"{verdict.upper()}: {out} was written, but {result.explanation}"
    elif doubts := [each.text for each in result.cautions if each.code == "samples"]:
        text = f"UNRELIABLE ERROR BARS: {out} was written, but {doubts[0]}"
    else:
        return
    say_on_stderr(text)
    raise typer.Exit(EXIT_NOT_CONVERGED)


def is_interrupted() -> bool:
    """Whether Ctrl-C was pressed since the command began, as `should_stop`."""
    return _ending_signal is not None


def cancel_exit_code() -> int:
    """Return the exit code of a command that a signal has ended: 128 and its number."""
    return 128 + (_ending_signal or signal.SIGINT)


@contextmanager
def _handle_interrupts() -> Iterator[None]:
    """Record Ctrl-C for `is_interrupted`, as compiled code may swallow it, and raise it."""
    global _ending_signal
    _ending_signal = None
    pressed = float("-inf")

    def stop(number: int, frame: object) -> None:
        global _ending_signal
        nonlocal pressed
        _ending_signal = number
        if time.monotonic() < pressed + _REPEAT_S:
            return  # it would interrupt the clean-up after the first
        pressed = time.monotonic()
        # Half-made objects would print errors when Python exits.
        sys.unraisablehook = lambda _: None
        raise KeyboardInterrupt

    # SIGTERM and SIGHUP count as Ctrl-C, so that no half-written file remains.
    with handling(ENDING_SIGNALS, stop):
        yield
