"""How long work tells its progress and its doubts, and is asked to stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from napari_shadowinv.errors import InversionCancelled


@dataclass(frozen=True)
class Progress:
    """One sign of life from a long computation."""

    stage: str  # such as "compile", "prepare", "sites", "transport", "read-out", "samples"
    step: int  # steps of this stage that are finished
    total: int | None = None  # where it is known
    message: str = ""  # for people, such as the residual reached


OnProgress = Callable[[Progress], None]
ShouldStop = Callable[[], bool]


class Reporter:
    """Passes progress on and raises `InversionCancelled` when asked to stop."""

    def __init__(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> None:
        self._on_progress = on_progress
        self._should_stop = should_stop

    def __call__(self, stage: str, step: int, total: int | None = None, message: str = "") -> None:
        if self._should_stop is not None and self._should_stop():
            raise InversionCancelled(f"stopped on request during {stage}")
        if self._on_progress is not None:
            self._on_progress(Progress(stage, step, total, message))
