"""A stack as a lazy dataset: one dask task inverts one shot, on demand."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import numpy as np

from napari_shadowinv._system.validation import check_instance
from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion.variables import SETUPS_LABEL
from napari_shadowinv.io.store import with_places
from napari_shadowinv.io.store_columns import INVERSIONS, column_values, columns_of
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.stack._plan import (
    Stack,
    describe_results,
    describe_stack,
    dtype_of,
)
from napari_shadowinv.stack._shots import FILES, ArrayExposure, Exposure, Reader
from napari_shadowinv.stack._worker import AnyTask

if TYPE_CHECKING:
    import xarray


def invert_stack(
    shots: Any,
    recipe: Recipe | None = None,
    *,
    variables: Collection[str] | None = None,
    reader: Reader = FILES,
) -> xarray.Dataset:
    """Describe the inversion of many shots, which dask computes on demand.

    The values do not depend on scheduler, chunks, order or number of workers.

    Parameters
    ----------
    shots : array (shot, y, x), xarray.DataArray or Dataset, path or paths, or Shot
        A dask or numpy array; an xarray object with one such variable; paths of one image each;
        a glob such as ``"shots/*.tif"``, sorted so that 2 comes before 10; a TIFF with a page for
        each shot; or a table (CSV) with a row for each shot, which may have its own energy, setup,
        brightness, mask and source. Files are read by the tasks that invert them. A `Shot` with
        one of these as its image has the setup, the mask and the source mask of all shots, and
        their source: one for all, or as many as shots.
    recipe : Recipe, optional
        Steps of each shot and of a measured source, setup and options. Without a source,
        intensities in the result are relative to each shot's mean. Without `threads` in the
        options, shots that are inverted simultaneously share the cores.
    variables : collection of str, optional
        Variables to compute. Default: all.
    reader : callable, optional
        Returns the image of a path. Default: files are read by their format;
        `napari_shadowinv.stack.FileReader` with ``channel="red"`` reads one of their colours.

    Returns
    -------
    xarray.Dataset
        The variables of `Inversion.to_dataset` with a first dimension ``shot``, each shot a
        chunk, and ``converged``, ``flux_residual``, ``image_residual``, ``noise_error``,
        ``discretisation_error`` and ``iterations``. Nothing is computed yet. Sites are omitted
        where shots may differ in their number: without `InversionOptions.n_sites`, with a free
        boundary, or with masks of their own. For a table, ``setup`` contains the setup of each
        shot as JSON.

    Raises
    ------
    InputError
        If there are no shots, or source, mask and shots do not fit together. A shot that cannot
        be inverted raises it when it is computed; `run_stack` continues without it.
    FileFormatError
        If the source, or all of the first shots, cannot be read.

    Examples
    --------
    >>> import numpy as np
    >>> from napari_shadowinv import InversionOptions
    >>> shots = np.ones((3, 20, 20))
    >>> stack = invert_stack(shots, Recipe(options=InversionOptions(n_sites=50)))
    >>> dict(stack.potential.sizes)
    {'shot': 3, 'y': 20, 'x': 20}
    >>> float(abs(stack.displacement.isel(shot=1)).max())
    0.0
    """
    check_instance(recipe, Recipe, "recipe")
    if recipe is not None and recipe.fit is not None:
        raise InputError(
            "the recipe has a section fit, and invert_stack inverts: use run_stack to fit, or "
            "leave the section out"
        )
    stack = describe_stack(shots, recipe, reader, variables)
    return _lazy_dataset(stack)


def _invert(label: str, shot: Exposure, block: AnyArray | None, task: AnyTask) -> dict[str, Any]:
    """Invert one shot, and return its variables."""
    try:
        images, _ = (shot if block is None else ArrayExposure("", block)).load()
        source = None if shot.source is None else shot.source.read()[0]
        inversion = task.run(images, source)
    except InputError as error:
        raise error.about(label) from error
    return {**task.arrays(inversion), **column_values(INVERSIONS, inversion)}


def _pick(record: dict[str, Any], name: str) -> AnyArray:
    return np.asarray(record[name])[np.newaxis]


def _lazy_records(stack: Stack) -> tuple[Any, str]:
    """Return an array of each shot's variables as a dictionary, a task for each, and its token."""
    from dask.delayed import delayed
    from dask.highlevelgraph import HighLevelGraph

    da: Any = import_module("dask.array")
    shots = stack.shots
    token = uuid4().hex  # not by content: of a changed file, dask must not reuse the result
    name = f"invert-shot-{token}"
    task = delayed(stack.task, name=f"task-{token}", traverse=False)
    lazy = [item for item in shots.items if isinstance(item, ArrayExposure) and item.is_lazy]
    arrays = {item.array.name: item.array for item in lazy}
    dependencies = [*arrays.values(), task]
    tasks: dict[Any, Any] = {}
    for index, item in enumerate(shots.items):
        shot, block = item, None
        if isinstance(item, ArrayExposure) and item.is_lazy:
            block = (item.array.name, item.index, 0, 0)
            shot = Exposure(item.name, source=item.source)
        tasks[name, index] = (_invert, shots.label(index), shot, block, task.key)
    graph = HighLevelGraph.from_collections(name, tasks, dependencies=dependencies)
    return da.Array(graph, name, ((1,) * len(shots),), dtype=object), token


def _lazy_dataset(stack: Stack) -> xarray.Dataset:
    """Return the dataset of a stack, with a task for each variable of each shot."""
    da: Any = import_module("dask.array")
    records, token = _lazy_records(stack)

    def of_each_shot(name: str, shape: tuple[int, ...], dtype: Any = None) -> Any:
        return records.map_blocks(
            partial(_pick, name=name),
            name=f"{name}-{token}",
            chunks=(*records.chunks, *((length,) for length in shape[1:])),
            new_axis=list(range(1, len(shape))),
            meta=np.empty((0,) * len(shape), dtype or dtype_of(name)),
        )

    dataset = describe_results(stack, of_each_shot)
    variables: dict[str, Any] = {}
    setups = stack.setups
    if setups is not None:
        variables["setup"] = (("shot",), da.from_array(np.array(setups, "O"), 1), SETUPS_LABEL)
    for column in columns_of(INVERSIONS):
        if column.value is not None:
            values = of_each_shot(column.key, (len(stack.shots),), column.kind)
            variables[column.key] = (("shot",), values, column.labels)
    if not stack.task.by_row:
        variables |= stack.task.masks
    dataset = dataset.assign(variables)
    return dataset if setups is None else with_places(dataset)
