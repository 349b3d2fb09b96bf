"""What is told about each image and each fiducial: rows of a table, or flags.

- one image: `ShotRow`; those of a fit: `shot_rows`, or `rows_by_shot` for a table of many shots
- the images of a table that are inverted one by one: `rows_to_invert`
- whether a file is such a table: `is_table`; all its rows: `table_rows`; write one: `write_table`
- known displacements: `fiducials_from`
"""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

from napari_shadowinv._system.safety import check_regular, small_text
from napari_shadowinv._system.validation import CheckedModel, nearest, validated
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import replacing, text_of
from napari_shadowinv.io.formats import SITES
from napari_shadowinv.options import MAX_STRENGTH, Noise

__all__ = [
    "ShotRow",
    "fiducials_from",
    "is_table",
    "rows_by_shot",
    "rows_of",
    "rows_to_invert",
    "shot_rows",
    "table_rows",
    "write_table",
]

_EXPECTED = "a table as comma-separated values"
_LONGEST_HEADER = 100_000  # bytes
_CONFIG = ConfigDict(frozen=True, extra="forbid")


def _strength(value: Any) -> Any:
    parts = str(value).split()
    if not parts or not all(map(_is_number, parts)):
        raise ValueError("expected a number, or one for each field with spaces between them")
    strengths = tuple(map(float, parts))
    if not all(abs(strength) <= MAX_STRENGTH for strength in strengths):
        raise ValueError(f"expected a displacement of at most {MAX_STRENGTH:g} times the first")
    return strengths


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


class ShotRow(CheckedModel):
    """One image, and what is known about it."""

    model_config = _CONFIG
    file: Path = Field(title="Image", description="Its file.")
    setup: Path | None = Field(
        default=None, title="Setup", description="TOML file with the experimental geometry."
    )
    energy: float | None = Field(
        default=None,
        gt=0,
        le=1e5,
        title="Energy",
        description="Energy in MeV, in place of the setup's.",
    )
    strength: Annotated[tuple[float, ...], BeforeValidator(_strength)] | None = Field(
        default=None,
        title="Strength",
        description="Displacement relative to the first image; with two fields '1 0.6'.",
    )
    gain: float | None = Field(
        default=None,
        gt=0,
        title="Gain",
        description="How many times brighter than the source the image is.",
    )
    psf: float | None = Field(
        default=None,
        ge=0,
        title="Point spread",
        description="Standard deviation in px, after --bin.",
    )
    mask: Path | None = Field(
        default=None, title="Mask", description="Image of the same size, 0 at unusable pixels."
    )
    source: Literal["unknown"] | Path | None = Field(
        default=None,
        title="Source",
        description="Image of the undisturbed beam, or unknown to fit a smooth one.",
    )
    noise: Noise | None = Field(
        default=None,
        title="Noise",
        description="poisson for counts, proportional for a share of each pixel, or the standard "
        "deviation in a pixel, after --bin.",
    )
    shot: str | None = Field(
        default=None,
        title="Shot",
        description="In a table of many shots that are fitted: which of them the image belongs to.",
    )
    exclude: bool = Field(
        default=False, title="Exclude", description="true, yes or 1 to leave the image out."
    )

    @property
    def source_file(self) -> Path | None:
        """The file of its source, if there is one."""
        return self.source if isinstance(self.source, Path) else None

    @property
    def files(self) -> dict[str, Path]:
        """What is read for it, by the names of the columns."""
        known = {"file": self.file, "setup": self.setup, "mask": self.mask}
        found = {**known, "source": self.source_file}
        return {name: path for name, path in found.items() if path is not None}

    @property
    def described(self) -> dict[str, Any]:
        """What it says, without folders, which may be moved."""
        said = self.model_dump(mode="json", exclude_none=True, exclude={"exclude"})
        return {**said, **{name: text_of(path.name) for name, path in self.files.items()}}


_FILES = ("file", "setup", "mask", "source")
_FOR_FITS = ("strength", "psf", "noise")


