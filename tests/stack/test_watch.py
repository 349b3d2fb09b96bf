"""A watched folder: files that arrive are inverted once, completely, and in order."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from helpers.command_line import done, shadowinv
from helpers.night import OPTIONS
from helpers.store_content import content
from helpers.watched import IMAGES, SETTLE, SOURCE, Watched, put, watched_once, whole
from napari_shadowinv import (
    FileFormatError,
    InputError,
    InversionOptions,
    invert,
    read,
)
from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv.cli import _batch
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.stack import RunStatus, watch_stack

pytestmark = pytest.mark.usefixtures("impatient")


def test_watch_inverts_existing_files_first_then_arrivals(folder, out):
    put(folder, 2, 1)
    with Watched(folder, out) as watch:
        watch.ended(2)
        put(folder, 5)
        watch.ended(3)
        put(folder, 0)
        watch.ended(4)
        # It can be opened at any time, with its numbers filled in.
        store = read(out)
        assert list(store.status.values) == [DONE] * 4
        assert store.converged.values.all()
        assert (store.total_error.values > 0).all()
        with pytest.raises(FileFormatError, match="is being written by"), locked(out):
            pass
    names = [f"shot_{index}.npy" for index in (1, 2, 5, 0)]
    ended = [event.name for event in watch.shots]
    assert [sorted(ended[:2]), *ended[2:]] == [names[:2], *names[2:]]  # two run side by side
    assert list(watch.result.name.values) == names


def test_file_that_pauses_half_written_is_inverted_again(folder, out):
    data = whole(1)
    put(folder, 0)
    with Watched(folder, out) as watch:
        watch.ended(1)
        path = folder / "shot_1.npy"
        path.write_bytes(data[:2000])
        assert watch.ended(2)[1].outcome.status == FAILED
        with path.open("ab") as file:
            file.write(data[2000:])
        assert watch.ended(3)[2].name == path.name
    assert list(watch.result.status.values) == [DONE, DONE]
    expected = invert(IMAGES[1], plan=plan_sites(SOURCE, OPTIONS), options=OPTIONS)
    np.testing.assert_allclose(watch.result.displacement[1], expected.displacement, atol=5e-3)


def test_changed_shot_is_reported_and_inverted_again(folder, out):
    put(folder, 0, 1)
    with Watched(folder, out) as watch:
        watch.ended(2)
        before = content(out)
        os.utime(folder / "shot_1.npy")
        (folder / "shot_1.npy").write_bytes(whole(1))  # the same again
        (folder / "shot_0.npy").write_bytes(whole(4))
        changed = watch.ended(3)[2]
    assert (changed.name, changed.outcome.index) == ("shot_0.npy", 0)
    assert len(watch.shots) == 3
    after = content(out)
    assert {name for name in before if before[name] != after[name]} & {
        "displacement/c/1/0/0/0",
        "report/c/1",
    } == set()
    (folder / "shot_1.npy").write_bytes(whole(5))
    with Watched(folder, out) as watch:
        assert watch.ended(1)[0].name == "shot_1.npy"


def test_moved_and_linked_files_count_and_other_files_do_not(folder, tmp_path):
    put(tmp_path, 0, 1, 2)
    out = folder / "night.shadowinv.zarr"  # does not set it off
    with Watched(folder, out, pattern="*") as watch:
        shutil.move(tmp_path / "shot_0.npy", folder)
        watch.ended(1)
        (folder / ".shot_7.npy").write_bytes(whole(1))
        (folder / "log.txt").write_text("0")
        (folder / "inner").mkdir()
        put(folder / "inner", 3)
        os.link(tmp_path / "shot_1.npy", folder / "shot_1.npy")
        watch.ended(2)
        watch.until(lambda: any(event.note for event in watch.events))
        time.sleep(3 * SETTLE)
        assert len(watch.shots) == 2
    (note,) = {event.note for event in watch.events if event.note}
    assert note.startswith("Left out: 1 .txt; choose others")
    with Watched(folder, out) as watch:
        (folder / "shot_4.npy.part").write_bytes(whole(4))
        (folder / "shot_4.npy.part").rename(folder / "shot_4.npy")
        watch.ended(1)
    assert list(watch.result.name.values) == [f"shot_{i}.npy" for i in (0, 1, 4)]


def test_pattern_may_name_an_array_in_each_file_but_the_source(folder, out, tmp_path):
    for index in (0, 1):
        with h5py.File(folder / f"shot_{index}.h5", "w") as file:
            file["entry/data"], file["entry/dark"] = IMAGES[index], 0 * IMAGES[index]
    np.save(tmp_path / "beam.npy", SOURCE)
    beam = str(tmp_path / "beam.npy")
    stored = watched_once(folder, out, pattern="*.h5::entry/data", source=beam)
    assert list(stored.status.values) == [DONE, DONE]
    with pytest.raises(InputError, match="read by a function, which selects no array"):
        watch_stack(folder, out, reader=np.load, watch={"pattern": "*.h5::entry/data"})


def test_store_waits_for_the_first_shot_that_can_be_read(folder, out):
    (folder / "shot_0.npy").write_bytes(b"")
    assert watched_once(folder, out, source=None) is None
    assert not out.exists()
    with Watched(folder, out, source=None) as watch:
        watch.until(lambda: any(event.note for event in watch.events))
        put(folder, 1)
        watch.ended(2)
    (note,) = {event.note for event in watch.events if event.note}
    assert "none of 1 shots can be read" in note
    assert list(watch.result.status.values) == [FAILED, DONE]


@pytest.mark.parametrize(("files", "code"), [(0, 0), (1, 1)])
def test_watch_command_without_a_shot_fails_if_one_cannot_be_read(folder, out, files, code):
    for index in range(files):
        (folder / f"shot_{index}.npy").write_bytes(b"")
    settle = f"--set=run.settle={SETTLE}"
    result = shadowinv("watch", folder, "--pattern", "*.npy", "--out", out, settle, "--idle", "0.2")
    assert result.exit_code == code
    assert result.stdout.splitlines()[-1].startswith("Stopped: no shots")


def test_it_goes_on_with_its_store_and_does_nothing_twice(folder, out):
    put(folder, 0, 1)
    (folder / "shot_2.npy").write_bytes(b"")
    watched_once(folder, out, source=None)
    before = content(out)
    (folder / "shot_0.npy").unlink()  # put away after it was inverted
    with Watched(folder, out, source=None) as watch:
        put(folder, 4)
        assert watch.ended(1)[0].name == "shot_4.npy"
    after = content(out)
    assert {name: after[name] for name in before if "/c/0" not in name} == {
        name: before[name] for name in before if "/c/0" not in name
    }
    assert list(watch.result.status.values) == [DONE, DONE, FAILED, DONE]
    np.save(folder / "shot_9.npy", IMAGES[0][:10])  # smaller than those before
    assert list(watched_once(folder, out, source=None).status.values) == [1, 1, 2, 1, 2]
    (folder / "shot_9.npy").write_bytes(whole(2))
    put(folder, 2)
    again = watched_once(folder, out, source=None, redo_failed=True)
    assert list(again.status.values) == [DONE] * 5
    with pytest.raises(InputError, match="different options"):
        watched_once(folder, out, source=None, options=InversionOptions(n_sites=50))


def watching(folder: Path, out: Path, tmp_path: Path, *more: object) -> list[object]:
    """The command that watches a folder until nothing arrives."""
    np.save(tmp_path / "reference.npy", SOURCE)
    flags = ["--source", tmp_path / "reference.npy", "--set=options.n_sites=100", "--out", out]
    settle = f"--set=run.settle={SETTLE}"
    return ["watch", folder, "--pattern", "*.npy", settle, "--idle", 0.2, *flags, *more]


def test_a_batch_goes_on_with_the_store_of_a_watch(folder, out, tmp_path):
    watch = watching(folder, out, tmp_path)
    for indices in ((3, 4), (1,)):
        put(folder, *indices)
        done(*watch)
    put(folder, 0)
    done("batch", f"{folder}/*.npy", *watch[7:], "--scheduler", "threads", "--resume")
    assert list(read(out).name.values) == [f"shot_{i}.npy" for i in (3, 4, 1, 0)]


def test_many_frames_cost_alike_and_leave_no_thread(folder, out, opened_paths):
    count = 60
    opened: list[int] = []  # files, before each shot that ends
    with Watched(folder, out) as watch:
        opened_paths.clear()
        for number in range(count):
            np.save(folder / f"shot_{number:03d}.npy", IMAGES[number % 6])
            if number % 20 == 19:
                watch.ended(number + 1)
                opened.append(len(opened_paths))
        watch.ended(count)
    assert list(watch.result.status.values) == [DONE] * count
    assert list(watch.result.name.values) == [f"shot_{i:03d}.npy" for i in range(count)]
    assert max(event.waiting for event in watch.shots) > 1
    assert watch.shots[-1].waiting == 0
    # Late shots open as many files as early ones.
    per_batch = np.diff(opened)
    assert per_batch[-1] <= 1.1 * per_batch[0]
    assert "lock" not in {thread.name for thread in threading.enumerate()}


def test_watch_command_prints_a_line_for_each_shot(folder, out, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    put(folder, 0, 1)
    (folder / "shot_2.npy").write_bytes(b"")
    command = watching(folder, out, tmp_path, "--set=instrument.beam_rms=0")
    result = shadowinv(*command)
    assert result.exit_code == 1
    lines = result.stdout.splitlines()
    assert result.stdout.count("Watching") == 1
    shot_lines = [line for line in lines if line.startswith("shot_")]
    store = StackStore(out)
    headlines = [report["headline"] for report in store.reports()[:2]]
    printed = sorted(tuple(line.split("  ")[:2]) for line in shot_lines)  # two run side by side
    assert printed == list(zip(store.names, headlines, strict=False))
    assert "waiting" in shot_lines[0]
    # Each kind of doubt about a shot is reported once, whatever its numbers.
    failure, warning = sorted(result.stderr.splitlines())
    assert warning.startswith("warning: shot_")
    assert "of the displacement (r.m.s.) rests on what lies beyond the image" in warning
    assert all(line.startswith("Reaches the edge: peak |d| ") for line in headlines)
    assert failure.startswith("failed: shot_2.npy: ")
    assert lines[-1] == "Stopped: 2 done, 1 failed, 0 pending; repeat the command to go on."
    assert shadowinv(*command, "--quiet").stdout == ""


@pytest.mark.parametrize(("files", "code"), [(1, 0), (3, 130)])
def test_ctrl_c_is_the_normal_end_unless_files_wait(
    folder, out, tmp_path, monkeypatch, files, code
):
    put(folder, *range(files))
    update = _batch._Printer.update

    def update_and_interrupt(printer: Any, progress: RunStatus) -> None:
        update(printer, progress)
        if progress.outcome is not None:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(_batch._Printer, "update", update_and_interrupt)
    result = shadowinv(*watching(folder, out, tmp_path))
    assert result.exit_code == code
    (end,) = [line for line in result.output.splitlines() if line.startswith("Stopped")]
    statuses = list(read(out).status.values)
    assert statuses.count(FAILED) == 0
    numbers = f"{statuses.count(DONE)} done, 0 failed, {statuses.count(PENDING)} pending"
    assert end == f"Stopped: {numbers}; repeat the command to go on."
    assert not list(tmp_path.glob(".*.lock"))


def test_removed_store_is_named_and_not_made_again(folder, out):
    put(folder, 0)
    with Watched(folder, out) as watch:
        watch.ended(1)
        shutil.rmtree(out)
        put(folder, 1)
        watch.until(lambda: watch.error)
    assert "was removed or moved while it was being written" in str(watch.error)
    assert "disk space" not in str(watch.error)
    assert not out.exists()


@pytest.mark.parametrize("command", ["batch", "watch"])
def test_shot_not_converged_ends_with_exit_code_3(folder, out, tmp_path, command):
    np.save(folder / "shot_0.npy", 0.9 * SOURCE + 0.1 * IMAGES[1])  # one step is enough
    put(folder, 1)
    watch = watching(folder, out, tmp_path, "--set=options.max_iterations=1")
    batch = ["batch", f"{folder}/*.npy", *watch[7:], "--scheduler", "threads"]
    done(*(watch if command == "watch" else batch), code=3)
    assert list(read(out).converged.values) == [True, False]


def test_file_written_during_its_read_is_read_again(folder, out):
    names = "shot_0.npy", "shot_1.npy"
    reads = []

    def load_and_change(path: Path) -> np.ndarray:
        image = np.load(path)
        reads.append(path.name)
        if path.name == names[0] and reads.count(names[0]) == 1:
            path.write_bytes(whole(4))
        return image

    put(folder, 0, 1)
    with Watched(folder, out, reader=load_and_change, dtype="float64") as watch:
        watch.ended(3)
        watch.until(lambda: watch.events[-1].waiting == 0)
    assert watch.shots[-1].name == names[0]
    assert list(watch.result.name.values) == list(names)
    expected = invert(IMAGES[4], plan=plan_sites(SOURCE, OPTIONS), options=OPTIONS)
    np.testing.assert_array_equal(watch.result.displacement[0], expected.displacement)
