"""A store is only read as far as it is there, and damage to it ends in one sentence."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from napari_shadowinv import InversionOptions
from napari_shadowinv.cli import app
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.io.store import StackStore, read_stack

OPTIONS = InversionOptions(n_sites=100)


@pytest.fixture
def store(night, tmp_path) -> Path:
    path = tmp_path / "run.shadowinv.zarr"
    night.run(path, shots=night.images[:2])
    return path


def status(path: Path):
    return CliRunner().invoke(app, ["info", str(path)])


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
    result = status(store)
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1


def test_a_store_opened_twice_is_not_taken_for_the_same_by_dask(store):
    first, second = (read_stack(store)["potential"].data.name for _ in range(2))
    assert first != second


def test_warnings_of_a_file_are_in_its_shots_report(night, tmp_path):
    colours = np.stack([night.images[0] * share for share in (1, 2, 3)], axis=-1)
    tifffile.imwrite(tmp_path / "film.tif", colours.astype(np.uint16), photometric="rgb")
    shape = "{} {}".format("{}", night.source.shape)
    header = "\n".join(shape.format(name) for name in ("flux2D", "flux2D_ref"))
    np.savetxt(tmp_path / "input.txt", np.vstack([night.images[0]] * 2), header=header)
    arguments = [str(tmp_path / name) for name in ("film.tif", "input.txt")]
    out = str(tmp_path / "a.shadowinv.zarr")
    chosen = ["--channel", "red", "--set=options.n_sites=100", "--out", out]
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
    out = ["--set=options.n_sites=100", "--scheduler", "threads", "--out", "a.shadowinv.zarr"]
    assert runner.invoke(app, ["batch", *names, "bad\x1b[31m[oh].npy", *out]).exit_code == 1
    for more in ([], ["--all"]):
        result = runner.invoke(app, ["info", "a.shadowinv.zarr", *more], env={"COLUMNS": "300"})
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
