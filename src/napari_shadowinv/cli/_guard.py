"""How a command ends when it does not end well: mistakes, Ctrl-C, no convergence."""

from __future__ import annotations

import functools
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec

import typer

from napari_shadowinv.errors import InputError, InversionCancelled

if TYPE_CHECKING:
    from napari_shadowinv.inversion import Report

EXIT_MISTAKE = 2
EXIT_NOT_CONVERGED = 3
EXIT_CANCELLED = 130

P = ParamSpec("P")


def guarded(command: Callable[P, None]) -> Callable[P, None]:
    """Turn a user's mistake into one sentence, and Ctrl-C into a word."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except (KeyboardInterrupt, InversionCancelled):
            _say_on_stderr("Cancelled")
            raise typer.Exit(EXIT_CANCELLED) from None
        except (OSError, MemoryError) as error:
            _say_on_stderr(str(error) or "There is not enough memory for this")
            raise typer.Exit(EXIT_MISTAKE) from None
        except ValueError as error:
            if not _is_mistake(error):
                raise
            _say_on_stderr(str(error))
            raise typer.Exit(EXIT_MISTAKE) from None

    return run


def _is_mistake(error: ValueError) -> bool:
    """Tell a user's mistake from one of ours, which deserves its traceback."""
    from pydantic import ValidationError

    return isinstance(error, InputError | ValidationError)


def _say_on_stderr(text: str) -> None:
    from rich.console import Console
    from rich.text import Text

    line = " ".join(text.split())
    Console(stderr=True).print(Text(line, style="bold red"), soft_wrap=True)


def alarm_unless_converged(report: Report, out: Path) -> None:
    """End with an exit code of its own if what was written is not to be trusted."""
    if not report.converged:
        _say_on_stderr(
            f"NOT CONVERGED: {out} is written, but its flux residual is {report.residual:.2g} "
            f"where {report.tolerance:.2g} was asked for: do not trust the field"
        )
        raise typer.Exit(EXIT_NOT_CONVERGED)


@contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Yield a `should_stop` that Ctrl-C makes true.

    The interrupt is raised as usual, too; should a callback of compiled code swallow it,
    the core still stops at its next step.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def stop(number: int, frame: object) -> None:
        asked.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)
