"""Progress of long work, and the request to stop it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from queue import SimpleQueue
from threading import Event
from typing import ParamSpec, TypeVar

from napari_shadowinv._system.machine import Crew
from napari_shadowinv.errors import InversionCancelled


@dataclass(frozen=True)
class Progress:
    """A step of a long computation."""

    stage: str  # such as "compile", "prepare", "sites", "transport", "read-out", "samples"
    step: int  # steps of this stage that are finished
    total: int | None = None  # where it is known
    message: str = ""  # for people, such as the residual reached
    objective: float | None = None  # of a fit

    @property
    def text(self) -> str:
        """The message, of a fit with its stage and the objective."""
        if self.objective is None:
            return self.message
        text = f"stage {self.step + 1} of {self.total}, {self.message}"
        return f"{text}, objective {self.objective:.6g}" if math.isfinite(self.objective) else text


OnProgress = Callable[[Progress], None]
OnStep = Callable[[str, float], None]
"""Receives the stage and the objective after each step of a fit; an exception ends the fit."""
ShouldStop = Callable[[], bool]


_P = ParamSpec("_P")
_T = TypeVar("_T")


class Reporter:
    """Passes progress on and raises `InversionCancelled` when asked to stop."""

    def __init__(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> None:
        self._on_progress = on_progress
        self.should_stop = should_stop

    def __call__(
        self,
        stage: str,
        step: int,
        total: int | None = None,
        message: str = "",
        objective: float | None = None,
    ) -> None:
        if self.should_stop is not None and self.should_stop():
            raise InversionCancelled(f"stopped on request during {stage}")
        if self._on_progress is not None:
            self._on_progress(Progress(stage, step, total, message, objective))


def run_in_parallel(
    works: Sequence[Callable[[Callable[_P, None]], _T]], threads: int, on_step: Callable[_P, None]
) -> list[_T]:
    """Call functions in a `Crew` and return their results, in the order of the functions.

    Their steps are reported by the thread that calls, so that an exception of `on_step`, or
    Ctrl-C, ends all of them at their next step.
    """
    if min(threads, len(works)) < 2:
        return [work(on_step) for work in works]
    steps: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
    is_over = Event()

    def report(*args: _P.args, **kwargs: _P.kwargs) -> None:
        if is_over.is_set():
            raise InversionCancelled("stopped on request")
        steps.put(partial(on_step, *args, **kwargs))

    def end(future: Future[_T]) -> None:
        if future.exception() is not None:
            is_over.set()
        steps.put(None)

    with ThreadPoolExecutor(threads, thread_name_prefix="fits of shadowinv") as pool:
        crew = Crew(len(works), threads)
        futures = [pool.submit(crew.call, work, report) for work in works]
        for future in futures:
            future.add_done_callback(end)
        try:
            running = len(works)
            while running:
                step = steps.get()
                if step is None:
                    running -= 1
                else:
                    step()
        except BaseException:
            is_over.set()
            raise
    # Of several exceptions, the others follow from the first.
    errors = [error for future in futures if (error := future.exception()) is not None]
    for error in sorted(errors, key=lambda each: isinstance(each, InversionCancelled)):
        raise error
    return [future.result() for future in futures]


@contextmanager
def measure_time(stage: str, seconds: dict[str, float]) -> Iterator[None]:
    """Add the time of a block to that of a stage."""
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
