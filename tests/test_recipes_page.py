"""What the page about recipes shows must work as it stands there."""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from napari_shadowinv import Recipe, read, run, synthetic_image
from napari_shadowinv.cli import app
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import read_recipe
from napari_shadowinv.preprocessing import ESTIMATES, STEPS, MeasuredSource

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "recipes.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^    shadowinv (.*)$", PAGE, re.MULTILINE)
WHOLE, STEPS_SHOWN = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    image = 300 * synthetic_image(gaussian_blob((60, 80), 20.0, 6.0).displacement)
    image = np.random.default_rng(0).poisson(image).astype(np.float32)
    (tmp_path / "shots").mkdir()
    for name in ("shot", "other", "shots/a", "shots/b"):
        tifffile.imwrite(f"{name}.tif", image)
    bare = np.full(image.shape, 255, np.uint8)
    iio.imwrite("usable.png", bare)
    bare[20:40, 30:50] = 0
    iio.imwrite("bare.png", bare)
    return tmp_path


def test_the_file_is_a_recipe_that_works(folder):
    (folder / "page.toml").write_text(WHOLE, encoding="utf-8")
    inversion = run(read_recipe(folder / "page.toml"), "shot.tif")
    assert inversion.image.shape == (26, 40)
    assert inversion.setup.detector_pixel_size == pytest.approx(290e-6)
    assert inversion.options.n_sites == 500


def test_each_step_and_each_source_is_shown_once_with_all_that_it_takes():
    steps = tomllib.loads(STEPS_SHOWN)["steps"]
    assert [each["step"] for each in steps] == list(STEPS)
    for each in steps:
        assert set(each) == {"step", *STEPS[each["step"]].parameters()}
    Recipe.model_validate({"steps": steps})
    rows = dict(re.findall(r"^\| `([a-z-]+)` \| (.*)\|$", PAGE, re.MULTILINE))
    models = {MeasuredSource.name(): MeasuredSource, **ESTIMATES}
    assert set(rows) == set(models)
    for name, model in models.items():
        assert set(model.parameters()) == set(re.findall(r"`([a-z_]+)[` ]", rows[name]))
        for parameter, field in model.parameters().items():
            default = re.search(rf"`{parameter} = ([\d.]+|\".*?\")`", rows[name])
            if default is not None and model is not MeasuredSource:
                assert tomllib.loads(f"it = {default[1]}")["it"] == field.default


def test_the_order_of_steps_is_that_of_the_command():
    (order,) = re.findall(r"in the order (dark, .*?)\.", PAGE)
    assert order.split(", ") == list(STEPS)


def test_python_and_commands_work_one_after_the_other(folder):
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL):
        exec(compile(block, "recipes.md", "exec"), names)
    assert '"sha256"' in str(names["text"])
    Path("shot.shadowinv").unlink()
    for command in COMMANDS[:4]:
        words = shlex.split(command)
        fast = ["--scheduler", "threads"] if words[0] == "batch" else []
        result = CliRunner().invoke(app, [*words, *fast])
        assert result.exit_code == 0, f"{command}: {result.output}"
    inversion = names["inversion"]
    reloaded = read("shot.shadowinv")
    np.testing.assert_array_equal(reloaded.potential, inversion.potential)  # type: ignore[attr-defined]
    assert read_recipe(Path("recipe.toml")).steps == names["recipe"].steps  # type: ignore[attr-defined]
    assert read("other.shadowinv").potential.shape == (15, 20)


def test_a_result_is_made_again(folder):
    assert CliRunner().invoke(app, ["invert", "shot.tif", "--bin", "2"]).exit_code == 0
    (folder / "moved").mkdir()
    shutil.copy("shot.tif", "moved/shot.tif")
    commands = [shlex.split(command) for command in COMMANDS if command.startswith("rerun")]
    assert len(commands) == 2
    for words in commands:
        result = CliRunner().invoke(app, words)
        assert result.exit_code == 0, result.output
        assert "the same result, bit for bit" in " ".join(result.output.split())


def test_a_store_names_the_step_that_differs(folder):
    batch = ["batch", "shots/*.tif", "--out", "night.shadowinv.zarr", "--scheduler", "threads"]
    first = CliRunner().invoke(app, [*batch, "--bin", "2"])
    assert first.exit_code == 0, first.output
    second = CliRunner().invoke(app, [*batch, "--bin", "4", "--resume"])
    assert second.exit_code == 2
    output = " ".join(second.output.split())
    refusal = re.search(r"    (night.shadowinv.zarr was started .*?)\n\n", PAGE, re.DOTALL)
    assert refusal is not None
    assert " ".join(refusal[1].split()) in output


def test_every_link_leads_somewhere():
    for target in re.findall(r"\]\(([^)#]+)\)", PAGE):
        if not target.startswith(("http", "reference/")):
            assert (DOCS / target).exists(), target
