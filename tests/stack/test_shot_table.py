"""A shot table joins a store by the numbers in the names of shots."""

from __future__ import annotations

import csv
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.command_line import flat, shadowinv
from napari_shadowinv import FileFormatError, InputError, read
from napari_shadowinv._napari.stores import shot_rows
from napari_shadowinv.io.shot_columns import read_shot_table
from napari_shadowinv.io.store import DONE, FAILED, StackStore
from napari_shadowinv.io.store_damage import Status

TABLE = """Shot; Energy (J); Delay [ns]; Remarks
# of the day
2; 12.5; 3; =good
0; 11; ; misfire
1; 12.25; 2.5; "two; words"
9; 1; 1; not here
"""
EXPECTED = {
    "shot_number": [0, 1, 2],
    "energy": [11, 12.25, 12.5],
    "delay": [np.nan, 2.5, 3],
    "remarks": ["misfire", "two; words", "=good"],
}


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "day.csv"
    path.write_text(TABLE)
    return path


def check_columns(stored, shots: slice = slice(None)) -> None:
    for name, values in EXPECTED.items():
        np.testing.assert_array_equal(stored[name].values[shots], values[shots], err_msg=name)
    assert (stored.energy.attrs["units"], stored.delay.attrs["units"]) == ("J", "ns")


def as_columns(path: Path) -> str:
    with h5py.File(path, "w") as file:
        group = file.create_group("entry/shots")
        group["number"] = [0, 1, 2, 9]
        group["energy"], group["delay"] = [11, 12.25, 12.5, 1], [np.nan, 2.5, 3, 1]
        group["energy"].attrs["units"], group["delay"].attrs["units"] = "J", np.bytes_("ns")
        group["remarks"] = ["misfire", "two; words", "=good", ""]
        group["image"] = np.ones((4, 4))
    return f"{path}::/entry/shots"


def as_compound(path: Path) -> Path:
    names = ["number", "energy (J)", "delay (ns)", "remarks"]
    formats = ["i4", "f8", "f4", h5py.string_dtype()]
    rows = [(0, 11, np.nan, "misfire"), (1, 12.25, 2.5, "two; words"), (2, 12.5, 3, "=good")]
    with h5py.File(path, "w") as file:
        kind = np.dtype({"names": names, "formats": formats})
        file["shots"] = np.array(rows, kind)
    return f"{path}::shots"


@pytest.mark.parametrize("write", [None, as_columns, as_compound])
def test_columns_are_stored_with_their_units(write, table, make_night, out, tmp_path):
    night = make_night(3)
    np.save(night.path(1), 0 * night.images[1])  # fails, and has a row nevertheless
    stored = night.run(out, shot_table=table if write is None else write(tmp_path / "day.h5"))
    assert list(stored.status.values) == [DONE, FAILED, DONE]
    check_columns(stored)
    assert not StackStore(out, every_byte=True).damage.files


