"""Progress of long work, and the request to stop it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

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
ShouldStop = Callable[[], bool]


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


@contextmanager
def measure_time(stage: str, seconds: dict[str, float]) -> Iterator[None]:
    """Add the time of a block to that of a stage."""
    start = time.perf_counter()
    yield
    seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - start
