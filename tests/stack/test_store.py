"""A store is only read as far as it is there, and damage to it ends in one sentence."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

import fuzz
from helpers.command_line import done, refused
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.store import StackStore, read_stack


@pytest.fixture
def store(night, tmp_path) -> Path:
    path = tmp_path / "run.shadowinv.zarr"
    night.run(path, shots=night.images[:2])
    return path


def test_the_copy_of_an_arrays_metadata_is_enough(store):
    before = read_stack(store)["potential"].values
    (store / "potential" / "zarr.json").write_bytes(b"\xff junk")
    np.testing.assert_array_equal(read_stack(store)["potential"].values, before)


@pytest.mark.parametrize("shots", [3000, 10**12])
def test_a_store_has_the_shots_that_are_there(store, shots):
    file = store / "zarr.json"
    content = json.loads(file.read_text())
    for array in content["consolidated_metadata"]["metadata"].values():
        if array["dimension_names"][:1] == ["shot"]:
            array["shape"][0] = shots
    file.write_text(json.dumps(content))
    with pytest.raises(FileFormatError, match=f"lists {shots} shots, but they are missing"):
        StackStore(store)
    refused("info", store, names=f"lists {shots} shots, but they are missing")


def test_a_store_opened_twice_is_not_taken_for_the_same_by_dask(store):
    first, second = (read_stack(store)["potential"].data.name for _ in range(2))
    assert first != second


def test_warnings_of_a_file_are_in_its_shots_report(any_night, tmp_path):
    image = any_night.images[0]
    colours = np.stack([image * share for share in (1, 2, 3)], axis=-1)
    tifffile.imwrite(tmp_path / "film.tif", colours.astype(np.uint16), photometric="rgb")
    out = tmp_path / "a.shadowinv.zarr"
    chosen = ("--channel", "red", "--set=options.n_sites=100", "--out", out)
    done("batch", tmp_path / "film.tif", *chosen)
    assert "film-scan" in {warning["code"] for warning in StackStore(out).report(0)["warnings"]}


def test_status_shows_names_and_reasons_as_they_are(any_night, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    names = ["a[b].npy", "c[bold]d.npy", "e[~f].npy"]
    for name in names:
        np.save(name, any_night.images[0])
    Path("bad\x1b[31m[oh].npy").write_bytes(b"junk")
    out = ("--set=options.n_sites=100", "--scheduler", "threads", "--out", "a.shadowinv.zarr")
    done("batch", *names, "bad\x1b[31m[oh].npy", *out, code=1)
    text = done("info", "a.shadowinv.zarr")
    assert r"bad\x1b[31m[oh].npy" in text
    assert "\x1b" not in text
    assert list(read_stack(Path("a.shadowinv.zarr")).name.values[:3]) == names


@pytest.mark.skipif(sys.platform != "linux", reason="memory is told by Linux")
def test_damage_at_random_ends_in_one_of_two_errors(store, tmp_path):
    reader = fuzz.Reader()
    (tmp_path / "bad").mkdir()
    tally = fuzz.fuzz("run.shadowinv.zarr", 20, 1, tmp_path / "bad", reader, store)
    reader.close()
    assert tally.failures == []
    assert tally.refused >= 3
