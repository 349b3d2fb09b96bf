"""The whole way from an image to a deflection potential.

- invert an image: `invert`
- prepare the sites once for many images with one source: `plan_sites`
- what comes out: `Inversion`, with a `Report` of how it went
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv.options import InversionOptions

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup

__all__ = ["Inversion", "Report"]


@dataclass(frozen=True)
class Report:
    """How an inversion went.

    Attributes
    ----------
    converged : bool
        Whether the flux residual fell below the tolerance.
    iterations : int
        Solver steps, all levels together.
    residual : float
        Largest relative flux error of a cell, max |T - S| / S.
    tolerance : float
        The residual that was asked for.
    n_sites : int
        Number of sites.
    floor : float
        Smallest intensity allowed in the image, as a share of its mean.
    floored_pixels : int
        Pixels that were raised to the floor.
    clipped_pixels : int
        Pixels that were negative and set to zero.
    levels : tuple of (int, int, float)
        Sites, solver steps and final residual of each level, coarse to fine.
    seconds : dict of str to float
        Time of each stage: prepare, sites, transport, read-out.
    warnings : tuple of str
        What the user should know before trusting the result.
    """

    converged: bool
    iterations: int
    residual: float
    tolerance: float
    n_sites: int
    floor: float
    floored_pixels: int
    clipped_pixels: int
    levels: tuple[tuple[int, int, float], ...]
    seconds: dict[str, float]
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class Inversion:
    """The deflection potential of one shot, and how far it can be trusted.

    Lengths are object-plane pixels; arrays are ``[y, x]``, vectors in axis order
    (y, x); a pixel's centre is at its integer index.

    Attributes
    ----------
    image : ndarray, shape (H, W)
        The image that was inverted, after clipping, scaled to the flux of the source.
    source : ndarray, shape (H, W)
        The undisturbed beam.
    potential : ndarray, shape (H, W)
        Normalised deflection potential in px²; its mean over the image's border is 0.
    displacement : ndarray, shape (2, H, W)
        Displacement of the ray that starts at each pixel, minus the gradient of the
        potential, in px.
    sites : ndarray, shape (n, 2)
        Positions of the sites.
    weights : ndarray, shape (n,)
        Weights of the power diagram, px².
    site_mass : ndarray, shape (n,)
        Flux of the source in each site's cell.
    site_displacement : ndarray, shape (n, 2)
        Centroid of each site's cell in the image, minus the site.
    reprojection : ndarray, shape (H, W)
        The image that the retrieved displacement makes of the source.
    residual : ndarray, shape (H, W)
        ``image - reprojection``.
    caustic : ndarray of bool, shape (H, W)
        Where the map folds or its Jacobian is below the threshold.
    report : Report
        How it went.
    options : InversionOptions
        The choices that made it.
    """

    image: NDArray[np.float64]
    source: NDArray[np.float64]
    potential: NDArray[np.float64]
    displacement: NDArray[np.float64]
    sites: NDArray[np.float64]
    weights: NDArray[np.float64]
    site_mass: NDArray[np.float64]
    site_displacement: NDArray[np.float64]
    reprojection: NDArray[np.float64]
    residual: NDArray[np.float64]
    caustic: NDArray[np.bool_]
    report: Report
    options: InversionOptions

    def to_dataset(self, setup: ProtonSetup | OpticalSetup | None = None) -> xarray.Dataset:
        """Everything as one labelled dataset, with units; see `napari_shadowinv.io.dataset`.

        Parameters
        ----------
        setup : ProtonSetup or OpticalSetup, optional
            Adds the potential and the line-integrated field in SI units.

        Returns
        -------
        xarray.Dataset
            Dimensions y, x, site and component.
        """
        from napari_shadowinv.io.dataset import dataset_from_inversion

        return dataset_from_inversion(self, setup)
