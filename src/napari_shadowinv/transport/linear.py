"""Newton's linear systems: graph Laplacians of power diagrams.

- solve one: `solve_laplacian`
"""

from __future__ import annotations

import numpy as np
import pyamg
from numpy.typing import NDArray
from scipy.sparse import csr_array, csr_matrix
from scipy.sparse.linalg import splu
from threadpoolctl import threadpool_limits

__all__ = ["solve_laplacian"]

Array = NDArray[np.float64]

_DIRECT_BELOW = 3000


def solve_laplacian(laplacian: csr_array, right: Array, tolerance: float) -> Array:
    """Solve L x = b for a connected graph Laplacian, with x of mean zero.

    Parameters
    ----------
    laplacian : csr_array, shape (n, n)
        Symmetric, rows sum to zero.
    right : ndarray, shape (n,)
        Right side; its mean is ignored.
    tolerance : float
        Relative residual to reach.

    Returns
    -------
    ndarray, shape (n,)
    """
    right = right - right.mean()
    if len(right) < _DIRECT_BELOW:
        solution = np.zeros(len(right))
        solution[1:] = splu(laplacian[1:, 1:].tocsc()).solve(right[1:])
    else:
        # more threads only slow the many small products of the cycles
        with threadpool_limits(limits=1):
            hierarchy = pyamg.ruge_stuben_solver(csr_matrix(laplacian), max_coarse=500)
            solution = hierarchy.solve(right, tol=tolerance, accel="cg", maxiter=200)
    return solution - solution.mean()
