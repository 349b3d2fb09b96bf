"""A folder of its own for each test of a command, and the command that is refused there."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.command_line import content, flat, shadowinv


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # Ctrl-C changes it
    return tmp_path


@pytest.fixture
def refused(folder: Path) -> Callable[..., None]:
    """Run a command that must fail with one sentence and write nothing."""

    def run(*arguments: object, names: str | tuple[str, ...]) -> None:
        before = content(folder)
        result = shadowinv(*arguments)
        assert result.exit_code == 2, result.output
        (line,) = result.stderr.splitlines()
        for name in (names,) if isinstance(names, str) else names:
            assert name in flat(line)
        assert content(folder) == before

    return run
