"""Input that is wrong on purpose: one sentence, before the work, without much memory."""

from __future__ import annotations

import copy
import json
import os
import pickle
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from pydantic import ValidationError

from helpers.command_line import done, refused
from napari_shadowinv import (
    FileFormatError,
    FitOptions,
    InputError,
    InversionOptions,
    OpticalSetup,
    ProtonSetup,
    Recipe,
    fit,
    invert,
    poisson_invert,
    read,
    run,
    run_stack,
    synthetic_image,
    write,
)
from napari_shadowinv._system.safety import LIMIT_VARIABLE, resolved_path
from napari_shadowinv.cli._export import _escape_cell
from napari_shadowinv.film import Calibration, Pack
from napari_shadowinv.film.scans import usable_pixels
from napari_shadowinv.inversion import Inversion, plan_sites
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read_toml
from napari_shadowinv.io.files import sha256
from napari_shadowinv.options import FitChoices
from napari_shadowinv.pipeline.shot_table import ShotRow, is_table, table_rows
from napari_shadowinv.preprocessing import STEPS
from napari_shadowinv.shot import shots_of

SHOT = np.random.default_rng(0).poisson(300, (16, 20)).astype(float)
MODELS = {
    "InversionOptions": (InversionOptions, {}),
    "FitOptions": (FitOptions, {}),
    "FitChoices": (FitChoices, {}),
    "Recipe": (Recipe, {}),
    "ProtonSetup": (ProtonSetup, ProtonSetup.example().model_dump(exclude={"kind"})),
    "OpticalSetup": (OpticalSetup, OpticalSetup.example().model_dump(exclude={"kind"})),
    "Pack": (Pack, {"layers": [{"film": "HDV2"}]}),
    "ShotRow": (ShotRow, {"file": "shot.npy"}),
    **{step.__name__: (step, {}) for step in STEPS.values()},
}
JUNK = ("x", "", -1, -1e300, 1e300, 1e-300, float("nan"), float("inf"), 2**70, [], {}, object())


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def refusal(call: Callable[[], Any]) -> str | None:
    """The sentence with which a call is refused, None if it is not."""
    try:
        call()
    except InputError as error:
        return str(error)
    return None


@pytest.mark.parametrize("name", MODELS)
def test_model_refuses_junk_in_one_sentence(name: str) -> None:
    model, content = MODELS[name]
    fields = [*model.model_fields, "no_such_field"]
    given = [{**content, field: junk} for field in fields for junk in JUNK]
    messages = [refusal(partial(model, **values)) for values in given]
    refused = [message for message in messages if message is not None]
    assert len(refused) >= len(JUNK)  # the field that does not exist
    for message in refused:
        assert message.startswith(f"{name}: ")
        assert "\n" not in message
        assert "pydantic" not in message


def test_refusal_of_a_model_is_a_value_error_and_travels() -> None:
    with pytest.raises(ValueError, match="'n_sites' is 2: sites must be at least 4") as caught:
        InversionOptions(n_sites=2)

    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)
    assert isinstance(caught.value.__cause__, ValidationError)
    options = InversionOptions(n_sites=50)
    assert pickle.loads(pickle.dumps(options)) == copy.deepcopy(options) == options
    with pytest.raises(ValidationError):
        InversionOptions.model_validate({"n_sites": 2})


