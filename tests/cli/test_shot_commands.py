import json
import os
import platform
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import xarray as xr
from scipy.io import savemat
from typer.testing import CliRunner

from helpers.command_line import content, flat, interrupted, pressing_ctrl_c, shadowinv
from napari_shadowinv import __version__
from napari_shadowinv import preprocessing as filters
from napari_shadowinv import preprocessing as sources
from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv.cli import _info, app
from napari_shadowinv.cli._inputs import setup_for
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import Inversion, invert, machine_code
from napari_shadowinv.inversion.machine_code import code_folder
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io import read, read_shot, write
from napari_shadowinv.io.files import sha256
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.pipeline import read_recipe
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    Bin,
    Crop,
    HotPixelFilter,
    LowPassFilter,
    Recipe,
    UniformEstimate,
)
from napari_shadowinv.provenance import ImageOrigin, Provenance

BLOB = gaussian_blob((24, 32), 6.0, 4.0, (10, 18))

PROTON_TOML = """
kind = "proton"
energy = 14.7
source_object_distance = 0.01
object_image_distance = 0.3
pixel_size = 1e-5
"""

pytestmark = pytest.mark.usefixtures("blank_pages")


@pytest.fixture
def shot(folder: Path) -> Path:
    path = folder / "shot.npy"
    np.save(path, 100 * synthetic_image(BLOB.displacement))
    return path


def dataset(path: str | Path) -> xr.Dataset:
    content = read(path)
    assert isinstance(content, xr.Dataset)
    return content


def test_version_and_help() -> None:
    assert shadowinv("--version").output.split() == ["shadowinv", __version__]
    text = shadowinv("invert", "--help").output
    for word in ("--source", "--bin", "--set", "--step", "shadowinv invert shot.tif"):
        assert word in text


