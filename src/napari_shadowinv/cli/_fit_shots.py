"""The images of a fit, read and prepared, with what is known about each: `FitShots`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv.cli._inputs import read_shot, setup_from
from napari_shadowinv.cli._terminal import interrupted
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import FIELDS, point_spread
from napari_shadowinv.physics.projection import default_deflector
from napari_shadowinv.physics.setup import setup_from_dict
from napari_shadowinv.pipeline import gathered
from napari_shadowinv.preprocessing import Recipe

if TYPE_CHECKING:
    from napari_shadowinv._typing import AnyArray
    from napari_shadowinv.cli._fit_rows import ShotRow
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.preprocessing import Provenance, Radiograph, Step


@dataclass(frozen=True)
class FitShots:
    """Images on one grid of pixels, after the same steps, and the row that describes each.

    Attributes
    ----------
    rows : sequence of ShotRow
        What is known about each.
    shots : sequence of Radiograph
        The images, with setup, source and mask.
    provenances : sequence of Provenance
        Where they came from.
    spreads : sequence of float
        Standard deviation of each point spread, px.
    """

    rows: Sequence[ShotRow]
    shots: Sequence[Radiograph]
    provenances: Sequence[Provenance]
    spreads: Sequence[float]

    @property
    def setups(self) -> tuple[Setup, ...] | None:
        """The setups of all images; None if there are none."""
        return _of_all(self.rows, [shot.setup for shot in self.shots], "setup")

    def given(self, gains: str) -> dict[str, Any]:
        """Return what `fit` takes of it; `gains` is "known" or "free"."""
        strengths = _of_all(self.rows, [row.strength for row in self.rows], "strength")
        if strengths is not None and len(set(map(len, strengths))) > 1:
            raise InputError(
                f"strengths have {', '.join(str(len(one)) for one in strengths)} numbers: expected "
                "one for each field in all images"
            )
        factors = _of_all(self.rows, [row.gain for row in self.rows], "gain")
        if factors is not None and gains == "free":
            raise InputError("received gains and --gains free: expected one of them")
        return {
            "images": np.stack([shot.image for shot in self.shots]),
            "strengths": strengths,
            # The strengths that were given count, wherever they come from.
            "setups": self.setups if strengths is None else None,
            "source": self._source(),
            "noise": self._noise(),
            "psf": list(self.spreads),
            "mask": self._mask(),
            "gains": gains if factors is None else factors,
        }

    def origins(self) -> str:
        """Where the images came from and what was known about them, as JSON."""
        told: list[dict[str, Any]] = []
        for row, made, spread in zip(self.rows, self.provenances, self.spreads, strict=True):
            files = {"image": made.image, "source": made.source, "mask": made.mask}
            one: dict[str, Any] = {
                # Masks as they were drawn could be longer than an attribute may be.
                name: origin.model_dump(exclude_none=True, exclude={"pixels"})
                for name, origin in files.items()
                if origin is not None
            }
            if row.source == "unknown":
                one["source"] = "unknown"
            steps = [step.model_dump(mode="json") for step in made.recipe.steps]
            known = row.model_dump(include={"noise", "gain"}, exclude_none=True)
            told.append({**one, "steps": steps, "psf": spread, **known})
        return json.dumps(told)

    def _source(self) -> Any:
        asked = ["unknown" if row.source == "unknown" else None for row in self.rows]
        if _of_all(self.rows, asked, "unknown source") is not None:
            return "unknown"
        beams = _of_all(self.rows, [shot.source for shot in self.shots], "source")
        return None if beams is None else np.stack(beams)

    def _noise(self) -> Any:
        known = _of_all(self.rows, [row.noise for row in self.rows], "noise")
        if known is None:
            return None
        if len({isinstance(one, str) for one in known}) > 1:
            raise InputError(
                "noise is 'poisson' in some images and a number in others: give numbers for all"
            )
        return "poisson" if isinstance(known[0], str) else known

    def _mask(self) -> AnyArray | None:
        masks = [shot.mask for shot in self.shots]
        if all(mask is None for mask in masks):
            return None
        shape = self.shots[0].shape
        return np.stack([np.ones(shape, bool) if mask is None else mask for mask in masks])


def fit_shots(
    rows: Sequence[ShotRow],
    steps: tuple[Step, ...],
    *,
    channel: str | None,
    variable: str | None,
    source_size: float | None,
    resolution: float | None,
) -> FitShots:
    """Read the images of a fit, and take the steps; lengths in m make the point spread."""
    shots: list[Radiograph] = []
    provenances: list[Provenance] = []
    spreads: list[float] = []
    for row in rows:
        shot, made = _read(row, steps, channel, variable)
        if shots and shot.shape != shots[0].shape:
            raise InputError(
                f"{row.file} has shape {shot.shape}, {rows[0].file} {shots[0].shape}: expected "
                "images of one size, on the same pixels; crop or bin them first"
            )
        spreads.append(_spread(row, shot.setup, source_size, resolution))
        shots.append(shot)
        provenances.append(made)
    return FitShots(rows, shots, provenances, spreads)


def fields_for(text: str | None, setups: Sequence[Setup] | None) -> list[str]:
    """Names of the fields that are asked for, or the one that usually bends such beams."""
    if text is not None:
        return [name.strip() for name in text.split(",") if name.strip()]
    if not setups:
        return ["B"]
    names = {deflector: name for name, deflector in FIELDS.items()}
    try:
        (usual,) = {names[default_deflector(setups[0], setup)] for setup in setups}
    except InputError as error:
        raise InputError(f"{error}; name it with --fields, of {', '.join(FIELDS)}") from error
    return [usual]


def _read(
    row: ShotRow, steps: tuple[Step, ...], channel: str | None, variable: str | None
) -> tuple[Radiograph, Provenance]:
    shot = read_shot(row.file, channel, variable)
    if row.source == "unknown":
        shot = replace(shot, source=None)
    beam = None if row.source_file is None else read_shot(row.source_file, channel, None)
    recipe = Recipe(steps=steps, mask=row.mask, setup=_setup(row, shot))
    try:
        inputs = gathered(recipe, shot, source=beam)
        inputs.recipe.check(inputs.shot)
        return inputs.prepared(interrupted), inputs.provenance
    except InputError as error:
        raise InputError(f"{row.file}: {error}") from error


def _setup(row: ShotRow, shot: Radiograph) -> Setup | None:
    changes = {} if row.energy is None else {"energy": row.energy}
    if row.setup is not None:
        return setup_from(row.setup, shot.metadata.get("geometry"), changes)
    if not changes or shot.setup is not None:
        told = None if shot.setup is None else {**shot.setup.model_dump(), **changes}
        return None if told is None else setup_from_dict(told, str(row.file))
    raise InputError(
        f"{row.file} has an energy of {row.energy:g} MeV and no setup: give the rest of the "
        "geometry with --setup"
    )


def _spread(
    row: ShotRow, setup: Setup | None, source_size: float | None, resolution: float | None
) -> float:
    if source_size is None and resolution is None:
        return row.psf or 0.0
    if row.psf is not None:
        raise InputError(
            f"{row.file} has a point spread of {row.psf:g} px, and --source-size or --resolution "
            "ask for another: expected one of them"
        )
    if setup is None:
        raise InputError(
            f"{row.file} has no setup, and --source-size and --resolution are in m: give --setup, "
            "or the point spread in px with --psf"
        )
    return point_spread(setup, source_size or 0.0, resolution or 0.0)


def _of_all(rows: Sequence[ShotRow], values: Sequence[Any], name: str) -> tuple[Any, ...] | None:
    """What all images have; None if none has it."""
    without = [row.file for row, value in zip(rows, values, strict=True) if value is None]
    if len(without) == len(rows):
        return None
    if without:
        raise InputError(
            f"{without[0]} has no {name}, other images have: expected it for all of them, or none"
        )
    return tuple(values)
