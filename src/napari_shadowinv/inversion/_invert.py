"""Inversion of an image to its deflection potential: `invert`, `plan_sites`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.machine import begin
from napari_shadowinv._system.progress import (
    OnProgress,
    Progress,
    Reporter,
    ShouldStop,
    measure_time,
)
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import to_figures
from napari_shadowinv.inversion.budget import Budget
from napari_shadowinv.inversion.error_budget import ErrorBudget
from napari_shadowinv.inversion.machine_code import loading_kernels
from napari_shadowinv.inversion.noise import ImageNoise
from napari_shadowinv.inversion.normalise import (
    Prepared,
    dark_in,
    margin_around,
    mask_unlit,
    number_of_sites,
    prepare,
)
from napari_shadowinv.inversion.plans import SpreadBeam, plan_over
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.inversion.result import Cells, Inversion, Report
from napari_shadowinv.inversion.solution_checks import (
    find_cautions,
    image_residual,
    is_coarse,
    mark_caustics,
)
from napari_shadowinv.options import MAX_DEFAULT_SITES, Instrument, InversionOptions
from napari_shadowinv.physics.arrays import unpack_array
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.preprocessing.alignment import RegisteredSource, register_source
from napari_shadowinv.preprocessing.image_checks import CheckedImage, image_cautions
from napari_shadowinv.transport.sites import RATIO, Levels, SitePlan, are_middles, edge_flux
from napari_shadowinv.transport.solvers import LevelSolution, solve

# Steps of the read-out: up to the first number the potential, then the re-projection.
_READ_STEPS = 30
_STEPS = 100

# Of the re-projection, along one axis. For sites 2 px apart, 16 rays per pixel differ from 144 by
# 0.01 to 0.06 % of the mean (r.m.s.), a fiftieth of the residual that so few sites leave.
_TILES_PER_SPACING = 8.0
_MOST_TILES = 4  # per pixel


def plan_sites(
    source: ArrayLike,
    options: InversionOptions | None = None,
    *,
    mask: ArrayLike | None = None,
    measured: bool = True,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> SitePlan:
    """Place the sites over a source, once for all images that share it.

    Where their number follows from the accuracy, they are placed as inversions need them.

    Parameters
    ----------
    source : array_like, shape (H, W)
        The undisturbed beam.
    options : InversionOptions, optional
        Options of the solver and the read-out have no effect.
    measured : bool, optional
        Whether the source was recorded. If it is an estimate, the errors of an inversion include
        the effect of another beam.
    mask, on_progress, should_stop
        As of `invert`.

    Returns
    -------
    SitePlan
        To be passed to `invert` as `plan`.

    Raises
    ------
    InputError
        If the source is no image of a beam or the sites do not fit in memory.
    InversionCancelled
        If `should_stop` returned true.
    """
    options = as_model(InversionOptions, options, "options")
    plan = plan_over(unpack_array(source, "source"), options, unpack_array(mask, "mask"), measured)
    plan = replace(plan, source=plan.source.copy())  # the caller's may change
    if options.is_adaptive:
        return plan
    levels = plan.levels.with_reporter(Reporter(on_progress, should_stop))
    return replace(plan, levels=levels.compute_all(options.threads))


@loading_kernels()
def invert(
    image: ArrayLike,
    *,
    source: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    options: InversionOptions | None = None,
    instrument: Instrument | None = None,
    plan: SitePlan | None = None,
    start: Inversion | None = None,
    measured: bool = True,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Inversion:
    """Retrieve the deflection potential that turns the source into the image.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot: counts or any linear measure of fluence.
    source : array_like, shape (H, W), optional
        The undisturbed beam. Default: uniform. The image is scaled to its flux, so their units
        need not match.
    mask : array_like of bool, shape (H, W), optional
        True at usable detector pixels. Image and source are continued smoothly into gaps between
        them (fiducials, handwriting, saturation) that are narrower than a fifth of the image;
        wider parts (beyond the edge of the film), and those where the source is dark, carry no
        flux. Set opaque obstacles to zero in `source` instead: their shadows move with the rays.
    options : InversionOptions, optional
        The defaults suit most images.
    instrument : Instrument, optional
        How well beam, detector and alignment are known, for the error budget. Default: exact, but
        for a source that was not recorded.
    plan : SitePlan, optional
        Sites prepared by `plan_sites`, instead of `source` and `mask`. If it was made with a number
        of sites, this number overrides the options.
    start : Inversion, optional
        Inversion of a similar image (the previous shot, another filter) on the same sites. The
        solver starts from its weights and, if the images are similar, needs only a few
        iterations; if it stalls, it restarts from scratch. The result is the same within the
        tolerance.
    measured : bool, default True
        Whether the source was recorded. If it is an estimate, the errors include the effect of
        another beam.
    on_progress : callable, optional
        Called regularly with a `Progress`.
    should_stop : callable, optional
        Called regularly; the inversion is cancelled when it returns true.

    Returns
    -------
    Inversion
        Even if the solver did not converge; its report then gives the residual and the reason.

    Raises
    ------
    InputError
        If image or source cannot be inverted, the source is the image itself, or `start` has
        other sites.
    InversionCancelled
        If `should_stop` returned true.

    References
    ----------
    Kasim et al., arXiv:1607.04179, section III and its algorithm.

    Examples
    --------
    A uniform image needs no deflection:

    >>> inversion = invert(np.full((20, 20), 7.0))
    >>> float(abs(inversion.displacement).max())
    0.0
    """
    options = as_model(InversionOptions, options, "options")
    instrument = as_model(Instrument, instrument, "instrument")
    check_instance(plan, SitePlan, "plan")
    check_instance(start, Inversion, "start")
    report = Reporter(on_progress, should_stop)
    seconds: dict[str, float] = {}
    with measure_time("prepare", seconds):
        report("prepare", 0, 1)
        inputs = _prepare(image, source, mask, options, instrument, plan, start, measured=measured)
        report("prepare", 1, 1)
    problem = _pose(inputs, options, report, seconds)
    solution = _solve(problem, report, seconds)
    return _assess(problem, solution, seconds)


class _Inputs(NamedTuple):
    """An image and its source as they are inverted, and a plan and a start that still suit them."""

    prepared: Prepared
    image: ArrayLike
    source: ArrayLike | None  # in register
    mask: BoolArray | None
    plan: SitePlan | None
    start: Inversion | None
    instrument: Instrument
    registered: RegisteredSource
    unlit: list[Caution]
    is_dark: BoolArray | bool
    measured: bool


def _prepare(
    image: ArrayLike,
    source: ArrayLike | None,
    mask: ArrayLike | None,
    options: InversionOptions,
    instrument: Instrument,
    plan: SitePlan | None,
    start: Inversion | None,
    *,
    measured: bool,
) -> _Inputs:
    """Mask unlit pixels, check image and source, and bring a recorded source into register."""
    image = unpack_array(image, "image")
    if plan is None:
        source, mask = unpack_array(source, "source"), unpack_array(mask, "mask")
        measured = measured and source is not None
    else:
        _check_plan(plan, options, has_own=source is None and mask is None, measured=measured)
        source, mask, measured = plan.source, plan.mask, plan.measured
    recorded = source if measured else None
    mask, unlit = mask_unlit(image, recorded, mask)
    is_dark: BoolArray | bool = False
    if recorded is not None and mask is not None:
        is_dark = dark_in(np.asarray(recorded), mask)
    if unlit and plan is not None:
        plan, start = plan_over(plan.source, options, mask, plan.measured), None
    prepared = prepare(image, source, options, mask)
    registered = RegisteredSource(prepared.source, 0.0)
    if measured:
        registered = register_source(prepared.image, prepared.source, prepared.mask, instrument)
        instrument = instrument.with_registration(registered.error)
        source, is_moved = registered.source, registered.source is not prepared.source
        if is_moved:
            plan = start = None
            prepared = prepare(image, source, options, mask)
    return _Inputs(
        prepared, image, source, mask, plan, start, instrument, registered, unlit, is_dark, measured
    )


@dataclass(frozen=True, eq=False)
class _Problem:
    """An inversion's plan and image, its error budget, and checks in threads beside the transport.

    `noise` and `checks` wait for their results; the checks begin when `checks` is first looked up.
    """

    inputs: _Inputs
    plan: SitePlan
    levels: Levels  # to be solved, at most
    options: InversionOptions
    noise: Callable[[], ImageNoise]
    budget: Budget

    @property
    def prepared(self) -> Prepared:
        """The image and its source."""
        return self.inputs.prepared

    @property
    def is_adaptive(self) -> bool:
        """Whether the number of sites follows from the errors."""
        is_free = self.options.is_adaptive and not self.levels.is_complete
        return is_free and self.inputs.start is None

    @cached_property
    def checks(self) -> Callable[[], tuple[Caution, ...]]:
        """Wait for the cautions about image and source."""
        # Not of a method: a problem that refers to itself would keep its memory.
        return begin(
            partial(_check_image, self.plan, self.prepared, self.noise), self.options.threads
        )

    def needed(self, solutions: Sequence[LevelSolution]) -> float:
        """Return the factor by which more sites are needed; see `Budget.needed`."""
        factor = self.budget.needed(solutions)
        finer = sum(count > len(solutions[-1].weights) for count in self.levels.counts)
        if factor <= RATIO or finer == 1:
            _ = self.checks  # begin, while the solver waits for the sites of the last level
        return factor


def _pose(
    inputs: _Inputs, options: InversionOptions, report: Reporter, seconds: dict[str, float]
) -> _Problem:
    """Place the sites, and begin to estimate the noise, which does not depend on the transport."""
    prepared = inputs.prepared
    with measure_time("sites", seconds):
        plan = inputs.plan or plan_over(prepared.source, options, inputs.mask, inputs.measured)
        levels = plan.levels.with_reporter(report)
    with measure_time("transport", seconds):
        correlation = inputs.instrument.noise_correlation
        noise = begin(
            lambda: ImageNoise(prepared.in_units(), options, correlation), options.threads
        )
        assumed = inputs.registered.is_assumed
        budget = Budget(plan, prepared, noise, options, inputs.instrument, is_shift_assumed=assumed)
        levels = _levels_to_solve(plan, levels, inputs.start, options)
    return _Problem(inputs, plan, levels, options, noise, budget)


def _check_image(
    plan: SitePlan, prepared: Prepared, noise: Callable[[], ImageNoise]
) -> tuple[Caution, ...]:
    """Return the cautions about image and source."""
    noise()  # before the checks, because the solver waits for it
    recorded = prepared.image * prepared.flux_scale
    beam = _checked_source(plan) if plan.measured else None
    return image_cautions(recorded, beam, prepared.mask)


def _levels_to_solve(
    plan: SitePlan, levels: Levels, start: Inversion | None, options: InversionOptions
) -> Levels:
    if not options.is_adaptive and not levels.is_complete:
        beam = SpreadBeam.of(plan.source, plan.mask, options)
        levels = levels.up_to(beam.count_of(number_of_sites(plan.source.shape, options)))
    if start is None:
        return levels
    may_differ = options.is_adaptive and not levels.is_complete
    sites = start.cells.sites
    if plan.pixels is not None and are_middles(sites) and len(sites) == plan.pixels.counts[-1]:
        levels = plan.pixels
    return _levels_from_start(start, levels, plan.margin_width, may_differ=may_differ)


class _Solution(NamedTuple):
    """Solutions of all levels, the fields of the last, and what is still computed about them."""

    levels: list[LevelSolution]
    fields: _Fields
    wait_for_errors: Callable[[], ErrorBudget | None]
    finest: bool  # whether an adaptive number of sites is the largest
    coarse: int  # sites with which structures of the image were missed; 0 if there were none


def _solve(problem: _Problem, report: Reporter, seconds: dict[str, float]) -> _Solution:
    """Solve levels until errors and re-projection need no more sites, and read the fields out."""
    options, budget = problem.options, problem.budget
    start, adaptive = problem.inputs.start, problem.is_adaptive
    levels, pixels = problem.levels, problem.plan.pixels
    if adaptive and pixels is not None and budget.resolves_pixels:
        levels = pixels.with_reporter(report)
    if not adaptive:
        _ = problem.checks  # begin
    solutions: list[LevelSolution] = []
    coarse = 0
    while True:
        with measure_time("transport", seconds):
            solutions = solve(
                levels,
                budget.target,
                report,
                start=None if start is None else start.cells.weights,
                needed=problem.needed if adaptive else None,
                solved=solutions,
                restarts=levels is problem.levels,
            )
        answer = solutions[-1]
        if levels is not problem.levels and not answer.converged:
            levels = problem.levels
            solutions = [each for each in solutions if not each.level.is_of_pixels]
            continue
        if answer.converged:
            with measure_time("errors", seconds):
                budget.free_target(solutions)
        fields, wait_for_errors = _read_fields(problem, solutions, report, seconds)
        finest = adaptive and len(answer.weights) == levels.counts[-1]
        more = adaptive and answer.converged and not finest
        units = problem.prepared.in_units()
        if not more or not is_coarse(units, fields.reprojection, problem.noise(), options.threads):
            return _Solution(solutions, fields, wait_for_errors, finest, coarse)
        wait_for_errors()  # they use the budget that the next solution changes
        coarse = len(answer.weights)


def _assess(problem: _Problem, solution: _Solution, seconds: dict[str, float]) -> Inversion:
    """Check the fields of a solution, wait for their errors, and return them with a report."""
    plan, prepared, inputs = problem.plan, problem.prepared, problem.inputs
    answer, fields = solution.levels[-1], solution.fields
    cautions = _cautions(problem, solution)
    with measure_time("errors", seconds):
        errors = solution.wait_for_errors()
    with measure_time("prepare", seconds):
        cautions = _ranked(problem, solution, cautions, errors)
    reprojection = fields.reprojection * prepared.unit
    return Inversion(
        image=prepared.image,
        source=prepared.source,
        potential=fields.potential,
        displacement=fields.displacement,
        cells=Cells(
            sites=answer.level.sites - plan.margin_width,
            weights=answer.weights,
            mass=answer.level.mass * plan.unit,
            flux=answer.flux * plan.unit,
            displacement=answer.displacement,
        ),
        reprojection=reprojection,
        residual=np.where(prepared.mask, prepared.image - reprojection, 0.0),
        caustic=mark_caustics(
            fields.jacobian, prepared.mask, len(answer.weights), problem.options.caustic_jacobian
        ),
        mask=prepared.mask,
        report=_make_report(problem, solution, seconds, cautions),
        options=problem.options,
        instrument=inputs.instrument,
        errors=errors,
    )


def _cautions(problem: _Problem, solution: _Solution) -> tuple[Caution, ...]:
    """Return the reasons to doubt a solution, of the transport and of its fields."""
    finest, fields, options = solution.levels[-1], solution.fields, problem.options
    if not finest.converged:
        text = (
            f"not converged: flux residual {to_figures(finest.residual)} per cell, tolerance "
            f"{to_figures(options.tolerance)}; {finest.reason}"
        )
        return (Caution("not-converged", text),)
    return find_cautions(
        problem.prepared.in_units(),
        problem.noise(),
        fields.displacement,
        fields.reprojection,
        fields.jacobian,
        len(finest.weights),
        options,
        is_dark=problem.inputs.is_dark,
    )


def _ranked(
    problem: _Problem,
    solution: _Solution,
    cautions: tuple[Caution, ...],
    errors: ErrorBudget | None,
) -> tuple[Caution, ...]:
    """Return all reasons to doubt an inversion, the gravest first."""
    options, inputs, prepared = problem.options, problem.inputs, problem.prepared
    by_errors: list[Caution | None] = []
    by_accuracy: list[Caution | None] = []
    if errors is not None:
        by_errors = [errors.beam_caution(), errors.edge_caution(options.max_error)]
        is_chosen = "accuracy" in options.model_fields_set
        if errors.condition(options.max_error) is None:
            is_chosen |= errors.share > options.max_error
        if solution.finest and is_chosen and not cautions:
            why = "with the most sites placed unless more are given"
            by_accuracy = [errors.accuracy_caution(options.accuracy, why)]
    of_image = (*cautions, *prepared.cautions, *by_accuracy, *problem.checks())
    registered = inputs.registered.caution
    return tuple(filter(None, (*by_errors, registered, *inputs.unlit, *of_image)))


_checked_sources: WeakKeyDictionary[SitePlan, CheckedImage] = WeakKeyDictionary()


def _checked_source(plan: SitePlan) -> CheckedImage:
    """Return the source, whose checks all shots with a plan share."""
    # Not a result's source, which its owner may change.
    return _checked_sources.setdefault(plan, CheckedImage.of(plan.source, plan.mask))


def _sites_reason(problem: _Problem, solution: _Solution) -> str:
    """Return the reason for the number of sites."""
    if problem.inputs.start is not None:
        return "as many as in the inversion that it started from"
    if not problem.is_adaptive:
        return "as requested"
    if solution.coarse:
        return f"with {solution.coarse:,} the re-projection missed structures of the image"
    if problem.budget.reason:
        return problem.budget.reason
    if problem.levels.counts[-1] < MAX_DEFAULT_SITES:
        return "one for each pixel, the most that are placed unless more are asked for"
    return "the most that are placed unless more are asked for"


def _check_plan(
    plan: SitePlan, options: InversionOptions, *, has_own: bool, measured: bool
) -> None:
    if not has_own:
        raise InputError(
            "got a plan together with a source or mask, expected only one: a plan "
            "contains its own source and mask"
        )
    if not measured and plan.measured:
        raise InputError(
            "got measured=False and a plan of a measured source: make the plan by "
            "plan_sites(source, measured=False)"
        )
    _check_boundary(plan, options)


def _check_boundary(plan: SitePlan, options: InversionOptions) -> None:
    made_for = "closed" if plan.margin is None else "free"
    if options.boundary != made_for:
        raise InputError(
            f"the plan was made for a {made_for} boundary but options have '{options.boundary}': "
            "make the plan with the same options"
        )
    if plan.margin is None:
        return
    width = margin_around(plan.source.shape, options)
    if plan.margin_width != width:
        raise InputError(
            f"the plan has a margin of {plan.margin_width} px but options ask for "
            f"{width} px: make the plan with the same options"
        )


@dataclass(frozen=True)
class _Fields:
    """Fields read from the weights, at the image's pixels."""

    potential: FloatArray
    displacement: FloatArray
    reprojection: FloatArray  # in units of the source's `power_of_two`
    flux_left: dict[str, float]
    flux_entered: dict[str, float]
    threads: int | None

    @cached_property
    def jacobian(self) -> FloatArray:
        """Determinant of the map's Jacobian."""
        return jacobian_determinant(self.displacement, threads=self.threads)


