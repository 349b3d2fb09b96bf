"""Results of a planned experiment: `ExperimentPlan`, of `PlannedShot`.

- the gain by a change of a stated number: `Gain`
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import (
    Fact,
    Headline,
    Level,
    Summarised,
    Verdict,
    percent,
    time_fact,
    to_figures,
)
from napari_shadowinv.options import Instrument
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions

_DETERMINED_SHARE = 0.9  # of the shots, for a field that would be determined
_SILENT_TOTALS = 3.0  # an error beyond so many reported ones is wrong in silence
_LIMITS = (0.16, 0.84)
_MIN_GAIN = 0.02  # of the error, worth a sentence
_LISTED_GAINS = 3
_LEAST_PART = 0.01  # of the largest one


@dataclass(frozen=True)
class Spread:
    """Median of a quantity over the shots, and the interval that holds 68 % of them."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread:
        """Return the spread of finite values; NaN without any."""
        finite = [value for value in values if math.isfinite(value)]
        if not finite:
            return cls(math.nan, math.nan, math.nan)
        low, high = np.quantile(finite, _LIMITS)
        return cls(float(np.median(finite)), float(low), float(high))

    @property
    def text(self) -> str:
        """In per cent, such as "2.1 % (68 % of the shots: 1.8 to 2.6 %)"."""
        if math.isnan(self.median):
            return "not known"
        if self.low == self.high:
            return percent(self.median)
        bounds = f"{percent(self.low).removesuffix(' %')} to {percent(self.high)}"
        return f"{percent(self.median)} (68 % of the shots: {bounds})"


@dataclass(frozen=True)
class PlannedShot:
    """A simulated shot and its inversion or fit; errors are shares of the field (r.m.s.)."""

    number: int  # of the draw
    verdict: Verdict  # of the inversion or fit, with its reason
    reason: str
    error: float  # made, over the image; it includes a wrong energy
    peak_error: float  # made in the largest magnitude, as a share of it, with its sign
    total: float  # reported
    parts: dict[str, float] = field(default_factory=dict)  # of the reported error, by causes
    # Standard deviations of the instrument's numbers after a fit over those before.
    scales: dict[str, float] = field(default_factory=dict)
    is_searched: bool = True  # whether a fit looked for alternatives and has error bars of its own

    @property
    def is_determined(self) -> bool:
        """Whether the verdict is "determined"."""
        return self.verdict is Verdict.DETERMINED


@dataclass(frozen=True)
class Gain:
    """Reported error after a change of one stated number, in the linear budget."""

    cause: str  # part of the error that the change makes smaller
    text: str  # the change in words
    total: float  # error after it, as a share of the field


