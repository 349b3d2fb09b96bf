"""Compare the numbers that pages show with what the program prints now.

The Python blocks and commands of a page run in a temporary folder, with a shot and a reference.
Every line of a ``text`` block, and every comment behind a ``print``, must be printed with the same
words and numbers, to one unit of the last digit shown. Times, versions and the error of the solver
depend on the machine and are left out. What needs files that the page does not make is listed as
not run, and blocks of which less than half is printed as not compared.

    python docs/check_numbers.py                  # all pages
    python docs/check_numbers.py --prose README.md docs/limits.md
    python docs/check_numbers.py --files films docs/tutorials/film-pack.md

With ``--prose``, numbers of sentences that are neither in the page's code nor in what it prints are
listed for a look: other programs, benchmarks and older runs have such numbers, too.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from typer.testing import CliRunner

from napari_shadowinv import synthetic_image
from napari_shadowinv.cli import app
from napari_shadowinv.physics.phantoms import gaussian_blob

ROOT = Path(__file__).parents[1]
NUMBER = re.compile(r"(?<![\w.])[-+]?(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?(?:e[-+]?\d+)?")
EXEMPT = re.compile(r"(?<=solver )[\d.e-]+|\b[\d.]+(?= s\b)|\b\d+\.\d+\.\d+\b|\d{4}-\d\d-\d\d\S*")
MEASURED = re.compile(rf"({NUMBER.pattern})(?: ±| ?%| (?:px|[mµ]?T·?m|MG·?µm|σ|χ²|MeV|Gy))")
COMMENT = re.compile(r"^print\(.*\)  # (?!such as)(.*)$", re.MULTILINE)
PART = re.compile(
    r"```(?P<language>\w+)\n(?P<block>.*?)^```|^    (?P<command>shadowinv [^\n]*)$",
    re.DOTALL | re.MULTILINE,
)


@dataclass
class Page:
    """A page, what its blocks and commands print, and what does not agree with it."""

    path: Path
    names: dict[str, Any]
    text: str = ""
    printed: str = ""
    compared: int = 0
    disagreements: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)

    def place(self, offset: int) -> str:
        """Return file and line of a character."""
        return f"{self.path.name}:{self.text.count(chr(10), 0, offset) + 1}"


def write_shot(folder: Path) -> dict[str, Any]:
    """Write the shots and the reference that pages take for granted; return them as arrays."""
    source = 100 + 20 * np.random.default_rng(0).random((40, 50))
    image = synthetic_image(gaussian_blob((40, 50), 20.0, 6.0).displacement, source)
    tifffile.imwrite(folder / "reference.tif", source.astype(np.float32))
    (folder / "shots").mkdir()
    for name in ("shot", "shots/shot1", "shots/shot2"):
        tifffile.imwrite(folder / f"{name}.tif", image.astype(np.float32))
    return {"image": image, "source": source}


def check_page(path: Path) -> Page:
    """Run a page in the current folder, and compare what it shows with what is printed."""
    page = Page(path, write_shot(Path.cwd()), path.read_text(encoding="utf-8"))
    parts = list(PART.finditer(page.text))
    for part in reversed(parts):  # so that the first remains, until the page has another
        _write_input(page, part)
    for part in parts:
        language, start = part["language"], part.start("block")
        if part["command"]:
            _run_command(page, part["command"], part.start("command"))
        elif language == "toml":
            _write_input(page, part)
        elif language == "python":
            _run_python(page, part["block"], start)
            _compare(page, start, COMMENT.finditer(part["block"]))
        elif language == "text":
            _compare(page, start, re.finditer(r"^(.*\d.*)$", part["block"], re.MULTILINE))
    return page


def _write_input(page: Page, part: re.Match[str]) -> None:
    """Write a block of TOML, or a table, to the file that the page names last before it."""
    language, block = part["language"], part["block"] or ""
    ending = "csv" if language == "text" and ", " in block.partition("\n")[0] else language
    named = re.findall(rf"`([\w-]+\.{ending})`", page.text[: part.start()])
    if not named and ending == "toml":
        named = ["setup.toml"]
    if named and ending in ("csv", "toml"):
        Path(named[-1]).write_text(block, encoding="utf-8")
    if named[-1:] == ["setup.toml"]:  # the same experiment at another energy
        other = re.sub(r"energy = [\d.]+", "energy = 3.0", block)
        Path("other.toml").write_text(other, encoding="utf-8")


def _run_command(page: Page, line: str, offset: int) -> None:
    arguments = shlex.split(line, comments=True)[1:]
    if arguments[0] == "watch":
        arguments += ["--idle", "0.5"]
    run = CliRunner().invoke(app, arguments, env={"COLUMNS": "400"})
    page.printed += run.output
    if run.exit_code not in (0, 3):  # 3: the field is not determined
        page.left_out.append(f"not run: {page.place(offset)}: {' '.join(run.output.split())}")


def _run_python(page: Page, code: str, offset: int) -> None:
    output = io.StringIO()
    try:
        with contextlib.redirect_stdout(output):
            exec(compile(code, page.path.name, "exec"), page.names)
    except Exception as error:
        page.left_out.append(f"not run: {page.place(offset)}: {type(error).__name__}: {error}")
    page.printed += output.getvalue()


def _words(text: str) -> list[str]:
    return EXEMPT.sub("*", text).split()


def _compare(page: Page, offset: int, lines: Iterable[re.Match[str]]) -> None:
    """Compare shown lines with those printed, if these are most of them."""
    shown = [
        (page.place(offset + line.start()), excerpt.strip(" ;,"))
        for line in lines
        for excerpt in re.split(r"…|\.\.\.", line[1])
        if NUMBER.search(" ".join(_words(excerpt)))
    ]
    printed = _words(page.printed)
    found = [_wrong_numbers(_words(excerpt), printed) for _, excerpt in shown]
    if 2 * found.count(None) > len(found):
        page.left_out.append(f"not compared: {shown[0][0]}: little of it is printed")
        return
    page.compared += len(found)
    for (place, excerpt), wrong in zip(shown, found, strict=True):
        if wrong is None:
            page.disagreements.append(f"{place}: is not printed: {excerpt}")
        elif wrong:
            texts = (f"shows {number}, printed {value}" for number, value in wrong)
            page.disagreements.append(f"{place}: {', '.join(texts)}")


def _wrong_numbers(words: list[str], printed: list[str]) -> list[tuple[str, str]] | None:
    """Find words among those printed; return the numbers that differ, or None without the words."""
    key, forms = (f" {NUMBER.sub('#', ' '.join(each))} " for each in (words, printed))
    starts = [match.start() for match in re.finditer(f"(?={re.escape(key)})", forms)]
    firsts = [forms.count(" ", 0, start) for start in starts]
    lines = [" ".join(printed[first : first + len(words)]) for first in firsts]
    return min((list(_unequal(" ".join(words), line)) for line in lines), key=len, default=None)


def _unequal(shown: str, printed: str) -> Iterator[tuple[str, str]]:
    """Yield the numbers of two lines that differ by more than a unit of the last digit shown."""
    for number, value in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        if abs(_value(number) - _value(value)) > 1.01 * _unit(number):
            yield number, value


def _value(number: str) -> float:
    return float(number.replace(",", ""))


def _unit(number: str) -> float:
    """Return one unit of the last digit."""
    digits, _, exponent = number.partition("e")
    return float(10.0 ** (int(exponent or 0) - len(digits.partition(".")[2])))


def unprinted_numbers(page: Page) -> Iterator[str]:
    """Yield the measured numbers of sentences that the page neither states in code nor prints."""
    facts = [fact.text for each in page.names.values() for fact in getattr(each, "facts", ())]
    texts = [page.printed, *facts, *(part[0] for part in PART.finditer(page.text))]
    known = [_value(number) for number in NUMBER.findall(" ".join(texts))]
    prose = PART.sub(lambda part: "\n" * part[0].count("\n"), page.text)
    for line, sentence in enumerate(prose.splitlines(), 1):
        for number in [] if sentence.startswith("|") else MEASURED.findall(sentence):
            if all(abs(_value(number) - value) > 0.51 * _unit(number) for value in known):
                yield f"{page.path.name}:{line}: {number}: {sentence}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pages", nargs="*", type=Path, help="Markdown files; default: all")
    parser.add_argument("--files", type=Path, help="folder with files that a page needs")
    parser.add_argument("--prose", action="store_true", help="list numbers of sentences, too")
    choices = parser.parse_args()
    every = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md")), *sorted(ROOT.glob("docs/*/*.md"))]
    files = None if choices.files is None else choices.files.resolve()
    is_wrong = False
    for path in [each.resolve() for each in choices.pages or every]:
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            if files is not None:
                shutil.copytree(files, folder, dirs_exist_ok=True)
            page = check_page(path)
        is_wrong |= bool(page.disagreements)
        lines = [f"{os.path.relpath(path)}: {page.compared} lines compared", *page.disagreements]
        lines += [text[:200] for text in page.left_out]
        lines += [f"not printed: {text}" for text in unprinted_numbers(page) if choices.prose]
        print("\n  ".join(lines), flush=True)
    return int(is_wrong)


if __name__ == "__main__":
    sys.exit(main())
