"""The set-up, the synthetic images and their inversion, as all of the paper's figures use them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv import Inversion, InversionOptions, ProtonSetup, invert
from napari_shadowinv.physics import phantoms

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

SHAPE = (200, 200)
SETUP = ProtonSetup.example()
PIXEL = SETUP.object_pixel_size * 1e6  # µm
SIGMA = 30e-6
NOISE = 0.1
OPTIONS = InversionOptions(negative="clip")


def field_of(displacement: FloatArray) -> FloatArray:
    """Magnitude of the path-integrated field in MG µm."""
    return np.hypot(*SETUP.path_integrated_b(displacement, "MG um"))


def noisy(image: FloatArray, seed: int, share: float = NOISE) -> FloatArray:
    """Add normal noise with a standard deviation that is a share of the mean."""
    rng = np.random.default_rng(seed)
    return image + share * image.mean() * rng.normal(size=image.shape)


def toroid_truth(peak: float) -> FloatArray:
    return phantoms.toroid(SHAPE, SETUP, peak, SIGMA).displacement


def retrieved(
    image: FloatArray, source: FloatArray | None = None, mask: BoolArray | None = None
) -> Inversion:
    beam = np.ones(image.shape) if source is None else source
    return invert(image, source=beam, mask=mask, options=OPTIONS)


def seconds_of(inversion: Inversion) -> float:
    return sum(inversion.report.seconds.values())


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
