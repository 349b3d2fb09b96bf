"""What is known about a stack before any shot is inverted: `describe_stack` gives a `Stack`."""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.arrays import (
    check_spacing,
    join_masks,
    unpack_array,
    unpack_mask,
)
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.labels import dataset_from_field, variable_labels
from napari_shadowinv.inversion.normalise import checked_mask, checked_source
from napari_shadowinv.io.files import text_of
from napari_shadowinv.io.store import FORMAT
from napari_shadowinv.options import FitChoices, InversionOptions
from napari_shadowinv.pipeline import Inputs, gathered
from napari_shadowinv.pipeline._fit import check_fit
from napari_shadowinv.pipeline.shot_table import ShotRow, is_table
from napari_shadowinv.preprocessing import (
    Estimate,
    MeasuredSource,
    Origin,
    Radiograph,
    Recipe,
    Step,
    UniformEstimate,
)
from napari_shadowinv.stack._discovery import Shots, find_shots, find_source, usual_shape
from napari_shadowinv.stack._shots import FitStack, Stack, TableStack
from napari_shadowinv.stack._sources import (
    Reader,
    described_reader,
    read_shot,
)
from napari_shadowinv.stack._table_shots import (
    RowShot,
    first_image,
    row_shots,
    shots_of_table,
)
from napari_shadowinv.stack._worker import Beam, shared_plan, threads_here

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup

# What is stored of an inversion, and of a fit, unless it is said.
STORED = ("potential", "displacement", "caustic")
FITTED = ("potential", "displacement", "displacement_uncertainty")


def describe_stack(
    shots: Any,
    *,
    variables: Collection[str] | None,
    source: Any,
    mask: ArrayLike | None,
    recipe: Recipe | None,
    options: InversionOptions | None,
    setup: Setup | None,
    filters: Sequence[Step],
    source_mask: ArrayLike | None,
    reader: Reader,
    warm_start: int,
) -> Stack:
    """Check everything that can be checked before a shot is read."""
    if warm_start < 1:
        raise InputError(
            f"warm_start is {warm_start}: expected a number of shots, or 1 to disable it"
        )
    wanted = _recipe(recipe, options, setup, filters)
    if isinstance(source, Estimate):
        wanted = wanted.model_copy(update={"source": source})
        source = None
    found, inputs, sources = _described(shots, wanted, source, mask, source_mask, reader)
    own = sources if isinstance(sources, Shots) else None
    if own is not None and isinstance(shots, Shots):
        raise InputError(
            f"got {len(own)} sources, and the shots are still to arrive: expected one for all"
        )
    if own is not None and len(own) != len(found):
        raise InputError(
            f"got {len(own)} sources for {len(found)} shots: expected one, or one for each shot"
        )
    named = described_reader(reader)
    if wanted.fit is not None:
        return _fit_stack(found, inputs, sources, wanted, variables, warm_start, named)
    rows = [shot.row for shot in found.items if isinstance(shot, RowShot)]
    own_masks = any(row.mask is not None for row in rows)
    alone = own_masks or any(row.source is not None for row in rows)
    beam = None if alone else _shared_beam(inputs, sources)
    if beam is None and warm_start > 1:
        raise InputError(
            f"warm_start is {warm_start} and each shot has its own source or mask: the previous "
            "solution belongs to different sites; leave warm_start out, or give one source and "
            "mask for all shots"
        )
    options = inputs.recipe.options
    ragged = own_masks or (beam is None and (options.boundary == "free" or options.is_adaptive))
    chosen = _checked_variables(variables, inputs.recipe, ragged=ragged)
    if not rows:
        return Stack(found, inputs, beam, own, chosen, warm_start, named)
    common = None if sources is None or own is not None else np.asarray(sources, np.float64)
    guess = wanted.estimate
    return TableStack(
        found, inputs, beam, own, chosen, warm_start, named, common=common, estimate=guess
    )


