"""`shadowinv analyse`: its table, its files and its messages."""

from __future__ import annotations

import csv
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from helpers.command_line import flat, shadowinv
from helpers.exact_fields import SETUP, field_of
from napari_shadowinv import write
from napari_shadowinv.analysis import PRODUCTS, analyse, product_from_text, products_in
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.io import read_dataset
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

CIRCLE = "current center=23.5,23.5 radius=8"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    phantom = toroid((48, 48), SETUP, 30.0, 9e-6)
    image = np.random.default_rng(0).poisson(400 * synthetic_image(phantom.displacement))
    inversion = invert(image, source=np.full(image.shape, 400.0))
    path = tmp_path_factory.mktemp("result") / "ring.shadowinv"
    return write(path, inversion.in_units(SETUP).to_dataset())


@pytest.fixture
def setup_file(tmp_path: Path) -> Path:
    path = tmp_path / "setup.toml"
    lines = [f"{name} = {value!r}" for name, value in SETUP.model_dump().items()]
    path.write_text("\n".join(lines).replace("'", '"'))
    return path


def test_table_has_the_numbers_of_python(result: Path, setup_file: Path) -> None:
    outcome = shadowinv(
        "analyse", result, CIRCLE, "--samples", 20, "--setup", setup_file, "--unit", "MG um"
    )
    assert outcome.exit_code == 0, outcome.output
    inversion = Inversion.from_dataset(read_dataset(result))
    (expected,) = analyse(
        inversion, product_from_text(CIRCLE), samples=20, setup=SETUP, unit="MG um"
    )
    text = flat(outcome.output)
    assert expected.facts[0].text in text
    assert "A rotation of the displacement is not seen" in text


def test_all_files_are_written(
    result: Path, setup_file: Path, tmp_path: Path, refused: Callable[..., None]
) -> None:
    names = {"--csv": "a.csv", "--figure": "a.png", "--out": "a.shadowinv"}
    flags = [part for flag, name in names.items() for part in (flag, tmp_path / name)]
    products = ["profile 23.5,5 23.5,42 width=3", "current-density"]
    outcome = shadowinv(
        "analyse", result, *products, "--samples", 20, "--setup", setup_file, "-q", *flags
    )
    assert outcome.exit_code == 0, outcome.output
    assert outcome.output == ""
    rows = list(csv.DictReader((tmp_path / "a.csv").open(encoding="utf-8")))
    assert {row["quantity"] for row in rows} == {"magnitude", "along", "normal", "intensity"}
    (profile, density) = products_in(read_dataset(tmp_path / "a.shadowinv"))
    written = [float(row["value"]) for row in rows if row["quantity"] == "along"]
    np.testing.assert_allclose(written, profile["along"].value, rtol=1e-6)
    assert density["density"].value.shape == (48, 48)
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    info = flat(shadowinv("info", tmp_path / "a.shadowinv").output)
    assert "current_density" in info
    assert density.facts[0].text in info
    # A file with products is a result like any other.
    unit = ("--unit", "px")
    refused("analyse", "a.shadowinv", CIRCLE, *unit, names="not defined for a field in px")


def test_products_come_from_a_file(
    result: Path, tmp_path: Path, refused: Callable[..., None]
) -> None:
    file = tmp_path / "products.toml"
    file.write_text(
        '[[products]]\nproduct = "region"\ncenter = [23.5, 23.5]\nradius = 9\nlabel = "core"\n'
    )
    outcome = shadowinv("analyse", result, "--products", file, "--samples", 20)
    assert outcome.exit_code == 0, outcome.output
    assert "core (core)" in outcome.output
    file.write_text('[[products]]\nproduct = "region"\nradius = 9\n')
    one = "products.toml, product 1: received only one of"
    refused("analyse", result, "--products", file, names=one)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "received no product, expected at least one: profile [label=TEXT]"),
        (["fluxx 1,1 2,2"], "did you mean 'flux'?"),
        ([CIRCLE, "--unit", "furlong"], "unit is 'furlong', expected one of T m"),
        ([CIRCLE, "--samples", "2"], "expected at least 20"),
        (["profile 5,5 5,500"], "expected points inside the image of 48 × 48 px"),
        (["profile 5,5 5,9 width=-2"], "'width' is '-2'"),
        (["flux 5,5 9,9 5,5"], "the flux across a closed line is zero"),
        ([CIRCLE, "--csv", "a.txt"], "a.txt"),
        ([CIRCLE, "--times", "1e-9"], "--shots and --times belong to a store of shots"),
    ],
)
def test_a_mistake_is_one_sentence(
    refused: Callable[..., None], arguments: list[str], message: str, result: Path
) -> None:
    refused("analyse", result, *arguments, names=message)


