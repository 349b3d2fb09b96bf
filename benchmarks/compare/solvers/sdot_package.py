"""sdot, semi-discrete transport: a site in each pixel, its cell's centroid is where it lands."""

from importlib.metadata import version

import numpy as np
import sdot

VERSION = version("sdot")
_SHIFT_PX = 1e-3  # on an exact grid of equal masses it stalls


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    lit = source.ravel() > 1e-3 * source.mean()
    masses = source.ravel()[lit] / source.ravel()[lit].sum()
    places = np.indices(image.shape, dtype=float).reshape(2, -1).T
    sites = places[lit] + _SHIFT_PX * np.random.default_rng(0).normal(size=(lit.sum(), 2))
    light = sdot.Image(
        np.maximum(image, 1e-3 * image.mean()),
        origin=[-0.5, -0.5],
        frame=[float(length) for length in image.shape],
    )
    plan = sdot.ot_solve(sdot.SumOfDiracs(sites, masses), light, tol=1e-3 * masses.min())
    shift = np.full(places.shape, np.nan)
    shift[lit] = np.asarray(plan.barycenters) - sites
    return shift.T.reshape(2, *image.shape)
