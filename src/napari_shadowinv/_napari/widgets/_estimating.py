"""Estimates of the source, again and again: the last one kept, and quick ones for a preview.

- estimate, unless it is known already: `SourceCache`
- estimate from larger pixels: `quick_source`
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from napari_shadowinv._system.progress import OnWarning, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.preprocessing.recipes import Estimate


@dataclass
class SourceCache:
    """The last estimate, for the next run with the same image."""

    _kept: (
        tuple[tuple[Estimate, bool], FloatArray, BoolArray | None, FloatArray, list[str]] | None
    ) = field(default=None, repr=False)

    def source(
        self,
        estimate: Estimate,
        image: FloatArray,
        mask: BoolArray | None,
        most_pixels: int | None = None,
        should_stop: ShouldStop | None = None,
        on_warning: OnWarning | None = None,
    ) -> FloatArray:
        """Return the source of an image; quickly with no more than `most_pixels`."""
        key = (estimate, most_pixels is not None)
        if self._kept is not None:
            last_key, last_image, last_mask, source, doubts = self._kept
            same = same_array(image, last_image) and same_array(mask, last_mask)
            if key == last_key and same:
                return _told(source, doubts, on_warning)
        doubts = []
        if most_pixels is None:
            source = estimate.source(image, mask, should_stop, doubts.append)
        else:
            source = quick_source(estimate, image, mask, most_pixels, should_stop, doubts.append)
        self._kept = key, image, mask, source, doubts
        return _told(source, doubts, on_warning)


def _told(source: FloatArray, doubts: list[str], on_warning: OnWarning | None) -> FloatArray:
    if on_warning is not None:
        for doubt in doubts:
            on_warning(doubt)
    return source


def quick_source(
    estimate: Estimate,
    image: FloatArray,
    mask: BoolArray | None,
    most_pixels: int,
    should_stop: ShouldStop | None = None,
    on_warning: OnWarning | None = None,
) -> FloatArray:
    """Estimate the source from an image whose pixels are merged, and spread it again.

    It is linear between the middles of the merged pixels; the flux is that of the image.
    """
    factor = int(np.ceil(np.sqrt(image.size / most_pixels)))
    if factor == 1 or min(image.shape) < 8 * factor:
        return estimate.source(image, mask, should_stop, on_warning)
    from scipy.ndimage import map_coordinates
    from skimage.transform import downscale_local_mean

    # It comes without types.
    merged: Callable[..., FloatArray] = downscale_local_mean
    usable = np.ones(image.shape, bool) if mask is None else mask
    share = merged(usable.astype(float), (factor, factor))
    sums = merged(np.where(usable, image, 0.0), (factor, factor))
    known = share > 0
    coarse = np.where(known, sums / np.where(known, share, 1.0), 0.0)
    coarser = estimate.coarser(factor)
    beam = coarser.source(coarse, None if known.all() else known, should_stop, on_warning)
    middle = (factor - 1) / 2
    places = np.meshgrid(*((np.arange(n) - middle) / factor for n in image.shape), indexing="ij")
    fine = map_coordinates(beam, places, order=1, mode="nearest")
    return np.asarray(fine * (image[usable].sum() / fine[usable].sum()))


def same_array(one: AnyArray | None, other: AnyArray | None) -> bool:
    """Whether two arrays hold the same, or both are none."""
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)
