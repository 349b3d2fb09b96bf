"""A free boundary: flux may cross the image's edge.

The sites cover a margin around the image too, where the beam goes on undisturbed as far as is
known. What arrives in the margin is not seen, so it is not prescribed: where the potential φ of
the deflection does not vanish, the flux S (1 + φ / ℓ²) is taken to arrive instead of S. In the
linear limit, Δφ = φ / ℓ²: beyond the edge the potential fades over the decay length ℓ. Each end
of the scale is well known: ℓ → 0 is φ = 0 at the edge, where flux leaves and enters at no more
than the cost of its transport; ℓ → ∞ is a margin filled with the source. In between, the
potential runs on smoothly across the edge.

- the beam in the margin: `Margin`
- flux that crosses each side of the image: `edge_flux`
- the transport with this boundary: `napari_shadowinv.transport.open_objective`
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from napari_shadowinv.geometry.density import split_pixels

__all__ = ["Margin", "edge_flux"]

Array = NDArray[np.float64]

_SIDES = ("top", "bottom", "left", "right")


@dataclass(frozen=True)
class Margin:
    """The beam in an image and in a margin around it.

    Attributes
    ----------
    beam : ndarray, shape (H + 2 m, W + 2 m)
        The source with its margin.
    width : int
        Pixels m on each side.
    """

    beam: Array
    width: int

    @classmethod
    def around(cls, source: Array, width: int, mask: NDArray[np.bool_] | None = None) -> Margin:
        """Continue a source beyond its edge by its nearest usable pixel.

        Parameters
        ----------
        source : ndarray, shape (H, W)
            Positive somewhere.
        width : int
            Pixels to add on each side.
        mask : ndarray of bool, shape (H, W), optional
            True where the source can be relied on.
        """
        usable = source > 0 if mask is None else mask & (source > 0)
        rows, columns = distance_transform_edt(
            np.pad(~usable, width, constant_values=True),
            return_distances=False,
            return_indices=True,
        )
        beam = np.pad(source, width)[rows, columns]
        made = cls(beam, width)
        made.within(beam)[:] = source
        return made

    def split(self, factor: int) -> Margin:
        """Return the same beam for pixels that are split into factor × factor."""
        return Margin(split_pixels(self.beam, factor), factor * self.width)

    def within(self, values: Array) -> Array:
        """Return the part of an array that belongs to the image; its last axes are y and x."""
        m = self.width
        return values[..., m:-m, m:-m]

    def parts(self, source: Array) -> tuple[Array, Array]:
        """Return a source of the image, and the beam of the margin, each alone in the whole."""
        image_part = np.zeros_like(self.beam)
        self.within(image_part)[:] = source
        return image_part, np.where(self.beyond, self.beam, 0)

    @cached_property
    def beyond(self) -> NDArray[np.bool_]:
        """Where the margin is, shape (H + 2 m, W + 2 m)."""
        beyond = np.ones(self.beam.shape, bool)
        self.within(beyond)[:] = False
        return beyond

    def edge_distance(self, points: NDArray[Any]) -> Array:
        """How far inside each side of the image points lie, px.

        Parameters
        ----------
        points : ndarray, shape (..., 2)
            Positions (y, x), counted from the margin's corner.

        Returns
        -------
        ndarray, shape (..., 4)
            From top, bottom, left and right; negative beyond.
        """
        first = self.width - 0.5
        last = np.array(self.beam.shape) - 1 - first
        both = np.stack([points - first, last - points], axis=-1)
        return both.reshape(*points.shape[:-1], 4)


def edge_flux(
    left_behind: Array, arrived: Array, margin: Margin
) -> tuple[dict[str, float], dict[str, float]]:
    """Sort the flux that has crossed the image's edge by the nearest side.

    Parameters
    ----------
    left_behind : ndarray, shape (H + 2 m, W + 2 m)
        Where the image's share of the source has landed.
    arrived : ndarray, shape (H + 2 m, W + 2 m)
        Where the margin's share has landed.
    margin : Margin
        The beam.

    Returns
    -------
    left, entered : dict of str to float
        For each of the sides top, bottom, left and right the flux, as a share of the source's
        flux in the image.
    """
    pixels = np.moveaxis(np.indices(margin.beam.shape), 0, -1)
    nearest = margin.edge_distance(pixels).argmin(axis=-1)
    total = margin.within(margin.beam).sum()

    def by_side(flux: Array) -> dict[str, float]:
        shares = np.bincount(nearest.ravel(), flux.ravel(), minlength=4) / total
        return dict(zip(_SIDES, shares.tolist(), strict=True))

    return by_side(np.where(margin.beyond, left_behind, 0)), by_side(
        np.where(margin.beyond, 0, arrived)
    )
