"""The transport to an image whose edge flux may cross (see `napari_shadowinv.transport.margin`).

- its objective: `OpenObjective`
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from napari_shadowinv._system.threads import available_threads
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.transport.linear import solve_laplacian
from napari_shadowinv.transport.margin import Margin
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.sites import Level

__all__ = ["OpenObjective"]

Array = NDArray[np.float64]


class OpenObjective(TransportObjective):
    """The transport to an image whose surroundings receive what the potential asks for.

    Parameters
    ----------
    level : Level
        Sites over image and margin.
    image : ndarray, shape (H, W)
        The image.
    margin : Margin
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
        margin: Margin,
        decay_length: float,
        *,
        threads: int | None = None,
    ) -> None:
        self._pixels = margin.beam.copy()
        margin.within(self._pixels)[:] = image
        super().__init__(
            level.triangulation.copy(),
            level.mass,
            Density.from_image(self._pixels),
            threads=threads,
        )
        self._beyond = np.nonzero(margin.beyond)
        self._beam = margin.beam[self._beyond]
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
