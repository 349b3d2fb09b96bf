import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
import xarray as xr
from typer.testing import CliRunner, Result

from napari_shadowinv.cli import app
from napari_shadowinv.inversion import invert
from napari_shadowinv.io import inversion_from_dataset, read, setup_from_dataset
from napari_shadowinv.io.files import sha256
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

BLOB = gaussian_blob((24, 32), 6.0, 4.0, (10, 18))

PROTON_TOML = """
kind = "proton"
energy = 14.7
source_object_distance = 0.01
object_image_distance = 0.3
pixel_size = 1e-5
"""


def shadowinv(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def shot(folder: Path) -> Path:
    path = folder / "shot.npy"
    np.save(path, 100 * synthetic_image(BLOB.displacement))
    return path


@pytest.fixture
def refused(folder: Path) -> Callable[..., None]:
    """Run a command that must fail with one sentence and write nothing."""

    def run(*arguments: object, names: str | tuple[str, ...]) -> None:
        before = content(folder)
        result = shadowinv(*arguments)
        assert result.exit_code == 2, result.output
        (line,) = result.stderr.splitlines()
        for name in (names,) if isinstance(names, str) else names:
            assert name in line
        assert "Traceback" not in result.output
        assert content(folder) == before

    return run


def dataset(path: str | Path) -> xr.Dataset:
    found = read(path)
    assert isinstance(found, xr.Dataset)
    return found


def test_version_and_help() -> None:
    assert shadowinv("--version").output.split() == ["shadowinv", version("napari-shadowinv")]
    text = shadowinv("invert", "--help").output
    for word in ("--source", "--bin", "--clip-negative", "shadowinv invert shot.tif", "energy"):
        assert word in text


def test_help_needs_no_heavy_import() -> None:
    heavy = ["numba", "numpy", "pydantic", "xarray", "matplotlib", "scipy", "h5py"]
    code = f"import sys, napari_shadowinv.cli; print([m for m in {heavy!r} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.strip() == "[]", result.stderr


def test_invert_writes_what_the_core_returns(folder: Path, shot: Path) -> None:
    result = shadowinv("invert", shot, "--n-sites", 300, "--seed", 4)
    assert result.exit_code == 0, result.output
    assert sorted(content(folder)) == ["shot.npy", "shot.png", "shot.shadowinv"]
    saved = dataset("shot.shadowinv")
    options = InversionOptions(n_sites=300, seed=4)
    expected = invert(np.load(shot), options=options)
    np.testing.assert_array_equal(saved["displacement"], expected.displacement)
    assert inversion_from_dataset(saved).options == options
    assert saved.attrs["input_file"] == "shot.npy"
    assert saved.attrs["input_sha256"] == sha256(shot)
    assert iio.imread("shot.png").ndim == 3
    for word in ("300", "converged", "peak |d|", "shot.shadowinv", "shot.png"):
        assert word in result.stdout


def test_quiet_says_nothing(shot: Path) -> None:
    result = shadowinv("invert", shot, "--quiet")
    assert (result.exit_code, result.output) == (0, "")


def test_source_setup_and_options_are_used(folder: Path, shot: Path) -> None:
    source = np.tile(np.linspace(90, 110, 32), (24, 1))
    tifffile.imwrite("beam.tif", source.astype(np.float32))
    (folder / "setup.toml").write_text(PROTON_TOML)
    (folder / "options.toml").write_text("tolerance = 0.01\nn_sites = 50\n")
    arguments = ["--source", "beam.tif", "--setup", "setup.toml", "--options", "options.toml"]
    result = shadowinv("invert", shot, *arguments, "--n-sites", 200, "--out", "result.shadowinv")
    assert result.exit_code == 0, result.output
    saved = dataset("result.shadowinv")
    np.testing.assert_array_equal(saved["source"], source.astype(np.float32))
    assert saved.attrs["source_file"] == "beam.tif"
    # A flag wins over the file.
    assert inversion_from_dataset(saved).options == InversionOptions(n_sites=200, tolerance=0.01)
    assert setup_from_dataset(saved) == ProtonSetup(
        energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
    )
    assert "T·m" in result.stdout
    assert "MG·µm" in result.stdout


def test_a_mask_keeps_unusable_pixels_out(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    usable = np.full((24, 32), 255, np.uint8)
    usable[:6, :8] = 0
    iio.imwrite(folder / "mask.png", usable)
    image = np.load(shot)
    image[:6, :8] = 1e4
    np.save(shot, image)
    assert shadowinv("invert", shot, "--mask", folder / "mask.png", "-q").exit_code == 0
    written = inversion_from_dataset(read(folder / "shot.shadowinv"))
    np.testing.assert_array_equal(written.mask, usable > 0)
    np.testing.assert_array_equal(
        written.potential, invert(np.load(shot), mask=usable > 0).potential
    )
    iio.imwrite(folder / "small.png", usable[1:])
    refused(
        "invert",
        shot,
        "--mask",
        folder / "small.png",
        "--overwrite",
        names=("small.png", "(23, 32)"),
    )


def test_bin_sums_and_widens_pixels(folder: Path) -> None:
    image = 100 * synthetic_image(gaussian_blob((50, 63), 20.0, 8.0).displacement)
    np.save("fine.npy", image)
    (folder / "light.toml").write_text(
        'kind = "optical"\nwavelength = 5e-7\nobject_image_distance = 0.1\npixel_size = 1e-5\n'
    )
    arguments = ["--bin", 2, "--setup", "light.toml", "--source", "fine.npy"]
    result = shadowinv("invert", "fine.npy", *arguments)
    assert result.exit_code == 0, result.output
    saved = dataset("fine.shadowinv")
    blocks = image[:50, :62].reshape(25, 2, 31, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(saved["source"], blocks)
    setup = setup_from_dataset(saved)
    assert isinstance(setup, OpticalSetup)
    assert setup.pixel_size == 2e-5
    assert "binned 2 × 2, 0 rows and 1 columns cut off" in " ".join(result.stdout.split())


def test_pradformat_in_and_out(folder: Path) -> None:
    with h5py.File("shot.h5", "w") as file:
        file["image"] = 100 * synthetic_image(BLOB.displacement)
        file.attrs.update(
            object_type="radiograph",
            pixel_width=3.1e-4,
            source_object_dist=0.01,
            object_image_dist=0.3,
        )
    # The file knows the geometry, the setup only what it leaves out.
    (folder / "energy.toml").write_text("energy = 14.7\n")
    result = shadowinv("invert", "shot.h5", "--setup", "energy.toml", "--out", "field.h5")
    assert result.exit_code == 0, result.output
    setup = setup_from_dataset(dataset("field.h5"))
    assert isinstance(setup, ProtonSetup)
    assert setup.object_pixel_size == pytest.approx(1e-5)
    with h5py.File("field.h5") as file:
        assert file.attrs["radiograph_filename"] == "shot.h5"
        np.testing.assert_allclose(
            setup.displacement(file["defl_ax2"][()]),
            invert(100 * synthetic_image(BLOB.displacement)).displacement[1],
            rtol=1e-9,
            atol=1e-12,
        )


def test_colour_film_by_channel(folder: Path) -> None:
    red = np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint16)
    tifffile.imwrite("film.tif", np.stack([red, red // 2, red // 3], axis=-1), photometric="rgb")
    result = shadowinv("invert", "film.tif", "--channel", "red")
    assert result.exit_code == 0, result.output
    image = dataset("film.shadowinv")["image"].values
    np.testing.assert_allclose(image / image.sum(), red / red.sum())


def test_negative_pixels_are_clipped_counted_and_reported(folder: Path) -> None:
    image = synthetic_image(BLOB.displacement)
    image[3, 4:7] = -0.1
    np.save("shot.npy", image)
    result = shadowinv("invert", "shot.npy", "--clip-negative")
    assert result.exit_code == 0, result.output
    inversion = inversion_from_dataset(dataset("shot.shadowinv"))
    assert inversion.report.clipped_pixels == 3
    assert (inversion.image[3, 4:7] == 0).all()
    assert "3 clipped" in " ".join(result.stdout.split())


def test_unconverged_result_is_written_with_an_alarm(folder: Path) -> None:
    np.save("shot.npy", synthetic_image(gaussian_blob((32, 32), 60.0, 4.0).displacement))
    (folder / "few.toml").write_text("max_iterations = 1\ntolerance = 1e-9\n")
    result = shadowinv("invert", "shot.npy", "--options", "few.toml")
    assert result.exit_code == 3, result.output
    assert "NOT CONVERGED" in result.stderr
    assert not inversion_from_dataset(dataset("shot.shadowinv")).report.converged


def test_figure_of_a_png_gets_another_name(folder: Path) -> None:
    iio.imwrite("shot.png", np.rint(100 * synthetic_image(BLOB.displacement)).astype(np.uint8))
    before = content(folder)["shot.png"]
    assert shadowinv("invert", "shot.png", "--overwrite").exit_code == 0
    assert sorted(content(folder)) == ["shot.png", "shot.shadowinv", "shot_report.png"]
    assert content(folder)["shot.png"] == before


def test_existing_files_are_replaced_only_if_asked(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    (folder / "shot.shadowinv").write_text("old")
    refused("invert", shot, names=("shot.shadowinv exists", "--overwrite"))
    assert shadowinv("invert", shot, "--overwrite").exit_code == 0
    assert "displacement" in dataset("shot.shadowinv")
    (folder / "shot.shadowinv").unlink()
    refused("invert", shot, names="shot.png exists")


def test_outputs_without_a_place_are_refused(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    refused("invert", shot, "--out", "nowhere/a.shadowinv", names="folder nowhere does not exist")
    refused("invert", shot, "--report", "nowhere/a.png", names="folder nowhere does not exist")
    refused("invert", shot, "--out", "a.xlsx", names=".xlsx")
    refused("invert", shot, "--out", folder, names="its ending is none")
    refused("forward", shot, "--out", shot, "--overwrite", names="both read and written")
    refused("invert", shot, "--out", "a.h5", names="needs a setup of kind 'proton'")


def test_files_that_are_no_image_are_refused(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    refused("invert", "missing.tif", names=("missing.tif", "does not exist"))
    refused("invert", shot, "--source", "missing.tif", names=("missing.tif", "does not exist"))
    (folder / "empty.tif").write_bytes(b"")
    refused("invert", "empty.tif", names=("empty.tif", "is empty"))
    (folder / "notes.tif").write_text("not an image\n")
    refused("invert", "notes.tif", names=("notes.tif", "text file"))
    (folder / "cut.npy").write_bytes(shot.read_bytes()[:-100])
    refused("invert", "cut.npy", names=("cut.npy", "cut short"))
    refused("invert", folder, names="is a folder")
    refused("info", "missing.tif", names="missing.tif")
    refused("forward", "missing.tif", names="missing.tif")


@pytest.mark.parametrize(
    ("value", "name"), [(np.nan, "NaN"), (np.inf, "infinite"), (-1.0, "1 negative")]
)
def test_impossible_pixels_are_refused(
    shot: Path, refused: Callable[..., None], value: float, name: str
) -> None:
    image = np.load(shot)
    image[5, 6] = value
    np.save(shot, image)
    refused("invert", shot, names=("shot.npy", name))


def test_impossible_images_and_sources_are_refused(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    np.save("zero.npy", np.zeros((24, 32)))
    np.save("small.npy", np.ones((20, 20)))
    refused("invert", "zero.npy", names=("zero.npy", "no positive pixel"))
    refused("invert", shot, "--source", "zero.npy", names="source is zero")
    refused("invert", shot, "--source", "small.npy", names=("(20, 20)", "(24, 32)"))
    refused("invert", shot, "--bin", 0, names="by 0")
    refused("invert", shot, "--bin", 20, names="by 20")


def test_impossible_numbers_of_sites_are_refused(shot: Path, refused: Callable[..., None]) -> None:
    refused("invert", shot, "--n-sites", 3, names=("n_sites", "3", "at least 4"))
    refused("invert", shot, "--n-sites", 10**12, names=("1,000,000,000,000 sites", "GB"))


@pytest.mark.parametrize(
    ("line", "names"),
    [
        ("energy = 0", ("'energy'", "0", "greater than")),
        ("energy = -14.7", ("'energy'", "-14.7")),
        ("object_image_distance = 0", ("'object_image_distance'", "0")),
        ("source_object_distance = -0.01", ("'source_object_distance'", "-0.01")),
        ("enerky = 14.7", ("enerky", "'energy'")),
        ("energy = # MeV\n", ("not valid TOML", "line")),
    ],
)
def test_mistakes_in_a_setup_are_named(
    folder: Path,
    shot: Path,
    refused: Callable[..., None],
    line: str,
    names: tuple[str, ...],
) -> None:
    key = line.split()[0].replace("enerky", "energy")
    kept = [old for old in PROTON_TOML.splitlines() if not old.startswith(key)]
    (folder / "setup.toml").write_text("\n".join([*kept, line]))
    refused("invert", shot, "--setup", "setup.toml", names=("setup.toml", *names))


def test_mistakes_in_options_are_named(
    folder: Path, shot: Path, refused: Callable[..., None]
) -> None:
    for text, names in (
        ("tolerence = 0.1", ("'tolerence'", "'tolerance'")),
        ("tolerance = 2", ("'tolerance'", "2", "less than 1")),
        ("tolerance 0.1\n", ("not valid TOML", "line 1")),
    ):
        (folder / "options.toml").write_text(text)
        refused("invert", shot, "--options", "options.toml", names=("options.toml", *names))


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


def test_forward_refuses_what_is_no_field(folder: Path, refused: Callable[..., None]) -> None:
    np.save("three.npy", np.zeros((3, 24, 32)))
    refused("forward", "three.npy", names=("three.npy", "(3, 24, 32)"))
    iio.imwrite("shot.png", np.zeros((24, 32), np.uint8))
    refused("forward", "shot.png", names="a PNG picture")
    np.save("d.npy", np.zeros((2, 24, 32)))
    np.save("beam.npy", np.ones((9, 9)))
    refused("forward", "d.npy", "--source", "beam.npy", names=("(9, 9)", "(24, 32)"))


def test_info_tells_what_is_inside(folder: Path) -> None:
    values = np.array([[1.0, 2.0, np.nan], [-3.0, 4.0, 5.0]])
    np.save("a.npy", values)
    text = " ".join(shadowinv("info", "a.npy").stdout.split())
    assert "(2, 3)" in text
    assert "float64" in text
    assert "-3, 1.8, 5" in text
    assert "negative 1 values" in text
    assert "NaN or infinite 1 values" in text
    tifffile.imwrite("film.tif", np.zeros((4, 5, 3), np.uint16), photometric="rgb")
    text = " ".join(shadowinv("info", "film.tif").stdout.split())
    assert "TIFF picture, 16 bits" in text
    assert "channels 3" in text


def test_info_of_a_result_tells_options_and_peak(folder: Path, shot: Path) -> None:
    (folder / "setup.toml").write_text(PROTON_TOML)
    shadowinv("invert", shot, "--setup", "setup.toml", "--seed", 12)
    text = " ".join(shadowinv("info", "shot.shadowinv").stdout.split())
    peak = np.hypot(*dataset("shot.shadowinv")["displacement"].values).max()
    for words in ("32 × 24 px", "seed = 12", "14.7 MeV proton", "shot.npy", "converged"):
        assert words in text
    assert f"peak |d| {peak:.3g} px" in text


def test_demo_finds_the_field_that_it_made(folder: Path) -> None:
    result = shadowinv("demo", "--n-sites", 6000, "--noise", 0, "--out", "tour")
    assert result.exit_code == 0, result.output
    written = ["toroid_97.png", "toroid_97.shadowinv", "toroid_97_comparison.png"]
    assert sorted(content(folder / "tour")) == written
    (line,) = [line for line in result.stdout.splitlines() if line.split()[:1] == ["error"]][:1]
    peak, distance = (float(word.strip("%,")) for word in line.split()[2:5:2])
    assert abs(peak) < 1
    assert distance < 2
    # The demo may repeat itself.
    again = shadowinv("demo", "--n-sites", 200, "--noise", 0, "--out", "tour")
    assert again.exit_code == 0, again.output


def test_demo_refuses_nonsense(folder: Path, refused: Callable[..., None]) -> None:
    refused("demo", "--noise", -1, names="noise is -1")
    refused("demo", "--n-sites", 2, names="n_sites")
    (folder / "demo").write_text("a file")
    refused("demo", names=("demo", "cannot be made a folder"))


def test_our_own_bug_is_not_blamed_on_the_user(shot: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*arguments: object, **options: object) -> None:
        raise ValueError("shapes do not broadcast")

    monkeypatch.setattr("napari_shadowinv.inversion.invert", broken)
    result = shadowinv("invert", shot)
    assert isinstance(result.exception, ValueError)


def interrupted(folder: Path, preparation: str, arguments: list[str]) -> tuple[int, str]:
    """Run the command in its own process, and press Ctrl-C when it has said "now"."""
    script = textwrap.dedent(preparation) + "\nfrom napari_shadowinv.cli import app\napp()\n"
    process = subprocess.Popen(
        [sys.executable, "-c", script, *arguments],
        cwd=folder,
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
    return process.returncode, errors


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_while_computing_leaves_nothing(folder: Path) -> None:
    np.save("shot.npy", synthetic_image(gaussian_blob((100, 100), 100.0, 12.0).displacement))
    say_when = """
        import contextlib
        from napari_shadowinv.cli import _progress

        @contextlib.contextmanager
        def bars():
            yield lambda progress: print("now" if progress.stage == "transport" else "")

        _progress.progress_bars = bars
    """
    before = content(folder)
    code, errors = interrupted(folder, say_when, ["invert", "shot.npy", "--n-sites", "30000"])
    assert (code, errors.strip()) == (130, "Cancelled")
    assert content(folder) == before


@pytest.mark.skipif(os.name == "nt", reason="SIGINT cannot be sent to one process there")
def test_ctrl_c_while_writing_keeps_the_old_result(folder: Path, shot: Path) -> None:
    (folder / "shot.shadowinv").write_text("old")
    slow_disk = """
        import time
        from napari_shadowinv.io import writing

        def write_slowly(path, dataset):
            path.write_text("half")
            print("now")
            time.sleep(60)

        writing.write_result = write_slowly
    """
    before = content(folder)
    code, errors = interrupted(folder, slow_disk, ["invert", "shot.npy", "--overwrite"])
    assert (code, errors.strip()) == (130, "Cancelled")
    assert content(folder) == before
