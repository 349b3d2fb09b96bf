"""The forward model fitted to images: `fit`."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop, measure_time
from napari_shadowinv._system.validation import as_model
from napari_shadowinv.fitting.compilation import ensure_compiled
from napari_shadowinv.fitting.exploration import PosteriorSummary, adapt, explore, find_basins
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import EXACT, Imperfect
from napari_shadowinv.fitting.measurements import FitData, collect_data
from napari_shadowinv.fitting.parallel import OnStep, run_in_parallel
from napari_shadowinv.fitting.pattern import (
    Pattern,
    find_pattern,
    noise_amplification,
)
from napari_shadowinv.fitting.result import Basin, Fit
from napari_shadowinv.fitting.rivals import compare_rivals, transmission_of
from napari_shadowinv.fitting.search import (
    SMALL_PX,
    FineMinimum,
    Minimum,
    estimate_smoothness,
    in_recorded_pixels,
    refine_minimum,
    search,
    settle_minimum,
    with_finer_knots,
)
from napari_shadowinv.fitting.shots import Shots
from napari_shadowinv.fitting.starts import collect_starts
from napari_shadowinv.fitting.summary import field_errors, report_of, summarise
from napari_shadowinv.fitting.verdict import VerdictLimits
from napari_shadowinv.options import FitOptions, Instrument

# Of the names of steps; those of starts are 0.
_STAGES = {"smoothness": 1} | dict.fromkeys(
    ("other starts", "full size", "point spread", "rivals", "samples"), 2
)


def fit(
    shots: Shots,
    *,
    fields: Sequence[str] = ("B",),
    instrument: Instrument | None = None,
    options: FitOptions | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Fit:
    """Find the fields, and the beam, that explain one or several images of one object.

    Rays may cross, images may be blurred, the beam may be unknown: the forward model is fitted
    as it is. Several images at different energies determine what one leaves open; the verdict
    says whether they do.

    Parameters
    ----------
    shots : Shot, array_like of shape (H, W), or sequence of them
        Images on one grid of pixels in the object plane, each with all that is known of it.
        Several need setups, or strengths. Without a source the beam is uniform, with the mean of
        each image; an unknown one is smooth, the same for all images but for its brightness.
        The brightness is fitted in any case where the instrument leaves beam or transmission open.
    fields : sequence of {"B", "E", "plasma", "phase"}, default ("B",)
        Cause of the deflection. Two fields need images of at least two energies.
    instrument : Instrument, optional
        How well beam, detector and alignment are known. What is stated is fitted together with the
        fields; what the images leave open of it enters the error bars. One image does not determine
        it. Default: exact, and a source that was not recorded may differ by 5 %.
    options : FitOptions, optional
        Everything else.
    on_progress, should_stop : callable, optional
        Receives a `Progress` after each step, with its objective; ends the work
        when it returns true.

    Raises
    ------
    InputError
        If shapes or values do not fit, or one image with an unknown source is given without
        ``FitOptions(ambiguous=True)``.
    InversionCancelled
        If `should_stop` returned true.

    Examples
    --------
    >>> from napari_shadowinv import Shot, synthetic_image
    >>> from napari_shadowinv.physics.phantoms import gaussian_blob
    >>> truth = gaussian_blob((64, 64), 40.0, 9.0).displacement
    >>> fast = Shot(synthetic_image(0.6 * truth), strength=0.6, noise=0.02)
    >>> slow = Shot(synthetic_image(truth), strength=1, noise=0.02)
    >>> found = fit([slow, fast], options=FitOptions(samples=0))
    >>> bool(np.abs(found.fields[0].displacement - truth).max() < 0.2)
    True
    """
    options = as_model(FitOptions, options, "options")
    rng = np.random.default_rng(options.seed)
    data = collect_data(shots, fields=fields, instrument=instrument, options=options)
    ensure_compiled(on_progress, should_stop)
    on_step = _report_steps(on_progress, should_stop)
    seconds: dict[str, float] = {}
    with measure_time("starts", seconds):
        minima = _search(data, on_step, should_stop)
    with measure_time("smoothness", seconds):
        minima = _with_smoothness(data, minima, rng, on_step)
    begun, threads = time.perf_counter(), available_threads(minima.scene.threads)
    works: list[Any] = [
        partial(_refine, data, minima),
        partial(_explore, data, minima, rng),
    ]
    (refined, seconds["full size"]), (basins, summary) = run_in_parallel(works, threads, on_step)
    seconds["samples"] = max(time.perf_counter() - begun - seconds["full size"], 0.0)
    with measure_time("residual", seconds):
        pattern = _find_pattern(data, minima, refined, summary, on_step)
        pattern = _with_cause(data, minima, pattern, on_step)
    with measure_time("samples", seconds):
        # What the weights do not include of it.
        least = float(np.sqrt(data.noise.expected_chi2.min()))
        amplification = max(noise_amplification(pattern.correlation) * least, 1.0)
        errors = field_errors(data, minima.scene, summary, amplification)
        report = report_of(data, minima.instrument, refined, summary, pattern)
    report = replace(report, seconds=seconds)
    return summarise(data, refined, basins, summary, errors, report, pattern)


@dataclass(frozen=True, eq=False)
class _Minima:
    """Ends of a search in a scene, the best first, and the instrument as stated.

    One image does not determine its instrument: the scene's is exact.
    """

    scene: Scene
    ends: list[Minimum]
    instrument: Imperfect

    @property
    def best(self) -> Minimum:
        return self.ends[0]

    @property
    def unsure(self) -> Scene:
        """The scene with the instrument as stated, whose numbers are not fitted to one image."""
        fixed = self.scene.held | (self.instrument.keys - self.scene.imperfect.keys)
        return replace(self.scene, imperfect=self.instrument, held=fixed)


def _search(data: FitData, on_step: OnStep, should_stop: ShouldStop | None) -> _Minima:
    """Descend from all starts, while numbers that would take the field's place are held."""
    scene = data.scene
    # One image cannot tell the instrument from the object: its numbers stay at 0.
    alone = replace(EXACT, shapes=scene.imperfect.shapes[:1]) if data.unknown else EXACT
    # A common beam comes after the field, where a source was recorded.
    common = set() if data.unknown or data.assumed else {"beam"}
    rough = replace(scene, held=frozenset({"gamma", "blur", "other_field"} | common))
    if data.single:
        rough = replace(scene, imperfect=alone)
    minima = search(rough, collect_starts(data, on_step, should_stop), on_step)
    instrument = scene.imperfect
    if data.instrument.absorption:
        transmission = transmission_of(data, minima[0], data.instrument.absorption)
        instrument = replace(instrument, shapes=(*instrument.shapes, transmission))
    scene = replace(scene, imperfect=alone if data.single else instrument)
    minima = [adapt(minimum, scene.imperfect, rough.imperfect) for minimum in minima]
    if scene.imperfect.of_response and min(data.size) < SMALL_PX and data.near is None:
        # In pixels of two, λ and the errors of the instrument's numbers come out too small.
        minima[0] = in_recorded_pixels(scene, minima[0])
    return _Minima(scene, minima, instrument)


