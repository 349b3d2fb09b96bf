"""What the README shows must work as it stands there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import tifffile
import xarray
from typer.testing import CliRunner

from napari_shadowinv import synthetic_image
from napari_shadowinv.cli import app
from napari_shadowinv.physics.phantoms import gaussian_blob

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


@pytest.fixture
def shot_folder(tmp_path, monkeypatch):
    source = 100 + 20 * np.random.default_rng(0).random((40, 50))
    image = synthetic_image(gaussian_blob((40, 50), 20.0, 6.0).displacement, source)
    tifffile.imwrite(tmp_path / "reference.tif", source.astype(np.float32))
    tifffile.imwrite(tmp_path / "shot.tif", image.astype(np.float32))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_python_example_makes_the_file_it_promises(shot_folder):
    names: dict[str, object] = {}
    for block in blocks("python"):
        exec(compile(block, "README.md", "exec"), names)
    result = names["result"]
    assert isinstance(result, xarray.Dataset)
    assert result.potential.attrs["units"] == "px²"
    peak = np.hypot(*names["inversion"].displacement).max()  # type: ignore[attr-defined]
    assert peak == pytest.approx(20 / 6 * np.exp(-0.5), rel=0.05)


def test_the_command_and_its_setup_file_work_as_shown(shot_folder):
    (setup,) = blocks("toml")
    (shot_folder / "setup.toml").write_text(setup, encoding="utf-8")
    command = re.search(r"^    (shadowinv invert .*)$", README, re.MULTILINE)
    assert command is not None
    result = CliRunner().invoke(app, command[1].split()[1:])
    assert result.exit_code == 0, result.output
    assert (shot_folder / "shot.shadowinv").exists()
    assert (shot_folder / "shot.png").read_bytes().startswith(b"\x89PNG")


def test_every_picture_and_page_that_it_links_to_exists():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        if not target.startswith("http"):
            assert (Path(__file__).parents[1] / target).exists(), target
