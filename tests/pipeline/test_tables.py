"""All tables are read alike: line numbers, separators, comments and mistakes."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.film import Calibration, read_corners
from napari_shadowinv.pipeline import read_pack
from napari_shadowinv.pipeline._film import read_fiducials
from napari_shadowinv.pipeline.shot_table import fiducials_from, table_rows


class Kind(NamedTuple):
    """A kind of table: its columns, two rows, and a function that reads it."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    read: Callable[[Path], Any]

    def lines(self, separator: str = ",") -> list[str]:
        return [separator.join(cells) for cells in (self.columns, *self.rows)]


def layers_of(path: Path) -> Any:
    pack = path.with_name("pack.toml")
    pack.write_text(f'layers = "{path.name}"\n')
    return read_pack(pack).layers


def marks_of(path: Path) -> Any:
    return read_fiducials(path, 3)


def calibration_of(path: Path) -> Any:
    calibration = Calibration.from_csv(path)
    return calibration.doses.tolist(), calibration.pixels.tolist()


def corners_of(path: Path) -> Any:
    return {name: corners.tolist() for name, corners in read_corners(path).items()}


KINDS = {
    "calibration": Kind(
        ("dose", "red", "green", "blue"),
        (("1", "40000", "41000", "30000"), ("10", "30000", "36000", "29000")),
        calibration_of,
    ),
    "corners": Kind(
        ("film", "y1", "x1", "y2", "x2", "y3", "x3", "y4", "x4"),
        (("1", *"00055550"), ("2", *"00077770")),
        corners_of,
    ),
    "fiducials of a pack": Kind(
        ("film", "name", "y", "x"), (("1", "left", "3", "4"), ("2", "left", "3", "5")), marks_of
    ),
    "fiducials of a fit": Kind(
        ("y", "x", "dy", "dx", "sigma"),
        (("3", "4", "0.5", "0", "1"), ("5", "4", "0.2", "0", "1")),
        fiducials_from,
    ),
    "layers": Kind(
        ("film", "filters", "turned"), (("HDV2", "13 um Al", "180"), ("EBT3", "", "0")), layers_of
    ),
    "shots": Kind(
        ("file", "energy", "psf"), (("a.tif", "14.7", "1"), ("b.tif", "3", "1")), table_rows
    ),
}
# A cell that each kind refuses: its column and the wrong text.
WRONG = {
    "calibration": ("red", "many"),
    "corners": ("x2", "wide"),
    "fiducials of a pack": ("y", "low"),
    "fiducials of a fit": ("sigma", "-1"),
    "layers": ("turned", "90"),
    "shots": ("psf", "wide"),
}


@pytest.fixture(params=KINDS)
def name(request: Any) -> str:
    return str(request.param)


@pytest.fixture
def kind(name: str) -> Kind:
    return KINDS[name]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "table.csv"


def write(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def refuses(kind: Kind, path: Path, *words: str) -> None:
    with pytest.raises((InputError, FileFormatError), match=re.escape(str(path))) as caught:
        kind.read(path)
    for word in words:
        assert word in str(caught.value)


def test_empty_lines_and_comments_count_as_lines(name: str, kind: Kind, path: Path) -> None:
    header, first, last = kind.lines()
    column, text = WRONG[name]
    cells = list(kind.rows[1])
    cells[kind.columns.index(column)] = text
    write(path, ["# a night in May", header, "", first, "  ", "# by hand", ",,", ",".join(cells)])
    refuses(kind, path, "table.csv, line 8", text)
    write(path, ["# a night in May", header, "", first, "  ", "# by hand", ",,", last])
    kind.read(path)


@pytest.mark.parametrize("separator", [";", "\t", " , ", '","'])
def test_separators_capitals_and_byte_order_mark_change_nothing(
    kind: Kind, path: Path, separator: str
) -> None:
    write(path, kind.lines())
    plain = kind.read(path)
    lines = kind.lines(separator)
    if '"' in separator:
        lines = [f'"{line}"' for line in lines]
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    assert kind.read(path) == plain
    write(path, [lines[0].upper(), *lines[1:]])
    assert kind.read(path) == plain


def test_columns_that_do_not_fit_are_named(kind: Kind, path: Path) -> None:
    first, count, (header, *rows) = kind.columns[0], len(kind.columns), kind.lines()
    without_first = [",".join(cells[1:]) for cells in (kind.columns, *kind.rows)]
    for lines, words in (
        (without_first, f"has no column '{first}'"),
        (["", "# nothing"], f"has no column '{first}'"),
        ([f"{line},{line.split(',')[0]}" for line in (header, *rows)], f"column '{first}' twice"),
        ([header], "has no rows below its column names"),
        (
            [header, rows[0], "", f"{rows[1]},,7"],
            f"line 4 has {count + 2} values, expected {count}: {first}, ",
        ),
    ):
        write(path, lines)
        refuses(kind, path, words)
    write(path, [f"{line},," for line in kind.lines()])
    kind.read(path)


@pytest.mark.parametrize(
    ("cell", "reason"),
    [("a" * 140_000, "field larger than field limit"), ('"left', "unexpected end of data")],
    ids=["too long", "open quote"],
)
def test_cell_that_cannot_be_read_is_refused(
    kind: Kind, path: Path, cell: str, reason: str
) -> None:
    header, first, last = kind.lines()
    write(path, [header, "", ",".join([cell, *first.split(",")[1:]]), last])
    with pytest.raises(FileFormatError, match="line 3 cannot be read"):
        kind.read(path)
    refuses(kind, path, reason)


def test_a_calibration_may_have_a_column_of_film_numbers(path: Path) -> None:
    write(path, ["#,Dose,Red,Green,Blue", ",Gy,,,", "1,1,5,5,5", "2,3,4,4,4"])
    np.testing.assert_array_equal(Calibration.from_csv(path).doses, [1, 3])
