"""Work on layers in a thread, with its estimated time and progress.

- the pattern of all jobs: `Job`, `Finished`, `ImageJob`
- an inversion: `InversionJob`, with its cost: `estimate_cost`; its estimated source: `SourceJob`
- a fit: `FitJob`; the fit that refines an inversion: `refinement`
- time and progress of a fit: `TimeEstimate`, `FitProgress`
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

from napari_shadowinv._napari import layer_metadata as about
from napari_shadowinv._napari.fit_layers import fit_layers
from napari_shadowinv._napari.layer_metadata import KEY, Frame, Result, frame_of, result_of, role_of
from napari_shadowinv._napari.layers import LayerData, result_layers
from napari_shadowinv._napari.shots import shot_in_memory
from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.progress import OnProgress, Progress, Reporter, ShouldStop
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.fitting import Fit
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.options import (
    MAX_DEFAULT_SITES,
    FitChoices,
    FitOptions,
    InversionOptions,
)
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.pipeline.fit_run import refinement_choices, run_fit, run_refinement
from napari_shadowinv.pipeline.inversion_run import Cache, run
from napari_shadowinv.preprocessing import Estimate, Recipe, estimate_source
from napari_shadowinv.shot import Shot

# Twice what two fast cores take for two to four images of 64² to 400² px without crossing rays.
# Crossing rays, or a search for the cause of a misfit, multiply the time by 1.9 to 4.
_TIME_S, _TIME_PER_PIXEL_S = 0.45, 1.7e-5
_CROSSING_RAYS_FACTOR = 4.0
_TWO_FIELDS_FACTOR, _UNKNOWN_BEAM_FACTOR = 1.5, 1.2
# Time of an error bar's sample relative to the fit, and its steps. Modes that beam and field share
# converge slowly.
_TIME_PER_SAMPLE, _STEPS_PER_SAMPLE = 0.008, 12.0
_TIME_PER_BEAM_SAMPLE, _STEPS_PER_BEAM_SAMPLE = 0.012, 50.0
_EVIDENCE_IN_SAMPLES = 20
_MINUTE_S, _HOUR_S = 60, 3600

# Shares of the time, and approximate steps; all stages without a name belong to the starts. Samples
# for the error bars are drawn beside the fit at full size.
_WEIGHTS = {"starts": 0.4, "smoothness": 0.4, "full size": 0.2}
_STEPS = {"starts": 140.0, "smoothness": 180.0, "full size": 20.0}
_STAGE_NAMES = {"smoothness": "smoothness"} | dict.fromkeys(
    ("other starts", "full size", "point spread", "rivals", "samples", "evidence"), "full size"
)
_BAR_LENGTH = 1000
# Of an inversion; measured on two cores with images of 0.25 to 4 Mpx and 5,000 to 1,000,000 sites,
# including the layers of the result.
_SECONDS_PER_PIXEL, _SECONDS_PER_SITE = 3e-6, 11e-6
_BYTES, _BYTES_PER_PIXEL, _BYTES_PER_SITE = 200e6, 280.0, 1700.0
_MIN_PIXELS_FOR_ESTIMATE = 1_000_000
_PREVIEW_ROLES = ("field", "caustic")


def duration_in_words(seconds: float) -> str:
    """Format an approximate time with a suitable unit."""
    if seconds < 2 * _MINUTE_S:
        return f"{float(f'{seconds:.1g}'):g} s" if seconds < 10 else f"{round(seconds, -1):g} s"
    if seconds < 2 * _HOUR_S:
        return f"{seconds / _MINUTE_S:.0f} min"
    return f"{seconds / _HOUR_S:.1f} h"


@dataclass(frozen=True)
class TimeEstimate:
    """Properties of a fit that determine its time."""

    shape: tuple[int, ...]
    images: int
    fields: int
    beam_is_unknown: bool
    options: FitOptions

    @property
    def samples(self) -> int:
        """Number of random fields, plus as many as take the time of the evidence."""
        samples = self.options.samples if self.options.samples > 1 else 0
        return samples + (_EVIDENCE_IN_SAMPLES if self.options.evidence else 0)

    @property
    def seconds(self) -> float:
        """Estimated time in s without crossing rays."""
        seconds = _TIME_S + _TIME_PER_PIXEL_S * self.images * self.shape[0] * self.shape[1]
        seconds *= _TWO_FIELDS_FACTOR if self.fields > 1 else 1
        seconds *= _UNKNOWN_BEAM_FACTOR if self.beam_is_unknown else 1
        return seconds * (1 + self.samples_weight)

    @property
    def samples_weight(self) -> float:
        """Time of the error bars relative to the rest of the fit."""
        return self.samples * (_TIME_PER_BEAM_SAMPLE if self.beam_is_unknown else _TIME_PER_SAMPLE)

    @property
    def samples_steps(self) -> float:
        """Approximate number of steps of the error bars."""
        steps_per_sample = _STEPS_PER_BEAM_SAMPLE if self.beam_is_unknown else _STEPS_PER_SAMPLE
        return self.samples * steps_per_sample

    def text(self, pace: float | None) -> str:
        """Return the estimate as a sentence, for a `FitJob.pace`."""
        count = "one image" if self.images == 1 else f"{self.images} images"
        subject = f"{count} of {self.shape[0]} × {self.shape[1]} px"
        if self.fields > 1:
            subject += f", {self.fields} fields"
        if self.beam_is_unknown:
            subject += ", unknown beam"
        time = duration_in_words((pace or 1) * self.seconds)
        if pace is None:
            longest = duration_in_words(_CROSSING_RAYS_FACTOR * self.seconds)
            return f"{subject}: about {time}, up to {longest} if rays cross."
        return f"{subject}: about {time}, based on the last fit."


class FitProgress:
    """Converts messages of a fit to monotonic progress, and records its objectives."""

    def __init__(self, estimate: TimeEstimate) -> None:
        self.history: list[tuple[str, float]] = []
        self._weights, self._expected = dict(_WEIGHTS), dict(_STEPS)
        self._weights["full size"] += estimate.samples_weight
        self._expected["full size"] += estimate.samples_steps
        self._last_stage = "full size and error bars" if estimate.samples else "full size"
        self._stage, self._steps, self._done = "", 0, 0.0
        self._objective = float("nan")

    def update(self, progress: Progress) -> Progress:
        """Return the progress of the fit, with a share of the total time and the stage in words."""
        if progress.stage != "fit" or progress.objective is None:
            return progress
        name, value = progress.message, progress.objective
        self.history.append((name, value))
        if name != "samples":  # drawn in larger pixels, whose objective is another
            self._objective = value
        stage = _STAGE_NAMES.get(name, "starts")
        if stage != self._stage:
            self._stage, self._steps = stage, 0
        self._steps += 1
        stages = list(self._weights)
        index = stages.index(stage)
        before = sum(self._weights[earlier] for earlier in stages[:index])
        within = 1 - math.exp(-2 * self._steps / self._expected[stage])
        share = (before + within * self._weights[stage]) / sum(self._weights.values())
        self._done = max(self._done, share)
        words = {"starts": f"starts ({name})", "full size": self._last_stage}
        message = f"stage {index + 1} of {len(stages)}, {words.get(stage, stage)}"
        done = int(_BAR_LENGTH * self._done)
        return Progress(progress.stage, done, _BAR_LENGTH, message, self._objective)


@dataclass(frozen=True)
class CostEstimate:
    """Estimated time (s) and peak memory (bytes) of an inversion."""

    pixels: int
    sites: int
    seconds: float
    memory: float

    @property
    def exceeds_memory(self) -> bool:
        available = physical_memory()
        return available is not None and self.memory > available

    @property
    def text(self) -> str:
        """The estimate as a sentence; empty for small images."""
        if self.pixels < _MIN_PIXELS_FOR_ESTIMATE and not self.exceeds_memory:
            return ""
        text = (
            f"{self.pixels / 1e6:.3g} Mpx with {self.sites:,} sites: about "
            f"{duration_in_words(self.seconds)} and up to {self.memory / 1e9:.1f} GB"
        )
        if not self.exceeds_memory:
            return f"{text}."
        return (
            f"{text}, more than this machine's {(physical_memory() or 0) / 1e9:.1f} GB: crop or "
            "bin the image, or choose fewer sites."
        )


def estimate_cost(
    shape: tuple[int, ...], options: InversionOptions, pace: float = 1.0
) -> CostEstimate:
    """Estimate an inversion that takes `pace` times the reference time on this machine."""
    pixels = shape[0] * shape[1]
    sites = options.n_sites or min(pixels, MAX_DEFAULT_SITES)
    seconds = pace * (_SECONDS_PER_PIXEL * pixels + _SECONDS_PER_SITE * sites)
    memory = _BYTES + _BYTES_PER_PIXEL * pixels + _BYTES_PER_SITE * sites
    return CostEstimate(pixels, sites, seconds, memory)


@dataclass(frozen=True, eq=False)
class Finished:
    """The result of a job, and the layers that show it."""

    content: Any
    layer_data: LayerData

    @property
    def result(self) -> Result[Any]:
        result = result_of(self.layer_data[0][1])
        assert result is not None
        return result


class Job:
    """Something to compute in a thread, and the layers that come of it.

    Cancelled work that does not stop is left alone after `patience` (s).
    """

    patience: ClassVar[float] = 0.5

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Any:
        raise NotImplementedError

    def layers(self, content: Any) -> LayerData:
        """Describe the layers of the result, the lowest first."""
        raise NotImplementedError

    def work(self, on_progress: OnProgress, should_stop: ShouldStop) -> Finished:
        """Compute the result and describe its layers, both in the thread."""
        content = self.run(on_progress, should_stop)
        return Finished(content, self.layers(content))


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageJob(Job):
    """A job on the image of a layer."""

    task: ClassVar[str]

    recipe: Recipe
    name: str  # of the result
    frame: Frame
    origins: Mapping[str, str] = field(default_factory=dict)  # of its inputs, saved and reported
    image: Any = None  # the layer
    companions: tuple[Any, ...] = ()  # layers that lie on the image

    @property
    def image_name(self) -> str:
        return str(self.image.name)


@dataclass(frozen=True, eq=False, kw_only=True)
class InversionJob(ImageJob):
    """An inversion of a shot with its masks; image and source may be lazy."""

    task = "inversion"

    shot: Shot
    cache: Cache | None = None
    preview: bool = False

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Inversion:
        return run(
            self.recipe,
            shot_in_memory(self.shot, "the image", "the source"),
            on_progress=on_progress,
            should_stop=should_stop,
            cache=self.cache,
            preview=self.preview,
        )

    def layers(self, content: Inversion) -> LayerData:
        """Describe the layers of the inversion; of a preview only the field and its caustics."""
        name = f"{self.name} preview" if self.preview else self.name
        result = Result(content, content.setup, self.origins)
        layer_data = result_layers(result, self.frame, name)
        mask = self.shot.source_mask
        for _, keywords, _ in layer_data:
            if role_of(keywords) == about.SOURCE and mask is not None:
                masked = Shot(mask.astype(float), source_mask=mask)
                keywords["metadata"][KEY]["source_mask"] = self.recipe.move(masked).source_mask
        if self.preview:
            layer_data = [layer for layer in layer_data if role_of(layer[1]) in _PREVIEW_ROLES]
        return layer_data


@dataclass(frozen=True, eq=False)
class SourceJob(Job):
    estimate: Estimate
    shot: Shot  # its image may be lazy
    image: Any
    made_from: dict[str, str]

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> FloatArray:
        report = Reporter(on_progress, should_stop)
        report("source", 0, None, self.estimate.title)
        shot = shot_in_memory(self.shot, "the image")
        source = estimate_source(self.estimate, shot, should_stop)
        report("source", 1, 1)
        return source

    def layers(self, content: FloatArray) -> LayerData:
        layer: Any = self.image
        metadata = about.metadata_for(
            about.SOURCE,
            "",
            about.setup_of(layer),
            setup_origin=about.setup_origin_of(layer),
            made_from=self.made_from,
            source_mask=self.shot.source_mask,
        )
        keywords = {
            "name": f"{layer.name} source: {self.estimate.title}",
            "metadata": metadata,
            "colormap": layer.colormap.name,
            "contrast_limits": tuple(layer.contrast_limits),
            **about.frame_of(layer).keywords(),
        }
        return [(content, keywords, "image")]


@dataclass(frozen=True, eq=False, kw_only=True)
class FitJob(ImageJob):
    """A fit to several images; images and sources may be lazy.

    The recipe holds the choices of the fit and the setup of the first image.
    """

    task = "fit"
    pace: ClassVar[float | None] = None  # time of the last fit relative to its estimate

    shots: tuple[Shot, ...]  # with the names of their images

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(str(shot.name) for shot in self.shots)

    @property
    def image_name(self) -> str:
        return self.names[0]

    @property
    def choices(self) -> FitChoices:
        assert self.recipe.fit is not None
        return self.recipe.fit

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the images after the steps."""
        return self.recipe.shape_after(self.shots[0].shape)

    @cached_property
    def progress(self) -> FitProgress:
        """Progress of the fit, and its objectives so far."""
        return FitProgress(self.time_estimate)

    @property
    def time_estimate(self) -> TimeEstimate:
        choices, images = self.choices, len(self.shots)
        fields, is_unknown = len(choices.fields or ("B",)), choices.beam == "unknown"
        return TimeEstimate(self.shape, images, fields, is_unknown, choices.options)

    def run(self, on_progress: OnProgress, should_stop: ShouldStop) -> Fit:
        fit = self.compute(lambda state: on_progress(self.progress.update(state)), should_stop)
        FitJob.pace = sum(fit.report.seconds.values()) / self.time_estimate.seconds
        return fit

    def layers(self, content: Fit) -> LayerData:
        result = Result(content, content.setup, self.origins)
        return fit_layers(result, self.frame, self.name)

    def compute(self, on_progress: OnProgress, should_stop: ShouldStop) -> Fit:
        """Load the images, apply the recipe's steps, and fit."""
        names = [f"'{name}'" for name in self.names]
        shots = [
            replace(shot_in_memory(shot, name, f"the source of {name}"), name=name)
            for shot, name in zip(self.shots, names, strict=True)
        ]
        return run_fit(self.recipe, shots, on_progress=on_progress, should_stop=should_stop)


