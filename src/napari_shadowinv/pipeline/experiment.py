"""An experiment before its shot: `plan_experiment`.

Shots are simulated with imperfections drawn from the stated instrument, and inverted (one image) or
fitted (several). The errors made, the errors reported and the verdicts say whether the field would
be determined, its limits, and the gain by a change.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Verdict, percent
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.fitting.compilation import ensure_compiled as ensure_fit_compiled
from napari_shadowinv.fitting.shots import NearField
from napari_shadowinv.inversion import invert
from napari_shadowinv.inversion.compilation import ensure_compiled as ensure_inversion_compiled
from napari_shadowinv.inversion.error_budget import ErrorBudget
from napari_shadowinv.options import FitOptions, Instrument, InversionOptions
from napari_shadowinv.physics.beam import BeamSetup
from napari_shadowinv.physics.field_grid import FieldGrid
from napari_shadowinv.physics.phantom_models import PhantomRecipe
from napari_shadowinv.physics.poisson import counting_error, potential_from_displacement
from napari_shadowinv.physics.setup import Setup, deflector_titles
from napari_shadowinv.pipeline.experiment_object import (
    PlannedObject,
    object_of_field,
    object_of_phantom,
)
from napari_shadowinv.pipeline.experiment_options import ExperimentOptions
from napari_shadowinv.pipeline.experiment_result import ExperimentPlan, PlannedShot
from napari_shadowinv.pipeline.experiment_shots import ExperimentInputs, ShotSimulator
from napari_shadowinv.shot import shots_of

_MIN_SIDE_PX = 32
_MIN_DISPLACEMENT_PX = 1e-6
_ERROR_SAMPLES = 6
_SAME_SIZE = 1e-6
# Verdicts that a fit without a search and without error bars cannot find itself.
_OF_SEARCH = (Verdict.UNCERTAIN, Verdict.SEVERAL, Verdict.AMBIGUOUS)


def plan_experiment(
    object: PlannedObject | PhantomRecipe | FieldGrid,
    setups: Setup | Sequence[Setup] | None = None,
    *,
    shape: tuple[int, int] | None = None,
    instrument: Instrument | None = None,
    options: ExperimentOptions | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> ExperimentPlan:
    """Simulate shots of an experiment, retrieve their fields, and compare these with the object.

    Parameters
    ----------
    object : PlannedObject, PhantomRecipe or FieldGrid
        The object: a phantom, or a field that is known from elsewhere.
    setups : Setup or sequence of Setup, optional
        The experiment of each image, with the same pixels at the object. Default: one image, and
        an object in pixels.
    shape : tuple of int, optional
        Height and width of an image in px. Default: of the known field, 200 × 200 for a phantom.
    instrument : Instrument, optional
        How well beam, detector and alignment are known: the imperfections are drawn from it, and
        inversions and fits take it into account. Default: exact, with a beam that is assumed.
    options : ExperimentOptions, optional
        Counts, reference, point spread, number of shots.
    on_progress, should_stop : callable, optional
        Receives a `Progress` after each shot; ends the work when it returns true.

    Returns
    -------
    ExperimentPlan

    Raises
    ------
    InputError
        If setups, object and shape do not fit together, or the object displaces no rays.
    InversionCancelled
        If `should_stop` returned true.

    Notes
    -----
    With one image the field is inverted, with several it is fitted. Only the first fits search for
    alternative solutions (`ExperimentOptions.searched`) and compute error bars; the others start
    near the true field with the smoothness of the first.

    Examples
    --------
    >>> from napari_shadowinv.physics.phantom_models import BlobRecipe
    >>> options = ExperimentOptions(counts=500, draws=2)
    >>> plan = plan_experiment(BlobRecipe(sigma=9), shape=(64, 64), options=options)
    >>> len(plan.shots)
    2
    """
    inputs = _checked_inputs(object, setups, shape, instrument, options)
    return _plan(inputs, Reporter(on_progress, should_stop))


def _checked_inputs(
    object: Any, setups: Any, shape: Any, instrument: Any, options: Any
) -> ExperimentInputs:
    options = as_model(ExperimentOptions, options, "options")
    instrument = as_model(Instrument, instrument, "instrument")
    check_instance(object, (PlannedObject, PhantomRecipe, FieldGrid), "object")
    if object is None:
        raise InputError("the object is None: expected a phantom or a field")
    listed = (setups,) if setups is None or isinstance(setups, BeamSetup) else tuple(setups)
    if not listed or (len(listed) > 1 and None in listed):
        raise InputError("the setups have gaps: expected the setup of each image")
    for setup in listed:
        check_instance(setup, BeamSetup, "setup")
    if isinstance(object, FieldGrid):
        object = object_of_field(object, listed[0])
    is_phantom = isinstance(object, PhantomRecipe)
    size = shape or ((200, 200) if is_phantom else object.shape)
    if len(size) != 2 or min(size) < _MIN_SIDE_PX:
        raise InputError(
            f"the shape is {tuple(size)}: expected height and width of {_MIN_SIDE_PX} px or more"
        )
    size = int(size[0]), int(size[1])
    if is_phantom:
        object = object_of_phantom(object, listed[0], size)
    inputs = ExperimentInputs(object, listed, size, instrument, options)
    _refuse_unsuitable(inputs)
    return inputs


def _refuse_unsuitable(inputs: ExperimentInputs) -> None:
    options, instrument, setups = inputs.options, inputs.instrument, inputs.setups
    if options.method == "inversion" and len(setups) > 1:
        raise InputError(
            f"received {len(setups)} setups and the method 'inversion', which takes one image: "
            "choose a fit, or give one setup"
        )
    if setups == (None,):
        for name in ("source_size", "resolution"):
            if getattr(options, name):
                raise InputError(
                    f"received {name} in m without a setup: give the setup, or the point spread in "
                    "px"
                )
    sizes = [setup.object_pixel_size for setup in setups if setup is not None]
    for number, size in enumerate(sizes[1:], start=2):
        if abs(size / sizes[0] - 1) > _SAME_SIZE:
            raise InputError(
                f"image {number} has pixels of {size * 1e6:.6g} µm at the object, the first of "
                f"{sizes[0] * 1e6:.6g} µm: expected the same"
            )
    if len(setups) > 1 and len(set(setups)) < len(setups):
        raise InputError("two setups are the same: give images of different energies")
    if instrument.noise_correlation:
        raise InputError(
            "received a noise correlation, but simulated pixels have independent noise: leave it "
            "out"
        )


def _plan(inputs: ExperimentInputs, report: Reporter) -> ExperimentPlan:
    start = time.perf_counter()
    options = inputs.options
    report("draws", 0, options.draws)
    simulator = ShotSimulator(inputs)
    if float(np.abs(simulator.truth).max()) < _MIN_DISPLACEMENT_PX:
        raise InputError(
            "the object displaces rays by nothing in this experiment: check its strength, the "
            "energy and the distances"
        )
    limit = counting_error(inputs.shape, options.counts * simulator.information)
    limit /= float(np.sqrt((simulator.truth**2).sum(axis=0).mean()))
    report("draws", 0, options.draws, f"limit by counts {percent(limit)}")
    ensure = ensure_fit_compiled if inputs.is_fit else ensure_inversion_compiled
    ensure(None, report.should_stop)
    prepared = time.perf_counter()
    retrieve = _fitted if inputs.is_fit else _inverted
    searched = min(options.searched, options.draws) if inputs.is_fit else options.draws
    done: list[PlannedShot] = []

    def draw_all(numbers: range, near: Fit | None) -> Iterator[_Retrieved]:
        def compute(number: int) -> _Retrieved:
            return retrieve(simulator, number, near, report.should_stop)

        with ThreadPoolExecutor(available_threads(options.threads)) as pool:
            tasks = [pool.submit(compute, number) for number in numbers]
            try:
                for task in as_completed(tasks):
                    done.append(task.result().shot)
                    report("draws", len(done), options.draws, _tally(done))
                yield from (task.result() for task in tasks)
            finally:
                pool.shutdown(cancel_futures=True)

    results = list(draw_all(range(searched), None))
    first = results[0]
    results += draw_all(range(searched, options.draws), first.fit)
    ended = time.perf_counter()
    return ExperimentPlan(
        title=inputs.object.title,
        setups=tuple(setup for setup in inputs.setups if setup is not None),
        shape=inputs.shape,
        instrument=inputs.instrument,
        options=options,
        method="fit" if inputs.is_fit else "inversion",
        shots=_with_error_bars([each.shot for each in results]),
        images=first.images,
        truth=simulator.truth,
        retrieved=first.displacement,
        seconds={"prepare": prepared - start, "shots": ended - prepared},
        is_thin=inputs.object.is_thin,
        limit=limit,
    )


def _tally(shots: Sequence[PlannedShot]) -> str:
    determined = sum(shot.is_determined for shot in shots)
    error = percent(float(np.median([shot.error for shot in shots])))
    return f"error made {error}, determined {determined} of {len(shots)}"


class _Retrieved(NamedTuple):
    shot: PlannedShot
    images: FloatArray
    displacement: FloatArray
    fit: Fit | None


def _inverted(
    simulator: ShotSimulator, number: int, near: Fit | None, should_stop: ShouldStop | None
) -> _Retrieved:
    inputs, shots = simulator.inputs, simulator.draw(number)
    options, (setup,) = inputs.options, inputs.setups
    # An inversion does not correct the known point spread: it adds to the unknown one.
    blur = float(np.hypot(inputs.instrument.blur, inputs.psf[0]))
    inversion = invert(
        shots.images[0],
        source=shots.source,
        instrument=inputs.instrument.model_copy(update={"blur": blur}),
        measured=options.is_recorded,
        options=InversionOptions(max_error=options.max_error, threads=1),
        should_stop=should_stop,
    )
    inversion = inversion.in_units(setup)
    assessment, errors = inversion.assessment, inversion.field_errors
    shot = PlannedShot(
        number,
        assessment.verdict,
        assessment.reason,
        *_errors_made(inversion.displacement, simulator.truth),
        total=np.nan if errors is None else errors.share,
        parts={} if errors is None else _parts_of(errors),
    )
    return _Retrieved(shot, shots.images, inversion.displacement, None)


def _fitted(
    simulator: ShotSimulator, number: int, near: Fit | None, should_stop: ShouldStop | None
) -> _Retrieved:
    inputs, shots = simulator.inputs, simulator.draw(number)
    options, setups = inputs.options, inputs.setups
    noise: Any = "poisson"
    if shots.source is not None and shots.source_noise:  # by the counts of image and reference
        means = gaussian_filter(shots.images, (0, 1.0, 1.0))
        noise = np.sqrt(np.maximum(means, 1.0) + shots.source * shots.source_noise)
    images = shots_of(
        shots.images,
        setup=setups,
        source=shots.source,
        psf=inputs.psf,
        noise=noise,
        measured=options.is_recorded,
    )
    if near is not None:
        start = NearField(potential_from_displacement(simulator.truth), near.fields[0].smoothness)
        images[0] = replace(images[0], start=start)
    result = fit(
        images,
        fields=_fields_of(inputs),
        instrument=inputs.fitted_instrument,
        options=FitOptions(
            samples=_ERROR_SAMPLES if near is None else 0, max_error=options.max_error, threads=1
        ),
        should_stop=should_stop,
    )
    displacement = result.fields[0].displacement
    parts, total, verdict = _fit_errors(result, inputs)
    shot = PlannedShot(
        number,
        verdict,
        result.explanation,
        *_errors_made(displacement, simulator.truth),
        total=total,
        parts=parts,
        scales=_scales_of(result, inputs),
        is_searched=near is None,
    )
    return _Retrieved(shot, shots.images, displacement, result)


def _fields_of(inputs: ExperimentInputs) -> tuple[str, ...]:
    setup = inputs.setups[0]
    cause = inputs.object.cause(setup)
    if setup is None or cause is None:
        return ("B",)
    return tuple(key for key, title in deflector_titles().items() if title == cause)


def _errors_made(displacement: FloatArray, truth: FloatArray) -> tuple[float, float]:
    """Return the error over the image, r.m.s., and at the peak, as shares of the field."""
    error = float(np.linalg.norm(displacement - truth) / np.linalg.norm(truth))
    peaks = [float(np.hypot(*field).max()) for field in (displacement, truth)]
    return error, peaks[0] / peaks[1] - 1


def _parts_of(errors: ErrorBudget) -> dict[str, float]:
    """Return the parts of a budget as shares of the field, by the causes' names."""
    names = {"beam between energies": "beam_between", "wavelength": "energy"}
    return {
        names.get(title, title.replace(" ", "_")): share for title, share in errors.shares.items()
    }


