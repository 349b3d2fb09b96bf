"""What a worker does: `Work` inverts one shot, `run_shots` some and writes each.

The parts of it are `try_shot` and `write_shot`.

`FitWork` takes the place of `Work` in a stack that is fitted, and has the same methods.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import multiprocessing
import sys
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion, plan_sites
from napari_shadowinv.inversion.labels import dataset_from_field, variable_labels
from napari_shadowinv.io.store import DONE, FAILED, ShotWriter
from napari_shadowinv.io.store_growing import GrowingStore
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.pipeline import Cache, Inputs, run_prepared
from napari_shadowinv.preprocessing import UniformEstimate
from napari_shadowinv.stack._fit_work import FitWork
from napari_shadowinv.stack._sources import Shot, checksum
from napari_shadowinv.transport.sites import SitePlan

_ASKED_AGAIN_AFTER = 10.0  # seconds: workers come and go, but asking takes milliseconds
_PLANS_KEPT = 2  # a worker that changes between two sources makes each once


@dataclass(frozen=True, eq=False)
class Beam:
    """The undisturbed beam and the mask of one or more shots."""

    shape: tuple[int, int]
    source: AnyArray | None = field(default=None, repr=False)
    mask: BoolArray | None = field(default=None, repr=False)
    key: str = ""  # checksum of the others

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
    """A plan that is being made, or is there."""

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
    """Return the sites for a beam; the first in this process who asks makes them."""
    key = f"{beam.key}{options.site_key()}{measured}"
    with _entries_lock:
        entry = _entries.setdefault(key, _Entry())
        _entries.move_to_end(key)
        while len(_entries) > _PLANS_KEPT:
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
    """What is done with every shot of a stack, wherever it is."""

    shape: tuple[int, int]  # of the shots as recorded
    inputs: Inputs  # without an image; shots inverted at once share the cores
    variables: tuple[str, ...]
    sites_chosen: bool = False  # as the first shots needed them

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
        found = getattr(image, "shape", None) or np.shape(image)
        if found != self.shape:
            others = "the others" if beam is None or beam.source is None else "the source"
            raise InputError(f"image has shape {found}, expected {self.shape} as {others}")
        if source is not None and np.shape(source) != self.shape:
            raise InputError(f"source has shape {np.shape(source)}, expected {self.shape}")
        inputs = self.gathered(content, beam, source)
        recipe = inputs.recipe
        ready = recipe.prepared(inputs.shot, should_stop)
        if beam is None and isinstance(recipe.source, UniformEstimate):
            beam = Beam.of(ready.shape, None, ready.mask)
        if beam is not None:
            ready = replace(ready, source=beam.image)
            if beam.source is None:
                ready = replace(ready, image=_relative(ready.image, ready.mask))
        options = recipe.options
        if options.threads is None:
            options = options.model_copy(update={"threads": threads_here(workers)})
        inputs = replace(inputs, recipe=recipe.model_copy(update={"options": options}))
        sites = _SharedSites(beam=beam)
        found = run_prepared(inputs, ready, cache=sites, start=start, should_stop=should_stop)
        return _as_chosen(found) if self.sites_chosen else found

    def gathered(self, content: Any, beam: Beam | None, source: AnyArray | None) -> Inputs:
        """Return what the recipe is applied to."""
        values = np.asarray(content, dtype=np.float64)
        return replace(self.inputs, shot=replace(self.inputs.shot, image=values, source=source))

    def arrays(self, inversion: Inversion) -> dict[str, AnyArray]:
        """Return the variables by name, fields in SI units among them."""
        own = variable_labels()
        arrays = {name: getattr(inversion, name) for name in self.variables if name in own}
        if len(arrays) < len(self.variables):
            fields = dataset_from_field(
                inversion.displacement, inversion.potential, inversion.setup
            )
            arrays |= {name: fields[name].values for name in self.variables if name not in own}
        return arrays

    def report(self, inversion: Inversion) -> dict[str, Any]:
        """Return what is told of a shot."""
        headline = inversion.headline
        return {
            **dataclasses.asdict(inversion.report),
            "stages": inversion.report.seconds,
            "level": headline.level.value,
            "headline": headline.text,
            **numbers_of(inversion),
        }


def _as_chosen(inversion: Inversion) -> Inversion:
    """Tell of a shot that the first ones have decided on its sites, and whether these suffice."""
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


def numbers_of(inversion: Inversion) -> dict[str, Any]:
    """Return the numbers of a shot that stand beside its arrays, by the store's names."""
    report, errors = inversion.report, inversion.errors
    return {
        "converged": report.converged,
        "flux_residual": report.residual,
        "image_residual": report.image_residual,
        "noise_error": math.nan if errors is None else errors.noise.rms,
        "discretisation_error": math.nan if errors is None else errors.discretisation.rms,
        "iterations": report.iterations,
    }


