"""The whole way from an image to a deflection potential.

- invert an image: `invert`
- prepare the sites once for many images with one source: `plan_sites`
- what comes out: `Inversion`, with a `Report` of how it went
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.preprocess import (
    Prepared,
    checked_mask,
    checked_source,
    masked_source,
    number_of_sites,
    prepare,
)
from napari_shadowinv.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv.readout import read_centroids, read_dual
from napari_shadowinv.transport.sites import Level, SitePlan, plan_levels
from napari_shadowinv.transport.solvers import LevelSolution, solve

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = ["Inversion", "Report", "invert", "plan_sites"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Report:
    """How an inversion went.

    Attributes
    ----------
    converged : bool
        Whether the flux residual fell below the tolerance.
    iterations : int
        Solver steps, all levels together.
    residual : float
        Largest relative flux error of a cell, max |T - S| / S.
    tolerance : float
        The residual that was asked for.
    n_sites : int
        Number of sites.
    floor : float
        Smallest intensity allowed in the image, as a share of its mean.
    floored_pixels : int
        Pixels that were raised to the floor, clipped ones included.
    clipped_pixels : int
        Pixels that were negative and set to zero.
    levels : tuple of (int, int, float)
        Sites, solver steps and final residual of each level, coarse to fine.
    seconds : dict of str to float
        Time of each stage: prepare, sites, transport, read-out.
    warnings : tuple of str
        What the user should know before trusting the result.
    """

    converged: bool
    iterations: int
    residual: float
    tolerance: float
    n_sites: int
    floor: float
    floored_pixels: int
    clipped_pixels: int
    levels: tuple[tuple[int, int, float], ...]
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Inversion:
    """The deflection potential of one shot, and how far it can be trusted.

    Lengths are object-plane pixels; arrays are ``[y, x]``, vectors in axis order
    (y, x); a pixel's centre is at its integer index.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        The image that was inverted, after clipping, scaled to the flux of the source.
    source : ndarray, shape (H, W)
        The undisturbed beam.
    potential : ndarray, shape (H, W)
        Normalised deflection potential in px²; its mean over the image's border is 0.
    displacement : ndarray, shape (2, H, W)
        Displacement of the ray that starts at each pixel, minus the gradient of the
        potential, in px.
    sites : ndarray, shape (n, 2)
        Positions of the sites.
    weights : ndarray, shape (n,)
        Weights of the power diagram, px².
    site_mass : ndarray, shape (n,)
        Flux of the source in each site's cell.
    site_displacement : ndarray, shape (n, 2)
        Centroid of each site's cell in the image minus that in the source, px.
    reprojection : ndarray, shape (H, W)
        The image that the retrieved displacement makes of the source.
    residual : ndarray, shape (H, W)
        ``image - reprojection``.
    caustic : ndarray of bool, shape (H, W)
        Where the map folds or its Jacobian is below the threshold.
    mask : ndarray of bool, shape (H, W)
        The pixels that were used; image, source, residual and caustic are 0 elsewhere.
    report : Report
        How it went.
    options : InversionOptions
        The choices that made it.
    """

    image: Array
    source: Array
    potential: Array
    displacement: Array
    sites: Array
    weights: Array
    site_mass: Array
    site_displacement: Array
    reprojection: Array
    residual: Array
    caustic: NDArray[np.bool_]
    mask: NDArray[np.bool_]
    report: Report
    options: InversionOptions

    def to_dataset(self, setup: ProtonSetup | OpticalSetup | None = None) -> xarray.Dataset:
        """Everything as one labelled dataset, with units; see `napari_shadowinv.io.dataset`.

        Parameters
        ----------
        setup : ProtonSetup or OpticalSetup, optional
            Adds the potential and the line-integrated field in SI units.

        Returns
        -------
        xarray.Dataset
            Dimensions y, x, site and component.
        """
        from napari_shadowinv.io.dataset import dataset_from_inversion

        return dataset_from_inversion(self, setup)


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


def plan_sites(
    source: ArrayLike,
    options: InversionOptions | None = None,
    *,
    mask: ArrayLike | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> SitePlan:
    """Spread the sites over a source, once for all images that share it.

    Parameters
    ----------
    source : array_like, shape (H, W)
        The undisturbed beam.
    options : InversionOptions, optional
        Its `n_sites`, `lloyd_iterations`, `lloyd_tolerance`, `floor`, `seed` and `threads` are
        used.
    mask : array_like of bool, shape (H, W), optional
        See `invert`.
    on_progress, should_stop
        See `invert`.

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
    usable = None if mask is None else checked_mask(mask, np.shape(source))
    beam = checked_source(source, usable)
    if usable is not None:
        beam = masked_source(beam, usable, options)
    return plan_levels(
        beam,
        number_of_sites(beam.shape, options),
        lloyd_iterations=options.lloyd_iterations,
        lloyd_tolerance=options.lloyd_tolerance,
        seed=options.seed,
        threads=options.threads,
        mask=usable,
        report=Reporter(on_progress, should_stop),
    )


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
        The undisturbed beam. Default: uniform. Image and source are brought to the same
        flux, so their units need not match.
    mask : array_like of bool, shape (H, W), optional
        True where a pixel of the detector can be used. Others (written on, saturated, beyond
        the film) carry no flux on either side; the field there is only a smooth
        continuation. What stands in the beam belongs into `source`, as zeros, instead: its
        shadow moves with the rays.
    options : InversionOptions, optional
        Choices; the default suits most images.
    plan : SitePlan, optional
        Sites prepared by `plan_sites`; its source and mask are used, and `source` and `mask`
        must be left out.
    start : Inversion, optional
        Of a similar image on the same sites, best made with the same `plan`: the shot before,
        or this one with another filter. The solver starts from its weights and is done in a few
        steps where the images are alike; where it does not get on from there it starts afresh.
        The answer is the same within the tolerance.
    on_progress : callable, optional
        Receives a `napari_shadowinv.progress.Progress` now and then.
    should_stop : callable, optional
        Asked now and then; when it returns true the inversion ends.

    Returns
    -------
    Inversion
        Also where the solver did not converge: `Inversion.report` then says how far
        it got and why.

    Raises
    ------
    InputError
        If image or source cannot be inverted, or `start` has other sites.
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
                    "got a plan and also a source or mask, expected one: a plan has its own"
                )
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
        weights = None if start is None else _weights_of(start, plan.levels[-1])
        solutions = solve(plan.levels, prepared.floored_image, options, report, start=weights)
    with stopwatch("read-out"):
        report("read-out", 0, 2)
        level = plan.levels[-1]
        weights, of_sites = solutions[-1].weights, solutions[-1].displacement
        height, width = prepared.image.shape
        potential, displacement = _read_out(level, weights, of_sites, (height, width), options)
        report("read-out", 1, 2)
        reprojection = synthetic_image(displacement, prepared.source, threads=options.threads)
        report("read-out", 2, 2)
    return Inversion(
        image=prepared.image,
        source=prepared.source,
        potential=potential,
        displacement=displacement,
        sites=level.sites,
        weights=weights,
        site_mass=level.mass,
        site_displacement=of_sites,
        reprojection=reprojection,
        residual=np.where(prepared.mask, prepared.image - reprojection, 0.0),
        caustic=(jacobian_determinant(displacement) < options.caustic_jacobian) & prepared.mask,
        mask=prepared.mask,
        report=_report(prepared, plan, solutions, stopwatch.seconds, options),
        options=options,
    )


