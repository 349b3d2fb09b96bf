"""How long a fit takes, told before it and while it runs: `Forecast`, `Course`, `PACE`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from napari_shadowinv._system.progress import Progress
from napari_shadowinv.fitting import FitOptions

# Measured on two cores, two to four images of 64² to 400² px whose rays do not cross; and by what
# factor fits take longer where they do (1.9 to 4), or where the cause of a misfit is looked for.
_SECONDS, _SECONDS_PER_PIXEL = 1.5, 5e-5
_WITH_CROSSING_RAYS = 4.0
_WITH_TWO_FIELDS, _WITH_A_BEAM = 1.5, 1.6  # times that
# Of the time that all else takes, and steps: those of the error bars. What beam and field can trade
# is found slowly.
_PER_SAMPLE, _STEPS_PER_SAMPLE = 0.008, 12.0
_PER_SAMPLE_OF_BEAM, _STEPS_PER_SAMPLE_OF_BEAM = 0.02, 50.0
_EVIDENCE_IN_SAMPLES = 20
_MINUTE, _HOUR = 60, 3600

# Shares of the time, and about how many steps they take; all stages without a name are starts.
_WEIGHTS = {"starts": 0.4, "smoothness": 0.4, "full size": 0.2}
_STEPS = {"starts": 140.0, "smoothness": 180.0, "full size": 20.0}
_ERROR_BARS = "error bars"
_WORDS = {"smoothness": "smoothness", "other starts": "smoothness", "full size": "full size"}
_WORDS |= {
    "point spread": "full size",
    "rivals": "full size",
    "samples": _ERROR_BARS,
    "evidence": _ERROR_BARS,
}
_PARTS = 1000  # of the bar


def duration_in_words(seconds: float) -> str:
    """Return a time that is known roughly."""
    if seconds < 2 * _MINUTE:
        return f"{float(f'{seconds:.1g}'):g} s" if seconds < 10 else f"{round(seconds, -1):g} s"
    if seconds < 2 * _HOUR:
        return f"{seconds / _MINUTE:.0f} min"
    return f"{seconds / _HOUR:.1f} h"


class Pace:
    """How much longer fits take here than where they were measured, as the last one told."""

    def __init__(self) -> None:
        self.factor: float | None = None

    def learn(self, forecast: Forecast, seconds: float) -> None:
        """Take over what a fit has taken."""
        self.factor = seconds / forecast.seconds


@dataclass(frozen=True)
class Forecast:
    """What a fit is made of, as far as its time depends on it."""

    shape: tuple[int, ...]
    images: int
    fields: int
    beam_is_unknown: bool
    samples: int

    @property
    def seconds(self) -> float:
        """About how long it takes if rays do not cross."""
        usual = _SECONDS + _SECONDS_PER_PIXEL * self.images * self.shape[0] * self.shape[1]
        usual *= _WITH_TWO_FIELDS if self.fields > 1 else 1
        usual *= _WITH_A_BEAM if self.beam_is_unknown else 1
        return usual * (1 + self.samples_weight)

    @property
    def samples_weight(self) -> float:
        """Time of the error bars over that of all else."""
        return self.samples * (_PER_SAMPLE_OF_BEAM if self.beam_is_unknown else _PER_SAMPLE)

    @property
    def samples_steps(self) -> float:
        """About how many steps the error bars take."""
        each = _STEPS_PER_SAMPLE_OF_BEAM if self.beam_is_unknown else _STEPS_PER_SAMPLE
        return self.samples * each

    def text(self, pace: Pace) -> str:
        """In a sentence."""
        count = "one image" if self.images == 1 else f"{self.images} images"
        what = f"{count} of {self.shape[0]} × {self.shape[1]} px"
        if self.fields > 1:
            what += f", {self.fields} fields"
        if self.beam_is_unknown:
            what += ", unknown beam"
        time = duration_in_words((pace.factor or 1) * self.seconds)
        if pace.factor is None:
            longest = duration_in_words(_WITH_CROSSING_RAYS * self.seconds)
            return f"{what}: about {time}, up to {longest} where rays cross."
        return f"{what}: about {time}, judging by the last fit."


PACE = Pace()


class Course:
    """Turns what a fit tells into progress that never goes back, and keeps its objectives."""

    def __init__(self, forecast: Forecast) -> None:
        self.history: list[tuple[str, float]] = []
        self._weights, self._expected = dict(_WEIGHTS), dict(_STEPS)
        if forecast.samples:
            self._weights[_ERROR_BARS] = forecast.samples_weight
            self._expected[_ERROR_BARS] = forecast.samples_steps
        self._stage, self._steps, self._done = "", 0, 0.0

    def heard(self, news: Progress) -> Progress:
        """Return where the fit is now: a share of the whole, and the stage in words."""
        if news.stage != "fit" or news.objective is None:
            return news
        name, value = news.message, news.objective
        self.history.append((name, value))
        stage = _WORDS.get(name, "starts")
        if stage not in self._weights:
            return news
        if stage != self._stage:
            self._stage, self._steps = stage, 0
        self._steps += 1
        self._done = max(self._done, self._share())
        words = f"stage {list(self._weights).index(stage) + 1} of {len(self._weights)}, {stage}"
        if stage == "starts":
            words += f" ({name})"
        return Progress(news.stage, int(_PARTS * self._done), _PARTS, words, value)

    def _share(self) -> float:
        stages = list(self._weights)
        before = sum(self._weights[one] for one in stages[: stages.index(self._stage)])
        within = 1 - math.exp(-2 * self._steps / self._expected[self._stage])
        return (before + within * self._weights[self._stage]) / sum(self._weights.values())


def forecast_of(
    shape: tuple[int, ...], images: int, fields: int, source: object, options: FitOptions
) -> Forecast:
    """Forecast a fit with the source and options that `fit` takes."""
    samples = options.samples if options.samples > 1 else 0
    samples += _EVIDENCE_IN_SAMPLES if options.evidence else 0
    return Forecast(shape, images, fields, isinstance(source, str), samples)
