"""Linear systems with a positive definite matrix: `solve`, and what one teaches the next.

Where fields and the numbers of an instrument explain images alike, some dozens of the eigenvalues
of a scaled Hessian are a thousand times smaller than all others; where rays have crossed, some are
a thousand times larger. Conjugate gradients find these directions slowly, but a solution yields
them (`SoftModes`), and further systems with nearly the same matrix are solved in few steps once
they are treated apart.

References
----------
M. R. Hestenes and E. Stiefel, J. Res. Natl. Bur. Stand. 49, 409 (1952); S. Gratton, A. Sartenaer
and J. Tshimanga, SIAM J. Optim. 21, 912 (2011).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh_tridiagonal

from napari_shadowinv._typing import AnyArray, FloatArray


def product(first: FloatArray, second: FloatArray) -> float:
    """Scalar product without BLAS, whose idle threads spin and whose sums depend on them."""
    return float(np.einsum("i,i", first, second))


@dataclass(eq=False)
class SoftModes:
    """Directions in which a matrix is small or large, for systems with nearly the same matrix.

    `solve` uses them, and adds those that have cost it many steps. They change the number of steps,
    not the solution beyond its tolerance.
    """

    most: int = 120  # modes that are kept
    soft: float = 0.5  # eigenvalues below it are of modes; most are about 1
    stiff: float = 4.0  # so are those above it
    worth: int = 12  # least steps of a solution from which modes are taken
    outdated: int = 100  # steps, with all modes, from which they belong to another matrix
    found: float = 0.5  # largest residual of an eigenvector over its eigenvalue
    independent: float = 1e-4  # least eigenvalue of products; rounding makes copies of some
    _vectors: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    _weights: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self._weights)

    def precondition(self, residual: FloatArray) -> FloatArray:
        """Return a residual with its parts along the modes over their eigenvalues."""
        if self._vectors.shape[1] != residual.size:
            return residual
        along = np.einsum("kn,n->k", self._vectors, residual)
        along *= self._weights
        return np.asarray(residual + np.einsum("k,kn->n", along, self._vectors))

    def learn(self, history: _History) -> None:
        """Add the modes that a solution has met; begin anew if others are of no use."""
        if len(history) < self.worth:
            return
        matrix = history.matrix()
        values, mixing = _tridiagonal_eigensystem(matrix[:-1, :-1])
        errors = np.abs(matrix[-1, -2] * mixing[-1])
        is_far = (values < self.soft) | (values > self.stiff)
        chosen = np.flatnonzero(is_far & (errors < self.found * values))
        size, is_outdated = history.size, len(history) > self.outdated
        if self._vectors.shape[1] != size:
            self._vectors, self._weights = np.empty((0, size)), np.empty(0)
        elif is_outdated and len(self) == self.most:
            self._vectors, self._weights = np.empty((0, size)), np.empty(0)
            # Their lengths are those with the old modes: less of a stiff one could become negative.
            chosen = chosen[values[chosen] < self.soft]
        chosen = chosen[: self.most - len(self)]
        if not chosen.size:
            return
        mixing = mixing[:, chosen]
        vectors = np.einsum("mk,mn->kn", mixing, np.array(history.turned[:-1], dtype=np.float64))
        residuals = np.array(history.residuals, dtype=np.float64)
        untouched = np.einsum("mk,mn->kn", mixing, residuals[:-1])
        images = np.einsum("mk,mn->kn", _tridiagonal_times(matrix, mixing), residuals)
        # Eigenvectors in the space of these vectors, of which rounding makes some twice.
        overlaps = np.einsum("in,jn->ij", vectors, untouched)
        energies = np.einsum("in,jn->ij", vectors, images)
        sizes, turn = eigensystem(overlaps + overlaps.T)
        is_new = sizes > self.independent
        turn = turn[:, is_new] / np.sqrt(sizes[is_new] / 2)
        turned_energies = np.einsum("jk,ji->ki", turn, energies + energies.T)
        values, inner = eigensystem(np.einsum("ki,ij->kj", turned_energies, turn) / 2)
        inner, values = inner[:, values > 0], values[values > 0]
        mixing = np.einsum("jk,ki->ij", turn, inner)
        directions = np.einsum("ij,jn->in", mixing, vectors)
        self._vectors = np.concatenate([self._vectors, directions])
        self._weights = np.append(self._weights, 1 / values - 1)


def _tridiagonal_times(matrix: FloatArray, columns: FloatArray) -> FloatArray:
    """Return all but the last column of a matrix times columns, without BLAS; see `product`."""
    result = np.zeros((len(matrix), columns.shape[1]))
    result[:-1] = np.diag(matrix)[:-1, None] * columns
    result[1:] += np.diag(matrix, -1)[:, None] * columns
    result[:-2] += np.diag(matrix, 1)[:-1, None] * columns[1:]
    return result


def _tridiagonal_eigensystem(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    # SciPy's default driver multiplies matrices by BLAS.
    values, vectors = eigh_tridiagonal(np.diag(matrix), np.diag(matrix, -1), lapack_driver="stev")
    return values, vectors


def eigensystem(matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues and eigenvectors (columns) of a symmetric matrix, without BLAS; see `product`."""
    matrix, turns = matrix.copy(), np.eye(len(matrix))
    for k in range(len(matrix) - 2):  # each reflection makes one column tridiagonal
        column = matrix[k + 1 :, k].copy()
        length = np.sqrt(product(column, column))
        if length == 0:
            continue
        column[0] += np.copysign(length, column[0])
        column *= np.sqrt(2 / product(column, column))
        trailing = matrix[k + 1 :, k + 1 :]
        image = np.einsum("ij,j->i", trailing, column)
        image -= product(column, image) / 2 * column
        trailing -= np.multiply.outer(column, image) + np.multiply.outer(image, column)
        matrix[k + 1, k] = -np.copysign(length, matrix[k + 1, k])
        turns[:, k + 1 :] -= np.multiply.outer(
            np.einsum("ij,j->i", turns[:, k + 1 :], column), column
        )
    values, vectors = _tridiagonal_eigensystem(matrix)
    return values, np.einsum("ij,jk->ik", turns, vectors)


