"""Sites and sources that a window reuses between runs: `Cache`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from napari_shadowinv._system.progress import OnProgress, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution, OnCaution
from napari_shadowinv.inversion import Inversion, plan_sites
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.preprocessing import Estimate
from napari_shadowinv.transport.sites import SitePlan

__all__ = ["Cache", "quick_source", "same_array"]


@dataclass
class Cache:
    """Sites and estimated source of the last run, for the next one with the same beam or image."""

    hits: int = 0  # how often sites were used again
    _plan: tuple[str, FloatArray, BoolArray | None, SitePlan] | None = field(
        default=None, repr=False
    )
    _solved: tuple[SitePlan, Inversion] | None = field(default=None, repr=False)
    _estimated: (
        tuple[tuple[Estimate, bool], FloatArray, BoolArray | None, FloatArray, list[Caution]] | None
    ) = field(default=None, repr=False)

    def plan(
        self,
        source: FloatArray,
        mask: BoolArray | None,
        options: InversionOptions,
        on_progress: OnProgress | None = None,
        should_stop: ShouldStop | None = None,
        *,
        measured: bool = True,
    ) -> SitePlan:
        """Return the sites for a source, computed only if anything about them has changed."""
        key = f"{options.site_key()}{measured}"
        if self._plan is not None:
            last_key, last_source, last_mask, plan = self._plan
            if key == last_key and _is_close(source, last_source) and same_array(mask, last_mask):
                self.hits += 1
                return plan
        plan = plan_sites(
            source,
            options,
            mask=mask,
            measured=measured,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        # At once: a run that was cancelled may still be about to do the same.
        self._plan = key, source, mask, plan
        return plan

    def last_inversion(self, plan: SitePlan) -> Inversion | None:
        """Return the last inversion passed to `keep`, if it has these sites."""
        solved = self._solved
        return solved[1] if solved is not None and solved[0] is plan else None

    def keep(self, plan: SitePlan, inversion: Inversion) -> None:
        """Store an inversion with these sites as start of the next one."""
        self._solved = plan, inversion

    def source(
        self,
        estimate: Estimate,
        image: FloatArray,
        mask: BoolArray | None,
        most_pixels: int | None = None,
        should_stop: ShouldStop | None = None,
        on_caution: OnCaution | None = None,
    ) -> FloatArray:
        """Return an estimated source; with `most_pixels`, quickly, from merged pixels."""
        key = (estimate, most_pixels is not None)
        source: FloatArray | None = None
        doubts: list[Caution] = []
        if self._estimated is not None:
            last_key, last_image, last_mask, last_source, last_doubts = self._estimated
            is_same = same_array(image, last_image) and same_array(mask, last_mask)
            if key == last_key and is_same:
                source, doubts = last_source, last_doubts
        if source is None:
            if most_pixels is None:
                source = estimate.source(image, mask, should_stop, doubts.append)
            else:
                source = quick_source(
                    estimate, image, mask, most_pixels, should_stop, doubts.append
                )
            self._estimated = key, image, mask, source, doubts
        if on_caution is not None:
            for doubt in doubts:
                on_caution(doubt)
        return source


def quick_source(
    estimate: Estimate,
    image: FloatArray,
    mask: BoolArray | None,
    most_pixels: int,
    should_stop: ShouldStop | None = None,
    on_caution: OnCaution | None = None,
) -> FloatArray:
    """Estimate a source from an image whose pixels are merged until there are few enough."""
    # Linear between the middles of the merged pixels, with the flux of the image.
    factor = int(np.ceil(np.sqrt(image.size / most_pixels)))
    if factor == 1 or min(image.shape) < 8 * factor:
        return estimate.source(image, mask, should_stop, on_caution)
    from scipy.ndimage import map_coordinates
    from skimage.transform import downscale_local_mean

    # It comes without types.
    merged: Callable[..., FloatArray] = downscale_local_mean
    usable = np.ones(image.shape, bool) if mask is None else mask
    share = merged(usable.astype(float), (factor, factor))
    sums = merged(np.where(usable, image, 0.0), (factor, factor))
    filled = share > 0
    coarse = np.where(filled, sums / np.where(filled, share, 1.0), 0.0)
    coarser = estimate.coarsen(factor)
    beam = coarser.source(coarse, None if filled.all() else filled, should_stop, on_caution)
    middle = (factor - 1) / 2
    places = np.meshgrid(*((np.arange(n) - middle) / factor for n in image.shape), indexing="ij")
    fine = map_coordinates(beam, places, order=1, mode="nearest")
    return np.asarray(fine * (image[usable].sum() / fine[usable].sum()))


def same_array(first: AnyArray | None, second: AnyArray | None) -> bool:
    """Return whether two arrays are equal, or both are None."""
    if first is None or second is None:
        return first is second
    return first is second or np.array_equal(first, second)


def _is_close(first: FloatArray, second: FloatArray) -> bool:
    # A filter keeps the mean of a uniform source to rounding only.
    return first.shape == second.shape and bool(np.allclose(first, second, rtol=1e-9, atol=0))
