"""`shadowinv batch`, `status`, `export` and `movie`."""

from __future__ import annotations

import csv
import hashlib
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile
from typer.testing import Result

from helpers.command_line import flat, interrupted, shadowinv
from napari_shadowinv import InversionOptions, invert, read, synthetic_image
from napari_shadowinv.cli._batch import _Printer
from napari_shadowinv.cli._terminal import progress_bars
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.facts import Level, Verdict, percent
from napari_shadowinv.io import store_writing
from napari_shadowinv.io.store import DONE, PENDING, StackStore
from napari_shadowinv.provenance import Provenance
from napari_shadowinv.stack import RunStatus

HERE = Path(__file__).parent
BATCH = ["batch", "shots/shot_*.npy", "--out", "n.shadowinv.zarr", "--set=options.n_sites=100"]
OPTICAL = """
kind = "optical"
wavelength = 532e-9
object_image_distance = 0.3
pixel_size = 2e-5
"""
PROTON = """
kind = "proton"
energy = 14.7
source_object_distance = 0.01
object_image_distance = 0.3
pixel_size = 1e-5
"""


@pytest.fixture
def folder(night, tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)  # Ctrl-C changes it
    np.save("reference.npy", night.source)
    Path("setup.toml").write_text(OPTICAL)
    return tmp_path


def batch(*more: object) -> Result:
    return shadowinv(
        "batch", "shots/shot_*.npy", "--source", "reference.npy", "--out", "n.shadowinv.zarr",
        "--set=options.n_sites=100", "--scheduler", "threads", "--set=instrument.beam_rms=0", *more,
    )  # fmt: skip


@pytest.fixture(scope="module")
def finished(any_night, tmp_path_factory) -> Path:
    """A finished run, as the command of `batch` makes it."""
    place = tmp_path_factory.mktemp("finished")
    np.save(place / "reference.npy", any_night.source)
    (place / "setup.toml").write_text(OPTICAL)
    result = shadowinv(
        "batch", any_night.glob, "--source", place / "reference.npy", "--set=options.n_sites=100",
        "--setup", place / "setup.toml", "--scheduler", "threads", "--set=instrument.beam_rms=0",
        "--out", place / "n.shadowinv.zarr",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return place / "n.shadowinv.zarr"


@pytest.fixture
def store(folder, finished) -> Path:
    """A copy of the store, next to the same shots."""
    shutil.copytree(finished, folder / "n.shadowinv.zarr")
    return folder / "n.shadowinv.zarr"


def test_batch_writes_and_reports_shots(night, folder):
    result = batch("--setup", "setup.toml")
    assert result.exit_code == 0
    assert "6 done, 0 failed, 0 pending" in flat(result.output)
    dataset = read("n.shadowinv.zarr")
    alone = invert(night.images[2], source=night.source, options=InversionOptions(n_sites=100))
    np.testing.assert_allclose(dataset.potential[2], alone.potential, rtol=1e-6, atol=1e-6)
    provenance = Provenance.of(dataset.attrs)
    assert provenance is not None
    assert provenance.image.source is not None
    assert provenance.image.source.file == "reference.npy"
    assert "line_integrated_density" in dataset
    reports = StackStore(Path("n.shadowinv.zarr")).reports()
    total = np.median([report["total_error"] for report in reports])
    status = flat(shadowinv("info", "n.shadowinv.zarr").output)
    for text in flat(result.output), status:
        assert "100; as requested" in text
        assert f"errors {100 * total:.2g} % of the displacement (r.m.s., median" in text


def test_shots_that_fail_are_named_and_the_exit_code_is_one(night, folder):
    night.path(1).write_bytes(b"")
    np.save(night.path(4), 0 * night.images[4])
    result = batch()
    assert result.exit_code == 1
    text = flat(result.output)
    assert "4 done, 2 failed, 0 pending" in text
    assert "shot_1.npy" in text
    assert "is empty" in text
    assert "shot_4.npy: image has no positive pixel" in text
    status = flat(shadowinv("info", "n.shadowinv.zarr").output)
    assert "4 done, 2 failed, 0 pending" in status
    assert "shot_4.npy: image has no positive pixel" in status
    every = shadowinv("info", "n.shadowinv.zarr", "--all").output
    for index in range(6):
        assert f"shot_{index}.npy" in every
    for index in (1, 4):
        np.save(night.path(index), night.images[index])
    assert batch("--set=run.redo_failed=true").exit_code == 0


def test_existing_store_is_neither_resumed_nor_replaced(store):
    before = store.stat().st_mtime_ns
    refused = batch("--setup", "setup.toml")
    assert refused.exit_code == 2
    assert "exists (6 done, 0 failed, 0 pending): use --resume to continue" in flat(refused.output)
    assert batch("--resume", "--overwrite").exit_code == 2
    assert store.stat().st_mtime_ns == before
    resumed = batch("--setup", "setup.toml", "--resume")
    assert resumed.exit_code == 0
    assert "nothing to do" in flat(resumed.output)
    second_run = batch("--resume")
    assert second_run.exit_code == 2
    assert "was started with a different setup" in flat(second_run.output)
    assert batch("--overwrite").exit_code == 0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["batch", "no/*.tif", "--out", "a.shadowinv.zarr"], "no file matches no/*.tif"),
        (["batch", "shots/*.npy", "--out", "a.zarr"], "ends with .shadowinv.zarr"),
        (["batch", "shots/*.npy", "--out", "a.shadowinv.zarr", "--source", "x.tif"], "not exist"),
        (["info", "shots", "--all"], "is not a stack of shots"),
        (["info", "none.shadowinv.zarr"], "none.shadowinv.zarr does not exist"),
        (["export", "shots", "--format", "csv"], "is not a stack of shots"),
    ],
)
def test_batch_mistakes_give_a_sentence_and_write_nothing(folder, arguments, words):
    before = sorted(folder.rglob("*"))
    result = shadowinv(*arguments)
    assert result.exit_code == 2
    assert words in flat(result.output)
    assert sorted(folder.rglob("*")) == before


