"""A free boundary: flux may cross the image's edge.

The sites also cover a margin around the image, in which the beam is assumed to continue
undisturbed. The flux that arrives in the margin is not measured, so it is not prescribed: where
the potential φ of the deflection does not vanish, the flux S (1 + φ / ℓ²) arrives instead of S. In
the linear limit, Δφ = φ / ℓ²: beyond the edge the potential decays over the decay length ℓ. Both
limits are simple: ℓ → 0 means φ = 0 at the edge, where flux leaves and enters at no more than the
cost of its transport; ℓ → ∞ is a margin filled with the source. In between, the potential
continues smoothly across the edge.

- the beam in the margin: `Margin`
- flux that crosses each side of the image: `edge_flux`
- the transport with this boundary: `napari_shadowinv.transport.objective.OpenObjective`
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt

from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.geometry.density import split_pixels

__all__ = ["Margin", "edge_flux"]


@dataclass(frozen=True)
class Margin:
    """The beam in an image and in a margin around it."""

    beam: FloatArray  # (H + 2 m, W + 2 m): the source with its margin
    width: int  # pixels m on each side

    @classmethod
    def around(cls, source: FloatArray, width: int, mask: BoolArray | None = None) -> Margin:
        """Continue a source by its nearest positive pixel, of those in the mask if there is one."""
        usable = source > 0 if mask is None else mask & (source > 0)
        rows, columns = distance_transform_edt(
            np.pad(~usable, width, constant_values=True),
            return_distances=False,
            return_indices=True,
        )
        beam = np.pad(source, width)[rows, columns]
        margin = cls(beam, width)
        margin.within(beam)[:] = source
        return margin

    def split(self, factor: int) -> Margin:
        """Return the same beam for pixels that are split into factor × factor."""
        return Margin(split_pixels(self.beam, factor), factor * self.width)

    def within(self, values: FloatArray) -> FloatArray:
        """Return the part of an array that belongs to the image; its last axes are y and x."""
        m = self.width
        return values[..., m:-m, m:-m]

    def parts(self, source: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a source of the image, and the beam of the margin, each alone in the whole."""
        image_part = np.zeros_like(self.beam)
        self.within(image_part)[:] = source
        return image_part, np.where(self.beyond, self.beam, 0)

    @cached_property
    def beyond(self) -> BoolArray:
        """True in the margin, shape (H + 2 m, W + 2 m)."""
        beyond = np.ones(self.beam.shape, bool)
        self.within(beyond)[:] = False
        return beyond

    def edge_distance(self, points: AnyArray) -> FloatArray:
        """Return how far inside top, bottom, left, right points (y, x) lie, px, shape (..., 4)."""
        first = self.width - 0.5
        last = np.array(self.beam.shape) - 1 - first
        both = np.stack([points - first, last - points], axis=-1)
        return both.reshape(*points.shape[:-1], 4)


def edge_flux(
    left_behind: FloatArray, arrived: FloatArray, margin: Margin
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the flux that left and entered the image at each side, relative to its source's flux.

    The image's part of the source has landed as `left_behind`, the margin's as `arrived`.
    """
    pixels = np.moveaxis(np.indices(margin.beam.shape), 0, -1)
    nearest = margin.edge_distance(pixels).argmin(axis=-1)
    total = margin.within(margin.beam).sum()

    def by_side(flux: FloatArray) -> dict[str, float]:
        shares = np.bincount(nearest.ravel(), flux.ravel(), minlength=4) / total
        return dict(zip(("top", "bottom", "left", "right"), shares.tolist(), strict=True))

    return by_side(np.where(margin.beyond, left_behind, 0)), by_side(
        np.where(margin.beyond, 0, arrived)
    )
