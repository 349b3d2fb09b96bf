"""A free boundary: flux may cross the image's edge.

The sites cover a margin around the image too, where the beam goes on undisturbed as far as is
known. What arrives in the margin is not seen, so it is not prescribed: where the potential φ of
the deflection does not vanish, the flux S (1 + φ / ℓ²) is taken to arrive instead of S. In the
linear limit, Δφ = φ / ℓ²: beyond the edge the potential fades over the decay length ℓ. Each end
of the scale is well known: ℓ → 0 is φ = 0 at the edge, where flux leaves and enters at no more
than the cost of its transport; ℓ → ∞ is a margin filled with the source. In between, the
potential runs on smoothly across the edge.

- the beam beyond the edge: `Outside`
- the transport with a free boundary: `OpenObjective`
- what crosses each side of the image: `crossings`
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from napari_shadowinv.geometry._threads import available_threads
from napari_shadowinv.geometry.density import Density, split_pixels
from napari_shadowinv.transport.linear import solve_laplacian
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.sites import Level

__all__ = ["OpenObjective", "Outside", "crossings"]

Array = NDArray[np.float64]

_SIDES = ("top", "bottom", "left", "right")


@dataclass(frozen=True)
class Outside:
    """The beam in and around an image.

    Attributes
    ----------
    beam : ndarray, shape (H + 2 m, W + 2 m)
        The source with its margin.
    margin : int
        Pixels m on each side.
    """

    beam: Array
    margin: int

    @classmethod
    def around(cls, source: Array, margin: int, mask: NDArray[np.bool_] | None = None) -> Outside:
        """Continue a source beyond its edge by its nearest usable pixel.

        Parameters
        ----------
        source : ndarray, shape (H, W)
            Positive somewhere.
        margin : int
            Pixels to add on each side.
        mask : ndarray of bool, shape (H, W), optional
            True where the source can be relied on.
        """
        usable = source > 0 if mask is None else mask & (source > 0)
        rows, columns = distance_transform_edt(
            np.pad(~usable, margin, constant_values=True),
            return_distances=False,
            return_indices=True,
        )
        beam = np.pad(source, margin)[rows, columns]
        outside = cls(beam, margin)
        outside.within(beam)[:] = source
        return outside

    def split(self, factor: int) -> Outside:
        """Return the same beam for pixels that are split into factor × factor."""
        return Outside(split_pixels(self.beam, factor), factor * self.margin)

    def within(self, values: Array) -> Array:
        """Return the part of an array that belongs to the image; its last axes are y and x."""
        m = self.margin
        return values[..., m:-m, m:-m]

    def parts(self, source: Array) -> tuple[Array, Array]:
        """Return a source of the image, and the beam of the margin, each alone in the whole."""
        image_part = np.zeros_like(self.beam)
        self.within(image_part)[:] = source
        return image_part, np.where(self.beyond, self.beam, 0)

    @cached_property
    def beyond(self) -> NDArray[np.bool_]:
        """Where the margin is, shape (H + 2 m, W + 2 m)."""
        margin = np.ones(self.beam.shape, bool)
        self.within(margin)[:] = False
        return margin

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
        first = self.margin - 0.5
        last = np.array(self.beam.shape) - 1 - first
        both = np.stack([points - first, last - points], axis=-1)
        return both.reshape(*points.shape[:-1], 4)


class OpenObjective(TransportObjective):
    """The transport to an image whose surroundings receive what the potential asks for.

    Parameters
    ----------
    level : Level
        Sites over image and margin.
    image : ndarray, shape (H, W)
        The image.
    outside : Outside
        The beam.
    decay_length : float
        ℓ, in px.
    threads : int, optional
        Threads of the kernels; results do not depend on it.
    """

    def __init__(
        self,
        level: Level,
        image: Array,
        outside: Outside,
        decay_length: float,
        *,
        threads: int | None = None,
    ) -> None:
        self._pixels = outside.beam.copy()
        outside.within(self._pixels)[:] = image
        super().__init__(
            level.triangulation.copy(),
            level.mass,
            Density.from_image(self._pixels),
            threads=threads,
        )
        self._beyond = np.nonzero(outside.beyond)
        self._beam = outside.beam[self._beyond]
        self._site = KDTree(level.sites).query(
            np.stack(self._beyond, axis=1), workers=available_threads(threads)
        )[1]
        self._gain = 0.5 / decay_length**2  # the potential is half the weight

    def image_for(self, weights: Array) -> Density:
        """Return the image with what arrives around it."""
        self._pixels[self._beyond] = self._beam * _response(self._gain * weights[self._site])
        return Density.from_image(self._pixels)

    def newton_step(
        self, laplacian: csr_array, weights: Array, gap: Array, tolerance: float
    ) -> Array:
        """See `TransportObjective.newton_step`; more weight in the margin brings more flux."""
        slope = self._gain * self._beam * _slope(self._gain * weights[self._site])
        ground = np.bincount(self._site, slope, len(weights)).astype(np.float64)
        threads = available_threads(self.threads)
        return solve_laplacian(laplacian, gap, tolerance, threads, ground=ground)

    def in_gauge(self, weights: Array) -> Array:
        """Return the weights as they are: far outside they are zero."""
        return weights


def _response(excess: Array) -> Array:
    """Return 1 + x where that is more than 1, else eˣ, which is never negative."""
    return np.where(excess > 0, 1 + excess, np.exp(np.minimum(excess, 0)))


def _slope(excess: Array) -> Array:
    return np.exp(np.minimum(excess, 0))


def crossings(
    left_behind: Array, arrived: Array, outside: Outside
) -> tuple[dict[str, float], dict[str, float]]:
    """Sort the flux that has crossed the image's edge by the nearest side.

    Parameters
    ----------
    left_behind : ndarray, shape (H + 2 m, W + 2 m)
        Where the image's share of the source has landed.
    arrived : ndarray, shape (H + 2 m, W + 2 m)
        Where the margin's share has landed.
    outside : Outside
        The beam.

    Returns
    -------
    left, entered : dict of str to float
        For each of the sides top, bottom, left and right the flux, as a share of the source's
        flux in the image.
    """
    pixels = np.moveaxis(np.indices(outside.beam.shape), 0, -1)
    nearest = outside.edge_distance(pixels).argmin(axis=-1)
    total = outside.within(outside.beam).sum()

    def by_side(flux: Array) -> dict[str, float]:
        shares = np.bincount(nearest.ravel(), flux.ravel(), minlength=4) / total
        return dict(zip(_SIDES, shares.tolist(), strict=True))

    return by_side(np.where(outside.beyond, left_behind, 0)), by_side(
        np.where(outside.beyond, 0, arrived)
    )
