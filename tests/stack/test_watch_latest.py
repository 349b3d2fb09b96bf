"""A watch of the latest shots, and the status file of a watch."""

from __future__ import annotations

import json
import shutil
import threading
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from helpers.command_line import done
from helpers.night import OPTIONS
from helpers.watched import SETTLE, SOURCE, Watched, put, watched_once
from napari_shadowinv import InputError, Instrument, Recipe, Shot, read, run_stack
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.pipeline import WatchOptions
from napari_shadowinv.stack import watch_stack

pytestmark = pytest.mark.usefixtures("impatient")

EXACT = Instrument(beam_rms=0)  # of the source: what lies beyond the edge is the largest error


class Gate:
    """A reader that waits until it is opened, as an inversion that takes long."""

    def __init__(self) -> None:
        self.opened = threading.Event()
        self.names: list[str] = []

    def __call__(self, path: Path) -> np.ndarray:
        self.names.append(path.name)
        assert self.opened.wait(30)
        return np.load(path)


def numbers_of(stored) -> list[tuple[str, int]]:
    names = [name.removeprefix("shot_").removesuffix(".npy") for name in stored.name.values]
    return list(zip(names, stored.status.values.tolist(), strict=True))


def test_latest_shot_is_next_and_the_others_are_passed_over(folder, out):
    gate = Gate()
    put(folder, 0)
    with Watched(folder, out, reader=gate, latest=True, instrument=EXACT) as watch:
        watch.until(lambda: gate.names)
        put(folder, 2, 3)
        time.sleep(3 * SETTLE)
        put(folder, 4)
        gate.opened.set()
        last = watch.ended(2)[-1]
        put(folder, 5)
        assert watch.ended(3)[-1].name == "shot_5.npy"
    assert [event.name for event in watch.shots[:2]] == ["shot_0.npy", "shot_4.npy"]
    assert (last.done, last.skipped, last.waiting) == (2, 2, 0)
    assert last.text == "2 done, 2 with warnings, 2 skipped"
    assert numbers_of(watch.result) == [("0", DONE), ("4", DONE), ("5", DONE)]
    assert not StackStore(out, every_byte=True).damage.shots
    again = watched_once(folder, out, reader=gate, instrument=EXACT)
    assert numbers_of(again) == [(name, DONE) for name in "04523"]


def test_existing_files_are_passed_over_but_the_newest_and_done_ones(folder, out, tmp_path):
    put(folder, 1)
    watched_once(folder, out)
    put(folder, 0, 2, 3)
    (folder / "shot_4.npy").write_bytes(b"")
    stored = watched_once(folder, out, latest=True)
    expected = [("1", DONE), ("4", FAILED)]
    assert numbers_of(stored) == expected
    status = (out / "status/c/1").stat()
    stored = watched_once(folder, out, latest=True)
    assert numbers_of(stored) == expected  # the newest has failed, and nothing else is newer
    assert (out / "status/c/1").stat() == status
    (folder / "shot_4.npy").unlink()
    put(folder, 4)
    files = [folder / f"shot_{number}.npy" for number in range(5)]
    recipe = Recipe(options=OPTIONS)
    later = run_stack(Shot(files, source=SOURCE), out, recipe, run={"redo_failed": True})
    assert numbers_of(later) == [(name, DONE) for name in "14023"]


def test_shot_in_work_is_pending_when_the_watch_ends(folder, out):
    gate = Gate()
    put(folder, 0)
    with Watched(folder, out, reader=gate, latest=True) as watch:
        gate.opened.set()
        watch.ended(1)
        gate.opened.clear()
        put(folder, 1)
        watch.until(lambda: "shot_1.npy" in gate.names)
        watch._stop.set()
        gate.opened.set()
    assert (watch.events[-1].skipped, watch.events[-1].waiting) == (1, 0)
    assert numbers_of(watch.result) == [("0", DONE), ("1", PENDING)]
    again = watched_once(folder, out, reader=gate)
    assert numbers_of(again) == [("0", DONE), ("1", DONE)]


