"""Files that arrive in a folder: each is named once it no longer changes."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from napari_shadowinv import FileFormatError
from napari_shadowinv.stack import _arrivals
from napari_shadowinv.stack._arrivals import Arrivals


class Watching:
    """The arrivals in a folder, by a clock that goes on only as it is told."""

    now = 0.0
    arrivals: Arrivals

    def names_after(self, seconds: float) -> list[str]:
        """Let time pass, look, and take the names of complete files."""
        self.now += seconds
        self.arrivals.look()
        names = list(self.arrivals.waiting)
        self.arrivals.waiting.clear()
        return names


@pytest.fixture
def watch(tmp_path, monkeypatch):
    """Return a function that watches a folder, in which files settle within a second."""

    def begin(pattern: str = "*.npy", *, existing: bool = True) -> Watching:
        watching = Watching()
        clock = SimpleNamespace(monotonic=lambda: watching.now)
        monkeypatch.setattr(_arrivals, "time", clock)
        watching.arrivals = Arrivals(tmp_path, pattern, settle=1.0, existing=existing)
        return watching

    return begin


def test_file_that_grows_is_not_named_until_it_stops(watch, tmp_path):
    watching = watch()
    for size in (10, 20, 30):
        (tmp_path / "shot_1.npy").write_bytes(bytes(size))
        assert watching.names_after(0.9) == []
    assert watching.names_after(0.9) == []
    assert watching.names_after(0.2) == ["shot_1.npy"]
    assert watching.names_after(5.0) == []
    assert watching.arrivals.is_quiet


def test_change_of_the_time_alone_names_a_file_again(watch, tmp_path):
    path = tmp_path / "shot_1.npy"
    path.write_bytes(bytes(10))
    watching = watch()
    watching.names_after(0.0)
    assert watching.names_after(1.1) == ["shot_1.npy"]
    os.utime(path, (5.0, 5.0))
    assert watching.names_after(1.0) == []
    assert not watching.arrivals.is_quiet
    assert watching.names_after(1.1) == ["shot_1.npy"]


def test_waiting_file_that_changes_or_goes_no_longer_waits(watch, tmp_path):
    for name in ("shot_1.npy", "shot_2.npy"):
        (tmp_path / name).write_bytes(bytes(10))
    watching = watch()
    watching.names_after(0.0)
    watching.now += 1.1
    watching.arrivals.look()
    assert watching.arrivals.waiting == ["shot_1.npy", "shot_2.npy"]
    (tmp_path / "shot_1.npy").write_bytes(bytes(20))
    (tmp_path / "shot_2.npy").unlink()
    assert watching.names_after(1.1) == []
    assert watching.names_after(1.1) == ["shot_1.npy"]


def test_files_have_their_final_names_and_are_in_counting_order(watch, tmp_path):
    watching = watch()
    for name in ("shot_10.npy.part", ".shot_9.npy", "shot_2.npy.part"):
        (tmp_path / name).write_bytes(bytes(10))
    assert watching.names_after(1.0) == []
    assert watching.names_after(2.0) == []
    for name in ("shot_10.npy.part", ".shot_9.npy", "shot_2.npy.part"):
        (tmp_path / name).rename(tmp_path / name.strip(".").removesuffix(".part"))
    assert watching.names_after(1.0) == []
    assert watching.names_after(1.1) == ["shot_2.npy", "shot_9.npy", "shot_10.npy"]
    assert not watching.arrivals.left_out


def test_existing_files_are_ignored_until_they_change(watch, tmp_path):
    (tmp_path / "shot_1.npy").write_bytes(bytes(10))
    watching = watch(existing=False)
    watching.names_after(0.0)
    assert watching.names_after(2.0) == []
    (tmp_path / "shot_1.npy").write_bytes(bytes(20))
    (tmp_path / "shot_2.npy").write_bytes(bytes(10))
    assert watching.names_after(1.0) == []
    assert watching.names_after(1.1) == ["shot_1.npy", "shot_2.npy"]


def test_kind_without_an_ending_is_of_the_first_images(watch, tmp_path):
    (tmp_path / "notes.md").write_text("no image")
    (tmp_path / "inner.tif").mkdir()
    watching = watch("*")
    assert watching.names_after(1.0) == []
    for name in ("shot_1.tif", "shot_2.TIFF", "thumbnail.png"):
        (tmp_path / name).write_bytes(bytes(10))
    watching.names_after(1.0)
    assert watching.names_after(1.1) == ["shot_1.tif", "shot_2.TIFF"]
    assert watching.arrivals.left_out == {".md": 1, ".png": 1}
    (tmp_path / "thumbnail.png").unlink()
    watching.names_after(1.0)
    assert watching.arrivals.left_out == {".md": 1}


@pytest.mark.parametrize("is_replaced", [False, True])
def test_folder_that_is_gone_or_another_is_an_error(watch, tmp_path, is_replaced):
    watching = watch()
    watching.names_after(1.0)
    tmp_path.rename(tmp_path.with_name("elsewhere"))
    if is_replaced:  # as an empty mount point
        tmp_path.mkdir()
    with pytest.raises(FileFormatError, match="can no longer be read"):
        watching.names_after(1.0)
    shutil.rmtree(tmp_path.with_name("elsewhere"))


def test_large_folder_is_looked_at_less_often(watch, tmp_path, monkeypatch):
    watching = watch()
    stamps_in = _arrivals._stamps_in

    def slow(folder: Path) -> Any:
        watching.now += 2.0
        return stamps_in(folder)

    monkeypatch.setattr(_arrivals, "_stamps_in", slow)
    watching.names_after(1.0)
    (tmp_path / "shot_1.npy").write_bytes(bytes(10))
    watching.names_after(9.9)
    assert watching.arrivals.is_quiet
    watching.names_after(0.2)
    assert not watching.arrivals.is_quiet