class _History:
    def __init__(self, size: int, worth: int, most_numbers: int = 8_000_000) -> None:
        most = most_numbers // size  # in each list of vectors
        self.size, self._most = size, most if most >= worth else 0
        self.residuals: list[AnyArray] = []  # Lanczos vectors
        self.turned: list[AnyArray] = []  # the same preconditioned
        self._shares: list[float] = []
        self._ratios: list[float] = []

    def __len__(self) -> int:
        return len(self._shares)

    def add(
        self, residual: FloatArray, turned: FloatArray, square: float, share: float, ratio: float
    ) -> None:
        """Add a step: a residual, the same preconditioned, their product, and coefficients."""
        if len(self) < self._most:
            scale = (-1.0) ** len(self) / np.sqrt(square)
            self.residuals.append((scale * residual).astype(np.float32))
            self.turned.append((scale * turned).astype(np.float32))
            self._shares.append(share)
            self._ratios.append(ratio)

    def matrix(self) -> FloatArray:
        """Return the tridiagonal matrix between them."""
        shares, ratios = np.array(self._shares), np.array(self._ratios)
        diagonal = 1 / shares
        diagonal[1:] += ratios[:-1] / shares[:-1]
        beside = np.sqrt(ratios[:-1]) / shares[:-1]
        return np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)


def solve(
    times: Callable[[FloatArray], FloatArray],
    right: FloatArray,
    *,
    tolerance: float,
    iterations: int,
    modes: SoftModes | None = None,
) -> FloatArray:
    """Solve a positive definite system by conjugate gradients, from zero.

    `times` multiplies the matrix by a vector. The steps end at a residual of `tolerance` times the
    `right` side, (n,). The modes come from nearly the same matrix; modes of this solution are
    added.
    """
    modes = SoftModes() if modes is None else modes
    history = _History(right.size, modes.worth)
    solution, residual = np.zeros_like(right), right
    goal = tolerance**2 * product(residual, residual)
    turned = modes.precondition(residual)
    direction, square, steps = turned, product(residual, turned), 0
    while steps < iterations and square > 0 and product(residual, residual) > goal:
        image = times(direction)
        share = square / product(direction, image)
        solution += share * direction
        before = residual, turned, square
        residual = residual - share * image
        turned = modes.precondition(residual)
        square = product(residual, turned)
        ratio = square / before[2]
        direction = turned + ratio * direction
        history.add(*before, share, ratio)
        steps += 1
    modes.learn(history)
    return solution
