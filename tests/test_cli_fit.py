"""The command `shadowinv fit`: what it reads, what it gives to `fit`, what it writes and tells."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray as xr
from typer.testing import CliRunner, Result

from napari_shadowinv.cli import app
from napari_shadowinv.cli._flags import fit_choices_of
from napari_shadowinv.fitting import Fit, FitOptions, Verdict, point_spread
from napari_shadowinv.inversion.labels import setup_from_dataset
from napari_shadowinv.io import read, write
from napari_shadowinv.io.files import sha256
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.preprocessing import Bin

SHAPE = (48, 56)
TRUTH = gaussian_blob(SHAPE, 25.0, 7.0, (22, 30)).displacement
RATIO = 1.72  # of a 5 MeV proton's displacement to one's of 14.7 MeV
LENGTHS = {"source_object_distance": 0.01, "object_image_distance": 0.3, "pixel_size": 1e-5}
FIRST, SECOND = (ProtonSetup(energy=energy, **LENGTHS) for energy in (14.7, 5.0))


def shadowinv(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def flat(text: str) -> str:
    return " ".join(text.split())


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two images of one object, and their setup without an energy."""
    monkeypatch.chdir(tmp_path)
    noise = np.random.default_rng(0)
    for name, strength in (("a", 1.0), ("b", RATIO)):
        image = 1000 * synthetic_image(strength * TRUTH) + noise.normal(0, 20, SHAPE)
        tifffile.imwrite(f"{name}.tif", image.astype(np.float32))
    lines = [f"{name} = {value}" for name, value in LENGTHS.items()]
    Path("setup.toml").write_text("\n".join(['kind = "proton"', *lines]))
    return tmp_path


PAIR = ("fit", "a.tif", "b.tif", "--energies", "14.7,5", "--setup", "setup.toml")


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch, make_fit: Callable[..., Fit]) -> dict[str, Any]:
    """What the command gives to `fit`, which then does no work."""
    seen: dict[str, Any] = {}

    def fit(**arguments: Any) -> Fit:
        seen.update(arguments)
        strengths = (1.0, 1.7, 2.0, 3.0)[: len(arguments["images"])]
        return make_fit(strengths=strengths)

    monkeypatch.setattr("napari_shadowinv.fitting.fit", fit)
    return seen


@pytest.fixture
def refused(folder: Path) -> Callable[..., None]:
    """Run a command that must fail with one sentence and write nothing."""

    def run(*arguments: object, names: tuple[str, ...]) -> None:
        before = content(folder)
        result = shadowinv(*arguments)
        assert result.exit_code == 2, result.output
        (line,) = result.stderr.splitlines()
        for name in names:
            assert name in line
        assert content(folder) == before

    return run


def fit_in(path: str) -> tuple[Fit, xr.Dataset]:
    dataset = read(Path(path))
    assert isinstance(dataset, xr.Dataset)
    return Fit.from_dataset(dataset), dataset


# What it finds and writes


def test_the_field_of_two_energies_is_found_and_written(folder: Path) -> None:
    result = shadowinv(*PAIR, "--samples", 2, "--noise", 20)
    assert result.exit_code == 0, result.output
    names = {"a.tif", "b.tif", "setup.toml", "a_fit.shadowinv", "a_fit.png"}
    assert set(content(folder)) == names
    fit, dataset = fit_in("a_fit.shadowinv")
    assert fit.verdict is Verdict.DETERMINED
    assert np.abs(fit.fields[0].displacement - TRUTH).max() < 0.2
    assert fit.setups == (FIRST, SECOND)
    assert fit.options == FitOptions(samples=2)
    assert setup_from_dataset(dataset) == FIRST
    told = flat(result.stdout)
    assert "verdict determined" in told
    assert fit.explanation in told
    assert "image 2 b.tif, 5 MeV proton, χ²" in told
    assert "MG·µm); peak |d|" in told

    described = flat(shadowinv("info", "a_fit.shadowinv").stdout)
    for words in ("kind fit of shadowinv", "verdict determined", "image 1 a.tif, 14.7 MeV proton"):
        assert words in described
    assert sha256("b.tif")[:40] in described
    assert "peak |∫B×dz|" in described