def _with_smoothness(
    data: FitData, minima: _Minima, rng: np.random.Generator, on_step: OnStep
) -> _Minima:
    is_near = data.near is not None
    scene, best = estimate_smoothness(minima.scene, minima.best, rng, on_step, is_near=is_near)
    if not (data.options.smoothness or is_near):
        scene, best = with_finer_knots(scene, best, rng, on_step)
    if data.counted:
        scene = _reweight_counts(data, scene, best)
        best = settle_minimum(scene, best, on_step)
    return replace(minima, scene=scene, ends=[best, *minima.ends[1:]])


def _refine(data: FitData, minima: _Minima, on_step: OnStep) -> tuple[FineMinimum, float]:
    begun, is_near = time.perf_counter(), data.near is not None
    refined = refine_minimum(minima.scene, minima.best, data.options, on_step, is_near=is_near)
    return refined, time.perf_counter() - begun


def _explore(
    data: FitData, minima: _Minima, rng: np.random.Generator, on_step: OnStep
) -> tuple[tuple[Basin, ...], PosteriorSummary]:
    """Find how far the images leave the answer open, by other starts and by samples."""
    best, *rivals = minima.ends
    basins = find_basins(minima.scene, best, rivals, on_step)
    unsure = minima.unsure if data.single else minima.scene
    there = adapt(best, unsure.imperfect, minima.scene.imperfect)
    return basins, explore(data, unsure, there, rng, on_step)


def _find_pattern(
    data: FitData, minima: _Minima, refined: FineMinimum, summary: PosteriorSummary, on_step: OnStep
) -> Pattern:
    pattern = find_pattern(data, refined)
    if pattern.lacks_counts() and summary.posterior is not None:
        posterior = summary.posterior.reporting(lambda: on_step("samples", np.nan))
        absorbed = posterior.count_determined(np.random.default_rng(data.options.seed))
        share = pattern.missing_counts - absorbed / np.count_nonzero(minima.scene.weights)
        pattern = replace(pattern, missing_counts=share)
    return pattern


def _with_cause(
    data: FitData,
    minima: _Minima,
    pattern: Pattern,
    on_step: OnStep,
    *,
    least_blur: float = 4.0,
    most_chi2: float = 25.0,
) -> Pattern:
    """Find the likely cause of a pattern by rival fits.

    Blur leaves little of a pattern, so it is looked for from `least_blur` standard deviations on. A
    fit that ended further away than `most_chi2` is no start for a rival.
    """
    is_off = pattern.is_certain or pattern.chi2 > VerdictLimits.misfit_chi2
    is_blurred = data.single or pattern.blur_score > least_blur
    if not (is_off or is_blurred) or pattern.chi2 >= most_chi2:
        return pattern
    only = "" if is_off else "blur"
    rivals = compare_rivals(data, minima.scene, minima.best, on_step, only=only)
    return replace(pattern, cause=rivals.cause(), tried=rivals.tried)


def _report_steps(on_progress: OnProgress | None, should_stop: ShouldStop | None) -> OnStep:
    """Return a callback that reports each step with its stage: starts, smoothness, full size."""
    report, reached = Reporter(on_progress, should_stop), 0

    def on_step(name: str, objective: float) -> None:
        nonlocal reached
        reached = max(reached, _STAGES.get(name, 0))
        report("fit", reached, 3, name, objective)

    return on_step


def _reweight_counts(data: FitData, scene: Scene, minimum: Minimum) -> Scene:
    """Return the weights of counts from the expected instead of the recorded counts."""
    unknowns = minimum.in_pixels(1)
    expected = scene.model(unknowns)
    units = data.units[:, None, None]
    references, factors = data.reference_noise, data.noise.factors
    variances = np.maximum(expected * units, 1.0) + references[:, None, None] ** 2
    weights = units**2 / (variances * factors[:, None, None])
    return replace(scene, weights=np.where(scene.weights > 0, weights, 0.0))
