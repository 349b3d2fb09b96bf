"""Tasks of a worker: `InvertTask` inverts one shot, `FitTask` fits one.

- a shot inverted and written to the store: `run_shot`
- its first part: `try_shot`
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import multiprocessing
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from napari_shadowinv._system.arrays import checksum, join_masks
from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion, plan_sites
from napari_shadowinv.inversion.variables import dataset_from_field, fit_labels, variable_labels
from napari_shadowinv.io.store import DONE, FAILED
from napari_shadowinv.io.store_columns import FITS, INVERSIONS, ROWS, column_values
from napari_shadowinv.io.store_writing import ShotWriter
from napari_shadowinv.options import FitChoices, InversionOptions
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline import Cache, Inputs, collect_inputs, run_fit, run_prepared
from napari_shadowinv.pipeline.fit_run import usual_fields
from napari_shadowinv.pipeline.inversion_run import same_array
from napari_shadowinv.preprocessing import Estimate, Recipe, UniformEstimate
from napari_shadowinv.provenance import MaskVariable, mask_variables
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack._shots import ArrayExposure, Exposure, failure_text
from napari_shadowinv.transport.sites import SitePlan

_MAX_PLANS = 2  # a worker that changes between two sources makes each once


@dataclass(frozen=True, eq=False)
class Beam:
    """The undisturbed beam and the mask of one or more shots."""

    shape: tuple[int, int]
    source: AnyArray | None = field(default=None, repr=False)
    mask: BoolArray | None = field(default=None, repr=False)

    @property
    def image(self) -> AnyArray:
        """The source; ones for a uniform beam."""
        return np.ones(self.shape) if self.source is None else self.source

    @cached_property
    def key(self) -> str:
        """Checksum of the fields."""
        parts = ["" if array is None else checksum(array) for array in (self.source, self.mask)]
        return hashlib.sha256(f"{self.shape}{parts[0]}|{parts[1]}".encode()).hexdigest()


@dataclass
class _SharedPlan:
    """A plan, complete or in preparation."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    plan: SitePlan | None = None


_entries: OrderedDict[str, _SharedPlan] = OrderedDict()
_entries_lock = threading.Lock()


def shared_plan(
    beam: Beam,
    options: InversionOptions,
    *,
    measured: bool = True,
    should_stop: ShouldStop | None = None,
) -> SitePlan:
    """Return the sites for a beam; the first call in this process computes them."""
    key = f"{beam.key}{options.site_key()}{measured}"
    with _entries_lock:
        entry = _entries.setdefault(key, _SharedPlan())
        _entries.move_to_end(key)
        while len(_entries) > _MAX_PLANS:
            _entries.popitem(last=False)
    with entry.lock:
        if entry.plan is None:
            entry.plan = plan_sites(
                beam.image, options, mask=beam.mask, measured=measured, should_stop=should_stop
            )
        return entry.plan


@dataclass
class _SharedSites(Cache):
    """Sites that all shots of a process share, where they share their beam."""

    beam: Beam | None = None

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
        beam = self.beam
        if beam is None or not same_array(mask, beam.mask):
            beam = Beam(source.shape, source, mask)  # the shot has unlit pixels of its own
        return shared_plan(beam, options, measured=measured, should_stop=should_stop)


@dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """Work on each shot of a stack, and the description of its results."""

    kind: ClassVar[str]  # of the results, for their provenance

    inputs: Inputs  # recipe and masks of all shots, without an image
    variables: tuple[str, ...]  # of a result
    by_row: bool = False  # whether shots are rows with their own setups, sources and masks

    @property
    def recipe(self) -> Recipe:
        return self.inputs.recipe

    @cached_property
    def moved(self) -> Shot:
        """Masks and setup after the steps that move pixels; its image means nothing."""
        return self.recipe.move(self.inputs.shot)

    @property
    def shape(self) -> tuple[int, int]:
        return self.moved.shape

    @property
    def setup(self) -> Setup | None:
        return self.moved.setup

    @property
    def masks(self) -> dict[str, MaskVariable]:
        """The masks of the images as variables of all shots."""
        return self.inputs.provenance.mask_variables

    @property
    def attributes(self) -> dict[str, str]:
        """Attributes of a dataset of the results."""
        provenance = self.inputs.provenance
        provenance = provenance.model_copy(update={"setup": self.setup, "kind": self.kind})
        options = self.recipe.options.model_dump_json()
        return {"options": options, "provenance": provenance.to_json()}

    def with_masks(self, shot: Shot) -> Shot:
        """Return a shot with the masks of all shots, too, but that a mask's file precedes theirs.

        That is the rule of `collect_inputs` for a shot and its recipe.
        """
        common = self.inputs.shot
        is_file = isinstance(shot.mask, Path)
        return replace(
            shot,
            mask=shot.mask if is_file else join_masks(common.mask, shot.mask),
            source_mask=join_masks(common.source_mask, shot.source_mask),
        )

    def arrays(self, result: Any) -> dict[str, AnyArray]:
        """Return the variables by name, fields in SI units among them."""
        planes, field = self._planes(result)
        if any(name not in planes for name in self.variables):
            in_si = dataset_from_field(field.displacement, field.potential, result.setup)
            planes |= {str(name): in_si[name].values for name in in_si.data_vars}
        return {name: planes[name] for name in self.variables if name in planes}

    def _planes(self, result: Any) -> tuple[dict[str, AnyArray], Any]:
        """Return variables in pixels by name, and the field that others follow from."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False, kw_only=True)
class InvertTask(Task):
    """Inversion of each shot."""

    kind = "inversion"

    estimate: Estimate | None = None  # of the source of rows without one

    @property
    def labels(self) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
        """Dimensions and labels of all variables that the results can have."""
        return variable_labels(self.setup)

    @property
    def masks(self) -> dict[str, MaskVariable]:
        """As of all tasks; each row of a table may have its own, of image and source."""
        return mask_variables([None, None], "shot") if self.by_row else super().masks

    def arrays(self, result: Any) -> dict[str, AnyArray]:
        masks = result.provenance.mask_variables.items() if self.by_row else ()
        return super().arrays(result) | {name: pixels for name, (_, pixels, _) in masks}

    @property
    def identity(self) -> dict[str, str]:
        """The choices that affect the results, as JSON."""
        instrument = self.recipe.instrument.stated
        return {
            "fit": "",
            "options": self.recipe.options.model_dump_json(exclude={"threads"}),
            "instrument": json.dumps(instrument) if instrument else "",
        }

    def run(
        self,
        images: Sequence[Shot],
        beam: Beam | None,
        source: AnyArray | None = None,
        *,
        workers: int | None = None,
        should_stop: ShouldStop | None = None,
    ) -> Inversion:
        """Apply the recipe to a shot as recorded, with `source` or else with the beam's."""
        (image,) = images
        shape, expected = np.shape(image.image), self.inputs.shot.shape
        if shape != expected:
            reference = "the others" if beam is None or beam.source is None else "the source"
            raise InputError(f"image has shape {shape}, expected {expected} as {reference}")
        if source is not None and np.shape(source) != expected:
            raise InputError(f"source has shape {np.shape(source)}, expected {expected}")
        if self.by_row:
            inputs = self._inputs_of_row(image, beam, source)
        else:
            values = np.asarray(image.image, dtype=np.float64)
            usable = self.with_masks(image).mask
            shot = replace(self.inputs.shot, image=values, source=source, mask=usable)
            inputs = replace(self.inputs, shot=shot)
        recipe = inputs.recipe
        ready = recipe.prepare(inputs.shot, should_stop)
        if beam is None and isinstance(recipe.source, UniformEstimate):
            beam = Beam(ready.shape, None, ready.mask)
        if beam is not None:
            ready = replace(ready, source=beam.image, mask=join_masks(ready.mask, beam.mask))
            if beam.source is None:
                ready = replace(ready, image=_divide_by_mean(ready.image, ready.mask))
        options = recipe.options
        if options.threads is None:
            options = options.model_copy(update={"threads": threads_here(workers)})
        inputs = replace(inputs, recipe=recipe.model_copy(update={"options": options}))
        return run_prepared(inputs, ready, cache=_SharedSites(beam=beam), should_stop=should_stop)

    def _inputs_of_row(self, row: Shot, beam: Beam | None, source: AnyArray | None) -> Inputs:
        """Return the image of a row over its brightness, with its own source, mask and setup."""
        common = self.inputs
        kinds = [setup and setup.kind for setup in (row.setup, self.recipe.setup)]
        if kinds[0] != kinds[1]:
            texts = [f"a setup of kind '{kind}'" if kind else "no setup" for kind in kinds]
            raise InputError(
                f"it has {texts[0]}, and the first row of its table {texts[1]}: a store has the "
                "units of one kind of setup; give all rows such a setup, or use two tables"
            )
        # A common source is already in the beam.
        recipe_source = self.estimate if beam is None else common.recipe.source
        changes = {"source": recipe_source, "setup": row.setup}
        has_source = row.source is not None and not row.has_own_source
        own = row.source if has_source else source
        shot = self.with_masks(replace(row, source=own, warnings=()))
        inputs = collect_inputs(common.recipe.model_copy(update=changes), shot)
        if beam is None:
            inputs.recipe.check(inputs.shot)
        if has_source:
            return inputs
        origin = common.provenance.image.source
        return replace(inputs, provenance=inputs.provenance.with_image(source=origin))

    def _planes(self, result: Inversion) -> tuple[dict[str, AnyArray], Any]:
        names = variable_labels().keys() & set(self.variables)
        return {name: result.variable(name) for name in names}, result

    def report(self, result: Inversion) -> dict[str, Any]:
        """Return the report of a shot, with its own provenance if it is a row of a table."""
        headline = result.headline
        entries = {
            **dataclasses.asdict(result.report),
            "errors": None if result.errors is None else result.errors.to_dict(),
            "stages": result.report.seconds,
            "level": headline.level.value,
            "headline": str(headline),
            **column_values(ROWS if self.by_row else INVERSIONS, result),
        }
        if self.by_row:
            assert result.provenance is not None
            entries["provenance"] = json.loads(result.provenance.to_json())
        return entries