def test_a_field_that_one_image_cannot_tell_is_written_with_an_exit_code_of_its_own() -> None:
    arguments = ("fit", "a.tif", "--source", "unknown", "--samples", 0, "--steps", 2)
    result = shadowinv(*arguments, "--ambiguous", "--beam-modes", 3, "--quiet")
    assert result.exit_code == 3
    (line,) = result.stderr.splitlines()
    assert line.startswith("ONE IMAGE CANNOT TELL: a_fit.shadowinv was written, but one image")
    assert result.stdout == ""
    fit, dataset = fit_in("a_fit.shadowinv")
    assert fit.verdict is Verdict.AMBIGUOUS
    assert json.loads(dataset.attrs["origins"])[0]["source"] == "unknown"


def test_one_image_and_an_unknown_beam_need_to_be_asked_for(refused: Callable[..., None]) -> None:
    refused("fit", "a.tif", "--source", "unknown", names=("one image", "--ambiguous"))


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_leaves_nothing(folder: Path) -> None:
    before = content(folder)
    script = """
        import contextlib
        from napari_shadowinv.cli import _fit_result, app

        @contextlib.contextmanager
        def bars():
            yield lambda progress: print("now" if progress.stage == "fit" else "")

        _fit_result.progress_bars = bars
        app()
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(script), *PAIR],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if "now" in line:
                process.send_signal(signal.SIGINT)
                break
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert (process.returncode, errors.strip()) == (130, "Cancelled")
    assert content(folder) == before


# What it gives to the fit


def test_images_setups_and_choices_reach_the_fit(given: dict[str, Any]) -> None:
    result = shadowinv(
        *PAIR, "--fields", "B, E", "--noise", "poisson", "--psf", 1.5, "--gains", "free",
        "--align", "shift", "--seed", 3,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    np.testing.assert_array_equal(given["images"][1], tifffile.imread("b.tif"))
    assert given["setups"] == (FIRST, SECOND)
    assert given["strengths"] is None
    assert given["fields"] == ["B", "E"]
    assert (given["noise"], given["psf"], given["gains"]) == ("poisson", [1.5, 1.5], "free")
    assert given["options"] == FitOptions(align="shift", seed=3)
    assert given["source"] is given["mask"] is given["fiducials"] is None


def test_a_table_describes_each_image(folder: Path, given: dict[str, Any]) -> None:
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
        "file, energy, setup, source, gain, psf, mask, noise\n"
        "a.tif, 14.7, setup.toml, beam.tif, 1,, mask.tif, 20\n"
        "\n"
        "b.tif, 5, setup.toml, beam.tif, 1.2, 0.5,,\n"
    )
    result = shadowinv("fit", "night/shots.csv", "--psf", 2, "--noise", 30)
    assert result.exit_code == 0, result.output
    assert given["setups"] == (FIRST, SECOND)
    # Flags hold where a cell is empty.
    assert given["psf"] == [2.0, 0.5]
    assert given["noise"] == (20.0, 30.0)
    assert given["gains"] == (1.0, 1.2)
    np.testing.assert_array_equal(given["source"], np.full((2, *SHAPE), 900))
    np.testing.assert_array_equal(given["mask"], [mask > 0, np.ones(SHAPE, bool)])
    origins = json.loads(fit_in("a_fit.shadowinv")[1].attrs["origins"])
    assert [one["image"]["file"] for one in origins] == ["a.tif", "b.tif"]
    assert origins[1]["image"]["sha256"] == sha256(night / "b.tif")
    assert origins[0]["mask"]["file"] == "mask.tif"


def test_a_table_of_numbers_is_an_image(given: dict[str, Any]) -> None:
    image = np.random.default_rng(1).uniform(1, 2, SHAPE)
    np.savetxt("numbers.csv", image, delimiter=",", fmt="%.17g")
    assert shadowinv("fit", "numbers.csv").exit_code == 0
    np.testing.assert_array_equal(given["images"], image[None])


def test_binning_sums_pixels_and_makes_those_of_the_setup_larger(given: dict[str, Any]) -> None:
    tifffile.imwrite("beam.tif", np.full(SHAPE, 10, np.float32))
    sizes = "--source-size", 1e-5, "--resolution", 4e-4
    result = shadowinv(*PAIR, "--bin", 2, "--source", "beam.tif", *sizes)
    assert result.exit_code == 0, result.output
    blocks = tifffile.imread("a.tif").astype(float).reshape(24, 2, 28, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(given["images"][0], blocks)
    np.testing.assert_array_equal(given["source"], np.full((2, 24, 28), 40))
    first = FIRST.model_copy(update={"pixel_size": 2e-5})
    assert given["setups"][0] == first
    assert given["psf"][0] == pytest.approx(point_spread(first, 1e-5, 4e-4))


def test_strengths_take_the_place_of_energies_and_units_are_kept(given: dict[str, Any]) -> None:
    assert shadowinv(*PAIR, "--strengths", "1 1,1.7 2.9", "--fields", "B,E").exit_code == 0
    assert given["strengths"] == ((1.0, 1.0), (1.7, 2.9))
    assert given["setups"] is None
    assert fit_in("a_fit.shadowinv")[0].setups == (FIRST, SECOND)


def test_known_displacements_come_from_a_table(given: dict[str, Any]) -> None:
    Path("mesh.csv").write_text("x;y;dx;dy;sigma\n20;10;0.5;-0.25;0.1\n30;12;0.4;0;0.2\n")
    assert shadowinv("fit", "a.tif", "--fiducials", "mesh.csv").exit_code == 0
    assert given["fiducials"] == [(10, 20, -0.25, 0.5, 0.1), (12, 30, 0, 0.4, 0.2)]
    origin = json.loads(fit_in("a_fit.shadowinv")[1].attrs["fiducials"])
    assert origin == {"file": "mesh.csv", "sha256": sha256("mesh.csv")}


def test_light_is_bent_by_a_refractive_index_unless_said_otherwise(given: dict[str, Any]) -> None:
    light = 'kind = "optical"\nobject_image_distance = 0.1\npixel_size = 1e-5\nwavelength = '
    for name, wavelength in (("one", "532e-9"), ("two", "1064e-9")):
        Path(f"{name}.toml").write_text(light + wavelength)
    assert shadowinv("fit", "a.tif", "--setup", "one.toml").exit_code == 0
    assert given["fields"] == ["phase"]
    Path("shots.csv").write_text("file,setup\na.tif,one.toml\nb.tif,two.toml\n")
    result = shadowinv("fit", "shots.csv", "--overwrite")
    assert result.exit_code == 2
    assert "wavelengths differ" in result.stderr


def test_options_come_from_a_file_and_flags_override_it(given: dict[str, Any]) -> None:
    Path("options.toml").write_text('edge = "free"\nsamples = 4\n')
    assert shadowinv("fit", "a.tif", "--options", "options.toml", "--samples", 0).exit_code == 0
    assert given["options"] == FitOptions(edge="free", samples=0)


def test_every_option_of_a_fit_has_a_flag() -> None:
    text = flat(shadowinv("fit", "--help").stdout)
    for name in FitOptions.model_fields:
        assert f"--{name.replace('_', '-')}" in text
    flags = {"bin": 2, "ambiguous": True, "beam_modes": 4}
    steps, options = fit_choices_of(flags, {})
    assert steps == (Bin(factor=2),)
    assert options == FitOptions(ambiguous=True, beam_modes=4)


# What it refuses

TABLES = {
    "file,enrgy\na.tif,3\n": ("column 'enrgy'", "did you mean 'energy'?"),
    "name,energy\na.tif,3\n": ("column 'name'", "known are file, setup, energy"),
    "energy,psf\n3,1\n": ("no column 'file'",),
    "file,psf,psf\na.tif,3,3\n": ("column 'psf' twice",),
    "file,psf\n": ("no rows",),
    "file,psf\na.tif,1,2\n": ("row 1 has 3 values, expected 2",),
    "file,psf\na.tif,wide\n": ("row 1", "'psf' is 'wide'"),
    "file,noise\na.tif,loud\n": ("row 1", "'noise' is 'loud': expected 'poisson'"),
    "file,strength\na.tif,1\nb.tif,\n": ("b.tif has no strength, other images have",),
    "file,source\na.tif,unknown\nb.tif,\n": ("b.tif has no unknown source",),
    "file,noise\na.tif,poisson\nb.tif,3\n": ("'poisson' in some images",),
    "file,strength\na.tif,1 2\nb.tif,2\n": ("strengths have 2, 1 numbers",),
}


@pytest.mark.parametrize(("table", "names"), TABLES.items(), ids=[n[0] for n in TABLES.values()])
def test_a_table_that_is_wrong_is_refused(
    refused: Callable[..., None], table: str, names: tuple[str, ...]
) -> None:
    Path("shots.csv").write_text(table)
    refused("fit", "shots.csv", names=names)


MISTAKES = {
    "fit a.tif b.tif": ("neither strengths nor setups",),
    "fit a.tif b.tif --energies 3": ("2 images and 1 values of energy",),
    "fit a.tif b.tif --energies 3,5": ("an energy of 3 MeV and no setup", "--setup"),
    "fit a.tif b.tif --setup setup.toml": ("'energy' is missing",),
    "fit a.tif b.tif --strengths 1,two": ("b.tif: 'strength' is 'two'",),
    "fit a.tif small.tif --strengths 1,2": ("small.tif has shape (40, 40), a.tif (48, 56)",),
    "fit a.tif --psf 1 --resolution 1e-5": ("point spread of 1 px", "--resolution"),
    "fit a.tif --resolution 1e-5": ("no setup", "--psf"),
    "fit a.tif --source nothing.tif": ("nothing.tif does not exist",),
    "fit a.tif --source small.tif": ("a.tif: source has shape (40, 40)",),
    "fit a.tif --out fit.h5": ("expected one of .shadowinv",),
    "fit a.tif --out setup.shadowinv --report setup.toml": (".toml", "expected one of"),
    "fit a.tif --edge soft": ("'edge' is 'soft'", "'fading' or 'free'"),
    "fit shots.csv --energies 3": ("column 'energy'",),
    "fit a.tif --options setup.toml": ("setup.toml: unknown key 'kind'",),
    "fit a.tif b.tif --gains 1,0 --strengths 1,2": ("b.tif: 'gain' is '0'",),
}


@pytest.mark.parametrize(("command", "names"), MISTAKES.items(), ids=list(MISTAKES))
def test_a_mistake_is_told_in_a_sentence(
    refused: Callable[..., None], command: str, names: tuple[str, ...]
) -> None:
    tifffile.imwrite("small.tif", np.ones((40, 40), np.float32))
    Path("shots.csv").write_text("file\na.tif\n")
    refused(*command.split(), names=names)


def test_an_input_is_never_overwritten(refused: Callable[..., None]) -> None:
    np.save("beam.npy", np.ones(SHAPE))
    Path("beam.npy").rename("beam.png")  # the content counts
    for option in ("--source", "--mask"):
        arguments = (option, "beam.png", "--report", "beam.png", "--overwrite")
        refused("fit", "a.tif", *arguments, names=("beam.png is both read and written",))


def test_a_result_is_replaced_only_if_asked(
    refused: Callable[..., None], given: dict[str, Any]
) -> None:
    Path("a_fit.png").write_text("mine")
    refused("fit", "a.tif", names=("a_fit.png exists", "--overwrite"))
    assert not given
    assert shadowinv("fit", "a.tif", "--overwrite").exit_code == 0


# What else takes a fit


def test_forward_takes_the_field_of_a_fit(make_fit: Callable[..., Fit]) -> None:
    fit = make_fit(setups=(FIRST, SECOND))
    write("fit.shadowinv", fit)
    assert shadowinv("forward", "fit.shadowinv", "--out", "seen.npy").exit_code == 0
    expected = synthetic_image(fit.fields[0].displacement, fit.source[0])
    np.testing.assert_array_equal(np.load("seen.npy"), expected)


def test_a_damaged_fit_is_told_in_a_sentence(
    refused: Callable[..., None], make_fit: Callable[..., Fit]
) -> None:
    write("fit.shadowinv", make_fit().to_dataset().assign_attrs(verdict="perhaps"))
    for command in ("forward", "info"):
        refused(command, "fit.shadowinv", names=("fit.shadowinv is damaged", "perhaps"))


def test_rerun_refuses_a_fit(refused: Callable[..., None], make_fit: Callable[..., Fit]) -> None:
    write("fit.shadowinv", make_fit())
    refused("rerun", "fit.shadowinv", names=("fit.shadowinv is a fit", "shadowinv fit"))


def test_forward_asks_which_of_two_fields(
    refused: Callable[..., None], make_fit: Callable[..., Fit]
) -> None:
    write("fit.shadowinv", make_fit(names=("B", "E")))
    refused("forward", "fit.shadowinv", names=("the fields B, E", "--variable displacement_B"))
    result = shadowinv("forward", "fit.shadowinv", "--variable", "displacement_E")
    assert result.exit_code == 0, result.output


def test_info_tells_a_doubtful_verdict(make_fit: Callable[..., Fit]) -> None:
    doubtful = dataclasses.replace(
        make_fit(), verdict=Verdict.SEVERAL, explanation="2 different fields explain the data"
    )
    write("fit.shadowinv", doubtful)
    told = flat(shadowinv("info", "fit.shadowinv").stdout)
    assert "verdict one of several" in told
    assert "warning 2 different fields explain the data" in told
    assert "other start from near: objective +20.00%, displacement 30.00% away" in told
    assert "gain 1.1, shifted by y" in told
