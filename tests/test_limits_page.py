"""The page "What limits my result?" must work as it stands there, with its numbers."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from napari_shadowinv import Instrument, invert, read
from napari_shadowinv.cli import app
from test_tutorials import assert_same_but_for_rounding, without_solver

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "limits.md").read_text(encoding="utf-8")


@pytest.fixture
def names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> dict[str, Any]:
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(block, "limits.md", "exec"), names)
    names["printed"] = capsys.readouterr().out
    return names


def share(inversion: Any) -> float:
    return 100 * float(inversion.errors.total.rms / inversion.errors.rms)


def test_the_blocks_print_what_the_page_shows(names):
    shown = "".join(re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL))
    assert_same_but_for_rounding(without_solver(names["printed"]), without_solver(shown))


def test_the_first_line_of_the_page_is_that_of_its_shot(names):
    (line,) = re.findall(r"^> (.*)$", PAGE, re.MULTILINE)
    assert line == str(names["result"].headline)


def test_the_commands_of_the_page_run(names):
    commands = re.findall(r"^    shadowinv (.*)$", PAGE, re.MULTILINE)
    assert len(commands) == 2
    for line in commands:
        run = CliRunner().invoke(app, shlex.split(line))
        assert run.exit_code == 0, run.output
    assert read("shot.shadowinv").attrs["verdict"] == "too uncertain"


def test_the_totals_of_the_tables_are_those_of_inversions(names):
    row = r"^\| .* \| .* \| `--set instrument\.([a-z_]+)=([\d.]+)` \| ([\d.]+) %"
    rows = re.findall(row, PAGE, re.MULTILINE)
    assert len(rows) == 9
    apart = invert(names["shot"], source=names["reference"])
    (total,) = re.findall(r"of another exposure \| .* \| ([\d.]+) %", PAGE)
    assert share(apart) == pytest.approx(float(total), rel=0.06)
    for name, value, total in rows:
        instrument = Instrument(**{"beam_rms": 0.0, name: float(value)})
        source = None if name == "beam_rms" else names["reference"]
        inversion = invert(names["shot"], source=source, instrument=instrument)
        assert share(inversion) == pytest.approx(float(total), rel=0.06), name
    for detector, total in re.findall(
        r"^\| `([A-Za-z0-9 -]+)` \| ([\d.]+) % \|", PAGE, re.MULTILINE
    ):
        instrument = Instrument.of(detector, beam_rms=0.005)
        inversion = invert(names["shot"], instrument=instrument)
        assert share(inversion) == pytest.approx(float(total), rel=0.06), detector
    sources = re.findall(r"([\d.]+) % for (?:an? )?`([A-Za-z -]+)`", PAGE)
    assert len(sources) == 4
    for total, source in sources:
        instrument = Instrument.of("film", source=source)
        inversion = invert(names["shot"], instrument=instrument)
        assert share(inversion) == pytest.approx(float(total), rel=0.06), source


def test_links_and_pages_exist():
    for target in re.findall(r"\]\((?!http)([^)#]+)(?:#[^)]*)?\)", PAGE):
        assert (DOCS / target).exists(), target
