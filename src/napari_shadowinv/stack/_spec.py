"""What is known about a stack before any shot is inverted: `describe_stack` gives a `Stack`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import count_sites
from napari_shadowinv.inversion.labels import dataset_from_field, variable_labels
from napari_shadowinv.inversion.normalise import checked_mask, checked_source
from napari_shadowinv.io.files import text_of
from napari_shadowinv.io.store import FORMAT
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.pipeline import Inputs, gathered
from napari_shadowinv.preprocessing import (
    Estimate,
    MeasuredSource,
    Origin,
    Radiograph,
    Recipe,
    Step,
    UniformEstimate,
)
from napari_shadowinv.stack._discovery import Shots, find_shots, find_source
from napari_shadowinv.stack._references import Reader, Shot, described_reader
from napari_shadowinv.stack._worker import Beam, Work, shared_plan, threads_here

if TYPE_CHECKING:
    from napari_shadowinv.physics.setup import Setup


@dataclass(frozen=True, eq=False)
class Stack:
    """Everything about a stack that is known before any shot is inverted."""

    shots: Shots
    inputs: Inputs  # recipe, masks, and where they came from
    beam: Beam | None  # source, after all steps, and mask of all shots; None if each has its own
    sources: Shots | None  # one for each shot, if these were measured
    variables: tuple[str, ...]
    warm_start: int = 1  # shots in a group, each initialised from the one before
    reader: str = ""  # name of what reads the files

    @property
    def recipe(self) -> Recipe:
        return self.inputs.recipe

    @cached_property
    def moved(self) -> Radiograph:
        """Masks and setup after the steps that move pixels; its image means nothing."""
        return self.recipe.moved(self.inputs.shot)

    @property
    def shape(self) -> tuple[int, int]:
        return self.moved.shape

    @property
    def setup(self) -> Setup | None:
        return self.moved.setup

    @cached_property
    def sizes(self) -> dict[str, int]:
        height, width = self.shape
        # Where each shot has its own, there are sites only if they do not depend on it.
        beam = self.beam or Beam.of(self.shape, None, self.moved.mask)
        sites = count_sites(beam.image, self.recipe.options, mask=beam.mask)
        return {"shot": len(self.shots), "y": height, "x": width, "component": 2, "site": sites}

    def is_shared(self, name: str) -> bool:
        """Whether all shots have one such variable together."""
        return (
            self.beam is not None
            and name in ("sites", "site_mass", "source", "mask")
            and not (name == "source" and self.beam.source is None)
        )

    def source_of(self, index: int) -> Shot | None:
        """Reference to the measured source of one shot; None if it is shared, or estimated."""
        return None if self.sources is None else self.sources.items[index]

    def chosen(self, order: Sequence[int]) -> Stack:
        """Return the stack with its shots, and their sources, in another order."""
        sources = None if self.sources is None else self.sources.chosen(order)
        return replace(self, shots=self.shots.chosen(order), sources=sources)

    def work(self, variables: tuple[str, ...]) -> Work:
        """Return what the task of each shot needs to know to make some variables."""
        return Work(self.shots.shape, self.inputs, variables)

    def changed(self, index: int, origin: dict[str, Any]) -> str:
        """Name what of a shot is not what its report says; empty if nothing."""
        if not self.shots.items[index].unchanged(origin):
            return self.shots.label(index)
        if self.sources is not None and not self.sources.items[index].unchanged(origin["source"]):
            return f"the source of {self.shots.label(index)}"
        return ""


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
    measured = wanted.source if isinstance(wanted.source, MeasuredSource) else MeasuredSource()
    source = measured.file if source is None else source
    source_reader = reader
    if measured.variable is not None:
        source_reader = partial(reader, variable=measured.variable)
    sources = find_source(source, reader=source_reader)
    if sources is None and isinstance(wanted.source, MeasuredSource):
        raise InputError(
            "the recipe asks for a measured source, but names no file: name one, or give a source"
        )
    # Where the source tells it, no shot needs to be read for its shape.
    shape = (() if mask is None else np.shape(mask)) if sources is None else sources.shape
    known = (shape[0], shape[1]) if len(shape) == 2 else None
    found = find_shots(shots, reader=reader, shape=known)
    if sources is not None and sources.shape != found.shape:
        raise InputError(f"source has shape {sources.shape}, shots {found.shape}: they must match")
    usable = None if mask is None else checked_mask(mask, found.shape)
    bare = None if source_mask is None else checked_mask(source_mask, found.shape)
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
    inputs = replace(inputs, shot=replace(inputs.shot, source=None))
    beam = _shared_beam(inputs, sources)
    own = sources if isinstance(sources, Shots) else None
    if own is not None and len(own) != len(found):
        raise InputError(
            f"got {len(own)} sources for {len(found)} shots: expected one, or one for each shot"
        )
    if beam is None and warm_start > 1:
        raise InputError(
            f"warm_start is {warm_start} and each shot has its own source: the previous solution "
            "belongs to different sites; leave warm_start out, or give one source for all shots"
        )
    chosen = _checked_variables(variables, inputs.recipe, own_sources=beam is None)
    return Stack(found, inputs, beam, own, chosen, warm_start, described_reader(reader))


def _recipe(
    recipe: Recipe | None,
    options: InversionOptions | None,
    setup: Setup | None,
    filters: Sequence[Step],
) -> Recipe:
    """The recipe that was given, or that the other keywords make up."""
    if recipe is None:
        return Recipe(steps=tuple(filters), setup=setup, options=options or InversionOptions())
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
    ready = inputs.recipe.prepared(replace(inputs.shot, image=np.asarray(sources, np.float64)))
    checked_source(ready.image, ready.mask)
    return Beam.of(ready.shape, ready.image, ready.mask)


def _checked_variables(
    wanted: Collection[str] | None, recipe: Recipe, *, own_sources: bool
) -> tuple[str, ...]:
    """Names of the variables that a stack shall have."""
    labels = variable_labels(recipe.setup)
    # As many sites then as the source shines into the margin: shots would differ.
    ragged = own_sources and recipe.options.boundary == "free"
    known = tuple(name for name, (dims, _) in labels.items() if not (ragged and "site" in dims))
    for name in wanted or ():
        if name in known:
            continue
        hint = " (it needs a setup)" if recipe.setup is None else ""
        if name in labels:
            hint = " (sites differ between shots with a free boundary and one source per shot)"
        raise InputError(
            f"there is no variable {name!r}{hint}: expected one or more of {', '.join(known)}"
        )
    return known if wanted is None else tuple(wanted)


def coordinates_of(stack: Stack) -> dict[str, Any]:
    plane = dataset_from_field(np.zeros((2, *stack.shape)), None, stack.setup)
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