def _weights_of(start: Inversion, level: Level) -> Array:
    """Return the weights to start from, if they belong to the sites of this level."""
    found, expected = start.sites, level.sites
    if found.shape != expected.shape or np.abs(found - expected).max() > 1e-3 * level.spacing:
        raise InputError(
            f"start has {len(found):,} sites that are not the {len(expected):,} of this inversion: "
            "make both with the same plan, source, mask and options"
        )
    return start.weights


def _read_out(
    level: Level,
    weights: Array,
    of_sites: Array,
    shape: tuple[int, int],
    options: InversionOptions,
) -> tuple[Array, Array]:
    """Potential and displacement at the pixels, by the read-out that the options name."""
    if options.readout == "centroid":
        return read_centroids(
            level, of_sites, shape, options.threads, integration=options.integration
        )
    return read_dual(level, weights, of_sites, shape, options.threads)


def _report(
    prepared: Prepared,
    plan: SitePlan,
    solutions: list[LevelSolution],
    seconds: dict[str, float],
    options: InversionOptions,
) -> Report:
    finest = solutions[-1]
    warnings = prepared.warnings
    if not finest.converged:
        warnings = (
            f"not converged: flux residual {finest.residual:.2g} per cell, asked for "
            f"{options.tolerance:.2g}; {finest.reason}",
            *warnings,
        )
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
    )