class _Fiducial(CheckedModel):
    model_config = _CONFIG
    y: float
    x: float
    dy: float
    dx: float
    sigma: float = Field(gt=0, title="Standard deviation")


def shot_rows(
    images: Sequence[Path], shared: Mapping[str, Any], lists: Mapping[str, str | None]
) -> list[ShotRow]:
    """Describe the images of a fit.

    Parameters
    ----------
    images : sequence of Path
        Images, or one table with a row for each.
    shared : mapping
        What holds for all images that do not say otherwise, by the names of the columns.
    lists : mapping of str to str
        Numbers separated by commas, one for each image, by the names of the columns.
    """
    given = {name: text for name, text in lists.items() if text is not None}
    if len(images) == 1 and is_table(images[0]):
        for name in given:
            raise InputError(
                f"received a list for each image, {given[name]}, beside the table {images[0]}: "
                f"write it into its column '{name}'"
            )
        rows = list(_used_rows(images[0], shared).values())
        if len({row.shot for row in rows}) > 1:
            raise InputError(
                f"{images[0]} has the images of several shots, expected one object: fit each with "
                "shadowinv batch --fit"
            )
        return rows
    columns = {name: [part.strip() for part in text.split(",")] for name, text in given.items()}
    for name, parts in columns.items():
        if len(parts) != len(images):
            raise InputError(
                f"received {len(images)} images and {len(parts)} values of {name} "
                f"({given[name]}): expected one for each image, separated by commas"
            )
    return [
        validated(
            ShotRow,
            _known({"file": image, **shared, **{name: columns[name][k] for name in columns}}),
            str(image),
        )
        for k, image in enumerate(images)
    ]


def rows_by_shot(table: Path, shared: Mapping[str, Any]) -> dict[str, tuple[ShotRow, ...]]:
    """Rows of a table with the images of many shots, by the names of the shots, in their order."""
    found: dict[str, tuple[ShotRow, ...]] = {}
    for number, row in _used_rows(table, shared).items():
        if row.shot is None:
            raise InputError(
                f"{table}, row {number} does not say which shot its image belongs to: give the "
                "column 'shot', the same for all images of one object"
            )
        found[row.shot] = (*found.get(row.shot, ()), row)
    return found


def rows_to_invert(table: Path | Sequence[ShotRow]) -> tuple[list[ShotRow], tuple[str, ...]]:
    """Rows, or those of a table, whose images are inverted one by one; columns only for fits."""
    rows = _used_rows(table, {})
    for number, row in rows.items():
        if row.source == "unknown":
            raise InputError(
                f"{_name_of(table)}, row {number} has the source 'unknown', which only a fit can "
                "find: name an image, or leave the cell empty"
            )
    used = list(rows.values())
    given = (name for name in _FOR_FITS if any(getattr(row, name) is not None for row in used))
    return used, tuple(given)


def table_rows(table: Path) -> list[ShotRow]:
    """All rows of a table of shots, those that are excluded among them."""
    return rows_of(table, ShotRow)


