"""A result in words, for every face: `Fact`, `Headline`, `Level`, `Verdict`; its `ResultKind`.

The verdict on a field with its limit and the next step: `Assessment`, by rules: `assess`.

A few lines of a result, as Python prints it: `Summarised`.

Numbers in words: `to_figures`, `percent`, `with_error`; their power of ten: `power_of_ten`.

Results describe themselves once, as facts. The command prints them as a table, a window shows them
as a report, a figure writes them below its panels; none of them words or rounds anything itself.

A room that treats kinds of results differently has one table with an entry for each `ResultKind`:
the class in `results`, the writers in `io.formats`, the figures in `plotting`, the rerun and
the file's description in `cli`, the layers in `_napari`.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, ClassVar, TypeVar

from napari_shadowinv._typing import BoolArray
from napari_shadowinv.cautions import Caution

_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

Case = TypeVar("Case")


def power_of_ten(largest: float, least: float = 1e-3, greatest: float = 1e5) -> tuple[int, str]:
    """Return the power of ten of a number that is not plain, rounded, and its text; else 0, ""."""
    rounded = float(f"{abs(largest):.3g}")
    if not 0 < rounded < math.inf or least <= rounded < greatest:
        return 0, ""
    power = math.floor(math.log10(rounded))
    return power, f"× 10{str(power).translate(_RAISED)}"


def to_figures(value: float, figures: int = 2) -> str:
    """Write a number to a few figures.

    >>> [to_figures(value) for value in (0.0123, 5, 99.6, 136.4, 2.5e7)]
    ['0.012', '5', '100', '136', '2.5 × 10⁷']
    """
    power, text = power_of_ten(value, 10.0**-4)
    rounded = float(f"{value:.{figures}g}")
    if power:
        return f"{rounded / 10.0**power:.{figures}g} {text}"
    return f"{value:.0f}" if 10.0**figures <= abs(rounded) < math.inf else f"{rounded:g}"


def percent(share: float) -> str:
    """Write a share in per cent to two figures.

    >>> [percent(share) for share in (0.0214, 0.996, 0.0, 3e-6)]
    ['2.1 %', '100 %', '0 %', 'below 0.01 %']
    """
    return "below 0.01 %" if 0 < share < 1e-4 else f"{to_figures(100 * share)} %"


def limit_text(part: str, total: str) -> str:
    """Name the largest part of the errors, with their total."""
    return f"limited by {part} (errors {total})"


def decimals_of(error: float) -> int:
    """Return the decimals that show an error to two figures."""
    return max(0, 1 - math.floor(math.log10(error)))


def round_down(number: float) -> float:
    """Round a positive number down to one digit."""
    step = 10.0 ** math.floor(math.log10(number))
    return float(f"{math.floor(number / step + 1e-9) * step:.1g}")


def with_error(value: float, error: float, sign: str = "") -> str:
    """Write a number with its error, to two figures of the error; "+" writes every sign.

    >>> with_error(97.13, 2.06), with_error(9e-7, 3.3e-4)
    ('97.1 ± 2.1', '(0.0 ± 3.3) × 10⁻⁴')
    """
    if not 0 < error < math.inf:
        return f"{value:{sign}.3g}"
    power, text = power_of_ten(max(abs(value), error))
    value, error = (number / 10.0**power for number in (value, error))
    digits = decimals_of(error)
    written = f"{value:{sign}.{digits}f} ± {error:.{digits}f}"
    return f"({written}) {text}" if text else written


class Summarised:
    """Mixin: shows its headline and its cautions instead of all its arrays."""

    def _summary(self) -> list[str]:
        """Return the lines below the title, the most important first."""
        result: Any = self
        lines = [str(result.headline)] if hasattr(result, "headline") else []
        if not hasattr(result, "cautions"):
            return [*lines, *(f"{fact.title}: {fact.text}" for fact in result.facts)]
        return lines + [each.text for each in result.cautions if each.code != "verdict"]

    def __repr__(self, most: int = 5, letters: int = 160) -> str:
        lines = [textwrap.shorten(line, letters, placeholder=" …") for line in self._summary()]
        if len(lines) > most:
            lines[most - 1 :] = [f"and {len(lines) - most + 1} more"]
        return "\n".join([type(self).__name__, *lines])


class ResultKind(StrEnum):
    """Kind of a result; its value is the attribute ``format`` of the result's file."""

    INVERSION = "shadowinv result"
    FIT = "shadowinv fit"
    FILM_DOSES = "shadowinv film pack"
    # Without images: of a shot of a store, of another program.
    FIELD = "shadowinv field"

    @classmethod
    def of(cls, attributes: Mapping[Any, Any]) -> ResultKind:
        """Return the kind of a dataset by its attributes."""
        file_format = attributes.get("format")
        if file_format in (cls.FIT, cls.FILM_DOSES):
            return cls(str(file_format))
        return cls.INVERSION if "report" in attributes else cls.FIELD

    @classmethod
    def from_noun(cls, noun: str) -> ResultKind:
        """Return the kind of a provenance, by its name in a sentence."""
        return next(kind for kind in cls if kind.noun == noun)

    @property
    def noun(self) -> str:
        """Name in a sentence."""
        return self.value.removeprefix("shadowinv ").replace("result", "inversion")


