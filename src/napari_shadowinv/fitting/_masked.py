"""Masks that hide the structure that determines a field: `hidden_contrast`."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from napari_shadowinv._typing import BoolArray, FloatArray

__all__ = ["hidden_contrast"]

_MIN_HOLE_RADIUS_PX = 6.0
_RIM_PX = 4
_SMOOTHED_PX = 1.0
_STRONGEST = 0.99  # quantile of the contrast, over the image


def hidden_contrast(contrast: FloatArray, used: BoolArray) -> float:
    """Return the contrast around the holes of a mask, as a share of the strongest.

    Parameters
    ----------
    contrast : ndarray, shape (L, H, W)
        Model images over their beams, minus 1.
    used : ndarray of bool, shape (L, H, W)
        The pixels that were fitted. A hole is where no image has any; smaller ones than 12 px are
        bridged by their surroundings.

    Returns
    -------
    float
        The largest of all images; 0 without holes.
    """
    used_anywhere = used.any(axis=0)
    # Holes begin where pixels are missing inside the image, not at its edge.
    depth = ndimage.distance_transform_edt(np.pad(~used_anywhere, 1))[1:-1, 1:-1]
    labels, _ = ndimage.label(~used_anywhere)
    wide = np.unique(labels[depth >= _MIN_HOLE_RADIUS_PX])
    hole = np.isin(labels, wide[wide > 0])
    if not hole.any():
        return 0.0
    rim = ndimage.binary_dilation(hole, iterations=_RIM_PX) & used_anywhere
    shares = []
    for image in contrast:
        strength = np.abs(ndimage.gaussian_filter(image, _SMOOTHED_PX))
        strongest = float(np.quantile(strength[used_anywhere], _STRONGEST))
        around = float(np.quantile(strength[rim], 0.9)) if rim.any() else 0.0
        shares.append(around / max(strongest, 1e-12))
    return max(shares)
