"""The commands that work on a shot, and what all commands share."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import xarray as xr
from scipy.io import savemat

from helpers.command_line import (
    content,
    done,
    flat,
    interrupted,
    pressing_ctrl_c,
    refused,
    shadowinv,
)
from helpers.image_files import save_pradformat
from helpers.results import provenance_in
from napari_shadowinv import __version__
from napari_shadowinv.cli._inputs import setup_for
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Assessment, Verdict
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.io import read, read_shot, write
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.preprocessing import Recipe

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


def test_the_program_shows_its_version_commands_and_flags() -> None:
    assert done("--version") == f"shadowinv {__version__}"
    text = done("invert", "--help")
    for word in ("--source", "--bin", "--set", "--step", "shadowinv invert shot.tif"):
        assert word in text
    alone = done(code=2)
    assert alone == done("-h")
    for command in COMMANDS:
        assert f"│ {command} " in alone


@pytest.mark.draws_figures
def test_invert_prints_its_result_and_draws_a_figure(folder: Path, shot: Path) -> None:
    (folder / "setup.toml").write_text(PROTON_TOML)
    printed = done("invert", shot, "--setup", "setup.toml")
    assert sorted(content(folder)) == ["setup.toml", "shot.npy", "shot.png", "shot.shadowinv"]
    assert len(np.unique(iio.imread("shot.png"))) > 100
    for word in ("limited by", "peak |", "T·m", "MG·µm", "shot.shadowinv", "shot.png"):
        assert word in printed


def test_colour_film_by_channel(folder: Path) -> None:
    red = np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint16)
    tifffile.imwrite("film.tif", np.stack([red, red // 2, red // 3], axis=-1), photometric="rgb")
    assert "wrong sign" in done("invert", "film.tif", "--channel", "red")
    image = read("film.shadowinv")["image"].values
    np.testing.assert_allclose(image / image.sum(), red / red.sum())
    warning = json.loads(read("film.shadowinv").attrs["report"])["cautions"][-1]
    assert warning["code"] == "film-scan"
    assert warning["text"].startswith("channel 'red' of a colour image was used as the fluence")


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
        printed = shadowinv(*arguments).stdout
        assert visible in printed.replace("\n", "")
        assert not set("\x1b\u202e") & set(printed)
    line = shadowinv("info", f"{name}.gone").stderr
    assert visible.replace(r"\n", " ") in line
    assert not set("\x1b\u202e") & set(line)


def test_unconverged_result_is_written_with_exit_code_3(folder: Path) -> None:
    np.save("shot.npy", synthetic_image(gaussian_blob((32, 32), 60.0, 4.0).displacement))
    few = ("--set=options.max_iterations=1", "--set=options.tolerance=1e-9")
    assert "NOT CONVERGED" in done("invert", "shot.npy", *few, code=3)
    assert not Inversion.from_dataset(read("shot.shadowinv")).report.converged


def test_an_output_replaces_what_is_no_input(folder: Path) -> None:
    iio.imwrite("shot.png", np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint8))
    before = content(folder)["shot.png"]
    (folder / "shot.shadowinv").write_text("old")
    done("invert", "shot.png", "--overwrite")
    assert sorted(content(folder)) == ["shot.png", "shot.shadowinv", "shot_report.png"]
    assert content(folder)["shot.png"] == before
    assert "displacement" in read("shot.shadowinv")
    Path("shot.shadowinv").rename("first.shadowinv")
    again = ("--out", "shot.shadowinv", "--overwrite")
    refused("rerun", "first.shadowinv", *again, names=("shot.png", "both read and written"))


def test_forward_predicts_the_image(folder: Path, shot: Path) -> None:
    done("invert", shot)
    saved = read("shot.shadowinv")
    done("forward", "shot.shadowinv", "--out", "again.npy")
    np.testing.assert_allclose(np.load("again.npy"), saved["reprojection"], rtol=1e-12)
    source = np.linspace(1, 2, 24 * 32).reshape(24, 32)
    np.save("beam.npy", source)
    done("forward", "shot.shadowinv", "--source", "beam.npy")
    image = tifffile.imread("shot_image.tif")
    assert image.dtype == np.float32
    expected = synthetic_image(saved["displacement"].values, source)
    np.testing.assert_allclose(image, expected, rtol=1e-6)


def test_forward_traces_a_3d_field(folder: Path) -> None:
    """A uniform field of 0.5 T along y in a box of 0.4 mm, as a simulation might leave it."""
    zeros = np.zeros((9, 9, 9))
    components = {"Bx": zeros, "By": zeros + 0.5, "Bz": zeros}
    xr.Dataset(
        {name: (("z", "y", "x"), values, {"units": "T"}) for name, values in components.items()},
        {axis: (axis, np.linspace(-0.2, 0.2, 9), {"units": "mm"}) for axis in "zyx"},
    ).to_netcdf("grid.nc", engine="h5netcdf")
    (folder / "setup.toml").write_text(PROTON_TOML)
    view = ("--set=view.right=-x", "--set=view.height=20", "--set=view.width=30")
    traced = done("forward", "grid.nc", "--setup", "setup.toml", *view, "--out", "image.tif")
    assert "faces reaches 100 %" in traced
    assert tifffile.imread("image.tif").shape == (20, 30)


def test_geometry_in_a_file_is_used_and_shown(folder: Path) -> None:
    geometry = {"source_object_dist": 0.01, "object_image_dist": 0.3, "pixel_width": 310e-6}
    image = synthetic_image(BLOB.displacement)
    save_pradformat(folder / "half.h5", image, **geometry)
    save_pradformat(folder / "all.h5", image, **geometry, spec_energy=14.7e6)
    text = done("info", "half.h5")
    for words in ("pradformat image", "source object distance (m) 0.01", "not the energy; give it"):
        assert words in text
    assert "14.7 MeV proton, magnification 31, pixel 10 µm at the object" in done("info", "all.h5")
    # What the file leaves out comes from the setup, with and without a kind.
    proton = 14.7, 0.3, pytest.approx(1e-5)
    for entries in ("energy = 14.7\n", 'kind = "proton"\nenergy = 14.7\n'):
        (folder / "energy.toml").write_text(entries)
        setup = setup_for(Path("energy.toml"), read_shot("half.h5"), Recipe())
        assert (setup.energy, setup.object_image_distance, setup.object_pixel_size) == proton


def test_rerun_lists_the_changes(folder: Path, shot: Path) -> None:
    done("invert", shot, "--out", "first.shadowinv")
    unchanged = "changed nothing difference none: the same result, bit for bit"
    assert unchanged in done("rerun", "first.shadowinv")
    assert {"first_again.shadowinv", "first_again.png"} <= content(folder).keys()
    # Another file of the same name, and another version.
    np.save(shot, 1.5 * np.load(shot) + 3)
    first = read("first.shadowinv")
    older = first.attrs["provenance"].replace(f'"version":"{__version__}"', '"version":"0.0.1"')
    write("old.shadowinv", first.assign_attrs(provenance=older))
    text = done("rerun", "old.shadowinv")
    for words in ("changed the image shot.npy differs", "displacement differs by up to"):
        assert words in text
    assert f"made by version 0.0.1, now {__version__}" in text
    shot.unlink()
    refused("rerun", "first.shadowinv", "--overwrite", names=("shot.npy", "does not exist"))


# A file, and words that describe its content.
DESCRIBED = {
    "a.npy": "(2, 3)|float64|-3, 1.8, 5|negative 1 values|NaN or infinite 1 values",
    "film.tif": "TIFF picture, 16 bits|channels 3|detector pixel size (m) 2e-05"
    "|turned upright as the file says|not proportional to the light",
    "shots.mat::beam": "mat image, array 'beam'|90, 100, 110",
    "shots.h5::day/d": "(2, 24, 32)",
    "kept.shadowinv": "another program|14.7 MeV proton",
    "fit.shadowinv": "one of several peak |; 2 different fields explain the data"
    "|alternative from near: objective +20 %, displacement 30 % away"
    # 64 × 48 px of 1.5 µm, (1.3 + 20) / 1.3.
    "|brightness 1.1, shifted by y|magnification 16.38|field of view 96 × 72 µm",
}


@pytest.mark.parametrize("name", DESCRIBED)
def test_info_describes_a_file(
    name: str, inversion: Inversion, make_fit: Callable[..., Fit], proton_setup: ProtonSetup
) -> None:
    if name == "a.npy":
        np.save(name, [[1.0, 2.0, np.nan], [-3.0, 4.0, 5.0]])
    elif name == "film.tif":
        dots = {"resolution": (500, 500), "resolutionunit": "CENTIMETER", "metadata": None}
        tags = [(274, "H", 1, 3, True), (34675, "B", 4, b"sRGB", True)]
        film = np.zeros((4, 5, 3), np.uint16)
        tifffile.imwrite(name, film, photometric="rgb", extratags=tags, **dots)
    elif name.startswith("shots.mat"):
        savemat("shots.mat", {"beam": np.tile(np.linspace(90, 110, 33), (24, 1))})
    elif name.startswith("shots.h5"):
        with h5py.File("shots.h5", "w") as file:
            file["day/d"] = BLOB.displacement
    elif name == "fit.shadowinv":
        several = Assessment(Verdict.SEVERAL, "2 different fields explain the data")
        write(name, make_fit(assessment=several, setups=(proton_setup, proton_setup)))
    else:
        field = inversion.displacement, inversion.potential, proton_setup
        write("kept.shadowinv", dataset_from_field(*field))
    text = done("info", name)
    for words in DESCRIBED[name].split("|"):
        assert words in text


def test_info_of_a_result_shows_options_with_a_value_and_peak(folder: Path, shot: Path) -> None:
    (folder / "setup.toml").write_text(PROTON_TOML)
    done("invert", shot, "--setup", "setup.toml", "--set=options.seed=12")
    text = done("info", "shot.shadowinv")
    peak = np.hypot(*read("shot.shadowinv")["displacement"].values).max()
    options = ("seed = 12", "accuracy = 0.01")
    for words in (*options, "32 × 24 px", "14.7 MeV proton", "shot.npy", "converged"):
        assert words in text
    assert not [words for words in ("n_sites", "= None") if words in text]
    match = re.search(r"peak \|d\| ([\d.]+) ± [\d.]+ px \([^)]+\), at", text)
    assert match
    assert float(match[1]) == pytest.approx(peak, rel=0.02)


def test_demo_recovers_its_field(folder: Path) -> None:
    printed = shadowinv("demo", "--set=options.n_sites=6000", "--noise", 0, "--out", "tour").stdout
    written = ["toroid_97.png", "toroid_97.shadowinv", "toroid_97_comparison.png"]
    assert sorted(content(folder / "tour")) == written
    line = next(line for line in printed.splitlines() if line.split()[:1] == ["error"])
    peak, distance = (float(word) for word in line.split()[2:6:3])
    assert abs(peak) < 1
    assert distance < 2
    # 200 px of 1.5 µm, and a distance of 1.3 mm to the object and 20 mm behind it.
    assert "magnification 16.38" in flat(printed)
    assert "field of view 300 × 300 µm" in flat(printed)
    # The demo may repeat itself.
    done("demo", "--set=options.n_sites=200", "--noise", 0, "--out", "tour")


SWAPPED = PROTON_TOML.replace("= 0.01", "= 1").replace("0.3", "0.01")
DOUBT = "setup: the magnification is 1.01"


@pytest.mark.parametrize("command", ["invert shot.npy", "fit shot.npy", "batch *.npy --out a.zarr"])
def test_setup_warnings_come_before_the_work(
    command: str, shot: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(*_: object, **__: object) -> None:
        raise InputError("the work began")

    monkeypatch.setattr("napari_shadowinv.pipeline.run", stopped)
    monkeypatch.setattr("napari_shadowinv.pipeline.fit_run.fit", stopped)
    monkeypatch.setattr("napari_shadowinv.cli._batch.run_batch", stopped)
    Path("swapped.toml").write_text(SWAPPED)
    lines = shadowinv(*command.split(), "--setup", "swapped.toml").stderr.splitlines()
    assert lines[0].startswith(DOUBT)
    assert lines[-1].endswith("the work began")


@pytest.mark.skipif(sys.platform != "linux", reason="names there are text")
def test_a_name_that_is_not_text_is_stored_as_bytes(folder: Path, shot: Path) -> None:
    os.rename(shot, b"sh\xf6t.npy")
    done("invert", os.fsdecode(b"sh\xf6t.npy"), "--out", "a.shadowinv")
    assert provenance_in("a.shadowinv").image.file == r"sh\xf6t.npy"


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
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert f"{disk}/a." in line
    assert "cannot be written (No space left on device): free some disk space" in line
    assert [path.name for path in disk.iterdir()] == ["other"]
    is_written = full == "figure"
    assert sorted(content(shot.parent)) == ["a.shadowinv"] * is_written + ["shot.npy"]


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