def test_status_export_and_window_list_the_columns(table, make_night, out, tmp_path):
    make_night(3).run(out, shot_table=table)
    listed = flat(shadowinv("status", out, "--all").output)
    assert "shot table shot number, Energy (J), Delay (ns), Remarks" in listed
    assert "two; words" in listed
    shadowinv("export", out, "--format", "csv", "--out", tmp_path / "t.csv")
    with (tmp_path / "t.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["energy (J)"] for row in rows] == ["11.0", "12.25", "12.5"]
    assert [row["delay (ns)"] for row in rows] == ["", "2.5", "3.0"]
    assert rows[2]["remarks"] == "'=good"  # no formula
    assert ("Energy (j)", "12.25") in shot_rows(out, 1)


def test_resumed_run_joins_a_table_and_its_corrections(table, make_night, out):
    night = make_night(3)
    night.path(2).rename(night.folder / "later.npy")
    night.run(out)
    (night.folder / "later.npy").rename(night.path(2))
    check_columns(night.run(out, shot_table=table))
    potential = read(out).potential.values
    table.write_text(TABLE.replace("misfire", "corrected").replace("Remarks", "Remarks; Film"))
    corrected = night.run(out, shot_table=table)
    assert list(corrected.remarks.values[:2]) == ["corrected", "two; words"]
    assert list(corrected.film.values) == [""] * 3
    np.testing.assert_array_equal(corrected.potential, potential)
    assert not StackStore(out, every_byte=True).damage.files
    assert len(night.run(out)) == len(corrected)  # without the table it stays


def test_columns_keep_their_units(table, make_night, out):
    night = make_night(3)
    night.run(out, shot_table=table)
    table.write_text(TABLE.replace("Energy (J)", "Energy (mJ)"))
    reason = "has 'energy' as numbers in mJ, and .* as numbers in J: correct the table"
    with pytest.raises(InputError, match=reason):
        night.run(out, shot_table=table)
    check_columns(read(out))


def test_a_table_joins_though_a_run_was_killed_meanwhile(table, make_night, out, monkeypatch):
    from napari_shadowinv.io import store_writing

    night = make_night(3)
    night.run(out)

    def killed(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(store_writing, "replacing", killed)
        with pytest.raises(KeyboardInterrupt):
            night.run(out, shot_table=table)
    assert "energy" not in read(out)
    assert Status.DAMAGED not in StackStore(out, every_byte=True).statuses()
    check_columns(night.run(out, shot_table=table))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("energy\n3\n", "has no column 'shot' or 'number' with the numbers of the shots"),
        ("shot,energy\n0,1\n1,2\n0,3\n", "has shot 0 twice, in line 2 and line 4"),
        ("shot\n0\n1\n", "has no row for shot 2 (shot_2.npy): add it"),
        ("shot,energy\n0,1\nA1,2\n2,3\n", "line 3 has the shot number 'A1': expected a whole"),
        ("shot,energy\n0,1\n,2\n2,3\n", "line 3 has no shot number: expected a whole number"),
        ("shot,energy,Energy (J)\n0,1,1\n", "has the column 'energy' twice"),
        ("shot,status\n0,1\n1,1\n2,1\n", "has the column 'status', a name that the store uses"),
        ("", "has no column 'shot' or 'number' with the numbers of the shots, but none"),
        (b"\x89PNG\r\n\x1a\n\x00", "is not a text file: expected a table"),
        (None, "does not exist: expected a table of shots"),
    ],
)  # fmt: skip
def test_wrong_table_is_one_sentence_and_no_store(text, words, make_night, out, tmp_path):
    night, path = make_night(3), tmp_path / "wrong.csv"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    result = shadowinv("batch", night.glob, "--out", out, "--shot-table", path)
    assert result.exit_code == 2
    assert words in flat(result.output)
    assert not out.exists()


def test_wrong_hdf5_table_is_refused(tmp_path):
    address = as_columns(tmp_path / "day.h5")
    with pytest.raises(FileFormatError, match="no table '/entry/none': expected a compound"):
        read_shot_table(f"{tmp_path / 'day.h5'}::/entry/none")
    with h5py.File(tmp_path / "day.h5", "r+") as file:
        file["entry/shots/pressure"] = [1.0, 2.0]
    with pytest.raises(FileFormatError, match="columns of 2, 4 rows in '/entry/shots'"):
        read_shot_table(address)


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (["a_007.tif", "a_012.tif"], [7, 12]),
        (["2024_7_cam2.b16", "2024_12_cam2.b16"], [7, 12]),
        (["run.h5[7]", "run.h5[12]"], [7, 12]),
        (["20240513_7.tif", "20240514_12.tif"], [7, 12]),  # dates are not in the table
        (["shot 7 (1)", "shot 12"], [7, 12]),
        (["7", "12"], [7, 12]),
        (["a_7.tif"], [7]),
    ],
)
def test_number_of_a_shot_is_that_which_differs(names, numbers, tmp_path):
    (tmp_path / "t.csv").write_text("number\n7\n12\n")
    rows = read_shot_table(tmp_path / "t.csv").rows_of(names)
    assert [row["table.shot_number"] for row in rows] == numbers


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["first.tif", "second.tif"], "have no number that differs from shot to shot"),
        (["a_7.tif", "b_7.tif"], "such as b_7.tif, have no number that differs"),
        (["a_7_12.tif", "a_12_7.tif"], "have several numbers that differ"),
    ],
)
def test_names_without_a_clear_number_are_refused(names, words, tmp_path):
    (tmp_path / "t.csv").write_text("number\n7\n12\n")
    with pytest.raises(InputError, match=words):
        read_shot_table(tmp_path / "t.csv").rows_of(names)