def _described(
    shots: Any,
    wanted: Recipe,
    source: Any,
    mask: ArrayLike | None,
    source_mask: ArrayLike | None,
    reader: Reader,
) -> tuple[Shots, Inputs, Any]:
    """Return the shots, the recipe with its masks, and the source of all or that of each."""
    measured = wanted.source if isinstance(wanted.source, MeasuredSource) else MeasuredSource()
    source = measured.file if source is None else source
    source_reader = reader
    if measured.variable is not None:
        source_reader = partial(reader, variable=measured.variable)
    lit = None
    if getattr(source, "ndim", None) == 2:
        source, lit = unpack_array(source, "source")
    sources = find_source(source, reader=source_reader)
    if isinstance(sources, Shots):
        lit = sources.mask
    if sources is None and isinstance(wanted.source, MeasuredSource):
        raise InputError(
            "the recipe asks for a measured source, but names no file: name one, or give a source"
        )
    mask, source_mask = unpack_mask(mask), unpack_mask(source_mask, "source mask")
    # Where the source tells it, no shot needs to be read for its shape.
    shape = (() if mask is None else np.shape(mask)) if sources is None else sources.shape
    known = (shape[0], shape[1]) if len(shape) == 2 else None
    table = _table_of(shots)
    if table is not None:
        found, first = _shots_of(table, wanted, reader, known)
        wanted = wanted.model_copy(update={"setup": first})
    else:
        found = find_shots(shots, reader=reader, shape=known)
    if sources is not None and sources.shape != found.shape:
        raise InputError(f"source has shape {sources.shape}, shots {found.shape}: they must match")
    mask = join_masks(mask, found.mask, lit)
    usable = None if mask is None else checked_mask(mask, found.shape)
    bare = None if source_mask is None else checked_mask(source_mask, found.shape)
    if wanted.setup is not None:
        check_spacing(shots, "shots", wanted.setup.pixel_sizes)
    nothing = np.ones(found.shape)
    inputs = gathered(
        wanted.model_copy(update={"source": wanted.estimate}),
        Radiograph(nothing),
        source=None if sources is None else nothing,
        mask=usable,
        source_mask=bare,
    )
    inputs.recipe.check(inputs.shot)
    if inputs.recipe.estimate is not None:
        inputs.recipe.estimate.placed(inputs.recipe.setup, found.shape)  # refuses a wrong setup
    if isinstance(source, (str, Path)):
        origin = Origin(file=text_of(Path(source).name))
        provenance = inputs.provenance.model_copy(update={"source": origin})
        inputs = replace(inputs, provenance=provenance)
    return found, replace(inputs, shot=replace(inputs.shot, source=None)), sources


def _table_of(shots: Any) -> Path | Sequence[ShotRow] | None:
    """The table that describes the shots, or its rows, if it is one."""
    if isinstance(shots, Sequence) and shots and all(isinstance(one, ShotRow) for one in shots):
        return shots
    alone = shots[0] if isinstance(shots, (list, tuple)) and len(shots) == 1 else shots
    if not isinstance(alone, (str, Path)) or not os.path.isfile(alone):
        return None
    return Path(alone) if is_table(Path(alone)) else None


def _shots_of(
    table: Path | Sequence[ShotRow],
    recipe: Recipe,
    reader: Reader,
    shape: tuple[int, int] | None,
) -> tuple[Shots, Setup | None]:
    """The shots of a table, and the setup of the first image."""
    part = getattr(reader, "keywords", {})
    if getattr(reader, "func", reader) is not read_shot:
        raise InputError(
            f"received a reader for the table {table}, which names files: leave the reader out"
        )
    chosen = part.get("channel"), part.get("variable")
    if recipe.fit is None:
        rows = row_shots(table, recipe, *chosen)
        items = list(rows.values())
        return Shots(items, tuple(rows), shape or usual_shape(items)), items[0].setup
    if not isinstance(table, Path):
        raise InputError("received rows of a table to fit, expected its file: write it first")
    named = shots_of_table(table, recipe, *chosen)
    first = first_image(list(named.values()))
    assert isinstance(first.image, Radiograph)
    return Shots(list(named.values()), tuple(named), first.image.shape), first.setup


def _fit_stack(
    found: Shots,
    inputs: Inputs,
    sources: Any,
    wanted: Recipe,
    variables: Collection[str] | None,
    warm_start: int,
    reader: str,
) -> FitStack:
    check_fit(wanted)
    choices = wanted.fit or FitChoices()
    if warm_start > 1:
        raise InputError(f"warm_start is {warm_start}: fits start on their own; leave it out")
    if choices.fields is not None and len(choices.fields) > 1:
        raise InputError(
            f"the recipe fits the fields {', '.join(choices.fields)}, and a store holds one: fit "
            "one field, or each shot alone with shadowinv fit"
        )
    own = sources if isinstance(sources, Shots) else None
    image = None if sources is None or own is not None else np.asarray(sources, np.float64)
    # Estimates, and beams of their own, are those of each shot.
    alone = own is not None or inputs.recipe.estimate not in (None, UniformEstimate())
    beam = None if alone else Beam.of(found.shape, image, None)
    stack = FitStack(found, inputs, beam, own, (), 1, reader, given=wanted)
    known = stack.labels
    if choices.options.samples < 2:
        known.pop("displacement_uncertainty")
    for name in variables or ():
        if name not in known:
            raise InputError(
                f"there is no variable {name!r} of a fit: expected one or more of "
                f"{', '.join(known)}"
            )
    usual = tuple(name for name in FITTED if name in known)
    return replace(stack, variables=tuple(variables or usual))


