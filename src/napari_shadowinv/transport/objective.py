"""The convex function whose minimum is the transport from the source to the image.

    f(w) = -Σ_i [ w_i S_i + ∫_{P_i} (|r - r_i|² - w_i) I dr ],
    ∂f/∂w_i = T_i - S_i,   ∂²f/∂w_i∂w_j = -∫_{P_i ∩ P_j} I ds / (2 |r_i - r_j|)

- f, its gradient and its Hessian at given weights: `TransportObjective`
- what a solver returns: `Solution`

References
----------
Paper, Eqs. 5 and 6; F. Aurenhammer, F. Hoffmann and B. Aronov, Algorithmica 20, 61 (1998).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from napari_shadowinv._system.threads import available_threads
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.transport.linear import solve_laplacian

__all__ = ["Solution", "TransportObjective"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """Weights of one level and how they were reached.

    Attributes
    ----------
    weights : ndarray, shape (n,)
        px²; of mean zero, but where the boundary is free.
    residual : float
        Largest relative flux error of a cell.
    iterations : int
        Steps of the solver.
    converged : bool
        Whether the residual is within the tolerance.
    reason : str
        Why it did not converge; empty if it did.
    """

    weights: Array
    residual: float
    iterations: int
    converged: bool
    reason: str = ""


class TransportObjective:
    """The function f(w) for given sites, their source flux, and an image.

    Parameters
    ----------
    triangulation : RegularTriangulation
        Triangulation of the sites; it follows the weights that are asked for.
    mass : ndarray, shape (n,)
        Source flux S_i of each site; its sum must equal the image's flux.
    image : Density
        The image.
    threads : int, optional
        Threads of the kernels; results do not depend on it.
    """

    def __init__(
        self,
        triangulation: RegularTriangulation,
        mass: Array,
        image: Density,
        *,
        threads: int | None = None,
    ) -> None:
        self.triangulation = triangulation
        self.mass = mass
        self.image = image
        self.threads = threads

    def diagram(self, weights: Array, *, with_moments: bool = False) -> PowerDiagram:
        """Return the power diagram for `weights`; empty cells are allowed."""
        self.triangulation.update(weights, threads=available_threads(self.threads))
        return PowerDiagram(
            self.triangulation,
            self.image_for(weights),
            with_moments=with_moments,
            threads=self.threads,
        )

    def diagram_if_full(self, weights: Array) -> PowerDiagram | None:
        """Return the power diagram for `weights`, or None as soon as a cell proves empty."""
        threads = available_threads(self.threads)
        if not self.triangulation.update(weights, stop_when_hidden=True, threads=threads):
            return None
        return PowerDiagram(self.triangulation, self.image_for(weights), threads=self.threads)

    def image_for(self, weights: Array) -> Density:
        """Return the image that the cells divide among themselves."""
        return self.image

    def newton_step(
        self, laplacian: csr_array, weights: Array, gap: Array, tolerance: float
    ) -> Array:
        """Return the change of the weights that closes the gap to first order.

        Parameters
        ----------
        laplacian : csr_array, shape (n, n)
            Of the diagram for these weights.
        weights : ndarray, shape (n,)
            Where the step starts, px².
        gap : ndarray, shape (n,)
            Flux that each cell lacks.
        tolerance : float
            Relative residual of the linear system.

        Raises
        ------
        RuntimeError
            The cells fall into groups with no flux between them.
        """
        return solve_laplacian(laplacian, gap, tolerance, available_threads(self.threads))

    def in_gauge(self, weights: Array) -> Array:
        """Fix the constant that the weights are known up to: their mean is zero."""
        centred: Array = weights - weights.mean()
        return centred

    def value_and_gradient(self, weights: Array) -> tuple[float, Array]:
        """Return f(w) and its gradient T - S (paper, Eqs. 5 and 6).

        Parameters
        ----------
        weights : ndarray, shape (n,)
            Weights in px².

        Returns
        -------
        value : float
        gradient : ndarray, shape (n,)
        """
        diagram = self.diagram(weights, with_moments=True)
        gradient = diagram.masses - self.mass
        value = float(np.sum(weights * gradient - diagram.inertia))
        return value, gradient

    def residual(self, diagram: PowerDiagram) -> float:
        """Return the largest relative flux error of a cell, max |T - S| / S."""
        return float(np.max(np.abs(diagram.masses - self.mass) / self.mass))
