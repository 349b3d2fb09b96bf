"""Damage to a store: noticed, named by its shot, and repaired by running again."""

from __future__ import annotations

import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr

import damage
from helpers.command_line import done
from helpers.store_content import content
from napari_shadowinv import FileFormatError, read
from napari_shadowinv.io.store import DAMAGED, DONE, FAILED, PENDING, StackStore
from napari_shadowinv.io.store_writing import ShotWriter


def test_damage_at_random_is_noticed(tmp_path, compiled):
    """`benchmarks/damage.py` does the same 500 times."""
    counts = damage.count_outcomes(12, 3, tmp_path)
    for name in ("bit of a chunk", "lost chunk", "shortened chunk", "bit of a result file"):
        assert counts[name] == {"noticed": 2}, name


@pytest.fixture(scope="module")
def finished(any_night, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("finished") / "n.shadowinv.zarr"
    any_night.run(path)
    return path


@pytest.fixture
def store(finished, tmp_path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / finished.name))


def flip(file: Path, place: int, bit: int = 3) -> None:
    data = bytearray(file.read_bytes())
    data[place] ^= 1 << bit
    file.write_bytes(data)


def field(store: Path, shot: int, name: str = "displacement") -> Path:
    return store / name / "c" / str(shot) / ("0/0/0" if name == "displacement" else "0/0")


def test_untouched_store_has_checksums_and_no_damage(store):
    for name, array in zarr.open_group(store, mode="r").arrays():
        assert array.metadata.codecs[-1].to_dict() == {"name": "crc32c"}, name
    opened = StackStore(store, every_byte=True)
    assert opened.damage.shots == {}
    assert opened.damage.files == ()
    done("info", store, "--verify")


@pytest.mark.parametrize("name", ["potential", "displacement", "caustic"])
def test_deleted_chunk_makes_its_shot_damaged(store, name):
    field(store, 3, name).unlink()
    assert read(store).status.values.tolist() == [DONE] * 3 + [DAMAGED] + [DONE] * 2
    assert StackStore(store).damage.shots == {3: f"its {name} is missing"}
    assert name == "caustic" or np.isnan(read(store)[name][3]).all()
    assert np.isfinite(read(store)[name][:3].values.astype(float)).all()


def test_lost_file_of_all_shots_is_damage(any_night, store):
    (store / "y" / "c" / "0").unlink()
    assert StackStore(store).damage.files == ("y/c/0 is missing",)
    for call in (read, any_night.run):
        with pytest.raises(FileFormatError, match="y/c/0 is missing"):
            call(store)


def test_done_shot_without_some_field_is_not_damaged(store):
    potential = read(store).potential[2].values
    ShotWriter.of(StackStore(store)).write(2, {"potential": potential}, {"n_sites": 100})
    assert StackStore(store, every_byte=True).damage.shots == {}
    np.testing.assert_array_equal(read(store).potential[2], potential)
    assert np.isnan(read(store).displacement[2]).all()


@pytest.mark.parametrize("part", ["report", "status"])
def test_lost_report_or_damaged_status_damages_the_shot(store, part):
    file = store / part / "c" / "2"
    file.unlink() if part == "report" else flip(file, 0)
    opened = StackStore(store)
    assert list(opened.damage.shots) == [2]
    assert f"its {part} is" in opened.report(2)["reason"]


def test_lost_report_of_a_failed_shot_damages_the_shot(any_night, out):
    any_night.run(out, shots=any_night.images[:2] * [[[1]], [[0]]])
    (out / "report" / "c" / "1").unlink()
    assert StackStore(out).damage.shots == {1: "its report is missing"}


def test_flipped_bit_of_the_last_file_is_found_by_verify(store):
    flip(field(store, 5, "caustic"), 0)
    flip(store / "shot" / "c" / "0", 0)
    damage = StackStore(store, every_byte=True).damage
    assert list(damage.shots) == [5]
    assert any(problem.startswith("shot/c/0 is damaged") for problem in damage.files)


