"""The package with a free boundary, which flux may cross, and the exposure of the source."""

import numpy as np

import napari_shadowinv
from napari_shadowinv import InversionOptions, invert

VERSION = napari_shadowinv.__version__


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    options = InversionOptions(boundary="free", flux="known")
    return invert(image, source=source, options=options).displacement
