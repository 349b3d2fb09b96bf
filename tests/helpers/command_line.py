"""Helpers to run the command in tests."""

from __future__ import annotations

import os
import shlex
import signal
import textwrap
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from threading import Timer
from unittest.mock import patch

import typer.testing
from typer.main import get_command
from typer.testing import CliRunner, Result

from helpers.signals import start
from napari_shadowinv._system.progress import Progress
from napari_shadowinv.cli import app

# Built once: to build all flags takes longer than most of the commands.
typer.testing._get_command = cache(get_command)  # type: ignore[attr-defined]


def shadowinv(*arguments: object) -> Result:
    """Run the command in this process."""
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def done(*arguments: object, code: int = 0) -> str:
    """Run the command, which must end with a code, and return its output in one line."""
    result = shadowinv(*arguments)
    assert result.exit_code == code, result.output
    return flat(result.output)


def refused(*arguments: object, names: str | tuple[str, ...]) -> None:
    """Run a command that must fail with one sentence and write nothing in the current folder."""
    before = content(Path()), {*Path().rglob("*")}
    result = shadowinv(*arguments)
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    for name in (names,) if isinstance(names, str) else names:
        assert name in flat(line)
    assert (content(Path()), {*Path().rglob("*")}) == before


def run_line(line: str, *more: str, columns: int = 300) -> Result:
    """Run the command as a page shows it; it must succeed."""
    result = CliRunner().invoke(app, [*shlex.split(line), *more], env={"COLUMNS": str(columns)})
    assert result.exit_code == 0, f"{line}: {result.output}"
    return result


def undrawn(*arguments: object) -> Result:
    """Run the command in this process, and leave the pages of its figures blank."""
    with patch("matplotlib.figure.Figure.draw", lambda figure, renderer: None):
        return shadowinv(*arguments)


def flat(text: str) -> str:
    """Replace line breaks, which depend on the terminal, by spaces."""
    return " ".join(text.split())


def content(folder: Path) -> dict[str, bytes]:
    """Read all files of a folder."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@contextmanager
def pressing_ctrl_c(stage: str, pause: float = 0.0) -> Iterator[None]:
    """Press Ctrl-C a pause after a stage of the work of a command in this process has begun."""
    press = Timer(pause, lambda: os.kill(os.getpid(), signal.SIGINT))

    @contextmanager
    def bars() -> Iterator[Callable[[Progress], None]]:
        def show(progress: Progress) -> None:
            if progress.stage == stage and press.ident is None:
                press.start()

        yield show

    with patch("napari_shadowinv.cli._terminal.progress_bar", bars):
        yield
    press.join()


def interrupted(
    folder: Path, preparation: str, arguments: list[str], pause: float = 0.0
) -> tuple[int, str]:
    """Run the command in its own processes, and press Ctrl-C a pause after they have said "now"."""
    run = "\nfrom napari_shadowinv.cli import app\napp()\n"
    body = textwrap.dedent(preparation) + run
    process = start(body, *arguments, cwd=folder, start_new_session=True)
    try:
        time.sleep(pause)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    return process.returncode, errors