@dataclass(frozen=True, eq=False, kw_only=True)
class Refinement(FitJob):
    """A fit to the image of an inversion, starting from the inversion."""

    inversion: Inversion
    setup: Setup | None

    def compute(self, on_progress: OnProgress, should_stop: ShouldStop) -> Fit:
        return run_refinement(
            self.inversion,
            self.setup,
            self.choices,
            on_progress=on_progress,
            should_stop=should_stop,
        )


def refinement(layer: Any, image: Any, name: str, psf: float) -> Refinement:
    """Return the job that fits an inversion's image with its source, mask and setup.

    `layer` belongs to the inversion, `image` is the layer of its shot, or `layer` again.
    """
    result = result_of(layer)
    if result is None or not isinstance(result.content, Inversion):
        kind = "no result" if result is None else f"a {result.content.kind.noun}"
        raise InputError(
            f"layer '{layer.name}' shows {kind}: select a layer of an inversion's result, such as "
            "the field"
        )
    inversion, setup = result.content, result.setup
    start = f"the inversion of '{name}'"
    return Refinement(
        recipe=Recipe(fit=refinement_choices(inversion, setup, psf)),
        shots=(Shot(inversion.image, name=name),),
        name=f"{name} refined",
        frame=frame_of(layer),
        origins={"Start": start, "Point spread": f"σ {psf:g} px" if psf else "none"},
        image=image,
        inversion=inversion,
        setup=setup,
    )


def name_of_result(layer: Any) -> str:
    """Return the name of the result that a layer belongs to, or else the layer's name."""
    return str(about.metadata_of(layer).get("name") or layer.name)
