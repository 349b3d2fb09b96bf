"""Values along a line across images, as plain arrays: no napari, no Qt.

- points along a line: `along`; beside it, to average over: `abreast`
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

__all__ = ["Profile", "abreast", "along", "sampled", "table_text"]

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
    averaged : str
        In words, what the values are averaged over; empty for those on the line alone.
    """

    name: str
    unit: str
    values: Array
    averaged: str = ""


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
    corners, reached = _corners(vertices)
    count = min(int(np.ceil(reached[-1] / step - 1e-9)) + 1, _MOST_SAMPLES)
    distance = np.linspace(0, reached[-1], max(count, 2))
    return _on_path(corners, reached, distance), distance


def _corners(vertices: ArrayLike) -> tuple[Array, Array]:
    """Corners of a path, no two of them in one place, and its length up to each."""
    corners = np.asarray(vertices, dtype=np.float64)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    moves = np.concatenate([[True], lengths > 0])
    if moves.sum() > 1:
        corners, lengths = corners[moves], lengths[moves[1:]]
    return corners, np.concatenate([[0.0], np.cumsum(lengths)])


def _on_path(corners: Array, reached: Array, distance: Array) -> Array:
    return np.stack([np.interp(distance, reached, corners[:, axis]) for axis in (0, 1)], axis=1)


def abreast(vertices: ArrayLike, distance: Array, width: float, step: float) -> Array:
    """Points of a strip around a path, in rows at right angles to it.

    Parameters
    ----------
    vertices : array_like, shape (k, 2)
        Corners of the path.
    distance : ndarray, shape (n,)
        Where the rows are, as `along` returns it.
    width : float
        Width of the strip; with 0 each row is the point on the path alone.
    step : float
        Greatest distance of two points of a row.

    Returns
    -------
    ndarray, shape (m, n, 2)
        m points in the middles of equal parts of the width, at each of the n distances.

    Examples
    --------
    >>> abreast([[0, 0], [0, 9]], np.array([4.0]), 3.0, 1.0)[:, 0]
    array([[-1.,  4.],
           [ 0.,  4.],
           [ 1.,  4.]])
    """
    corners, reached = _corners(vertices)
    points = _on_path(corners, reached, distance)
    edges = np.diff(corners, axis=0)
    edge = np.clip(np.searchsorted(reached, distance, side="right") - 1, 0, len(edges) - 1)
    lengths = np.maximum(np.hypot(*edges.T), np.finfo(float).tiny)
    along_y, along_x = (edges / lengths[:, None])[edge].T
    across = np.stack([along_x, -along_y], axis=1)
    count = min(max(int(np.ceil(width / step - 1e-9)), 1), _MOST_SAMPLES)
    offsets = width * ((np.arange(count) + 0.5) / count - 0.5)
    rows: Array = points + offsets[:, None, None] * across
    return rows


def sampled(image: ArrayLike, points: Array, to_pixels: Callable[[Array], Array]) -> Array:
    """Values of an image at points of the world, linear between the pixels' centres.

    Parameters
    ----------
    image : array_like, shape (H, W)
        The image.
    points : ndarray, shape (n, 2) or (m, n, 2)
        Where, in the world; over the m the values are averaged, without those outside.
    to_pixels : callable
        Brings points of the world to pixels of the image.

    Returns
    -------
    ndarray, shape (n,)
        NaN outside the image, whose pixels reach half a pixel beyond their centres.
    """
    from scipy.ndimage import map_coordinates

    plane = np.asarray(image, dtype=np.float64)
    pixels = to_pixels(points.reshape(-1, 2))
    values = np.asarray(map_coordinates(plane, pixels.T, order=1, mode="nearest"))
    size = np.array(plane.shape)
    inside = ((pixels >= -0.5) & (pixels <= size - 0.5)).all(axis=1)
    rows = np.where(inside, values, 0.0).reshape(-1, points.shape[-2])
    count = inside.reshape(rows.shape).sum(axis=0)
    return np.where(count > 0, rows.sum(axis=0) / np.maximum(count, 1), np.nan)


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
    """Its name, with the unit if the name does not tell it, and what it is averaged over."""
    name = profile.name
    if profile.unit and f"({profile.unit})" not in name:
        name = f"{name} ({profile.unit})"
    return f"{name}, {profile.averaged}" if profile.averaged else name
