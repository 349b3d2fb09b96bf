"""A result in words, for every face: `Fact`, `Headline`, `Level`.

Results describe themselves once, as facts. The command prints them as a table, a window shows them
as a report, a figure writes them below its panels; none of them words or rounds anything itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum

from napari_shadowinv.cautions import Caution

__all__ = ["Fact", "Headline", "Level", "caution_facts", "error_fact", "time_fact"]


class Level(StrEnum):
    """How far a result can be trusted."""

    SOUND = "sound"
    DOUBTFUL = "doubtful"
    FAILED = "failed"


@dataclass(frozen=True)
class Headline:
    """A result in one line.

    Attributes
    ----------
    level : Level
        Sound without warnings, doubtful with warnings, failed if the solver did not converge.
    text : str
        The warnings, then the peak of the main field with its error.
    """

    level: Level
    text: str


@dataclass(frozen=True, slots=True)
class Fact:
    """A property of a result in words.

    Attributes
    ----------
    key : str
        Name for programs, such as "image_residual"; the code of a caution.
    title : str
        Name for people, such as "Image residual".
    text : str
        The value, with its unit.
    level : Level
        Not sound if it is a reason to doubt the result.
    is_detail : bool
        Whether it describes the work of the solver rather than the result. Windows fold it away.
    """

    key: str
    title: str
    text: str
    level: Level = Level.SOUND
    is_detail: bool = False


def caution_facts(cautions: Iterable[Caution]) -> list[Fact]:
    """Return cautions as facts."""
    return [Fact(each.code, "Warning", each.text, Level.DOUBTFUL) for each in cautions]


def error_fact(name: str, text: str) -> Fact:
    """Return a contribution to the error budget."""
    key = name if name.startswith("error") else f"error_{name}"
    return Fact(key.replace(" ", "_"), name.capitalize(), text)


def time_fact(seconds: Mapping[str, float]) -> Fact:
    """Return the time of all stages and of each."""
    stages = ", ".join(f"{stage} {value:.2f}" for stage, value in seconds.items())
    return Fact("time", "Time", f"{sum(seconds.values()):.2f} s ({stages})", is_detail=True)