@dataclass(frozen=True, eq=False, kw_only=True)
class FitTask(Task):
    """Fit of the forward model to each shot, from its images as recorded."""

    kind = "fit"

    requested: Recipe  # without the setups of a table's rows, which come with the images

    @property
    def choices(self) -> FitChoices:
        return self.requested.fit or FitChoices()

    @property
    def field(self) -> str:
        """Name of the field that is fitted to each shot."""
        setups = None if self.setup is None else [self.setup]
        (name,) = self.choices.fields or usual_fields(setups)
        return name

    @property
    def labels(self) -> dict[str, tuple[tuple[str, ...], dict[str, str]]]:
        return fit_labels(self.field, self.setup)

    @property
    def identity(self) -> dict[str, str]:
        choices = self.choices
        return {
            "fit": choices.model_dump_json(exclude={"options"}, exclude_none=True),
            "options": choices.options.model_dump_json(exclude={"threads"}),
            "instrument": "",
        }

    @property
    def attributes(self) -> dict[str, str]:
        return {**super().attributes, "fields": json.dumps([self.field])}

    def run(
        self,
        images: Sequence[Shot],
        beam: Beam | None,
        source: AnyArray | None = None,
        *,
        workers: int | None = None,
        should_stop: ShouldStop | None = None,
    ) -> Fit:
        """Fit a shot."""
        common = beam.source if source is None and beam is not None else source
        completed = [self._completed(shot, common) for shot in images]
        fit = run_fit(self._recipe, completed, should_stop=should_stop)
        shape = fit.fields[0].potential.shape
        if shape != self.shape:
            raise InputError(f"the field has shape {shape}, expected {self.shape} as the others")
        if fit.setup != self.setup:
            raise InputError(
                "the setup of its first image differs from that of the other shots' first images, "
                "and a store has one: write these shots into another store"
            )
        return fit

    @property
    def _recipe(self) -> Recipe:
        """The recipe for a worker; simultaneous fits share the cores."""
        options = self.choices.options
        if options.threads is None:
            options = options.model_copy(update={"threads": 1})
        choices = self.choices.model_copy(update={"fields": (self.field,), "options": options})
        cleared = {"setup": None, "mask": None, "source_mask": None, "fit": choices}
        return self.requested.model_copy(update={"source": self.requested.estimate, **cleared})

    def _completed(self, shot: Shot, source: AnyArray | None) -> Shot:
        keeps_source = source is None or not (shot.source is None or shot.has_own_source)
        return replace(
            self.with_masks(shot),
            image=np.asarray(shot.image, dtype=np.float64),
            setup=self.requested.setup if shot.setup is None else shot.setup,
            source=shot.source if keeps_source else source,
        )

    def _planes(self, result: Fit) -> tuple[dict[str, AnyArray], Any]:
        (field,) = result.fields
        planes = {
            "potential": field.potential,
            "displacement": field.displacement,
            "displacement_uncertainty": field.uncertainty,
        }
        return {name: plane for name, plane in planes.items() if plane is not None}, field

    def report(self, result: Fit) -> dict[str, Any]:
        entries = {
            **column_values(FITS, result),
            "explanation": result.explanation,
            "chi2_images": result.chi2.tolist(),
            "brightness": result.brightness.tolist(),
            "strengths": result.strengths.tolist(),
            "objective": result.report.objective,
            "stages": result.report.seconds,
            "warnings": [dataclasses.asdict(caution) for caution in result.cautions],
        }
        provenance = result.provenance
        if provenance is not None and any(image.file for image in provenance.images):
            entries["images"] = [
                image.model_dump(mode="json", exclude_none=True, exclude={"mask", "source_mask"})
                for image in provenance.images
            ]
        return entries


AnyTask = InvertTask | FitTask


