"""Preparation of a shot before its inversion: filters, then an estimate of its source.

- filters and estimate, in order: `Preparation`
- detect contradictory masks: `check_masks`
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing.recipes import Estimate, Filter

if TYPE_CHECKING:
    from napari_shadowinv._system.progress import OnWarning, ShouldStop

__all__ = ["Preparation", "check_masks"]

Image = NDArray[np.float64]
Mask = NDArray[np.bool_]

_LEAST_VISIBLE = 0.1  # of what the source mask hides in one place, for the inversion to see it
_LEAST_OBJECT = 10  # pixels
_MOST_FALL = 10.0  # times below the dimmest pixel seen


@dataclass(frozen=True, eq=False)
class Preparation:
    """Filters to apply in order, and the source estimate to apply to the filtered shot.

    Attributes
    ----------
    filters : tuple of Filter
        From `napari_shadowinv.preprocessing.recipes`.
    estimate : Estimate, optional
        Likewise. Default: the source is measured, or uniform.
    bare : ndarray of bool, shape (H, W), optional
        Pixels not covered by the object; the estimate uses only these.
    """

    filters: tuple[Filter, ...] = ()
    estimate: Estimate | None = None
    bare: Mask | None = None

    @property
    def described(self) -> str:
        """Titles and parameters of the filters; empty if there are none."""
        return "; ".join(one.described for one in self.filters)

    def check(self, *, has_source: bool, mask: Mask | None) -> None:
        """Reject contradictory choices before any work is done.

        Parameters
        ----------
        has_source : bool
            Whether there is a measured source.
        mask : ndarray of bool, shape (H, W), or None
            The pixels that can be used.

        Raises
        ------
        InputError
            If there is a source though the image is flattened, no source mask for an estimate
            that needs one, or the mask hides the object, too.
        """
        flattening = [one.described for one in self.filters if one.flattens]
        if has_source and flattening:
            raise InputError(
                f"got a source and the filter {flattening[0]}, which removes the beam from the "
                "image but not from the source: use only one of them"
            )
        if self.estimate is not None:
            if self.estimate.needs_mask and self.bare is None:
                raise InputError(
                    f"got the estimate '{self.estimate.title}' without a source mask, which "
                    "hides the object from the estimate but not from the inversion: give one"
                )
            check_masks(mask, self.bare)
        elif self.bare is not None:
            raise InputError(
                "got a source mask but no source estimate to use it: leave the mask out, or "
                "choose an estimate"
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
        self,
        image: NDArray[Any],
        mask: Mask | None = None,
        should_stop: ShouldStop | None = None,
        on_warning: OnWarning | None = None,
        *,
        by: Callable[..., Image] | None = None,
    ) -> Image:
        """Estimate the source of a filtered shot.

        Parameters and errors are those of `filtered`, but for `on_warning`: it receives a
        sentence where the estimate has to be doubted (default: `warnings.warn`); and `by`, what
        is called as `Estimate.source` is, and in its place.

        Returns
        -------
        ndarray, shape (H, W)
        """
        assert self.estimate is not None
        usable = _both(mask, self.bare)
        beam = _as_beam(image, usable)
        guess = self.estimate.source if by is None else by
        source = guess(beam, usable, should_stop=should_stop, on_warning=on_warning)
        _check_fall(source, beam, mask, self.bare, on_warning)
        return source


def _as_beam(image: NDArray[Any], mask: Mask | None) -> Image:
    """Return a shot as an estimate of its source shall see it: not negative, 0 where masked."""
    values = np.asarray(image, dtype=np.float64)
    return np.maximum(values if mask is None else np.where(mask, values, 0), 0)


def check_masks(mask: Mask | None, bare: Mask | None) -> None:
    """Reject a mask that excludes the object, as marked by the source mask, from the inversion.

    Parameters
    ----------
    mask, bare : ndarray of bool, shape (H, W), or None
        The pixels that can be used, and those where the object is not.

    Raises
    ------
    InputError
        If next to nothing of the object is left.
    """
    if mask is None or bare is None or bare.all():
        return
    from scipy.ndimage import label

    # Place by place: a source mask may hide a wide border of unusable pixels, too.
    places, count = label(~bare, np.ones((3, 3)))
    hidden = np.bincount(places.ravel(), minlength=count + 1)[1:]
    visible = np.bincount(places[mask], minlength=count + 1)[1:]
    # Stray pixels are no object, unless there is nothing else.
    objects = hidden >= min(_LEAST_OBJECT, hidden.max())
    hidden, visible = hidden[objects], visible[objects]
    if (visible < _LEAST_VISIBLE * hidden).all():
        raise InputError(
            f"the mask hides {1 - visible.sum() / hidden.sum():.0%} of what the source mask "
            "hides, so the object would be excluded from the inversion: use the mask for "
            "unusable pixels only and the source mask for the object; if the object itself is "
            "unusable, leave the source mask out, as estimates ignore masked pixels anyway"
        )


def _check_fall(
    source: Image, image: Image, mask: Mask | None, bare: Mask | None, warn: OnWarning | None
) -> None:
    """Tell of a source that is much darker behind the source mask than anywhere around it."""
    if bare is None:
        return
    seen, object_ = (bare, ~bare) if mask is None else (bare & mask, ~bare & mask)
    if object_.any() and source[object_].min() < image[seen].min() / _MOST_FALL:
        (warnings.warn if warn is None else warn)(
            f"the estimated source falls to {source[object_].min():.3g} under the source mask, "
            f"while the image is at least {image[seen].min():.3g} elsewhere: compare it with "
            "another estimate"
        )


def _both(first: Mask | None, second: Mask | None) -> Mask | None:
    if first is None or second is None:
        return second if first is None else first
    return first & second
