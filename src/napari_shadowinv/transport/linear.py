"""Newton's linear systems: graph Laplacians of power diagrams.

- solve one: `solve_laplacian`
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import splu

from napari_shadowinv.transport._coarsening import require_connected
from napari_shadowinv.transport._multigrid import LaplacianSolver

__all__ = ["solve_laplacian"]

Array = NDArray[np.float64]

_DIRECT_BELOW = 200


def solve_laplacian(
    laplacian: csr_array, right: Array, tolerance: float, threads: int = 1
) -> Array:
    """Solve L x = b for a connected graph Laplacian, with x of mean zero.

    Large systems are solved by multigrid to the tolerance; small ones, and those where it
    does not get there, by factorisation.

    Parameters
    ----------
    laplacian : csr_array, shape (n, n)
        Symmetric, nothing positive off the diagonal, rows sum to zero.
    right : ndarray, shape (n,)
        Right side; its mean is ignored.
    tolerance : float
        Norm of the residual to reach, relative to the right side's.
    threads : int
        Most threads to use. Results do not depend on it.

    Returns
    -------
    ndarray, shape (n,)

    Raises
    ------
    RuntimeError
        The graph is not connected.

    Examples
    --------
    >>> chain = csr_array(np.array([[1.0, -1, 0], [-1, 3, -2], [0, -2, 2]]))
    >>> solution = solve_laplacian(chain, np.array([1.0, 0, -1]), 1e-2)
    >>> solution - solution[2]
    array([1.5, 0.5, 0. ])
    """
    if len(right) < _DIRECT_BELOW:
        require_connected(laplacian)
        return _solve_directly(laplacian, right)
    solution, _, residual = LaplacianSolver(laplacian, threads=threads).solve(right, tolerance)
    if residual <= tolerance:
        return solution
    return _solve_directly(laplacian, right)


def _solve_directly(laplacian: csr_array, right: Array) -> Array:
    """Factorise the system without its first unknown."""
    solution: Array = np.zeros(len(right))
    if len(right) > 1:
        factors = splu(
            laplacian[1:, 1:].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        solution[1:] = factors.solve(right[1:] - right.mean())
    solution -= solution.mean()
    return solution
