"""Signs that a field continues beyond the edge of its image: `inner_sides`, `turned_back`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray

__all__ = ["TURNED_BACK", "Sides", "inner_sides", "turned_back"]

TURNED_BACK = 0.07
"""Mean displacement across the edge over the r.m.s. one: 0.05 if contained, 0.08 if cut."""

_DEPTH = 0.05  # of the shorter side
_MAX_MASKED = 0.2  # of a side


@dataclass(frozen=True)
class Sides:
    """Displacement along the four sides of an image, px.

    `outwards` is its component across the edge, a twentieth of the shorter side (`depth` px) inside
    it; `along` the component along the edge, at the edge.
    """

    depth: int
    outwards: tuple[FloatArray, ...]
    along: tuple[FloatArray, ...]


def inner_sides(displacement: FloatArray, mask: BoolArray) -> Sides | None:
    """Return a displacement along the sides; None if the used part of the image ends elsewhere.

    Parameters
    ----------
    displacement : ndarray, shape (2, H, W)
        In px.
    mask : ndarray of bool, shape (H, W)
        The pixels to use.
    """
    depth = max(2, round(_DEPTH * min(mask.shape)))
    y, x = np.where(mask, displacement, np.nan)
    outwards = -y[depth], y[-1 - depth], -x[:, depth], x[:, -1 - depth]
    along = x[0], x[-1], y[:, 0], y[:, -1]
    if any(np.isnan(side).mean() > _MAX_MASKED for side in (*outwards, *along)):
        return None
    return Sides(depth, outwards, along)


def turned_back(sides: Sides) -> float:
    """Return the mean displacement towards or away from the edge on all sides, px.

    An edge that keeps rays or fields from leaving turns them back on all sides.
    """
    means = [float(np.nanmean(side)) for side in sides.outwards]
    return min(abs(float(np.mean(means))), abs(float(np.median(means))))
