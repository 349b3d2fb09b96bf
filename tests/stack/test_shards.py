"""Shards: parts of the shots that several processes write into one store, without a lock."""

from __future__ import annotations

import importlib.util
import os
import random
import re
import shlex
import shutil
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from helpers.command_line import flat, shadowinv
from helpers.night import OPTIONS
from helpers.shard_process import ShardProcesses, shard_processes
from helpers.slow_reading import log_and_read
from napari_shadowinv import (
    FileFormatError,
    InputError,
    InversionOptions,
    RunOptions,
    merge_stack,
    read,
    watch_stack,
)
from napari_shadowinv._system.hidden_files import locked
from napari_shadowinv.io import store_writing
from napari_shadowinv.io.store import DONE, FAILED, StackStore
from napari_shadowinv.io.store_writing import ShotWriter, StoreError
from napari_shadowinv.stack import RunStatus, numbers_of

ROOT = Path(__file__).parents[2]


def in_one_thread(night, out: Path, shard: str | None = None, **changes: Any):
    """Run a shard of a night, or all of it."""
    return night.run(out, shard=shard, scheduler="synchronous", **changes)


@pytest.fixture(scope="module")
def facility_night() -> ModuleType:
    """The benchmark, which compares stores file by file."""
    path = ROOT / "benchmarks" / "facility_night.py"
    spec = importlib.util.spec_from_file_location("facility_night", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["facility_night"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def single(any_night, tmp_path_factory) -> Path:
    """The store of a single run without shards."""
    path = tmp_path_factory.mktemp("single") / "single.shadowinv.zarr"
    in_one_thread(any_night, path)
    return path


@pytest.fixture(scope="module")
def two_of_three(any_night, tmp_path_factory) -> Path:
    """A store whose second shard is missing."""
    path = tmp_path_factory.mktemp("shards") / "night.shadowinv.zarr"
    for shard in ("1/3", "3/3"):
        in_one_thread(any_night, path, shard)
    return path


@pytest.fixture
def unmerged(two_of_three, out) -> Path:
    """A copy of that store, which a test may change."""
    shutil.copytree(two_of_three, out)
    return out


@pytest.fixture(scope="module")
def processes():
    if not hasattr(os, "fork"):
        pytest.skip("the shards are forked")
    with shard_processes() as started:
        yield started


@pytest.fixture
def job(any_night, tmp_path, out) -> dict[str, Any]:
    """A shard for a process of its own."""
    np.save(tmp_path / "source.npy", any_night.source)
    source = str(tmp_path / "source.npy")
    return {"out": str(out), "shots": any_night.glob, "source": source, "kill_at": None}


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def file_contents(store: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in store.rglob("*") if path.is_file()}


def test_shards_in_any_order_equal_a_single_run(any_night, single, out, facility_night):
    for number in (3, 1, 4, 2):
        shard = in_one_thread(any_night, out, f"{number}/4")
        assert list(shard.shot) == list(range(number - 1, 6, 4))
        assert (shard.status == DONE).all()
    merged, expected = merge_stack(out), read(single)
    assert facility_night.differences(out, single) == []
    assert names_in(out.parent) - {out.name, "shots"} == set()
    # Also as opened: every column, attribute and provenance, but not times.
    times = ["seconds", "report"]
    for dataset in (merged, expected):
        for name in ("created", "store_id"):
            del dataset.attrs[name]
    assert merged.drop_vars(times).identical(expected.drop_vars(times))
    assert (merged.seconds > 0).all()
    assert merged.attrs["provenance"]


@pytest.mark.parametrize(
    "choices",
    [
        {"options": InversionOptions()},  # the first shots decide the number of sites
        {"warm_start": 2, "options": OPTIONS},
    ],
)
def test_shards_share_sites_and_keep_groups(choices, any_night, out, tmp_path, facility_night):
    whole = tmp_path / "whole.shadowinv.zarr"
    in_one_thread(any_night, whole, **choices)
    for shard in ("2/2", "1/2"):
        in_one_thread(any_night, out, shard, **choices)
    merge_stack(out)
    assert facility_night.differences(out, whole) == []


def test_shards_divide_groups_evenly():
    for count, group, shots in ((40, 1, 1003), (7, 5, 333), (3, 2, 2)):
        shards = [
            numbers_of(RunOptions(shard=f"{number}/{count}", warm_start=group), shots)
            for number in range(1, count + 1)
        ]
        assert sorted(index for shard in shards for index in shard) == list(range(shots))
        groups = [{index // group for index in shard} for shard in shards]
        assert sum(map(len, groups)) == -(-shots // group)
        assert max(map(len, groups)) - min(map(len, groups)) <= 1
    assert numbers_of(RunOptions(), 5) is None


def test_killed_shards_and_merges_are_repeated(
    processes: ShardProcesses, job, single, out, facility_night
):
    rng = random.Random(5)
    codes: Counter[int] = Counter()
    remains = 0

    def run(shard: str | None, changes: int) -> None:
        """Kill a shard or the merge before one of the first changes that it makes to files."""
        nonlocal remains
        kill_at = rng.randint(1, changes)
        codes.update(processes.run({**job, "shard": shard, "kill_at": kill_at}))
        remains += len(facility_night.leftovers(out.parent, (out.name, "source.npy")))

    for shard in ("3/3", "1/3", "2/3"):
        for _ in range(2):
            # While it creates the store, or writes its two shots.
            run(shard, 45 if out.exists() else 180)
        assert processes.run({**job, "shard": shard}) == [0]
    for _ in range(2):
        run(None, 34)
    assert processes.run({**job, "shard": None}) == [0]
    assert codes[-9] >= 6
    assert codes.keys() <= {-9, 0}  # a shard may have fewer changes left to make
    assert remains > 0
    assert facility_night.differences(out, single) == []
    assert facility_night.leftovers(out.parent, (out.name, "source.npy")) == []


def test_shards_that_run_at_once_create_one_store(
    processes: ShardProcesses, job, single, out, facility_night
):
    # One of them twice, as after a network failure that a job system took for the end of a node.
    jobs = [{**job, "shard": shard} for shard in ("1/3", "2/3", "3/3", "2/3")]
    assert processes.run(*jobs) == [0] * 4
    merge_stack(out)
    assert facility_night.differences(out, single) == []
    assert facility_night.leftovers(out.parent, (out.name, "source.npy")) == []


def test_a_store_created_meanwhile_is_used(any_night, single, out, monkeypatch, facility_night):
    write_template = store_writing._write_template

    def write_slowly(path, contents):
        write_template(path, contents)
        monkeypatch.setattr(store_writing, "_write_template", write_template)
        in_one_thread(any_night, out, "2/2")

    monkeypatch.setattr(store_writing, "_write_template", write_slowly)
    in_one_thread(any_night, out, "1/2")
    assert names_in(out.parent) == {out.name}
    merge_stack(out)
    assert facility_night.differences(out, single) == []


def test_a_shard_opens_no_file_of_the_shots_of_others(unmerged, any_night, opened_paths):
    before = file_contents(unmerged)
    opened_paths.clear()
    in_one_thread(any_night, unmerged, "2/3")
    of_shots = re.compile(r"/(?:potential|displacement|caustic|status|report)/c/(\d+)")
    assert {match[1] for path in opened_paths if (match := of_shots.search(path))} == {"1", "4"}
    after = file_contents(unmerged)
    assert all(after[path] == content for path, content in before.items())


def test_a_repeated_shard_reads_only_shots_that_are_pending(night, out):
    in_one_thread(night, out, "1/2", reader=log_and_read)
    (out / "status" / "c" / "2").unlink()  # as if killed before it was written
    statuses: list[RunStatus] = []
    for engine in ("1 thread", "nothing to do"):
        in_one_thread(night, out, "1/2", reader=log_and_read, on_progress=statuses.append)
        last = statuses[-1]
        assert (last.engine, last.total, last.done) == (engine, 3, 3)
    assert Counter(night.reads) == {"shot_0": 1, "shot_2": 2, "shot_4": 1}


def test_failed_shots_are_merged_and_repeated_by_their_shard(night, out):
    image = np.load(night.path(1))
    np.save(night.path(1), 0 * image)
    for shard in ("1/2", "2/2"):
        in_one_thread(night, out, shard)
    np.save(night.path(1), image)
    in_one_thread(night, out, "1/2", redo_failed=True)
    assert list(read(out).status) == [DONE, FAILED, *[DONE] * 4]
    result = shadowinv("merge", out)
    assert result.exit_code == 1
    assert "5 done, 1 failed, 0 pending" in flat(result.output)
    # A merged store is continued as usual.
    assert (in_one_thread(night, out, redo_failed=True).status == DONE).all()


def test_a_damaged_shot_is_repeated_by_its_shard(unmerged, any_night, single, facility_night):
    in_one_thread(any_night, unmerged, "2/3")
    chunk = unmerged / "potential" / "c" / "3" / "0" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"shard 1 of 3 is incomplete \(0 shots pending, 1 dam"):
        merge_stack(unmerged)
    in_one_thread(any_night, unmerged, "2/3")
    assert StackStore(unmerged).damage.shots
    in_one_thread(any_night, unmerged, "1/3")
    merge_stack(unmerged)
    assert facility_night.differences(unmerged, single) == []


def test_merge_lists_incomplete_shards_and_changes_nothing(any_night, out):
    in_one_thread(any_night, out, "5/6")
    before = file_contents(out)
    with pytest.raises(InputError) as error:
        merge_stack(out)
    assert str(error.value) == (
        f"{out} cannot be merged yet, as shards 1-4,6 of 6 are incomplete (5 shots pending): run "
        "shards 1-4,6 again, then merge"
    )
    assert file_contents(out) == before
    assert names_in(out.parent) == {out.name}
    assert "6, not merged; incomplete: 1-4,6" in flat(shadowinv("status", out).output)


def test_merge_refuses_stores_without_shards(unmerged, any_night, single, tmp_path):
    in_one_thread(any_night, unmerged, "2/3")
    assert "3, all complete: merge them" in flat(shadowinv("status", unmerged).output)
    assert shadowinv("merge", unmerged, "--quiet").exit_code == 0
    for store in (unmerged, single):
        before = file_contents(store)
        result = shadowinv("merge", store)
        assert result.exit_code == 2
        assert f"{store} has no shards to merge: they are merged already" in flat(result.output)
        assert file_contents(store) == before
    missing = tmp_path / "missing.shadowinv.zarr"
    assert "does not exist" in flat(shadowinv("merge", missing).output)
    assert names_in(tmp_path) == {unmerged.name}


def test_two_merges_at_once_are_refused(unmerged):
    with locked(unmerged), pytest.raises(FileFormatError, match="is being written by process"):
        merge_stack(unmerged)


def test_merge_removes_drafts_of_any_machine(unmerged, any_night):
    in_one_thread(any_night, unmerged, "2/3")
    elsewhere = "-01234567-4711-89ab-0f1e2d3c"
    drafts = [
        unmerged.with_name(f".{unmerged.name}{elsewhere}"),
        unmerged / f".zarr{elsewhere}.json",
    ]
    foreign = unmerged.with_name(f".later.shadowinv.zarr{elsewhere}")
    for folder in (drafts[0], foreign):
        (folder / "status").mkdir(parents=True)
    drafts[1].write_text("{")
    (unmerged / "status" / "c" / "1.0a1b.partial").write_text("")
    merge_stack(unmerged)
    assert names_in(unmerged.parent) == {unmerged.name, foreign.name}
    assert not any(path.exists() for path in drafts)
    assert not list(unmerged.rglob("*.partial"))


def test_a_shard_that_survives_the_merge_cannot_write(unmerged, any_night):
    in_one_thread(any_night, unmerged, "2/3")
    writer = ShotWriter.of(StackStore(unmerged))
    merge_stack(unmerged)
    before = file_contents(unmerged)
    with pytest.raises(StoreError, match="must not be replaced or merged during the run"):
        writer.write(1, {}, {"reason": "late"}, FAILED)
    assert file_contents(unmerged) == before


@pytest.mark.parametrize(
    ("shard", "changes", "reason"),
    [
        ("1/4", {}, r"is written in 3 shards, received shard 1 of 4: use the same number"),
        (None, {}, r"is written in 3 shards: merge them before you continue without shards"),
        ("2/3", {"options": InversionOptions(n_sites=90)}, r"different options \(n_sites: 100 th"),
        ("2/3", {"source": None}, r"different source image"),
        ("2/3", {"warm_start": 2}, r"different warm start \(1 there, 2 now\)"),
        ("2/3", {"shots": slice(0, 5)}, r"different shots \(6 there, 5 given, without shot_5"),
    ],
)
def test_shards_of_another_run_are_refused(shard, changes, reason, unmerged, any_night):
    unfinished = unmerged / "potential" / "c" / "1" / "0.0a1b.partial"  # of a shard that runs
    unfinished.parent.mkdir()
    unfinished.write_text("")
    if isinstance(part := changes.get("shots"), slice):
        changes = {"shots": [any_night.path(index) for index in range(6)[part]]}
    before = file_contents(unmerged)
    with pytest.raises(InputError, match=reason):
        in_one_thread(any_night, unmerged, shard, **changes)
    assert file_contents(unmerged) == before


def test_a_watch_of_the_folder_leaves_shards_alone(unmerged, any_night):
    unfinished = unmerged / "status" / "c" / "1.0a1b.partial"
    unfinished.write_text("")
    with pytest.raises(InputError, match="is written in 3 shards: merge them"):
        watch_stack(any_night.folder, unmerged, watch={"pattern": "*.npy", "idle": 0.1})
    assert unfinished.exists()


def test_shards_of_other_files_or_rows_are_refused(night, out, tmp_path):
    table = tmp_path / "pack.csv"
    rows = "file, brightness\nshots/shot_0.npy, 1\nshots/shot_1.npy, {}\n"
    table.write_text(rows.format(1))
    in_one_thread(night, out, "1/2", shots=table)
    table.write_text(rows.format(1.2))
    other = "shots of the same names from other files or with other rows of a table: use the same"
    with pytest.raises(InputError, match=other):
        in_one_thread(night, out, "2/2", shots=table)
    table.write_text(rows.format(1))
    in_one_thread(night, out, "2/2", shots=table)
    assert (merge_stack(out).status == DONE).all()

    images = tmp_path / "images.shadowinv.zarr"
    in_one_thread(night, images, "1/2", shots=night.images)
    with pytest.raises(InputError, match=other):
        in_one_thread(night, images, "2/2", shots=night.images[::-1])
    in_one_thread(night, images, "2/2", shots=night.images)
    assert (merge_stack(images).status == DONE).all()


def test_shards_find_files_by_their_place_beside_the_store(night, tmp_path):
    """A file system may be mounted elsewhere on another machine, but not its folders exchanged."""
    out = tmp_path / "night.shadowinv.zarr"
    in_one_thread(night, out, "1/2")
    shutil.copytree(night.folder, tmp_path / "other")
    with pytest.raises(InputError, match="from other files"):
        in_one_thread(night, out, "2/2", shots=str(tmp_path / "other" / "shot_*.npy"))
    mounted = tmp_path / "mounted"
    shutil.copytree(night.folder, mounted / "shots")
    shutil.move(out, mounted)
    there = mounted / out.name
    in_one_thread(night, there, "2/2", shots=str(mounted / "shots" / "shot_*.npy"))
    assert (merge_stack(there).status == DONE).all()


def test_new_shots_wait_for_the_merge(night, out):
    in_one_thread(night, out, "1/2")
    np.save(night.path(6), night.images[2])
    with pytest.raises(InputError, match="was started with 6 shots, received 7: use the same"):
        in_one_thread(night, out, "2/2")
    in_one_thread(night, out, "2/2", shots=[night.path(index) for index in range(6)])
    with pytest.raises(InputError, match="is written in 2 shards: merge them"):
        in_one_thread(night, out)
    merge_stack(out)
    with pytest.raises(InputError, match="was written without shards, or its shards are merged"):
        in_one_thread(night, out, "1/2")
    assert (in_one_thread(night, out).status == DONE).sum() == 7


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--shard", "0/40"], "--shard is '0/40': expected a shard from 1/40 to 40/40"),
        (["--shard", "41/40"], "--shard is '41/40': expected a shard from 1/40 to 40/40"),
        (["--shard", "a/b"], "--shard is 'a/b': expected a shard and the number of shards, such"),
        (["--shard", "3"], "--shard is '3': expected a shard and the number of shards, such as"),
        (["--shard", "1/0"], "--shard is '1/0': expected a shard and the number of shards"),
        (["--shard", "1/2", "--overwrite"], "--shard is 1/2 and --overwrite is set, but a shard"),
    ],
)
def test_wrong_shards_give_one_sentence(flags, message, any_night, out):
    result = shadowinv("batch", any_night.glob, "--out", out, *flags)
    assert result.exit_code == 2
    assert flat(result.output).startswith(message)
    assert len(result.output.strip().splitlines()) == 1
    assert names_in(out.parent) == set()


def test_a_shard_summarises_its_own_shots(night, out, tmp_path):
    np.save(tmp_path / "source.npy", night.source)
    np.save(night.path(1), 0 * night.images[1])
    command = ["batch", night.glob, "--source", tmp_path / "source.npy", "--n-sites", "100"]
    text = {}
    for number, code in ((1, 0), (2, 1)):
        flags = ["--out", out, "--shard", f"{number}/2", "--workers", "1"]
        result = shadowinv(*command, *flags)
        assert result.exit_code == code, result.output
        text[number] = flat(result.output)
    assert "shots 3 done, 0 failed, 0 pending" in text[1]
    assert "shard 1/2; merge the store after the last" in text[1]
    assert "shots 2 done, 1 failed, 0 pending" in text[2]
    assert "shot_1.npy" in text[2]
    assert not any(f"shot_{index}.npy" in text[1] for index in (1, 3, 5))


def test_the_job_array_of_the_page_inverts_a_night(night, tmp_path, monkeypatch):
    page = (ROOT / "docs" / "batch.md").read_text(encoding="utf-8")
    (script,) = re.findall(r"```bash\n(#!/bin/bash\n#SBATCH.*?)```", page, re.DOTALL)
    count = int(re.search(r"--array=1-(\d+)", script)[1])  # type: ignore[index]
    assert f"/{count}" in script
    project = tmp_path / "project"
    (project / "shots").mkdir(parents=True)
    for index, image in enumerate(night.images):
        np.save(project / "shots" / f"shot_{index}.npy", image)
    np.save(project / "reference.npy", night.source)
    text = re.sub(r"\\\n", " ", script).replace("/project", str(project))
    text = text.replace(".tif", ".npy").replace(f"/{count}", "/3")
    (line,) = re.findall(r"^shadowinv (batch.*)$", text, re.MULTILINE)
    for task in ("3", "1", "2"):
        arguments = shlex.split(line.replace("$SLURM_ARRAY_TASK_ID", task))
        assert shadowinv(*arguments, "--n-sites", "100").exit_code == 0
    (merging,) = re.findall(r"--wrap '(shadowinv merge [^']*)'", page)
    result = shadowinv(*shlex.split(merging.replace("/project", str(project)))[1:])
    assert result.exit_code == 0
    assert (read(project / "night.shadowinv.zarr").status == DONE).all()
    assert names_in(project) == {"shots", "reference.npy", "night.shadowinv.zarr"}
