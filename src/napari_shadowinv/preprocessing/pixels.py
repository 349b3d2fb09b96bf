"""Images as numbers: checks of images and parameters, a robust polynomial fit, filled-in parts.

- values and usable pixels of an image: `checked_pixels`; of a beam, which has flux: `beam_pixels`
- fit a polynomial: `fit_polynomial`
- continue values smoothly into gaps: `continued`; a beam, under an object: `with_filled_part`
"""

from __future__ import annotations

import numpy as np
import scipy
from numpy.polynomial.legendre import legvander
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import (
    block_means,
    check_mask,
    check_plane,
    complete_block_means,
    unpack_array,
)
from napari_shadowinv.preprocessing.noise import NORMAL_MAD


def with_filled_part(
    values: FloatArray, usable: BoolArray, report: Reporter, width: float = 5.0
) -> FloatArray:
    """Return a beam, positive, that is `continued` into the part that is not usable."""
    return with_flux_of(continued(values, usable, report, width), values, usable)


def continued(
    values: FloatArray, usable: BoolArray, report: Reporter, width: float, *, rtol: float = 1e-6
) -> FloatArray:
    """Return values whose part that is not usable continues a smoothing spline to the others.

    The spline u, a thin plate, minimises ∑(u - value)² over the usable pixels + width⁴ ∑ (Δu)²
    over all, with mirrored borders, by conjugate gradients preconditioned with the discrete cosine
    transform, from coarse to fine (D. Garcia, Comput. Stat. Data Anal. 54, 1167 (2010)).
    """
    # scikit-image's inpaint_biharmonic continues the noise of the gap's border: behind a mask of
    # small spots, fields change by 0.4 to 7 noise errors.
    used, mean = usable.astype(float), values[usable].mean()
    filling = _spline(np.where(usable, values / mean, 0.0), used, width, report, rtol) * mean
    return np.where(usable, values, filling)


def _spline(
    weighted: FloatArray, share: FloatArray, width: float, report: Reporter, rtol: float
) -> FloatArray:
    """Minimise ∑ share·(u - value)² + width⁴ ∑ (Δu)², `weighted` being share·value."""
    from skimage.transform import resize

    if min(weighted.shape) < 32:
        start = np.full(weighted.shape, weighted.sum() / share.sum())
    else:  # from pixels twice as large
        coarse = _spline(block_means(weighted, 2), block_means(share, 2), width / 2, report, rtol)
        sides = [2 * side for side in coarse.shape]
        doubled = resize(coarse, sides, order=1, mode="edge")  # type: ignore[no-untyped-call]
        start = doubled[: weighted.shape[0], : weighted.shape[1]]
    squares = [4 * np.sin(0.5 * np.pi * np.arange(side) / side) ** 2 for side in weighted.shape]
    roughness = (width**2 * np.add.outer(*squares)) ** 2

    def stiffness(flat: FloatArray) -> FloatArray:
        report("source", 0)
        u = flat.reshape(weighted.shape)
        bent = scipy.fft.idctn(roughness * scipy.fft.dctn(u, norm="ortho"), norm="ortho")
        return np.asarray(share * u + bent).ravel()

    diagonal = float(share.mean()) + roughness

    def nearly_inverse(flat: FloatArray) -> FloatArray:
        coefficients = scipy.fft.dctn(flat.reshape(weighted.shape), norm="ortho")
        return np.asarray(scipy.fft.idctn(coefficients / diagonal, norm="ortho")).ravel()

    shape = (weighted.size, weighted.size)
    solution, _ = scipy.sparse.linalg.cg(
        scipy.sparse.linalg.LinearOperator(shape, matvec=stiffness, dtype=np.float64),
        weighted.ravel(),
        x0=start.ravel(),
        M=scipy.sparse.linalg.LinearOperator(shape, matvec=nearly_inverse, dtype=np.float64),
        rtol=rtol,
        maxiter=500,
    )
    return np.asarray(solution.reshape(weighted.shape))


MAX_EXTRAPOLATION = 10.0  # times the brightest pixel seen
LEAST_LIGHT = 0.05  # of the mean, to be compared with other light


def checked_pixels(image: ArrayLike, mask: ArrayLike | None = None) -> tuple[FloatArray, BoolArray]:
    """Return a copy of an image as floats and its usable pixels, or raise an `InputError`.

    Masked pixels, which may be NaN, are set to the mean of the usable ones.
    """
    values = np.array(check_plane(unpack_array(image, "image"), "image"), dtype=np.float64)
    usable = check_mask(unpack_array(mask, "mask"), values.shape)
    bad = int((~np.isfinite(values[usable])).sum())
    if bad:
        raise InputError(
            f"image has {bad} usable pixels that are NaN or infinite, expected none: replace or "
            "mask them"
        )
    values[~usable] = values[usable].mean()
    return values, usable


