"""Abel inversion of a deflection by a small linear operator.

- deflections and line integrals of an axisymmetric object: `deflection_matrix`, `projection_matrix`
- its inverse, regularised: `inverse_matrix`
- how far to smooth, by the difference of the object's sides: `choose_smoothing`

All lengths are in px. An object f(r) with the projection F(y) = ∫f dz deflects by
δ(y) = -F'(y), at the distance y from its axis. In terms of the profile,

    F(y) = 2 ∫ f(r) r / √(r² - y²) dr,    δ(y) = -2 y ∫ f'(r) / √(r² - y²) dr,    r from y to R,

so that f follows from δ without a derivative: f(r) = (1/π) ∫ δ(y) / √(y² - r²) dy. Here f is
continuous and linear between radii one pixel apart, and zero at the outermost radius R. The
deflections are taken `FIRST_OFFSET` outside of these radii, projections at them. The integrals of
the pieces are elementary, and f is found by least squares with a penalty on its second differences.
As the result is linear in δ, its covariance is A C Aᵀ.

References
----------
.. [1] K. J. Daun et al., "Deconvolution of axisymmetric flame properties using Tikhonov
   regularization", Appl. Opt. 45, 4638 (2006).
.. [2] D. D. Hickstein et al., "A direct comparison of high-speed methods for the numerical Abel
   transform", Rev. Sci. Instrum. 90, 065115 (2019).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError

FIRST_OFFSET = 0.3027
"""Distance in px of the first deflection from the axis.

A piece of constant slope errs by its curvature, weighted with 1/√(r² - y²). Over all pieces this
adds up to the Hurwitz zeta function ζ(-½, offset), of which it is the zero.
"""

_SMOOTHINGS = tuple(10.0 ** (power / 2) for power in range(-4, 11))


def deflection_matrix(count: int, offset: float = FIRST_OFFSET) -> FloatArray:
    """Return the deflections at y = offset + 0, 1, … by a profile at r = 0, 1, … px.

    The matrix, (count, count), times f in px gives δ in px, positive away from the axis. An
    `InputError` refuses fewer than 4 radii.
    """
    y, _, integral = _grid(count, offset)
    pieces = -2 * y * np.diff(integral, axis=1)
    matrix = np.zeros((count, count + 1))
    matrix[:, 1:] += pieces
    matrix[:, :-1] -= pieces
    return matrix[:, :-1]


def projection_matrix(count: int, offset: float = 0.0) -> FloatArray:
    """Return the line integrals at y = offset + 0, 1, … of a profile at r = 0, 1, … px.

    The matrix, (count, count), times f gives F, in units of f times px.
    """
    y, radii, integral = _grid(count, offset)
    root = np.sqrt(np.maximum(radii**2 - y**2, 0.0))
    # ∫ r dr / √(r² - y²) and ∫ r² dr / √(r² - y²) over each piece
    first = np.diff(root, axis=1)
    second = np.diff((radii * root + y**2 * integral) / 2, axis=1)
    matrix = np.zeros((count, count + 1))
    matrix[:, :-1] += 2 * (radii[:, 1:] * first - second)
    matrix[:, 1:] += 2 * (second - radii[:, :-1] * first)
    return matrix[:, :-1]


def inverse_matrix(matrix: FloatArray, smoothing: float) -> FloatArray:
    """Return the operator, (n, m), from deflections or projections to the profile.

    With the matrix K, (m, n), it minimises |K f - δ|² + s |f''|² by second differences of f, which
    is even at the axis and zero beyond R; s is the smoothing.
    """
    count = matrix.shape[1]
    bends = -2.0 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    bends[0, 1] = 2.0
    normal = matrix.T @ matrix + smoothing * bends.T @ bends
    return np.asarray(np.linalg.solve(normal, matrix.T))


def choose_smoothing(
    matrix: FloatArray, side: FloatArray, opposite_side: FloatArray, *, share: float = 0.25
) -> float:
    """Return the largest smoothing whose error is small against that by noise.

    The sides of an axisymmetric object, (slices, m), both positive away from the axis, differ by
    their noise, and half of their difference is the error of their mean. The profile is smoothed as
    far as one more smoothing changes it by a share of that (r.m.s.), so that bands by noise hold.
    An `InputError` refuses deflections that are not finite.
    """
    if not np.isfinite([side, opposite_side]).all():
        raise InputError("the deflections are not finite, expected numbers everywhere")
    best: float = _SMOOTHINGS[0]
    for smoothing in _SMOOTHINGS:
        inverse = inverse_matrix(matrix, smoothing)
        profile = (side + opposite_side) / 2 @ inverse.T
        change = float(np.linalg.norm(profile @ (inverse @ matrix).T - profile))
        noise = float(np.linalg.norm((side - opposite_side) / 2 @ inverse.T))
        if change > share * noise:
            break
        best = smoothing
    return best


@lru_cache(maxsize=16)
def operators(
    count: int, smoothing: float, *, of_deflection: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the operator K and its inverse A for a number of radii; they must not be changed."""
    matrix = deflection_matrix(count) if of_deflection else projection_matrix(count)
    inverse = inverse_matrix(matrix, smoothing)
    for array in (matrix, inverse):
        array.setflags(write=False)
    return matrix, inverse


def _grid(count: int, offset: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances y (count, 1) and radii r (1, count + 1) in px, and ∫ dr / √(r² - y²)."""
    if count < 4:
        raise InputError(f"the radius is {count} px, expected at least 4 px")
    y, radii = offset + np.arange(float(count))[:, None], np.arange(count + 1.0)[None, :]
    ratio = np.divide(radii, y, out=np.ones((count, count + 1)), where=y > 0)
    # The integral is arcosh(r / y), zero at r = y.
    return y, radii, np.arccosh(np.maximum(ratio, 1.0))
