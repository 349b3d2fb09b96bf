"""The command `shadowinv fit`: its inputs, the arguments of `fit`, its files and messages."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import tifffile

from helpers.command_line import content, done, flat, pressing_ctrl_c, refused, shadowinv
from helpers.fit_images import of_each
from helpers.pages import blocks, text_of
from helpers.results import provenance_in
from napari_shadowinv.facts import Verdict
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
from napari_shadowinv.provenance import Origin
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


def fit_in(path: str) -> Fit:
    return Fit.from_dataset(read(path))


# Results


@pytest.mark.draws_figures
def test_the_field_of_two_energies_is_found_and_written(folder: Path) -> None:
    exact = "--set=instrument.beam_rms=0"
    printed = done(*PAIR, *set_options(samples=2), "--noise", 20, exact)
    names = {"a.tif", "b.tif", "setup.toml", "a_fit.shadowinv", "a_fit.png"}
    assert set(content(folder)) == names
    assert len(np.unique(iio.imread("a_fit.png"))) > 100
    fit = fit_in("a_fit.shadowinv")
    assert fit.verdict is Verdict.DETERMINED
    assert np.abs(fit.fields[0].displacement - TRUTH).max() < 0.2
    assert fit.setups == (FIRST, SECOND)
    assert fit.options == FitOptions(samples=2)
    assert setup_from_dataset(read("a_fit.shadowinv")) == FIRST
    assert "determined peak |∫B×dz| " in printed
    assert fit.assessment.short in printed
    described = done("info", "a_fit.shadowinv")
    for words in (
        *(fit.explanation, "image 1 a.tif, 14.7 MeV proton", "image 2 b.tif, 5 MeV proton, χ²"),
        *("MG·µm)", "displacement B peak |d|", "a source that differs from it by 1 %"),
        *("kind fit of shadowinv", "determined peak |∫B×dz|", sha256("b.tif")[:40]),
    ):
        assert words in described


def test_an_ambiguous_field_is_written_with_exit_code_3() -> None:
    options = set_options(samples=0, max_iterations=2, ambiguous="true")
    result = shadowinv("fit", "a.tif", "--source", "unknown", *options, "--quiet")
    assert result.exit_code == 3
    (line,) = result.stderr.splitlines()
    assert line.startswith("ONE IMAGE CANNOT TELL: a_fit.shadowinv was written, but one image")
    assert result.stdout == ""
    assert fit_in("a_fit.shadowinv").verdict is Verdict.AMBIGUOUS
    assert provenance_in("a_fit.shadowinv").recipe.fit.beam == "unknown"


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_leaves_nothing(folder: Path) -> None:
    before = content(folder)
    with pressing_ctrl_c("fit"):
        result = shadowinv(*PAIR)
    assert (result.exit_code, result.stderr.strip()) == (130, "Cancelled")
    assert content(folder) == before


# Arguments of the fit


def test_images_setups_and_choices_reach_the_fit(fit_arguments: dict[str, Any]) -> None:
    done(
        *(*PAIR, "--set=fit.fields=B, E", "--noise", "poisson", "--set=fit.psf=1.5"),
        *("--set=fit.brightness=free", *set_options(align="shift", seed=3)),
    )
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
    done("fit", "night/shots.csv", "--set=fit.psf=2", "--noise", 30)
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


def test_binning_sums_pixels_and_widens_them(fit_arguments: dict[str, Any]) -> None:
    tifffile.imwrite("beam.tif", np.full(SHAPE, 10, np.float32))
    sizes = "--set=fit.source_size=1e-5", "--set=fit.resolution=4e-4"
    done(*PAIR, "--bin", 2, "--source", "beam.tif", *sizes)
    blocks = tifffile.imread("a.tif").astype(float).reshape(24, 2, 28, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(fit_arguments["shots"][0].image, blocks)
    beams = of_each(fit_arguments["shots"], "source")
    np.testing.assert_array_equal(beams, np.full((2, 24, 28), 40))
    first = FIRST.model_copy(update={"pixel_size": 2e-5})
    assert fit_arguments["shots"][0].setup == first
    assert fit_arguments["shots"][0].psf == pytest.approx(point_spread(first, 1e-5, 4e-4))


def test_known_displacements_come_from_a_table(fit_arguments: dict[str, Any]) -> None:
    Path("mesh.csv").write_text("x;y;dx;dy;sigma\n20;10;0.5;-0.25;0.1\n30;12;0.4;0;0.2\n")
    done("fit", "a.tif", "--fiducials", "mesh.csv")
    rows = ((10, 20, -0.25, 0.5, 0.1), (12, 30, 0, 0.4, 0.2))
    np.testing.assert_array_equal(fit_arguments["shots"][0].fiducials, rows)
    provenance = provenance_in("a_fit.shadowinv")
    assert provenance.fiducials == Origin(file="mesh.csv", sha256=sha256("mesh.csv"))
    assert provenance.fiducial_rows == rows


def test_a_result_is_replaced_with_overwrite(fit_arguments: dict[str, Any]) -> None:
    Path("a_fit.png").write_text("mine")
    refused("fit", "a.tif", names=("a_fit.png exists", "--overwrite"))
    assert not fit_arguments
    done("fit", "a.tif", "--overwrite")


# Fits in other commands


def test_forward_takes_a_field_of_a_fit(make_fit: Callable[..., Fit]) -> None:
    fit = make_fit(setups=(FIRST, SECOND))
    write("fit.shadowinv", fit)
    done("forward", "fit.shadowinv", "--out", "seen.npy")
    expected = synthetic_image(fit.fields[0].displacement, fit.source[0])
    np.testing.assert_array_equal(np.load("seen.npy"), expected)


def test_a_fitted_field_is_predicted_by_its_own_cause(make_fit: Callable[..., Fit]) -> None:
    fit = make_fit(names=("E",), setups=(FIRST, SECOND))
    write("fit.shadowinv", fit)
    Path("second.toml").write_text(Path("setup.toml").read_text() + "\nenergy = 5.0\n")
    printed = done("forward", "fit.shadowinv", "--setup", "second.toml", "--out", "seen.npy")
    assert "the electric field alone deflects the beam" in printed
    field = fit.fields[0].displacement
    expected = predict_image(field, FIRST, SECOND, deflector="electric field")
    np.testing.assert_array_equal(np.load("seen.npy"), expected)


@pytest.mark.usefixtures("no_causes")
def test_rerun_takes_moved_images_in_their_order(folder: Path) -> None:
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
    images = ("elsewhere/a.tif", "elsewhere/c.tif")
    output = flat(shadowinv("rerun", "a_fit.shadowinv", *images, *where).stdout)
    assert "changed the image 2 c.tif differs from the b.tif used before" in output
    assert "displacement differs by up to" in output
    assert "nothing" not in output


# Recipes


def test_a_saved_recipe_gives_the_same_fit(fit_arguments: dict[str, Any]) -> None:
    tifffile.imwrite("mask.tif", (np.eye(*SHAPE) == 0).astype(np.uint8))
    chosen = ("--bin", 2, "--mask", "mask.tif", "--noise", "poisson", "--source", "unknown")
    lengths = ("--set=fit.source_size=1e-5", *set_options(samples=0, boundary="free"))
    done(*PAIR, *chosen, *lengths, "--set=fit.fields=B,E", "--save-recipe", "r.toml")
    before = dict(fit_arguments)
    recipe = read_recipe(Path("r.toml"))
    assert recipe.fit == FitChoices(
        fields=("B", "E"),
        beam="unknown",
        noise="poisson",
        source_size=1e-5,
        options=FitOptions(samples=0, boundary="free"),
    )
    done(*PAIR, "--recipe", "r.toml", "--overwrite")
    assert before.keys() == fit_arguments.keys()
    for name in before.keys() - {"shots", "on_progress", "should_stop"}:
        assert fit_arguments[name] == before[name]
    for new, old in zip(fit_arguments["shots"], before["shots"], strict=True):
        np.testing.assert_equal(vars(new), vars(old))

    # Flags override the recipe.
    spread = ("--set=fit.source_size=", "--set=fit.psf=0.5")
    both = "fit.psf, a point spread in px, and fit.source_size in m"
    refused(*PAIR, "--recipe", "r.toml", spread[1], "--overwrite", names=both)
    more = ("--set=fit.brightness=free", "--source", "a.tif", "--bin", 4)
    overrides = (*spread, *more, *set_options(samples=3))
    done(*PAIR, "--recipe", "r.toml", *overrides, "--overwrite")
    assert of_each(fit_arguments["shots"], "psf") == [0.5, 0.5]
    assert fit_arguments["options"] == FitOptions(samples=3, boundary="free")
    assert fit_arguments["shots"][1].source.shape == (SHAPE[0] // 4, SHAPE[1] // 4)
    assert of_each(fit_arguments["shots"], "brightness") == ["free", "free"]
    assert fit_arguments["fields"] == ("B", "E")


def test_the_setup_of_one_image_is_in_its_recipe(fit_arguments: dict[str, Any]) -> None:
    alone = ("fit", "a.tif", "--energies", 14.7, "--setup", "setup.toml")
    done(*alone, "--save-recipe", "r.toml")
    assert read_recipe(Path("r.toml")).setup == FIRST
    done("fit", "b.tif", "--recipe", "r.toml", "--energies", 5)
    assert of_each(fit_arguments["shots"], "setup") == [SECOND]
    done(*PAIR, "--save-recipe", "both.toml", "--overwrite")
    assert read_recipe(Path("both.toml")).setup is None


def test_the_recipe_on_the_page_works(fit_arguments: dict[str, Any]) -> None:
    (text,) = blocks(text_of("docs/fit.md"), "toml")
    Path("page.toml").write_text(text, encoding="utf-8")
    done(*PAIR, "--recipe", "page.toml")
    assert of_each(fit_arguments["shots"], "noise") == ["poisson", "poisson"]
    assert of_each(fit_arguments["shots"], "brightness") == ["free", "free"]
    assert fit_arguments["options"] == FitOptions(samples=10)
    assert fit_arguments["shots"][1].image.shape == (24, 28)
    assert fit_arguments["shots"][0].psf > 0
    keys = tomllib.loads(text)["fit"].keys()
    assert set(FitChoices.model_fields) - keys == {"psf"}


# Comparison of fields
