"""What is done to a shot before its inversion: filters, then a guess of its undisturbed beam.

- all of it, in order: `Preparation`
- a shot as an estimate of its source shall see it: `as_beam`
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.recipes import Estimate, Filter

if TYPE_CHECKING:
    from napari_shadowinv.progress import ShouldStop

__all__ = ["Preparation", "as_beam"]

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Preparation:
    """Filters, one after the other, and how the source is guessed from what they leave.

    Attributes
    ----------
    filters : tuple of Filter
        From `napari_shadowinv.recipes`.
    estimate : Estimate, optional
        Likewise. Default: the source is measured, or uniform.
    bare : ndarray of bool, shape (H, W), optional
        Pixels where the object is not; the estimate looks at no others.
    """

    filters: tuple[Filter, ...] = ()
    estimate: Estimate | None = None
    bare: Mask | None = None

    @property
    def described(self) -> str:
        """Titles and parameters of the filters; empty if there are none."""
        return "; ".join(one.described for one in self.filters)

    def check(self, *, has_source: bool, has_mask: bool) -> None:
        """Refuse what contradicts itself, before any work.

        Parameters
        ----------
        has_source : bool
            Whether there is a measured source.
        has_mask : bool
            Whether there is a mask of usable pixels.

        Raises
        ------
        InputError
            If there is a source though the image is flattened, or no mask for what needs one.
        """
        flattening = [one.described for one in self.filters if one.flattens]
        if has_source and flattening:
            raise InputError(
                f"got a source and the filter {flattening[0]}, which takes the beam out of the "
                "image while the source still has it: leave one of them out"
            )
        if self.estimate is not None:
            self.estimate.check(has_mask=has_mask or self.bare is not None)
        elif self.bare is not None:
            raise InputError(
                "got a source mask, which an estimate of the source looks at, but no estimate: "
                "leave the mask out, or choose an estimate"
            )

    def filtered(
        self, image: NDArray[Any], mask: Mask | None = None, should_stop: ShouldStop | None = None
    ) -> NDArray[Any]:
        """Filter a shot, or a measured source as much as its shot.

        Parameters
        ----------
        image : ndarray, shape (H, W)
            The shot or the source.
        mask : ndarray of bool, shape (H, W), optional
            The pixels that can be used.
        should_stop : callable, optional
            Asked now and then.

        Returns
        -------
        ndarray, shape (H, W)
            The image itself where there are no filters.

        Raises
        ------
        InputError
            If it cannot be filtered.
        InversionCancelled
            If `should_stop` returned true.
        """
        for one in self.filters:
            image = one.filtered(np.asarray(image, dtype=np.float64), mask, should_stop)
        return image

    def estimated(
        self, image: NDArray[Any], mask: Mask | None = None, should_stop: ShouldStop | None = None
    ) -> Image:
        """Guess the source of a shot that is filtered.

        Parameters and errors are those of `filtered`.

        Returns
        -------
        ndarray, shape (H, W)
        """
        assert self.estimate is not None
        usable = _both(mask, self.bare)
        return self.estimate.source(as_beam(image, usable), usable, should_stop)


def as_beam(image: NDArray[Any], mask: Mask | None) -> Image:
    """Take away what an inversion would clip or not look at, which must not spoil an estimate.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        The shot.
    mask : ndarray of bool, shape (H, W), or None
        The pixels to look at.

    Returns
    -------
    ndarray, shape (H, W)
    """
    values = np.asarray(image, dtype=np.float64)
    return np.maximum(values if mask is None else np.where(mask, values, 0), 0)


def _both(first: Mask | None, second: Mask | None) -> Mask | None:
    if first is None or second is None:
        return second if first is None else first
    return first & second
