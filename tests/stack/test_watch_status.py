"""A watch that inverts the newest file next, and the status file of a watch."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from helpers.night import OPTIONS
from helpers.watched import SETTLE, SOURCE, Watched, put, watched_once
from napari_shadowinv import FileFormatError, Instrument, Recipe, Shot, run_stack
from napari_shadowinv.io.store import DONE, PENDING
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


def test_newest_file_is_next_and_older_ones_follow(folder, out):
    gate = Gate()
    put(folder, 0)
    with Watched(folder, out, reader=gate, latest=True) as watch:
        watch.until(lambda: gate.names)
        put(folder, 2, 3)
        time.sleep(3 * SETTLE)
        put(folder, 4)
        gate.opened.set()
        watch.ended(4)
    assert [event.name for event in watch.shots] == [f"shot_{k}.npy" for k in (0, 4, 3, 2)]
    assert list(watch.result.name.values) == [f"shot_{k}.npy" for k in (0, 2, 3, 4)]


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
    assert list(watch.result.status.values) == [DONE, PENDING]
    files = [folder / f"shot_{number}.npy" for number in range(2)]
    recipe, shots = Recipe(options=OPTIONS), Shot(files, source=SOURCE)
    assert list(run_stack(shots, out, recipe, reader=gate).status.values) == [DONE, DONE]


def test_status_file_describes_the_newest_shot_and_is_always_complete(folder, out, tmp_path):
    path, states = tmp_path / "status.json", []
    with Watched(folder, out, status_file=path, instrument=EXACT) as watch:
        assert json.loads(path.read_text())["newest"] is None
        put(folder, 0, 1)
        (folder / "shot_2.npy").write_bytes(b"")

        def is_over() -> bool:
            states.append(json.loads(path.read_text()))
            return states[-1]["done"] + states[-1]["failed"] == 3

        watch.until(is_over)
        status = states[-1]
        assert status["failed"] == 1
        assert status["waiting"] == 0
        assert status["rate_per_s"] > 0
        put(folder, 3)
        watch.until(lambda: json.loads(path.read_text())["done"] == 3)
    newest = json.loads(path.read_text())["newest"]
    assert (newest["shot"], newest["name"]) == (3, "shot_3.npy")
    peak = float(np.hypot(*watch.result.displacement.values[3]).max())
    assert newest["peak"] == {"symbol": "|d|", "value": pytest.approx(peak, rel=1e-6), "unit": "px"}
    assert newest["headline"].startswith(str(watch.result.verdict.values[3]).capitalize())
    assert "edge" in {warning["code"] for warning in newest["warnings"]}
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith(".status")] == []


def test_status_file_that_cannot_be_written_stops_no_watch(folder, out, tmp_path):
    place = tmp_path / "display"
    with pytest.raises(FileFormatError, match="does not exist; create it first"):
        watch_stack(folder, out, watch=WatchOptions(status_file=place / "status.json"))
    place.mkdir()
    put(folder, 0)
    with Watched(folder, out, status_file=place / "status.json") as watch:
        place.rename(tmp_path / "elsewhere")
        watch.ended(1)
    assert list(watch.result.status.values) == [DONE]
    assert watched_once(folder, out) is not None
