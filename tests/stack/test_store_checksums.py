"""Damage to a store: noticed, named by its shot, and repaired by running again."""

from __future__ import annotations

import json
import os
import shutil
import struct
from pathlib import Path

import google_crc32c
import numpy as np
import pytest
import zarr

from helpers.command_line import flat, shadowinv
from helpers.store_content import content
from napari_shadowinv import FileFormatError, read
from napari_shadowinv.io import store_checksums
from napari_shadowinv.io.store import DAMAGED, DONE, FAILED, PENDING, StackStore
from napari_shadowinv.io.store_checksums import Layout, find_damage, note_shot, reseal
from napari_shadowinv.io.store_writing import ShotWriter


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


def swap(first: Path, second: Path) -> None:
    spare = first.with_name("spare")
    first.rename(spare)
    second.rename(first)
    spare.rename(second)


def field(store: Path, shot: int, name: str = "displacement") -> Path:
    return store / name / "c" / str(shot) / ("0/0/0" if name == "displacement" else "0/0")


def test_every_array_ends_with_a_crc32c(store):
    for name, array in zarr.open_group(store, mode="r").arrays():
        assert array.metadata.codecs[-1].to_dict() == {"name": "crc32c"}, name


def test_untouched_store_has_no_damage(store):
    opened = StackStore(store, every_byte=True)
    assert opened.damage.shots == {}
    assert opened.damage.files == ()
    assert shadowinv("status", store, "--verify").exit_code == 0


@pytest.mark.parametrize("name", ["potential", "displacement", "caustic"])
def test_deleted_chunk_makes_its_shot_damaged(store, name):
    field(store, 3, name).unlink()
    assert read(store).status.values.tolist() == [DONE] * 3 + [DAMAGED] + [DONE] * 2
    problem = rf"shot 3 \(shot_3.npy\): its {name} is missing; .* to invert it again"
    with pytest.raises(FileFormatError, match=problem):
        read(store)[name].load()
    assert np.isfinite(read(store)[name][:3].values.astype(float)).all()


@pytest.mark.parametrize("key", ["y/c/0", "image_residual/c/0"])
def test_lost_file_of_all_shots_is_damage(store, key):
    (store / key).unlink()
    assert StackStore(store).damage.files == (f"{key} is missing",)


@pytest.mark.parametrize("part", ["report", "status"])
def test_lost_report_or_damaged_status_damages_the_shot(store, part):
    file = store / part / "c" / "2"
    file.unlink() if part == "report" else flip(file, 0)
    opened = StackStore(store)
    assert list(opened.damage.shots) == [2]
    assert f"its {part} is" in opened.report(2)["reason"]


def test_lost_report_of_a_failed_shot_damages_the_shot(make_night, out):
    night = make_night(2)
    np.save(night.path(1), 0 * night.images[1])
    night.run(out)
    (out / "report" / "c" / "1").unlink()
    assert StackStore(out).damage.shots == {1: "its report is missing"}


def test_field_of_a_failed_shot_is_damage(make_night, out):
    night = make_night(2)
    np.save(night.path(1), 0 * night.images[1])
    night.run(out)
    field(out, 1).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(field(out, 0), field(out, 1))
    assert list(StackStore(out).damage.shots) == [1]


@pytest.mark.parametrize("change", ["shape", "junk", "lost"])
def test_damaged_description_of_an_array_is_found_by_verify(store, change):
    file = store / "potential" / "zarr.json"
    description = json.loads(file.read_text())
    if change == "shape":
        description["shape"][2] += 1
    file.write_text("junk" if change == "junk" else json.dumps(description))
    if change == "lost":
        file.unlink()
    assert StackStore(store).damage.files == ()
    (problem,) = StackStore(store, every_byte=True).damage.files
    assert problem.startswith("potential/zarr.json is damaged")


def test_flipped_bit_of_the_last_file_is_found_by_verify(store):
    flip(field(store, 5, "caustic"), 0)
    flip(store / "noise_error" / "c" / "0", 0)
    damage = StackStore(store, every_byte=True).damage
    assert list(damage.shots) == [5]
    assert any(problem.startswith("noise_error/c/0 is damaged") for problem in damage.files)


@pytest.mark.parametrize("change", ["longer", "without empty entries"])
def test_equivalent_description_of_an_array_is_no_damage(store, change):
    file = store / "potential" / "zarr.json"
    description = json.loads(file.read_text())
    if change == "longer":  # as left by a process that was killed while the store grew
        description["shape"][0] += 3
    else:
        filled = {k: v for k, v in description.items() if v not in (None, {}, [])}
        description = {**filled, "must_understand": None}
    file.write_text(json.dumps(description))
    assert StackStore(store, every_byte=True).damage.files == ()