def test_command_counts_what_it_passes_over_and_ends_well(folder, out):
    put(folder, 0, 1, 2)
    keys = [f"--set={key}" for key in ("options.n_sites=100", "run.max_shots=1")]
    settle = f"--set=run.settle={SETTLE}"
    printed = done("watch", folder, "--pattern", "*.npy", "--out", out, "--latest", settle, *keys)
    assert "Stopped: 1 done, 2 skipped; repeat" in printed
    assert numbers_of(read(out)) == [("2", DONE)]


def test_status_file_describes_the_newest_shot(folder, out, tmp_path, monkeypatch):
    path = tmp_path / "status.json"
    with Watched(folder, out, status_file=path, instrument=EXACT) as watch:
        assert json.loads(path.read_text())["newest"] is None
        put(folder, 0)
        watch.ended(1)
        (folder / "shot_1.npy").write_bytes(b"")
        watch.ended(2)
        put(folder, 2)
        watch.ended(3)
        watch.until(lambda: (json.loads(path.read_text())["newest"] or {}).get("shot") == 2)
        first = json.loads(path.read_text())
    assert first["state"] == "watching"
    assert (first["done"], first["failed"], first["skipped"], first["waiting"]) == (2, 1, 0, 0)
    assert (first["folder"], first["store"]) == (str(folder), str(out))
    assert first["rate_per_s"] > 0
    newest = first["newest"]
    assert (newest["name"], newest["status"]) == ("shot_2.npy", "done")
    peak = float(np.hypot(*watch.result.displacement.values[2]).max())
    assert newest["peak"] == {"symbol": "|d|", "value": pytest.approx(peak, rel=1e-6), "unit": "px"}
    assert newest["headline"].startswith(str(watch.result.verdict.values[2]).capitalize())
    written = (folder / "shot_2.npy").stat().st_mtime
    assert datetime.fromisoformat(newest["written"]).timestamp() == pytest.approx(written, abs=2e-3)
    assert datetime.fromisoformat(first["time"]).timestamp() > written
    assert "edge" in newest["warnings"]
    assert json.loads(path.read_text())["state"] == "stopped"


def test_status_file_is_always_complete(folder, out, tmp_path, monkeypatch):
    path = tmp_path / "status.json"
    put(folder, 0, 1, 2)
    with Watched(folder, out, status_file=path, max_shots=3) as watch:
        numbers = []
        while watch._thread.is_alive():
            numbers.append(json.loads(path.read_text())["done"])
    assert numbers == sorted(numbers)
    assert len(set(numbers)) > 1
    assert json.loads(path.read_text())["done"] == 3
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith(".status")] == []


def test_watch_that_fails_leaves_its_reason_in_the_status_file(folder, out, tmp_path):
    path = tmp_path / "status.json"
    with Watched(folder, out, status_file=path) as watch:
        shutil.rmtree(folder)
        watch.until(lambda: not watch._thread.is_alive())
    status = json.loads(path.read_text())
    assert status["state"] == "failed"
    assert "can no longer be read" in status["reason"]


def test_status_file_that_cannot_be_written_is_noted_once(folder, out, tmp_path, monkeypatch):
    place = tmp_path / "display"
    place.mkdir()
    with Watched(folder, out, status_file=place / "status.json") as watch:
        place.rename(tmp_path / "elsewhere")
        put(folder, 0, 1)
        watch.ended(2)
        watch.until(lambda: any(event.note for event in watch.events))
    (note,) = [event.note for event in watch.events if event.note]
    assert note.startswith("the status file cannot be written: ")
    assert list(watch.result.status.values) == [DONE, DONE]


@pytest.mark.parametrize(
    ("name", "pattern", "words"),
    [
        ("status.json", "*.json", "would be taken for a shot of the watched folder"),
        ("nowhere/status.json", "*.npy", "does not exist; create it first"),
    ],
)
def test_wrong_status_file_is_refused_at_once(folder, out, name, pattern, words):
    began = time.monotonic()
    with pytest.raises(OSError if "nowhere" in name else InputError, match=words):
        watch_stack(
            folder, out, watch=WatchOptions(status_file=folder / name, pattern=pattern, idle=0.1)
        )
    assert time.monotonic() < began + 5