def _divide_by_mean(image: AnyArray, mask: BoolArray | None) -> AnyArray:
    """Divide by the mean, because a uniform beam that all shots share is 1 everywhere."""
    values = np.asarray(image, dtype=np.float64)
    used = values if mask is None else values[mask]
    # An invalid image is left unchanged: the error should refer to the original.
    if not np.isfinite(used).all():
        return values
    mean = float(np.maximum(used, 0).mean())
    return values / mean if mean > 0 else values


def threads_here(workers: int | None = None) -> int:
    """Return the number of threads of a shot beside others that are in work on this machine.

    By default there is one for each thread of dask's pool, and one alone in the main thread.
    """
    cores = available_threads(None)
    if workers is None:
        import dask

        alone = threading.current_thread() is threading.main_thread()
        alone = alone and multiprocessing.parent_process() is None
        workers = 1 if alone else int(dask.config.get("num_workers", None) or cores)
    return max(1, cores // workers)


@dataclass(frozen=True)
class ShotOutcome:
    """Outcome of one shot.

    Attributes
    ----------
    index, status : int
        Its number, and DONE or FAILED of `napari_shadowinv.io.store`.
    seconds : float
        Time that its worker spent on it, reading and writing included.
    reason, converged : str and bool
        Why it failed, and whether the solver reached its tolerance, or the fit its end.
    warnings : int
        Number of warnings about its result.
    """

    index: int
    status: int
    seconds: float
    reason: str = ""
    converged: bool = True
    warnings: int = 0


@dataclass(frozen=True)
class TaskContext:
    """Context that the tasks of all shots share."""

    writer: ShotWriter
    task: AnyTask
    workers: int | None
    results: dict[int, Any] | None = None  # takes them, by the shots' numbers, in this process


def run_shot(
    shot: Exposure,
    index: int,
    should_stop: ShouldStop | None,
    beam: Beam | None,
    context: TaskContext,
    block: AnyArray | None = None,
) -> ShotOutcome:
    """Task: load a shot, invert or fit it, and write it; what goes wrong with it is its outcome.

    A shot is replaced by its block of a dask array if a cluster has computed that already.
    """
    if block is not None:
        shot = ArrayExposure(shot.name, block, source=shot.source)
    attempt = try_shot(context.task, shot, beam, context.workers, should_stop)
    if context.results is not None:
        context.results[index] = attempt.result
    return _write_shot(context.writer, context.task, index, attempt)


@dataclass(frozen=True, eq=False)
class Attempt:
    """An attempt to invert or fit a shot, with a result or a failure."""

    began: float  # value of `time.perf_counter`
    seconds: float
    origin: dict[str, Any]  # metadata of its file
    result: Inversion | Fit | None = None
    failure: str = ""


def try_shot(
    task: AnyTask,
    shot: Exposure,
    beam: Beam | None,
    workers: int | None = None,
    should_stop: ShouldStop | None = None,
) -> Attempt:
    """Read and invert, or fit, one shot; all errors but a cancellation become its failure."""
    began = time.perf_counter()
    origin: dict[str, Any] = {}
    result, failure = None, ""
    try:
        origin = shot.stamp()
        images, loaded = shot.load()
        origin |= loaded
        source = None
        if shot.source is not None:
            source, origin["source"] = shot.source.read()
        result = task.run(images, beam, source, workers=workers, should_stop=should_stop)
    except InversionCancelled:
        raise
    except Exception as error:
        # No error of a reader or a solver may stop the other shots.
        failure = failure_text(error)
    return Attempt(began, time.perf_counter() - began, origin, result, failure)


def _write_shot(writer: ShotWriter, task: AnyTask, index: int, attempt: Attempt) -> ShotOutcome:
    result: Any = attempt.result
    cautions = [dataclasses.asdict(caution) for caution in attempt.origin.get("warnings", ())]
    if result is None:
        failed = {"reason": attempt.failure, "seconds": attempt.seconds}
        writer.write(index, {}, {**attempt.origin, **failed, "warnings": cautions}, FAILED)
        return ShotOutcome(index, FAILED, attempt.seconds, attempt.failure)
    entries = task.report(result)
    warnings = {"warnings": [*entries["warnings"], *cautions]}
    report = {**entries, "seconds": attempt.seconds, **attempt.origin, **warnings}
    writer.write(index, task.arrays(result), report)
    spent = time.perf_counter() - attempt.began
    count = len(report["warnings"])
    return ShotOutcome(index, DONE, spent, converged=result.report.converged, warnings=count)


def write_failure(writer: ShotWriter, index: int, reason: str) -> ShotOutcome:
    """Write a shot that could not be begun."""
    writer.write(index, {}, {"reason": reason}, FAILED)
    return ShotOutcome(index, FAILED, 0.0, reason)
