"""How a command ends when it does not end well: mistakes, Ctrl-C, no convergence."""

from __future__ import annotations

import functools
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec

import typer

from napari_shadowinv.cli._terminal import say_on_stderr
from napari_shadowinv.errors import InputError, InversionCancelled

if TYPE_CHECKING:
    from napari_shadowinv.inversion import Report

EXIT_MISTAKE = 2
EXIT_NOT_CONVERGED = 3
EXIT_CANCELLED = 130

_ONE_WISH = 2.0  # seconds in which impatient fingers mean one and the same Ctrl-C

P = ParamSpec("P")

_ctrl_c = threading.Event()


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
            if _is_cancelled(error):
                code, text = EXIT_CANCELLED, "Cancelled"
            elif isinstance(error, OSError | MemoryError) or _is_mistake(error):
                code, text = EXIT_MISTAKE, str(error) or "There is not enough memory for this"
            else:
                raise
            say_on_stderr(text)
            raise typer.Exit(code) from None

    return run


def _is_cancelled(error: BaseException) -> bool:
    """Tell Ctrl-C from a failure; some libraries make another error of it."""
    if isinstance(error, KeyboardInterrupt | InversionCancelled):
        return True
    return isinstance(error, Exception) and interrupted()


def _is_mistake(error: BaseException) -> bool:
    """Tell a user's mistake from one of ours, which deserves its traceback."""
    from pydantic import ValidationError

    return isinstance(error, InputError | ValidationError)


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


@contextmanager
def _noting_interrupts() -> Iterator[None]:
    """Note Ctrl-C for `interrupted`, and raise the interrupt as usual.

    Should a callback of compiled code swallow it, the core still stops at its next step.
    """
    _ctrl_c.clear()
    pressed = float("-inf")
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: object) -> None:
        nonlocal pressed
        _ctrl_c.set()
        if time.monotonic() < pressed + _ONE_WISH:
            return  # it would interrupt the clearing up after the first
        pressed = time.monotonic()
        # What is half made now complains when Python clears up.
        sys.unraisablehook = lambda _: None
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
