"""Parts of an image filled in from their surroundings.

- the beam under an object: `interpolated_source`
- masked pixels: `without_masked`
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import scipy
from numpy.typing import ArrayLike

from napari_shadowinv._system.progress import Reporter, ShouldStop
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import pixels

FILL_WIDTH = 5.0  # px
_COARSEST_SIDE = 32
_TOLERANCE = 1e-6


def without_masked(
    image: FloatArray, mask: BoolArray | None, should_stop: ShouldStop | None = None
) -> FloatArray:
    """Return an image with masked pixels filled in, so that filters do not spread their values."""
    if mask is None or mask.all() or not mask.any():
        return image
    return np.where(mask, image, interpolated_source(image, mask, should_stop=should_stop))


def interpolated_source(
    image: ArrayLike,
    mask: ArrayLike,
    *,
    width: float = FILL_WIDTH,
    kind: Literal["biharmonic", "laplace"] = "biharmonic",
    should_stop: ShouldStop | None = None,
) -> FloatArray:
    """The image itself, with the part under the object filled in from its surroundings.

    It is an estimate as in `napari_shadowinv.preprocessing.estimates`.

    Parameters
    ----------
    image : array_like, shape (H, W)
    mask : array_like of bool, shape (H, W)
        True where the image shows the bare beam, False where the object is.
    width : float, default 5
        Standard deviation in px of the blur applied to the surroundings before they are
        extrapolated, so that noise does not spread into the gap. Wider gaps need more blur.
    kind : {"biharmonic", "laplace"}, default "biharmonic"
        "biharmonic" continues slope and curvature of the beam: for gaps inside the image.
        "laplace" never leaves the range of the surroundings: for gaps at the image's edge.
    should_stop : callable, optional

    Returns
    -------
    ndarray of float64, shape (H, W)
        Where the mask is true, the image itself.

    Notes
    -----
    The filling u minimises ∑(u - image)² over the usable pixels + width²ᵖ ∑ u(-Δ)ᵖu over
    all, with p = 2 (a thin plate) or p = 1 (a membrane) and mirrored borders, by conjugate
    gradients preconditioned with the discrete cosine transform, from coarse to fine.

    References
    ----------
    D. Garcia, "Robust smoothing of gridded data in one and higher dimensions with missing
    values", Computational Statistics & Data Analysis 54, 1167 (2010).
    """
    if kind not in ("biharmonic", "laplace"):
        raise InputError(f"kind is {kind!r}, expected 'biharmonic' or 'laplace'")
    values, usable = pixels.beam_pixels(image, mask)
    width = pixels.checked_number("width", width, above=0, unit="px")
    power = 2 if kind == "biharmonic" else 1
    report = Reporter(None, should_stop)
    beam = np.where(usable, values, fill_masked(values, usable, width, power, report))
    return pixels.with_flux_of(beam, values, usable)


def fill_masked(
    values: FloatArray, usable: BoolArray, width: float, power: int, report: Reporter
) -> FloatArray:
    """Fit a smoothing spline to the usable pixels and continue it over the others."""
    mean = values[usable].mean()
    weighted = np.where(usable, values / mean, 0.0)
    share = usable.astype(np.float64)
    return np.asarray(_spline(weighted, share, width, power, report) * mean)


def _spline(
    weighted: FloatArray, share: FloatArray, width: float, power: int, report: Reporter
) -> FloatArray:
    """Minimise ∑ share·(u - value)² + width^2p ∑ u(-Δ)ᵖu, `weighted` being share·value."""
    squares = [4 * np.sin(0.5 * np.pi * np.arange(side) / side) ** 2 for side in weighted.shape]
    roughness = (width**2 * np.add.outer(*squares)) ** power

    def stiffness(flat: FloatArray) -> FloatArray:
        report("source", 0)
        u = flat.reshape(weighted.shape)
        bent = scipy.fft.idctn(roughness * scipy.fft.dctn(u, norm="ortho"), norm="ortho")
        return np.asarray(share * u + bent).ravel()

    typical = float(share.mean())

    def nearly_inverse(flat: FloatArray) -> FloatArray:
        coefficients = scipy.fft.dctn(flat.reshape(weighted.shape), norm="ortho") / (
            typical + roughness
        )
        return np.asarray(scipy.fft.idctn(coefficients, norm="ortho")).ravel()

    shape = (weighted.size, weighted.size)
    solution, _ = scipy.sparse.linalg.cg(
        scipy.sparse.linalg.LinearOperator(shape, matvec=stiffness, dtype=np.float64),
        weighted.ravel(),
        x0=_coarse_spline(weighted, share, width, power, report).ravel(),
        M=scipy.sparse.linalg.LinearOperator(shape, matvec=nearly_inverse, dtype=np.float64),
        rtol=_TOLERANCE,
        maxiter=500,
    )
    return np.asarray(solution.reshape(weighted.shape))


def _coarse_spline(
    weighted: FloatArray, share: FloatArray, width: float, power: int, report: Reporter
) -> FloatArray:
    """Return a first guess of `_spline`, from pixels twice as large."""
    if min(weighted.shape) < _COARSEST_SIDE:
        return np.full(weighted.shape, weighted.sum() / share.sum())
    coarse = _spline(
        pixels.block_means(weighted, 2), pixels.block_means(share, 2), width / 2, power, report
    )
    height, length = weighted.shape
    return _double_rows(_double_rows(coarse, height).T, length).T


def _double_rows(coarse: FloatArray, side: int) -> FloatArray:
    """Interpolate to twice as many rows, cut to `side`, linearly between the coarse ones."""
    padded = np.pad(coarse, [(1, 1), (0, 0)], mode="edge")
    near, before, after = padded[1:-1], padded[:-2], padded[2:]
    rows = np.stack([0.75 * near + 0.25 * before, 0.75 * near + 0.25 * after], axis=1)
    return np.asarray(rows.reshape(-1, coarse.shape[1])[:side])
