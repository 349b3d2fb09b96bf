"""One Laplacian, many right-hand sides: factors, with which a solution costs two substitutions.

- solutions of many systems, `WIDTH` at a time: `FactorisedLaplacian`
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.linear_surface import WIDTH
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.transport._coarsening import require_connected
from napari_shadowinv.transport.linear import factorise

__all__ = ["FactorisedLaplacian"]


@njit(nogil=True, cache=True)
def _substitute(
    starts: Indices, rows: Indices, factor: FloatArray, pivots: FloatArray, x: FloatArray
) -> None:
    """Solve L D Lᵀ x = b in place; each column of L begins with its diagonal, which is 1."""
    n = len(pivots)
    unknown = np.empty(WIDTH)
    for j in range(n):
        for s in range(WIDTH):
            unknown[s] = x[j, s]
        for k in range(starts[j] + 1, starts[j + 1]):
            i, value = rows[k], factor[k]
            for s in range(WIDTH):
                x[i, s] -= value * unknown[s]
    for j in range(n - 1, -1, -1):
        for s in range(WIDTH):
            unknown[s] = x[j, s] / pivots[j]
        for k in range(starts[j] + 1, starts[j + 1]):
            i, value = rows[k], factor[k]
            for s in range(WIDTH):
                unknown[s] -= value * x[i, s]
        for s in range(WIDTH):
            x[j, s] = unknown[s]


class FactorisedLaplacian:
    """Factors of a Laplacian as `LaplacianSolver` takes it, which threads may share.

    A graph that is not connected, or that rounding makes look so, raises a RuntimeError.
    """

    def __init__(self, laplacian: csr_array, ground: FloatArray | None = None) -> None:
        require_connected(laplacian)
        factors = factorise(laplacian, ground)
        self._n, self._pinned = int(laplacian.shape[0]), int(ground is None)
        self._pivots = factors.U.diagonal()
        self._places = factors.perm_c.copy()  # itself, it would keep all factors
        # Rows are exchanged as the columns are, so U = D Lᵀ, as long as each pivot is positive.
        if not (np.array_equal(factors.perm_r, self._places) and (self._pivots > 0).all()):
            raise RuntimeError("the Laplacian is not positive")
        lower = factors.L
        lower.sort_indices()
        self._lower = lower.indptr, lower.indices, lower.data

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve L x = b for each column of b, (n, k).

        Without a ground the mean of b is ignored, and x is zero at the first node.
        """
        solution = np.zeros((self._n, right.shape[1]))
        if self._pinned:
            right = (right - right.mean(axis=0))[1:]
        for start in range(0, right.shape[1], WIDTH):
            columns = slice(start, start + WIDTH)
            ordered = np.zeros((len(right), WIDTH))
            ordered[self._places, : right[:, columns].shape[1]] = right[:, columns]
            _substitute(*self._lower, self._pivots, ordered)
            solved = ordered[self._places]
            solution[self._pinned :, columns] = solved[:, : solution[:, columns].shape[1]]
        return solution
