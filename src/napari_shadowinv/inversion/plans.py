"""Plans of the sites over a source.

- sites as many as options ask for, on all levels: `plan_over`
- one level of sites that are placed already: `plan_of`, `plan_on`
- the beam that sites are spread over: `SpreadBeam`
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter

from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.inversion.normalise import (
    bytes_per_pixel,
    check_source,
    gaps_in,
    into_gaps,
    margin_around,
    masked_source,
    number_of_sites,
    power_of_two,
)
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.arrays import check_mask
from napari_shadowinv.transport.sites import Levels, Margin, SiteLevel, SitePlan, plan_levels


class SpreadBeam(NamedTuple):
    """A source as sites are spread over it, with its margin where the boundary is free."""

    values: FloatArray  # in units of a power of two
    unit: float
    margin: Margin | None

    @classmethod
    def of(cls, source: FloatArray, mask: BoolArray | None, options: InversionOptions) -> Self:
        """Return the beam of a source, of which a mask may be known."""
        if mask is not None:
            mask = mask | gaps_in(mask, source)
        beam = masked_source(source, mask, options)
        unit = power_of_two(beam)
        beam = beam / unit
        if options.boundary != "free":
            return cls(beam, unit, None)
        margin = Margin.around(beam, margin_around(beam.shape, options), mask)
        return cls(margin.beam, unit, margin)

    def count_of(self, n_sites: int) -> int:
        """Return the number of sites in image and margin, for `n_sites` in the image."""
        if self.margin is None:
            return n_sites
        inner = np.ascontiguousarray(self.margin.within(self.values))
        return round(n_sites * float(self.values.sum()) / float(inner.sum()))

    def lit_pixels(
        self, options: InversionOptions, *, dim: float = 0.65, most: float = 0.01
    ) -> BoolArray | None:
        """Return the pixels with light, (H, W), of an even beam, each of which may have a site.

        None if the beam jumps: more than the share `most` of the pixels are `dim` beside the
        brightest of their neighbours. Sites that are as dense as the beam is bright suit it better.
        """
        brightest = maximum_filter(self.values, 3)
        if np.count_nonzero(self.values < dim * brightest) > most * brightest.size:
            return None
        return np.asarray(self.values >= 0.5 * options.floor * self.values.mean())


def plan_over(
    source: ArrayLike, options: InversionOptions, mask: ArrayLike | None, measured: bool
) -> SitePlan:
    """Plan sites over a source without computing any level."""
    usable = None if mask is None else check_mask(mask, np.shape(source))
    check_memory(np.shape(source), bytes_per_pixel(options), "an inversion")
    checked, lit = check_source(source, usable), usable
    if usable is not None:
        gaps = gaps_in(usable, source)
        checked, lit = into_gaps(checked, usable, gaps), usable | gaps
    checked = masked_source(checked, lit, options)
    n_sites = number_of_sites(checked.shape, options)
    beam = SpreadBeam.of(checked, usable, options)
    levels = plan_levels(
        beam.values,
        beam.count_of(n_sites),
        lloyd_iterations=options.lloyd_iterations,
        lloyd_tolerance=options.lloyd_tolerance,
        seed=options.seed,
        threads=options.threads,
    ).levels
    pixels = None
    # At the edges of masks the image jumps, and sites in all pixels do not converge.
    if options.is_adaptive and n_sites == checked.size and (lit is None or lit.all()):
        even = beam.lit_pixels(options)
        if even is not None:
            pixels = levels.ending_in_pixels(beam.values, even, options.threads)
    return SitePlan(checked, levels, usable, beam.margin, beam.unit, measured, pixels)


def plan_of(
    sites: FloatArray,
    source: FloatArray,
    mask: BoolArray,
    options: InversionOptions,
    *,
    measured: bool,
) -> SitePlan:
    """Return the plan of one level with sites, (n, 2), px of a source that was recorded or not."""
    width = margin_around(source.shape, options) if options.boundary == "free" else 0
    region = [(-0.5, -0.5), tuple(side + 2 * width - 0.5 for side in source.shape)]
    triangulation = RegularTriangulation(sites + width, region=region)
    return plan_on(triangulation, source, mask, options, measured=measured)


def plan_on(
    triangulation: RegularTriangulation,
    source: FloatArray,
    mask: BoolArray | None,
    options: InversionOptions,
    *,
    measured: bool,
) -> SitePlan:
    """Return the plan of the one level of a triangulation's sites over a source."""
    beam = SpreadBeam.of(source, mask, options)
    density = Density.from_image(beam.values, threads=options.threads)
    level = SiteLevel.of(triangulation, density, options.threads)
    levels = Levels((len(level.sites),), lambda count, report: level)
    return SitePlan(source, levels, mask, beam.margin, beam.unit, measured)
