"""What the README shows must work as it stands there."""

from __future__ import annotations

import importlib
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray
from typer.testing import CliRunner

from napari_shadowinv import read
from napari_shadowinv.cli import app
from napari_shadowinv.physics.setup import SPECIES, setup_from_dict

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


@pytest.fixture
def shot_folder(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "docs")
    monkeypatch.chdir(tmp_path)
    importlib.import_module("check_numbers").write_shot(tmp_path)
    return tmp_path


def test_the_python_example_prints_the_field_with_its_error(shot_folder, capsys):
    names: dict[str, Any] = {}
    (block,) = blocks("python")
    exec(compile(block, "README.md", "exec"), names)
    printed = capsys.readouterr().out
    (shown,) = re.findall(r"print\(.*# (.*) …", block)
    assert shown in printed  # a peak with its error, in µT·m, and what it depends on
    field = float(np.hypot(*names["field"]).max())
    assert float(shown.split()[-6]) == pytest.approx(1e6 * field, abs=0.05)
    result = names["result"]
    assert isinstance(result, xarray.Dataset)
    assert result.potential.attrs["units"] == "pixel**2"
    peak = np.hypot(*names["inversion"].displacement).max()
    assert peak == pytest.approx(20 / 6 * np.exp(-0.5), rel=0.05)


STEP = re.compile(
    r"```python\n(?P<python>.*?)```|^    shadowinv (?P<line>[^\n]*)$"
    r"|`shadowinv (?P<inline>[^`\n]*)`",
    re.DOTALL | re.MULTILINE,
)
LEFT_TO_THE_READER = {"info FILE": "info shot.shadowinv"}


def steps() -> list[tuple[str, str]]:
    """The commands and the Python of the README, from the top to the bottom."""
    steps = []
    for match in STEP.finditer(README):
        kind = "python" if match["python"] else "command"
        text = match["python"] or match["line"] or match["inline"]
        steps.append((kind, LEFT_TO_THE_READER.get(text, text)))
    return steps


def test_commands_and_python_work_one_after_the_other_in_one_folder(shot_folder):
    (setup,) = blocks("toml")
    (shot_folder / "setup.toml").write_text(setup, encoding="utf-8")
    slow_setup = setup.replace("14.7", "3.0")  # "at another energy"
    (shot_folder / "other.toml").write_text(slow_setup, encoding="utf-8")
    done = []
    for kind, text in steps():
        if kind == "python":
            exec(compile(text, "README.md", "exec"), {})
        else:
            # One process is enough, and starts at once.
            result = CliRunner().invoke(app, shlex.split(text))
            assert result.exit_code == 0, f"{text}: {result.output}"
            done.append(shlex.split(text)[0])
    assert done == ["invert", "info", "forward", "batch", "info"]
    assert (shot_folder / "shot.png").read_bytes().startswith(b"\x89PNG")
    assert read("shot.shadowinv").potential.attrs["units"] == "pixel**2"
    image = tifffile.imread("shot_image.tif")
    assert image.shape == (40, 50)
    assert xarray.open_zarr("night.shadowinv.zarr", consolidated=False).sizes["shot"] == 2


def test_a_setup_for_electrons_is_as_the_readme_says(tmp_path):
    (setup,) = blocks("toml")
    said = re.search(r"`(kind = .*?)`.*`(species = .*?)`", README)
    assert said is not None
    written = re.sub("^kind.*$", f"{said[1]}\n{said[2]}", setup, flags=re.MULTILINE)
    assert setup_from_dict(tomllib.loads(written)).particle == SPECIES["electron"]


def test_every_picture_and_page_that_it_links_to_exists():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (Path(__file__).parents[1] / target).exists(), target
