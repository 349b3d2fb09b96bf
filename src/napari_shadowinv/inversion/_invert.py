"""Inversion of an image to its deflection potential: `invert`, `plan_sites`, `count_sites`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import normalise
from napari_shadowinv.inversion.normalise import Prepared, margin_around, prepare
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.inversion.result import Inversion, Report
from napari_shadowinv.inversion.trust import doubts, image_residual
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.margin import Margin, edge_flux
from napari_shadowinv.transport.sites import SitePlan, plan_levels
from napari_shadowinv.transport.solvers import LevelSolution, fitted_flux, solve

__all__ = ["count_sites", "invert", "plan_sites"]

# Steps of the read-out: up to the first number the potential, then the re-projection.
_READ, _STEPS = 30, 100


def plan_sites(
    source: ArrayLike,
    options: InversionOptions | None = None,
    *,
    mask: ArrayLike | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> SitePlan:
    """Place the sites over a source, once for all images that share it.

    Parameters
    ----------
    source : array_like, shape (H, W)
        The undisturbed beam.
    options : InversionOptions, optional
        Those of the solver and the read-out do not matter.
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
    options = options or InversionOptions()
    ground = _ground(source, options, mask)
    plan = plan_levels(
        ground.beam if ground.margin is None else ground.margin.beam,
        ground.n_sites,
        lloyd_iterations=options.lloyd_iterations,
        lloyd_tolerance=options.lloyd_tolerance,
        seed=options.seed,
        threads=options.threads,
        report=Reporter(on_progress, should_stop),
    )
    return replace(
        plan,
        source=ground.beam * ground.unit,
        mask=ground.mask,
        margin=ground.margin,
        unit=ground.unit,
    )


def count_sites(
    source: ArrayLike, options: InversionOptions, *, mask: ArrayLike | None = None
) -> int:
    """Return how many sites `plan_sites` would place, those in a margin included."""
    if options.boundary != "free":
        height, width = np.shape(source)
        return normalise.number_of_sites((height, width), options)
    return _ground(source, options, mask).n_sites


class _Ground(NamedTuple):
    """What sites are to be spread over, in units of a power of two, and how many."""

    beam: FloatArray
    unit: float
    mask: BoolArray | None
    margin: Margin | None
    n_sites: int


def _ground(source: ArrayLike, options: InversionOptions, mask: ArrayLike | None) -> _Ground:
    usable = None if mask is None else normalise.checked_mask(mask, np.shape(source))
    beam = normalise.checked_source(source, usable)
    if usable is not None:
        beam = normalise.masked_source(beam, usable, options)
    n_sites = normalise.number_of_sites(beam.shape, options)
    unit = normalise.power_of_two(beam)
    beam = beam / unit
    if options.boundary != "free":
        return _Ground(beam, unit, usable, None, n_sites)
    margin = Margin.around(beam, margin_around(beam.shape, options), usable)
    return _Ground(beam, unit, usable, margin, round(n_sites * margin.beam.sum() / beam.sum()))


