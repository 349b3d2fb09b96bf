"""Files that arrive in a folder: each is named once it no longer changes."""

from __future__ import annotations

import os
from types import SimpleNamespace

import pytest

from napari_shadowinv import FileFormatError
from napari_shadowinv.stack import _arrivals
from napari_shadowinv.stack._arrivals import Arrivals


class Watching:
    """The arrivals in a folder, by a clock that goes on only as it is told."""

    now = 0.0
    arrivals: Arrivals

    def names_after(self, seconds: float) -> list[str]:
        """Let time pass, look, and return the names of the files that have become complete."""
        self.now += seconds
        return self.arrivals.look()


@pytest.fixture
def watch(tmp_path, monkeypatch):
    """Return a function that watches a folder, in which files settle within a second."""

    def begin(pattern: str = "*.npy") -> Watching:
        watching = Watching()
        clock = SimpleNamespace(monotonic=lambda: watching.now)
        monkeypatch.setattr(_arrivals, "time", clock)
        watching.arrivals = Arrivals(tmp_path, pattern, 1.0)
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


def test_change_of_the_time_alone_names_a_file_again(watch, tmp_path):
    path = tmp_path / "shot_1.npy"
    path.write_bytes(bytes(10))
    watching = watch()
    watching.names_after(0.0)
    assert watching.names_after(1.1) == ["shot_1.npy"]
    os.utime(path, (5.0, 5.0))
    assert watching.names_after(1.0) == []
    assert watching.arrivals.last_change == watching.now
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


def test_folder_that_is_gone_is_an_error(watch, tmp_path):
    watching = watch()
    watching.names_after(1.0)
    tmp_path.rename(tmp_path.with_name("elsewhere"))
    with pytest.raises(FileFormatError, match="cannot be read"):
        watching.names_after(1.0)
    tmp_path.with_name("elsewhere").rename(tmp_path)
