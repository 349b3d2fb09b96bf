"""Shots that a table describes: `ObjectShot`, several images of one object; `RowShot`, one image.

- what is fitted: `shots_of_table`; what is inverted, a row each: `row_shots`
- what a worker does with the image of a row: `RowWork`
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io.files import sha256
from napari_shadowinv.io.formats import PRADFORMAT, TEXT, kind_of
from napari_shadowinv.physics.setup import Setup, setup_from_dict
from napari_shadowinv.pipeline import FitShot, Inputs, gathered
from napari_shadowinv.pipeline._fit_shots import read_rows, row_setup
from napari_shadowinv.pipeline.files import read_part
from napari_shadowinv.pipeline.shot_table import ShotRow, rows_by_shot, rows_to_invert
from napari_shadowinv.preprocessing import Estimate, Radiograph, Recipe
from napari_shadowinv.stack._discovery import names_of
from napari_shadowinv.stack._sources import Shot, doubts_of_file, stamp
from napari_shadowinv.stack._worker import Beam, Work


@dataclass(frozen=True, eq=False)
class ObjectShot(Shot):
    """Several images of one object, as rows of a table describe them."""

    rows: tuple[ShotRow, ...]
    recipe: Recipe
    channel: str | None = None
    variable: str | None = None

    def load(self) -> tuple[Any, dict[str, Any]]:
        """Return the images as `FitShot`, and what they were read from."""
        shots = read_rows(self.rows, self.recipe, channel=self.channel, variable=self.variable)
        files = {
            f"{name} {number}": {**stamp(path), "sha256": sha256(path)}
            for number, row in enumerate(self.rows, 1)
            for name, path in row.files.items()
        }
        return shots, {"files": files, "rows": self._described()}

    def shape(self) -> tuple[int, ...]:
        return read_part(self.rows[0].file, self.channel, self.variable).shape

    def unchanged(self, origin: dict[str, Any]) -> bool:
        """Compare the rows, and the files that are there by size and time or checksum."""
        if self._described() != origin.get("rows"):
            return False
        return all(
            _is_same(path, origin.get("files", {}).get(f"{name} {number}", {}))
            for number, row in enumerate(self.rows, 1)
            for name, path in row.files.items()
        )

    def _described(self) -> list[dict[str, Any]]:
        return [row.described for row in self.rows]


@dataclass(frozen=True, eq=False)
class RowShot(ObjectShot):
    """One image that is inverted, as a row of a table describes it."""

    setup: Setup | None = None  # of the image as recorded
    unused: tuple[str, ...] = ()  # columns that only fits use

    @property
    def row(self) -> ShotRow:
        return self.rows[0]

    def __dask_tokenize__(self) -> tuple[Any, ...]:
        # A file that changed is another input, and what dask has of it another result.
        files = {name: str(path) for name, path in self.row.files.items()}
        known = [stamp(path) for path in self.row.files.values() if path.exists()]
        setup = "" if self.setup is None else self.setup.model_dump_json()
        told = json.dumps([self.row.described, files, known])
        return told, setup, str(self.channel), str(self.variable)

    def load(self) -> tuple[Any, dict[str, Any]]:
        (shot,), origin = super().load()
        warnings = doubts_of_file(shot.image)
        if self.unused:
            text = (
                f"the table has {', '.join(self.unused)}, which an inversion does not use: fit the "
                "image to use it"
            )
            warnings.append(Caution("file", text))
        told = {**origin["files"]["file 1"], **origin, "warnings": warnings}
        return dataclasses.replace(shot, setup=self.setup), told

    def difference(self, origin: dict[str, Any]) -> str:
        """Name what differs from the row, or the setup, of which a report tells."""
        (before,) = origin.get("rows") or ({},)
        if before != self.row.described:
            return _differences(before, self.row.described)
        made = origin.get("provenance", {}).get("recipe", {}).get("setup")
        old = None if made is None else setup_from_dict(made)
        # A row whose image was put away may not tell its setup any more.
        if old == self.setup or (self.setup is None and not self.row.file.exists()):
            return ""
        told = [{} if one is None else one.model_dump() for one in (old, self.setup)]
        return _differences(*told)


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name}: {before.get(name)} there, {now.get(name)} now"
        for name in {**before, **now}
        if before.get(name) != now.get(name)
    )


def _is_same(path: Path, before: Mapping[str, Any]) -> bool:
    if not path.exists():
        return True  # put away after it was fitted
    return stamp(path).items() <= before.items() or sha256(path) == before.get("sha256")


def shots_of_table(
    table: Path, recipe: Recipe, channel: str | None, variable: str | None
) -> dict[str, ObjectShot]:
    """Return the shots that a table describes and that are fitted, by name."""
    return {
        name: ObjectShot(tuple(map(_absolute, rows)), recipe, channel, variable)
        for name, rows in rows_by_shot(table, {}).items()
    }


def row_shots(
    table: Path | Sequence[ShotRow], recipe: Recipe, channel: str | None, variable: str | None
) -> dict[str, RowShot]:
    """Return the shots that a table describes, or its rows, and that are inverted, by name."""
    rows, unused = rows_to_invert(table)
    names = names_of([row.file for row in rows])
    found = {}
    for name, row in zip(names, map(_absolute, rows), strict=True):
        setup = row_setup(row, _known_of(row, channel, variable), recipe)
        found[name] = RowShot((row,), recipe, channel, variable, setup, unused)
    return found


def _known_of(row: ShotRow, channel: str | None, variable: str | None) -> Radiograph:
    """An image, if its file may tell a geometry and can be read; else one that tells nothing."""
    try:
        if kind_of(row.file) in (PRADFORMAT.name, TEXT.name):
            return read_part(row.file, channel, variable)
    except (OSError, ValueError):
        pass  # its shot fails, by name
    return Radiograph(np.zeros((1, 1)))


def _absolute(row: ShotRow) -> ShotRow:
    """A row whose files a worker elsewhere finds."""
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
    """What is done with every row of a table that is inverted."""

    estimate: Estimate | None = None  # of the source of rows without one

    def gathered(self, content: Any, beam: Beam | None, source: AnyArray | None) -> Inputs:
        """Return the image of a row, divided by its gain, with its own source, mask and setup."""
        row: FitShot = content
        common = self.inputs
        self._check_setup(row.setup)
        assert isinstance(row.image, Radiograph)
        bare = dataclasses.replace(
            row.image,
            image=row.image.image / (row.gain or 1.0),
            setup=None,
            source=None,
            mask=None,
            source_mask=None,
            warnings=(),
        )
        known = source if row.source is None else row.source
        recipe = common.recipe.model_copy(
            update={
                # What all shots share is in the beam already.
                "source": self.estimate if beam is None else common.recipe.source,
                "setup": row.setup,
                "mask": row.mask,
            }
        )
        usable = common.shot.mask if row.mask is None else None
        inputs = gathered(
            recipe, bare, source=known, mask=usable, source_mask=common.shot.source_mask
        )
        if beam is None:
            inputs.recipe.check(inputs.shot)
        told: dict[str, Any] = {"gain": row.gain}
        if row.source is None:
            told["source"] = common.provenance.source
        provenance = inputs.provenance.model_copy(update=told)
        return dataclasses.replace(inputs, provenance=provenance)

    def report(self, inversion: Inversion) -> dict[str, Any]:
        """Return what is told of a shot: its own provenance and energy, too."""
        made = inversion.provenance
        assert made is not None
        told = {"provenance": json.loads(made.model_dump_json(exclude_none=True))}
        energy = getattr(made.setup, "energy", None)
        return {**super().report(inversion), **told, **({"energy": energy} if energy else {})}

    def _check_setup(self, setup: Setup | None) -> None:
        first = self.inputs.recipe.setup
        kinds = [None if one is None else one.kind for one in (setup, first)]
        if kinds[0] != kinds[1]:
            own, usual = (f"a setup of kind '{kind}'" if kind else "no setup" for kind in kinds)
            raise InputError(
                f"it has {own}, and the first row of its table {usual}: a store has the units of "
                "one kind of setup; give all rows such a setup, or use two tables"
            )
