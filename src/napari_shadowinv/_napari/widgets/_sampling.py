"""Values along a line across images, as plain arrays: no napari, no Qt.

- sample an image: `sampled`
- several of them on one axis: `Profile`; as a table: `table_text`
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Profile", "along", "sampled", "table_text"]

Array = NDArray[np.float64]

_MOST_SAMPLES = 5000


@dataclass(frozen=True, eq=False)
class Profile:
    """Values of one image along a line.

    Attributes
    ----------
    name : str
        What the image shows.
    unit : str
        Unit of the values; empty if unknown.
    values : ndarray, shape (n,)
        NaN where the line is outside the image.
    """

    name: str
    unit: str
    values: Array


def along(vertices: ArrayLike, step: float) -> tuple[Array, Array]:
    """Points along a path.

    Parameters
    ----------
    vertices : array_like, shape (k, 2)
        Corners of the path, two for a straight line.
    step : float
        Greatest distance of two points.

    Returns
    -------
    points : ndarray, shape (n, 2)
        From the first corner to the last, evenly along the path.
    distance : ndarray, shape (n,)
        Length of the path up to each point.

    Examples
    --------
    >>> points, distance = along([[0, 0], [3, 4]], 1.0)
    >>> distance
    array([0., 1., 2., 3., 4., 5.])
    """
    corners = np.asarray(vertices, dtype=np.float64)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    reached = np.concatenate([[0.0], np.cumsum(lengths)])
    count = min(int(np.ceil(reached[-1] / step - 1e-9)) + 1, _MOST_SAMPLES)
    distance = np.linspace(0, reached[-1], max(count, 2))
    points = np.stack([np.interp(distance, reached, corners[:, axis]) for axis in (0, 1)], axis=1)
    return points, distance


def sampled(image: ArrayLike, points: Array, to_pixels: Callable[[Array], Array]) -> Array:
    """Values of an image at points of the world, linear between the pixels' centres.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The image.
    points : ndarray, shape (n, 2)
        Where, in the world.
    to_pixels : callable
        Brings points of the world to pixels of the image.

    Returns
    -------
    ndarray, shape (n,)
        NaN outside the image, whose pixels reach half a pixel beyond their centres.
    """
    from scipy.ndimage import map_coordinates

    plane = np.asarray(image, dtype=np.float64)
    pixels = to_pixels(points)
    values = np.asarray(map_coordinates(plane, pixels.T, order=1, mode="nearest"))
    size = np.array(plane.shape)
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1)
    return np.where(inside, values, np.nan)


def table_text(distance: Array, unit: str, profiles: Sequence[Profile]) -> str:
    """Return profiles as comma-separated values, a column each, with units in the first row.

    Parameters
    ----------
    distance : ndarray, shape (n,)
        Distance along the line.
    unit : str
        Unit of the distance.
    profiles : sequence of Profile
        The columns.

    Returns
    -------
    str
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([f"distance ({unit})", *(_heading(profile) for profile in profiles)])
    for row in zip(distance, *(profile.values for profile in profiles), strict=True):
        writer.writerow([f"{value:.9g}" for value in row])
    return text.getvalue()


def _heading(profile: Profile) -> str:
    """Its name, with the unit if the name does not tell it."""
    if not profile.unit or f"({profile.unit})" in profile.name:
        return profile.name
    return f"{profile.name} ({profile.unit})"
