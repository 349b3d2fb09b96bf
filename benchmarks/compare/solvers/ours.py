"""The package with its default options."""

import numpy as np

import napari_shadowinv
from napari_shadowinv import InversionOptions, invert

VERSION = napari_shadowinv.__version__


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    return invert(image, source=source, options=InversionOptions()).displacement
