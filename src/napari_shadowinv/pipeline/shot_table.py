"""Descriptions of images and fiducials, from rows of a table or from flags.

- one image: `ShotRow`; all of a fit: `shot_rows`
- the images of a table that are inverted one by one: `rows_to_invert`
- whether a file is such a table: `is_table`; all its rows: `table_rows`
- known displacements: `fiducials_from`
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from napari_shadowinv._system.safety import check_regular
from napari_shadowinv._system.tables import read_rows
from napari_shadowinv._system.validation import CheckedModel, suggestion, validate
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import name_of
from napari_shadowinv.io.formats import TABLE
from napari_shadowinv.options import MAX_STRENGTH, Noise
from napari_shadowinv.physics.setup import beam_quantities

_BeamValue = Annotated[float, Field(gt=0, le=1e5)] | None


def _strength(value: Any) -> Any:
    try:
        strengths = tuple(map(float, str(value).split()))
    except ValueError:
        strengths = ()
    if not strengths:
        raise ValueError("expected a number, or one for each field with spaces between them")
    if not all(abs(strength) <= MAX_STRENGTH for strength in strengths):
        raise ValueError(f"expected a displacement of at most {MAX_STRENGTH:g} times the first")
    return strengths


class ShotRow(CheckedModel, extra="allow"):
    """One image and its description.

    It also takes the quantity of its beam in place of the setup's, ``energy`` (MeV) of particles or
    ``wavelength`` (m) of light: the names in `beam_quantities`. If only strengths are given, the
    quantity is a label.
    """

    __pydantic_extra__: dict[str, _BeamValue]
    file: Path = Field(title="Image", description="Its file.")
    setup: Path | None = Field(
        default=None, description="TOML file with the experimental geometry."
    )
    strength: Annotated[tuple[float, ...], BeforeValidator(_strength)] | None = Field(
        default=None,
        description="Displacement relative to the first image; with two fields '1 0.6'.",
    )
    brightness: float | None = Field(
        default=None, gt=0, description="How many times brighter than the source the image is."
    )
    psf: float | None = Field(
        default=None,
        ge=0,
        title="Point spread",
        description="Standard deviation in px, after the step 'bin'.",
    )
    mask: Path | None = Field(
        default=None, description="Image of the same size, 0 at unusable pixels."
    )
    source: Literal["unknown"] | Path | None = Field(
        default=None, description="Image of the undisturbed beam, or unknown to fit a smooth one."
    )
    noise: Noise | None = Field(
        default=None,
        description="poisson for counts, proportional for a share of each pixel, or the standard "
        "deviation in a pixel, after the step 'bin'.",
    )
    exclude: bool = Field(default=False, description="true, yes or 1 to leave the image out.")

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_columns(cls, values: Any) -> Any:
        unknown = set(values) - set(cls.columns()) if isinstance(values, Mapping) else set()
        if unknown:
            name = min(map(str, unknown))
            raise ValueError(f"unknown key '{name}', {suggestion(name, cls.columns())}")
        return values

    @classmethod
    def columns(cls) -> list[str]:
        """Return the columns of a table of shots."""
        first = ["file", "setup", *beam_quantities()]
        return [*first, *(name for name in cls.model_fields if name not in first)]

    @property
    def beam(self) -> dict[str, float]:
        """Energy or wavelength of the row, by name; empty without it."""
        return _drop_none(self.model_extra or {})

    @property
    def beam_text(self) -> str:
        """Energy or wavelength of the row with its unit; empty without it."""
        return ", ".join(beam_quantities()[name].text(value) for name, value in self.beam.items())

    @property
    def files(self) -> dict[str, Path]:
        """Files of the image, by the names of the columns."""
        columns = {name: getattr(self, name) for name in ("file", "setup", "mask", "source")}
        return {name: path for name, path in columns.items() if isinstance(path, Path)}

    @property
    def summary(self) -> dict[str, Any]:
        """Entries of the row, without folders, which may be moved."""
        entries = self.model_dump(mode="json", exclude_none=True, exclude={"exclude"})
        return {**entries, **{name: name_of(path) for name, path in self.files.items()}}


class _Fiducial(CheckedModel):
    y: float
    x: float
    dy: float
    dx: float
    sigma: float = Field(gt=0, title="Standard deviation")


def shot_rows(
    images: Sequence[Path],
    setup: Path | None = None,
    energies: str | None = None,
    name: str = "energies",
) -> list[ShotRow]:
    """Describe the images of a fit, or the rows of their table.

    The setup is that of all images without one; energies are separated by commas, one for each
    image, and have a name in errors.
    """
    if len(images) == 1 and is_table(images[0]):
        if energies is not None:
            raise InputError(
                f"received {name} {energies} and the table {images[0]}: write it into the column "
                "'energy'"
            )
        return list(_used_rows(images[0], setup).values())
    values = [None] * len(images) if energies is None else energies.split(",")
    if len(values) != len(images):
        raise InputError(
            f"received {len(images)} images and {len(values)} values of {name} ({energies}): "
            "expected one for each image, separated by commas"
        )
    return [
        validate(
            ShotRow,
            _drop_none({"file": image, "setup": setup, "energy": value and value.strip()}),
            str(image),
            {"energy": name},
        )
        for image, value in zip(images, values, strict=True)
    ]


def rows_to_invert(table: Path | Sequence[ShotRow]) -> list[ShotRow]:
    """Return the rows to invert one by one."""
    rows = _used_rows(table)
    place = f"{table}, line" if isinstance(table, Path) else "the table, row"
    for number, row in rows.items():
        if row.source == "unknown":
            raise InputError(
                f"{place} {number} has the source 'unknown', which only a fit can "
                "find: name an image, or leave the cell empty"
            )
    return list(rows.values())


def table_rows(table: Path) -> list[ShotRow]:
    """Return all rows of a table of shots, including excluded ones."""
    return list(_read_shots(table).values())


def _used_rows(table: Path | Sequence[ShotRow], setup: Path | None = None) -> dict[int, ShotRow]:
    rows = _read_shots(table, setup) if isinstance(table, Path) else dict(enumerate(table, 1))
    used = {number: row for number, row in rows.items() if not row.exclude}
    if not used:
        raise InputError(
            f"{table if isinstance(table, Path) else 'the table'} excludes all of its {len(rows)} "
            "images: empty the column 'exclude' in the rows to use"
        )
    return used


def fiducials_from(path: Path) -> list[tuple[float, ...]]:
    """Read known displacements from a table: rows of y, x, dy, dx and their σ, in px."""
    rows = read_rows(path, _Fiducial).values()
    return [(row.y, row.x, row.dy, row.dx, row.sigma) for row in rows]


def _drop_none(values: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def is_table(path: Path, *, most_bytes: int = 100_000) -> bool:
    """Return whether a file is a table with column names, not an image as text."""
    if path.suffix.lower() not in TABLE.suffixes:
        return False
    check_regular(path, "a table or an image as text")
    with path.open(encoding="utf-8-sig", errors="replace") as file:  # it may be a large image
        lines = map(str.strip, file.read(most_bytes).splitlines())
    # A lone # is the name of a column of numbers.
    first = next((line for line in lines if line and not re.match("#(?![;,\t])", line)), "")
    return not re.match(r'"?([-+.\d]|(nan|inf)\b|$)', first, re.IGNORECASE)


def _read_shots(table: Path, setup: Path | None = None) -> dict[int, ShotRow]:
    """Return all rows of a table by their lines; file names are relative to its folder."""
    shared = _drop_none({"setup": setup})
    return read_rows(table, ShotRow, columns=ShotRow.columns(), shared=shared)