def test_flipped_bit_in_a_field_is_refused_on_reading(store):
    file = field(store, 2)
    flip(file, file.stat().st_size // 2)
    for again in (read(store), pickle.loads(pickle.dumps(read(store)))):
        with pytest.raises(FileFormatError, match=r"displacement/c/2 could not be read .*checksum"):
            again.displacement[1:, 0, ::2][1].load()
        assert np.isfinite(again.displacement[1::2]).all()
    damaged = "shot_2.npy: its displacement is damaged"
    assert damaged in done("info", store, "--verify", code=1)


@pytest.mark.parametrize("command", ["export", "movie"])
def test_damaged_shot_is_not_exported(store, tmp_path, command):
    field(store, 3, "potential").unlink()
    where = ["--format", "tiff", "--out", tmp_path / "t"] if command == "export" else []
    where = where or ["--out", tmp_path / "film.gif"]
    missing = "shot 3 (shot_3.npy): its potential is missing"
    assert missing in done(command, store, *where, code=2)
    done(command, store, *where, "--shots", "0:3")


def test_run_again_redoes_only_damaged_shots(any_night, store, finished):
    field(store, 3, "potential").unlink()
    flip(field(store, 1), 300)
    flip(store / "report" / "c" / "4", 20)
    flip(store / "status" / "c" / "5", 0)
    stamps = {index: field(store, index).stat().st_mtime_ns for index in range(6)}
    written = any_night.run(store)
    assert written.status.values.tolist() == [DONE] * 6
    changed = [i for i in range(6) if field(store, i).stat().st_mtime_ns != stamps[i]]
    assert changed == [1, 3, 4, 5]
    assert content(store) == content(finished)
    done("info", store, "--verify")


def test_damaged_shot_is_pending_until_it_is_redone(any_night, store):
    field(store, 3, "potential").unlink()

    def stop(_progress: object) -> None:
        if _progress.scheduler:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        any_night.run(store, on_progress=stop)
    assert StackStore(store).statuses().tolist() == [DONE] * 3 + [PENDING] + [DONE] * 2
    assert np.isnan(read(store).displacement[3]).all()


@pytest.mark.parametrize("way", ["reopened", "failed"])
def test_shot_that_was_done_keeps_no_field(make_night, out, way):
    names = ("potential", "displacement", "caustic", "weights")
    make_night(2).run(out, variables=names)
    writer = ShotWriter.of(StackStore(out))
    if way == "reopened":
        writer.reopen(1)
    else:
        writer.write(1, {}, {"error": "no image"}, FAILED)
    arrays = writer.arrays()
    for name in ("potential", "displacement", "weights"):
        assert np.isnan(arrays[name][1]).all(), name
        assert np.isfinite(arrays[name][0]).all(), name
    assert not arrays["caustic"][1].any()


def test_many_shots_span_chunks_without_false_alarm(any_night, tmp_path, monkeypatch):
    from napari_shadowinv.io import store_writing

    monkeypatch.setattr(store_writing, "_TOGETHER", 2)
    path = tmp_path / "n.shadowinv.zarr"
    any_night.run(path, shots=[any_night.path(i) for i in range(3)])
    any_night.run(path)
    assert StackStore(path, every_byte=True).damage.files == ()
    (path / "shot" / "c" / "2").rename(path / "away")
    assert StackStore(path).damage.files == ("shot/c/2 is missing",)


def test_copy_by_another_program_may_leave_out_empty_chunks(finished, tmp_path):
    path = tmp_path / "copy.shadowinv.zarr"
    shots = read(finished).drop_vars(["status", "deflection_angle"], errors="ignore")
    shots["caustic"] = shots["caustic"] & False
    shots.assign(status=("shot", np.full(6, DONE, np.int8))).to_zarr(path)
    np.testing.assert_array_equal(read(path).potential, read(finished).potential)
    done("info", path, "--verify")
    flip(field(path, 2), 60)
    assert list(StackStore(path, every_byte=True).damage.shots) == [2]