def _fit_errors(result: Fit, inputs: ExperimentInputs) -> tuple[dict[str, float], float, Verdict]:
    """Return the parts of a fit's error, the total, and the verdict, with the energy's error."""
    verdict, setup = result.verdict, inputs.setups[0]
    if result.errors is None:
        return {}, np.nan, verdict
    name = "" if setup is None else setup.main_field.name
    errors = result.errors.in_field(setup, name, inputs.instrument.energy)
    if verdict is Verdict.DETERMINED and errors.share > inputs.options.max_error:
        verdict = Verdict.UNCERTAIN
    return _parts_of(errors), errors.share, verdict


def _scales_of(result: Fit, inputs: ExperimentInputs) -> dict[str, float]:
    """Return standard deviations of the instrument's numbers over those that were stated."""
    instrument, beam = inputs.instrument, inputs.beam
    stated = {
        "beam": beam.rms,
        "beam_between": beam.between,
        "gamma": instrument.gamma,
        "background": instrument.background,
        "blur": instrument.blur**2,
        "absorption": instrument.absorption,
        "other_field": 1.0,
    }
    scales = {}
    for key, rows in result.report.numbers.items():
        deviation = float(np.sqrt(np.mean([row[1] ** 2 for row in rows])))
        if stated.get(key) and np.isfinite(deviation):
            scales[key] = deviation / stated[key]
    return scales


def _with_error_bars(shots: Sequence[PlannedShot]) -> tuple[PlannedShot, ...]:
    """Copy error bars, and verdicts by them, to the fits that have none."""
    searched = [shot for shot in shots if shot.is_searched]
    if len(searched) == len(shots):
        return tuple(shots)
    total = float(np.median([shot.total for shot in searched]))
    doubts = [shot for shot in searched if shot.verdict in _OF_SEARCH]
    completed = []
    for shot in shots:
        if not shot.is_searched:
            shot = replace(shot, total=total)
            if shot.is_determined and doubts:
                shot = replace(shot, verdict=doubts[0].verdict, reason=doubts[0].reason)
        completed.append(shot)
    return tuple(completed)
