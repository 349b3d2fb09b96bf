"""`shadowinv analyse`: its table, its files and its messages."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from helpers.command_line import done, flat, refused, shadowinv
from helpers.exact_fields import SETUP, field_of
from napari_shadowinv import write
from napari_shadowinv.analysis import PRODUCTS, analyse, product_from_text, products_in
from napari_shadowinv.inversion import Inversion, invert
from napari_shadowinv.io import read_dataset
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

CIRCLE = "current center=23.5,23.5 radius=8"
FEW = ("--samples", 20)


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
    unit = ("--samples", 20, "--setup", setup_file, "--unit", "MG um")
    text = done("analyse", result, CIRCLE, *unit)
    inversion = Inversion.from_dataset(read_dataset(result))
    product = product_from_text(CIRCLE)
    (expected,) = analyse(inversion, product, samples=20, setup=SETUP, unit="MG um")
    assert expected.facts[0].text in text
    assert "A rotation of the displacement is not seen" in text


def test_all_files_are_written(result: Path, setup_file: Path, tmp_path: Path) -> None:
    products = ["profile 23.5,5 23.5,42 width=3", "current-density"]
    flags = ("--csv", "a.csv", "--figure", "a.png", "--out", "a.shadowinv")
    assert done("analyse", result, *products, "--setup", setup_file, "-q", *FEW, *flags) == ""
    rows = list(csv.DictReader((tmp_path / "a.csv").open(encoding="utf-8")))
    assert {row["quantity"] for row in rows} == {"magnitude", "along", "normal", "intensity"}
    (profile, density) = products_in(read_dataset(tmp_path / "a.shadowinv"))
    written = [float(row["value"]) for row in rows if row["quantity"] == "along"]
    np.testing.assert_allclose(written, profile["along"].value, rtol=1e-6)
    assert density["density"].value.shape == (48, 48)
    assert (tmp_path / "a.png").read_bytes()[:4] == b"\x89PNG"
    info = done("info", "a.shadowinv")
    assert "current_density" in info
    assert density.facts[0].text in info
    # A file with products is a result like any other.
    done("analyse", "a.shadowinv", CIRCLE, *FEW)


def test_every_product_is_listed_with_its_choices(result: Path) -> None:
    text = flat(shadowinv("analyse", result).stderr)
    for name in (*PRODUCTS, "[smoothing="):
        assert name in text


def test_field_of_another_program_has_no_bands(tmp_path: Path) -> None:
    field = field_of(toroid((40, 40), SETUP, 30.0, 9e-6))
    path = write(tmp_path / "field.shadowinv", field.dataset)
    text = done("analyse", path, "current center=19.5,19.5 radius=8")
    assert "none: the errors of this field are not known" in text


def test_numbers_are_followed_through_the_shots_of_a_store(
    setup_file: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "shots"
    folder.mkdir()
    for number in range(3):
        phantom = toroid((32, 32), SETUP, 20 * np.exp(0.2 * number), 6e-6)
        np.save(folder / f"{number}.npy", 300 * synthetic_image(phantom.displacement))
    store, table = tmp_path / "night.shadowinv.zarr", tmp_path / "shots.csv"
    done("batch", f"{folder}/*.npy", "--setup", setup_file, "--out", store, "-q")
    region = "region center=15.5,15.5 radius=10"

    def rms(*flags: object) -> list[tuple[float, float]]:
        done("analyse", store, region, *flags, "--csv", table, "--overwrite")
        rows = csv.DictReader(table.open())
        return [
            (float(row["place"]), float(row["value"])) for row in rows if row["quantity"] == "rms"
        ]

    times, values = zip(*rms("--times", "2e-9"), strict=True)
    assert times == (0, 2e-9, 4e-9)
    np.testing.assert_allclose(np.diff(np.log(values)), 0.2, rtol=0.05)
    assert rms("--shots", "0,2", "--times", "0,4e-9") == [(0, values[0]), (4e-9, values[2])]
    assert [place for place, _ in rms("--shots", "0,2")] == [0, 2]
    for flags, message in (
        (["--times", "1,2"], "--times is '1,2', expected the time between two shots in s"),
        (["--out", tmp_path / "a.shadowinv"], "use --csv"),
        (["--shots", "9"], "shots are '9': expected numbers from 0 to 2"),
    ):
        refused("analyse", store, region, *flags, names=message)
