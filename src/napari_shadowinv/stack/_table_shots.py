"""Shots of a table: `ObjectShot`, several images of one object; `RowShot`, one image.

- shots to fit: `object_shots`; shots to invert, a row each: `row_shots`
- the inversion of a row by a worker: `RowWork`
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io.files import sha256
from napari_shadowinv.io.formats import PRADFORMAT, TEXT, kind_of
from napari_shadowinv.io.store_columns import ROWS
from napari_shadowinv.physics.setup import Setup, setup_from_dict
from napari_shadowinv.pipeline import FitShot, Inputs, collect_inputs
from napari_shadowinv.pipeline.files import read_part
from napari_shadowinv.pipeline.fit_shots import read_rows, row_setup
from napari_shadowinv.pipeline.shot_table import ShotRow, rows_by_shot, rows_to_invert
from napari_shadowinv.preprocessing import Estimate, Radiograph, Recipe
from napari_shadowinv.stack._discovery import names_of
from napari_shadowinv.stack._sources import Shot, file_doubts, stamp
from napari_shadowinv.stack._worker import Beam, Work


@dataclass(frozen=True, eq=False)
class ObjectShot(Shot):
    """Several images of one object, from rows of a table."""

    rows: tuple[ShotRow, ...]
    recipe: Recipe
    channel: str | None = None
    variable: str | None = None

    def load(self) -> tuple[Any, dict[str, Any]]:
        """Return the images as `FitShot`, and the files of their rows."""
        shots = read_rows(self.rows, self.recipe, channel=self.channel, variable=self.variable)
        files = {
            f"{name} {number}": {**stamp(path), "sha256": sha256(path)}
            for number, row in enumerate(self.rows, 1)
            for name, path in row.files.items()
        }
        return shots, {"files": files, "rows": self._summaries()}

    def shape(self) -> tuple[int, ...]:
        return read_part(self.rows[0].file, self.channel, self.variable).shape

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Compare the rows, and existing files by size and time or checksum."""
        if self._summaries() != origin.get("rows"):
            return False
        return all(
            _is_unchanged(path, origin.get("files", {}).get(f"{name} {number}", {}))
            for number, row in enumerate(self.rows, 1)
            for name, path in row.files.items()
        )

    def _summaries(self) -> list[dict[str, Any]]:
        return [row.summary for row in self.rows]


@dataclass(frozen=True, eq=False)
class RowShot(ObjectShot):
    """One image to invert, from a row of a table."""

    setup: Setup | None = None  # of the image as recorded
    unused: tuple[str, ...] = ()  # columns that only fits use

    @property
    def row(self) -> ShotRow:
        return self.rows[0]

    def __dask_tokenize__(self) -> tuple[Any, ...]:
        # A changed file is another input, so dask must not reuse its result.
        files = {name: str(path) for name, path in self.row.files.items()}
        stamps = [stamp(path) for path in self.row.files.values() if path.exists()]
        setup = "" if self.setup is None else self.setup.model_dump_json()
        content = json.dumps([self.row.summary, files, stamps])
        return content, setup, str(self.channel), str(self.variable)

    def load(self) -> tuple[Any, dict[str, Any]]:
        (shot,), origin = super().load()
        warnings = file_doubts(shot.image)
        if self.unused:
            text = (
                f"the table has {', '.join(self.unused)}, which an inversion does not use: fit the "
                "image to use it"
            )
            warnings.append(Caution("file", text))
        metadata = {**origin["files"]["file 1"], **origin, "warnings": warnings}
        return dataclasses.replace(shot, setup=self.setup), metadata

    def difference(self, origin: dict[str, Any]) -> str:
        """Describe the difference from the row, or the setup, in a report."""
        (before,) = origin.get("rows") or ({},)
        if before != self.row.summary:
            return _differences(before, self.row.summary)
        entries = origin.get("provenance", {}).get("recipe", {}).get("setup")
        setup_before = None if entries is None else setup_from_dict(entries)
        # The setup of a row may have been in an image that was removed.
        if setup_before == self.setup or (self.setup is None and not self.row.file.exists()):
            return ""
        setups = (setup_before, self.setup)
        return _differences(*({} if setup is None else setup.model_dump() for setup in setups))


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name}: {before.get(name)} there, {now.get(name)} now"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    )


def _is_unchanged(path: Path, before: Mapping[str, Any]) -> bool:
    if not path.exists():
        return True  # put away after it was fitted
    return stamp(path).items() <= before.items() or sha256(path) == before.get("sha256")


