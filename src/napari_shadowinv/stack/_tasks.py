"""What a worker of a run is asked to do, `run_shots`: invert some shots, and write each."""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from napari_shadowinv._typing import AnyArray
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io.store import DONE, FAILED, ShotWriter
from napari_shadowinv.stack._references import Shot, checksum
from napari_shadowinv.stack._worker import Beam, Work


@dataclass(frozen=True)
class ShotOutcome:
    """What became of one shot."""

    index: int
    status: int  # DONE or FAILED of `napari_shadowinv.io.store`
    seconds: float  # that its worker spent on it, reading and writing included
    reason: str = ""  # why it failed
    converged: bool = True  # whether the solver reached its tolerance


@dataclass(frozen=True)
class Settings:
    """What the task of every shot needs to know."""

    writer: ShotWriter
    work: Work
    workers: int | None


def run_shots(
    shots: list[Any],
    labels: list[tuple[int, bool, Shot | None]],
    beam: Beam | None,
    settings: Settings,
    stop: Any = None,
) -> list[ShotOutcome]:
    """Task: invert some shots one after the other and write each."""
    should_stop = None if stop is None else stop.is_set
    previous: Inversion | None = None
    outcomes = []
    for shot, (index, wanted, source) in zip(shots, labels, strict=True):
        start = time.perf_counter()
        failure = ""
        try:
            image, origin = _loaded(shot)
            own = None
            if source is not None:
                own, origin["source"] = source.load()
            previous = settings.work.invert(
                image, beam, own, start=previous, workers=settings.workers, should_stop=should_stop
            )
        except InversionCancelled:
            raise
        except Exception as error:
            # Whatever a reader or a solver stumbles over, the other shots shall go on.
            previous, failure = None, _reason(error)
        if not wanted:
            continue
        seconds = time.perf_counter() - start
        if previous is None:
            settings.writer.fail(index, {"reason": failure, "seconds": seconds})
            outcomes.append(ShotOutcome(index, FAILED, seconds, failure))
        else:
            report = {
                **dataclasses.asdict(previous.report),
                "stages": previous.report.seconds,
                "seconds": seconds,
                **origin,
                "warnings": [*previous.report.warnings, *origin.get("warnings", ())],
            }
            settings.writer.write(index, settings.work.arrays(previous), report)
            spent = time.perf_counter() - start
            outcomes.append(ShotOutcome(index, DONE, spent, converged=previous.report.converged))
    return outcomes


def _reason(error: Exception) -> str:
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
