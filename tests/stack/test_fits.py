"""Stacks that are fitted: one fit for each shot, alone or of several images, in one store."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tifffile
import typer
import xarray as xr

from helpers.command_line import flat, shadowinv
from helpers.store_content import content
from napari_shadowinv import InputError, Recipe, run_stack, synthetic_image
from napari_shadowinv.cautions import Caution
from napari_shadowinv.cli._batch import exit_unless_reliable
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.io import read
from napari_shadowinv.io.store import DONE, StackStore
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.pipeline import RunOptions, run_fit, write_recipe
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack import invert_stack

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


def truth(index: int) -> Any:
    return gaussian_blob(SHAPE, 20.0 + 5 * index, 7.0, (22, 20 + index)).displacement


def image(index: int, strength: float = 1.0) -> Any:
    noise = np.random.default_rng(index).normal(0, 0.02, SHAPE)
    return synthetic_image(strength * truth(index)) + noise


@pytest.fixture
def images() -> Any:
    return np.stack([image(index) for index in range(3)])


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
    store = run_stack(images, out, recipe, scheduler="synchronous")
    alone = run_fit(recipe, [images[1]])
    report = StackStore(out).reports()[1]
    assert [Caution.from_json(each) for each in report["warnings"]] == list(alone.cautions)
    codes = [caution.code for caution in alone.cautions]
    assert "hot-pixels" in codes
    assert str(store["cautions"].values[1]).split() == list(dict.fromkeys(codes))
    assert "hot pixels: 1 pixel" in flat(shadowinv("info", out).stdout)
    table = out.with_name("night.csv")
    assert shadowinv("export", out, "--out", table, "--format", "csv").exit_code == 0
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
    store = run_stack(images, out, recipe, scheduler="synchronous", run=RunOptions(dtype="float64"))
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
    recipe = Recipe(fit=CHOICES)
    spoilt = images.copy()
    spoilt[1] = 0
    first = run_stack(spoilt, out, recipe, scheduler="synchronous")
    assert first["status"].values.tolist() == [1, 2, 1]
    assert "no flux" in StackStore(out).report(1)["reason"]
    before = content(out)
    names: list[str] = []
    again = run_stack(
        spoilt,
        out,
        recipe,
        scheduler="synchronous",
        on_progress=lambda news: names.append(news.scheduler),
    )
    assert names == ["nothing to do"]
    assert again["verdict"].values[1] == ""
    assert content(out) == before
    other_recipe = Recipe(fit=CHOICES.model_copy(update={"psf": 1.0}))
    with pytest.raises(InputError, match=r"different fit \(psf: default there, 1.0 now\)"):
        run_stack(spoilt, out, other_recipe, scheduler="synchronous")
    with pytest.raises(InputError, match="different fit"):
        run_stack(
            spoilt,
            out,
            scheduler="synchronous",
            run=RunOptions(variables=("potential", "displacement")),
        )


def test_error_bars_are_stored_if_they_are_made(images: Any, out: Path) -> None:
    options = HASTY.model_copy(update={"samples": 2})
    recipe = Recipe(fit=CHOICES.model_copy(update={"options": options}))
    store = run_stack(images[:1], out, recipe, scheduler="synchronous")
    assert store["displacement_uncertainty"].attrs["units"] == "pixel"
    assert float(store["displacement_uncertainty"].min()) > 0
    assert float(store["total_error"][0]) == run_fit(recipe, [images[0]]).total_error
    shot = RetrievedField(store.isel(shot=0))
    fact = next(fact for fact in shot.facts if fact.key == "significance")
    assert "(σ by noise, instrument and beam)" in fact.text


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "two fields": ({"fields": ("B", "E")}, "B, E, and a store holds one"),
    "variable": ({"variables": ("caustic",)}, "no variable 'caustic' of a fit"),
    "step": ({"steps": [{"step": "low-pass"}]}, "what the forward model is fitted to"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_stack_of_fits_refuses_wrong_input_before_writing(
    images: Any, out: Path, name: str
) -> None:
    changes, words = REFUSED[name]
    fields, steps = changes.pop("fields", None), changes.pop("steps", ())
    recipe = Recipe(steps=steps, fit=CHOICES.model_copy(update={"fields": fields}))
    with pytest.raises(InputError, match=words):
        run_stack(images, out, recipe, scheduler="synchronous", run=changes)
    assert not out.exists()


def test_a_lazy_stack_does_not_fit(images: Any) -> None:
    with pytest.raises(InputError, match="invert_stack inverts: use run_stack"):
        invert_stack(images, Recipe(fit=CHOICES))


# Several images of each shot


def test_images_of_one_object_are_fitted_together(folder: Path, out: Path) -> None:
    recipe = Recipe(fit=CHOICES)
    store = run_stack(
        "shots.csv", out, recipe, scheduler="synchronous", run=RunOptions(dtype="float64")
    )
    assert store["name"].values.tolist() == ["s0", "s1"]
    for index in range(2):
        shots = [
            Shot(folder / f"{name}{index}.tif", setup)
            for name, setup in zip(("low", "high"), SETUPS, strict=True)
        ]
        alone = run_fit(recipe, shots)
        field = store["displacement"].values[index]
        np.testing.assert_array_equal(field, alone.fields[0].displacement)
        assert np.abs(field - truth(index)).max() < 0.3
        report = StackStore(out).report(index)
        assert [image["file"] for image in report["images"]] == [
            f"low{index}.tif",
            f"high{index}.tif",
        ]
        assert report["chi2_images"] == alone.chi2.tolist()
    assert "path_integrated_b" in store
    np.testing.assert_allclose(store["x"], np.arange(48) * SETUPS[0].object_pixel_size)


@pytest.mark.usefixtures("no_causes")
def test_changed_table_is_refused_and_longer_table_grows(folder: Path, out: Path) -> None:
    recipe = Recipe(fit=CHOICES)
    run_stack("shots.csv", out, recipe, scheduler="synchronous")
    text = Path("shots.csv").read_text()
    for name in ("low", "high"):
        tifffile.imwrite(f"{name}2.tif", tifffile.imread(f"{name}1.tif") * np.float32(2))
    more = [f"s2,{name}2.tif,{energy},setup.toml" for name, energy in (("low", 14.7), ("high", 5))]
    Path("shots.csv").write_text("\n".join([text, *more]))
    choices = CHOICES.model_copy(update={"noise": None})
    with pytest.raises(InputError, match="different fit"):
        run_stack("shots.csv", out, Recipe(fit=choices), scheduler="synchronous")
    store = run_stack("shots.csv", out, recipe, scheduler="synchronous")
    assert store["name"].values.tolist() == ["s0", "s1", "s2"]
    Path("shots.csv").write_text(
        Path("shots.csv").read_text().replace("s1,high1.tif,5.0", "s1,high1.tif,6")
    )
    with pytest.raises(InputError, match=r"shot 1 \(s1\) has changed"):
        run_stack("shots.csv", out, recipe, scheduler="synchronous")
    Path("shots.csv").write_text(text)
    tifffile.imwrite("low0.tif", image(5).astype(np.float32))
    with pytest.raises(InputError, match="different shots"):
        run_stack("shots.csv", out, recipe, scheduler="synchronous")
    Path("shots.csv").write_text("\n".join([text, *more]))
    with pytest.raises(InputError, match=r"shot 0 \(s0\) has changed"):
        run_stack("shots.csv", out, recipe, scheduler="synchronous")


def test_a_shot_with_another_setup_fails_alone(folder: Path, out: Path) -> None:
    text = Path("shots.csv").read_text()
    Path("shots.csv").write_text(text.replace("s1,low1.tif,14.7", "s1,low1.tif,13"))
    store = run_stack("shots.csv", out, Recipe(fit=CHOICES), scheduler="synchronous")
    assert store["status"].values.tolist() == [1, 2]
    assert "setup of its first image differs" in StackStore(out).report(1)["reason"]


# The command


def test_batch_command_fits_reports_and_exports(folder: Path) -> None:
    arguments = ("batch", "shots.csv", "--recipe", "r.toml", "--scheduler", "threads")
    out = "night.shadowinv.zarr"
    result = shadowinv(*arguments, "--out", out)
    assert result.exit_code in (0, 3), result.output
    store = StackStore(Path(out))
    verdicts = [report["verdict"] for report in store.reports()]
    assert result.exit_code == (0 if set(verdicts) == {"determined"} else 3)
    assert "verdicts" in result.stdout
    output = flat(shadowinv("info", out).stdout)
    assert "noise = 0.02" in output
    assert "beam = known" in output
    assert f"{verdicts.count('determined')} determined" in output
    table = flat(shadowinv("info", out, "--all").stdout)
    assert "verdict" in table
    assert "χ²" in table

    assert shadowinv("export", out, "--format", "csv").exit_code == 0
    with Path("night.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["verdict"] for row in rows] == verdicts
    assert float(rows[0]["chi2"]) == store.report(0)["chi2"]
    assert "flux_residual" not in rows[0]
    exported = shadowinv("export", out, "--format", "tiff", "--variables", "path_integrated_b")
    assert exported.exit_code == 0, exported.output
    assert Path("night", "0000_s0_path_integrated_b_y.tif").exists()
    refused = shadowinv("export", out, "--format", "pradformat", "--out", "other")
    assert refused.exit_code == 2
    assert "holds fits, expected inversions for pradformat" in refused.stderr
    assert not Path("other").exists()
    dataset = read(Path(out))
    assert isinstance(dataset, xr.Dataset)
    again = shadowinv(*arguments, "--out", out, "--resume")
    assert "nothing to do" in again.stdout


@pytest.fixture
def refused(folder: Path) -> Callable[..., None]:
    def run(*arguments: object, names: tuple[str, ...]) -> None:
        before = {path.name for path in folder.iterdir()}
        result = shadowinv("batch", *arguments, "--out", "x.shadowinv.zarr")
        assert result.exit_code == 2, result.output
        (line,) = result.stderr.splitlines()
        for name in names:
            assert name in line
        assert {path.name for path in folder.iterdir()} == before

    return run


def test_fit_mistakes_give_one_sentence(refused: Callable[..., None]) -> None:
    fitted = "--set=fit.fields=B"
    both = (fitted, "--set=options.tolerance=1e-3")
    refused("low*.tif", *both, names=("options.tolerance", "fit.options"))
    refused("low*.tif", fitted, "--accuracy", 0.1, names=("--accuracy", "fit.options"))
    Path("shots.csv").write_text("file,psf\nlow0.tif,1\n")
    refused("shots.csv", fitted, names=("line 2 does not say which shot", "column 'shot'"))
    Path("shots.csv").write_text("shot,file\n1,low0.tif\n1,high0.tif\n2,low1.tif\n")
    single = shadowinv("fit", "shots.csv")
    assert single.exit_code == 2
    assert "several shots, expected one object: fit them as a stack" in flat(single.stderr)
    Path("shots.csv").write_text("shot,file\n1,gone.tif\n")
    refused("shots.csv", fitted, names=("none of 1 shots can be read", "gone.tif"))