def test_model_inside_another_is_named_with_its_place() -> None:
    with pytest.raises(InputError, match=r"^Recipe: 'options\.n_sites' is 2"):
        Recipe(options={"n_sites": 2})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: invert(SHOT, options="fast"), "options is 'fast', expected InversionOptions"),
        (lambda: invert(SHOT, options={"sites": 9}), "options: unknown key 'sites'"),
        (lambda: invert(SHOT, start="x"), "start is 'x', expected Inversion"),
        (lambda: invert(SHOT, plan="x"), "plan is 'x', expected SitePlan"),
        (lambda: plan_sites(SHOT, options=5), "options is 5"),
        (lambda: run("x", SHOT), "recipe is 'x', expected Recipe"),
        (lambda: run_stack(SHOT[None], "a.shadowinv.zarr", "x"), "recipe is 'x'"),
        (
            lambda: run_stack(SHOT[None], "a.shadowinv.zarr", run=[1]),
            r"run is \[1\], expected RunOptions",
        ),
        (lambda: fit(np.ones((32, 32)), options="x"), "options is 'x', expected FitOptions"),
        (
            lambda: fit(shots_of(np.ones((32, 32)), setup=[{}])),
            "setup is {}: expected that of an experiment",
        ),
    ],
)
def test_wrong_kind_of_argument_is_named(call: Callable[[], Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.parametrize(
    "call",
    [invert, plan_sites, poisson_invert, synthetic_image],
)
@pytest.mark.parametrize("image", [[[1, 2], [3]], "x", None, SHOT.astype(str)])
def test_what_is_no_image_is_refused(call: Callable[[Any], Any], image: Any) -> None:
    with pytest.raises(InputError):
        call(image)


# An array of any size that takes no memory.
HUGE = np.broadcast_to(np.float64(1), (300_000, 300_000))


@pytest.mark.parametrize(
    "call",
    [
        lambda: invert(HUGE),
        lambda: plan_sites(HUGE),
        lambda: fit(HUGE),
        lambda: fit(shots_of([HUGE, HUGE], strength=[1, 0.6])),
        lambda: run(Recipe(), HUGE),
        lambda: synthetic_image(np.broadcast_to(HUGE, (2, *HUGE.shape))),
    ],
    ids=["invert", "plan_sites", "fit", "fit list", "run", "forward"],
)
def test_image_too_large_for_the_memory_is_refused_first(call: Callable[[], Any]) -> None:
    with pytest.raises(InputError, match="300000 × 300000 pixels needs about"):
        call()


def test_limit_of_memory_can_be_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(LIMIT_VARIABLE, "1e-5")

    with pytest.raises(InputError, match=r"expected at most 1e-05 GB: .*SHADOWINV_MAX_GB"):
        invert(SHOT)
    with pytest.raises(InputError, match=r"an inversion of .* pixels needs about"):
        run_stack(SHOT[None], "a.shadowinv.zarr")


# Files


def test_toml_with_a_deep_key_is_refused_and_usual_keys_are_read(here: Path) -> None:
    file = Path("deep.toml")
    for text in (
        '[options]\nseed = 1.5\nx = "a.b.c.d.e.f"\n',
        "a.b.c.d = 1\n",
        f'x = "{"a " * 50_000}"\n',
    ):
        file.write_text(text)
        assert read_toml(file)
    file.write_text("seed = 1\n" + ".".join(["a"] * 10_000) + " = 1\n")
    with pytest.raises(InputError, match=r"deep\.toml, line 2 has a key of more than 16 parts"):
        read_toml(file)


def test_tiff_whose_strip_unpacks_to_far_more_is_refused(here: Path) -> None:
    pixels = np.zeros((100, 100), np.uint16)
    tifffile.imwrite("bomb.tif", pixels, compression="zlib", rowsperstrip=100)
    assert read("bomb.tif").shape == (100, 100)
    with tifffile.TiffFile("bomb.tif", mode="r+") as tiff:
        tags = tiff.pages[0].aspage().tags
        bomb = zlib.compress(bytes(80_000_000), 1)
        places = {"StripOffsets": os.path.getsize("bomb.tif"), "StripByteCounts": len(bomb)}
        for name, value in places.items():
            tags[name].overwrite(value)
    with Path("bomb.tif").open("ab") as file:
        file.write(bomb)

    with pytest.raises(FileFormatError, match="could not be read"):
        read("bomb.tif")


def test_pipes_and_loops_of_links_are_refused_in_one_sentence(here: Path) -> None:
    os.mkfifo("pipe.csv")
    os.symlink("loop.npy", "loop.npy")
    np.save("shot.npy", SHOT)
    with pytest.raises(FileFormatError, match="is a pipe"):
        sha256("pipe.csv")
    refused("fit", "shot.npy", "--fiducials", "pipe.csv", names="pipe.csv is a pipe")
    for arguments in (["loop.npy"], ["shot.npy", "--source", "loop.npy"]):
        assert "Too many levels of symbolic links" in done("invert", *arguments, code=2)
    for check in (sha256, resolved_path):
        with pytest.raises(FileFormatError, match="null byte"):
            check(Path("a\0b.npy"))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("shot.npy,1,1e300", "'energy' is '1e300'"),
        ("shot.npy,1e300,1", "at most 10000 times the first"),
        ("shot.npy,1,nan", "'energy' is 'nan'"),
    ],
    ids=["energy", "strength", "nan"],
)
def test_hostile_row_of_a_table_is_refused(row: str, message: str) -> None:
    Path("shots.csv").write_text(f"file,strength,energy\n{row}\n")

    with pytest.raises(InputError, match=message):
        table_rows(Path("shots.csv"))


