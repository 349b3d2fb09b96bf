"""The command `shadowinv fit`: its inputs, the arguments of `fit`, its files and messages."""

import dataclasses
import os
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import xarray as xr

from helpers.command_line import content, flat, pressing_ctrl_c, shadowinv
from helpers.fit_images import of_each
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit, point_spread
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read, write
from napari_shadowinv.io.files import sha256
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.projection import predict_image
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.pipeline import read_recipe
from napari_shadowinv.provenance import Origin, Provenance
from napari_shadowinv.shot import Shot

SHAPE = (48, 56)
TRUTH = gaussian_blob(SHAPE, 25.0, 7.0, (22, 30)).displacement
RATIO = 1.72  # of a 5 MeV proton's displacement to one's of 14.7 MeV
LENGTHS = {"source_object_distance": 0.01, "object_image_distance": 0.3, "pixel_size": 1e-5}
FIRST, SECOND = (ProtonSetup(energy=energy, **LENGTHS) for energy in (14.7, 5.0))

pytestmark = pytest.mark.usefixtures("blank_pages")


@pytest.fixture(autouse=True)
def folder(folder: Path) -> Path:
    """Two images of one object, and their setup without an energy."""
    noise = np.random.default_rng(0)
    for name, strength in (("a", 1.0), ("b", RATIO)):
        image = 1000 * synthetic_image(strength * TRUTH) + noise.normal(0, 20, SHAPE)
        tifffile.imwrite(f"{name}.tif", image.astype(np.float32))
    lines = [f"{name} = {value}" for name, value in LENGTHS.items()]
    Path("setup.toml").write_text("\n".join(['kind = "proton"', *lines]))
    return folder


def set_options(**options: object) -> tuple[str, ...]:
    """Return the flags that set options of a fit."""
    return tuple(f"--set=fit.options.{name}={value}" for name, value in options.items())


QUICK = set_options(samples=0, max_iterations=1, spacing=0.5, smoothness=10)
PAIR = ("fit", "a.tif", "b.tif", "--energies", "14.7,5", "--setup", "setup.toml")


@pytest.fixture
def fit_arguments(monkeypatch: pytest.MonkeyPatch, make_fit: Callable[..., Fit]) -> dict[str, Any]:
    """Record the arguments that the command passes to `fit`, which then does no work."""
    recorded: dict[str, Any] = {}

    def fit(shots: Sequence[Shot], **arguments: Any) -> Fit:
        recorded.update(arguments, shots=shots)
        strengths = (1.0, 1.7, 2.0, 3.0)[: len(shots)]
        return make_fit(strengths=strengths)

    monkeypatch.setattr("napari_shadowinv.pipeline.fit_run.fit", fit)
    return recorded


def fit_in(path: str) -> tuple[Fit, xr.Dataset]:
    dataset = read(Path(path))
    assert isinstance(dataset, xr.Dataset)
    return Fit.from_dataset(dataset), dataset


def provenance_in(path: str) -> Provenance:
    provenance = fit_in(path)[0].provenance
    assert provenance is not None
    return provenance


# Results


@pytest.mark.draws_figures
def test_the_field_of_two_energies_is_found_and_written(folder: Path) -> None:
    exact = "--set=instrument.beam_rms=0"
    result = shadowinv(*PAIR, *set_options(samples=2), "--noise", 20, exact)
    assert result.exit_code == 0, result.output
    names = {"a.tif", "b.tif", "setup.toml", "a_fit.shadowinv", "a_fit.png"}
    assert set(content(folder)) == names
    assert len(np.unique(iio.imread("a_fit.png"))) > 100
    fit, dataset = fit_in("a_fit.shadowinv")
    assert fit.verdict is Verdict.DETERMINED
    assert np.abs(fit.fields[0].displacement - TRUTH).max() < 0.2
    assert fit.setups == (FIRST, SECOND)
    assert fit.options == FitOptions(samples=2)
    assert setup_from_dataset(dataset) == FIRST
    output = flat(result.stdout)
    assert "determined peak |∫B×dz| " in output
    assert fit.assessment.short in output
    output = flat(shadowinv("info", "a_fit.shadowinv").stdout)
    assert fit.explanation in output
    assert "image 2 b.tif, 5 MeV proton, χ²" in output
    assert "MG·µm)" in output
    assert "displacement B peak |d|" in output
    assert "a source that differs from it by 1 %" in output

    description = flat(shadowinv("info", "a_fit.shadowinv").stdout)
    for words in ("kind fit of shadowinv", "determined peak |∫B", "image 1 a.tif, 14.7 MeV proton"):
        assert words in description
    assert sha256("b.tif")[:40] in description
    assert "peak |∫B×dz|" in description


