"""What a widget computes, as plain arrays: no napari, no Qt.

- invert a shot: `ShotJob`
- keep the sites while the source stays: `PlanCache`
- estimate a source: `SourceJob`
- an array as a plane of floats: `plane_of`
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, OnWarning, Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.io.files import text_of
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.pipeline.cache import SourceCache, quick_source, same_array
from napari_shadowinv.preprocessing import Estimate, Filter, Preparation, UniformEstimate

if TYPE_CHECKING:
    from napari_shadowinv.inversion import Inversion
    from napari_shadowinv.physics.setup import Setup
    from napari_shadowinv.transport.sites import SitePlan

Crop = tuple[slice, slice]

PREVIEW_SITES = 5_000
PREVIEW_PIXELS = 10_000


@dataclass
class PlanCache:
    """The sites of the last run, for the next one with the same source."""

    hits: int = 0  # how often the work was saved
    _kept: tuple[tuple[Any, ...], FloatArray, BoolArray | None, SitePlan] | None = field(
        default=None, repr=False
    )
    _solved: tuple[SitePlan, Inversion] | None = field(default=None, repr=False)

    def plan(
        self,
        source: FloatArray,
        mask: BoolArray | None,
        options: InversionOptions,
        on_progress: OnProgress | None,
        should_stop: ShouldStop | None,
    ) -> SitePlan:
        """Return the sites for a source, made anew only if anything about them changed."""
        from napari_shadowinv.inversion import plan_sites

        key = (
            options.n_sites,
            options.lloyd_iterations,
            options.lloyd_tolerance,
            options.seed,
            options.boundary,
            options.margin,
            None if mask is None else options.floor,
        )
        if self._kept is not None:
            last_key, last_source, last_mask, plan = self._kept
            if key == last_key and _alike(source, last_source) and same_array(mask, last_mask):
                self.hits += 1
                return plan
        plan = plan_sites(
            source, options, mask=mask, on_progress=on_progress, should_stop=should_stop
        )
        # At once: a run that was cancelled may still be about to do the same.
        self._kept = key, source, mask, plan
        return plan

    def solved(self, plan: SitePlan) -> Inversion | None:
        """Return what `keep` was last given, if it was made with these sites."""
        solved = self._solved
        return solved[1] if solved is not None and solved[0] is plan else None

    def keep(self, plan: SitePlan, inversion: Inversion) -> None:
        """Remember an inversion made with these sites, to start the next one from."""
        self._solved = plan, inversion


def _alike(one: FloatArray, other: FloatArray) -> bool:
    # A filter keeps the mean of a uniform source to rounding only.
    return one.shape == other.shape and np.allclose(one, other, rtol=1e-9, atol=0)


@dataclass(frozen=True, eq=False)
class ShotJob:
    """One shot to invert, with all that it takes."""

    image: ArrayLike  # also one that is read only when it is needed
    source: ArrayLike | Path | Estimate
    mask: BoolArray | None = None  # true where a pixel is usable
    crop: Crop | None = None
    cleaning: Filter | None = None
    options: InversionOptions = field(default_factory=InversionOptions)
    cache: PlanCache = field(default_factory=PlanCache)
    estimates: SourceCache = field(default_factory=SourceCache)
    preview: bool = False
    source_mask: BoolArray | None = None  # an estimate of the source looks only where it is true
    setup: Setup | None = None
    warnings: tuple[str, ...] = ()  # what is known against the image

    def for_preview(self) -> ShotJob:
        """The same with few enough sites, and pixels of an estimate, to be quick."""
        wanted = self.options.n_sites or PREVIEW_SITES
        fewer = self.options.model_copy(update={"n_sites": min(wanted, PREVIEW_SITES)})
        return replace(self, options=fewer, preview=True)

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> Inversion:
        from napari_shadowinv.inversion import invert
        from napari_shadowinv.inversion.compilation import ensure_compiled
        from napari_shadowinv.inversion.normalise import number_of_sites, prepare

        report = Reporter(on_progress, should_stop)
        seconds: dict[str, float] = {}
        clock = time.perf_counter()
        report("prepare", 0, None, "image and source")
        image, mask, bare = self._image_and_masks()
        estimate = self._estimate()
        preparation = Preparation(() if self.cleaning is None else (self.cleaning,), estimate, bare)
        preparation.check(has_source=estimate is None, mask=mask)
        image = preparation.filtered(image, mask, should_stop)
        # Before the sites are spread: a mistake is told at once.
        report("prepare", 0, None)
        prepare(image, None, self.options, mask)
        if estimate is not None:
            report("source", 0, None, estimate.title)
        doubts = self._doubts_of_uniform()
        source = self._source(image, mask, preparation, should_stop, doubts.append)
        report("prepare", 0, None)
        prepare(image, source, self.options, mask)
        seconds["source"] = time.perf_counter() - clock
        ensure_compiled(on_progress, should_stop)
        clock = time.perf_counter()
        n_sites = number_of_sites((image.shape[0], image.shape[1]), self.options)
        options = self.options.model_copy(update={"n_sites": n_sites})
        plan = self.cache.plan(source, mask, options, on_progress, should_stop)
        seconds["sites"] = time.perf_counter() - clock
        inversion = invert(
            image,
            plan=plan,
            options=self.options,
            # What is kept must not depend on what was tried before it.
            start=self.cache.solved(plan) if self.preview else None,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        if self.preview:
            self.cache.keep(plan, inversion)
        spent = inversion.report.seconds
        seconds |= {stage: spent[stage] + seconds.get(stage, 0.0) for stage in spent}
        inversion = replace(inversion, report=replace(inversion.report, seconds=seconds))
        return inversion.with_warnings((*doubts, *self.warnings))

    def attributes(self) -> dict[str, str]:
        """What is done before the inversion, as `napari_shadowinv.io.dataset.provenance` tells."""
        told: dict[str, str] = {}
        done: dict[str, Any] = {}
        if self.crop is not None:
            rows, columns = self.crop
            done["crop"] = {"y": [rows.start, rows.stop], "x": [columns.start, columns.stop]}
        if self.cleaning is not None:
            done[self.cleaning.function] = self.cleaning.model_dump()
        if done:
            told["input_preparation"] = json.dumps(done)
        if isinstance(self.source, Estimate):
            guess = {"source_from": self.source.function, **self.source.model_dump()}
            told["source_preparation"] = json.dumps(guess)
        elif isinstance(self.source, Path):
            told["source_file"] = text_of(self.source.name)
        return told

    def _image_and_masks(self) -> tuple[FloatArray, BoolArray | None, BoolArray | None]:
        image = plane_of(self.image, "the image")
        masks = {"mask": self.mask, "source mask": self.source_mask}
        for name, mask in masks.items():
            if mask is not None and mask.shape != image.shape:
                raise InputError(
                    f"{name} has shape {mask.shape}, image {image.shape}: they must match"
                )
        if self.crop is None:
            return image, self.mask, self.source_mask
        usable, bare = (None if mask is None else mask[self.crop] for mask in masks.values())
        return _cropped(image, self.crop), usable, bare

    def _corner(self) -> tuple[int, int]:
        """First row and column of what is inverted."""
        return (0, 0) if self.crop is None else (self.crop[0].start, self.crop[1].start)

    def _estimate(self) -> Estimate | None:
        """How the source is guessed, for the part of the image that is inverted."""
        if not isinstance(self.source, Estimate):
            return None
        return self.source.placed(self.setup, np.shape(self.image), self._corner())

    def _doubts_of_uniform(self) -> list[str]:
        from napari_shadowinv.preprocessing import uniform_warnings

        if not isinstance(self.source, UniformEstimate):
            return []
        height, width = np.shape(self.image)
        top, left = self._corner()
        middle = (height - 1) / 2 - top, (width - 1) / 2 - left
        if self.crop is not None:
            height, width = (part.stop - part.start for part in self.crop)
        return list(uniform_warnings((height, width), self.setup, centre=middle))

    def _source(
        self,
        image: FloatArray,
        mask: BoolArray | None,
        preparation: Preparation,
        should_stop: ShouldStop | None,
        on_warning: OnWarning,
    ) -> FloatArray:
        from napari_shadowinv.inversion.normalise import checked_source

        if preparation.estimate is not None:
            most_pixels = PREVIEW_PIXELS if self.preview else None
            kept = partial(self.estimates.source, preparation.estimate, most_pixels=most_pixels)
            return preparation.estimated(image, mask, should_stop, on_warning, by=kept)
        assert not isinstance(self.source, Estimate)
        given = self.source
        if isinstance(given, Path):
            from napari_shadowinv.io import read_radiograph

            given = read_radiograph(given).image
        source = plane_of(given, "the source")
        whole = np.shape(self.image)
        if source.shape != whole:
            raise InputError(f"source has shape {source.shape}, image {whole}: they must match")
        if self.crop is not None:
            source = source[self.crop]
        source = preparation.filtered(source, mask, should_stop)
        return checked_source(source, np.ones(image.shape, bool) if mask is None else mask)


@dataclass(frozen=True, eq=False)
class SourceJob:
    """A source to estimate from a shot; quickly, if its pixels are to be merged first."""

    image: ArrayLike
    estimate: Estimate
    mask: BoolArray | None = None
    quick: bool = False

    def run(
        self, on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
    ) -> FloatArray:
        report = Reporter(on_progress, should_stop)
        report("source", 0, None, type(self.estimate).title)
        image = plane_of(self.image, "the image")
        if self.quick:
            source = quick_source(self.estimate, image, self.mask, PREVIEW_PIXELS, should_stop)
        else:
            source = self.estimate.source(image, self.mask, should_stop)
        report("source", 1, 1)
        return source


def plane_of(values: ArrayLike, name: str) -> FloatArray:
    """Return one image as floats, or say why it is none."""
    array = np.asarray(values)
    if array.ndim != 2:
        raise InputError(
            f"{name} has shape {array.shape}, expected two dimensions (y, x): choose one shot or "
            "one channel"
        )
    if array.dtype.kind not in "buif":
        raise InputError(f"{name} has values of type {array.dtype}, expected real numbers")
    return array.astype(np.float64)


def _cropped(image: FloatArray, crop: Crop) -> FloatArray:
    part = image[crop]
    if min(part.shape) < 4:
        raise InputError(
            f"the crop contains {part.shape[1]} × {part.shape[0]} pixels of the image, expected "
            "at least 4 × 4: draw a larger rectangle"
        )
    return part