def object_shots(
    table: Path, recipe: Recipe, channel: str | None, variable: str | None
) -> dict[str, ObjectShot]:
    """Return the shots of a table to fit, by name."""
    return {
        name: ObjectShot(tuple(map(_with_absolute_paths, rows)), recipe, channel, variable)
        for name, rows in rows_by_shot(table, {}).items()
    }


def row_shots(
    table: Path | Sequence[ShotRow], recipe: Recipe, channel: str | None, variable: str | None
) -> dict[str, RowShot]:
    """Return the shots of a table, or of its rows, to invert, by name."""
    rows, unused = rows_to_invert(table)
    names = names_of([row.file for row in rows])
    shots = {}
    for name, row in zip(names, map(_with_absolute_paths, rows), strict=True):
        setup = row_setup(row, _read_geometry(row, channel, variable), recipe)
        shots[name] = RowShot((row,), recipe, channel, variable, setup, unused)
    return shots


def _read_geometry(row: ShotRow, channel: str | None, variable: str | None) -> Radiograph:
    """Read an image if its file may contain a geometry; return an empty one otherwise."""
    try:
        if kind_of(row.file) in (PRADFORMAT.name, TEXT.name):
            return read_part(row.file, channel, variable)
    except (OSError, ValueError):
        pass  # its shot fails, by name
    return Radiograph(np.zeros((1, 1)))


def _with_absolute_paths(row: ShotRow) -> ShotRow:
    """Return a row with absolute paths, for workers elsewhere."""
    return row.model_copy(update={name: path.absolute() for name, path in row.files.items()})


def first_image(shots: Sequence[ObjectShot]) -> FitShot:
    """Return the first image of the first shot that can be read; others fail later, by name."""
    first_error: Exception | None = None
    for shot in shots:
        try:
            images: tuple[FitShot, ...] = dataclasses.replace(shot, rows=shot.rows[:1]).load()[0]
            return images[0]
        except (OSError, ValueError) as error:
            first_error = first_error or error
    raise FileFormatError(f"none of {len(shots)} shots can be read, the first: {first_error}")


@dataclass(frozen=True, eq=False)
class RowWork(Work):
    """Task of every row of a table to invert."""

    estimate: Estimate | None = None  # of the source of rows without one
    shots: ClassVar[str] = ROWS

    def collect_inputs(self, content: Any, beam: Beam | None, source: AnyArray | None) -> Inputs:
        """Return the image of a row over its brightness, with its own source, mask and setup."""
        row: FitShot = content
        common = self.inputs
        self._check_setup(row.setup)
        assert isinstance(row.image, Radiograph)
        bare = dataclasses.replace(
            row.image,
            image=row.image.image / (row.brightness or 1.0),
            setup=None,
            source=None,
            mask=None,
            source_mask=None,
            warnings=(),
        )
        row_source = source if row.source is None else row.source
        recipe = common.recipe.model_copy(
            update={
                # A common source is already in the beam.
                "source": self.estimate if beam is None else common.recipe.source,
                "setup": row.setup,
                "mask": row.mask,
            }
        )
        usable = common.shot.mask if row.mask is None else None
        inputs = collect_inputs(
            recipe, bare, source=row_source, mask=usable, source_mask=common.shot.source_mask
        )
        if beam is None:
            inputs.recipe.check(inputs.shot)
        entries: dict[str, Any] = {"brightness": row.brightness}
        if row.source is None:
            entries["source"] = common.provenance.image.source
        provenance = inputs.provenance.with_image(**entries)
        return dataclasses.replace(inputs, provenance=provenance)

    def report(self, inversion: Inversion) -> dict[str, Any]:
        """Return the report of a shot, with its own provenance."""
        provenance = inversion.provenance
        assert provenance is not None
        entries = {"provenance": json.loads(provenance.to_json())}
        return {**super().report(inversion), **entries}

    def _check_setup(self, setup: Setup | None) -> None:
        first = self.inputs.recipe.setup
        kinds = [None if setup is None else setup.kind, None if first is None else first.kind]
        if kinds[0] != kinds[1]:
            texts = [f"a setup of kind '{kind}'" if kind else "no setup" for kind in kinds]
            raise InputError(
                f"it has {texts[0]}, and the first row of its table {texts[1]}: a store has the "
                "units of one kind of setup; give all rows such a setup, or use two tables"
            )