def test_an_ambiguous_field_is_written_with_exit_code_3() -> None:
    options = set_options(samples=0, max_iterations=2, ambiguous="true")
    result = shadowinv("fit", "a.tif", "--source", "unknown", *options, "--quiet")
    assert result.exit_code == 3
    (line,) = result.stderr.splitlines()
    assert line.startswith("ONE IMAGE CANNOT TELL: a_fit.shadowinv was written, but one image")
    assert result.stdout == ""
    fit, _ = fit_in("a_fit.shadowinv")
    assert fit.verdict is Verdict.AMBIGUOUS
    assert fit.provenance is not None
    assert fit.provenance.recipe.fit is not None
    assert fit.provenance.recipe.fit.beam == "unknown"


def test_one_image_with_unknown_beam_needs_ambiguous(refused: Callable[..., None]) -> None:
    names = ("one image", "(--set fit.options.ambiguous=true)")
    refused("fit", "a.tif", "--source", "unknown", names=names)


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_leaves_nothing(folder: Path) -> None:
    before = content(folder)
    with pressing_ctrl_c("fit"):
        result = shadowinv(*PAIR)
    assert (result.exit_code, result.stderr.strip()) == (130, "Cancelled")
    assert content(folder) == before


# Arguments of the fit


def test_images_setups_and_choices_reach_the_fit(fit_arguments: dict[str, Any]) -> None:
    result = shadowinv(
        *(*PAIR, "--set=fit.fields=B, E", "--noise", "poisson", "--set=fit.psf=1.5"),
        *("--set=fit.brightness=free", *set_options(align="shift", seed=3)),
    )
    assert result.exit_code == 0, result.output
    shots = fit_arguments["shots"]
    np.testing.assert_array_equal(shots[1].image, tifffile.imread("b.tif"))
    assert of_each(shots, "setup") == [FIRST, SECOND]
    assert of_each(shots, "strength") == of_each(shots, "mask") == [None, None]
    assert fit_arguments["fields"] == ("B", "E")
    assert of_each(shots, "noise") == ["poisson", "poisson"]
    assert of_each(shots, "brightness") == ["free", "free"]
    assert of_each(shots, "psf") == [1.5, 1.5]
    assert fit_arguments["options"] == FitOptions(align="shift", seed=3)
    assert of_each(shots, "source") == of_each(shots, "fiducials") == [None, None]


