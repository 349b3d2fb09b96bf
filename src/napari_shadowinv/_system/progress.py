"""How long work tells its progress and its doubts, and is asked to stop.

The core calls `on_progress` with a `Progress` and asks `should_stop` between
steps; progress bars of the command line, of napari and of a notebook are
adapters that live with them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from napari_shadowinv.errors import InversionCancelled

__all__ = ["OnProgress", "OnWarning", "Progress", "Reporter", "ShouldStop"]


@dataclass(frozen=True)
class Progress:
    """One sign of life from a long computation.

    Attributes
    ----------
    stage : str
        What is being done: ``"compile"``, ``"prepare"``, ``"sites"``, ``"transport"``,
        ``"read-out"``, ``"samples"``.
    step : int
        Steps of this stage that are finished.
    total : int or None
        Steps that this stage has; None where nobody can know.
    message : str
        A short text for people, such as the residual reached.
    """

    stage: str
    step: int
    total: int | None = None
    message: str = ""


OnProgress = Callable[[Progress], None]
OnWarning = Callable[[str], None]
ShouldStop = Callable[[], bool]


class Reporter:
    """Passes progress on and raises `InversionCancelled` when asked to stop.

    Parameters
    ----------
    on_progress : callable, optional
        Receives each `Progress`.
    should_stop : callable, optional
        Asked at each step; a true answer ends the work.

    Raises
    ------
    InversionCancelled
        From a call, when `should_stop` returned true.
    """

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
