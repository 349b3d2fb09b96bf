"""Plan of a stack before any shot is inverted: `describe_stack` returns a `Stack`."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import check_instance, map_paths
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.normalise import bytes_per_pixel, check_source
from napari_shadowinv.inversion.variables import dataset_from_field, variable_labels
from napari_shadowinv.io.files import sha256, split_address
from napari_shadowinv.io.store import FORMAT
from napari_shadowinv.physics.arrays import (
    check_shape,
    check_spacing,
    checksum,
    join_masks,
    unpack_array,
)
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline.inversion_run import Inputs, collect_inputs
from napari_shadowinv.pipeline.run_options import RunOptions, WatchOptions
from napari_shadowinv.pipeline.shot_table import ShotRow, is_table
from napari_shadowinv.preprocessing import Estimate, MeasuredSource, Recipe, UniformEstimate
from napari_shadowinv.provenance import index_masks
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack._shots import (
    FileReader,
    Reader,
    RowExposure,
    Shots,
    find_shots,
    find_source,
    table_shots,
    usual_shape,
)
from napari_shadowinv.stack._worker import (
    Task,
)

if TYPE_CHECKING:
    import xarray

# Variables that are stored by default.
STORED = ("potential", "displacement", "caustic", "mask")


@dataclass(frozen=True, eq=False)
class Stack:
    """Plan of a stack: its shots, and the task of each with everything that they share."""

    shots: Shots
    task: Task
    reader: str  # name of the reader of the files
    dtype: str  # of fields in the store

    @property
    def source_text(self) -> str:
        """A text by which a store is not continued with another source."""
        estimate, source = self.task.requested.estimate, self.task.inputs.shot.source
        if source is not None:
            return f"sha256 {checksum(source)}"
        if estimate not in (None, UniformEstimate()):
            return f"estimated from each shot: {estimate.model_dump_json()}"
        return "uniform"


def describe_stack(
    shots: Any, recipe: Recipe | None, reader: Reader, options: RunOptions | WatchOptions
) -> Stack:
    """Describe a stack, and check everything that can be checked before a shot is read."""
    check_instance(recipe, Recipe, "recipe")
    common = shots if isinstance(shots, Shot) else Shot(shots)
    of_one = ("dark", "strength", "brightness", "psf", "noise", "fiducials", "start")
    if needless := [name for name in of_one if getattr(common, name) is not None]:
        raise InputError(
            f"the shot of a stack has {', '.join(needless)}, expected its source, masks and setup: "
            "describe the shots in a table"
        )
    if isinstance(common.source, (Estimate, Shot)) or common.beam_unknown:
        raise InputError(
            f"the source of the shots is {common.source!r:.60}: expected an image or a file; "
            "choose an estimate in the recipe"
        )
    resolved = map_paths(recipe or Recipe(), Path.absolute)  # for workers elsewhere
    if common.setup is not None:
        resolved = resolved.model_copy(update={"setup": common.setup})
    files = FileReader.of(reader)
    stack_shots, inputs = _describe_inputs(common, resolved, files)
    task = _plan_inversion(stack_shots, inputs, resolved, options.variables or STORED)
    return Stack(stack_shots, task, files.name, options.dtype)


def _plan_inversion(
    shots: Shots, inputs: Inputs, recipe: Recipe, variables: Collection[str]
) -> Task:
    if inputs.shot.source is not None:
        ready = inputs.recipe.prepare(replace(inputs.shot, image=inputs.shot.source))
        assert ready.source is not None
        check_source(ready.source, ready.mask)
    rows = [shot.row for shot in shots.items if isinstance(shot, RowExposure)]
    own_masks = any(row.mask is not None for row in rows)
    _check_variables(variables, inputs.recipe, own_masks=own_masks)
    if rows:  # each shot has the common masks, too
        unmasked = index_masks(inputs.provenance.images, [(None, None)])
        inputs = replace(inputs, provenance=inputs.provenance.model_copy(update=unmasked))
    return Task(inputs=inputs, variables=tuple(variables), requested=recipe, by_row=bool(rows))


def _describe_inputs(common: Shot, recipe: Recipe, reader: FileReader) -> tuple[Shots, Inputs]:
    """Return the shots, and all that they share."""
    shots = common.image
    measured = recipe.source if isinstance(recipe.source, MeasuredSource) else MeasuredSource()
    recorded = measured.file if common.source is None else common.source
    if getattr(recorded, "ndim", None) == 2:
        recorded = unpack_array(recorded, "source")
    # The reader's array is that of the shots.
    source = find_source(recorded, replace(reader, variable=measured.variable))
    if source is None and isinstance(recipe.source, MeasuredSource):
        raise InputError(
            "the recipe asks for a measured source, but names no file: name one, or give a source"
        )
    mask = unpack_array(common.mask, "mask")
    # With a source, no shot needs to be read for its shape.
    shape = (() if mask is None else np.shape(mask)) if source is None else source.shape
    image_shape = (shape[0], shape[1]) if len(shape) == 2 else None
    table = _find_table(shots)
    if table is not None:
        stack_shots, first = _describe_table(table, recipe, reader, image_shape)
        recipe = recipe.model_copy(update={"setup": first})
    else:
        stack_shots = find_shots(shots, reader, image_shape)
    if source is not None:
        check_shape("source", source.shape, stack_shots.shape, "shots")
    mask = join_masks(mask, stack_shots.mask)
    if recipe.setup is not None:
        check_spacing(shots, "shots", recipe.setup.pixel_sizes)
    if not recipe.steps:
        check_memory(stack_shots.shape, bytes_per_pixel(recipe.options), "an inversion")
    blank = np.ones(stack_shots.shape)
    beam = None if source is None else Shot(source)
    if beam is not None and isinstance(recorded, (str, Path)):
        path, variable = split_address(recorded, measured.variable)
        digest = sha256(path) if path.is_file() else ""  # else a pattern of the file
        beam = replace(beam, path=path, metadata={"sha256": digest, "variable": variable})
    inputs = collect_inputs(
        recipe.model_copy(update={"source": recipe.estimate}),
        Shot(blank, source=beam, mask=mask, source_mask=common.source_mask),
    )
    inputs.recipe.check(inputs.shot)
    if inputs.recipe.estimate is not None:
        # It refuses a wrong setup.
        inputs.recipe.estimate.adapt_to(inputs.recipe.setup, stack_shots.shape)
    return stack_shots, inputs


def _find_table(shots: Any) -> Path | Sequence[ShotRow] | None:
    """Return the table of the shots, or its rows; None if they are no table."""
    if isinstance(shots, Sequence) and shots and all(isinstance(row, ShotRow) for row in shots):
        return shots
    single = shots[0] if isinstance(shots, (list, tuple)) and len(shots) == 1 else shots
    is_file = isinstance(single, (str, Path)) and os.path.isfile(single)
    return Path(single) if is_file and is_table(Path(single)) else None


def _describe_table(
    table: Path | Sequence[ShotRow],
    recipe: Recipe,
    reader: FileReader,
    shape: tuple[int, int] | None,
) -> tuple[Shots, Setup | None]:
    """Return the shots of a table, and the setup of the first image."""
    if reader.function is not None or reader.variable is not None:
        raise InputError(
            f"received a reader for the table {table}, which names files and their arrays: leave "
            "the reader out"
        )
    items = table_shots(table, recipe, reader.channel)
    return Shots(items, shape or usual_shape(items)), items[0].setup


def _check_variables(names: Collection[str], recipe: Recipe, *, own_masks: bool) -> None:
    """Refuse variables that no stack has; shots may differ in their number of sites."""
    labels, options = variable_labels(recipe.setup), recipe.options
    # The number depends on the masked area, or on the flux of the source in the margin.
    ragged = own_masks or options.n_sites is None or options.boundary == "free"
    available = tuple(name for name, (dims, _) in labels.items() if not (ragged and "site" in dims))
    for name in names:
        if name in available:
            continue
        hint = " (it needs a setup)" if recipe.setup is None else ""
        if name in labels:
            hint = (
                " (shots may differ in their number of sites, unless it is stated, "
                "the boundary is closed and no shot has its own mask)"
            )
        raise InputError(
            f"there is no variable {name!r}{hint}: expected one or more of {', '.join(available)}"
        )


def empty_results(stack: Stack) -> xarray.Dataset:
    """Return the dataset of a stack as its store has it, without a shot."""
    import xarray as xr

    task, text = stack.task, np.dtypes.StringDType()
    height, width = task.shape
    sizes = {"shot": 0, "y": height, "x": width, "component": 2}
    sizes["site"] = task.recipe.options.n_sites or 0
    for dims, *_ in task.masks.values():
        sizes |= zip(dims[-2:], task.inputs.shot.shape, strict=True)
    variables: dict[str, Any] = {}
    for name, (of_one, labels) in task.labels.items():
        if name in task.variables:
            dims = ("shot", *of_one)
            fields = np.float64 if "site" in of_one else stack.dtype
            dtype = bool if name in ("caustic", "mask") else fields
            variables[name] = dims, np.empty([sizes[dim] for dim in dims], dtype), labels
    for name, (dims, pixels, labels) in task.masks.items():
        none = np.empty([sizes[dim] for dim in dims], bool)
        variables[name] = dims, none if pixels is None else pixels, labels
    # Where setups differ, so may the pixels' size.
    setup = None if task.by_row else task.setup
    plane = dataset_from_field(np.zeros((2, *task.shape)), None, setup)
    coords: dict[Any, Any] = dict(plane.coords)
    coords["component"] = coords["component"].astype(text)
    coords["shot"] = xr.Variable("shot", np.empty(0, np.int64), {"long_name": "Shot"})
    coords["name"] = xr.Variable("shot", np.empty(0, text), {"long_name": "Name of the shot"})
    attributes = dataset_from_field(np.zeros((2, 4, 4)), None, task.setup).attrs
    return xr.Dataset(variables, coords, {"format": FORMAT, **attributes, **task.attributes})