def test_nothing_is_written_among_the_files_of_a_store(store):
    before = sorted(store.rglob("*"))
    for arguments in (
        ["export", store, "--format", "tiff", "--out", store, "--overwrite"],
        ["export", store, "--format", "csv", "--out", store / "table.csv"],
        ["movie", store, "--out", store / "film.gif"],
    ):
        result = shadowinv(*arguments)
        assert result.exit_code == 2
        assert "is inside the store being read" in flat(result.output)
    assert sorted(store.rglob("*")) == before


def test_shots_are_exported_as_tiff(store):
    result = shadowinv(
        "export", store, "--format", "tiff", "--shots", "1:3,5", "--variables",
        "potential,displacement", "--out", "tiffs",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    dataset = read(store)
    names = sorted(path.name for path in Path("tiffs").iterdir())
    assert len(names) == 3 * 3
    plane = tifffile.imread("tiffs/0005_shot_5_displacement_x.tif")
    np.testing.assert_array_equal(plane, dataset.displacement.sel(component="x")[5])
    again = shadowinv("export", store, "--format", "tiff", "--shots", "1", "--out", "tiffs")
    assert again.exit_code == 2
    assert "exists" in again.output


def test_shots_are_exported_as_pradformat_for_particle_beams(store):
    refused = shadowinv("export", store, "--format", "pradformat")
    assert refused.exit_code == 2
    assert not Path("n").exists()
    Path("setup.toml").write_text(PROTON)
    assert batch("--setup", "setup.toml", "--overwrite").exit_code == 0
    assert shadowinv("export", store, "--format", "pradformat", "--shots", "4").exit_code == 0
    (path,) = Path("n").iterdir()
    with h5py.File(path) as file:
        assert file.attrs["radiograph_filename"] == "shot_4.npy"
    exported = read(path)
    provenance, of_store = Provenance.of(exported.attrs), Provenance.of(read(store).attrs)
    assert provenance.image.file == "shot_4.npy"
    assert (
        provenance.image.sha256 == hashlib.sha256(Path("shots/shot_4.npy").read_bytes()).hexdigest()
    )
    assert provenance.recipe == of_store.recipe
    np.testing.assert_allclose(exported.displacement, read(store).displacement[4], atol=1e-6)


def test_a_table_of_all_shots_is_exported_as_csv(night, folder):
    np.save(night.path(2), 0 * night.images[2])
    assert batch().exit_code == 1
    assert shadowinv("export", "n.shadowinv.zarr", "--format", "csv").exit_code == 0
    with Path("n.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["name"] for row in rows] == [f"shot_{i}.npy" for i in range(6)]
    assert rows[2]["status"] == "failed"
    assert "no positive pixel" in rows[2]["reason"]
    store = read("n.shadowinv.zarr")
    assert float(rows[3]["image_residual"]) == float(store.image_residual[3])
    status = shadowinv("info", "n.shadowinv.zarr", "--all").output
    assert percent(float(store.image_residual[3])) in flat(status)
    mask = store.mask.values[3]
    largest = np.hypot(*store.displacement.values[3])[mask].max()
    assert float(rows[3]["displacement_peak (px)"]) == pytest.approx(largest, rel=1e-6)


def test_status_of_all_shots_fits_80_columns(night, folder, monkeypatch):
    name = "n.shadowinv.zarr"
    np.save(night.path(2), 0 * night.images[2])
    assert batch().exit_code == 1
    monkeypatch.setenv("COLUMNS", "80")
    status = shadowinv("info", name, "--all").output
    lines = status.splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.rstrip() for line in lines if " shot_" in line]
    assert sum(row.endswith("%") for row in rows) == 5
    assert sum(row.split()[2:] == ["failed"] for row in rows) == 1
    reasons = status.split("Reasons and warnings")[1]
    assert (
        reasons.split("shot 2", 1)[1]
        .split("\n")[0]
        .strip()
        .startswith("image has no positive pixel")
    )


def test_progress_of_a_batch_fits_80_columns(folder, monkeypatch):
    text = io.StringIO()
    monkeypatch.setattr(sys, "stderr", text)
    for name, value in {"COLUMNS": "80", "FORCE_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    status = RunStatus(
        total=500, done=121, failed=2, waiting=377, ended=60, seconds=300.0, scheduler="4 threads",
        name="a_long_name_of_a_shot_of_the_night_0123.tif",
    )  # fmt: skip
    with progress_bars() as show:
        _Printer(quiet=True, show=show).update(status)
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", text.getvalue()))
    assert max(map(len, lines)) <= 80
    assert any("4 threads" in line and "121 of 500 done" in line for line in lines)


@pytest.mark.parametrize("text", ["6", "a", "1:2:3:4", ""])
def test_shots_that_do_not_exist_are_refused(store, text):
    result = shadowinv("export", store, "--format", "tiff", "--shots", text)
    assert result.exit_code == 2
    assert "expected numbers from 0 to 5" in flat(result.output)


@pytest.mark.parametrize("name", ["plume.gif", "plume.mp4"])
def test_a_film_has_a_frame_for_each_shot(store, name):
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg")
    result = shadowinv("movie", store, "-o", name, "--shots", "1:5")
    assert result.exit_code == 0, result.output
    frames = iio.imread(name)
    assert len(frames) == 4
    assert all(length % 2 == 0 for length in frames.shape[1:3])
    assert not np.array_equal(frames[0], frames[2])
    assert shadowinv("movie", store, "-o", name).exit_code == 2  # it exists


@pytest.mark.parametrize("name", ["plume.gif", "plume.mp4"])
def test_a_film_on_a_full_disk_is_refused_and_the_old_one_kept(store, small_disk, name):
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg")
    disk, resize = small_disk
    film = disk / name
    film.write_bytes(bytes(8000))
    assert resize("16k")
    result = shadowinv("movie", store, "-o", film, "--overwrite")
    assert result.exit_code == 2, result.output
    assert f"{film} cannot be written" in flat(result.output)
    assert "No space left on device" in flat(result.output)
    assert "Wrote" not in result.output
    assert film.read_bytes() == bytes(8000)
    assert list(disk.iterdir()) == [film]


# A process of its own: what remains of a writer shows as it ends.
_SMALL_FILES = """
import resource, sys
from pathlib import Path
import numpy as np
from napari_shadowinv.plotting import write_film

frames = np.random.default_rng(0).integers(0, 255, (4, 50, 50, 3), np.uint8)
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, most))
try:
    write_film(Path(sys.argv[1]), frames, 10.0)
except OSError as error:
    print(error)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="files have no limit there")
def test_a_film_that_finds_no_room_is_refused_in_one_line(tmp_path):
    film = tmp_path / "plume.gif"
    command = [sys.executable, "-c", _SMALL_FILES, str(film)]
    printed = subprocess.run(command, capture_output=True, text=True)
    assert (printed.returncode, printed.stderr) == (0, "")
    (line,) = printed.stdout.splitlines()
    assert line.startswith(f"{film} cannot be written (")
    assert list(tmp_path.iterdir()) == []


def test_a_film_that_cannot_be_read_back_is_none(store, monkeypatch):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", lambda path: (5, 0.5))
    result = shadowinv("movie", store, "-o", "plume.mp4")
    assert result.exit_code == 2
    assert "ffmpeg: 5 of 6 frames can be read back" in flat(result.output)
    assert not list(Path().glob("*plume*"))


@pytest.mark.parametrize("name", ["plume.gif", "plume.mp4"])
@pytest.mark.parametrize("error", [FileFormatError("shot 3 is damaged"), KeyboardInterrupt()])
def test_a_film_that_ends_early_leaves_nothing(tmp_path, name, error):
    from napari_shadowinv.plotting import write_film

    def frames():
        yield np.zeros((40, 60, 3), np.uint8)
        raise error

    with pytest.raises(type(error)) as raised:
        write_film(tmp_path / name, frames(), 10.0)
    assert raised.value is error
    assert list(tmp_path.iterdir()) == []


def test_the_colour_scale_of_a_film_is_fixed(store):
    from napari_shadowinv.plotting import stack_frames

    dataset = read(store)
    brightest = int(np.argmax([float(dataset.potential[i].max()) for i in range(6)]))
    alone = next(stack_frames(dataset.isel(shot=[0]), "potential", limits=(0, 1)))
    together = list(stack_frames(dataset, "potential", limits=(0, 1)))
    np.testing.assert_array_equal(together[0], alone)
    scaled = list(stack_frames(dataset, "potential"))
    # The same value has the same colour in all shots: the colour bar's pixels never change.
    bar = slice(int(0.82 * alone.shape[1]), None)
    for frame in scaled:
        np.testing.assert_array_equal(frame[60:, bar], scaled[brightest][60:, bar])


def test_masked_pixels_leave_a_film_as_it_is(store):
    from napari_shadowinv.plotting import stack_frames

    dataset = read(store).load()
    mask = np.ones(dataset.potential.shape[1:], bool)
    mask[3:9, 3:9] = False
    clean = dataset.assign(mask=(("y", "x"), mask))
    wild = clean.assign(potential=clean.potential.where(mask, 1e6))
    frames = list(stack_frames(wild, "potential"))
    for frame, expected in zip(frames, stack_frames(clean, "potential"), strict=True):
        np.testing.assert_array_equal(frame, expected)
    # The mask of a fit's images: a pixel counts that one of them shows.
    both = np.stack([mask, np.ones_like(mask)])
    fit_frames = stack_frames(wild.assign(mask=(("image", "y", "x"), both)), "potential")
    assert not np.array_equal(next(fit_frames), frames[0])


def test_a_gif_keeps_the_colours_of_its_scale(store):
    from napari_shadowinv.plotting import stack_frames

    assert shadowinv("movie", store, "-o", "film.gif").exit_code == 0
    drawn = np.array(list(stack_frames(read(store))), dtype=int)
    # A palette of 256 colours for each frame; antialiased letters are not in it.
    difference = np.abs(iio.imread("film.gif") - drawn)
    assert difference.mean() < 0.5
    assert np.quantile(difference, 0.99) <= 6


def test_without_its_package_mp4_is_refused_in_one_sentence(store, monkeypatch):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    result = shadowinv("movie", store, "-o", "plume.mp4")
    assert result.exit_code == 2
    assert "plume.mp4 needs the package imageio-ffmpeg" in flat(result.output)
    assert not Path("plume.mp4").exists()


def test_ctrl_c_leaves_a_store_that_is_resumed(folder, monkeypatch):
    update, out = _Printer.update, folder / "n.shadowinv.zarr"

    def update_and_interrupt(printer, status):
        update(printer, status)
        if status.outcome is not None:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(_Printer, "update", update_and_interrupt)
        cancelled = batch("--workers", 1)
    assert cancelled.exit_code == 130
    (sentence,) = cancelled.stderr.splitlines()
    assert sentence.startswith("Cancelled: 1 done, 0 failed, 5 pending. Repeat the command with")
    assert StackStore(out).statuses().tolist() == [DONE] + [PENDING] * 5
    assert batch("--resume", "--quiet").exit_code == 0
    assert (StackStore(out).statuses() == DONE).all()


@pytest.mark.skipif(os.name != "posix", reason="signals to a process group")
def test_ctrl_c_while_workers_start_gives_one_sentence(night, folder):
    starting = """
        from concurrent.futures import ProcessPoolExecutor

        class Pool(ProcessPoolExecutor):
            def __init__(self, *arguments):
                print("now")
                super().__init__(*arguments)

        from napari_shadowinv.stack import _schedulers
        _schedulers.ProcessPoolExecutor = Pool
    """
    processes = ["--scheduler", "processes", "--workers", "1"]
    # When the workers are about to import their modules.
    code, output = interrupted(folder, starting, [*BATCH, *processes], 0.6)
    assert code == 130
    (sentence,) = output.splitlines()
    assert sentence.endswith("Repeat the command with --resume to continue.")
    # The store may be there by then.
    assert re.match(r"Cancelled: (nothing written|0 done, 0 failed, 6 pending)\. ", sentence)


def test_ctrl_c_while_the_store_is_made_leaves_nothing(folder, monkeypatch):
    """Zarr writes in a thread of its own, which would go on after the interrupt."""
    write = store_writing._write_template

    def write_slowly(path, *arguments):
        write(path, *arguments)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.3)
        Path(path, "late").mkdir(parents=True)

    before = sorted(folder.rglob("*"))
    with ThreadPoolExecutor(1) as pool:
        monkeypatch.setattr(
            store_writing,
            "_write_template",
            lambda *each: pool.submit(write_slowly, *each).result(),
        )
        result = batch()
    assert result.exit_code == 130
    assert "Cancelled: nothing written" in result.output
    assert sorted(folder.rglob("*")) == before


def test_status_counts_verdicts_and_lists_warnings_once(store):
    reports = StackStore(store).reports()
    assert {report["level"] for report in reports} <= set(Level)
    assert all("peak" in report["headline"] for report in reports)
    doubtful = [report for report in reports if report["level"] == "doubtful"]
    assert all(report["warnings"] for report in doubtful)
    text = flat(shadowinv("info", store).output)
    shots = Counter(report["verdict"] for report in reports)
    assert f"{shots['determined']} determined" in text
    codes = {caution["code"] for report in doubtful for caution in report["warnings"]}
    verdicts = {verdict for verdict in shots if not Verdict(verdict).level.is_success}
    assert text.count("warning ") == len(codes) + len(verdicts)


def test_shots_whose_beam_nobody_recorded_are_a_success(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    y, x = (np.indices((48, 48)) - 24) / 5
    lens = 0.8 * np.exp(-(y**2 + x**2) / 2) * np.stack([y, x])
    for number in (1, 2):
        np.save(f"{number}.npy", synthetic_image(number * lens))
    threads = "--scheduler", "threads"
    run = shadowinv("batch", "1.npy", "2.npy", "--out", "b.shadowinv.zarr", *threads)
    assert run.exit_code == 0
    rows = flat(shadowinv("info", "b.shadowinv.zarr").output)
    assert "0 determined, 2 depends on the beam" in rows


def test_arrays_of_a_file_are_shots_source_mask_and_rows(night, folder):
    usable = np.ones(night.source.shape, np.uint8)
    usable[:3] = 0
    with h5py.File("run.h5", "w") as file:
        file["entry/data"], file["entry/beam"], file["entry/usable"] = (
            night.images[:2], night.source, usable,
        )  # fmt: skip
    Path("table.csv").write_text("file, mask\nrun.h5::/entry/data[1], run.h5::/entry/usable\n")
    common = ("--source", "run.h5::/entry/beam", "--set=options.n_sites=100")
    mask = ("--mask", "run.h5::/entry/usable")
    results = {}
    for name, more in (("run.h5::/entry/data", mask), ("table.csv", ())):
        out = Path(f"{len(results)}.shadowinv.zarr")
        result = shadowinv("batch", name, *common, *more, "--out", out)
        assert result.exit_code in (0, 3), flat(result.output)
        results[name] = read(out)
    many, row = results.values()
    np.testing.assert_array_equal(many.mask, 2 * [usable != 0])
    np.testing.assert_array_equal(row.displacement[0], many.displacement[1])
    assert list(row.name.values) == ["run.h5::/entry/data[1]"]


def test_a_folder_says_which_files_it_leaves_out(night, folder):
    Path("shots/log.txt").write_text("0")
    result = shadowinv(
        "batch", "shots", "--source", "reference.npy", "--out", "n.shadowinv.zarr",
        "--set=options.n_sites=100", "--scheduler", "threads",
    )  # fmt: skip
    assert "left out 1 .txt" in flat(result.output)


def test_a_run_that_the_disk_interrupts_names_the_flag_that_resumes_it(folder, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    assert batch().exit_code == 0
    shutil.rmtree("n.shadowinv.zarr")
    monkeypatch.setattr(store_writing, "_write_template", full)
    result = batch()
    assert result.exit_code == 2
    words = "free some disk space or check the folder's permissions, then run again to resume"
    assert f"{words} (--resume)" in flat(result.output)
