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
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from typing import TYPE_CHECKING, Any, ParamSpec

import typer
from pydantic import ValidationError

from napari_shadowinv._system.machine import ENDING_SIGNALS, handling
from napari_shadowinv.errors import InputError, InversionCancelled

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from napari_shadowinv._system.progress import OnProgress, Progress

EXIT_FAILED_SHOTS = 1
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


def say(content: str | Table, style: str = "", *, on_stderr: bool = False) -> None:
    """Print a sentence or a table."""
    from rich.console import Console

    is_text = isinstance(content, str)
    text = plain(content, style) if is_text else content
    Console(stderr=on_stderr).print(text, soft_wrap=is_text, highlight=False)


def say_on_stderr(text: str, style: str = "bold red") -> None:
    """Print an error, or a warning in another style, in one line."""
    say(" ".join(text.split()), style, on_stderr=True)


@contextmanager
def work_callbacks(quiet: bool) -> Iterator[dict[str, Any]]:
    """Provide the callbacks of long work as keywords: a bar of its progress, and Ctrl-C."""
    with nullcontext() if quiet else progress_bar() as show:
        yield {"on_progress": show, "should_stop": is_interrupted}


@contextmanager
def progress_bar() -> Iterator[OnProgress | None]:
    """Show a bar for the stage of the work, on a terminal only."""
    from rich import progress as bar
    from rich.console import Console
    from rich.table import Column

    console = Console(stderr=True)
    if not console.is_terminal:
        yield None
        return
    flexible = Column(ratio=1, no_wrap=True, overflow="ellipsis")  # keeps the bar on one line
    columns = (
        bar.TextColumn("{task.description:<10}", markup=False),
        bar.BarColumn(bar_width=30),
        bar.TimeElapsedColumn(),
        bar.TimeRemainingColumn(),
        bar.TextColumn("{task.fields[message]}", style="dim", markup=False, table_column=flexible),
    )
    with bar.Progress(*columns, console=console, expand=True) as bars:
        task = bars.add_task("", total=None, message="")

        def show(progress: Progress) -> None:
            shares: Any = {"total": progress.total, "completed": progress.step}
            message = escape_invisible(progress.text)
            bars.update(task, description=progress.stage, message=message, **shares)

        yield show


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