def test_a_table_describes_each_image(folder: Path, fit_arguments: dict[str, Any]) -> None:
    night = folder / "night"
    night.mkdir()
    for name in ("a.tif", "b.tif", "setup.toml"):
        (folder / name).rename(night / name)
    tifffile.imwrite(night / "beam.tif", np.full(SHAPE, 900, np.float32))
    mask = np.full(SHAPE, 255, np.uint8)
    mask[:5, :7] = 0
    tifffile.imwrite(night / "mask.tif", mask)
    (night / "shots.csv").write_text(
        "# the second shot of the night\n"
        "file, energy, setup, source, brightness, psf, mask, noise\n"
        "a.tif, 14.7, setup.toml, beam.tif, 1,, mask.tif, 20\n"
        "\n"
        "b.tif, 5, setup.toml, beam.tif, 1.2, 0.5,,\n"
    )
    result = shadowinv("fit", "night/shots.csv", "--set=fit.psf=2", "--noise", 30)
    assert result.exit_code == 0, result.output
    shots = fit_arguments["shots"]
    assert of_each(shots, "setup") == [FIRST, SECOND]
    # Flags hold where a cell is empty.
    assert of_each(shots, "psf") == [2.0, 0.5]
    assert of_each(shots, "noise") == [20.0, 30.0]
    assert of_each(shots, "brightness") == [1.0, 1.2]
    np.testing.assert_array_equal(of_each(shots, "source"), np.full((2, *SHAPE), 900))
    np.testing.assert_array_equal(shots[0].mask, mask > 0)
    assert shots[1].mask is None
    provenance = provenance_in("a_fit.shadowinv")
    assert [image.file for image in provenance.images] == ["a.tif", "b.tif"]
    assert provenance.images[1].sha256 == sha256(night / "b.tif")
    assert [image.mask for image in provenance.images] == [0, None]
    (origin,) = provenance.masks
    assert (origin.file, origin.sha256) == ("mask.tif", sha256(night / "mask.tif"))
    np.testing.assert_array_equal(origin.mask(), mask > 0)
    assert [image.psf for image in provenance.images] == [None, 0.5]
    assert [image.brightness for image in provenance.images] == [1.0, 1.2]
    assert [image.setup for image in provenance.images] == [FIRST, SECOND]