def _read_fields(
    problem: _Problem, solutions: list[LevelSolution], report: Reporter, seconds: dict[str, float]
) -> tuple[_Fields, Callable[[], ErrorBudget | None]]:
    """Read the last solution, and begin to estimate its errors; return a function that waits."""
    plan, prepared, options = problem.plan, problem.prepared, problem.options
    solution, budget = solutions[-1], problem.budget

    def report_share(report: Reporter, share: float, first: int, last: int) -> None:
        report("read-out", round(first + share * (last - first)), _STEPS)

    report_share(report, 0, 0, _READ_STEPS)
    with measure_time("read-out", seconds):
        potential, displacement = read_out(
            solution, options, lambda share: report_share(report, share, 0, _READ_STEPS)
        )
    tiles = int(np.clip(math.ceil(_TILES_PER_SPACING / solution.level.spacing), 2, _MOST_TILES))

    def reproject() -> tuple[FloatArray, dict[str, float], dict[str, float]]:
        """Return the image that the field makes, and the flux that left and entered it."""

        def image_of(source: FloatArray, first: int, last: int) -> FloatArray:
            def on_progress(news: Progress) -> None:
                report_share(report, news.step / (news.total or 1), first, last)

            return synthetic_image(
                displacement,
                source,
                rays_per_pixel=tiles**2,
                threads=options.threads,
                on_progress=on_progress,
            )

        source = prepared.source / prepared.unit
        if plan.margin is None:
            return image_of(source, _READ_STEPS, _STEPS), {}, {}
        halfway = (_READ_STEPS + _STEPS) // 2
        of_image, of_margin = plan.margin.parts(source)
        from_image = image_of(of_image, _READ_STEPS, halfway)
        from_margin = image_of(of_margin, halfway, _STEPS)
        edges = edge_flux(from_image, from_margin, plan.margin)
        return plan.within(from_image + from_margin), *edges

    inner = plan.within(potential)
    moves = np.ascontiguousarray(plan.within(displacement))

    def estimate() -> ErrorBudget | None:
        return budget.errors(solutions, inner, moves) if solution.converged else None

    errors_at_end = begin(estimate, options.threads)
    with measure_time("read-out", seconds):
        image, outflow, inflow = reproject()
    fields = _Fields(
        np.ascontiguousarray(inner - border_mean(inner)),
        moves,
        np.ascontiguousarray(image),
        outflow,
        inflow,
        options.threads,
    )
    return fields, errors_at_end


