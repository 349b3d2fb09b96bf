"""Newton's linear systems: graph Laplacians of power diagrams.

- solve one: `solve_laplacian`
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import splu

from napari_shadowinv.transport._coarsening import require_connected
from napari_shadowinv.transport._multigrid import LaplacianSolver

__all__ = ["solve_laplacian"]

Array = NDArray[np.float64]

_DIRECT_BELOW = 200


def solve_laplacian(
    laplacian: csr_array,
    right: Array,
    tolerance: float,
    threads: int = 1,
    *,
    ground: Array | None = None,
) -> Array:
    """Solve L x = b for a connected graph Laplacian, with x of mean zero.

    With a ground solve (L + diag(ground)) x = b; then no constant is left open.

    Large systems are solved by multigrid to the tolerance; small ones, and those where it
    does not get there, by factorisation.

    Parameters
    ----------
    laplacian : csr_array, shape (n, n)
        Symmetric, nothing positive off the diagonal, rows sum to zero.
    right : ndarray, shape (n,)
        Right side; without a ground its mean is ignored.
    tolerance : float
        Norm of the residual to reach, relative to the right side's.
    threads : int
        Most threads to use. Results do not depend on it.
    ground : ndarray, shape (n,), optional
        Conductance from each node to a ground at potential 0; not negative, not zero everywhere.

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
        return _solve_directly(laplacian, right, ground)
    solver = LaplacianSolver(laplacian, ground, threads=threads)
    solution, _, residual = solver.solve(right, tolerance)
    if residual <= tolerance:
        return solution
    return _solve_directly(laplacian, right, ground)


def _solve_directly(laplacian: csr_array, right: Array, ground: Array | None) -> Array:
    """Factorise the system, without a ground all but its first unknown."""
    if ground is not None:
        return _factorised(laplacian + diags_array(ground), right)
    solution: Array = np.zeros(len(right))
    if len(right) > 1:
        solution[1:] = _factorised(laplacian[1:, 1:], right[1:] - right.mean())
    solution -= solution.mean()
    return solution


def _factorised(matrix: csr_array, right: Array) -> Array:
    factors = splu(
        matrix.tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    solution: Array = factors.solve(right)
    return solution