def _relative(image: AnyArray, mask: BoolArray | None) -> AnyArray:
    """Divide by the mean, because a uniform beam that all shots share is 1 everywhere."""
    values = np.asarray(image, dtype=np.float64)
    used = values if mask is None else values[mask]
    # An image that cannot be inverted is left alone: the error shall tell of it as it was.
    if not np.isfinite(used).all():
        return values
    mean = float(np.maximum(used, 0).mean())
    return values / mean if mean > 0 else values


def threads_here(workers: int | None = None) -> int:
    """Return how many threads one shot may use, so that all shots at once fill the machine."""
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
        here = get_address_host(get_worker().address)
    except ValueError:
        return None
    return _threads_on(here, int(time.monotonic() / _ASKED_AGAIN_AFTER))


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
    """What became of one shot.

    Attributes
    ----------
    index, status : int
        Its number, and DONE or FAILED of `napari_shadowinv.io.store`.
    seconds : float
        Time that its worker spent on it, reading and writing included.
    reason, converged : str and bool
        Why it failed, and whether the solver reached its tolerance, or the fit its end.
    """

    index: int
    status: int
    seconds: float
    reason: str = ""
    converged: bool = True


@dataclass(frozen=True)
class Settings:
    """What the task of every shot needs to know."""

    writer: ShotWriter
    work: Work | FitWork
    workers: int | None


def run_shots(
    shots: list[Any],
    labels: list[tuple[int, bool, Shot | None]],
    beam: Beam | None,
    settings: Settings,
    stop: Any = None,
) -> list[ShotOutcome]:
    """Task: invert, or fit, some shots one after the other and write each."""
    should_stop = None if stop is None else stop.is_set
    previous: Inversion | Fit | None = None
    outcomes = []
    for shot, (index, wanted, source) in zip(shots, labels, strict=True):
        tried = try_shot(settings.work, shot, beam, source, previous, settings.workers, should_stop)
        previous = tried.result
        if wanted:
            outcomes.append(write_shot(settings.writer, settings.work, index, tried))
    return outcomes


@dataclass(frozen=True, eq=False)
class Tried:
    """What came of the attempt to invert, or fit, a shot; it has a result or a failure."""

    began: float  # value of `time.perf_counter`
    seconds: float
    origin: dict[str, Any]  # what is known of its file
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
) -> Tried:
    """Read and invert, or fit, one shot; all but a cancellation is its own failure."""
    began = time.perf_counter()
    origin: dict[str, Any] = {}
    result, failure = None, ""
    try:
        image, origin = _loaded(shot)
        own = None
        if source is not None:
            own, origin["source"] = source.load()
        result = work.invert(
            image, beam, own, start=start, workers=workers, should_stop=should_stop
        )
    except InversionCancelled:
        raise
    except Exception as error:
        # Whatever a reader or a solver stumbles over, the other shots shall go on.
        failure = reason_of(error)
    return Tried(began, time.perf_counter() - began, origin, result, failure)


def write_shot(
    writer: ShotWriter | GrowingStore, work: Any, index: int, tried: Tried
) -> ShotOutcome:
    """Write what came of a shot."""
    made = tried.result
    cautions = [dataclasses.asdict(caution) for caution in tried.origin.get("warnings", ())]
    if made is None:
        failed = {"reason": tried.failure, "seconds": tried.seconds}
        writer.fail(index, {**tried.origin, **failed, "warnings": cautions})
        return ShotOutcome(index, FAILED, tried.seconds, tried.failure)
    told = work.report(made)
    warnings = {"warnings": [*told["warnings"], *cautions]}
    report = {**told, "seconds": tried.seconds, **tried.origin, **warnings}
    writer.write(index, work.arrays(made), report)
    spent = time.perf_counter() - tried.began
    return ShotOutcome(index, DONE, spent, converged=made.report.converged)


def reason_of(error: Exception) -> str:
    """Say why a shot failed."""
    if isinstance(error, MemoryError):
        return "there is not enough memory for this shot on its worker"
    kind = type(error).__name__
    if isinstance(error, InputError | OSError):
        return str(error) or kind
    return f"{kind}: {error}"


def _loaded(shot: Any) -> tuple[AnyArray, dict[str, Any]]:
    """Image of a shot; a block of a dask array on a cluster has been computed already."""
    if isinstance(shot, np.ndarray):
        return shot[0], {"sha256": checksum(shot[0])}
    loaded: tuple[AnyArray, dict[str, Any]] = shot.load()
    return loaded
