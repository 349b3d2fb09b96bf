"""The examples of the page about many shots must work as they stand there."""

from __future__ import annotations

import re
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile

from helpers.command_line import run_line
from helpers.pages import blocks, commands, run_python, text_of
from napari_shadowinv import Shot, invert, run_stack
from napari_shadowinv.pipeline.shot_table import ShotRow

PAGE = text_of("docs/batch.md")
COMMANDS = [line.partition("#")[0] for line in commands(PAGE)]


@pytest.fixture
def night(make_night):
    return make_night(4)


@pytest.fixture
def folder(night, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for index, image in enumerate(night.images):
        tifffile.imwrite(f"shots/shot_{index}.tif", image.astype("float32"))
        Path(f"shots/shot_{index}.npy").unlink()  # a watch takes one kind
    tifffile.imwrite("reference.tif", night.source.astype("float32"))
    return tmp_path


def run_job_array() -> None:
    """Run the script of the page for the shots that there are."""
    script = next(block for block in blocks(PAGE, "bash") if "--array=0-9" in block)
    (command,) = re.findall(r"^shadowinv (.*)$", script.replace("\\\n", " "), re.MULTILINE)
    for task in "3021":
        run_line(command.replace("$SLURM_ARRAY_TASK_ID", task))


def test_python_blocks_of_the_page_keep_their_promise(folder, night):
    run_job_array()
    run_stack(Shot("shots/*.tif", source="reference.tif"), "live.shadowinv.zarr")
    lines = [f"{number}, {number}.5\n" for number in (3, 0, 1, 2)]
    Path("day.csv").write_text("".join(["shot, delay (ns)\n", *lines]))
    local = [block for block in blocks(PAGE, "python") if "cluster" not in block]
    names = run_python("".join(f"```python\n{block}```\n" for block in local))
    alone = invert(tifffile.imread("shots/shot_3.tif"), source=tifffile.imread("reference.tif"))
    assert float(names["one"].max()) == pytest.approx(alone.potential.max(), rel=1e-6)
    assert list(names["later"].status) == [1] * 4
    assert list(names["store"].status) == [1] * 4
    assert list(names["live"]["delay (ns)"].values) == [0.5, 1.5, 2.5, 3.5]
    joined, single = names["night"], names["later"]
    assert list(joined["name"].values) == list(single["name"].values)
    np.testing.assert_array_equal(joined["potential"], single["potential"])


def test_page_lists_the_columns_of_the_model():
    (section,) = re.findall(r"^## Each shot with .*?(?=^## )", PAGE, re.DOTALL | re.MULTILINE)
    listed = re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE)
    only_fits = {"strength", "psf", "noise"}
    assert {*listed} == {*ShotRow.columns()} - only_fits
    assert all(f"`{name}`" in section for name in only_fits)


def test_the_commands_work_as_shown(folder, night):
    pytest.importorskip("imageio_ffmpeg")
    Path("setup.toml").write_text(
        'kind = "proton"\nenergy = 14.7\nsource_object_distance = 0.01\n'
        "object_image_distance = 0.3\npixel_size = 1e-5\n"
    )
    bare = np.ones(night.source.shape, np.uint8)
    bare[4:17, 6:22] = 0
    iio.imwrite("bare.png", bare)
    fast = ["--scheduler", "threads", "--set=options.n_sites=100", "--setup", "setup.toml"]
    (guessing,) = [command for command in COMMANDS if "--source-from" in command]
    for command in (COMMANDS[0], guessing):
        run_line(command, *fast)
    # The field reaches the edge: a warning.
    cautious = ["--set=options.n_sites=100", "--set=instrument.beam_rms=0"]
    for watch in (command for command in COMMANDS if command.startswith("watch")):
        if "status_file" in watch:
            tifffile.imwrite("shots/shot_3.tif", night.images[0].astype("float32"))
        printed = run_line(watch, "--idle", "0.2", *cautious).stdout
        assert printed.splitlines()[0].startswith("Watching shots for images; ")
    keys = re.findall(r'"(\w+)":', re.findall(r"```text\n(\{.*?)```", PAGE, re.DOTALL)[0])
    status = Path("status.json").read_text()
    assert [key for key in keys if f'"{key}"' not in status] == []
    remaining = [command for command in COMMANDS if not re.match("batch|watch", command)]
    assert len(remaining) == 7
    for command in remaining:
        run_line(command)
