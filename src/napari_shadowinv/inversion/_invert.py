"""Inversion of an image to its deflection potential: `invert`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion._plan import plan_sites
from napari_shadowinv.inversion.normalise import Prepared, margin_around, prepare
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.inversion.result import Inversion, Report
from napari_shadowinv.inversion.trust import doubts, image_residual
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.margin import edge_flux
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, fitted_flux, solve

__all__ = ["invert"]

Array = NDArray[np.float64]

# Steps of the read-out: up to the first number the potential, then the re-projection.
_READ, _STEPS = 30, 100


class _Stopwatch:
    """Adds up the seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent


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
        The undisturbed beam. Default: uniform. The image is scaled to the flux of the source,
        so their units need not match.
    mask : array_like of bool, shape (H, W), optional
        True at usable detector pixels. Other pixels (handwriting, saturation, beyond the edge
        of the film) carry no flux in image or source; the field there is only a smooth
        continuation. Set opaque obstacles to zero in `source` instead: their shadows move
        with the rays.
    options : InversionOptions, optional
        Options; the defaults suit most images.
    plan : SitePlan, optional
        Sites prepared by `plan_sites`; its source and mask are used, and `source` and `mask`
        must be left out.
    start : Inversion, optional
        Inversion of a similar image on the same sites, preferably with the same `plan`: the
        previous shot, or this one with a different filter. The solver starts from its weights
        and needs only a few iterations if the images are similar; if it stalls, it restarts
        from scratch. The result is the same within the tolerance.
    on_progress : callable, optional
        Called regularly with a `napari_shadowinv._system.progress.Progress`.
    should_stop : callable, optional
        Called regularly; the inversion is cancelled when it returns true.

    Returns
    -------
    Inversion
        Returned even if the solver did not converge; `Inversion.report` then gives the
        residual and the reason.

    Raises
    ------
    InputError
        If image or source cannot be inverted, the source is the image itself, or `start` has
        other sites.
    InversionCancelled
        If `should_stop` returned true.

    References
    ----------
    Kasim et al., "Quantitative shadowgraphy and proton radiography for large intensity
    modulations", arXiv:1607.04179, section III and its algorithm.

    Examples
    --------
    A uniform image needs no deflection:

    >>> import numpy as np
    >>> inversion = invert(np.full((20, 20), 7.0))
    >>> float(abs(inversion.displacement).max())
    0.0
    """
    options = options or InversionOptions()
    report = Reporter(on_progress, should_stop)
    stopwatch = _Stopwatch()

    with stopwatch("prepare"):
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
    with stopwatch("sites"):
        if plan is None:
            plan = plan_sites(
                prepared.source,
                options,
                mask=mask,
                on_progress=on_progress,
                should_stop=should_stop,
            )
    with stopwatch("transport"):
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
    with stopwatch("read-out"):
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
        report=_report(prepared, plan, solutions, fields, jacobian, stopwatch.seconds, options),
        options=options,
    )


def _check_boundary(plan: SitePlan, options: InversionOptions) -> None:
    made_for = "closed" if plan.margin is None else "free"
    if options.boundary != made_for:
        raise InputError(
            f"the plan was made for a {made_for} boundary but options have '{options.boundary}': "
            "make the plan with the same options"
        )
    if plan.margin is not None and plan.margin_width != margin_around(plan.source.shape, options):
        raise InputError(
            f"the plan has a margin of {plan.margin_width} px but options ask for "
            f"{margin_around(plan.source.shape, options)} px: make the plan with the same options"
        )


class _Fields(NamedTuple):
    """What is read off the weights, at the image's pixels."""

    potential: Array
    displacement: Array
    reprojection: Array
    flux_left: dict[str, float]
    flux_entered: dict[str, float]


def _read_fields(
    plan: SitePlan,
    prepared: Prepared,
    solution: LevelSolution,
    options: InversionOptions,
    report: Reporter,
) -> _Fields:
    report("read-out", 0, _STEPS)
    potential, displacement = read_out(plan, solution, options, _reading(report, 0, _READ))
    source = prepared.source / prepared.unit
    left: dict[str, float] = {}
    entered: dict[str, float] = {}
    if plan.margin is None:
        reprojection = _reprojection(displacement, source, options, report, _READ, _STEPS)
    else:
        halfway = (_READ + _STEPS) // 2
        of_image, of_margin = plan.margin.parts(source)
        from_image = _reprojection(displacement, of_image, options, report, _READ, halfway)
        from_margin = _reprojection(displacement, of_margin, options, report, halfway, _STEPS)
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


def _reading(report: Reporter, first: int, last: int) -> Callable[[float], None]:
    """Report a share of some work as steps of the read-out."""
    return lambda share: report("read-out", round(first + share * (last - first)), _STEPS)


def _reprojection(
    displacement: Array,
    source: Array,
    options: InversionOptions,
    report: Reporter,
    first: int,
    last: int,
) -> Array:
    tell = _reading(report, first, last)
    return synthetic_image(
        displacement,
        source,
        threads=options.threads,
        on_progress=lambda news: tell(news.step / (news.total or 1)),
    )


def _weights_of(start: Inversion, plan: SitePlan) -> Array:
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
    jacobian: Array,
    seconds: dict[str, float],
    options: InversionOptions,
) -> Report:
    finest = solutions[-1]
    warnings = prepared.warnings
    image, source = prepared.image / prepared.unit, prepared.source / prepared.unit
    reprojection = fields.reprojection / prepared.unit
    if not finest.converged:
        warnings = (
            f"not converged: flux residual {finest.residual:.2g} per cell, tolerance "
            f"{options.tolerance:.2g}; {finest.reason}",
            *warnings,
        )
    else:
        found = doubts(
            replace(prepared, image=image, source=source),
            fields.displacement,
            reprojection,
            jacobian,
            len(finest.weights),
            options,
        )
        warnings = (*found, *warnings)
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
        warnings=warnings,
        flux_scale=prepared.flux_scale,
        flux_left=fields.flux_left,
        flux_entered=fields.flux_entered,
        image_residual=image_residual(image, reprojection, prepared.mask),
    )
