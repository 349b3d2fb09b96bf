"""A column is one entry of a table: store, status, export and window list it."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from helpers.command_line import done
from napari_shadowinv._napari.result_files import shot_rows
from napari_shadowinv.io import store_columns
from napari_shadowinv.io.store import StackStore
from napari_shadowinv.io.store_columns import (
    COLUMNS,
    ShotColumn,
    columns_of,
)


@pytest.fixture
def site_column(monkeypatch) -> ShotColumn:
    column = ShotColumn(
        "site_count",
        "Number of sites",
        title="places",
        kind=int,
        value=lambda inversion: len(inversion.cells.sites),
        show="{:04d}".format,
    )
    monkeypatch.setattr(store_columns, "COLUMNS", (*COLUMNS, column))
    return column


def test_added_column_is_read_and_listed_everywhere(
    site_column, make_night, out, tmp_path, monkeypatch
):
    monkeypatch.setenv("COLUMNS", "200")  # so that no heading is folded
    night = make_night(2)
    np.save(night.path(1), 0 * night.images[1])
    written = night.run(out, scheduler="synchronous")
    assert written.site_count.values.tolist() == [100, 0]
    assert written.site_count.attrs["long_name"] == "Number of sites"
    assert StackStore(out).columns[-1] is site_column

    table = tmp_path / "t.csv"
    done("export", out, "--format", "csv", "--out", table)
    with table.open(newline="", encoding="utf-8") as f:
        assert [row["site_count"] for row in csv.DictReader(f)] == ["100", ""]

    assert ("Places", "0100") in shot_rows(out, 0)
    assert shot_rows(out, 1)[0] == ("Shot", "1 (shot_1.npy)")
    assert "Places" not in dict(shot_rows(out, 1))


@pytest.mark.parametrize("own_setups", [None, "proton", "optical"])
def test_keys_and_titles_of_a_store_are_unique(own_setups):
    columns = columns_of(own_setups)
    assert len({column.key for column in columns}) == len(columns)
    assert len({column.title for column in columns}) == len(columns)


def test_value_without_entry_is_the_fill_value():
    values = {column.kind: column.values([{}])[0] for column in COLUMNS}
    assert (values[str], values[bool], values[int]) == ("", 0, 0)
    assert np.isnan(values[float])
    assert COLUMNS[0].text({}) == ""
