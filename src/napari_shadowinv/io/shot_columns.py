"""Columns of a shot table, such as energies, delays and remarks, by the numbers of the shots.

- read a table, as comma-separated values or from HDF5: `read_shot_table`; it is a `ShotTable`
- its row for each shot of a stack, by the numbers in the shots' names: `ShotTable.rows_of`
- the columns of a table that a store has: `joined_columns`
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.safety import as_file_errors, check_regular, check_size
from napari_shadowinv._system.tables import is_number, read_table
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.io.files import split_address
from napari_shadowinv.io.hdf5 import load_dataset, member, members, open_hdf5
from napari_shadowinv.io.store_columns import Column

JOINED = "shot_table"  # attribute of a store: the columns that it has of a shot table (JSON)
PREFIX = "table."  # of the entries of these columns in the reports of shots
_NUMBER_COLUMNS = ("shot_number", "shot", "number")  # the first that a table has
_NUMBER_KEY = "shot_number"
_NAME_AND_UNIT = re.compile(r"(?P<name>.*?)\s*[(\[](?P<unit>[^()\[\]]*)[)\]]")
_FILE_ENDING = re.compile(r"\.[A-Za-z]\w*(?=\[|$)")
_KINDS = {kind.__name__: kind for kind in (str, int, float)}
_FORMATS = {str: "s", int: "d", float: ".10g"}
_MAX_LISTED = 5
_MAX_EXACT = 2**53  # whole numbers that a float represents


@dataclass(frozen=True)
class ShotTable:
    """Columns of a shot table."""

    path: Path
    columns: tuple[Column, ...]  # the number of the shot first
    # Values by the columns' entries in a report, by the shot's number; without empty cells.
    rows: Mapping[int, Mapping[str, Any]]

    def rows_of(self, names: Sequence[str]) -> list[Mapping[str, Any]]:
        """Return the row of each shot by the number in its name.

        Raises
        ------
        InputError
            If the names have no number that identifies a shot, or the table lacks a shot.
        """
        numbers = self._numbers_in(names)
        shots = zip(numbers, names, strict=True)
        missing = [f"{number} ({name})" for number, name in shots if number not in self.rows]
        if missing:
            more = f" and {len(missing) - _MAX_LISTED} more" if len(missing) > _MAX_LISTED else ""
            raise InputError(
                f"{self.path} has no row for {'shots' if len(missing) > 1 else 'shot'} "
                f"{', '.join(missing[:_MAX_LISTED])}{more}: add it, its cells may be empty"
            )
        return [self.rows[number] for number in numbers]

    def _numbers_in(self, names: Sequence[str]) -> Sequence[int]:
        """Return the number in each name that differs from name to name."""
        parts = [list(map(int, re.findall(r"\d+", _FILE_ENDING.sub("", name)))) for name in names]
        count = min(map(len, parts))
        is_regular = all(len(numbers) == count for numbers in parts)
        places = range(count) if is_regular else {0, -1} if count else ()
        series = [tuple(numbers[place] for numbers in parts) for place in places]
        distinct = [numbers for numbers in series if len(set(numbers)) == len(names)]
        listed = [numbers for numbers in distinct if all(n in self.rows for n in numbers)]
        candidates = listed or distinct
        if len(candidates) != 1:
            reason = "several numbers that differ" if candidates else "no number that differs"
            raise InputError(
                f"the names of the shots, such as {names[-1]}, have {reason} from shot to shot: "
                f"expected one, by which {self.path} is joined; rename the files"
            )
        return candidates[0]


def joined_columns(attributes: Mapping[Any, Any]) -> tuple[Column, ...]:
    """Return the columns of a shot table that a store has, by its attributes."""
    return tuple(
        _column(each["key"], each["title"], each["unit"], _KINDS[each["kind"]])
        for each in json.loads(attributes.get(JOINED, "[]"))
    )


def describe_columns(columns: Iterable[Column]) -> str:
    """Return columns of a shot table as an attribute of a store."""
    entries = [
        {"key": c.key, "title": c.long_name, "unit": c.unit, "kind": c.kind.__name__}
        for c in columns
    ]
    return json.dumps(entries, ensure_ascii=False)


def _column(key: str, title: str, unit: str, kind: type) -> Column:
    return Column(
        key,
        title,
        title=title if unit == "1" else f"{title} ({unit})",
        unit=unit,
        kind=kind,
        format=_FORMATS[kind],
        entry=f"{PREFIX}{key}",
    )


def read_shot_table(path: str | Path) -> ShotTable:
    """Read a table whose rows belong to shots by their numbers.

    Parameters
    ----------
    path : str or Path
        Comma-separated values with column names in the first line, or HDF5: a compound dataset, or
        a group of datasets of one length, as ``file.h5::/entry/shots``.

    Returns
    -------
    ShotTable

    Raises
    ------
    FileFormatError
        If the file cannot be read as a table.
    InputError
        If no column has the numbers of the shots, a number is no whole one or occurs twice, or two
        columns have one name.
    """
    import h5py

    file, name = split_address(path)
    if name is None:
        check_regular(file, "a table of shots")
    if name is not None or h5py.is_hdf5(file):
        titles, cells = _read_hdf5_columns(file, name or "/")
        lines = {f"row {row}": texts for row, texts in enumerate(cells)}
    else:
        table = read_table(file)
        titles = table.titles
        lines = {f"line {line}": texts for line, texts in table.rows.items()}
    return _table_of(Path(path), titles, lines)


def _table_of(path: Path, titles: Sequence[str], lines: Mapping[str, list[str]]) -> ShotTable:
    names, units = zip(*map(_name_and_unit, titles), strict=True) if titles else ((), ())
    keys = [re.sub(r"\W+", "_", name.lower()).strip("_") for name in names]
    number_key = next((key for key in _NUMBER_COLUMNS if key in keys), None)
    if number_key is None:
        raise InputError(
            f"{path} has no column 'shot' or 'number' with the numbers of the shots, but "
            f"{', '.join(titles) or 'none'}: rename the column that has them"
        )
    for key, count in Counter(keys).items():
        if count > 1 and key:
            raise InputError(f"{path} has the column '{key}' twice: expected it once; rename one")
    place = keys.index(number_key)
    number_column = _column(_NUMBER_KEY, "shot number", "1", int)
    columns: dict[int, Column] = {}  # by their positions
    for position, key in enumerate(keys):
        if key and position != place:
            filled = [cells[position] for cells in lines.values() if cells[position]]
            kind = float if filled and all(map(is_number, filled)) else str
            columns[position] = _column(key, names[position], units[position] or "1", kind)
    rows: dict[int, dict[str, Any]] = {}
    origins: dict[int, str] = {}
    for line, cells in lines.items():
        number = _shot_number(path, line, cells[place])
        if number in rows:
            raise InputError(
                f"{path} has shot {number} twice, in {origins[number]} and {line}: expected each "
                "shot once; remove a row"
            )
        origins[number] = line
        rows[number] = {number_column.entry: number} | {
            column.entry: column.kind(cells[position])
            for position, column in columns.items()
            if cells[position]
        }
    return ShotTable(path, (number_column, *columns.values()), rows)


def _name_and_unit(title: str) -> tuple[str, str]:
    match = _NAME_AND_UNIT.fullmatch(title.strip())
    return (match["name"], match["unit"].strip()) if match else (title.strip(), "")


def _shot_number(path: Path, line: str, text: str) -> int:
    number = float(text) if is_number(text) else math.nan
    if not number.is_integer() or not 0 <= number < _MAX_EXACT:
        received = f"the shot number '{text}'" if text else "no shot number"
        raise InputError(f"{path}, {line} has {received}: expected a whole number")
    return int(number)


@as_file_errors
def _read_hdf5_columns(path: Path, name: str) -> tuple[list[str], Iterator[list[str]]]:
    """Return the titles and the rows of cells of a compound dataset or a group of columns."""
    import h5py

    with open_hdf5(path) as file:
        item = member(path, file, name)
        columns: dict[str, list[str]] = {}
        if isinstance(item, h5py.Dataset) and item.dtype.names and item.ndim == 1:
            values = load_dataset(path, item)
            columns = {field: _texts(values[field]) for field in item.dtype.names}
        elif isinstance(item, h5py.Group):
            for key, column in members(item):
                if isinstance(column, h5py.Dataset) and column.ndim == 1:
                    columns[_title(key, column)] = _texts(load_dataset(path, column))
    if not columns:
        raise FileFormatError(
            f"{path} has no table {name!r}: expected a compound dataset, or a group of columns; "
            "name it, such as shots.h5::/entry/shots"
        )
    lengths = {len(column) for column in columns.values()}
    if len(lengths) > 1:
        raise FileFormatError(
            f"{path} has columns of {', '.join(map(str, sorted(lengths)))} rows in {name!r}: "
            "expected one length for all; name the group of the table alone"
        )
    check_size(path, 64 * len(columns) * max(lengths))
    return list(columns), map(list, zip(*columns.values(), strict=True))


def _title(key: str, column: Any) -> str:
    unit = column.attrs.get("units", "")
    unit = unit.decode(errors="replace") if isinstance(unit, bytes) else unit
    return f"{key} ({unit})" if isinstance(unit, str) and unit else key


def _texts(values: Any) -> list[str]:
    """Return the values of a column as the cells of a table, empty for NaN."""
    return ["" if value != value else _text(value) for value in np.asarray(values).tolist()]


def _text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