@contextmanager
def _timed(stage: str, seconds: dict[str, float]) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def invert(
    image: ArrayLike,
    *,
    source: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    options: InversionOptions | None = None,
    plan: SitePlan | None = None,
    start: Inversion | None = None,
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
        True at usable detector pixels. Others (handwriting, saturation, beyond the edge of the
        film) carry no flux; the field there is only a smooth continuation. Set opaque obstacles
        to zero in `source` instead: their shadows move with the rays.
    options : InversionOptions, optional
        The defaults suit most images.
    plan : SitePlan, optional
        Sites prepared by `plan_sites`, in place of `source` and `mask`.
    start : Inversion, optional
        Inversion of a similar image (the previous shot, another filter) on the same sites. The
        solver starts from its weights and, if the images are similar, needs only a few
        iterations; if it stalls, it restarts from scratch. The result is the same within the
        tolerance.
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
    options = options or InversionOptions()
    report = Reporter(on_progress, should_stop)
    seconds: dict[str, float] = {}
    with _timed("prepare", seconds):
        report("prepare", 0, 1)
        if plan is not None:
            if source is not None or mask is not None:
                raise InputError(
                    "got a plan together with a source or mask, expected only one: a plan "
                    "contains its own source and mask"
                )
            _check_boundary(plan, options)
            source, mask = plan.source, plan.mask
        prepared = prepare(image, source, options, mask)
        report("prepare", 1, 1)
    with _timed("sites", seconds):
        if plan is None:
            plan = plan_sites(
                prepared.source,
                options,
                mask=mask,
                on_progress=on_progress,
                should_stop=should_stop,
            )
    with _timed("transport", seconds):
        if plan.margin is not None and options.flux == "fit":
            image_flux = fitted_flux(
                plan.levels, prepared.floored_image, plan.margin, options, report
            )
            scale = prepared.flux_scale / image_flux
            prepared = prepare(image, source, options, mask, flux_scale=scale)
        weights = None if start is None else _weights_of(start, plan)
        solutions = solve(
            plan.levels, prepared.floored_image, options, report, start=weights, margin=plan.margin
        )
    with _timed("read-out", seconds):
        fields = _read_fields(plan, prepared, solutions[-1], options, report)
    level = plan.levels[-1]
    jacobian = jacobian_determinant(fields.displacement)
    return Inversion(
        image=prepared.image,
        source=prepared.source,
        potential=fields.potential,
        displacement=fields.displacement,
        sites=level.sites - plan.margin_width,
        weights=solutions[-1].weights,
        site_mass=level.mass * plan.unit,
        site_flux=solutions[-1].flux * plan.unit,
        site_displacement=solutions[-1].displacement,
        reprojection=fields.reprojection,
        residual=np.where(prepared.mask, prepared.image - fields.reprojection, 0.0),
        caustic=(jacobian < options.caustic_jacobian) & prepared.mask,
        mask=prepared.mask,
        report=_report(prepared, plan, solutions, fields, jacobian, seconds, options),
        options=options,
    )


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


class _Fields(NamedTuple):
    """What is read off the weights, at the image's pixels."""

    potential: FloatArray
    displacement: FloatArray
    reprojection: FloatArray
    flux_left: dict[str, float]
    flux_entered: dict[str, float]


def _read_fields(
    plan: SitePlan,
    prepared: Prepared,
    solution: LevelSolution,
    options: InversionOptions,
    report: Reporter,
) -> _Fields:
    def tell(share: float, first: int, last: int) -> None:
        report("read-out", round(first + share * (last - first)), _STEPS)

    def reprojected(source: FloatArray, first: int, last: int) -> FloatArray:
        return synthetic_image(
            displacement,
            source,
            threads=options.threads,
            on_progress=lambda news: tell(news.step / (news.total or 1), first, last),
        )

    tell(0, 0, _READ)
    potential, displacement = read_out(plan, solution, options, lambda share: tell(share, 0, _READ))
    source = prepared.source / prepared.unit
    left: dict[str, float] = {}
    entered: dict[str, float] = {}
    if plan.margin is None:
        reprojection = reprojected(source, _READ, _STEPS)
    else:
        halfway = (_READ + _STEPS) // 2
        of_image, of_margin = plan.margin.parts(source)
        from_image = reprojected(of_image, _READ, halfway)
        from_margin = reprojected(of_margin, halfway, _STEPS)
        reprojection = plan.within(from_image + from_margin)
        left, entered = edge_flux(from_image, from_margin, plan.margin)
    inner = plan.within(potential)
    return _Fields(
        np.ascontiguousarray(inner - border_mean(inner)),
        np.ascontiguousarray(plan.within(displacement)),
        np.ascontiguousarray(reprojection) * prepared.unit,
        left,
        entered,
    )


def _weights_of(start: Inversion, plan: SitePlan) -> FloatArray:
    """Return the weights to start from, if they belong to the finest sites of this plan."""
    level = plan.levels[-1]
    found, expected = start.sites + plan.margin_width, level.sites
    if found.shape != expected.shape or np.abs(found - expected).max() > 1e-3 * level.spacing:
        raise InputError(
            f"start has {len(found):,} sites that differ from the {len(expected):,} sites of "
            "this inversion: compute both with the same plan, source, mask and options"
        )
    return start.weights


def _report(
    prepared: Prepared,
    plan: SitePlan,
    solutions: list[LevelSolution],
    fields: _Fields,
    jacobian: FloatArray,
    seconds: dict[str, float],
    options: InversionOptions,
) -> Report:
    finest = solutions[-1]
    image, source = prepared.image / prepared.unit, prepared.source / prepared.unit
    reprojection = fields.reprojection / prepared.unit
    found: tuple[str, ...] = (
        f"not converged: flux residual {finest.residual:.2g} per cell, tolerance "
        f"{options.tolerance:.2g}; {finest.reason}",
    )
    if finest.converged:
        scaled = replace(prepared, image=image, source=source)
        n_sites = len(finest.weights)
        found = doubts(scaled, fields.displacement, reprojection, jacobian, n_sites, options)
    return Report(
        converged=finest.converged,
        iterations=sum(solution.iterations for solution in solutions),
        residual=finest.residual,
        tolerance=options.tolerance,
        n_sites=len(plan.levels[-1].sites),
        floor=options.floor,
        floored_pixels=prepared.floored_pixels,
        clipped_pixels=prepared.clipped_pixels,
        levels=tuple(
            (len(solution.weights), solution.iterations, solution.residual)
            for solution in solutions
        ),
        seconds=seconds,
        warnings=(*found, *prepared.warnings),
        flux_scale=prepared.flux_scale,
        flux_left=fields.flux_left,
        flux_entered=fields.flux_entered,
        image_residual=image_residual(image, reprojection, prepared.mask),
    )