def test_shot_that_is_being_written_is_looked_at_again(store, monkeypatch):
    read_checksum, looks = store_checksums.stored_checksum, []

    def late_checksum(file: Path) -> str | None:
        if file == field(store, 2):
            looks.append(file)
        return None if len(looks) == 1 and file == field(store, 2) else read_checksum(file)

    monkeypatch.setattr(store_checksums, "stored_checksum", late_checksum)
    assert StackStore(store).damage.shots == {}
    assert len(looks) == 2


def test_report_of_several_texts_is_damage(store):
    file = store / "report" / "c" / "2"
    raw = struct.pack("<I", 2) + file.read_bytes()[4:-4]
    file.write_bytes(raw + struct.pack("<I", google_crc32c.value(raw)))
    problem = StackStore(store).damage.shots[2]
    assert problem.startswith("its report is damaged (its header implies")


def test_files_beyond_the_limit_of_memory_are_not_read(store, monkeypatch):
    layout = Layout.of(store, json.loads((store / "zarr.json").read_text()))
    monkeypatch.setenv("SHADOWINV_MAX_GB", "1e-7")
    shots = find_damage(layout).shots
    assert list(shots) == list(range(6))
    assert all("expands to" in problem for problem in shots.values())


def test_store_without_checksums_gets_none():
    assert reseal({"attributes": {}}) == {"attributes": {}}
    array = zarr.create_array({}, shape=(1,), chunks=(1,), dtype="f8", dimension_names=("shot",))
    layout = Layout.of_open(Path(), "id", {"potential": array})
    assert note_shot(layout, {"potential": array}, 0, []) == {}


def test_swapped_chunks_damage_both_shots(store):
    swap(field(store, 1), field(store, 4))
    assert np.flatnonzero(read(store).status == DAMAGED).tolist() == [1, 4]
    with pytest.raises(FileFormatError, match="its displacement is not the one that was written"):
        read(store).displacement[4].load()


def test_swapped_reports_damage_both_shots(store):
    swap(store / "report" / "c" / "1", store / "report" / "c" / "4")
    assert np.flatnonzero(read(store).status == DAMAGED).tolist() == [1, 4]


def swap_shots(store: Path, first: int, second: int) -> None:
    """Exchange all files that belong to two shots, and their names."""
    for chunks in store.glob("*/c"):
        if len(list(chunks.iterdir())) == 6:
            swap(chunks / str(first), chunks / str(second))
    names = zarr.open_group(store, mode="r+")["name"]
    names[[first, second]] = names[[second, first]]


def test_swapped_shots_are_damaged_with_all_their_files(store):
    swap_shots(store, 1, 4)
    damage = StackStore(store).damage
    problem = "its report was written for another shot"
    assert damage.shots == {1: problem, 4: problem}
    assert damage.files == ()
    with pytest.raises(FileFormatError, match=problem):
        read(store).potential[4].load()


def test_shot_of_another_store_is_damaged(any_night, store, tmp_path):
    other = tmp_path / "other.shadowinv.zarr"
    any_night.run(other)
    for name in ("report", "status", "potential", "displacement", "caustic"):
        shutil.rmtree(store / name)
        shutil.copytree(other / name, store / name)
    assert list(StackStore(store).damage.shots) == list(range(6))


def test_every_name_is_compared_with_its_report(store):
    names = zarr.open_group(store, mode="r+")["name"]
    names[[2, 3]] = names[[3, 2]]
    with pytest.raises(FileFormatError, match="name/c/0 does not belong to shots 0 to 5"):
        read(store)


def test_swapped_numbers_of_shots_are_refused(store):
    swap(store / "image_residual" / "c" / "0", store / "noise_error" / "c" / "0")
    with pytest.raises(FileFormatError, match="does not belong to shots 0 to 5"):
        read(store)


def test_coordinate_with_a_valid_checksum_of_its_own_is_damage(store):
    file = store / "y" / "c" / "0"
    flip(file, 0)
    raw = file.read_bytes()[:-4]
    file.write_bytes(raw + struct.pack("<I", google_crc32c.value(raw)))
    assert StackStore(store).damage.files == ("y/c/0 is not the file that was written",)