COMMANDS = (
    "invert", "rerun", "fit", "film", "forward", "analyse", "plan", "info", "demo", "batch",
    "watch", "export", "movie",
)  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command_fits_a_screen(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = shadowinv(command, "--help").output
    lines = text.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 80
    assert shadowinv(command, "-h").output == text


def test_program_alone_lists_its_commands() -> None:
    result = shadowinv()
    assert result.exit_code == 2
    assert result.output == shadowinv("-h").output
    for command in COMMANDS:
        assert f"│ {command} " in result.output


def test_commands_are_completed_in_a_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    environment = {"_SHADOWINV_COMPLETE": "complete_bash", "COMP_WORDS": "shadowinv inv"}
    result = CliRunner().invoke(
        app, [], prog_name="shadowinv", env={**environment, "COMP_CWORD": "1"}
    )
    assert result.output.split() == ["invert"]


def test_help_and_report_need_no_heavy_import() -> None:
    heavy = ["numba", "scipy.fft", "scipy.optimize", "xarray", "matplotlib", "skimage", "h5py"]
    heavy += ["dask", "zarr", "distributed"]
    script = f"""
import sys
from typer.testing import CliRunner
from napari_shadowinv.cli import app

heavy = set({heavy}) & set(sys.modules)
assert CliRunner().invoke(app, ["info", "--system"]).exit_code == 0
print([*heavy, *({{"napari", "qtpy", "PyQt6", "PySide6"}} & set(sys.modules))])
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.draws_figures
def test_invert_writes_the_result_of_the_library(folder: Path, shot: Path) -> None:
    result = shadowinv("invert", shot, "--set=options.n_sites=300", "--set=options.seed=4")
    assert result.exit_code == 0, result.output
    assert sorted(content(folder)) == ["shot.npy", "shot.png", "shot.shadowinv"]
    saved = dataset("shot.shadowinv")
    options = InversionOptions(n_sites=300, seed=4)
    expected = invert(np.load(shot), options=options)
    np.testing.assert_array_equal(saved["displacement"], expected.displacement)
    assert Inversion.from_dataset(saved).options == options
    provenance = Provenance.of(saved.attrs)
    assert provenance is not None
    assert provenance.image == ImageOrigin(file="shot.npy", sha256=sha256(shot), shape=(24, 32))
    assert provenance.recipe == Recipe(source=UniformEstimate(), options=options)
    assert len(np.unique(iio.imread("shot.png"))) > 100
    for word in ("limited by", "peak |d|", "shot.shadowinv", "shot.png"):
        assert word in result.stdout


def test_quiet_prints_nothing(shot: Path) -> None:
    result = shadowinv("invert", shot, "--quiet")
    assert (result.exit_code, result.output) == (0, "")


def test_source_setup_and_options_are_used(folder: Path, shot: Path) -> None:
    source = np.tile(np.linspace(90, 110, 32), (24, 1))
    tifffile.imwrite("beam.tif", source.astype(np.float32))
    (folder / "setup.toml").write_text(PROTON_TOML)
    (folder / "r.toml").write_text("[options]\ntolerance = 0.01\nn_sites = 50\n")
    arguments = ["--source", "beam.tif", "--setup", "setup.toml", "--recipe", "r.toml"]
    changes = ["--set=options.n_sites=200", "--accuracy", 0.1, "--set=options.accuracy=0.2"]
    result = shadowinv("invert", shot, *arguments, *changes, "--out", "result.shadowinv")
    assert result.exit_code == 0, result.output
    saved = dataset("result.shadowinv")
    np.testing.assert_array_equal(saved["source"], source.astype(np.float32))
    provenance = Provenance.of(saved.attrs)
    assert provenance is not None
    assert provenance.image.source is not None
    assert provenance.image.source.file == "beam.tif"
    # A flag wins over the file, and a key over both.
    expected = InversionOptions(n_sites=200, tolerance=0.01, accuracy=0.2)
    assert Inversion.from_dataset(saved).options == expected
    assert setup_from_dataset(saved) == ProtonSetup(
        energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
    )
    assert "T·m" in result.stdout
    assert "MG·µm" in result.stdout


def test_colour_film_by_channel(folder: Path) -> None:
    red = np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint16)
    tifffile.imwrite("film.tif", np.stack([red, red // 2, red // 3], axis=-1), photometric="rgb")
    result = shadowinv("invert", "film.tif", "--channel", "red")
    assert result.exit_code == 0, result.output
    assert "wrong sign" in flat(result.stdout)
    content = dataset("film.shadowinv")
    image = content["image"].values
    np.testing.assert_allclose(image / image.sum(), red / red.sum())
    warnings = json.loads(content.attrs["report"])["cautions"]
    assert warnings[-1]["code"] == "film-scan"
    assert warnings[-1]["text"].startswith(
        "channel 'red' of a colour image was used as the fluence"
    )


@pytest.mark.skipif(sys.platform == "win32", reason="such names are not allowed there")
@pytest.mark.parametrize("name", ["a[/b].tif", "a[red]b.tif", "a\x1b[31mb\u202e.tif", "a\nb.tif"])
def test_file_names_are_printed_without_control_characters(folder: Path, name: str) -> None:
    path = Path(name)
    path.parent.mkdir(exist_ok=True)
    tifffile.imwrite(path, np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint16))
    visible = name.replace("\x1b", r"\x1b").replace("\u202e", r"\u202e").replace("\n", r"\n")
    for arguments in (
        ("info", name),
        ("invert", name, "--set=options.n_sites=100", "--out", "a.shadowinv"),
    ):
        result = shadowinv(*arguments)
        assert result.exit_code == 0, result.output
        assert visible in result.stdout.replace("\n", "")
        assert not set("\x1b\u202e") & set(result.stdout)
    line = shadowinv("info", f"{name}.gone").stderr
    assert visible.replace(r"\n", " ") in line
    assert not set("\x1b\u202e") & set(line)


def test_unconverged_result_is_written_with_exit_code_3(folder: Path) -> None:
    np.save("shot.npy", synthetic_image(gaussian_blob((32, 32), 60.0, 4.0).displacement))
    few = ("--set=options.max_iterations=1", "--set=options.tolerance=1e-9")
    result = shadowinv("invert", "shot.npy", *few)
    assert result.exit_code == 3, result.output
    assert "NOT CONVERGED" in result.stderr
    assert not Inversion.from_dataset(dataset("shot.shadowinv")).report.converged


def test_figure_of_a_png_gets_another_name(folder: Path) -> None:
    iio.imwrite("shot.png", np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint8))
    before = content(folder)["shot.png"]
    assert shadowinv("invert", "shot.png", "--overwrite").exit_code == 0
    assert sorted(content(folder)) == ["shot.png", "shot.shadowinv", "shot_report.png"]
    assert content(folder)["shot.png"] == before


def test_existing_files_need_overwrite(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    (folder / "shot.shadowinv").write_text("old")
    refused("invert", shot, names=("shot.shadowinv exists", "--overwrite"))
    assert shadowinv("invert", shot, "--overwrite").exit_code == 0
    assert "displacement" in dataset("shot.shadowinv")
    (folder / "shot.shadowinv").unlink()
    refused("invert", shot, names="shot.png exists")


def test_forward_predicts_the_image(folder: Path, shot: Path) -> None:
    np.save("d.npy", BLOB.displacement)
    source = np.linspace(1, 2, 24 * 32).reshape(24, 32)
    np.save("beam.npy", source)
    assert shadowinv("forward", "d.npy", "--source", "beam.npy").exit_code == 0
    expected = synthetic_image(BLOB.displacement, source)
    image = tifffile.imread("d_image.tif")
    assert image.dtype == np.float32
    np.testing.assert_allclose(image, expected, rtol=1e-6)
    np.save("phi.npy", BLOB.potential)
    assert shadowinv("forward", "phi.npy", "--out", "phi_image.npy").exit_code == 0
    uniform = synthetic_image(BLOB.displacement)
    np.testing.assert_allclose(np.load("phi_image.npy"), uniform, atol=0.05)
    shadowinv("invert", shot)
    assert shadowinv("forward", "shot.shadowinv", "--out", "again.npy").exit_code == 0
    saved = dataset("shot.shadowinv")
    np.testing.assert_allclose(np.load("again.npy"), saved["reprojection"], rtol=1e-12)


REFUSED = {
    # outputs
    "invert shot.npy --out a.png --figure a.png": "a.png",
    "invert shot.npy --figure a.toml --save-recipe a.toml": "a.toml",
    "invert shot.npy --out nowhere/a.shadowinv": "folder nowhere does not exist",
    "invert shot.npy --figure nowhere/a.png": "folder nowhere does not exist",
    "invert shot.npy --out a.xlsx": ".xlsx",
    "invert shot.npy --out a.h5": "needs a setup of kind 'proton'",
    "invert shot.npy --out .": "is a folder",
    "forward shot.npy --out shot.npy --overwrite": "both read and written",
    # inputs
    "invert missing.tif": "missing.tif does not exist",
    "invert .": "is a folder",
    "invert shot.npy --source missing.tif": "missing.tif does not exist",
    "invert shot.npy --source small.npy": "(20, 20)",
    "invert shot.npy --mask small.npy": "small.npy",
    "invert zero.npy": "zero.npy: image has no positive pixel",
    "info missing.tif": "missing.tif",
    "forward missing.tif": "missing.tif",
    "invert shot.npy::shot": "neither a MATLAB nor an HDF5 file",
    # flags and keys
    "invert shot.npy --bin 0": "--bin is 0",
    "invert shot.npy --bin 20": "by 20",
    "invert shot.npy --set options.margin=4": "options.margin: it needs --boundary free",
    "invert shot.npy --set options.n_sites=3": "options.n_sites is '3'",
    "invert shot.npy --set options.n_sites=1000000000000": "1,000,000,000,000 sites",
    "invert shot.npy --source-from gausian": "--source-from is 'gausian': did you mean 'gaussian'",
    "invert shot.npy --source-from gaussian --source shot.npy": "choose one of them",
    "invert shot.npy --source-from 'gaussian degree=3'": "'gaussian degree=3': unknown key",
    "invert shot.npy --source-from interpolated": "without a source mask",
    "invert shot.npy --source shot.npy": "the source is the image itself",
    "invert shot.npy --step 'low-pas 3'": "--step is 'low-pas 3': did you mean 'low-pass'",
    "invert shot.npy --step 'low-pass 3 4'": "expected name=value instead of '4'",
    "invert shot.npy --step 'butterworth 9 kind=band'": "kind=band': 'kind' is 'band'",
    "invert shot.npy --step 'low-pass -1'": "'width' is '-1': ",
    # files of settings
    "invert shot.npy --setup zero.toml": "zero.toml: 'energy' is 0",
    "invert shot.npy --setup typo.toml": "unknown key 'enerky', did you mean 'energy'",
    "invert shot.npy --setup prose.toml": "prose.toml is not valid TOML",
    "invert shot.npy --recipe steps.toml": "'steps.0.width' is 0",
    "invert shot.npy --recipe keys.toml": "keys.toml: unknown key 'enerky'",
    "invert shot.npy --recipe mask.toml": "nowhere.png",
    # fields
    "forward three.npy": "three.npy is an array of shape (3, 24, 32)",
    "forward d.npy --source small.npy": "(20, 20)",
    "forward d.npy --deflector plasma": "--recorded-with",
    "forward d.npy --set trace.counts=3": "d.npy is no 3-D field",
    # the demo
    "demo --noise -1": "--noise is -1",
    "demo --set options.n_sites=2": "options.n_sites",
    "demo --out shot.npy": "shot.npy cannot be created as a folder",
}


@pytest.mark.parametrize("command", REFUSED)
def test_mistakes_give_one_sentence(shot: Path, refused: Callable[..., None], command: str) -> None:
    arrays = {"small": np.ones((20, 20)), "zero": np.zeros((24, 32)), "d": BLOB.displacement}
    for name, array in {**arrays, "three": np.zeros((3, 24, 32))}.items():
        np.save(f"{name}.npy", array)
    files = {
        "zero": PROTON_TOML.replace("14.7", "0"),
        "typo": PROTON_TOML.replace("energy", "enerky"),
        "keys": "enerky = 14.7",
        "prose": "energy = # MeV",
        "steps": "[[steps]]\nstep = 'low-pass'\nwidth = 0",
        "mask": "mask = 'nowhere.png'",
    }
    for name, text in files.items():
        Path(f"{name}.toml").write_text(text)
    refused(*shlex.split(command), names=REFUSED[command])


@pytest.fixture
def grid(folder: Path) -> Path:
    """A uniform field of 0.5 T along y in a box of 0.4 mm, as a simulation might leave it."""
    places = np.linspace(-0.2, 0.2, 9)
    zeros = np.zeros((9, 9, 9))
    components = {"Bx": zeros, "By": zeros + 0.5, "Bz": zeros}
    fields = xr.Dataset(
        {name: (("z", "y", "x"), values, {"units": "T"}) for name, values in components.items()},
        {axis: (axis, places, {"units": "mm"}) for axis in "zyx"},
    )
    fields.to_netcdf("grid.nc", engine="h5netcdf")
    (folder / "setup.toml").write_text(PROTON_TOML)
    return Path("grid.nc")


def test_forward_traces_a_3d_field(grid: Path) -> None:
    traced = shadowinv(
        *("forward", grid, "--setup", "setup.toml", "--set=view.right=-x"),
        *("--set=view.height=20", "--set=view.width=30"),
        *("--truth", "truth.nc", "--out", "image.tif"),
    )
    assert traced.exit_code == 0
    assert "faces reaches 100 %" in flat(traced.output)
    assert tifffile.imread("image.tif").shape == (20, 30)
    with xr.open_dataset("truth.nc", engine="h5netcdf") as truth:
        field = truth["path_integrated_b"].sel(component="y").values
    np.testing.assert_allclose(field[10, 15], -0.5 * 4e-4, rtol=1e-6)


def test_forward_refuses_choices_that_do_not_fit_a_3d_field(
    grid: Path, refused: Callable[..., None]
) -> None:
    refused("forward", grid, names="there is no setup")
    trace = ("forward", grid, "--setup", "setup.toml")
    refused(*trace, "--set=view.beam=x", "--set=view.right=x", names="two different axes")
    refused(*trace, "--set=trace.source_size=1e-5", names="use output 'counts'")
    refused(*trace, "--set=trace.step=3", names="trace.step is '3'")
    refused(*trace, "--deflector", "plasma", names="leave them out")
    refused("forward", f"{grid}::4", *trace[2:], names="no openPMD file")


def test_variables_of_matlab_and_hdf5(folder: Path, refused: Callable[..., None]) -> None:
    source = np.tile(np.linspace(90, 110, 32), (24, 1))
    image = synthetic_image(BLOB.displacement, source)
    savemat("shots.mat", {"shot": image, "beam": source, "phi": BLOB.potential})
    with h5py.File("shots.h5", "w") as file:
        file.update({"day/shot": image, "day/beam": source, "day/d": BLOB.displacement})
    expected = invert(image, source=source).displacement
    for name, group, remedy in (("shots.mat", "", "::shot"), ("shots.h5", "day/", "::day/beam")):
        refused("invert", name, "--overwrite", names=(name, remedy, f"{group}shot"))
        refused("info", name, names=(name, remedy, f"'{group}shot' (24×32"))
        refused("info", f"{name}::shop", names=(name, "'shop'", f"{group}beam"))
        arguments = [f"{name}::{group}shot", "--source", f"{name}::{group}beam"]
        result = shadowinv("invert", *arguments, "--overwrite")
        assert result.exit_code == 0, result.output
        np.testing.assert_array_equal(dataset("shots.shadowinv")["displacement"], expected)
    Path("beam.toml").write_text('[source]\nmethod = "measured"\nvariable = "day/beam"\n')
    result = shadowinv("invert", "shots.h5::day/shot", "--recipe", "beam.toml", "--overwrite")
    assert result.exit_code == 0, result.output
    np.testing.assert_array_equal(dataset("shots.shadowinv")["displacement"], expected)
    refused("invert", "shots.shadowinv", "--out", "again.shadowinv", names="is the result")
    from_mat = shadowinv("forward", "shots.mat::phi", "--out", "a.npy")
    from_h5 = shadowinv("forward", "shots.h5::day/d", "--out", "b.npy")
    assert (from_mat.exit_code, from_h5.exit_code) == (0, 0), from_mat.output + from_h5.output
    np.testing.assert_allclose(np.load("b.npy"), synthetic_image(BLOB.displacement))
    np.testing.assert_allclose(np.load("a.npy"), np.load("b.npy"), atol=0.05)
    text = " ".join(shadowinv("info", "shots.mat::beam").stdout.split())
    assert "array 'beam' of a MATLAB file" in text
    assert "90, 100, 110" in text
    text = " ".join(shadowinv("info", "shots.h5::day/d").stdout.split())
    assert "(2, 24, 32)" in text
    refused("info", "shots.h5::day", names=("no array 'day'", "day/beam"))


GEOMETRY_TEXT = "# source_object_distance = 1 cm\n# object_image_distance = 30 cm\n# bin_um = 310\n"


def test_geometry_in_a_text_image_is_used_and_shown(folder: Path) -> None:
    rows = "\n".join(
        " ".join(f"{v:.6f}" for v in row) for row in synthetic_image(BLOB.displacement)
    )
    (folder / "half.txt").write_text(GEOMETRY_TEXT + rows)
    (folder / "all.txt").write_text(GEOMETRY_TEXT + "# Ep_MeV = 14.7\n" + rows)
    text = " ".join(shadowinv("info", "half.txt").stdout.split())
    assert "numbers as text" in text
    assert "source object distance (m) 0.01" in text
    assert "not the energy; give it with --setup" in text
    text = " ".join(shadowinv("info", "all.txt").stdout.split())
    assert "14.7 MeV proton, magnification 31, pixel 10 µm at the object" in text
    # What the file leaves out comes from the setup, with and without a kind.
    for entries in ("energy = 14.7\n", 'kind = "proton"\nenergy = 14.7\n'):
        (folder / "energy.toml").write_text(entries)
        half = read_shot("half.txt")
        setup = setup_for(Path("energy.toml"), half, Recipe())
        assert isinstance(setup, ProtonSetup)
        assert (setup.energy, setup.object_image_distance) == (14.7, 0.3)
        assert setup.object_pixel_size == pytest.approx(1e-5)
    light = "wavelength = 5e-7\nsource_object_distance = inf\n"
    (folder / "light.toml").write_text(light)
    setup = setup_for(Path("light.toml"), read_shot("all.txt"), Recipe())
    assert isinstance(setup, OpticalSetup)
    assert (setup.object_image_distance, setup.magnification) == (0.3, 1)


def test_reference_in_a_text_image_is_the_source(folder: Path) -> None:
    source = np.tile(np.linspace(90, 110, 32), (24, 1))
    image = synthetic_image(BLOB.displacement, source)
    rows = [" ".join(f"{v:.9f}" for v in row) for row in np.concatenate([image, source])]
    (folder / "both.txt").write_text(
        "\n".join(["# flux2D (24, 32)", "# flux2D_ref (24, 32)", *rows])
    )
    assert shadowinv("invert", "both.txt").exit_code == 0
    np.testing.assert_allclose(dataset("both.shadowinv")["source"], source, rtol=1e-9)
    flags = ["--source-from", "uniform", "--overwrite"]
    assert shadowinv("invert", "both.txt", *flags).exit_code == 0
    assert np.ptp(dataset("both.shadowinv")["source"].values) == 0
    refused = shadowinv("invert", "both.txt", "--step=high-pass 3", "--overwrite")
    assert refused.exit_code == 2
    assert "would flatten the image but not the source" in flat(refused.output)


def test_an_estimated_source_is_described(shot: Path) -> None:
    result = shadowinv("invert", shot, "--source-from", "polynomial degree=3")
    assert result.exit_code in (0, 3), result.output
    saved = dataset("shot.shadowinv")
    np.testing.assert_array_equal(
        saved["source"], sources.PolynomialEstimate(degree=3).source(np.load(shot))
    )
    text = flat(shadowinv("info", "shot.shadowinv").stdout)
    assert f"source {sources.PolynomialEstimate(degree=3).summary}" in text
    assert "beam assumed" in text


def test_filters_match_the_library() -> None:
    ramp = np.tile(np.linspace(80, 120, 64), (48, 1))
    image = synthetic_image(gaussian_blob((48, 64), 12.0, 8.0).displacement, ramp)
    image += np.random.default_rng(0).normal(size=image.shape)
    image[7, 9] = 400
    np.save("shot.npy", image)
    clean, hot, dead = filters.remove_hot_pixels(image, threshold=6.0)
    assert (hot.sum(), dead.sum()) == (1, 0)
    blocks = clean.reshape(24, 2, 32, 2).sum(axis=(1, 3))
    expected = filters.LowPassFilter(width=1.5).filter_image(
        filters.BackgroundFilter(degree=1).filter_image(blocks)
    )
    flags = ["--step=low-pass 1.5", "--step=background degree=1", "--step=hot-pixels 6", "--bin", 2]
    result = shadowinv("invert", "shot.npy", *flags)
    assert result.exit_code == 0, result.output
    saved = dataset("shot.shadowinv")
    np.testing.assert_allclose(
        saved["image"], expected * saved["source"].mean().item() / expected.mean()
    )
    steps = Inversion.from_dataset(saved).provenance.recipe.steps
    assert steps == (
        HotPixelFilter(threshold=6),
        Bin(factor=2),
        BackgroundFilter(degree=1),
        LowPassFilter(width=1.5),
    )
    assert "1 hot and 0 dead pixels replaced" in flat(shadowinv("info", "shot.shadowinv").stdout)


def test_a_saved_recipe_gives_the_same_result(folder: Path, shot: Path) -> None:
    usable = np.ones((24, 32), np.uint8)
    usable[3, 4:6] = 0
    iio.imwrite("usable.png", usable)
    (folder / "setup.toml").write_text(PROTON_TOML)
    (folder / "recipes").mkdir()
    flags = [
        "--mask", "usable.png", "--setup", "setup.toml", "--bin", 2, "--step=crop x=2:",
        "--source-from", "polynomial degree=1", "--set=options.n_sites=150", "--set=options.seed=3",
    ]  # fmt: skip
    files = ["--save-recipe", "recipes/recipe.toml", "--out", "first.shadowinv"]
    result = shadowinv("invert", shot, *flags, *files)
    assert result.exit_code == 0, result.output
    recipe = read_recipe(folder / "recipes" / "recipe.toml")
    assert recipe.steps == (Crop(x=(2, None)), Bin(factor=2))
    assert recipe.mask is not None
    assert recipe.mask.resolve() == folder / "usable.png"
    again = ["--recipe", "recipes/recipe.toml", "--out", "second.shadowinv"]
    assert shadowinv("invert", shot, *again).exit_code == 0
    first, second = dataset("first.shadowinv"), dataset("second.shadowinv")
    for name in first.data_vars:
        np.testing.assert_array_equal(first[name], second[name])
    assert first.attrs["provenance"] == second.attrs["provenance"]
    # A flag wins over the recipe, where it stands.
    assert shadowinv("invert", shot, *again, "--bin", 3, "--overwrite").exit_code == 0
    provenance = Provenance.of(dataset("second.shadowinv").attrs)
    assert provenance is not None
    assert provenance.recipe.steps == (Crop(x=(2, None)), Bin(factor=3))
    assert provenance.setup is not None
    assert provenance.setup.object_pixel_size == pytest.approx(3e-5)


def test_files_of_a_recipe_are_never_overwritten(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    iio.imwrite("shot.png", np.ones((24, 32), np.uint8))  # a mask with the figure's usual name
    (folder / "recipe.toml").write_text("mask = 'shot.png'\n[options]\nn_sites = 100\n")
    flags = ["--recipe", "recipe.toml", "--overwrite"]
    refused("invert", shot, *flags, names=("shot.png", "both read and written"))
    out = ["--out", "a.shadowinv", "--save-recipe"]
    refused("invert", shot, *flags, *out, "recipe.toml", names="recipe.toml is both read")
    refused("invert", shot, *flags, *out, "shot.npy", names=("shot.npy", ".toml"))
    assert shadowinv("invert", shot, *flags, "--out", "a.shadowinv").exit_code == 0
    iio.imwrite("b.png", np.random.default_rng(0).integers(90, 110, (24, 32)).astype(np.uint8))
    assert shadowinv("invert", "b.png", "--out", "c.shadowinv").exit_code == 0
    again = ["--out", "b.shadowinv", "--overwrite"]
    refused("rerun", "c.shadowinv", *again, names=("b.png", "both read and written"))


def test_a_damaged_mask_in_a_result_is_reported(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    usable = np.ones((24, 32), np.uint8)
    usable[3, 4:6] = 0
    iio.imwrite("usable.png", usable)
    assert shadowinv("invert", shot, "--mask", "usable.png").exit_code == 0
    saved = dataset("shot.shadowinv")
    provenance = Provenance.of(saved.attrs)
    assert provenance is not None
    (original,) = provenance.masks
    mask = original.model_copy(update={"checksum": "nonsense"})
    text = provenance.model_copy(update={"masks": (mask,)}).model_dump_json()
    for bad in (
        saved.assign_attrs(provenance=text),
        saved.drop_vars("input_mask_0"),
        saved.assign(input_mask_0=~saved["input_mask_0"]),
        saved.drop_vars("input_mask_0").assign(input_mask_0=("name", ["nonsense"])),
    ):
        write("bad.shadowinv", bad, overwrite=True)
        refused("rerun", "bad.shadowinv", names="the mask stored in the result is damaged")


def test_rerun_lists_the_changes(folder: Path, shot: Path, refused: Callable[..., None]) -> None:
    assert shadowinv("invert", shot, "--out", "first.shadowinv").exit_code == 0
    result = shadowinv("rerun", "first.shadowinv")
    assert result.exit_code == 0, result.output
    assert "changed nothing difference none: the same result, bit for bit" in flat(result.stdout)
    assert {"first_again.shadowinv", "first_again.png"} <= content(folder).keys()
    # Another file of the same name, and another version.
    np.save(shot, 1.5 * np.load(shot) + 3)
    first = dataset("first.shadowinv")
    older = first.attrs["provenance"].replace(f'"version":"{__version__}"', '"version":"0.0.1"')
    write("old.shadowinv", first.assign_attrs(provenance=older))
    text = flat(shadowinv("rerun", "old.shadowinv").stdout)
    assert "changed the image shot.npy differs" in text
    assert "displacement differs by up to" in text
    assert f"made by version 0.0.1, now {__version__}" in text
    for path in (shot, folder / "old_again.shadowinv", folder / "old_again.png"):
        path.unlink()
    refused("rerun", "first.shadowinv", "--overwrite", names=("shot.npy", "does not exist"))
    write("bare.shadowinv", invert(np.ones((8, 8))))
    refused("rerun", "bare.shadowinv", names=("bare.shadowinv", "has no provenance"))
    (folder / "notes.md").write_text("a toroid")
    refused("rerun", "notes.md", names="notes.md is a text file")


@pytest.mark.parametrize(
    "part", ["image", {"mask": "FILE"}, {"source": {"method": "measured", "file": "FILE"}}]
)
def test_rerun_reads_no_foreign_file(folder: Path, refused: Callable[..., None], part: Any) -> None:
    for name in ("private", "mine"):
        (folder / name).mkdir()
    os.chdir(folder / "mine")
    file = str(folder / "private" / "shot.npy")
    for path in (file, "shot.npy"):
        np.save(path, np.random.default_rng(0).poisson(100, (16, 16)))
    shadowinv("invert", "shot.npy", "--out", "first.shadowinv")
    first = dataset("first.shadowinv")
    provenance = json.loads(first.attrs["provenance"])
    if part == "image":
        provenance["images"][0]["file"] = file
    else:
        provenance["recipe"] |= json.loads(json.dumps(part).replace("FILE", file))
    write("bad.shadowinv", first.assign_attrs(provenance=json.dumps(provenance)))

    refused("rerun", "bad.shadowinv", names=(file, "in another folder", "(--other-folders)"))
    if part == "image":
        assert shadowinv("rerun", "bad.shadowinv", "--other-folders").exit_code == 0
        assert shadowinv("rerun", "bad.shadowinv", file, "--overwrite").exit_code == 0


def test_info_describes_the_contents(folder: Path) -> None:
    values = np.array([[1.0, 2.0, np.nan], [-3.0, 4.0, 5.0]])
    np.save("a.npy", values)
    text = " ".join(shadowinv("info", "a.npy").stdout.split())
    assert "(2, 3)" in text
    assert "float64" in text
    assert "-3, 1.8, 5" in text
    assert "negative 1 values" in text
    assert "NaN or infinite 1 values" in text
    dots = {"resolution": (500, 500), "resolutionunit": "CENTIMETER", "metadata": None}
    tags = [(274, "H", 1, 3, True), (34675, "B", 4, b"sRGB", True)]
    film = np.zeros((4, 5, 3), np.uint16)
    tifffile.imwrite("film.tif", film, photometric="rgb", extratags=tags, **dots)
    text = " ".join(shadowinv("info", "film.tif").stdout.split())
    assert "TIFF picture, 16 bits" in text
    assert "channels 3" in text
    assert "detector pixel size (m) 2e-05" in text
    assert "turned upright as the file says" in text
    assert "not proportional to the light" in text


def test_info_reports_the_installation() -> None:
    text = shadowinv("info", "--system").stdout
    entries = dict(re.split(r"\s{2,}", line, maxsplit=1) for line in text.splitlines())
    assert entries["napari-shadowinv"] == __version__
    assert entries["python"].startswith(platform.python_version())
    for package in ("numpy", "scipy", "numba", "dask", "xarray", "zarr", "h5py"):
        assert entries[package] == metadata.version(package)
    assert platform.machine() in entries["platform"]
    assert entries["cores"].startswith(f"{os.cpu_count()}, ")
    size = physical_memory()
    assert entries["memory"] == ("unknown" if size is None else f"{size / 2**30:.1f} GiB")
    folder = code_folder()
    assert folder is not None
    assert Path(entries["compiled code"].rpartition(" (")[0]).expanduser() == folder


def test_report_lists_missing_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    def without_windows(name: str) -> str:
        if name in ("napari", "npe2", "qtpy", *_info.QT_BINDINGS):
            raise metadata.PackageNotFoundError(name)
        return metadata.version(name)

    monkeypatch.setattr(_info, "version", without_windows)
    entries = [line.split(maxsplit=1) for line in shadowinv("info", "--system").stdout.splitlines()]
    for name in ("napari", "npe2", "qtpy", "Qt"):
        assert [name, "not installed"] in entries
    only = {"PySide6_Essentials": "6.11.0"}
    monkeypatch.setattr(_info, "_version", only.get)
    entries = [line.split(maxsplit=1) for line in _info.system_report().splitlines()]
    assert ["Qt", "PySide6_Essentials 6.11.0"] in entries


def test_the_report_hides_the_home_folder(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setattr(Path, "home", lambda: folder)
    monkeypatch.setattr(machine_code, "code_folder", lambda: folder / "kept")
    text = shadowinv("info", "--system").stdout
    assert str(Path("~") / "kept") in text
    assert str(folder) not in text


def test_the_report_survives_a_compiler_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ImportError("llvmlite does not\nload")

    monkeypatch.setattr(machine_code, "code_folder", broken)
    last = shadowinv("info", "--system").stdout.splitlines()[-1]
    assert last.endswith("unknown: ImportError: llvmlite does not load")


def test_info_needs_a_file_or_report(refused: Callable[..., None]) -> None:
    refused("info", names="--system")
    refused("info", "shot.npy", "--system", names="no file")


def test_info_of_a_result_shows_options_and_peak(folder: Path, shot: Path) -> None:
    (folder / "setup.toml").write_text(PROTON_TOML)
    shadowinv("invert", shot, "--setup", "setup.toml", "--set=options.seed=12")
    text = " ".join(shadowinv("info", "shot.shadowinv").stdout.split())
    peak = np.hypot(*dataset("shot.shadowinv")["displacement"].values).max()
    for words in ("32 × 24 px", "seed = 12", "14.7 MeV proton", "shot.npy", "converged"):
        assert words in text
    match = re.search(r"peak \|d\| ([\d.]+) ± [\d.]+ px \([^)]+\), at", text)
    assert match
    assert float(match[1]) == pytest.approx(peak, rel=0.02)


def test_info_describes_a_foreign_field(folder: Path, inversion: Inversion) -> None:
    setup = ProtonSetup(
        energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
    )
    write("field.h5", inversion, setup=setup)
    write("kept.shadowinv", read("field.h5"))
    for name, kind in (("field.h5", "pradformat inversion"), ("kept.shadowinv", "another program")):
        text = " ".join(shadowinv("info", name).stdout.split())
        assert kind in text
        assert "14.7 MeV proton" in text


def test_demo_recovers_its_field(folder: Path) -> None:
    result = shadowinv("demo", "--set=options.n_sites=6000", "--noise", 0, "--out", "tour")
    assert result.exit_code == 0, result.output
    written = ["toroid_97.png", "toroid_97.shadowinv", "toroid_97_comparison.png"]
    assert sorted(content(folder / "tour")) == written
    (line,) = [line for line in result.stdout.splitlines() if line.split()[:1] == ["error"]][:1]
    peak, distance = (float(word) for word in line.split()[2:6:3])
    assert abs(peak) < 1
    assert distance < 2
    # 200 px of 1.5 µm, and a distance of 1.3 mm to the object and 20 mm behind it.
    assert "magnification 16.38" in flat(result.stdout)
    assert "field of view 300 × 300 µm" in flat(result.stdout)
    # The demo may repeat itself.
    again = shadowinv("demo", "--set=options.n_sites=200", "--noise", 0, "--out", "tour")
    assert again.exit_code == 0, again.output


@pytest.mark.parametrize("command", ["invert shot.npy", "fit shot.npy", "batch *.npy --out a.zarr"])
def test_setup_warnings_come_before_the_work(
    command: str, shot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise InputError("the work began")

    monkeypatch.setattr("napari_shadowinv.pipeline.run", stopped)
    monkeypatch.setattr("napari_shadowinv.pipeline.fit_run.fit", stopped)
    monkeypatch.setattr("napari_shadowinv.cli._batch.run_batch", stopped)
    Path("swapped.toml").write_text(PROTON_TOML.replace("= 0.01", "= 1").replace("0.3", "0.01"))
    lines = shadowinv(*command.split(), "--setup", "swapped.toml").stderr.splitlines()
    assert lines[0].startswith("setup: the magnification is 1.01")
    assert lines[-1].endswith("the work began")


@pytest.mark.parametrize(
    "command", ["invert shot.npy --setup swapped.toml", "rerun shot.shadowinv"]
)
def test_a_doubtful_setup_is_printed_once(command: str, shot: Path) -> None:
    Path("swapped.toml").write_text(PROTON_TOML.replace("= 0.01", "= 1").replace("0.3", "0.01"))
    if command.startswith("rerun"):
        shadowinv("invert", shot, "--setup", "swapped.toml", "--set=options.n_sites=200")
    result = shadowinv(*command.split())
    assert flat(result.stderr).count("setup: the magnification is 1.01") == 1
    assert "setup: the magnification" not in flat(result.stdout)
    assert "setup: the magnification is 1.01" in flat(shadowinv("info", "shot.shadowinv").stdout)


def test_info_lists_the_options_that_have_a_value(shot: Path) -> None:
    shadowinv("invert", shot, "--out", "chosen.shadowinv", "--set=options.n_sites=200")
    shadowinv("invert", shot, "--out", "automatic.shadowinv")
    assert "n_sites = 200" in flat(shadowinv("info", "chosen.shadowinv").stdout)
    text = flat(shadowinv("info", "automatic.shadowinv").stdout)
    assert "n_sites" not in text
    assert "= None" not in text
    assert "accuracy = 0.01" in text


@pytest.mark.skipif(sys.platform != "linux", reason="names there are text")
def test_a_name_that_is_not_text_is_stored_as_bytes(folder: Path, shot: Path) -> None:
    os.rename(shot, b"sh\xf6t.npy")
    result = shadowinv("invert", os.fsdecode(b"sh\xf6t.npy"), "--out", "a.shadowinv")
    assert result.exit_code == 0, result.output
    provenance = Provenance.of(dataset("a.shadowinv").attrs)
    assert provenance is not None
    assert provenance.image.file == r"sh\xf6t.npy"


def test_a_bug_keeps_its_traceback(shot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise ValueError("shapes do not broadcast")

    monkeypatch.setattr("napari_shadowinv.pipeline.inversion_run.invert", broken)
    result = shadowinv("invert", shot)
    assert isinstance(result.exception, ValueError)


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_while_computing_leaves_nothing(folder: Path) -> None:
    np.save("shot.npy", synthetic_image(gaussian_blob((100, 100), 100.0, 12.0).displacement))
    before = content(folder)
    with pressing_ctrl_c("transport", pause=0.05):
        result = shadowinv("invert", "shot.npy", "--set=options.n_sites=30000")
    assert (result.exit_code, result.stderr.strip()) == (130, "Cancelled")
    assert content(folder) == before


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_converted_by_a_library_still_cancels(folder: Path, shot: Path) -> None:
    half_imported = """
        from napari_shadowinv import io

        class HalfMade:
            def __del__(self):
                raise AttributeError("half made")

        kept = HalfMade()

        def read_shot(*arguments, **options):
            try:
                stall()
            except KeyboardInterrupt:
                raise ImportError("a part of the library failed to import")

        io.read_shot = read_shot
    """
    code, errors = interrupted(folder, half_imported, ["invert", "shot.npy"])
    assert (code, errors.strip()) == (130, "Cancelled")
    assert sorted(content(folder)) == ["shot.npy"]


@pytest.mark.parametrize("presses", [1, 2])
def test_ctrl_c_while_writing_keeps_the_old_result(
    folder: Path, shot: Path, monkeypatch: pytest.MonkeyPatch, presses: int
) -> None:
    """Also if it is pressed again before the clean-up after the first begins."""
    (folder / "shot.shadowinv").write_text("old")

    class Room:
        def __enter__(self) -> None:
            signal.raise_signal(signal.SIGINT)

        def __exit__(self, *_: object) -> None:
            pass

    def write_half(path: Path, _: bytes) -> None:
        path.write_text("half")
        if presses == 2:
            monkeypatch.setattr("napari_shadowinv.io.files.defer_interrupts", Room)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Path, "write_bytes", write_half)
    before = content(folder)
    result = shadowinv("invert", shot, "--overwrite")
    assert (result.exit_code, result.stderr.strip()) == (130, "Cancelled")
    assert content(folder) == before


@pytest.mark.draws_figures
@pytest.mark.parametrize("full", ["result", "figure"])
def test_a_full_disk_costs_the_figure_but_not_the_result(
    full: str, small_disk: tuple[Path, Callable[[str], bool]], shot: Path
) -> None:
    disk, resize = small_disk
    assert resize("64k")
    (disk / "other").write_bytes(bytes(60_000))
    out = disk / "a.shadowinv" if full == "result" else Path("a.shadowinv")
    figure = disk / "a.png" if full == "figure" else Path("a.png")
    result = shadowinv(
        "invert", shot, "--set=options.n_sites=300", "--out", out, "--figure", figure
    )
    assert result.exit_code == (2 if full == "result" else 1)
    (line,) = result.stderr.splitlines()
    assert f"{disk}/a." in line
    assert "cannot be written (No space left on device): free some disk space" in line
    assert [path.name for path in disk.iterdir()] == ["other"]
    is_written = full == "figure"
    assert sorted(content(shot.parent)) == ["a.shadowinv"] * is_written + ["shot.npy"]


def test_a_figure_that_fails_does_not_cost_the_result(
    folder: Path, shot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*arguments: Any, **keywords: Any) -> None:
        raise RuntimeError("latex was not able to process it")

    monkeypatch.setattr("napari_shadowinv.plotting.figures.report_figure", fail)
    result = shadowinv("invert", shot, "--set=options.n_sites=300")
    assert result.exit_code == 1, result.output
    assert sorted(content(folder)) == ["shot.npy", "shot.shadowinv"]
    assert "the figure shot.png could not be drawn" in result.stderr
    assert "latex was not able" in result.stderr
    assert "shot.shadowinv" in result.stdout
    assert "shot.png" not in result.stdout


SIGNAL_IN_IMPORT = """
class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == "napari_shadowinv.cli":
            press()
sys.meta_path.insert(0, Interrupted())
"""
SIGNAL_IN_FLAGS = """
import typer.main
build = typer.main.get_command
typer.main.get_command = lambda *arguments: press() or build(*arguments)
"""


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
@pytest.mark.parametrize("when", [SIGNAL_IN_IMPORT, SIGNAL_IN_FLAGS])
def test_ctrl_c_before_a_command_begins_is_one_word(when: str) -> None:
    script = """
import signal, sys
def press():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        pass  # as some libraries do
"""
    run = "from napari_shadowinv.__main__ import main\nmain()"
    ended = subprocess.run(
        [sys.executable, "-c", script + when + run, "--version"], capture_output=True, text=True
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (130, "", "Cancelled\n")


def test_the_package_runs_as_the_command() -> None:
    command = [sys.executable, "-m", "napari_shadowinv", "--version"]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stdout == f"shadowinv {__version__}\n"