@dataclass(frozen=True, eq=False, repr=False)
class ExperimentPlan(Summarised):
    """Simulated shots of an experiment with their inversions or fits."""

    title: str  # of the object
    setups: tuple[Setup, ...]  # of each image; none if it is planned in pixels
    shape: tuple[int, int]  # height and width of an image, px
    instrument: Instrument  # as stated, as are the options
    options: ExperimentOptions
    method: str  # "inversion" or "fit", by which fields were retrieved
    shots: tuple[PlannedShot, ...]  # one for each draw, in order
    images: FloatArray  # (L, H, W), counts of the first draw
    truth: FloatArray  # (2, H, W), displacement in the first image, px, at the stated energy
    retrieved: FloatArray  # (2, H, W), the same of the first draw
    seconds: dict[str, float]  # of each stage
    is_thin: bool = True  # whether the object is taken as thin, not traced
    limit: float = math.nan  # least error that the counts allow, as a share of the field

    @property
    def verdicts(self) -> dict[Verdict, int]:
        """How many shots have each verdict, the most frequent first."""
        return dict(Counter(shot.verdict for shot in self.shots).most_common())

    @property
    def determined_share(self) -> float:
        """Share of the shots whose field is determined."""
        return sum(shot.is_determined for shot in self.shots) / len(self.shots)

    @cached_property
    def error(self) -> Spread:
        """Error made, as a share of the field (r.m.s.)."""
        return Spread.of([shot.error for shot in self.shots])

    @cached_property
    def peak_error(self) -> Spread:
        """Error made at the peak, as a share of it, with its sign."""
        return Spread.of([shot.peak_error for shot in self.shots])

    @cached_property
    def total(self) -> Spread:
        """Error that the inversions or fits report, as a share of the field (r.m.s.)."""
        return Spread.of([shot.total for shot in self.shots])

    @property
    def ratio(self) -> float:
        """Error made over the reported one, r.m.s. over the shots; about 1 if that is right."""
        ratios = [shot.error / shot.total for shot in self.shots if shot.total > 0]
        return math.sqrt(np.mean(np.square(ratios))) if ratios else math.nan

    @property
    def silent(self) -> int:
        """How many shots are called determined and are wrong, by far more than is reported."""
        largest = self.options.max_error
        return sum(
            shot.is_determined and shot.error > max(largest, _SILENT_TOTALS * shot.total)
            for shot in self.shots
        )

    @cached_property
    def parts(self) -> dict[str, float]:
        """Medians of the parts of the reported error, the largest first."""
        names = dict.fromkeys(name for shot in self.shots for name in shot.parts)
        medians = {
            name: float(np.median([shot.parts[name] for shot in self.shots if name in shot.parts]))
            for name in names
        }
        return dict(sorted(medians.items(), key=lambda part: -part[1]))

    @property
    def ranking(self) -> list[tuple[str, float]]:
        """Titles and sizes of the parts that matter, the largest first."""
        least = _LEAST_PART * max(self.parts.values(), default=0.0)
        return [(self._title(name), share) for name, share in self.parts.items() if share >= least]

    @cached_property
    def gains(self) -> tuple[Gain, ...]:
        """Gains by a change of each stated number, the largest first.

        The linear budget says so, without further simulations: the part of a number that is known
        twice as well is half as large, or a quarter where it acts by its square; as far as the
        images of a fit do not determine the number anyway.
        """
        squares = {name: share**2 for name, share in self.parts.items()}
        total = math.sqrt(sum(squares.values()))
        gains = []
        for name, square in squares.items():
            if change := self._change_of(name):
                text, factor = change
                less = math.sqrt(max(total**2 - square * (1 - factor**2), 0.0))
                gains.append(Gain(name, text, less))
        return tuple(sorted(gains, key=lambda gain: gain.total))

    def _change_of(self, name: str) -> tuple[str, float] | None:
        """Return a change in words, and the factor on the part that it acts on."""
        if name == "noise":
            counts = 2 * self.options.counts
            return f"twice the counts ({counts:,.4g} a pixel)", math.sqrt(0.5)
        if name == "beam":
            size = self.instrument.beam_of(measured=self.options.is_recorded).rms
        else:
            size = float(getattr(self.instrument, name, 0.0) or 0.0)
        if not size:
            return None
        power = 2.0 if name == "blur" else 1.0
        scales = [shot.scales[name] for shot in self.shots if name in shot.scales]
        scale = min(float(np.median(scales)), 1.0) if scales else 1.0
        # Of a prior and data with known variances, in which the prior's becomes smaller.
        factor = 1 / math.sqrt(1 + (4.0**power - 1) * scale**2)
        unit, digits = ("px", 1.0) if name in ("blur", "registration") else ("%", 100.0)
        unit, digits = ("", 1.0) if name == "gamma" else (unit, digits)
        better, before = (f"{to_figures(digits * x)} {unit}".rstrip() for x in (size / 2, size))
        return f"{self._title(name)} known to {better} instead of {before}", factor

    @property
    def is_determined(self) -> bool:
        """Whether the field would be determined, in nine of ten shots or more."""
        return self.determined_share >= _DETERMINED_SHARE and not self.silent

    @property
    def headline(self) -> Headline:
        """Verdict on the experiment, error and its largest cause in one line."""
        count = len(self.shots)
        determined = round(self.determined_share * count)
        would = "would" if self.is_determined else "would not reliably"
        texts = [
            f"the field {would} be determined: {determined} of {count} simulated shots",
            f"error made {self.error.text}",
        ]
        if self.ranking:
            title, share = self.ranking[0]
            texts.append(f"limited by {title} {percent(share)}")
            if title == "beam" and self.instrument.beam_rms is None:
                rms = self.instrument.beam_of(measured=self.options.is_recorded).rms
                texts.append(f"its unevenness of {percent(rms)} is assumed: record a reference")
        if self.silent:
            texts.append(f"{self.silent} of them wrong without a warning")
        return Headline(Level.SOUND if self.is_determined else Level.DOUBTFUL, "; ".join(texts))

    @property
    def facts(self) -> tuple[Fact, ...]:
        """The plan in words, as every face shows it below the headline."""
        return tuple(self._facts())

    def _facts(self) -> Iterator[Fact]:
        yield from self._gain_facts()
        level = Level.SOUND if self.is_determined else Level.DOUBTFUL
        counts = ", ".join(f"{name} {n}" for name, n in self.verdicts.items())
        yield Fact("verdicts", "Verdicts", f"of {len(self.shots)} shots: {counts}", level)
        reasons = (shot.reason for shot in self.shots if not shot.is_determined)
        if reason := next(reasons, ""):
            yield Fact("reason", "Usual reason", reason, Level.DOUBTFUL)
        if self.silent:
            text = (
                f"{self.silent} of {len(self.shots)} shots are called determined, but the field is "
                f"off by more than {percent(self.options.max_error)} and {_SILENT_TOTALS:g} times "
                "the reported error: do not rely on the verdict in this experiment"
            )
            yield Fact("silent", "Warning", text, Level.DOUBTFUL)
        if not math.isnan(self.limit):
            text = (
                f"{percent(self.limit)} of the field (r.m.s.), known before any shot: by all waves "
                "of 2 px and more if the beam is known and rays do not cross; only assumptions "
                "about the field leave less"
            )
            yield Fact("limit", "Limit by counts", text)
        yield Fact("error", "Error made", f"{self.error.text} of the field (r.m.s.)")
        yield Fact("peak_error", "Error at the peak", self.peak_error.text)
        total = f"{self.total.text} of the field (r.m.s.)"
        if not math.isnan(self.ratio):
            total += f"; the error made is {to_figures(self.ratio)} times that (r.m.s.)"
        yield Fact("total", "Error reported", total)
        if ranking := ", ".join(f"{title} {percent(share)}" for title, share in self.ranking):
            yield Fact("limits", "Limited by", ranking)
        yield from self._caveat_facts()
        yield time_fact(self.seconds)

    def _gain_facts(self) -> Iterator[Fact]:
        before = math.sqrt(sum(share**2 for share in self.parts.values()))
        worth = [gain for gain in self.gains if gain.total < (1 - _MIN_GAIN) * before]
        listed = "; ".join(f"{gain.text}: {percent(gain.total)}" for gain in worth[:_LISTED_GAINS])
        if listed:
            text = f"reported error {percent(before)}; with {listed} (linear budget)"
            yield Fact("gains", "What a change buys", text)

    def _caveat_facts(self) -> Iterator[Fact]:
        searched = sum(shot.is_searched for shot in self.shots)
        if searched < len(self.shots):
            text = (
                f"alternative solutions were looked for in {searched} of {len(self.shots)} shots; "
                "the other fits start near the true field and have the error bars of these"
            )
            yield Fact("searched", "Not tested", text, is_detail=True)
        is_thin = "is thin and " if self.is_thin else ""
        text = (
            f"the object {is_thin}does not change between images; scattering, diffraction and the "
            "instrument's numbers that are not stated are left out"
        )
        if not self.is_thin:
            text += "; errors are those of the traced displacement, not of the line integral"
        yield Fact("assumed", "Assumed", text, is_detail=True)

    def _title(self, name: str) -> str:
        if name == "energy" and self.setups:
            return self.setups[0].beam_quantity().noun
        return "beam between energies" if name == "beam_between" else name.replace("_", " ")

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each shot, for a table."""
        return [
            {
                "draw": shot.number,
                "verdict": str(shot.verdict),
                "error": shot.error,
                "peak_error": shot.peak_error,
                "reported_error": shot.total,
                "searched": shot.is_searched,
                **{f"part_{name}": shot.parts.get(name, math.nan) for name in self.parts},
            }
            for shot in self.shots
        ]
