"""The convex function whose minimum is the transport from the source to the image.

    f(w) = -Σ_i [ w_i S_i + ∫_{P_i} (|r - r_i|² - w_i) I dr ],
    ∂f/∂w_i = T_i - S_i,   ∂²f/∂w_i∂w_j = -∫_{P_i ∩ P_j} I ds / (2 |r_i - r_j|)

- f, its gradient and its Hessian at given weights: `TransportObjective`; where flux may cross
  the image's edge: `OpenObjective`
- the result of a solver: `Solution`

References
----------
Paper, Eqs. 5 and 6; F. Aurenhammer, F. Hoffmann and B. Aronov, Algorithmica 20, 61 (1998).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.transport.linear import SimilarSystems
from napari_shadowinv.transport.margin import Margin
from napari_shadowinv.transport.sites import Level

__all__ = ["OpenObjective", "Solution", "TransportObjective"]


@dataclass(frozen=True, eq=False)
class Solution:
    """Weights of one level and how they were reached."""

    weights: FloatArray  # shape (n,), px²; of mean zero, but where the boundary is free
    residual: float  # largest relative flux error of a cell
    iterations: int
    converged: bool  # whether the residual is within the tolerance
    reason: str = ""  # why it did not converge


class TransportObjective:
    """The function f(w) for given sites, their source flux S_i, and an image of the same flux.

    The triangulation of the sites follows the weights of the last call.
    """

    def __init__(
        self,
        triangulation: RegularTriangulation,
        mass: FloatArray,
        image: Density,
        *,
        threads: int | None = None,
    ) -> None:
        self.triangulation = triangulation
        self.mass = mass
        self.image = image
        self.threads = threads

    def diagram(self, weights: FloatArray, *, with_moments: bool = False) -> PowerDiagram:
        """Return the power diagram for `weights`; empty cells are allowed."""
        self.triangulation.update(weights, threads=available_threads(self.threads))
        image = self.image_for(weights)
        return PowerDiagram(
            self.triangulation, image, with_moments=with_moments, threads=self.threads
        )

    def diagram_if_full(self, weights: FloatArray) -> PowerDiagram | None:
        """Return the power diagram for `weights`, or None as soon as a cell proves empty."""
        threads = available_threads(self.threads)
        if not self.triangulation.update(weights, stop_when_hidden=True, threads=threads):
            return None
        return PowerDiagram(self.triangulation, self.image_for(weights), threads=self.threads)

    def image_for(self, weights: FloatArray) -> Density:
        """Return the image that the cells divide among themselves."""
        return self.image

    def newton_step(
        self,
        systems: SimilarSystems,
        laplacian: csr_array,
        weights: FloatArray,
        gap: FloatArray,
        tolerance: float,
    ) -> FloatArray:
        """Return the change of the weights that fills each cell's gap to first order.

        The Laplacian belongs to the diagram of these weights. A RuntimeError is raised if the
        cells fall into groups with no flux between them.
        """
        return systems.solve(laplacian, gap, tolerance, ground=self.ground(weights))

    def ground(self, weights: FloatArray) -> FloatArray | None:
        """Return the derivative of each site's image flux by its weight, if it is not zero."""
        return None

    def in_gauge(self, weights: FloatArray) -> FloatArray:
        """Fix the undetermined constant of the weights: their mean becomes zero."""
        centred: FloatArray = weights - weights.mean()
        return centred

    def value_and_gradient(self, weights: FloatArray) -> tuple[float, FloatArray]:
        """Return f(w) and its gradient T - S (paper, Eqs. 5 and 6)."""
        diagram = self.diagram(weights, with_moments=True)
        gradient = diagram.masses - self.mass
        return float(np.sum(weights * gradient - diagram.inertia)), gradient

    def residual(self, diagram: PowerDiagram) -> float:
        """Return the largest relative flux error of a cell, max |T - S| / S."""
        return float(np.max(np.abs(diagram.masses - self.mass) / self.mass))


class OpenObjective(TransportObjective):
    """The function for a level over image and margin; the potential sets the margin's flux.

    The decay length ℓ is in px; see `napari_shadowinv.transport.margin`.
    """

    def __init__(
        self,
        level: Level,
        image: FloatArray,
        margin: Margin,
        decay_length: float,
        *,
        threads: int | None = None,
    ) -> None:
        self._pixels = margin.beam.copy()
        margin.within(self._pixels)[:] = image
        density = Density.from_image(self._pixels)
        super().__init__(level.triangulation.copy(), level.mass, density, threads=threads)
        self._beyond = np.nonzero(margin.beyond)
        self._beam = margin.beam[self._beyond]
        self._site = KDTree(level.sites).query(
            np.stack(self._beyond, axis=1), workers=available_threads(threads)
        )[1]
        self._gain = 0.5 / decay_length**2  # the potential is half the weight

    def image_for(self, weights: FloatArray) -> Density:
        """Return the image with the flux that arrives around it."""
        excess = self._gain * weights[self._site]
        # 1 + x where that is more than 1, else eˣ, which is never negative
        share = np.where(excess > 0, 1 + excess, np.exp(np.minimum(excess, 0)))
        self._pixels[self._beyond] = self._beam * share
        return Density.from_image(self._pixels)

    def ground(self, weights: FloatArray) -> FloatArray:
        """Return the derivative: more weight in the margin attracts more flux."""
        excess = self._gain * weights[self._site]
        slope = self._gain * self._beam * np.exp(np.minimum(excess, 0))
        return np.bincount(self._site, slope, len(weights)).astype(np.float64)

    def in_gauge(self, weights: FloatArray) -> FloatArray:
        """Return the weights as they are: far outside they are zero."""
        return weights