def test_an_image_is_refused(refused: Callable[..., None]) -> None:
    image = write("image.npy", np.ones((8, 9)))
    refused("analyse", image, "contrast", names="expected the result")


def test_a_result_is_never_overwritten(result: Path, refused: Callable[..., None]) -> None:
    shutil.copy(result, "a.shadowinv")
    out = ("--out", "a.shadowinv", "--overwrite")
    refused("analyse", "a.shadowinv", CIRCLE, *out, names="both read and written")


def test_every_product_is_listed_with_its_choices(result: Path) -> None:
    text = flat(shadowinv("analyse", result).stderr)
    for name in PRODUCTS:
        assert f"{name} " in text
    assert "[smoothing=" in text


def test_field_of_another_program_has_no_bands(tmp_path: Path) -> None:
    field = field_of(toroid((40, 40), SETUP, 30.0, 9e-6))
    path = write(tmp_path / "field.shadowinv", field.dataset)
    outcome = shadowinv("analyse", path, "current center=19.5,19.5 radius=8")
    assert outcome.exit_code == 0, outcome.output
    assert "none: the errors of this field are not known" in flat(outcome.output)


def test_numbers_are_followed_through_the_shots_of_a_store(
    setup_file: Path, tmp_path: Path, refused: Callable[..., None]
) -> None:
    folder = tmp_path / "shots"
    folder.mkdir()
    for number in range(3):
        phantom = toroid((32, 32), SETUP, 20 * np.exp(0.2 * number), 6e-6)
        np.save(folder / f"{number}.npy", 300 * synthetic_image(phantom.displacement))
    store, table = tmp_path / "night.shadowinv.zarr", tmp_path / "growth.csv"
    assert shadowinv(
        "batch", f"{folder}/*.npy", "--setup", setup_file, "--out", store, "-q"
    ).exit_code == 0  # fmt: skip
    region = "region center=15.5,15.5 radius=10"
    outcome = shadowinv("analyse", store, region, "--times", "2e-9", "--csv", table)
    assert outcome.exit_code == 0, outcome.output
    (stated,) = re.findall(r"growth of rms ([\d.]+) 1/ns", flat(outcome.output))
    assert float(stated) == pytest.approx(0.1, rel=0.05)
    rows = [row for row in csv.DictReader(table.open()) if row["quantity"] == "rms"]
    assert [float(row["place"]) for row in rows] == [0, 2e-9, 4e-9]
    growth = np.log(float(rows[2]["value"]) / float(rows[0]["value"])) / 4
    assert growth == pytest.approx(0.1, rel=0.05)
    first_and_last = shadowinv("analyse", store, region, "--shots", "0,2", "--times", "2e-9")
    (without_middle,) = re.findall(r"growth of rms ([\d.]+) 1/ns", flat(first_and_last.output))
    assert float(without_middle) == pytest.approx(float(stated), rel=0.01)
    by_shot = shadowinv("analyse", store, region, "--shots", "0,2")
    (of_shots,) = re.findall(r"growth of rms ([\d.]+) per shot", flat(by_shot.output))
    assert float(of_shots) == pytest.approx(2 * float(stated), rel=0.01)
    for flags, message in (
        (["--times", "1,2"], "--times is '1,2', expected the time between two shots in s"),
        (["--out", tmp_path / "a.shadowinv"], "use --csv"),
        (["--shots", "9"], "shots are '9': expected numbers from 0 to 2"),
    ):
        refused("analyse", store, region, *flags, names=message)
