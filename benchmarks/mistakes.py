"""Share of mistakes, put into two versions of the package one at a time, that tests notice.

    git worktree add ../before COMMIT
    python benchmarks/mistakes.py ../before [--rooms inversion io …] [--each 4] [--seed 1]

Of each room, lines of functions that are the same in both versions are drawn, and one token of each
is changed: an operator, a comparison, a number, a truth value. The tests of that room then run in a
copy of each version until one fails. Tokens whose change makes no difference (of a sum to which
zero is added) are as likely in both, so that the difference of the counts is what tells. Tests that
fail without a mistake, as on other versions of libraries, are left out. It takes a minute or two
for a mistake and version.
"""

from __future__ import annotations

import argparse
import ast
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
import token
import tokenize
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

THIS = Path(__file__).resolve().parents[1]
ROOMS = (
    "analysis", "cli", "film", "fitting", "geometry", "inversion", "io", "physics",
    "preprocessing", "stack",
)  # fmt: skip
CHANGES = {
    "<": ">=", ">": "<=", "<=": ">", ">=": "<", "==": "!=", "!=": "==", "+": "-", "-": "+",
    "*": "/", "/": "*", "and": "or", "or": "and", "True": "False", "False": "True",
    "min": "max", "max": "min", "break": "continue",
}  # fmt: skip


class Mistake(NamedTuple):
    """One token of a line, changed; the line is in both versions once."""

    room: str
    file: str
    line: str
    changed: str

    def text(self) -> str:
        return f"{self.file}: {self.line.strip()} -> {self.changed.strip()}"


def mistakes_of(room: str, old: Path, count: int, rng: np.random.Generator) -> list[Mistake]:
    """Draw mistakes in a room, each in another file if there are as many."""
    found: dict[str, list[Mistake]] = {}
    package = "src/napari_shadowinv"
    for path in sorted((THIS / package / room).glob("*.py")):
        name = f"{package}/{room}/{path.name}"
        if not (old / name).is_file():
            continue
        text, before = path.read_text(), (old / name).read_text().splitlines()
        lines = text.splitlines()
        for number, at, new in changes_in(text):
            line = lines[number]
            if lines.count(line) == before.count(line) == 1 and line.startswith("    "):
                start, end = at
                changed = line[:start] + new + line[end:]
                found.setdefault(name, []).append(Mistake(room, name, line, changed))
    files = [str(name) for name in rng.permutation(sorted(found))]
    chosen = [files[k % len(files)] for k in range(count)]
    return [found[name][int(rng.integers(len(found[name])))] for name in chosen]


def changes_in(text: str) -> Iterator[tuple[int, tuple[int, int], str]]:
    """Yield line, columns and another text of each token that can be changed."""
    previous = ""
    for each in tokenize.generate_tokens(io.StringIO(text).readline):
        new = CHANGES.get(each.string)
        is_sign = each.string in ("+", "-", "*", "/") and (
            each.start[1] == len(each.line) - len(each.line.lstrip())
            or previous in ("(", "[", ",", "=", "return", ":", "*")
        )
        if each.type == token.NUMBER and previous not in ("[", ":"):
            is_whole = each.string.isdigit() or not ast.literal_eval(each.string)
            new = f"({each.string} + 1)" if is_whole else f"(2 * {each.string})"
        if new and not is_sign and each.type in (token.OP, token.NAME, token.NUMBER):
            yield each.start[0] - 1, (each.start[1], each.end[1]), new
        previous = each.string


def run_tests(room: str, checkout: Path, *options: str, minutes: float = 60) -> Any:
    """Run the tests of a room in a checkout; a `TimeoutExpired` if they take longer."""
    environment = {**os.environ, "PYTHONPATH": str(checkout / "src"), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    return subprocess.run(
        [*command, f"tests/{room}"],
        cwd=checkout,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60 * minutes,
        check=False,
    )


def failing_tests(room: str, checkout: Path) -> list[str]:
    """Return the functions of a room's tests that fail without a mistake."""
    printed = run_tests(room, checkout, "-rfE").stdout
    return sorted(set(re.findall(r"^(?:FAILED|ERROR) ([^ \[]+)", printed, re.MULTILINE)))


def is_noticed(mistake: Mistake, checkout: Path, failing: list[str], minutes: float) -> bool:
    """Return whether another test of the room fails in a checkout with the mistake."""
    path = checkout / mistake.file
    right = path.read_text()
    lines = right.splitlines(keepends=True)
    at = next(k for k, line in enumerate(lines) if line.rstrip("\n") == mistake.line)
    lines[at] = mistake.changed + "\n"
    path.write_text("".join(lines))
    left_out = [f"--deselect={name}" for name in failing]
    try:
        ended = run_tests(mistake.room, checkout, "-x", *left_out, minutes=minutes)
    except subprocess.TimeoutExpired:
        return True
    finally:
        path.write_text(right)
    return bool(ended.returncode)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path, help="a checkout of the other version")
    parser.add_argument("--rooms", nargs="+", choices=ROOMS, default=ROOMS)
    parser.add_argument("--each", type=int, default=4, help="mistakes in a room")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=15, help="after which it is noticed")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    counts = {"before": 0, "now": 0}
    drawn = [
        mistake
        for room in ROOMS
        for mistake in mistakes_of(room, arguments.old.resolve(), arguments.each, rng)
        if room in arguments.rooms
    ]
    with tempfile.TemporaryDirectory() as folder:
        copies = {}
        for version, checkout in (("before", arguments.old.resolve()), ("now", THIS)):
            copies[version] = Path(folder) / version
            ignored = shutil.ignore_patterns(".git", ".venv", "build", "dist")
            shutil.copytree(checkout, copies[version], ignore=ignored)
        failing = {
            (room, version): failing_tests(room, copy)
            for room in arguments.rooms
            for version, copy in copies.items()
        }
        for mistake in drawn:
            answers = {
                version: is_noticed(
                    mistake, copy, failing[mistake.room, version], arguments.minutes
                )
                for version, copy in copies.items()
            }
            for version, noticed in answers.items():
                counts[version] += noticed
            words = ", ".join(f"{each}: {'yes' if yes else 'NO'}" for each, yes in answers.items())
            print(f"{words} | {mistake.text()}", flush=True)
    print(f"noticed of {len(drawn)}: {counts['before']} before, {counts['now']} now")


if __name__ == "__main__":
    main()
