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

from helpers.command_line import flat, run_line, shadowinv
from helpers.pages import blocks, commands, run_python, text_of
from napari_shadowinv import Recipe, read, run, synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import read_recipe
from napari_shadowinv.preprocessing import ESTIMATES, STEPS, MeasuredSource

pytestmark = pytest.mark.usefixtures("blank_pages")

PAGE = text_of("docs/recipes.md")
COMMANDS = commands(PAGE)
WHOLE, STEPS_SHOWN = blocks(PAGE, "toml")


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
    names = run_python(PAGE)
    assert '"sha256"' in str(names["text"])
    Path("shot.shadowinv").unlink()
    for command in COMMANDS[:4]:
        run_line(command, *(["--scheduler", "threads"] if command.startswith("batch") else []))
    np.testing.assert_array_equal(read("shot.shadowinv").potential, names["inversion"].potential)
    assert read_recipe(Path("recipe.toml")).steps == names["recipe"].steps
    assert read("other.shadowinv").potential.shape == (15, 20)


def test_a_result_is_made_again(folder):
    run_line("invert shot.tif --bin 2")
    (folder / "moved").mkdir()
    shutil.copy("shot.tif", "moved/shot.tif")
    repeats = [command for command in COMMANDS if command.startswith("rerun")]
    assert len(repeats) == 2
    for command in repeats:
        assert "the same result, bit for bit" in flat(run_line(command).output)


def test_a_store_names_the_step_that_differs(folder):
    batch = ["batch", "shots/*.tif", "--out", "night.shadowinv.zarr", "--scheduler", "threads"]
    run_line(shlex.join(batch), "--bin", "2")
    second = shadowinv(*batch, "--bin", "4", "--resume")
    assert second.exit_code == 2
    refusal = re.search(r"    (night.shadowinv.zarr was started .*?)\n\n", PAGE, re.DOTALL)
    assert refusal is not None
    assert flat(refusal[1]) in flat(second.output)
