"""Stacks that are fitted: one fit for each shot, alone or of several images, in one store."""

from __future__ import annotations

import csv
import json
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
import typer
import xarray as xr

from helpers.command_line import done, refused, shadowinv
from helpers.store_content import content
from napari_shadowinv import InputError, Recipe, run_stack, synthetic_image
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._batch import exit_unless_reliable
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.pipeline import run_fit, write_recipe
from napari_shadowinv.shot import Shot

SHAPE = (48, 48)
SETUPS = [
    ProtonSetup(
        energy=energy, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
    )
    for energy in (14.7, 5.0)
]
RATIO = SETUPS[0].momentum / SETUPS[1].momentum
HASTY = FitOptions(samples=0, max_iterations=5, spacing=0.25)
CHOICES = FitChoices(noise=0.02, options=HASTY)
RECIPE = Recipe(fit=CHOICES)


def truth(index: int) -> Any:
    return gaussian_blob(SHAPE, 20.0 + 5 * index, 7.0, (22, 20 + index)).displacement


def image(index: int, strength: float = 1.0) -> Any:
    noise = np.random.default_rng(index).normal(0, 0.02, SHAPE)
    return synthetic_image(strength * truth(index)) + noise


@pytest.fixture
def images() -> Any:
    return np.stack([image(index) for index in range(3)])


