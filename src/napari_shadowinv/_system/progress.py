"""Progress of long work, and the request to stop it."""

from __future__ import annotations

import math
from collections.abc import Callable
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
        """The message with the objective."""
        if self.objective is None or not math.isfinite(self.objective):
            return self.message
        return f"{self.message}, objective {self.objective:.6g}"


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
