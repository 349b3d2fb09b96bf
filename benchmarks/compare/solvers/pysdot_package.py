"""pysdot, semi-discrete transport: a site in each pixel, its cell's centroid is where it lands."""

from importlib.metadata import version

import numpy as np
from pysdot import OptimalTransport
from pysdot.domain_types import ScaledImage

VERSION = version("pysdot")


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    height, width = image.shape
    places = np.indices(image.shape, dtype=float).reshape(2, -1).T[:, ::-1]
    lit = source.ravel() > 1e-3 * source.mean()
    masses = source.ravel()[lit]
    light = np.maximum(image, 1e-3 * image.mean())
    transport = OptimalTransport(
        positions=np.ascontiguousarray(places[lit]),
        masses=masses,
        domain=ScaledImage(
            [-0.5, -0.5], [width - 0.5, height - 0.5], light * masses.sum() / light.sum()
        ),
        obj_max_dm=1e-3 * masses.min(),
        obj_max_dw=0,
        linear_solver="Scipy",
    )
    transport.adjust_weights()
    shift = np.full(places.shape, np.nan)
    shift[lit] = transport.get_centroids() - places[lit]
    return shift[:, ::-1].T.reshape(2, *image.shape)
