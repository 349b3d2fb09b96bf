"""A store is only read as far as it is there, and nothing in it blocks or fills the memory."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import pickle
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner
from zarr.core.buffer import default_buffer_prototype

from napari_shadowinv import InversionOptions, Recipe, run_stack
from napari_shadowinv.cli import app
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.store import DAMAGED, DONE, StackStore, read_stack
from napari_shadowinv.io.store_checksums import FIXED, SEAL, CheckedStore

OPTIONS = InversionOptions(n_sites=100)


@pytest.fixture
def store(night, tmp_path) -> Path:
    path = tmp_path / "run.shadowinv.zarr"
    run_stack(
        night.images[:2], path, Recipe(options=OPTIONS), source=night.source, scheduler="threads"
    )
    return path


def status(path: Path):
    return CliRunner().invoke(app, ["status", str(path)])


@pytest.fixture
def unsealed(store) -> Path:
    """A store without checksums, as a copy by another program."""
    file = store / "zarr.json"
    document = json.loads(file.read_text())
    for name in (SEAL, FIXED):
        del document["attributes"][name]
    file.write_text(json.dumps(document))
    return store


def test_the_count_of_a_report_is_looked_at_first(unsealed):
    store = unsealed
    chunk = store / "report" / "c" / "0"
    chunk.write_bytes(np.uint32(2**31 - 1).tobytes() + chunk.read_bytes()[4:])
    tracemalloc.start()
    with pytest.raises(FileFormatError, match="implies 2147483647"):
        StackStore(store).reports()
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()
    assert status(store).exit_code == 2


def test_the_bytes_of_a_packed_chunk_are_looked_at_first(unsealed):
    store = unsealed
    chunk = store / "potential" / "c" / "0" / "0" / "0"
    head = chunk.read_bytes()
    chunk.write_bytes(head[:4] + np.uint32(2**31 - 1).tobytes() + head[8:])
    with pytest.raises(FileFormatError, match="implies 2147483647"):
        read_stack(store)["potential"][0].load()


@pytest.mark.skipif(sys.platform != "linux", reason="needs pipes and devices")
@pytest.mark.parametrize("where", ["zarr.json", "name/c/0"])
def test_a_pipe_or_a_device_in_a_store_is_refused(store, where):
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        (store / where).unlink()
        make(store / where)
        with pytest.raises(FileFormatError):
            StackStore(store).reports()


@pytest.mark.skipif(sys.platform != "linux", reason="needs pipes and devices")
@pytest.mark.parametrize("where", ["status/c/1", "report/c/1", "potential/c/1/0/0"])
def test_a_pipe_or_a_device_in_a_shot_damages_the_shot(store, where):
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        (store / where).unlink()
        make(store / where)
        opened = StackStore(store)
        assert opened.statuses().tolist() == [DONE, DAMAGED]
        assert "is a" in opened.reports()[1]["reason"]


@pytest.mark.skipif(sys.platform != "linux", reason="needs pipes")
def test_a_pipe_in_a_store_without_checksums_is_refused(unsealed):
    (unsealed / "name" / "c" / "0").unlink()
    os.mkfifo(unsealed / "name" / "c" / "0")
    with pytest.raises(FileFormatError, match="is a pipe"):
        StackStore(unsealed)


def test_a_chunk_beyond_the_limit_of_memory_is_not_unpacked(unsealed, monkeypatch):
    monkeypatch.setenv("SHADOWINV_MAX_GB", "5e-6")
    with pytest.raises(FileFormatError, match="expands to"):
        StackStore(unsealed)


def test_parts_of_files_are_checked_too(store):
    (store / "zarr.json").write_text((store / "zarr.json").read_text().replace("100", "101"))
    parts = CheckedStore(store).get_partial_values(
        default_buffer_prototype(), [("zarr.json", None)]
    )
    with pytest.raises(FileFormatError, match="does not match its checksum"):
        asyncio.run(parts)


def test_the_copy_of_an_arrays_metadata_is_enough(store):
    before = read_stack(store)["potential"].values
    (store / "potential" / "zarr.json").write_bytes(b"\xff junk")
    np.testing.assert_array_equal(read_stack(store)["potential"].values, before)


@pytest.mark.parametrize("shots", [3000, 10**12])
def test_a_store_has_the_shots_that_are_there(unsealed, shots):
    store = unsealed
    file = store / "zarr.json"
    content = json.loads(file.read_text())
    for array in content["consolidated_metadata"]["metadata"].values():
        if array["dimension_names"][:1] == ["shot"]:
            array["shape"][0] = shots
    file.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=f"lists {shots} shots, but they are missing"):
        StackStore(store)
    result = status(store)
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1


def test_a_store_opened_twice_is_not_taken_for_the_same_by_dask(store):
    first, second = (read_stack(store)["potential"].data.name for _ in range(2))
    assert first != second
    assert pickle.loads(pickle.dumps(CheckedStore(store))).root == store


def test_warnings_of_a_file_are_in_its_shots_report(night, tmp_path):
    colours = np.stack([night.images[0] * share for share in (1, 2, 3)], axis=-1)
    tifffile.imwrite(tmp_path / "film.tif", colours.astype(np.uint16), photometric="rgb")
    shape = "{} {}".format("{}", night.source.shape)
    header = "\n".join(shape.format(name) for name in ("flux2D", "flux2D_ref"))
    np.savetxt(tmp_path / "input.txt", np.vstack([night.images[0]] * 2), header=header)
    arguments = [str(tmp_path / name) for name in ("film.tif", "input.txt")]
    out = str(tmp_path / "a.shadowinv.zarr")
    chosen = ["--channel", "red", "--n-sites", "100", "--scheduler", "threads", "--out", out]
    result = CliRunner().invoke(app, ["batch", *arguments, *chosen])
    assert result.exit_code == 0, result.output
    film, text = (StackStore(Path(out)).report(index)["warnings"] for index in (0, 1))
    assert "film-scan" in {warning["code"] for warning in film}
    assert "file" in {warning["code"] for warning in text}


def test_status_shows_names_and_reasons_as_they_are(night, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["a[b].npy", "c[bold]d.npy", "e[~f].npy"]
    for name in names:
        np.save(name, night.images[0])
    Path("bad\x1b[31m[oh].npy").write_bytes(b"junk")
    runner = CliRunner()
    out = ["--n-sites", "100", "--scheduler", "threads", "--out", "a.shadowinv.zarr"]
    assert runner.invoke(app, ["batch", *names, "bad\x1b[31m[oh].npy", *out]).exit_code == 1
    for more in ([], ["--all"]):
        result = runner.invoke(app, ["status", "a.shadowinv.zarr", *more], env={"COLUMNS": "300"})
        assert result.exit_code == 0, result.output
        assert r"bad\x1b[31m[oh].npy" in result.stdout
        assert "\x1b" not in result.stdout
    assert all(name in result.stdout for name in names)


@pytest.mark.skipif(sys.platform != "linux", reason="memory is told by Linux")
def test_damage_at_random_ends_in_one_of_two_errors(store, tmp_path):
    path = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"
    spec = importlib.util.spec_from_file_location("fuzz", path)
    fuzz = sys.modules["fuzz"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fuzz)
    reader = fuzz.Reader()
    (tmp_path / "bad").mkdir()
    tally = fuzz.fuzz("run.shadowinv.zarr", 30, 1, tmp_path / "bad", reader, store)
    reader.close()
    assert tally.failures == []
    assert tally.refused >= 3