class Level(StrEnum):
    """How far a result can be trusted."""

    SOUND = "sound"
    CONDITIONAL = "depends on the beam"
    DOUBTFUL = "doubtful"
    FAILED = "failed"

    @property
    def is_success(self) -> bool:
        """Whether the work was done: commands exit with 0, and no face warns.

        What nobody measured is a condition of the result, not a fault.
        """
        return self in (Level.SOUND, Level.CONDITIONAL)


class Verdict(StrEnum):
    """Whether the field of an inversion or a fit is known, and why not."""

    DETERMINED = "determined"
    CONDITIONAL = "depends on the beam"
    DETECTOR = "depends on the detector"
    SEVERAL = "one of several"
    AMBIGUOUS = "one image cannot tell"
    UNCERTAIN = "too uncertain"
    EDGE = "reaches the edge"
    MISFIT = "does not fit"

    @property
    def level(self) -> Level:
        """How far a result with this verdict can be trusted, if it has no warnings."""
        if self in (Verdict.CONDITIONAL, Verdict.DETECTOR):
            return Level.CONDITIONAL
        return Level.SOUND if self is Verdict.DETERMINED else Level.DOUBTFUL


@dataclass(frozen=True)
class Assessment:
    """Verdict on a field, with its limit and the next step."""

    verdict: Verdict
    reason: str  # its limit in a few words; empty if there is nothing to say
    advice: str = ""  # the next step in a few words
    explanation: str = ""  # the reason in a sentence. Default: reason and advice
    caution: Caution | None = None  # the one that decided it, if one did

    def __post_init__(self) -> None:
        object.__setattr__(self, "explanation", self.explanation or self.short)

    @property
    def short(self) -> str:
        """Reason and advice, for a headline."""
        return ": ".join(filter(None, (self.reason, self.advice)))


def assess(case: Case, rules: Iterable[Callable[[Case], Assessment | None]]) -> Assessment:
    """Return the assessment by the first rule that applies to a case; one of them always does."""
    return next(filter(None, (rule(case) for rule in rules)))


@dataclass(frozen=True)
class Headline:
    """A result in one line of at most `MOST_WORDS`, which begins with its title.

    Its text is the peak of the main field with its error, its limit, the next step, and the first
    warning in a few words.
    """

    MOST_WORDS: ClassVar = 25

    level: Level  # failed if not converged, doubtful with a warning, else by the verdict
    text: str
    verdict: Verdict | None = None  # of results that have one

    @classmethod
    def of(
        cls,
        peaks: Iterable[str],
        assessment: Assessment,
        cautions: Iterable[Caution] = (),
        *,
        converged: bool = True,
    ) -> Headline:
        """Return the headline of a field by its peaks, without parts that would be too long."""
        doubts = list(cautions)
        level = Level.DOUBTFUL if doubts else assessment.verdict.level
        warnings = [each.short for each in doubts if each is not assessment.caution]
        text = "; ".join(filter(None, peaks))
        for part in filter(None, (assessment.reason, assessment.advice, *warnings[:1])):
            sign = ": " if part == assessment.advice else "; "
            longer = f"{text}{sign * bool(text)}{part}"
            if len(longer.split()) <= cls.MOST_WORDS:
                text = longer
        return cls(level if converged else Level.FAILED, text, assessment.verdict)

    @property
    def title(self) -> str:
        """The one word for trust: the verdict, or else the level."""
        if self.verdict is None or self.level is Level.FAILED:
            return self.level.value
        return self.verdict + ", with warnings" * (self.level is not self.verdict.level)

    def __str__(self) -> str:
        return f"{self.title.capitalize()}: {self.text}"


@dataclass(frozen=True, slots=True)
class Fact:
    """A property of a result in words."""

    key: str  # for programs, such as "image_residual"; the code of a caution
    title: str  # for people, such as "Image residual"
    text: str  # the value, with its unit
    level: Level = Level.SOUND  # not sound if it is a reason to doubt the result
    is_detail: bool = False  # about the work of the solver: windows fold it away
    short: str = ""  # the value for a headline or a panel's title; empty if it has no place there


def verdict_fact(verdict: Verdict) -> Fact:
    """Return a verdict, whose reason is in the headline."""
    return Fact("verdict", "Verdict", str(verdict), verdict.level)


def caution_facts(cautions: Iterable[Caution]) -> list[Fact]:
    """Return cautions as facts."""
    return [Fact(each.code, "Warning", each.text, Level.DOUBTFUL) for each in cautions]


def masked_fact(mask: BoolArray) -> list[Fact]:
    """Return the share of the pixels that a mask of used pixels excludes, if there are any."""
    excluded = 1 - float(mask.mean())
    return [Fact("masked", "Masked", f"{percent(excluded)} of the pixels")] if excluded else []


def error_fact(name: str, text: str) -> Fact:
    """Return a contribution to the error budget."""
    key = name if name.startswith("error") else f"error_{name}"
    return Fact(key.replace(" ", "_"), name.capitalize(), text)


def folded(facts: Iterable[Fact], shown: Collection[str]) -> tuple[Fact, ...]:
    """Return facts as a report shows them: those with other keys are details, unless doubtful."""
    return tuple(
        fact if fact.key in shown or not fact.level.is_success else replace(fact, is_detail=True)
        for fact in facts
    )


def time_fact(seconds: Mapping[str, float]) -> Fact:
    """Return the time of all stages and of each."""
    stages = ", ".join(f"{stage} {value:.2f}" for stage, value in seconds.items())
    return Fact("time", "Time", f"{sum(seconds.values()):.2f} s ({stages})", is_detail=True)