def write_table(path: Path, rows: Sequence[ShotRow]) -> None:
    """Write a table of shots, in place of one that is there; files relative to its folder."""
    folder = path.parent.absolute()
    told = [row.model_dump(mode="json", exclude_none=True, exclude_defaults=True) for row in rows]
    for cells, row in zip(told, rows, strict=True):
        files = row.files.items()
        cells |= {name: os.path.relpath(file.absolute(), folder) for name, file in files}
        if row.strength is not None:
            cells["strength"] = " ".join(f"{one:.17g}" for one in row.strength)
        if row.exclude:
            cells["exclude"] = "yes"
    columns = [name for name in ShotRow.model_fields if any(name in cells for cells in told)]
    with (
        replacing(path, overwrite=True) as draft,
        Path(draft).open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(told)


def _used_rows(table: Path | Sequence[ShotRow], shared: Mapping[str, Any]) -> dict[int, ShotRow]:
    """The rows that are not excluded, by number."""
    rows = rows_of(table, ShotRow, shared) if isinstance(table, Path) else table
    used = {number: row for number, row in enumerate(rows, 1) if not row.exclude}
    if not used:
        raise InputError(
            f"{_name_of(table)} excludes all of its {len(rows)} images: empty the column 'exclude' "
            "in the rows to use"
        )
    return used


def _name_of(table: Path | Sequence[ShotRow]) -> str:
    return str(table) if isinstance(table, Path) else "the table"


def fiducials_from(path: Path) -> list[tuple[float, ...]]:
    """Known displacements from a table: rows of y, x, dy, dx and their σ, in px."""
    return [(one.y, one.x, one.dy, one.dx, one.sigma) for one in rows_of(path, _Fiducial)]


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def is_table(path: Path) -> bool:
    """Tell whether a file is a table with names of columns, and no image as numbers."""
    if path.suffix.lower() not in SITES.suffixes:
        return False
    check_regular(path, _EXPECTED)
    with path.open("rb") as file:  # an image may be large
        head = file.read(_LONGEST_HEADER).decode("utf-8-sig", errors="replace")
    lines = _filled(head)
    return bool(lines) and not any(map(_is_number, _cells(path, lines[0])))


def _lines(path: Path) -> list[str]:
    return _filled(small_text(path, _EXPECTED, "utf-8-sig"))


def _filled(text: str) -> list[str]:
    """Lines of a table that are neither empty nor a comment."""
    return [line for line in text.splitlines() if line.strip(" ,;\t") and line.strip()[0] != "#"]


def _cells(path: Path, line: str, delimiter: str = "") -> list[str]:
    delimiter = delimiter or _delimiter(line)
    try:
        (cells,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    except csv.Error as error:
        raise InputError(
            f"{path} has a line that begins with {line[:30]!r} and cannot be read ({error}): "
            "expected a table as comma-separated values; correct it"
        ) from None
    return [cell.strip() for cell in cells]


def _delimiter(header: str) -> str:
    return ";" if ";" in header else ","


Model = TypeVar("Model", bound=BaseModel)


def rows_of(path: Path, model: type[Model], shared: Mapping[str, Any] | None = None) -> list[Model]:
    """Return rows of a table as models; files that it names are looked for from its own folder."""
    lines = _lines(path)
    header = _cells(path, lines[0]) if lines else []
    _check_header(path, header, model)
    if len(lines) < 2:
        raise InputError(f"{path} has no rows below its first line: expected one for each image")
    rows = []
    for number, line in enumerate(lines[1:], 1):
        cells = _cells(path, line, _delimiter(lines[0]))
        if len(cells) > len(header):
            raise InputError(
                f"{path}, row {number} has {len(cells)} values, expected {len(header)}: "
                f"{', '.join(header)}"
            )
        told = {name: cell for name, cell in zip(header, cells, strict=False) if cell}
        for name in told.keys() & set(_FILES):
            if told[name] != "unknown":
                told[name] = str(path.parent / told[name])
        rows.append(validated(model, {**_known(shared or {}), **told}, f"{path}, row {number}"))
    return rows


def _check_header(path: Path, header: list[str], model: type[BaseModel]) -> None:
    known = list(model.model_fields)
    for name in header:
        if name not in known:
            meant = nearest(name.lower(), known)
            hint = f"did you mean '{meant}'?" if meant else f"known are {', '.join(known)}"
            raise InputError(f"{path} has a column '{name}': {hint}")
    for one, other in pairwise(sorted(header)):
        if one == other:
            raise InputError(f"{path} has the column '{one}' twice: expected it once")
    needed = [name for name, field in model.model_fields.items() if field.is_required()]
    missing = [name for name in needed if name not in header]
    if missing:
        raise InputError(
            f"{path} has no column '{missing[0]}': its first line must name {', '.join(needed)}"
        )
