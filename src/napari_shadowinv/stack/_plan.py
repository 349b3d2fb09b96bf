"""Description of a stack before any shot is inverted: `describe_stack` returns a `Stack`.

Its number of sites follows from the accuracy: `choose_sites`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.arrays import (
    check_spacing,
    checked_mask,
    join_masks,
    unpack_array,
    unpack_mask,
)
from napari_shadowinv._system.progress import ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import check_instance
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion import Inversion, count_sites
from napari_shadowinv.inversion.normalise import bytes_per_pixel, checked_source, number_of_sites
from napari_shadowinv.inversion.variables import dataset_from_field, variable_labels
from napari_shadowinv.io.files import sha256, text_of
from napari_shadowinv.io.store import FORMAT
from napari_shadowinv.options import FitChoices, InversionOptions
from napari_shadowinv.pipeline import Inputs, collect_inputs
from napari_shadowinv.pipeline.fit_run import check_fit
from napari_shadowinv.pipeline.shot_table import ShotRow, is_table
from napari_shadowinv.preprocessing import (
    Estimate,
    MeasuredSource,
    Radiograph,
    Recipe,
    UniformEstimate,
)
from napari_shadowinv.provenance import Origin
from napari_shadowinv.stack._discovery import Shots, find_shots, find_source, usual_shape
from napari_shadowinv.stack._shots import FitStack, Stack, TableStack
from napari_shadowinv.stack._sources import (
    Reader,
    read_shot,
    reader_text,
)
from napari_shadowinv.stack._table_shots import (
    RowShot,
    first_image,
    object_shots,
    row_shots,
)
from napari_shadowinv.stack._worker import Beam, shared_plan, threads_here

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup


MAX_TRIED_SHOTS = 10  # at the beginning of a stack
_DECIDING_SHOTS = 3


def choose_sites(stack: Stack, should_stop: ShouldStop | None = None) -> Stack:
    """Return the stack with the number of sites that its first shots need.

    All shots that share a beam then share the sites. Shots that cannot be inverted are skipped; if
    all of them are, the number is the default without an accuracy.
    """
    if not stack.chooses_sites:
        return stack
    return with_enough_sites(stack, needed_shares(stack, should_stop))


def needed_shares(stack: Stack, should_stop: ShouldStop | None = None) -> list[float]:
    """Return the share of the default number of sites that each of the first shots needs."""
    assert stack.beam is not None
    options = stack.recipe.options
    most = count_sites(stack.beam.image, options, mask=stack.beam.mask)
    work, needed = stack.work(()), []
    for shot in stack.shots.items[:MAX_TRIED_SHOTS]:
        try:
            content, _ = shot.load()
            inversion = work.invert(content, stack.beam, workers=1, should_stop=should_stop)
        except InversionCancelled:
            raise
        except Exception:  # the error is reported when it is its turn
            continue
        needed.append(cast("Inversion", inversion).report.n_sites / most)
        if len(needed) == _DECIDING_SHOTS:
            break
    return needed


def with_enough_sites(stack: Stack, shares: list[float]) -> Stack:
    """Return the stack with enough sites for each of these shares."""
    # A margin has its own sites, which are not counted here.
    most = number_of_sites(stack.shape, stack.recipe.options)
    return stack.with_sites(max(4, round(max(shares, default=1.0) * most)))


# Variables that are stored of an inversion, and of a fit, by default.
STORED = ("potential", "displacement", "caustic")
FITTED = ("potential", "displacement", "displacement_uncertainty")


def describe_stack(
    shots: Any,
    recipe: Recipe | None,
    *,
    variables: Collection[str] | None,
    source: Any,
    mask: ArrayLike | None,
    source_mask: ArrayLike | None,
    reader: Reader,
    warm_start: int,
) -> Stack:
    """Describe a stack, and check everything that can be checked before a shot is read."""
    if warm_start < 1:
        raise InputError(
            f"warm_start is {warm_start}: expected a number of shots, or 1 to disable it"
        )
    check_instance(recipe, Recipe, "recipe")
    resolved = Recipe() if recipe is None else recipe
    if isinstance(source, Estimate):
        resolved = resolved.model_copy(update={"source": source})
        source = None
    stack_shots, inputs, sources = _describe_inputs(
        shots, resolved, source, mask, source_mask, reader
    )
    shot_sources = sources if isinstance(sources, Shots) else None
    if shot_sources is not None and isinstance(shots, Shots):
        raise InputError(
            f"got {len(shot_sources)} sources, and the shots are still to arrive: expected one for "
            "all"
        )
    if shot_sources is not None and len(shot_sources) != len(stack_shots):
        raise InputError(
            f"got {len(shot_sources)} sources for {len(stack_shots)} shots: expected one, or one "
            "for each shot"
        )
    reader_name = reader_text(reader)
    if resolved.fit is not None:
        return _fit_stack(
            stack_shots, inputs, sources, resolved, variables, warm_start, reader_name
        )
    rows = [shot.row for shot in stack_shots.items if isinstance(shot, RowShot)]
    own_masks = any(row.mask is not None for row in rows)
    per_shot = own_masks or any(row.source is not None for row in rows)
    beam = None if per_shot else _shared_beam(inputs, sources)
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
        return Stack(stack_shots, inputs, beam, shot_sources, chosen, warm_start, reader_name)
    common = (
        None if sources is None or shot_sources is not None else np.asarray(sources, np.float64)
    )
    guess = resolved.estimate
    return TableStack(
        stack_shots,
        inputs,
        beam,
        shot_sources,
        chosen,
        warm_start,
        reader_name,
        common=common,
        estimate=guess,
    )


def _describe_inputs(
    shots: Any,
    recipe: Recipe,
    source: Any,
    mask: ArrayLike | None,
    source_mask: ArrayLike | None,
    reader: Reader,
) -> tuple[Shots, Inputs, Any]:
    """Return the shots, the recipe with its masks, and the common source or one for each."""
    measured = recipe.source if isinstance(recipe.source, MeasuredSource) else MeasuredSource()
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
    if sources is None and isinstance(recipe.source, MeasuredSource):
        raise InputError(
            "the recipe asks for a measured source, but names no file: name one, or give a source"
        )
    mask, source_mask = unpack_mask(mask), unpack_mask(source_mask, "source mask")
    # With a source, no shot needs to be read for its shape.
    shape = (() if mask is None else np.shape(mask)) if sources is None else sources.shape
    image_shape = (shape[0], shape[1]) if len(shape) == 2 else None
    table = _find_table(shots)
    if table is not None:
        stack_shots, first = _describe_table(table, recipe, reader, image_shape)
        recipe = recipe.model_copy(update={"setup": first})
    else:
        stack_shots = find_shots(shots, reader=reader, shape=image_shape)
    if sources is not None and sources.shape != stack_shots.shape:
        raise InputError(
            f"source has shape {sources.shape}, shots {stack_shots.shape}: they must match"
        )
    mask = join_masks(mask, stack_shots.mask, lit)
    usable = None if mask is None else checked_mask(mask, stack_shots.shape)
    bare = None if source_mask is None else checked_mask(source_mask, stack_shots.shape)
    if recipe.setup is not None:
        check_spacing(shots, "shots", recipe.setup.pixel_sizes)
    if recipe.fit is None and not recipe.steps:
        check_memory(stack_shots.shape, bytes_per_pixel(recipe.options), "an inversion")
    blank = np.ones(stack_shots.shape)
    inputs = collect_inputs(
        recipe.model_copy(update={"source": recipe.estimate}),
        Radiograph(blank),
        source=None if sources is None else blank,
        mask=usable,
        source_mask=bare,
    )
    inputs.recipe.check(inputs.shot)
    if inputs.recipe.estimate is not None:
        inputs.recipe.estimate.adapt_to(
            inputs.recipe.setup, stack_shots.shape
        )  # refuses a wrong setup
    if isinstance(source, (str, Path)):
        path = Path(source)
        origin = Origin(
            file=text_of(path.name),
            sha256=sha256(path) if path.is_file() else "",  # else a pattern of several files
            variable=measured.variable,
            shape=stack_shots.shape,
        )
        provenance = inputs.provenance.with_image(source=origin)
        inputs = replace(inputs, provenance=provenance)
    return stack_shots, replace(inputs, shot=replace(inputs.shot, source=None)), sources


def _find_table(shots: Any) -> Path | Sequence[ShotRow] | None:
    """Return the table of the shots, or its rows; None if they are no table."""
    if isinstance(shots, Sequence) and shots and all(isinstance(row, ShotRow) for row in shots):
        return shots
    single = shots[0] if isinstance(shots, (list, tuple)) and len(shots) == 1 else shots
    if not isinstance(single, (str, Path)) or not os.path.isfile(single):
        return None
    return Path(single) if is_table(Path(single)) else None


def _describe_table(
    table: Path | Sequence[ShotRow],
    recipe: Recipe,
    reader: Reader,
    shape: tuple[int, int] | None,
) -> tuple[Shots, Setup | None]:
    """Return the shots of a table, and the setup of the first image."""
    part = getattr(reader, "keywords", {})
    if getattr(reader, "func", reader) is not read_shot:
        raise InputError(
            f"received a reader for the table {table}, which names files: leave the reader out"
        )
    parts = part.get("channel"), part.get("variable")
    if recipe.fit is None:
        rows = row_shots(table, recipe, *parts)
        items = list(rows.values())
        return Shots(items, tuple(rows), shape or usual_shape(items)), items[0].setup
    if not isinstance(table, Path):
        raise InputError("received rows of a table to fit, expected its file: write it first")
    by_name = object_shots(table, recipe, *parts)
    first = first_image(list(by_name.values()))
    assert isinstance(first.image, Radiograph)
    return Shots(list(by_name.values()), tuple(by_name), first.image.shape), first.setup


def _fit_stack(
    stack_shots: Shots,
    inputs: Inputs,
    sources: Any,
    recipe: Recipe,
    variables: Collection[str] | None,
    warm_start: int,
    reader: str,
) -> FitStack:
    check_fit(recipe)
    choices = recipe.fit or FitChoices()
    if warm_start > 1:
        raise InputError(f"warm_start is {warm_start}: fits start on their own; leave it out")
    if choices.fields is not None and len(choices.fields) > 1:
        raise InputError(
            f"the recipe fits the fields {', '.join(choices.fields)}, and a store holds one: fit "
            "one field, or each shot alone with shadowinv fit"
        )
    shot_sources = sources if isinstance(sources, Shots) else None
    image = None if sources is None or shot_sources is not None else np.asarray(sources, np.float64)
    # An estimate or a list of sources gives each shot its own beam.
    per_shot = shot_sources is not None or inputs.recipe.estimate not in (None, UniformEstimate())
    beam = None if per_shot else Beam.of(stack_shots.shape, image, None)
    stack = FitStack(stack_shots, inputs, beam, shot_sources, (), 1, reader, fit_recipe=recipe)
    labels = stack.labels
    if choices.options.samples < 2:
        labels.pop("displacement_uncertainty")
    for name in variables or ():
        if name not in labels:
            raise InputError(
                f"there is no variable {name!r} of a fit: expected one or more of "
                f"{', '.join(labels)}"
            )
    defaults = tuple(name for name in FITTED if name in labels)
    return replace(stack, variables=tuple(variables or defaults))


def _shared_beam(inputs: Inputs, sources: Any) -> Beam | None:
    """Return the common source after all steps, and mask; None if each shot has its own source."""
    moved = inputs.recipe.move(inputs.shot)
    if isinstance(inputs.recipe.source, UniformEstimate):
        return Beam.of(moved.shape, None, moved.mask)
    if sources is None or isinstance(sources, Shots):
        return None
    beam = np.asarray(sources, np.float64)
    ready = inputs.recipe.prepare(replace(inputs.shot, image=beam, source=beam))
    assert ready.source is not None
    checked_source(ready.source, ready.mask)
    return Beam.of(ready.shape, ready.source, ready.mask)


def _checked_variables(
    names: Collection[str] | None, recipe: Recipe, *, ragged: bool
) -> tuple[str, ...]:
    """Return the variables of a stack; shots may differ in their number of sites if `ragged`."""
    labels = variable_labels(recipe.setup)
    # The number depends on the masked area, or on the flux of the source in the margin.
    available = tuple(name for name, (dims, _) in labels.items() if not (ragged and "site" in dims))
    for name in names or ():
        if name in available:
            continue
        hint = " (it needs a setup)" if recipe.setup is None else ""
        if name in labels:
            hint = (
                " (sites differ between shots with one source per shot and a free boundary or no "
                "given number of sites, or with masks of their own)"
            )
        raise InputError(
            f"there is no variable {name!r}{hint}: expected one or more of {', '.join(available)}"
        )
    return available if names is None else tuple(names)


def coordinates_of(stack: Stack) -> dict[str, Any]:
    is_table = isinstance(stack, TableStack)
    # Where setups differ, so may the pixels' size.
    plane = dataset_from_field(np.zeros((2, *stack.shape)), None, None if is_table else stack.setup)
    shots = stack.shots
    numbers = np.arange(len(shots)) if shots.coordinate is None else shots.coordinate
    coords: dict[str, Any] = {str(name): value for name, value in plane.coords.items()}
    coords["shot"] = ("shot", numbers, {"long_name": "Shot"})
    coords["name"] = ("shot", np.array(shots.names, dtype=str), {"long_name": "Name of the shot"})
    return coords


def attributes_of(stack: Stack) -> dict[str, str]:
    attributes = dataset_from_field(np.zeros((2, 4, 4)), None, stack.setup).attrs
    kind = "fit" if isinstance(stack, FitStack) else "inversion"
    provenance = stack.inputs.provenance.model_copy(update={"setup": stack.setup, "kind": kind})
    return {
        "format": FORMAT,
        **attributes,
        "options": stack.recipe.options.model_dump_json(),
        "provenance": provenance.to_json(),
        **({"fields": json.dumps([stack.fitted_field])} if isinstance(stack, FitStack) else {}),
    }


def values_of_beam(beam: Beam, options: InversionOptions) -> dict[str, Any]:
    """Return the variables that all shots share, by name; also a task of dask."""
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
    """Return the type of a variable in an inversion."""
    return np.dtype(bool) if name in ("caustic", "mask") else np.dtype(np.float64)
