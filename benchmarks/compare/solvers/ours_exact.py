"""The package with an accuracy of 0.001: a site in each pixel, and slopes inside the pixels."""

import numpy as np

import napari_shadowinv
from napari_shadowinv import InversionOptions, invert

VERSION = napari_shadowinv.__version__


def solve(source: np.ndarray, image: np.ndarray) -> np.ndarray:
    return invert(image, source=source, options=InversionOptions(accuracy=0.001)).displacement