def _levels_from_start(
    start: Inversion, levels: Levels, margin_width: int, *, may_differ: bool
) -> Levels:
    """Return the levels up to the one of an inversion to start from, if its sites are the same.

    With `may_differ`, the inversion may have a level between two of the plan.
    """
    start_sites = start.cells.sites + margin_width
    if len(start_sites) in levels.counts or (may_differ and len(start_sites) <= levels.counts[-1]):
        up_to = levels.up_to(len(start_sites))
        level = up_to[-1]
        if np.abs(start_sites - level.sites).max() <= 1e-3 * level.spacing:
            return up_to
    raise InputError(
        f"start has {len(start_sites):,} sites that differ from the {levels.counts[-1]:,} sites of "
        "this inversion: compute both with the same plan, source, mask and options"
    )


def _make_report(
    problem: _Problem,
    solution: _Solution,
    seconds: dict[str, float],
    cautions: tuple[Caution, ...],
) -> Report:
    finest, fields, prepared = solution.levels[-1], solution.fields, problem.prepared.in_units()
    return Report(
        converged=finest.converged,
        iterations=sum(level.iterations for level in solution.levels),
        residual=finest.residual,
        tolerance=problem.options.tolerance,
        n_sites=len(finest.weights),
        floor=problem.options.floor,
        floored_pixels=prepared.floored_pixels,
        clipped_pixels=prepared.clipped_pixels,
        levels=tuple(
            (len(level.weights), level.iterations, level.residual) for level in solution.levels
        ),
        seconds=seconds,
        cautions=cautions,
        flux_scale=prepared.flux_scale,
        flux_left=fields.flux_left,
        flux_entered=fields.flux_entered,
        image_residual=image_residual(prepared.image, fields.reprojection, prepared.mask),
        sites_reason=_sites_reason(problem, solution),
        measured=problem.plan.measured,
    )
