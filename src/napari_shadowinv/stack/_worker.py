"""Work on one shot: `Task`.

- a shot inverted and written to the store: `run_shot`
"""

from __future__ import annotations

import dataclasses
import json
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion import Inversion, plan_sites
from napari_shadowinv.inversion.variables import variable_labels
from napari_shadowinv.io.store import DONE, FAILED
from napari_shadowinv.io.store_columns import column_values
from napari_shadowinv.io.store_writing import ShotWriter
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.arrays import checksum, join_masks
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline.inversion_run import Cache, Inputs, collect_inputs, run_prepared
from napari_shadowinv.preprocessing import Recipe, UniformEstimate
from napari_shadowinv.provenance import MaskVariable, mask_variables
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack._shots import ArrayExposure, Exposure, failure_text
from napari_shadowinv.transport.sites import SitePlan

_MAX_PLANS = 2  # a worker that changes between two sources makes each once


@dataclass
class _SharedPlan:
    """A plan, complete or in preparation."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    plan: SitePlan | None = None


_entries: OrderedDict[str, _SharedPlan] = OrderedDict()
_entries_lock = threading.Lock()


class SharedSites(Cache):
    """Sites that all shots of this process with the same source share; the first computes them."""

    def plan(
        self,
        source: FloatArray,
        mask: BoolArray | None,
        options: InversionOptions,
        on_progress: OnProgress | None = None,
        should_stop: ShouldStop | None = None,
        *,
        measured: bool = True,
    ) -> SitePlan:
        hidden = "" if mask is None else checksum(mask)
        key = f"{checksum(source)}|{hidden}|{options.site_key()}{measured}"
        with _entries_lock:
            entry = _entries.setdefault(key, _SharedPlan())
            _entries.move_to_end(key)
            while len(_entries) > _MAX_PLANS:
                _entries.popitem(last=False)
        with entry.lock:
            if entry.plan is None:
                entry.plan = plan_sites(
                    source, options, mask=mask, measured=measured, should_stop=should_stop
                )
            return entry.plan


@dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """Inversion of each shot of a stack, and the description of its results."""

    inputs: Inputs  # recipe, source and masks of all shots; the image only has their shape
    variables: tuple[str, ...]  # of a result
    requested: Recipe  # without the setups of a table's rows, which come with the images
    by_row: bool = False  # whether shots are rows with their own setups, sources and masks

    @property
    def recipe(self) -> Recipe:
        return self.inputs.recipe

    @cached_property
    def moved(self) -> Shot:
        """Masks and setup after the steps that move pixels; its image means nothing."""
        return self.recipe.move(replace(self.inputs.shot, source=None))

    @property
    def shape(self) -> tuple[int, int]:
        return self.moved.shape

    @property
    def setup(self) -> Setup | None:
        return self.moved.setup

    @property
    def labels(self) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
        """Dimensions and labels of all variables that the results can have."""
        return variable_labels(self.setup)

    @property
    def masks(self) -> dict[str, MaskVariable]:
        """The masks of the images as variables of all shots; each row of a table has its own."""
        if self.by_row:
            return mask_variables([None, None], "shot")
        return self.inputs.provenance.mask_variables

    @property
    def attributes(self) -> dict[str, str]:
        """Attributes of a dataset of the results."""
        provenance = self.inputs.provenance
        provenance = provenance.model_copy(update={"setup": self.setup})
        options = self.recipe.options.model_dump_json()
        return {"options": options, "provenance": provenance.to_json()}

    def completed(self, shot: Shot) -> Shot:
        """Return a shot with the masks of all shots, and its own source or that of all.

        A mask's file precedes the masks of all, by the rule of `collect_inputs`.
        """
        common = self.inputs.shot
        is_file = isinstance(shot.mask, Path)
        return replace(
            shot,
            image=np.asarray(shot.image, dtype=np.float64),
            source=common.source if shot.source is None else shot.source,
            mask=shot.mask if is_file else join_masks(common.mask, shot.mask),
            source_mask=join_masks(common.source_mask, shot.source_mask),
        )

    def arrays(self, result: Inversion) -> dict[str, AnyArray]:
        """Return the variables by name, and the masks."""
        dataset = result.to_dataset()
        names = (*self.variables, *self.masks)
        return {name: dataset[name].values for name in names if name in dataset}

    def run(self, image: Shot, workers: int | None, should_stop: ShouldStop | None) -> Inversion:
        """Apply the recipe to a shot as recorded."""
        common = self.inputs.shot
        if np.shape(image.image) != common.shape:
            reference = "the others" if common.source is None else "the source"
            raise InputError(
                f"image has shape {np.shape(image.image)}, expected {common.shape} as {reference}"
            )
        if self.by_row:
            self._check_kind(image.setup)
        # Doubts about the file are in the report of the shot.
        shot = self.completed(replace(image, cautions=()))
        setup = image.setup if self.by_row else self.requested.setup
        # Without masks: the shot has those of all.
        cleared = {"source": self.requested.estimate, "mask": None, "source_mask": None}
        recipe = self.requested.model_copy(update={**cleared, "setup": setup})
        inputs = collect_inputs(recipe, shot)
        if shot.source is common.source:
            origin = self.inputs.provenance.image.source
            inputs = replace(inputs, provenance=inputs.provenance.with_image(source=origin))
        inputs.recipe.check(inputs.shot)
        ready = inputs.recipe.prepare(inputs.shot, should_stop)
        if isinstance(inputs.recipe.source, UniformEstimate):
            # The same for all shots, so that they share their sites.
            relative = _divide_by_mean(ready.image, ready.mask)
            ready = replace(ready, image=relative, source=np.ones(ready.shape))
        options = self.recipe.options
        if options.threads is None:
            options = options.model_copy(update={"threads": threads_here(workers)})
        inputs = replace(inputs, recipe=inputs.recipe.model_copy(update={"options": options}))
        return run_prepared(inputs, ready, cache=SharedSites(), should_stop=should_stop)

    def _check_kind(self, setup: Setup | None) -> None:
        kinds = [each and each.kind for each in (setup, self.recipe.setup)]
        if kinds[0] != kinds[1]:
            texts = [f"a setup of kind '{kind}'" if kind else "no setup" for kind in kinds]
            raise InputError(
                f"it has {texts[0]}, and the first row of its table {texts[1]}: a store has the "
                "units of one kind of setup; give all rows such a setup, or use two tables"
            )

    def report(self, result: Inversion) -> dict[str, Any]:
        """Return the report of a shot, with its own provenance if it is a row of a table."""
        headline, field = result.headline, result.main_field
        entries = {
            **dataclasses.asdict(result.report),
            "errors": None if result.errors is None else result.errors.to_dict(),
            "stages": result.report.seconds,
            "headline": str(headline),
            "level": headline.level.value,
            "peak": {"symbol": field.symbol, "value": field.largest, "unit": field.unit},
            **column_values(result, own_setup=self.by_row),
        }
        if self.by_row:
            assert result.provenance is not None
            entries["provenance"] = json.loads(result.provenance.to_json())
        return entries


def _divide_by_mean(image: AnyArray, mask: BoolArray | None) -> AnyArray:
    """Divide by the mean, because a uniform beam that all shots share is 1 everywhere."""
    values = np.asarray(image, dtype=np.float64)
    used = values if mask is None else values[mask]
    # An invalid image is left unchanged: the error should refer to the original.
    if not np.isfinite(used).all():
        return values
    mean = float(np.maximum(used, 0).mean())
    return values / mean if mean > 0 else values


def threads_here(workers: int | None) -> int:
    """Return the number of threads of a shot; `workers` are at work on its machine, if known."""
    return max(1, available_threads(None) // workers) if workers else 1


@dataclass(frozen=True)
class ShotOutcome:
    """Outcome of one shot."""

    index: int
    status: int  # DONE or FAILED of `napari_shadowinv.io.store`
    seconds: float  # that its worker spent on it, reading and writing included
    report: dict[str, Any]  # as in the store: of a failure its reason, else headline and numbers

    @property
    def reason(self) -> str:
        """Why it failed; empty if it did not."""
        return str(self.report.get("reason", ""))


@dataclass(frozen=True)
class TaskContext:
    """Context that the tasks of all shots share."""

    writer: ShotWriter
    task: Task
    workers: int | None


def run_shot(
    shot: Exposure,
    index: int,
    should_stop: ShouldStop | None,
    context: TaskContext,
    block: AnyArray | None = None,
) -> ShotOutcome:
    """Task: load a shot, invert it, and write it; what goes wrong with it is its outcome.

    A shot is replaced by its block of a dask array if a cluster has computed that already.
    """
    if block is not None:
        shot = ArrayExposure(shot.name, block)
    task, began = context.task, time.perf_counter()
    result: Inversion | None = None
    origin: dict[str, Any] = {}
    entries: dict[str, Any] = {}
    try:
        origin = shot.stamp()
        image, loaded = shot.load()
        origin |= loaded
        result = task.run(image, context.workers, should_stop)
        entries = task.report(result)
    except InversionCancelled:
        raise
    except Exception as error:
        # No error of a reader or a solver may stop the other shots.
        entries = {"reason": failure_text(error)}
    cautions = () if result is None else result.cautions
    warnings = list(map(dataclasses.asdict, (*cautions, *origin.pop("cautions", ()))))
    seconds = time.perf_counter() - began
    report = {**entries, "seconds": seconds, **origin, "warnings": warnings}
    status = FAILED if result is None else DONE
    context.writer.write(index, {} if result is None else task.arrays(result), report, status)
    return ShotOutcome(index, status, time.perf_counter() - began, report)


def write_failure(writer: ShotWriter, index: int, reason: str) -> ShotOutcome:
    """Write a shot that could not be begun."""
    report = {"reason": reason}
    writer.write(index, {}, report, FAILED)
    return ShotOutcome(index, FAILED, 0.0, report)