def _recipe(
    recipe: Recipe | None,
    options: InversionOptions | None,
    setup: Setup | None,
    filters: Sequence[Step],
) -> Recipe:
    """The recipe that was given, or that the other keywords make up."""
    check_instance(recipe, Recipe, "recipe")
    if recipe is None:
        options = as_model(InversionOptions, options, "options")
        return Recipe(steps=tuple(filters), setup=setup, options=options)
    given = {"options": options, "setup": setup, "filters": tuple(filters) or None}
    for name, value in given.items():
        if value is not None:
            raise InputError(f"got a recipe and {name}: say so in the recipe")
    return recipe


def _shared_beam(inputs: Inputs, sources: Any) -> Beam | None:
    """Source, after all steps, and mask that the shots share; None if each has its own source."""
    moved = inputs.recipe.moved(inputs.shot)
    if isinstance(inputs.recipe.source, UniformEstimate):
        return Beam.of(moved.shape, None, moved.mask)
    if sources is None or isinstance(sources, Shots):
        return None
    beam = np.asarray(sources, np.float64)
    ready = inputs.recipe.prepared(replace(inputs.shot, image=beam, source=beam))
    assert ready.source is not None
    checked_source(ready.source, ready.mask)
    return Beam.of(ready.shape, ready.source, ready.mask)


def _checked_variables(
    wanted: Collection[str] | None, recipe: Recipe, *, ragged: bool
) -> tuple[str, ...]:
    """Names of the variables that a stack shall have; shots may differ in the number of sites."""
    labels = variable_labels(recipe.setup)
    # By as many as the masks hide, or as the source shines into the margin.
    known = tuple(name for name, (dims, _) in labels.items() if not (ragged and "site" in dims))
    for name in wanted or ():
        if name in known:
            continue
        hint = " (it needs a setup)" if recipe.setup is None else ""
        if name in labels:
            hint = (
                " (sites differ between shots with one source per shot and a free boundary or no "
                "given number of sites, or with masks of their own)"
            )
        raise InputError(
            f"there is no variable {name!r}{hint}: expected one or more of {', '.join(known)}"
        )
    return known if wanted is None else tuple(wanted)


def coordinates_of(stack: Stack) -> dict[str, Any]:
    own = isinstance(stack, TableStack)
    # Where setups differ, so may the pixels' size.
    plane = dataset_from_field(np.zeros((2, *stack.shape)), None, None if own else stack.setup)
    shots = stack.shots
    numbers = np.arange(len(shots)) if shots.coordinate is None else shots.coordinate
    coords: dict[str, Any] = {str(name): value for name, value in plane.coords.items()}
    coords["shot"] = ("shot", numbers, {"long_name": "Shot"})
    coords["name"] = ("shot", np.array(shots.names, dtype=str), {"long_name": "Name of the shot"})
    return coords


def attributes_of(stack: Stack) -> dict[str, str]:
    attributes = dataset_from_field(np.zeros((2, 4, 4)), None, stack.setup).attrs
    provenance = stack.inputs.provenance.model_copy(update={"setup": stack.setup})
    return {
        "format": FORMAT,
        **attributes,
        "options": stack.recipe.options.model_dump_json(),
        "provenance": provenance.model_dump_json(exclude_none=True),
        **({"fields": json.dumps([stack.bends])} if isinstance(stack, FitStack) else {}),
    }


def values_of_beam(beam: Beam, options: InversionOptions) -> dict[str, Any]:
    """Return the variables that all shots share, by name; a task, too."""
    if options.threads is None:
        options = options.model_copy(update={"threads": threads_here()})
    plan = shared_plan(beam, options)
    level = plan.levels[-1]
    mask = np.ones(beam.shape, bool) if beam.mask is None else beam.mask
    source = None if beam.source is None else checked_source(beam.source, beam.mask)
    return {
        "sites": level.sites - plan.margin_width,
        "site_mass": level.mass * plan.unit,
        "mask": mask,
        "source": source,
    }


def dtype_of(name: str) -> Any:
    """Type of a variable as an inversion has it."""
    return np.dtype(bool) if name in ("caustic", "mask") else np.dtype(np.float64)
