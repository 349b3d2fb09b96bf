"""`shadowinv batch`, `status`, `export` and `movie`."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
import signal
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

from helpers.command_line import done, interrupted, refused, shadowinv
from napari_shadowinv import read, synthetic_image
from napari_shadowinv.cli._batch import _Printer
from napari_shadowinv.cli._terminal import progress_bar
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.facts import Level, Verdict
from napari_shadowinv.io import store_writing
from napari_shadowinv.io.files import sha256
from napari_shadowinv.io.store import DONE, PENDING, StackStore
from napari_shadowinv.plotting import stack_frames, write_film
from napari_shadowinv.stack import RunStatus

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


QUICK = ("--set=options.n_sites=100", "--scheduler", "threads", "--set=instrument.beam_rms=0")
OF_NIGHT = ("batch", "shots/shot_*.npy", "--source", "reference.npy", "--out", "n.shadowinv.zarr")


def batch(*more: object, code: int = 0) -> str:
    """Invert the night in the current folder, and return what is printed."""
    return done(*OF_NIGHT, *QUICK, *more, code=code)


@pytest.fixture(scope="module")
def finished(any_night, tmp_path_factory) -> Path:
    """A finished run, as the command of `batch` makes it."""
    place = tmp_path_factory.mktemp("finished")
    np.save(place / "reference.npy", any_night.source)
    (place / "setup.toml").write_text(OPTICAL)
    files = ("--source", place / "reference.npy", "--setup", place / "setup.toml")
    out = place / "n.shadowinv.zarr"
    assert "6 done, 0 failed, 0 pending" in done(
        "batch", any_night.glob, *files, *QUICK, "--out", out
    )
    return out


@pytest.fixture
def store(folder, finished) -> Path:
    """A copy of the store, next to the same shots."""
    shutil.copytree(finished, folder / "n.shadowinv.zarr")
    return folder / "n.shadowinv.zarr"


def test_shots_that_fail_are_named_and_listed(night, folder):
    night.path(1).write_bytes(b"")
    np.save(night.path(4), 0 * night.images[4])
    text = batch(code=1)
    dark = "shot_4.npy: image has no positive pixel"
    for words in ("4 done, 2 failed, 0 pending", "shot_1.npy", "is empty", dark):
        assert words in text
    status = done("info", "n.shadowinv.zarr")
    assert "4 done, 2 failed, 0 pending" in status
    assert dark in status

    done("export", "n.shadowinv.zarr", "--format", "csv")
    with Path("n.csv").open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert [row["name"] for row in table] == [f"shot_{i}.npy" for i in range(6)]
    assert table[4]["status"] == "failed"
    assert "no positive pixel" in table[4]["reason"]
    store = read("n.shadowinv.zarr")
    assert float(table[3]["image_residual"]) == float(store.image_residual[3])
    largest = np.hypot(*store.displacement.values[3])[store.mask.values[3]].max()
    assert float(table[3]["peak"]) == pytest.approx(largest, rel=1e-6)
    assert table[3]["peak_unit"] == "px"
    for index in (1, 4):
        np.save(night.path(index), night.images[index])
    batch("--set=run.redo_failed=true")


def test_existing_store_is_neither_resumed_nor_replaced(store):
    before = store.stat().st_mtime_ns
    setup = ("--setup", "setup.toml")
    exists = "exists (6 done, 0 failed, 0 pending): use --resume to continue"
    refused(*OF_NIGHT, *QUICK, *setup, names=exists)
    batch("--resume", "--overwrite", code=2)
    assert store.stat().st_mtime_ns == before
    assert "nothing to do" in batch(*setup, "--resume")
    assert "was started with a different setup" in batch("--resume", code=2)
    batch("--overwrite")


def test_mistakes_of_an_export_write_nothing(store):
    tiffs = ("export", store, "--format", "tiff", "--shots")
    done(*tiffs, "1", "--out", "tiffs")
    for text in ("6", "a", "1:2:3:4", ""):
        refused(*tiffs, text, names="expected numbers from 0 to 5")
    refused(*tiffs, "1", "--out", "tiffs", names="exists")
    refused("export", store, "--format", "pradformat", names="needs a setup of kind 'proton'")


def test_shots_are_exported_as_tiff(store):
    chosen = ("--shots", "1:3,5", "--variables", "potential,displacement", "--out", "tiffs")
    done("export", store, "--format", "tiff", *chosen)
    assert len(list(Path("tiffs").iterdir())) == 3 * 3
    plane = tifffile.imread("tiffs/0005_shot_5_displacement_x.tif")
    np.testing.assert_array_equal(plane, read(store).displacement.sel(component="x")[5])


def test_shots_are_exported_as_pradformat_for_particle_beams(night, folder):
    Path("setup.toml").write_text(PROTON)
    batch("--setup", "setup.toml")
    store = read("n.shadowinv.zarr")
    done("export", "n.shadowinv.zarr", "--format", "pradformat", "--shots", "4")
    (path,) = Path("n").iterdir()
    with h5py.File(path) as file:
        assert file.attrs["radiograph_filename"] == "shot_4.npy"
        provenance = json.loads(file.attrs["provenance"])
        angle = file["defl_ax2"][...]
    (image,) = provenance["images"]
    assert image["file"] == "shot_4.npy"
    assert image["sha256"] == sha256("shots/shot_4.npy")
    displacement = store.displacement[4].sel(component="x")
    assert np.ptp(angle) > 0
    assert np.corrcoef(angle.ravel(), displacement.values.ravel())[0, 1] == pytest.approx(1)


def test_progress_of_a_batch_fits_80_columns(folder, monkeypatch):
    text = io.StringIO()
    monkeypatch.setattr(sys, "stderr", text)
    for name, value in {"COLUMNS": "80", "FORCE_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    status = RunStatus(
        total=500, done=121, failed=2, waiting=377, ended=60, seconds=300.0, scheduler="4 threads",
        name="a_long_name_of_a_shot_of_the_night_0123.tif",
    )  # fmt: skip
    with progress_bar() as show:
        _Printer(quiet=True, show=show).update(status)
    lines = re.split(r"[\r\n]+", re.sub(r"\x1b\[[\d;?]*[a-zA-Z]", "", text.getvalue()))
    assert max(map(len, lines)) <= 80
    assert any("4 threads" in line and "121 of 500 done" in line for line in lines)


FILMS = pytest.mark.parametrize("name", ["plume.gif", "plume.mp4"])


@FILMS
def test_a_film_has_a_frame_for_each_shot(store, name):
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg")
    done("movie", store, "-o", name, "--shots", "1:5")
    frames = iio.imread(name)
    assert len(frames) == 4
    assert all(length % 2 == 0 for length in frames.shape[1:3])
    assert not np.array_equal(frames[0], frames[2])
    refused("movie", store, "-o", name, names="exists")
    if name.endswith("gif"):
        # A palette of 256 colours for each frame; antialiased letters are not in it.
        frames_now = np.array(list(stack_frames(read(store).isel(shot=slice(1, 5)))), dtype=int)
        difference = np.abs(frames - frames_now)
        assert difference.mean() < 0.5
        assert np.quantile(difference, 0.99) <= 6


@FILMS
def test_a_film_on_a_full_disk_is_refused_and_the_old_one_kept(store, small_disk, name):
    if name.endswith("mp4"):
        pytest.importorskip("imageio_ffmpeg")
    disk, resize = small_disk
    film = disk / name
    film.write_bytes(bytes(8000))
    assert resize("16k")
    words = (f"{film} cannot be written", "No space left on device")
    refused("movie", store, "-o", film, "--overwrite", names=words)
    assert film.read_bytes() == bytes(8000)
    assert list(disk.iterdir()) == [film]


def test_a_film_needs_its_package_and_all_its_frames(store, monkeypatch):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr(imageio_ffmpeg, "count_frames_and_secs", lambda path: (5, 0.5))
    lost = "ffmpeg: 5 of 6 frames can be read back"
    refused("movie", store, "-o", "plume.mp4", names=lost)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    refused("movie", store, "-o", "plume.mp4", names="plume.mp4 needs the package imageio-ffmpeg")


@FILMS
@pytest.mark.parametrize("error", [FileFormatError("shot 3 is damaged"), KeyboardInterrupt()])
def test_a_film_that_ends_early_leaves_nothing(tmp_path, name, error):
    def frames():
        yield np.zeros((40, 60, 3), np.uint8)
        raise error

    with pytest.raises(type(error)) as raised:
        write_film(tmp_path / name, frames(), 10.0)
    assert raised.value is error
    assert list(tmp_path.iterdir()) == []


def test_the_colour_scale_of_a_film_is_fixed(store):
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
    dataset = read(store).load()
    mask = np.ones(dataset.potential.shape[1:], bool)
    mask[3:9, 3:9] = False
    clean = dataset.assign(mask=(("y", "x"), mask))
    wild = clean.assign(potential=clean.potential.where(mask, 1e6))
    frames = list(stack_frames(wild, "potential"))
    for frame, expected in zip(frames, stack_frames(clean, "potential"), strict=True):
        np.testing.assert_array_equal(frame, expected)


def test_ctrl_c_leaves_a_store_that_is_resumed(folder, monkeypatch):
    update, out = _Printer.update, folder / "n.shadowinv.zarr"

    def update_and_interrupt(printer, status):
        update(printer, status)
        if status.outcome is not None:
            signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(_Printer, "update", update_and_interrupt)
        cancelled = shadowinv(*OF_NIGHT, *QUICK, "--workers", 1)
    assert cancelled.exit_code == 130
    (sentence,) = cancelled.stderr.splitlines()
    assert sentence.startswith("Cancelled: 1 done, 0 failed, 5 pending. Repeat the command with")
    assert StackStore(out).statuses().tolist() == [DONE] + [PENDING] * 5
    batch("--resume", "--quiet")
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
    code, output = interrupted(folder, starting, [*OF_NIGHT, QUICK[0], *processes], 0.6)
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
        assert "Cancelled: nothing written" in batch(code=130)
    assert sorted(folder.rglob("*")) == before


def test_status_counts_verdicts_and_lists_warnings_once(store):
    reports = StackStore(store).reports()
    assert {report["level"] for report in reports} <= set(Level)
    assert all("peak" in report["headline"] for report in reports)
    doubtful = [report for report in reports if report["level"] == "doubtful"]
    assert all(report["warnings"] for report in doubtful)
    text = done("info", store)
    shots = Counter(report["verdict"] for report in reports)
    for verdict, count in shots.items():
        assert f"{count} {verdict}" in text
    codes = {caution["code"] for report in doubtful for caution in report["warnings"]}
    verdicts = {verdict for verdict in shots if not Verdict(verdict).level.is_success}
    assert text.count("warning ") == len(codes) + len(verdicts)


def test_shots_whose_beam_nobody_recorded_are_a_success(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    y, x = (np.indices((48, 48)) - 24) / 5
    lens = 0.8 * np.exp(-(y**2 + x**2) / 2) * np.stack([y, x])
    for number in (1, 2):
        np.save(f"{number}.npy", synthetic_image(number * lens))
    done("batch", "1.npy", "2.npy", "--out", "b.shadowinv.zarr", "--scheduler", "threads")
    assert "2 depends on the beam" in done("info", "b.shadowinv.zarr")


def test_a_folder_says_which_files_it_leaves_out(night, folder):
    Path("shots/log.txt").write_text("0")
    out = ("--source", "reference.npy", "--out", "n.shadowinv.zarr")
    assert "left out 1 .txt" in done("batch", "shots", *out, *QUICK)


def test_a_run_that_the_disk_interrupts_names_the_flag_that_resumes_it(folder, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store_writing, "_write_template", full)
    words = "free some disk space or check the folder's permissions, then run again to resume"
    assert f"{words} (--resume)" in batch(code=2)
