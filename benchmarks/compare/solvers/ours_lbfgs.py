"""Power diagrams as Kasim et al. solve them: L-BFGS from zero weights, centroids read out."""

import numpy as np

import napari_shadowinv
from napari_shadowinv import InversionOptions, invert

VERSION = napari_shadowinv.__version__


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    options = InversionOptions(
        n_sites=image.size,
        solver="lbfgs",
        stages="single",
        readout="centroid",
        max_iterations=100_000,
    )
    return invert(image, source=source, options=options).displacement
