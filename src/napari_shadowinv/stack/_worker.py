"""Tasks of a worker: `Work` inverts one shot, `run_shots` several and writes each.

`run_shots` consists of `try_shot` and `write_shot`. For stacks to fit, `FitWork` replaces `Work`
and has the same methods.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import multiprocessing
import sys
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion, plan_sites
from napari_shadowinv.inversion.variables import dataset_from_field, variable_labels
from napari_shadowinv.io.store import DONE, FAILED
from napari_shadowinv.io.store_columns import INVERSIONS, column_values
from napari_shadowinv.io.store_writing import GrowingStore, ShotWriter
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.pipeline import Cache, Inputs, run_prepared
from napari_shadowinv.preprocessing import UniformEstimate
from napari_shadowinv.stack._fit_work import FitWork
from napari_shadowinv.stack._sources import Shot, checksum
from napari_shadowinv.transport.sites import SitePlan

_REFRESH_S = 10.0  # workers come and go, but asking takes milliseconds
_MAX_PLANS = 2  # a worker that changes between two sources makes each once


@dataclass(frozen=True, eq=False)
class Beam:
    """The undisturbed beam and the mask of one or more shots."""

    shape: tuple[int, int]
    source: AnyArray | None = field(default=None, repr=False)
    mask: BoolArray | None = field(default=None, repr=False)
    key: str = ""  # checksum of the other fields

    @property
    def image(self) -> AnyArray:
        """The source; ones for a uniform beam."""
        return np.ones(self.shape) if self.source is None else self.source

    @classmethod
    def of(cls, shape: tuple[int, int], source: AnyArray | None, mask: BoolArray | None) -> Beam:
        parts = ["" if array is None else checksum(array) for array in (source, mask)]
        text = f"{shape}{parts[0]}|{parts[1]}"
        return cls(shape, source, mask, hashlib.sha256(text.encode()).hexdigest())


@dataclass
class _Entry:
    """A plan, complete or in preparation."""

    lock: threading.Lock = field(default_factory=threading.Lock)
    plan: SitePlan | None = None


_entries: OrderedDict[str, _Entry] = OrderedDict()
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
        entry = _entries.setdefault(key, _Entry())
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
        beam = self.beam or Beam.of(source.shape, source, mask)
        return shared_plan(beam, options, measured=measured, should_stop=should_stop)


@dataclass(frozen=True, eq=False)
class Work:
    """Task of every shot of a stack."""

    shape: tuple[int, int]  # of the shots as recorded
    inputs: Inputs  # without an image; shots inverted at once share the cores
    variables: tuple[str, ...]
    sites_chosen: bool = False  # as the first shots needed them
    shots: ClassVar[str] = INVERSIONS

    def invert(
        self,
        content: Any,
        beam: Beam | None,
        source: AnyArray | None = None,
        *,
        start: Inversion | None = None,
        workers: int | None = None,
        should_stop: ShouldStop | None = None,
    ) -> Inversion:
        """Apply the recipe to a shot as recorded, and to its source if it has its own."""
        image = getattr(content, "image", content)
        shape = getattr(image, "shape", None) or np.shape(image)
        if shape != self.shape:
            reference = "the others" if beam is None or beam.source is None else "the source"
            raise InputError(f"image has shape {shape}, expected {self.shape} as {reference}")
        if source is not None and np.shape(source) != self.shape:
            raise InputError(f"source has shape {np.shape(source)}, expected {self.shape}")
        inputs = self.collect_inputs(content, beam, source)
        recipe = inputs.recipe
        ready = recipe.prepare(inputs.shot, should_stop)
        if beam is None and isinstance(recipe.source, UniformEstimate):
            beam = Beam.of(ready.shape, None, ready.mask)
        if beam is not None:
            ready = replace(ready, source=beam.image)
            if beam.source is None:
                ready = replace(ready, image=_divide_by_mean(ready.image, ready.mask))
        options = recipe.options
        if options.threads is None:
            options = options.model_copy(update={"threads": threads_here(workers)})
        inputs = replace(inputs, recipe=recipe.model_copy(update={"options": options}))
        sites = _SharedSites(beam=beam)
        inversion = run_prepared(inputs, ready, cache=sites, start=start, should_stop=should_stop)
        return _with_sites_reason(inversion) if self.sites_chosen else inversion

    def collect_inputs(self, content: Any, beam: Beam | None, source: AnyArray | None) -> Inputs:
        """Return the inputs of the recipe."""
        values = np.asarray(content, dtype=np.float64)
        return replace(self.inputs, shot=replace(self.inputs.shot, image=values, source=source))

    def arrays(self, inversion: Inversion) -> dict[str, AnyArray]:
        """Return the variables by name, fields in SI units among them."""
        labels = variable_labels()
        arrays = {name: getattr(inversion, name) for name in self.variables if name in labels}
        if len(arrays) < len(self.variables):
            fields = dataset_from_field(
                inversion.displacement, inversion.potential, inversion.setup
            )
            arrays |= {name: fields[name].values for name in self.variables if name not in labels}
        return arrays

    def report(self, inversion: Inversion) -> dict[str, Any]:
        """Return the report of a shot."""
        headline = inversion.headline
        return {
            **dataclasses.asdict(inversion.report),
            "stages": inversion.report.seconds,
            "level": headline.level.value,
            "headline": headline.text,
            **column_values(self.shots, inversion),
        }


def _with_sites_reason(inversion: Inversion) -> Inversion:
    """Add the reason for the number of sites, and a warning if it does not suffice."""
    caution, errors = None, inversion.errors
    if errors is not None:
        why = "with the sites of the first shots"
        caution = errors.accuracy_caution(inversion.options.accuracy, why)
    report = replace(
        inversion.report,
        sites_reason="as many as the first shots needed for the accuracy",
        warnings=(*inversion.report.warnings, *filter(None, [caution])),
    )
    return replace(inversion, report=report)


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
    """Return the number of threads of a shot with which all simultaneous shots fill the machine."""
    # On a dask worker, workers default to the threads of all dask workers on this machine; in a
    # pool of dask to its `num_workers`, or one for each core.
    cores = available_threads(None)
    if workers is None:
        workers = _threads_of_cluster() or _threads_of_pool(cores)
    return max(1, cores // workers)


def _threads_of_cluster() -> int | None:
    """Threads of all dask workers on this machine; None elsewhere than on a worker."""
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker
    from distributed.comm.addressing import get_address_host

    try:
        host = get_address_host(get_worker().address)
    except ValueError:
        return None
    return _threads_on(host, int(time.monotonic() / _REFRESH_S))


@functools.lru_cache(maxsize=1)
def _threads_on(host: str, _age: int) -> int:
    from distributed import get_client
    from distributed.comm.addressing import get_address_host

    client: Any = get_client()
    workers = client.nthreads()
    return sum(count for address, count in workers.items() if get_address_host(address) == host)


def _threads_of_pool(cores: int) -> int:
    alone = threading.current_thread() is threading.main_thread()
    if alone and multiprocessing.parent_process() is None:
        return 1
    import dask

    return int(dask.config.get("num_workers", None) or cores)


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
    work: Work | FitWork
    workers: int | None


def run_shots(
    shots: list[Any],
    labels: list[tuple[int, bool, Shot | None]],
    beam: Beam | None,
    context: TaskContext,
    stop: Any = None,
) -> list[ShotOutcome]:
    """Task: invert, or fit, some shots one after the other and write each."""
    should_stop = None if stop is None else stop.is_set
    previous: Inversion | Fit | None = None
    outcomes = []
    for shot, (index, is_pending, source) in zip(shots, labels, strict=True):
        attempt = try_shot(context.work, shot, beam, source, previous, context.workers, should_stop)
        previous = attempt.result
        if is_pending:
            outcomes.append(write_shot(context.writer, context.work, index, attempt))
    return outcomes


@dataclass(frozen=True, eq=False)
class Attempt:
    """An attempt to invert or fit a shot, with a result or a failure."""

    began: float  # value of `time.perf_counter`
    seconds: float
    origin: dict[str, Any]  # metadata of its file
    result: Inversion | Fit | None = None
    failure: str = ""


def try_shot(
    work: Any,
    shot: Any,
    beam: Beam | None,
    source: Shot | None = None,
    start: Any = None,
    workers: int | None = None,
    should_stop: ShouldStop | None = None,
) -> Attempt:
    """Read and invert, or fit, one shot; all errors but a cancellation become its failure."""
    began = time.perf_counter()
    origin: dict[str, Any] = {}
    result, failure = None, ""
    try:
        image, origin = _load_shot(shot)
        shot_source = None
        if source is not None:
            shot_source, origin["source"] = source.load()
        result = work.invert(
            image, beam, shot_source, start=start, workers=workers, should_stop=should_stop
        )
    except InversionCancelled:
        raise
    except Exception as error:
        # No error of a reader or a solver may stop the other shots.
        failure = failure_text(error)
    return Attempt(began, time.perf_counter() - began, origin, result, failure)


def write_shot(
    writer: ShotWriter | GrowingStore, work: Any, index: int, attempt: Attempt
) -> ShotOutcome:
    """Write the result or the failure of a shot."""
    result = attempt.result
    cautions = [dataclasses.asdict(caution) for caution in attempt.origin.get("warnings", ())]
    if result is None:
        failed = {"reason": attempt.failure, "seconds": attempt.seconds}
        writer.fail(index, {**attempt.origin, **failed, "warnings": cautions})
        return ShotOutcome(index, FAILED, attempt.seconds, attempt.failure)
    entries = work.report(result)
    warnings = {"warnings": [*entries["warnings"], *cautions]}
    report = {**entries, "seconds": attempt.seconds, **attempt.origin, **warnings}
    writer.write(index, work.arrays(result), report)
    spent = time.perf_counter() - attempt.began
    count = len(report["warnings"])
    return ShotOutcome(index, DONE, spent, converged=result.report.converged, warnings=count)


def failure_text(error: Exception) -> str:
    """Return the reason of a failure."""
    if isinstance(error, MemoryError):
        return "there is not enough memory for this shot on its worker"
    kind = type(error).__name__
    if isinstance(error, InputError | OSError):
        return str(error) or kind
    return f"{kind}: {error}"


def _load_shot(shot: Any) -> tuple[AnyArray, dict[str, Any]]:
    """Load a shot; a block of a dask array on a cluster has been computed already."""
    if isinstance(shot, np.ndarray):
        return shot[0], {"sha256": checksum(shot[0])}
    loaded: tuple[AnyArray, dict[str, Any]] = shot.load()
    return loaded