def test_flipped_bit_in_a_field_is_refused_on_reading(store):
    file = field(store, 2)
    flip(file, file.stat().st_size // 2)
    with pytest.raises(FileFormatError):
        read(store).displacement[2].load()
    result = shadowinv("status", store, "--verify")
    assert result.exit_code == 1
    assert "shot_2.npy: its displacement is damaged" in flat(result.output)


def test_flipped_digit_in_the_metadata_is_refused(store):
    file = store / "zarr.json"
    text = file.read_text()
    assert '"n_sites\\": 100' in text or 'n_sites\\":100' in text
    file.write_text(text.replace('n_sites\\":100', 'n_sites\\":101', 1))
    with pytest.raises(FileFormatError, match="does not match its checksum"):
        read(store)


@pytest.mark.parametrize("command", ["export", "movie"])
def test_damaged_shot_is_not_exported(store, tmp_path, command):
    field(store, 3, "potential").unlink()
    where = ["--format", "tiff", "--out", tmp_path / "t"] if command == "export" else []
    where = where or ["--out", tmp_path / "film.gif"]
    refused = shadowinv(command, store, *where)
    assert refused.exit_code == 2
    assert "shot 3 (shot_3.npy): its potential is missing" in flat(refused.output)
    assert shadowinv(command, store, *where, "--shots", "0:3").exit_code == 0


def test_run_again_redoes_only_damaged_shots(any_night, store, finished):
    field(store, 3, "potential").unlink()
    flip(field(store, 1), 300)
    swap(store / "image_residual" / "c" / "0", store / "noise_error" / "c" / "0")
    stamps = {index: field(store, index).stat().st_mtime_ns for index in range(6)}
    written = any_night.run(store)
    assert written.status.values.tolist() == [DONE] * 6
    changed = [i for i in range(6) if field(store, i).stat().st_mtime_ns != stamps[i]]
    assert changed == [1, 3]
    assert content(store) == content(finished)
    assert shadowinv("status", store, "--verify").exit_code == 0


def test_damaged_shot_is_pending_until_it_is_redone(any_night, store):
    field(store, 3, "potential").unlink()

    def stop(_progress: object) -> None:
        if _progress.engine:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        any_night.run(store, on_progress=stop)
    assert StackStore(store).statuses().tolist() == [DONE] * 3 + [PENDING] + [DONE] * 2
    assert np.isnan(read(store).displacement[3]).all()


def test_done_shot_whose_file_turns_bad_loses_every_field(make_night, out):
    night = make_night(2)
    names = ("potential", "displacement", "caustic", "weights")
    night.run(out, variables=names)
    field(out, 1, "potential").unlink()
    np.save(night.path(1), 0 * night.images[1])
    ShotWriter.of(StackStore(out)).reopen(1)
    written = night.run(out, variables=names)
    assert written.status.values.tolist() == [DONE, FAILED]
    for name in ("potential", "displacement", "weights"):
        assert np.isnan(written[name][1]).all()
        assert np.isfinite(written[name][0]).all()
    assert not written.caustic[1].any()
    assert shadowinv("status", out, "--verify").exit_code == 0


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


def test_store_without_checksums_is_read(finished, tmp_path):
    path = tmp_path / "old.shadowinv.zarr"
    shutil.copytree(finished, path)
    document = json.loads((path / "zarr.json").read_text())
    for name in ("metadata_sha256", "chunk_checksums"):
        del document["attributes"][name]
    (path / "zarr.json").write_text(json.dumps(document))
    np.testing.assert_array_equal(read(path).potential, read(finished).potential)
    result = shadowinv("status", path, "--verify")
    assert result.exit_code == 0
    assert "copied by another program" in flat(result.output)


def test_checksums_of_a_folder_are_not_passed_on(finished):
    assert not {"metadata_sha256", "chunk_checksums"} & read(finished).attrs.keys()


def test_many_shots_span_chunks_without_false_alarm(any_night, tmp_path, monkeypatch):
    from napari_shadowinv.io import store_writing

    monkeypatch.setattr(store_writing, "_TOGETHER", 2)
    path = tmp_path / "n.shadowinv.zarr"
    any_night.run(path, shots=[any_night.path(i) for i in range(3)])
    any_night.run(path)
    assert StackStore(path, every_byte=True).damage.files == ()
    (path / "flux_residual" / "c" / "2").rename(path / "away")
    assert StackStore(path).damage.files == ("flux_residual/c/2 is missing",)
    (path / "away").rename(path / "flux_residual" / "c" / "2")
    swap(path / "name" / "c" / "0", path / "name" / "c" / "1")
    with pytest.raises(FileFormatError, match="name/c/0 does not belong to shots 0 to 1"):
        read(path)


def test_files_are_read_no_further_than_regular(store):
    file = field(store, 3)
    file.unlink()
    os.mkfifo(file)
    assert StackStore(store).statuses()[3] == DAMAGED