def test_binning_sums_pixels_and_enlarges_the_pixel_size(
    fit_arguments: dict[str, Any],
) -> None:
    tifffile.imwrite("beam.tif", np.full(SHAPE, 10, np.float32))
    sizes = "--set=fit.source_size=1e-5", "--set=fit.resolution=4e-4"
    result = shadowinv(*PAIR, "--bin", 2, "--source", "beam.tif", *sizes)
    assert result.exit_code == 0, result.output
    blocks = tifffile.imread("a.tif").astype(float).reshape(24, 2, 28, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(fit_arguments["shots"][0].image, blocks)
    beams = of_each(fit_arguments["shots"], "source")
    np.testing.assert_array_equal(beams, np.full((2, 24, 28), 40))
    first = FIRST.model_copy(update={"pixel_size": 2e-5})
    assert fit_arguments["shots"][0].setup == first
    assert fit_arguments["shots"][0].psf == pytest.approx(point_spread(first, 1e-5, 4e-4))


def test_known_displacements_come_from_a_table(fit_arguments: dict[str, Any]) -> None:
    Path("mesh.csv").write_text("x;y;dx;dy;sigma\n20;10;0.5;-0.25;0.1\n30;12;0.4;0;0.2\n")
    assert shadowinv("fit", "a.tif", "--fiducials", "mesh.csv").exit_code == 0
    rows = ((10, 20, -0.25, 0.5, 0.1), (12, 30, 0, 0.4, 0.2))
    np.testing.assert_array_equal(fit_arguments["shots"][0].fiducials, rows)
    provenance = provenance_in("a_fit.shadowinv")
    assert provenance.fiducials == Origin(file="mesh.csv", sha256=sha256("mesh.csv"))
    assert provenance.fiducial_rows == rows


def test_settings_override_the_recipe_of_a_fit(fit_arguments: dict[str, Any]) -> None:
    Path("r.toml").write_text('[fit.options]\nboundary = "free"\nsamples = 4\n')
    assert shadowinv("fit", "a.tif", "--recipe", "r.toml", *set_options(samples=0)).exit_code == 0
    assert fit_arguments["options"] == FitOptions(boundary="free", samples=0)


# Errors

TABLES = {
    "file,enrgy\na.tif,3\n": ("column 'enrgy'", "did you mean 'energy'?"),
    "file,noise\na.tif,loud\n": ("line 2", "'noise' is 'loud': expected 'poisson'"),
    "file,strength\na.tif,1\nb.tif,\n": ("b.tif has no strength, other images have",),
    "file,source\na.tif,unknown\nb.tif,\n": ("b.tif has no unknown source",),
}


@pytest.mark.parametrize(("table", "names"), TABLES.items(), ids=[n[0] for n in TABLES.values()])
def test_wrong_tables_are_refused(
    refused: Callable[..., None], table: str, names: tuple[str, ...]
) -> None:
    Path("shots.csv").write_text(table)
    refused("fit", "shots.csv", names=names)


MISTAKES = {
    "fit a.tif b.tif": ("neither strengths nor setups",),
    "fit a.tif b.tif --energies 3": ("2 images and 1 values of --energies",),
    "fit a.tif b.tif --energies 3,5": ("an energy of 3 MeV and no setup", "--setup"),
    "fit a.tif b.tif --setup setup.toml": ("'energy' is missing",),
    "fit wrong.csv": ("line 3", "'strength' is 'two'"),
    "fit small.csv": ("small.tif has shape (40, 40), a.tif (48, 56)",),
    "fit a.tif --set fit.psf=1 --set fit.resolution=1e-5": (
        "fit.psf, a point spread in px, and fit.resolution in m",
    ),
    "fit a.tif --set fit.resolution=1e-5": ("no setup", "(--set fit.psf)"),
    "fit a.tif --source nothing.tif": ("nothing.tif does not exist",),
    "fit a.tif --source small.tif": ("a.tif: source has shape (40, 40)",),
    "fit a.tif --out fit.csv": ("expected one of .h5", ".shadowinv"),
    "fit a.tif --out fit.h5": ("pradformat", "needs a setup"),
    "fit a.tif b.tif --energies 3,5 --setup setup.toml --set fit.fields=B,E --out fit.h5": (
        "holds one field, received B and E",
    ),
    "fit a.tif --out setup.shadowinv --figure setup.toml": (".toml", "expected one of"),
    "fit a.tif --set fit.options.boundary=soft": (
        "fit.options.boundary is 'soft'",
        "'fading' or 'free'",
    ),
    "fit a.tif --set options.samples=2": ("options.samples: did you mean fit.options.samples?",),
    "fit shots.csv --energies 3": ("column 'energy'",),
    "fit dark.csv": ("line 3", "'brightness' is '0'"),
    "fit two.csv --compare": ("needs the setup",),
}


@pytest.mark.parametrize(("command", "names"), MISTAKES.items(), ids=list(MISTAKES))
def test_mistakes_give_one_sentence(
    refused: Callable[..., None], command: str, names: tuple[str, ...]
) -> None:
    tifffile.imwrite("small.tif", np.ones((40, 40), np.float32))
    Path("shots.csv").write_text("file\na.tif\n")
    Path("wrong.csv").write_text("file,strength\na.tif,1\nb.tif,two\n")
    Path("two.csv").write_text("file,strength\na.tif,1\nb.tif,2\n")
    Path("mesh.csv").write_text("x,y,dx,dy,sigma\n20,10,0.5,-0.25,0.1\n")
    Path("small.csv").write_text("file,strength\na.tif,1\nsmall.tif,2\n")
    Path("dark.csv").write_text("file,strength,brightness\na.tif,1,1\nb.tif,2,0\n")
    refused(*command.split(), names=names)


def test_an_input_is_never_overwritten(refused: Callable[..., None]) -> None:
    np.save("beam.npy", np.ones(SHAPE))
    Path("beam.npy").rename("beam.png")  # the content counts
    for option in ("--source", "--mask"):
        arguments = (option, "beam.png", "--figure", "beam.png", "--overwrite")
        refused("fit", "a.tif", *arguments, names=("beam.png is both read and written",))


def test_replacing_a_result_needs_overwrite(
    refused: Callable[..., None], fit_arguments: dict[str, Any]
) -> None:
    Path("a_fit.png").write_text("mine")
    refused("fit", "a.tif", names=("a_fit.png exists", "--overwrite"))
    assert not fit_arguments
    assert shadowinv("fit", "a.tif", "--overwrite").exit_code == 0


# Fits in other commands


def test_forward_takes_the_field_of_a_fit(make_fit: Callable[..., Fit]) -> None:
    fit = make_fit(setups=(FIRST, SECOND))
    write("fit.shadowinv", fit)
    assert shadowinv("forward", "fit.shadowinv", "--out", "seen.npy").exit_code == 0
    expected = synthetic_image(fit.fields[0].displacement, fit.source[0])
    np.testing.assert_array_equal(np.load("seen.npy"), expected)


def test_a_fitted_field_is_predicted_by_its_own_cause(make_fit: Callable[..., Fit]) -> None:
    fit = make_fit(names=("E",), setups=(FIRST, SECOND))
    write("fit.shadowinv", fit)
    Path("second.toml").write_text(Path("setup.toml").read_text() + "\nenergy = 5.0\n")
    result = shadowinv("forward", "fit.shadowinv", "--setup", "second.toml", "--out", "seen.npy")
    assert result.exit_code == 0, result.output
    assert "the electric field alone deflects the beam" in flat(result.stdout)
    field = fit.fields[0].displacement
    expected = predict_image(field, FIRST, SECOND, deflector="electric field")
    np.testing.assert_array_equal(np.load("seen.npy"), expected)


def test_a_damaged_fit_gives_one_sentence(
    refused: Callable[..., None], make_fit: Callable[..., Fit]
) -> None:
    write("fit.shadowinv", make_fit().to_dataset().assign_attrs(verdict="perhaps"))
    for command in ("forward", "info", "rerun"):
        refused(command, "fit.shadowinv", names=("fit.shadowinv", "damaged", "perhaps"))


def test_forward_asks_which_of_two_fields(
    refused: Callable[..., None], make_fit: Callable[..., Fit]
) -> None:
    write("fit.shadowinv", make_fit(names=("B", "E")))
    refused("forward", "fit.shadowinv", names=("the fields B, E", "fit.shadowinv::displacement_B"))
    result = shadowinv("forward", "fit.shadowinv::displacement_E")
    assert result.exit_code == 0, result.output


def test_info_shows_a_doubtful_verdict(make_fit: Callable[..., Fit]) -> None:
    doubtful = dataclasses.replace(
        make_fit(), assessment=Assessment(Verdict.SEVERAL, "2 different fields explain the data")
    )
    write("fit.shadowinv", doubtful)
    output = flat(shadowinv("info", "fit.shadowinv").stdout)
    assert "one of several peak " in output
    assert "; 2 different fields explain the data" in output
    assert "alternative from near: objective +20 %, displacement 30 % away" in output
    assert "brightness 1.1, shifted by y" in output


# Rerun


@pytest.mark.usefixtures("no_causes")
def test_rerun_takes_moved_images_in_their_order(
    folder: Path, refused: Callable[..., None]
) -> None:
    tifffile.imwrite("beam.tif", np.full(SHAPE, 1000, np.float32))
    assert shadowinv(*PAIR, "--source", "beam.tif", *QUICK).exit_code in (0, 3)
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    for name in ("a.tif", "beam.tif"):
        Path(name).rename(elsewhere / name)
    tifffile.imwrite(elsewhere / "c.tif", tifffile.imread("b.tif") + np.float32(5))
    refused("rerun", "a_fit.shadowinv", "--overwrite", names=("image 1 a.tif does not exist",))
    alone = ("rerun", "a_fit.shadowinv", "b.tif", "--overwrite")
    refused(*alone, names=("received 1 images", "made from 2"))
    where = ("--source", "elsewhere/beam.tif", "--overwrite")
    moved = shadowinv("rerun", "a_fit.shadowinv", "elsewhere/a.tif", "elsewhere/c.tif", *where)
    output = flat(moved.stdout)
    assert "changed the image 2 c.tif differs from the b.tif used before" in output
    assert "displacement differs by up to" in output
    assert "nothing" not in output


# Recipes


def test_a_saved_recipe_gives_the_same_fit(fit_arguments: dict[str, Any]) -> None:
    tifffile.imwrite("mask.tif", (np.eye(*SHAPE) == 0).astype(np.uint8))
    chosen = ("--bin", 2, "--mask", "mask.tif", "--noise", "poisson", "--source", "unknown")
    lengths = ("--set=fit.source_size=1e-5", *set_options(samples=0))
    first = shadowinv(*PAIR, *chosen, *lengths, "--set=fit.fields=B,E", "--save-recipe", "r.toml")
    assert first.exit_code == 0, first.output
    before = dict(fit_arguments)
    recipe = read_recipe(Path("r.toml"))
    assert recipe.fit == FitChoices(
        fields=("B", "E"),
        beam="unknown",
        noise="poisson",
        source_size=1e-5,
        options=FitOptions(samples=0),
    )
    assert shadowinv(*PAIR, "--recipe", "r.toml", "--overwrite").exit_code == 0
    assert before.keys() == fit_arguments.keys()
    for name in before.keys() - {"shots", "on_progress", "should_stop"}:
        assert fit_arguments[name] == before[name]
    for new, old in zip(fit_arguments["shots"], before["shots"], strict=True):
        np.testing.assert_equal(vars(new), vars(old))

    # Flags override the recipe.
    spread = ("--set=fit.source_size=", "--set=fit.psf=0.5")
    refused = shadowinv(*PAIR, "--recipe", "r.toml", spread[1], "--overwrite")
    assert "fit.psf, a point spread in px, and fit.source_size in m" in refused.stderr
    more = ("--set=fit.brightness=free", "--source", "a.tif", "--bin", 4)
    overrides = (*spread, *more, *set_options(samples=3))
    changed = shadowinv(*PAIR, "--recipe", "r.toml", *overrides, "--overwrite")
    assert changed.exit_code == 0, changed.output
    assert of_each(fit_arguments["shots"], "psf") == [0.5, 0.5]
    assert fit_arguments["options"] == FitOptions(samples=3)
    assert fit_arguments["shots"][1].source.shape == (SHAPE[0] // 4, SHAPE[1] // 4)
    assert of_each(fit_arguments["shots"], "brightness") == ["free", "free"]
    assert fit_arguments["fields"] == ("B", "E")


def test_the_setup_of_one_image_is_in_its_recipe(fit_arguments: dict[str, Any]) -> None:
    alone = ("fit", "a.tif", "--energies", 14.7, "--setup", "setup.toml")
    assert shadowinv(*alone, "--save-recipe", "r.toml").exit_code == 0
    assert read_recipe(Path("r.toml")).setup == FIRST
    assert shadowinv("fit", "b.tif", "--recipe", "r.toml", "--energies", 5).exit_code == 0
    assert of_each(fit_arguments["shots"], "setup") == [SECOND]
    assert shadowinv(*PAIR, "--save-recipe", "both.toml", "--overwrite").exit_code == 0
    assert read_recipe(Path("both.toml")).setup is None


RECIPES = {
    '[[steps]]\nstep = "low-pass"\n': ("low-pass", "what the forward model is fitted to"),
    '[fit]\nbeam = "unknown"\n[source]\nmethod = "gaussian"\n': ("source and a fit with an unk",),
    "[fit]\npsf = 1\nresolution = 1e-5\n": ("r.toml", "'fit.psf'", "'fit.resolution'"),
    "[fit]\nfield = 3\n": ("r.toml: unknown key 'fit.field', did you mean 'fields'?",),
    "[fit.options]\nsamples = -2\n": ("r.toml: 'fit.options.samples' is -2",),
}


@pytest.mark.parametrize(("text", "names"), RECIPES.items(), ids=[n[0] for n in RECIPES.values()])
def test_invalid_recipes_are_refused(
    refused: Callable[..., None], text: str, names: tuple[str, ...]
) -> None:
    Path("r.toml").write_text(text)
    refused("fit", "a.tif", "--recipe", "r.toml", names=names)


def test_the_recipe_on_the_page_works(fit_arguments: dict[str, Any]) -> None:
    page = (Path(__file__).parents[2] / "docs" / "fit.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    Path("page.toml").write_text(text, encoding="utf-8")
    result = shadowinv(*PAIR, "--recipe", "page.toml")
    assert result.exit_code == 0, result.output
    assert of_each(fit_arguments["shots"], "noise") == ["poisson", "poisson"]
    assert of_each(fit_arguments["shots"], "brightness") == ["free", "free"]
    assert fit_arguments["options"] == FitOptions(samples=10)
    assert fit_arguments["shots"][1].image.shape == (24, 28)
    assert fit_arguments["shots"][0].psf > 0
    keys = tomllib.loads(text)["fit"].keys()
    assert set(FitChoices.model_fields) - keys == {"psf"}


# Comparison of fields


def test_fields_are_compared_and_the_likeliest_is_written(
    monkeypatch: pytest.MonkeyPatch, make_fit: Callable[..., Fit]
) -> None:
    """Of those that are nearly as likely, the one with the fewest fields."""
    evidences = {("B",): 0.0, ("E",): -50.0, ("B", "E"): 3.0}

    def fit(_: Any, *, fields: tuple[str, ...], options: FitOptions, **__: Any) -> Fit:
        made = make_fit(names=fields, options=options)
        report = dataclasses.replace(made.report, log_evidence=evidences[fields])
        return dataclasses.replace(made, report=report)

    monkeypatch.setattr("napari_shadowinv.pipeline.fit_run.fit", fit)
    result = shadowinv(*PAIR, "--compare")
    assert result.exit_code == 0, result.output
    rows = [line.split() for line in result.stdout.partition("Comparison")[2].splitlines()]
    names_and_evidence = [
        (row[0].rstrip(","), row[-2]) for row in rows if row and row[0].rstrip(",") in "BE"
    ]
    assert names_and_evidence == [("B", "likeliest"), ("B", "+3.0"), ("E", "-50.0")]
    assert [field.name for field in fit_in("a_fit.shadowinv")[0].fields] == ["B"]
    provenance = provenance_in("a_fit.shadowinv")
    assert provenance.recipe.fit is not None
    assert provenance.recipe.fit.fields == ("B",)
    assert provenance.recipe.fit.options.evidence
    chosen = shadowinv(*PAIR, "--compare", "--set=fit.fields=E", "--overwrite")
    assert chosen.exit_code == 0, chosen.output
    assert [field.name for field in fit_in("a_fit.shadowinv")[0].fields] == ["E"]


def test_incomparable_fields_are_refused(refused: Callable[..., None]) -> None:
    refused(*PAIR, "--compare", "--set=fit.fields=plasma", names=("plasma", "B; E; B,E"))


def test_field_of_view_of_a_fit_is_in_its_table(
    make_fit: Callable[..., Fit], proton_setup: ProtonSetup
) -> None:
    write("fit.shadowinv", make_fit(setups=(proton_setup, proton_setup)))
    output = flat(shadowinv("info", "fit.shadowinv").stdout)
    # 64 × 48 px of 1.5 µm, (1.3 + 20) / 1.3.
    assert "magnification 16.38" in output
    assert "field of view 96 × 72 µm" in output


def test_a_doubtful_setup_is_printed_once_by_a_fit() -> None:
    text = Path("setup.toml").read_text()
    near = text.replace("object_image_distance = 0.3", "object_image_distance = 1e-4")
    Path("setup.toml").write_text(near)
    result = shadowinv("fit", "a.tif", "--setup", "setup.toml", "--energies", "14.7", *QUICK)
    assert flat(result.stderr).count("setup: the magnification is") == 1
    assert "setup: the magnification is" not in flat(result.stdout)
    assert "setup: the magnification is" in flat(shadowinv("info", "a_fit.shadowinv").stdout)
