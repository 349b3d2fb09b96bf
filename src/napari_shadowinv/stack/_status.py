"""Status of a run over many shots, or of a watched folder: `RunStatus`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from napari_shadowinv.stack._worker import ShotOutcome

if TYPE_CHECKING:
    from napari_shadowinv.fitting import Fit
    from napari_shadowinv.inversion import Inversion

WATCHING = "watching"  # name of the engine of a watched folder


@dataclass(frozen=True)
class RunStatus:
    """Status of a run, or of a watched folder.

    Attributes
    ----------
    total, done, failed : int
        Numbers of shots, including earlier runs.
    doubtful : int
        Shots that are done, with warnings.
    waiting : int
        Shots that have not ended; of a watched folder, files that have arrived.
    ended : int
        Shots that have ended in this run.
    seconds : float
        Time of this run; of a watched folder, the time during which shots were inverted.
    engine : str
        Name of the engine that inverts the shots.
    stage : str
        Current stage of the preparation, before all shots.
    name, outcome : str, ShotOutcome or None
        The shot that has just ended, if any, and its outcome.
    result : Inversion, Fit or None
        Its result, for a watched folder; do not keep a reference.
    again : bool
        Whether the shot was inverted before and its file has changed since.
    failures : tuple of (str, str)
        Names of the failed shots, with the reasons.
    note : str
        A sentence for the user.
    """

    total: int = 0
    done: int = 0
    failed: int = 0
    doubtful: int = 0
    waiting: int = 0
    ended: int = 0
    seconds: float = 0.0
    engine: str = ""
    stage: str = ""
    name: str = ""
    outcome: ShotOutcome | None = None
    result: Inversion | Fit | None = None
    again: bool = False
    failures: tuple[tuple[str, str], ...] = ()
    note: str = ""

    @property
    def rate(self) -> float:
        """Shots per second in this run, 0 before the first has ended."""
        return self.ended / self.seconds if self.seconds > 0 else 0.0

    @property
    def remaining(self) -> float | None:
        """Seconds until the waiting shots have ended at the same rate; None if unknown."""
        return self.waiting / self.rate if self.rate else None

    @property
    def text(self) -> str:
        """The numbers of shots."""
        is_watch = self.engine == WATCHING
        numbers = [
            f"{self.done} done" if is_watch else f"{self.done} of {self.total} done",
            f"{self.failed} failed" if self.failed else "",
            f"{self.doubtful} with warnings" if self.doubtful else "",
            f"{self.waiting} waiting" if is_watch and self.waiting else "",
        ]
        return ", ".join(filter(None, numbers))


OnStatus = Callable[[RunStatus], None]