def fitted(shots: Any, out: Path, recipe: Recipe = RECIPE, **more: Any) -> xr.Dataset:
    """The store of shots, made in this process."""
    return run_stack(shots, out, recipe, scheduler="synchronous", **more)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A table of two shots, each at two energies, and its files."""
    monkeypatch.chdir(tmp_path)
    lines = ["shot,file,energy,setup"]
    for index in range(2):
        for name, strength, setup in (("low", 1.0, SETUPS[0]), ("high", RATIO, SETUPS[1])):
            tifffile.imwrite(f"{name}{index}.tif", image(index, strength).astype(np.float32))
            lines.append(f"s{index},{name}{index}.tif,{setup.energy},setup.toml")
    entries = {name: value for name, value in SETUPS[0].model_dump().items() if value is not None}
    del entries["energy"]
    text = [f"{key} = {json.dumps(value)}" for key, value in entries.items()]
    Path("setup.toml").write_text("\n".join(text))
    Path("shots.csv").write_text("\n".join(lines))
    write_recipe(Path("r.toml"), Recipe(fit=CHOICES))
    return tmp_path


@pytest.mark.usefixtures("no_causes")
def test_a_stored_fit_keeps_its_cautions(images: Any, out: Path) -> None:
    images[1, 10, 12] = 9.0
    recipe = Recipe(setup=SETUPS[0], fit=CHOICES)
    store = fitted(images, out, recipe)
    alone = run_fit(recipe, [images[1]])
    report = StackStore(out).reports()[1]
    assert [Caution.from_json(each) for each in report["warnings"]] == list(alone.cautions)
    codes = [caution.code for caution in alone.cautions]
    assert "hot-pixels" in codes
    assert str(store["cautions"].values[1]).split() == list(dict.fromkeys(codes))
    assert "hot pixels: 1 pixel" in done("info", out)
    table = out.with_name("night.csv")
    done("export", out, "--out", table, "--format", "csv")
    with table.open(encoding="utf-8") as file:
        row = list(csv.DictReader(file))[1]
    assert "hot-pixels" in row["cautions"].split()


@pytest.mark.parametrize(("code", "exits"), [("samples", True), ("hot-pixels", False)])
def test_unreliable_error_bars_of_a_stored_fit_are_an_exit_code(code: str, exits: bool) -> None:
    report = {"verdict": "determined", "warnings": [{"code": code, "text": "…"}]}
    store: Any = SimpleNamespace(
        statuses=lambda: np.array([DONE]), reports=lambda: [report], field="B"
    )
    with pytest.raises(typer.Exit) if exits else nullcontext() as ended:
        exit_unless_reliable(store)
    assert not exits or ended.value.exit_code == 3


@pytest.mark.usefixtures("no_causes")
def test_each_shot_of_an_array_is_fitted_alone(images: Any, out: Path) -> None:
    recipe = Recipe(setup=SETUPS[0], fit=CHOICES)
    store = fitted(images, out, recipe, run={"dtype": "float64"})
    assert store["status"].values.tolist() == [1, 1, 1]
    for index, plane in enumerate(images):
        alone = run_fit(recipe, [plane])
        shot = store.isel(shot=index)
        np.testing.assert_array_equal(shot["displacement"], alone.fields[0].displacement)
        np.testing.assert_array_equal(shot["potential"], alone.fields[0].potential)
        in_si = SETUPS[0].path_integrated_b(alone.fields[0].displacement)
        np.testing.assert_array_equal(shot["path_integrated_b"], in_si)
        report = json.loads(str(shot["report"].values))
        assert report["verdict"] == str(shot["verdict"].values) == str(alone.verdict)
        assert report["chi2"] == float(shot["chi2"]) == alone.chi2[0]
        assert report["seconds"] == float(shot["seconds"]) > 0
    assert "path_integrated_e" not in store
    assert "caustic" not in store
    assert "flux_residual" not in store


def test_a_shot_fails_alone_and_the_rest_is_resumed(images: Any, out: Path) -> None:
    images[1] = 0
    first = fitted(images, out)
    assert first["status"].values.tolist() == [1, 2, 1]
    assert "no flux" in StackStore(out).report(1)["reason"]
    before = content(out)
    names: list[str] = []
    again = fitted(images, out, on_progress=lambda news: names.append(news.scheduler))
    assert names == ["nothing to do"]
    assert again["verdict"].values[1] == ""
    assert content(out) == before
    other_recipe = Recipe(fit=CHOICES.model_copy(update={"psf": 1.0}))
    with pytest.raises(InputError, match=r"different fit \(psf: default there, 1.0 now\)"):
        fitted(images, out, other_recipe)
    with pytest.raises(InputError, match="different fit"):
        fitted(images, out, Recipe(), run={"variables": ("potential", "displacement")})


def test_error_bars_are_stored_if_they_are_made(images: Any, out: Path) -> None:
    options = HASTY.model_copy(update={"samples": 2})
    recipe = Recipe(fit=CHOICES.model_copy(update={"options": options}))
    store = fitted(images[:1], out, recipe)
    assert store["displacement_uncertainty"].attrs["units"] == "pixel"
    assert float(store["displacement_uncertainty"].min()) > 0
    assert float(store["total_error"][0]) == run_fit(recipe, [images[0]]).total_error
    shot = RetrievedField(store.isel(shot=0))
    fact = next(fact for fact in shot.facts if fact.key == "significance")
    assert "(σ by noise, instrument and beam)" in fact.text


@pytest.mark.parametrize(
    ("recipe", "variables", "words"),
    [
        ({"fit": CHOICES.model_copy(update={"fields": ("B", "E")})}, (), "and a store holds one"),
        ({"fit": CHOICES}, ("caustic",), "no variable 'caustic' of a fit"),
        ({"fit": CHOICES, "steps": [{"step": "low-pass"}]}, (), "what the forward model is fitted"),
    ],
)
def test_nonsense_is_refused_before_writing(
    images: Any, out: Path, recipe: Any, variables: Any, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        fitted(images, out, Recipe(**recipe), run={"variables": variables} if variables else {})
    assert not out.exists()


# Several images of each shot


def test_images_of_one_object_are_fitted_together(folder: Path, out: Path) -> None:
    store = fitted("shots.csv", out, run={"dtype": "float64"})
    assert store["name"].values.tolist() == ["s0", "s1"]
    for index in range(2):
        shots = [
            Shot(folder / f"{name}{index}.tif", setup)
            for name, setup in zip(("low", "high"), SETUPS, strict=True)
        ]
        alone = run_fit(RECIPE, shots)
        field = store["displacement"].values[index]
        np.testing.assert_array_equal(field, alone.fields[0].displacement)
        assert np.abs(field - truth(index)).max() < 0.3
        report = StackStore(out).report(index)
        names = [image["file"] for image in report["images"]]
        assert names == [f"low{index}.tif", f"high{index}.tif"]
        assert report["chi2_images"] == alone.chi2.tolist()
    assert "path_integrated_b" in store
    np.testing.assert_allclose(store["x"], np.arange(48) * SETUPS[0].object_pixel_size)


@pytest.mark.usefixtures("no_causes")
def test_changed_table_is_refused_and_longer_table_grows(folder: Path, out: Path) -> None:
    fitted("shots.csv", out)
    text = Path("shots.csv").read_text()
    for name in ("low", "high"):
        tifffile.imwrite(f"{name}2.tif", tifffile.imread(f"{name}1.tif") * np.float32(2))
    more = [f"s2,{name}2.tif,{energy},setup.toml" for name, energy in (("low", 14.7), ("high", 5))]
    longer = "\n".join([text, *more])
    Path("shots.csv").write_text(longer)
    with pytest.raises(InputError, match="different fit"):
        fitted("shots.csv", out, Recipe(fit=CHOICES.model_copy(update={"noise": None})))
    assert fitted("shots.csv", out)["name"].values.tolist() == ["s0", "s1", "s2"]
    Path("shots.csv").write_text(longer.replace("s1,high1.tif,5.0", "s1,high1.tif,6"))
    with pytest.raises(InputError, match=r"shot 1 \(s1\) has changed"):
        fitted("shots.csv", out)
    tifffile.imwrite("low0.tif", image(5).astype(np.float32))
    for rows, words in ((text, "different shots"), (longer, r"shot 0 \(s0\) has changed")):
        Path("shots.csv").write_text(rows)
        with pytest.raises(InputError, match=words):
            fitted("shots.csv", out)


def test_a_shot_with_another_setup_fails_alone(folder: Path, out: Path) -> None:
    text = Path("shots.csv").read_text()
    Path("shots.csv").write_text(text.replace("s1,low1.tif,14.7", "s1,low1.tif,13"))
    assert fitted("shots.csv", out)["status"].values.tolist() == [1, 2]
    assert "setup of its first image differs" in StackStore(out).report(1)["reason"]


# The command


def test_batch_command_fits_reports_and_exports(folder: Path) -> None:
    out = "night.shadowinv.zarr"
    arguments = ("batch", "shots.csv", "--recipe", "r.toml", "--scheduler", "threads", "--out", out)
    result = shadowinv(*arguments)
    store = StackStore(Path(out))
    verdicts = [report["verdict"] for report in store.reports()]
    assert result.exit_code == (0 if set(verdicts) == {"determined"} else 3)
    assert "verdicts" in result.stdout
    described = done("info", out)
    for words in ("noise = 0.02", "beam = known", f"{verdicts.count('determined')} determined"):
        assert words in described
    table = done("info", out, "--all")
    assert "verdict" in table
    assert "χ²" in table

    done("export", out, "--format", "csv")
    with Path("night.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["verdict"] for row in rows] == verdicts
    assert float(rows[0]["chi2"]) == store.report(0)["chi2"]
    assert "flux_residual" not in rows[0]
    done("export", out, "--format", "tiff", "--variables", "path_integrated_b")
    assert Path("night", "0000_s0_path_integrated_b_y.tif").exists()
    prad = ("--format", "pradformat", "--out", "other")
    refused("export", out, *prad, names="holds fits, expected inversions for pradformat")
    assert "nothing to do" in shadowinv(*arguments, "--resume").stdout
