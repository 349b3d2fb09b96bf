"""An image whose beam lies beside that of its source."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import ndimage

from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob

Array = np.ndarray[Any, Any]
_MARGIN_PX = 20


def shifted_pair(
    shift: tuple[float, float], contrast: float = 0.1, shape: tuple[int, int] = (120, 150)
) -> tuple[Array, Array]:
    """Return image and source in counts; the beam in the image is shifted (y, x) by some px."""
    rng = np.random.default_rng(4)
    size = [side + 2 * _MARGIN_PX for side in shape]
    structure = ndimage.gaussian_filter(rng.normal(size=size), 4)
    beam = 400 * (1 + contrast * structure / structure.std())
    inside = np.s_[_MARGIN_PX:-_MARGIN_PX, _MARGIN_PX:-_MARGIN_PX]
    blob = gaussian_blob(shape, 12.0, 10.0, (shape[0] / 2, shape[1] / 2))
    image = synthetic_image(blob.displacement, ndimage.shift(beam, shift, order=3)[inside])
    return rng.poisson(image).astype(float), rng.poisson(0.8 * beam[inside]).astype(float)
