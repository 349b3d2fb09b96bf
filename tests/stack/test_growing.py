"""Shots that arrive while a night goes on: appended, and nothing that was there moves."""

from __future__ import annotations

import os
import shutil

import numpy as np
import pytest
import tifffile
import zarr

from helpers.store_content import content
from napari_shadowinv import FileFormatError, InputError, read
from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv.io.store import DONE, StackStore


@pytest.fixture
def hidden(night):
    """Return a function that makes the night as if it had only some shots yet."""

    def hide(*indices: int) -> None:
        for index in range(6):
            shot_file, away = night.path(index), night.folder / f"later_{index}"
            if index in indices and shot_file.exists():
                shot_file.rename(away)
            elif index not in indices and away.exists():
                away.rename(shot_file)

    return hide


def test_appended_shots_give_the_bytes_of_a_single_run(night, out, expected, hidden):
    hidden(4, 5)
    night.run(out)
    before = content(out)
    stamps = {name: (out / name).stat().st_mtime_ns for name in before}
    earlier = read(out)
    hidden()
    progress = []
    grown = night.run(out, on_progress=progress.append)
    assert (progress[0].done, progress[0].total) == (4, 6)
    assert list(grown.status) == [DONE] * 6
    assert list(grown.name.values) == [f"shot_{i}.npy" for i in range(6)]
    assert list(grown.shot) == list(range(6))
    assert (grown.iterations > 0).all()
    assert content(out) == expected
    assert {name: (out / name).stat().st_mtime_ns for name in before} == stamps
    # A reader that opened it earlier sees the earlier content.
    np.testing.assert_array_equal(earlier.potential, grown.potential[:4])
    # So do those who go by the arrays' own metadata.
    plain = zarr.open_group(out, mode="r", use_consolidated=False)
    assert {array.shape[0] for name, array in plain.arrays() if name not in "yx"} - {2} == {6}


def test_shot_that_sorts_in_between_is_appended(night, out, hidden):
    hidden(1, 3, 4)
    night.run(out)
    hidden(3)
    assert list(night.run(out).name.values) == [f"shot_{i}.npy" for i in (0, 2, 5, 1, 4)]
    hidden()
    grown = night.run(out)
    order = [0, 2, 5, 1, 4, 3]
    assert list(grown.name.values) == [f"shot_{i}.npy" for i in order]
    assert list(grown.status) == [DONE] * 6
    again = night.run(out)  # the same glob once more
    assert list(again.name.values) == list(grown.name.values)
    shots = [night.path(index) for index in order]
    alone = night.run(out.with_name("alone.shadowinv.zarr"), shots=shots)
    np.testing.assert_array_equal(grown.potential, alone.potential)
    # A shot is known by its name, in whatever order they are given.
    again = night.run(out, shots=[night.path(index) for index in (0, 2, 5, 4, 1, 3)])
    assert list(again.name.values) == list(grown.name.values)


def test_pending_and_failed_shots_stay_so_until_their_turn(night, out, hidden):
    hidden(5)
    night.path(2).write_bytes(b"")
    night.run(out)
    hidden()
    np.save(night.path(2), night.images[2])

    def interrupt(_progress):
        raise KeyboardInterrupt  # as soon as it is longer

    with pytest.raises(KeyboardInterrupt):
        night.run(out, on_progress=interrupt)
    assert list(StackStore(out).statuses()) == [1, 1, 2, 1, 1, 0]
    assert list(night.run(out).status) == [1, 1, 2, 1, 1, 1]
    assert list(night.run(out, redo_failed=True).status) == [DONE] * 6


def test_arrays_and_films_grow_too(night, out, tmp_path, expected):
    film = tmp_path / "film.tif"
    for count in (4, 6):
        tifffile.imwrite(film, night.images[:count], photometric="minisblack")
        assert (
            list(night.run(tmp_path / "film.shadowinv.zarr", shots=film).status) == [DONE] * count
        )
        assert list(night.run(out, shots=night.images[:count]).status) == [DONE] * count
    assert content(out) == expected
    assert content(tmp_path / "film.shadowinv.zarr") == expected
    with pytest.raises(InputError, match="shot 1 has changed"):
        night.run(out, shots=night.images[[0, 2, 1, 3, 4, 5]])


class Killed(BaseException):
    """As a signal that nothing can catch."""


def test_killed_at_any_moment_of_growing_it_is_as_before(night, out, expected, hidden, monkeypatch):
    hidden(1, 5)
    night.run(out)
    before = read(out).load()
    begun = out.with_name("begun")
    shutil.copytree(out, begun)
    os_replace = os.replace
    remaining = [0]

    def replace(*paths):
        """Move a file to its place, but only a number of times."""
        if not remaining[0]:
            raise Killed
        remaining[0] -= 1
        return os_replace(*paths)

    finished = False
    moments = 0
    while not finished:
        shutil.rmtree(out)
        shutil.copytree(begun, out)
        hidden()
        remaining[0] = moments
        with monkeypatch.context() as patch:
            patch.setattr(os, "replace", replace)
            with pytest.raises(Killed):
                night.run(out, scheduler="synchronous")
        finished = len(StackStore(out).names) == 6
        if not finished:
            # The old store, to read and to go on with.
            assert read(out).load().identical(before)
            hidden(1, 5)
            if moments % 4 == 0:
                assert night.run(out).load().identical(before)
        hidden()
        after = night.run(out, shots=[night.path(i) for i in range(6)])
        assert list(after.name.values) == [f"shot_{i}.npy" for i in (0, 2, 3, 4, 1, 5)]
        assert list(after.status) == [DONE] * 6
        moments += 1
    assert moments > 8  # each array along shots, and the folder's own metadata
    first = {name: text for name, text in expected.items() if "/c/0" in name}
    assert first.items() <= content(out).items()


def test_workers_of_the_shorter_store_write_new_shots(night, out, expected, hidden):
    from distributed import Client, LocalCluster

    with (
        LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0"
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        hidden(3, 4, 5)
        night.run(out, scheduler=client)
        hidden()
        night.run(out, scheduler=client)
    assert content(out) == expected


def test_only_one_run_grows_a_store(night, out, hidden):
    hidden(5)
    night.run(out)
    hidden()
    busy = pytest.raises(FileFormatError, match="being written by another process")
    with locked(out), busy:
        night.run(out)
    assert len(StackStore(out).names) == 5