def complete_blocks(mask: BoolArray, block: int, share: float = 0.999) -> BoolArray:
    """Return which blocks of pixels are usable, by a least share of their pixels."""
    return complete_block_means(mask, block) > share


def beam_pixels(image: ArrayLike, mask: ArrayLike | None) -> tuple[FloatArray, BoolArray]:
    """Return values and usable pixels of an image, refusing one without flux."""
    values, usable = checked_pixels(image, mask)
    flux = values[usable].sum()
    if flux <= 0:
        raise InputError(
            f"image has a flux of {flux:.4g} over its usable pixels, expected a positive one: "
            "check the file and its background"
        )
    return values, usable


def with_flux_of(
    beam: FloatArray, values: FloatArray, usable: BoolArray, floor: float = 1e-3
) -> FloatArray:
    """Return a beam with the flux of an image over its usable pixels, above a share of the mean."""
    # The floor is that to which an inversion raises an image's dark pixels.
    mean = values[usable].mean()
    positive = np.maximum(beam, floor * mean)
    source = np.asarray(positive * (mean / positive[usable].mean()))
    brightest = float(values[usable].max())
    if not source.max() <= MAX_EXTRAPOLATION * brightest:
        raise InputError(
            f"the estimated source rises to {source.max():.3g} under the mask, while the image "
            f"is at most {brightest:.3g} elsewhere: mask less, or choose another estimate"
        )
    return source


def fit_polynomial(
    values: FloatArray, usable: BoolArray, degree: int, report: Reporter
) -> FloatArray:
    """Fit a polynomial in y and x, of a total degree, robust against outliers, to usable pixels.

    Iteratively reweighted least squares of the soft L1 loss: residuals count squared within the
    noise (the median absolute deviation of the residuals), in proportion beyond.
    """
    terms = (degree + 1) * (degree + 2) // 2
    if usable.sum() < terms:
        raise InputError(
            f"degree {degree} has {terms} coefficients, image has {int(usable.sum())} usable "
            "pixels: use a lower degree or mask fewer pixels"
        )
    rows, columns = (
        np.asarray(legvander(np.linspace(-1, 1, side), degree), np.float64) for side in values.shape
    )
    fit = _weighted_fit(values, usable.astype(np.float64), rows, columns)
    rounding = 1e-12 * float(np.abs(values).max())
    for step in range(50):
        report("fit", step)
        residual = values - fit
        scale = NORMAL_MAD * float(np.median(np.abs(residual[usable])))
        if scale <= rounding:
            break
        weights = usable / np.sqrt(1 + (residual / scale) ** 2)
        previous, fit = fit, _weighted_fit(values, weights, rows, columns)
        if np.abs(fit - previous).max() < 1e-6 * scale:
            break
    return fit


def nonnegative_fit(columns: FloatArray, values: FloatArray) -> tuple[FloatArray, float]:
    """Fit values by columns of any size whose coefficients are not negative, by least squares.

    Returns the coefficients, shape (K,), and the root of the sum of squared residuals.
    """
    norms = np.maximum(np.linalg.norm(columns, axis=0), np.finfo(np.float64).tiny)
    terms, distance = scipy.optimize.nnls(columns / norms, values)
    return terms / norms, float(distance)


def _weighted_fit(
    values: FloatArray, weights: FloatArray, rows: FloatArray, columns: FloatArray
) -> FloatArray:
    """Fit a polynomial by weighted least squares, from bases along y and x."""
    # The normal equations need sums of the weights over products of the bases only; those
    # separate into y and x, so no matrix of pixels × coefficients is formed.
    n = rows.shape[1]
    pairs = [
        (basis[:, :, None] * basis[:, None, :]).reshape(-1, n * n) for basis in (rows, columns)
    ]
    gram = (pairs[0].T @ weights @ pairs[1]).reshape(n, n, n, n).transpose(0, 2, 1, 3)
    moments = (rows.T @ (weights * values) @ columns).ravel()
    low_degree = np.flatnonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
    coefficients = np.zeros(n * n)
    square = gram.reshape(n * n, n * n)[np.ix_(low_degree, low_degree)]
    coefficients[low_degree] = np.linalg.lstsq(square, moments[low_degree], rcond=None)[0]
    return np.asarray(rows @ coefficients.reshape(n, n) @ columns.T)
