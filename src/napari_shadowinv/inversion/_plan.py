"""Sites for the inversion of one or many images: `plan_sites`, `count_sites`."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv.inversion.normalise import (
    checked_mask,
    checked_source,
    margin_around,
    masked_source,
    number_of_sites,
    power_of_two,
)
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.transport.margin import Margin
from napari_shadowinv.transport.sites import SitePlan, plan_levels

__all__ = ["count_sites", "plan_sites"]

Array = NDArray[np.float64]


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
        Its `n_sites`, `lloyd_iterations`, `lloyd_tolerance`, `floor`, `boundary`, `margin`,
        `seed` and `threads` are used.
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
    """Return the number of sites `plan_sites` would place, without placing them.

    Parameters
    ----------
    source, options, mask
        See `plan_sites`.

    Returns
    -------
    int
        With a free boundary, including those in the margin.

    Raises
    ------
    InputError
        See `plan_sites`.
    """
    if options.boundary != "free":
        height, width = np.shape(source)
        return number_of_sites((height, width), options)
    return _ground(source, options, mask).n_sites


class _Ground(NamedTuple):
    """What sites are to be spread over, in units of a power of two, and how many."""

    beam: Array
    unit: float
    mask: NDArray[np.bool_] | None
    margin: Margin | None
    n_sites: int


def _ground(source: ArrayLike, options: InversionOptions, mask: ArrayLike | None) -> _Ground:
    usable = None if mask is None else checked_mask(mask, np.shape(source))
    beam = checked_source(source, usable)
    if usable is not None:
        beam = masked_source(beam, usable, options)
    n_sites = number_of_sites(beam.shape, options)
    unit = power_of_two(beam)
    beam = beam / unit
    if options.boundary != "free":
        return _Ground(beam, unit, usable, None, n_sites)
    margin = Margin.around(beam, margin_around(beam.shape, options), usable)
    return _Ground(beam, unit, usable, margin, round(n_sites * margin.beam.sum() / beam.sum()))
