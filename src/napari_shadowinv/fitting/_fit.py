"""The forward model fitted to images: `fit`, and choices of fields compared: `compare`."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import (
    OnProgress,
    OnStep,
    Reporter,
    ShouldStop,
    measure_time,
    run_in_parallel,
)
from napari_shadowinv._system.validation import as_model
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Verdict
from napari_shadowinv.fitting.compilation import ensure_compiled
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, product
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import (
    ASSUMED,
    EXACT,
    Imperfect,
    numbers_in_units,
)
from napari_shadowinv.fitting.measurements import FitData, collect_data
from napari_shadowinv.fitting.pattern import (
    Pattern,
    find_pattern,
    log_evidence,
    noise_amplification,
)
from napari_shadowinv.fitting.posterior import (
    BeamError,
    BeamShifts,
    Posterior,
    Sample,
    compare_samples,
    displacement_errors,
    errors_by_part,
    largest_share,
    potentials_of,
    sampled_potentials,
    shifts_by_beam,
)
from napari_shadowinv.fitting.result import Basin, Fit, FitReport, FittedField
from napari_shadowinv.fitting.rivals import compare_rivals, transmission_of
from napari_shadowinv.fitting.search import (
    SMALL_PX,
    SPACING_WITH_NUMBERS,
    Minimum,
    Start,
    estimate_smoothness,
    in_recorded_pixels,
    refine_minimum,
    search,
    settle_minimum,
)
from napari_shadowinv.fitting.shots import Shots, list_shots
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.fitting.verdict import MISFIT_CHI2, assess_verdict, hidden_contrast
from napari_shadowinv.inversion import invert
from napari_shadowinv.inversion.imperfections import IMPERFECTIONS
from napari_shadowinv.inversion.samples import Pairs
from napari_shadowinv.options import FitOptions, Instrument, InversionOptions
from napari_shadowinv.physics.edge import edge_changes, edge_sides
from napari_shadowinv.physics.forward import jacobian_determinant

_FROM_FAR = ((4, 2.0), (4, 1.0), (2, 1.0))
_FROM_NEAR = ((4, 2.0), (2, 2.0), (2, 1.0))
_FROM_FIELD = ((4, 1.0), (2, 1.0))
_SHARES_OF_TRANSPORT = (1.0, 1.4, 1.9, 2.4)  # past caustics, transport is too weak
_ROUNDED = 8.0  # px
_TRANSPORT_SITES = 10_000
_DECIDES = 10.0  # in log evidence
_MIN_BLUR_SCORE = 4.0  # standard deviations
_DARKEST = 1e-3  # of a beam's mean
_MAX_RIVAL_CHI2 = 25.0  # a fit that ended further away is no start for a rival
_SPACING_OF_SAMPLES = 1 / 3  # px
_CHECKED = 2  # samples of an instrument that are solved, too
_SAMPLES_OF_BEAMS = 24  # at least, where each image has a beam of its own
# Before a field has been found, they would take its place.
_HELD_IN_SEARCH = frozenset({"gamma", "blur", "other_field"})


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

    Returns
    -------
    Fit

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
    seconds: dict[str, float] = {}
    rng = np.random.default_rng(options.seed)
    data = collect_data(shots, fields=fields, instrument=instrument, options=options)
    ensure_compiled(on_progress, should_stop)
    scene = data.scene
    on_step = report_steps("fit", on_progress, should_stop)
    # One image cannot tell the instrument from the object: its numbers stay at 0.
    alone = replace(EXACT, shapes=scene.imperfect.shapes[:1]) if data.unknown else EXACT
    with measure_time("starts", seconds):
        # A common beam comes after the field, where a source was recorded.
        common = set() if data.unknown or data.assumed else {"beam"}
        rough = replace(scene, held=_HELD_IN_SEARCH | common)
        if data.single:
            rough = replace(scene, imperfect=alone)
        minima = search(rough, collect_starts(data, on_step, should_stop), on_step)
        imperfect = scene.imperfect
        if data.instrument.absorption:
            transmission = transmission_of(data, minima[0], data.instrument.absorption)
            imperfect = replace(imperfect, shapes=(*imperfect.shapes, transmission))
        scene = replace(scene, imperfect=alone if data.single else imperfect)
        minima = [_adapt(minimum, scene.imperfect, rough.imperfect) for minimum in minima]
        if scene.imperfect.of_response and min(data.size) < SMALL_PX and data.near is None:
            # In pixels of two, λ and the errors of the instrument's numbers come out too small.
            minima[0] = in_recorded_pixels(scene, minima[0])
    is_near = data.near is not None
    with measure_time("smoothness", seconds):
        scene, best = estimate_smoothness(scene, minima[0], rng, on_step, is_near=is_near)
        if data.counted:
            scene = reweight_counts(data, scene, best)
            best = settle_minimum(scene, best, on_step)

    unsure = scene
    if data.single:
        # One image does not determine its instrument.
        unsure = replace(scene, imperfect=imperfect, held=imperfect.keys - alone.keys)

    def refine(on_step: OnStep) -> tuple[Scene, Unknowns, float, int, bool]:
        with measure_time("full size", seconds):
            return refine_minimum(scene, best, options, on_step, is_near=is_near)

    def explore(on_step: OnStep) -> tuple[tuple[Basin, ...], _Openness]:
        basins = _basins(scene, best, minima[1:], on_step)
        there = _adapt(best, unsure.imperfect, scene.imperfect)
        return basins, _find_openness(data, unsure, there, rng, options, on_step)

    begun, threads = time.perf_counter(), available_threads(scene.threads)
    works: list[Any] = [refine, explore]
    refined, (basins, openness) = run_in_parallel(works, threads, on_step)
    seconds["samples"] = max(time.perf_counter() - begun - seconds["full size"], 0.0)
    fine, unknowns, value, taken, ended = refined
    with measure_time("residual", seconds):
        # A fit of one image absorbs too much of its noise for the counts to be tested.
        is_counted = data.counted and not data.single
        stated = data.instrument.noise_correlation
        pattern = find_pattern(
            fine,
            unknowns,
            data.size,
            is_counted=is_counted,
            correlation=stated,
            noise=data.noise,
        )
        if pattern.lacks_counts and openness.posterior is not None:
            posterior = openness.posterior.reporting(lambda: on_step("samples", value))
            absorbed = posterior.count_determined(np.random.default_rng(options.seed))
            share = pattern.missing_counts - absorbed / np.count_nonzero(scene.weights)
            pattern = replace(pattern, missing_counts=share)
        is_off = pattern.is_certain or pattern.chi2 > MISFIT_CHI2
        # Blur leaves little of a pattern, and one image none.
        is_blurred = data.single or pattern.blur_score > _MIN_BLUR_SCORE
        if (is_off or is_blurred) and pattern.chi2 < _MAX_RIVAL_CHI2:
            only = "" if is_off else "blur"
            rivals = compare_rivals(data, scene, best, fields, on_step, only=only)
            pattern = replace(pattern, cause=rivals.cause(), tried=rivals.tried)
    with measure_time("samples", seconds):
        samples, pairs, errors = openness.samples, openness.pairs, openness.errors
        evidence = float("nan")
        if options.evidence:
            evidence = log_evidence(scene, best, fields, options, on_step)
        # What the weights do not include of it.
        least = float(np.sqrt(data.noise.expected_chi2.min()))
        amplification = max(noise_amplification(pattern.correlation) * least, 1.0)
        potentials = None
        if errors is not None:
            of_beam = () if openness.by_beam is None else openness.by_beam.changes
            shifts = [*of_beam, *openness.assumed.values()]
            potentials = sampled_potentials(scene, samples, shifts, data.size, options.seed)
            amplified = _amplify_noise(errors, openness.by_part, amplification)
            ratio = product(amplified.ravel(), amplified.ravel()) / product(
                errors.ravel(), errors.ravel()
            )
            potentials *= np.float32(np.sqrt(ratio))
            by_part = dict(openness.by_part)
            by_part["noise"] = amplification * by_part["noise"]
            openness = replace(openness, errors=amplified, by_part=by_part)
    found_by = FitReport(
        objective=value,
        iterations=taken,
        converged=ended,
        seconds=seconds,
        total=float("nan"),
        log_evidence=evidence,
        pattern=pattern.largest,
        noise_correlation=pattern.correlation,
        added=_added_light(data, fine, unknowns, samples, amplification),
        numbers=numbers_in_units(
            imperfect,
            imperfect.adapt(unknowns, scene.imperfect),
            [sample.change for sample in samples],
        ),
        sensitivities=openness.sensitivities,
        sampling=options.sampling,
        nonlinearity=float("nan") if pairs is None else pairs.nonlinearity,
        spread_ratio=float("nan") if pairs is None else pairs.spread_ratio,
    )
    return _result(
        data, fine, unknowns, fields, options, basins, openness, potentials, found_by, pattern
    )


def report_steps(
    task: str, on_progress: OnProgress | None, should_stop: ShouldStop | None
) -> OnStep:
    """Return a callback that reports each step of a task with its number."""
    report, numbers = Reporter(on_progress, should_stop), count(1)
    return lambda stage, objective: report(task, next(numbers), None, stage, objective)


def compare(
    shots: Shots,
    *,
    choices: Sequence[Sequence[str]] = (("B",), ("E",), ("B", "E")),
    instrument: Instrument | None = None,
    options: FitOptions | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> tuple[Fit, ...]:
    """Fit several choices of fields to the same images, to see which explains them.

    Parameters
    ----------
    shots, instrument, options, on_progress, should_stop
        As for `fit`; each shot has its setup.
    choices : sequence of sequence of str, default B alone, E alone, both
        Possible causes of the deflection.

    Returns
    -------
    tuple of Fit
        One for each choice, the likeliest first, by ``report.log_evidence``. A difference of 10
        decides: of those nearer to the likeliest, that with the fewest fields comes first.

    Raises
    ------
    InputError
        As `fit`, and if no setups are given.
    """
    listed = list_shots(shots)
    if any(shot.setup is None or shot.strength is not None for shot in listed):
        raise InputError(
            "comparing fields needs the setup of each image, and no strengths: how much each field "
            "displaces follows from the setups"
        )
    with_evidence = as_model(FitOptions, options, "options").model_copy(update={"evidence": True})
    fits = [
        fit(
            listed,
            fields=choice,
            instrument=instrument,
            options=with_evidence,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        for choice in choices
    ]
    least = max(each.report.log_evidence for each in fits) - _DECIDES

    def rank(one: Fit) -> tuple[float, float]:
        evidence = one.report.log_evidence
        return (len(one.fields) if evidence > least else np.inf), -evidence

    return tuple(sorted(fits, key=rank))


@dataclass(frozen=True)
class _Openness:
    """How far the images leave the best unknowns open, and how far an instrument would move them.

    `posterior` is that of counts; `pairs` compares samples with those that are solved in full;
    `errors`, `by_part` and `by_beam` are those of the displacement, `sensitivities` shares of it.
    `assumed` are the likely changes by a detector of which nothing was stated.
    """

    posterior: Posterior | None
    samples: list[Sample]
    pairs: Pairs | None
    errors: FloatArray | None
    by_part: dict[str, FloatArray]
    by_beam: BeamShifts | None
    assumed: dict[str, Unknowns]
    sensitivities: dict[str, float]


def _find_openness(
    data: FitData,
    scene: Scene,
    best: Minimum,
    rng: np.random.Generator,
    options: FitOptions,
    on_step: OnStep,
) -> _Openness:
    """Draw samples around the best unknowns."""

    def posterior_with(scene: Scene, start: Minimum, modes: SoftModes | None = None) -> Posterior:
        # What rays that are far apart add would tell fields from what resembles them.
        is_dense = scene.imperfect.resembles_fields
        middle = best.coarsen(scene, SPACING_WITH_NUMBERS if is_dense else _SPACING_OF_SAMPLES)
        return Posterior(middle, start.unknowns, rng, lambda: on_step("samples", best.value), modes)

    posterior = posterior_with(scene, best, None if data.single else copy(best.modes))
    count = options.samples if options.samples > 1 else 0
    if count and "beam_between" in scene.imperfect.keys:
        # A few directions hold most of the error, which a few samples find by chance only.
        count = max(count, _SAMPLES_OF_BEAMS)
    samples = posterior.draw_samples(count)
    is_solved = options.sampling == "resolve"
    if is_solved:
        checked, solved = samples, posterior.solve(samples)
    else:
        checked = samples[: _CHECKED if scene.imperfect.of_response else 0]
        solved = posterior.solve(checked, steps=1)
    pairs = compare_samples(posterior.scene, checked, solved) if solved else None
    samples = solved if is_solved else samples
    changes = [sample.change for sample in samples]
    errors = displacement_errors(scene, changes, data.size) if changes else None
    by_part = errors_by_part(scene, posterior, samples, data.size)
    if errors is not None and not by_part:
        by_part = {"noise": errors}
    by_beam = shifts_by_beam(data, scene, posterior, samples, options)
    sensitivities, assumed = {}, {}
    if samples:
        tested = replace(scene, imperfect=_tested_instrument(data, best))
        response = posterior_with(tested, _adapt(best, tested.imperfect, EXACT))
        exact = None if scene.imperfect.parts else posterior
        responses = response.responses(np.random.default_rng(options.seed), exact)
        moves = response.scene.displacement
        sensitivities = {
            key: largest_share(moves(change), moves(best.unknowns))
            for key, (change, _) in responses.items()
        }
        # Counts are those of a detector that is linear and has no dark level.
        if not (data.counted or data.instrument.has_numbers):
            assumed = {
                key: change.like(size * change.flat())
                for key, (change, size) in responses.items()
                if key in ASSUMED
            }
    return _Openness(
        posterior if data.counted else None,  # its Jacobians are large
        samples,
        pairs,
        errors=errors,
        by_part=by_part,
        by_beam=by_beam,
        assumed=assumed,
        sensitivities=sensitivities,
    )


def collect_starts(data: FitData, on_step: Any, should_stop: ShouldStop | None) -> list[Start]:
    """Return the starting points: no field, a field that is known, and inversions by transport."""
    # A beam that is about uniform comes after the field.
    scene, held = data.scene, data.assumed
    candidates = []
    if data.near is not None:
        return [Start("near field", ((2, 1.0),), data.start)]
    if data.start is not None:
        candidates.append(Start("given", ((2, 1.0),), data.start, held))
    if not data.single:
        candidates.append(Start("from far", _FROM_FAR, beam_held=held))
    candidates.append(Start("from near", _FROM_NEAR, beam_held=held))
    if data.unknown and not data.single:
        candidates.append(Start("from far, beam held", _FROM_FAR, beam_held=True))
    if scene.strengths.shape[1] > 1 or data.unknown:
        return candidates
    sizes = np.abs(scene.strengths[:, 0])  # zero where the object does not deflect: a blank shot
    weakest = int(np.argmin(np.where(sizes > 0, sizes, np.inf)))
    on_step("transport", float("nan"))
    transported = _transport_potential(data, weakest, should_stop)
    if transported is None:
        return candidates
    potential = gaussian_filter(transported, _ROUNDED) / scene.strengths[weakest, 0]
    if not data.single:
        return [*candidates, Start("transport", ((2, 2.0), (2, 1.0)), potential, held)]
    return candidates + [
        Start(f"{share:g} × transport", _FROM_FIELD, share * potential)
        for share in _SHARES_OF_TRANSPORT
    ]


def _transport_potential(
    data: FitData, number: int, should_stop: ShouldStop | None
) -> FloatArray | None:
    """The potential that transport makes of an image; None if it makes none of it."""
    height, width = data.size
    scene = data.scene
    image = scene.images[number, :height, :width]
    used = scene.weights[number, :height, :width] > 0
    pad = scene.pad
    beam = scene.beams[number, pad : pad + height, pad : pad + width]
    options = InversionOptions(
        n_sites=min(_TRANSPORT_SITES, height * width),
        negative="clip",
        threads=scene.threads,
        tolerance=0.05,
    )
    try:
        return invert(
            image, source=beam, mask=used, options=options, should_stop=should_stop
        ).potential
    except InputError:
        return None


def _tested_instrument(data: FitData, minimum: Minimum) -> Imperfect:
    """Return the imperfections to which each fit states its sensitivity."""
    sizes = {each.key: each.tested for each in IMPERFECTIONS if each.tested}
    shapes = transmission_of(data, minimum, sizes.pop("absorption"))
    return Imperfect(
        gamma=sizes["gamma"],
        blur=sizes["blur"] ** 2,
        background=sizes["background"],
        shapes=(shapes,),
    )


def _adapt(minimum: Minimum, imperfect: Imperfect, before: Imperfect) -> Minimum:
    return replace(minimum, unknowns=imperfect.adapt(minimum.unknowns, before))


def _amplify_noise(
    errors: FloatArray, by_part: Mapping[str, FloatArray], amplification: float
) -> FloatArray:
    """Return errors with those by correlated noise, which alone it makes larger."""
    more = (amplification**2 - 1) * by_part["noise"] ** 2
    return np.asarray(np.sqrt(errors**2 + more))


def reweight_counts(data: FitData, scene: Scene, minimum: Minimum) -> Scene:
    """Return the weights of counts from the expected instead of the recorded counts."""
    unknowns = minimum.in_pixels(1)
    expected = scene.model(unknowns)
    units = data.units[:, None, None]
    references, factors = data.reference_noise, data.noise.factors
    variances = np.maximum(expected * units, 1.0) + references[:, None, None] ** 2
    weights = units**2 / (variances * factors[:, None, None])
    return replace(scene, weights=np.where(scene.weights > 0, weights, 0.0))


def _basins(
    scene: Scene, best: Minimum, others: Sequence[Minimum], on_step: Any
) -> tuple[Basin, ...]:
    """The best answer and others, with the same λ and without blur.

    Smoother fields have decided which is best: the present λ favours what follows the
    noise.
    """
    ends = [best]
    for minimum in others[:2]:
        rival = minimum if minimum.bin == best.bin else in_recorded_pixels(scene, minimum)
        unknowns = rival.unknowns._replace(
            common=best.unknowns.common, separate=best.unknowns.separate
        )
        rival = replace(rival, unknowns=unknowns)
        ends.append(settle_minimum(scene, rival, on_step, "other starts"))
    middle = best.coarsen(scene)
    chi2 = [float(middle.chi2(end.unknowns).mean()) for end in ends]
    return tuple(
        Basin(end.start, end.value, each, best.distance(end), end.displacement)
        for end, each in zip(ends, chi2, strict=True)
    )


def _added_light(
    data: FitData, scene: Scene, unknowns: Unknowns, samples: Sequence[Sample], amplification: float
) -> dict[str, list[list[list[float]]]]:
    """Coefficients of light that adds to each image, in its unit, with standard deviations."""
    units = (data.units * np.exp(unknowns.brightness))[:, None]
    light = {}
    for number, block in enumerate(scene.added):
        values = units * unknowns.added[number]
        changes = [sample.change.added[number] for sample in samples]
        spreads = np.full_like(values, np.nan)
        if changes:
            spreads = units * amplification * np.sqrt(np.mean(np.square(changes), axis=0))
        light[block.title] = np.stack([values, spreads], axis=-1).tolist()
    return light


def _changes_by_edge(
    potentials: FloatArray, displacements: FloatArray, errors: FloatArray
) -> FloatArray:
    """Return each field's `edge_changes`, (M, k, 3, H, W), as far as they exceed other errors.

    Other errors, (M, 2, H, W), move the fields at the edge, too.
    """
    changes = np.array(list(map(edge_changes, potentials, displacements)))
    squares = (changes[:, :, 1:] ** 2).sum(axis=1).mean(axis=(1, 2, 3))
    explained = (errors**2).mean(axis=(1, 2, 3))
    excess = np.maximum(1 - explained / np.maximum(squares, 1e-300), 0.0)
    return np.asarray(np.sqrt(excess)[:, None, None, None, None] * changes)


def _with_edge(samples: FloatArray, changes: FloatArray, seed: int) -> FloatArray:
    """Add what lies beyond the edge, (M, k, H, W), to samples of potentials, (M, n, H, W)."""
    rng = np.random.default_rng([seed, *b"edge"])
    draws = rng.normal(size=(samples.shape[1], changes.shape[1]))
    beyond = np.einsum("sk,mkyx->msyx", draws, changes).astype(np.float32)
    return np.asarray(samples + beyond)


def _beam_error(data: FitData, by_beam: BeamShifts, displacements: FloatArray) -> BeamError:
    return BeamError(
        sensitivity=largest_share(by_beam.by_percent, displacements),
        variation=data.beam.rms,
        share=largest_share(by_beam.errors, displacements),
        scale=data.beam.length,
        assumed=data.assumed or (data.beam.rms > 0 and data.instrument.beam_rms is None),
    )


def _result(
    data: FitData,
    scene: Scene,
    unknowns: Unknowns,
    names: Sequence[str],
    options: FitOptions,
    basins: tuple[Basin, ...],
    openness: _Openness,
    samples: FloatArray | None,
    report: FitReport,
    pattern: Pattern,
) -> Fit:
    height, width = data.size
    errors, by_beam, by_part = openness.errors, openness.by_beam, openness.by_part
    if errors is not None and by_beam is not None:
        by_part, errors = {**by_part, "beam": by_beam.errors}, np.hypot(errors, by_beam.errors)
    for key, change in openness.assumed.items():
        by_part = {**by_part, key: displacement_errors(scene, [change], data.size)}
        errors = None if errors is None else np.hypot(errors, by_part[key])
    counts = scene.ray_counts(unknowns)
    units = data.units[:, None, None]
    used = scene.weights[:, :height, :width] > 0
    images = scene.images[:, :height, :width] * units
    model = scene.model(unknowns, counts)[:, :height, :width] * units
    brightness = np.exp(unknowns.brightness)
    beams = scene.beam(unknowns)[:, :height, :width] * units * brightness[:, None, None]
    displacements = scene.displacement(unknowns)[..., :height, :width].copy()
    potentials = potentials_of(scene, unknowns, data.size)
    total, sides = float("nan"), tuple[str, ...]()
    if errors is not None and samples is not None:  # which an error by the edge has to exceed
        changes = _changes_by_edge(potentials, displacements, errors)
        by_edge = np.sqrt((changes[:, :, 1:] ** 2).sum(axis=1))
        if by_edge.any():
            by_part, errors = {**by_part, "edge": by_edge}, np.hypot(errors, by_edge)
            samples = _with_edge(samples, changes[:, :, 0], options.seed)
        total = largest_share(errors, displacements)
        sides = edge_sides((by_edge**2).sum(axis=(0, 1)))
    fields = [
        FittedField(
            name,
            potentials[m],
            displacements[m],
            None if errors is None else errors[m],
            (float(scene.smoothness[m, 0]), float(scene.smoothness[m, 1])),
            None if samples is None else samples[m],
        )
        for m, name in enumerate(names)
    ]
    shares = {key: largest_share(each, displacements) for key, each in by_part.items()}
    parts = dict(sorted(shares.items(), key=lambda part: -part[1]))
    report = replace(
        report,
        total=total,
        parts=parts,
        sides=sides,
        beam=None if by_beam is None else _beam_error(data, by_beam, displacements),
        beam_rms=data.beam.rms,
        recorded=not data.assumed,
    )
    jacobians = [
        jacobian_determinant(moved)
        for moved in np.einsum("lm,mcyx->lcyx", scene.strengths, displacements)
    ]
    jacobian = max(jacobians, key=lambda each: int((each < 0).sum()))
    unassessed = Fit(
        images=images,
        mask=used,
        strengths=scene.strengths,
        fields=tuple(fields),
        source=beams,
        brightness=brightness * data.brightness,
        frames=unknowns.frames,
        reprojection=model,
        residual=np.where(used, images - model, 0.0),
        chi2=data.noise.relative_chi2(scene.chi2(unknowns, counts)),
        basins=basins,
        folded=float((jacobian < 0).mean()),
        verdict=Verdict.UNCERTAIN,
        explanation="",
        report=report,
        options=options,
        instrument=data.instrument,
        setups=data.setups or (),
        noise=data.noise_of(scene.weights),
    )
    verdict, explanation = assess_verdict(
        unassessed,
        pattern,
        jacobian,
        single=data.single,
        beam_unknown=data.unknown,
        hidden=hidden_contrast(model / np.maximum(beams, _DARKEST * units) - 1, used),
        searched=data.near is None,
        noise=data.noise,
    )
    return replace(unassessed, verdict=verdict, explanation=explanation)
