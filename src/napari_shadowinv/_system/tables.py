"""Tables as comma-separated values, with the lines of their rows for messages.

- the cells of a table: `read_table`; its rows as models: `read_rows`; to a file: `write_cells`

The cells are the standard library's: pandas does not know the lines of its rows. Semicolons and
tabs separate cells, too. Empty lines and lines that begin with ``#`` are skipped.
Capitals in column names do not matter.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from napari_shadowinv._system.safety import as_file_errors, small_text
from napari_shadowinv._system.validation import Model, map_paths, suggestion, validate
from napari_shadowinv.errors import FileFormatError, InputError

_SEPARATORS = ";\t,"
_EXPECTED = "a table as comma-separated values"


class Table(NamedTuple):
    """Cells of a table."""

    path: Path
    header: list[str]  # column names in lower case
    rows: dict[int, list[str]]  # by line in the file, each with as many cells as there are columns

    def position_of(self, column: str) -> int:
        """Return the position of a column that occurs once, or raise an `InputError`."""
        if column not in self.header:
            raise InputError(
                f"{self.path} has no column '{column}', but {', '.join(self.header) or 'none'}: "
                "the first line must name the columns"
            )
        if self.header.count(column) > 1:
            raise InputError(f"{self.path} has the column '{column}' twice: expected it once")
        return self.header.index(column)


@as_file_errors
def read_table(path: Path) -> Table:
    """Read a table; an `InputError` names the line with more cells than there are columns."""
    records = _records(path, small_text(path, _EXPECTED))
    _, names = next(records, (0, []))
    header = [name.lower() for name in _without_empty_end(names)]
    rows = {}
    for line, cells in records:
        if len(_without_empty_end(cells)) > len(header):
            raise InputError(
                f"{path}, line {line} has {len(cells)} values, expected {len(header)}: "
                f"{', '.join(header)}"
            )
        rows[line] = [*cells, *[""] * len(header)][: len(header)]
    if header and not rows:
        raise InputError(f"{path} has no rows below its column names: expected at least one")
    return Table(path, header, rows)


def read_rows(
    path: Path,
    model: type[Model],
    *,
    columns: Collection[str] = (),
    shared: Mapping[str, Any] = MappingProxyType({}),
) -> dict[int, Model]:
    """Return the rows of a table as models, by their lines in the file.

    Empty cells stand for the values `shared` by all rows, or the model's defaults; file names are
    relative to the folder of the table. Names of `columns` are by default those of the model's
    fields. An `InputError` names an unknown, missing or repeated column, and the line of an invalid
    row.
    """
    table = read_table(path)
    known = {name.lower(): name for name in columns or model.model_fields}
    for name in table.header:
        if name not in known:
            raise InputError(f"{path} has a column '{name}': {suggestion(name, known.values())}")
    required = [name.lower() for name, field in model.model_fields.items() if field.is_required()]
    for name in (*required, *table.header):
        table.position_of(name)
    models = {}
    for line, cells in table.rows.items():
        entries = {
            known[name]: cell for name, cell in zip(table.header, cells, strict=True) if cell
        }
        row = validate(model, {**shared, **entries}, f"{path}, line {line}")
        kept = {name: getattr(row, name) for name in shared.keys() - entries.keys()}
        models[line] = map_paths(row, path.parent.joinpath).model_copy(update=kept)
    return models


def write_cells(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, object]]) -> None:
    """Write a table from the cells of its rows by column; missing ones are empty."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _records(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the line and the cells of each row that is not empty."""
    lines = ["\n" if _is_comment(line) else line for line in io.StringIO(text, newline=None)]
    header = next((line for line in lines if line.strip(f" {_SEPARATORS}\n")), "")
    separator = max(_SEPARATORS, key=header.count)
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True, strict=True)
    line = 1
    try:
        for row in reader:
            cells = [cell.strip() for cell in row]
            if any(cells):
                yield line, cells
            line = reader.line_num + 1
    except csv.Error as error:
        raise FileFormatError(
            f"{path}, line {line} cannot be read ({error}): expected {_EXPECTED}, with quotes in "
            "pairs; correct it"
        ) from None


def _is_comment(line: str) -> bool:
    # A lone # is the name of a column of numbers.
    text = line.lstrip()
    return text.startswith("#") and text[1:2] not in {*_SEPARATORS}


def _without_empty_end(cells: list[str]) -> list[str]:
    return cells[: max((k for k, cell in enumerate(cells, 1) if cell), default=0)]
