"""Pages of the documentation: their blocks, their commands, and what they show as printed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import matplotlib
import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "paper").glob("*.md"), *(ROOT / "docs").rglob("*.md")])
WRITTEN_PAGES = [page for page in PAGES if page.parent.name != "reference"]  # others are generated


def text_of(page: str) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def commands(text: str) -> list[str]:
    """The commands on lines of their own, without the name of the program."""
    return re.findall(r"^    shadowinv (.*)$", text, re.MULTILINE)


def run_python(text: str) -> dict[str, Any]:
    """Run all blocks of Python one after the other, without a screen, and return their names."""
    matplotlib.use("agg")
    names: dict[str, Any] = {"__name__": "page"}
    for block in blocks(text, "python"):
        exec(compile(block, "page", "exec", dont_inherit=True), names)
    return names


def assert_same_but_for_rounding(printed: str, shown: str) -> None:
    """Compare words exactly, and numbers to 5 per cent or two units of the last digit shown."""
    number = r"[-+]?\d+(?:\.\d+)?"
    assert re.sub(number, "#", printed).split() == re.sub(number, "#", shown).split()
    for actual, expected in zip(
        re.findall(number, printed), re.findall(number, shown), strict=True
    ):
        unit = 10.0 ** -len(expected.partition(".")[2])
        assert float(actual) == pytest.approx(float(expected), rel=0.05, abs=2 * unit)


def assert_rows_are_shown(printed: str, shown: str) -> None:
    """Compare a table of a page with the rows of an output that begin like its rows.

    The error of the solver depends on the machine.
    """
    expected = [re.sub(r"\s+", " ", row).strip() for row in shown.splitlines()]
    starts = tuple(re.split(r"\s{2,}", row.strip())[0] + " " for row in shown.splitlines())
    rows = [re.sub(r"\s+", " ", row).strip() for row in printed.splitlines()]
    both = ("\n".join(row for row in rows if row.startswith(starts)), "\n".join(expected))
    solver = r"solver (?:below )?[\d.]+ %"
    assert_same_but_for_rounding(*(re.sub(solver, "solver", text) for text in both))