def test_large_image_as_numbers_is_no_table() -> None:
    np.savetxt("large.csv", np.random.default_rng(0).random((200, 250)), delimiter=",")
    assert Path("large.csv").stat().st_size > 1_000_000

    assert not is_table(Path("large.csv"))


def test_calibration_row_that_is_no_dose_is_refused() -> None:
    for dose in ("nan", "-3", "inf"):
        rows = [
            f"{dose},3000,31000,32000",
            *(f"{2**n},{40000 - n},{41000 - n},9" for n in range(4)),
        ]
        Path("table.csv").write_text("Dose,Red,Green,Blue\n" + "\n".join(rows))
        with pytest.raises(InputError, match=f"line 2 has '{dose}'.*a dose of 0 or more"):
            Calibration.from_csv("table.csv")


def test_rim_wider_than_the_film_is_refused() -> None:
    grey = np.repeat([[40000.0], [4000.0], [400.0]], 3, axis=1)
    film = np.full((60, 80, 3), 20000, np.uint16)

    with pytest.raises(InputError, match="rim is 1000000 px on a film of 60 × 80 px"):
        usable_pixels(film, Calibration(np.array([1.0, 10.0, 100.0]), grey), rim=1_000_000)


# Results


@pytest.mark.parametrize("name", ["report", "options", "setup"])
@pytest.mark.parametrize("junk", ["", "{", "[]", "null", '"x"', '{"a": 1}'])
def test_result_with_junk_is_refused_in_one_sentence(name: str, junk: str) -> None:
    dataset = invert(SHOT, options={"n_sites": 60}).in_units(ProtonSetup.example()).to_dataset()
    dataset.attrs[name] = junk
    load = setup_from_dataset if name == "setup" else Inversion.from_dataset
    message = refusal(lambda: load(dataset))
    # An empty setup is none; what a report lacks may have a default.
    allowed = {("setup", "")}
    assert (name, junk) in allowed if message is None else "\n" not in message


def test_result_of_a_later_version_is_not_taken_for_a_script() -> None:
    np.save("shot.npy", SHOT)
    dataset = run(Recipe(options={"n_sites": 60}), "shot.npy").to_dataset()
    provenance = json.loads(dataset.attrs["provenance"])
    for text in (json.dumps(provenance | {"version": "99.0", "lens": 1}), "{"):
        write("later.shadowinv", dataset.assign_attrs(provenance=text), overwrite=True)
        refused("rerun", "later.shadowinv", names="a damaged provenance, or one of another version")


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ("shot 1.tif", "shot 1.tif"),
        ("=HYPERLINK(1)", "'=HYPERLINK(1)"),
        ("-1+2", "'-1+2"),
        ("@SUM", "'@SUM"),
        ("red\x1b[31m", "red\\x1b[31m"),
        ("a\u202eb", "a\\u202eb"),
    ],
)
def test_exported_cell_is_no_command(name: str, cell: str) -> None:
    assert _escape_cell(name) == cell


def test_a_backend_of_the_environment_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    np.save("shot.npy", SHOT)
    monkeypatch.setenv("MPLBACKEND", "bogus")
    done("info", "shot.npy")
    assert "MPLBACKEND" not in os.environ
