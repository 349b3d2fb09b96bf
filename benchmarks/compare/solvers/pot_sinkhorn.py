"""POT, entropic transport between pixels (Sinkhorn), ε = 1 px²."""

import numpy as np
import ot

VERSION = ot.__version__
_REGULARISATION = 1.0  # px²


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    places = np.indices(image.shape, dtype=float).reshape(2, -1).T.copy()
    beam = np.maximum(source, 1e-3 * source.mean()).ravel()
    light = np.maximum(image, 1e-3 * image.mean()).ravel()
    plan = ot.sinkhorn(
        beam / beam.sum(),
        light / light.sum(),
        ot.dist(places, places),
        _REGULARISATION,
        method="sinkhorn",
        numItermax=5000,
        stopThr=1e-6,
    )
    landed = plan @ places / plan.sum(axis=1)[:, None]
    return (landed - places).T.reshape(2, *image.shape)
