"""Small shots of an object that changes, with their source."""

from __future__ import annotations

import numpy as np

from napari_shadowinv import InversionOptions, synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob

SHAPE = (24, 28)
OPTIONS = InversionOptions(n_sites=100)


def make_shots(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Shots of a blob that grows and wanders, and their source."""
    source = 100 + 10 * np.random.default_rng(0).random(SHAPE)
    blobs = [
        gaussian_blob(SHAPE, 2 + 3 * np.sin(0.7 * i) ** 2, 4.0, (10, 12 + i % 5))
        for i in range(count)
    ]
    return np.stack([synthetic_image(blob.displacement, source) for blob in blobs]), source
