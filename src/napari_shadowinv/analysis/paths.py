"""Points along lines and paths, and the values of planes there.

- points along a path, and across it within a strip: `sample_path`, `sample_strip`
- directions along a path, and its pieces: `path_directions`, `edge_midpoints`
- a circle as a path: `circle_path`
- values at points: `interpolate`, `interpolate_cubic`; means across a strip: `mean_inside`
- where values fall below a level: `first_below`
- the peak of a profile, its width and area: `measure_peak`, `PeakMeasures`
- the values along a line: `Profile`; rows as comma-separated text: `csv_text`

Points are (y, x) in any unit; `interpolate` maps them to pixels.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.geometry.compiler import njit


@dataclass(frozen=True, eq=False)
class Profile:
    """Values along a line, with their name and unit."""

    name: str
    unit: str
    values: FloatArray  # (n,); NaN where the line is outside the image


def sample_path(vertices: ArrayLike, step: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """Return points (n, 2) along a path, at most a step apart, and their distances along it."""
    corners, cumulative_length = _corners(vertices)
    distance = np.linspace(0, cumulative_length[-1], _count(cumulative_length[-1], step, least=2))
    return _points_at(corners, cumulative_length, distance), distance


def _count(length: float, step: float, least: int, most: int = 5000) -> int:
    """Return the number of points at most a step apart."""
    return min(max(int(np.ceil(length / step - 1e-9)) + least - 1, least), most)


def _corners(vertices: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the distinct corners of a path, and its length up to each corner."""
    corners = np.asarray(vertices, dtype=np.float64)
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    moves = np.concatenate([[True], lengths > 0])
    if moves.sum() > 1:
        corners, lengths = corners[moves], lengths[moves[1:]]
    return corners, np.concatenate([[0.0], np.cumsum(lengths)])


def _points_at(
    corners: FloatArray, cumulative_length: FloatArray, distance: FloatArray
) -> FloatArray:
    return np.stack(
        [np.interp(distance, cumulative_length, corners[:, axis]) for axis in (0, 1)], axis=1
    )


def sample_strip(
    vertices: ArrayLike, distance: FloatArray, width: float, step: float = 1.0
) -> FloatArray:
    """Return points (m, n, 2) of a strip: at n distances, m points across the path."""
    corners, cumulative_length = _corners(vertices)
    points = _points_at(corners, cumulative_length, distance)
    along_y, along_x = path_directions(vertices, distance).T
    across = np.stack([along_x, -along_y], axis=1)
    count = _count(width, step, least=1)
    offsets = width * ((np.arange(count) + 0.5) / count - 0.5)
    return np.asarray(points + offsets[:, None, None] * across)


def interpolate(
    image: ArrayLike, points: FloatArray, to_pixels: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Return values at world points (n, 2), or means over m of (m, n, 2); NaN outside."""
    from scipy.ndimage import map_coordinates

    plane = np.asarray(image, dtype=np.float64)
    pixels = to_pixels(points.reshape(-1, 2))
    values = np.asarray(map_coordinates(plane, pixels.T, order=1, mode="nearest"))
    shape = (-1, points.shape[-2])
    return mean_inside(values.reshape(shape), is_inside(pixels, plane.shape).reshape(shape))


def is_inside(points: FloatArray, shape: tuple[int, ...]) -> BoolArray:
    """Return which points (..., 2) in px are inside an image."""
    return np.asarray(((points >= -0.5) & (points <= np.array(shape) - 0.5)).all(axis=-1))


def mean_inside(values: FloatArray, inside: BoolArray) -> FloatArray:
    """Return means (n,) of values (m, n) inside; NaN where there are none."""
    count = inside.sum(axis=0)
    total = np.where(inside, values, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


@dataclass(frozen=True)
class PeakMeasures:
    """Peak of a profile, its full width at half maximum, and the area under the profile."""

    peak: float  # the value of largest magnitude, with its sign
    position: float  # distance along the line
    width: float  # NaN if the profile stays above half of the peak up to an end of the line
    area: float

    def text(self, unit: str, distance_unit: str) -> str:
        """Return the measures in words, with their units."""
        width = "beyond the line" if np.isnan(self.width) else f"{self.width:.4g} {distance_unit}"
        return (
            f"peak {f'{self.peak:.4g} {unit}'.strip()} at {self.position:.4g} {distance_unit}, "
            f"width (FWHM) {width}, "
            f"area {self.area:.4g} {'·'.join(filter(None, (unit, distance_unit)))}"
        )


def measure_peak(distance: FloatArray, values: FloatArray) -> PeakMeasures | None:
    """Measure the peak of largest magnitude; None if the line misses the image.

    Nothing is subtracted: half of the maximum counts from zero.
    """
    inside = np.isfinite(values)
    if not inside.any():
        return None
    distance, values = distance[inside], values[inside]
    top = int(np.abs(values).argmax())
    peak = float(values[top])
    relative = values / peak if peak else np.zeros_like(values)
    edges = [first_below(distance[top::step], relative[top::step], 0.5) for step in (-1, 1)]
    area = float(np.trapezoid(values, distance))
    return PeakMeasures(peak, float(distance[top]), edges[1] - edges[0], area)


def first_below(places: FloatArray, values: FloatArray, level: float) -> float:
    """Return the first place at which values fall below a level; NaN if they do not."""
    below = np.flatnonzero(values < level)
    if not below.size or below[0] == 0:
        return math.nan
    last = below[0]
    step = (values[last - 1] - level) / (values[last - 1] - values[last])
    return float(places[last - 1] + step * (places[last] - places[last - 1]))


def csv_text(rows: Iterable[Iterable[str]]) -> str:
    """Return rows as comma-separated values."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def path_directions(vertices: ArrayLike, distance: FloatArray) -> FloatArray:
    """Return the unit vectors (n, 2) along a path, in axis order (y, x), at distances along it."""
    corners, cumulative_length = _corners(vertices)
    edges = np.diff(corners, axis=0)
    edge = np.clip(
        np.searchsorted(cumulative_length, distance, side="right") - 1, 0, len(edges) - 1
    )
    lengths = np.maximum(np.hypot(*edges.T), np.finfo(float).tiny)
    return np.asarray((edges / lengths[:, None])[edge])


def edge_midpoints(outline: FloatArray, step: float = 0.5) -> tuple[FloatArray, FloatArray]:
    """Cut the edges of a path into pieces; return their middles and vectors, (n, 2) each."""
    edges = np.diff(outline, axis=0)
    counts = np.maximum(np.ceil(np.hypot(*edges.T) / step - 1e-9), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(edges)), counts)
    place = np.arange(len(edge)) - np.repeat(np.cumsum(counts) - counts, counts)
    pieces: FloatArray = (edges / counts[:, None])[edge]
    return outline[:-1][edge] + (place[:, None] + 0.5) * pieces, pieces


def circle_path(center: tuple[float, float], radius: float, *, corners: int = 720) -> FloatArray:
    """Return corners (n, 2) of a closed polygon with the area of a circle, from x towards y."""
    angles = np.linspace(0, 2 * np.pi, corners + 1)
    step = 2 * np.pi / corners
    corner_radius = radius * np.sqrt(step / np.sin(step))
    directions = np.stack([np.sin(angles), np.cos(angles)], axis=1)
    return np.asarray(np.asarray(center) + corner_radius * directions, dtype=np.float64)


def interpolate_cubic(plane: FloatArray, points: FloatArray) -> FloatArray:
    """Return values of a plane at points (..., 2) in px, by cubic polynomials through 4 × 4 pixels.

    Points in the outermost half pixel are extrapolated. scipy's splines would filter the whole
    plane first, for each sample of a band.
    """
    values = np.empty(points[..., 0].size)
    _interpolate_points(plane, points.reshape(-1, 2), values)
    return values.reshape(points.shape[:-1])


@njit(nogil=True, cache=True, error_model="numpy")
def _interpolate_points(plane: FloatArray, points: FloatArray, values: FloatArray) -> None:
    """Write the values of a plane at points (n, 2)."""
    height, width = plane.shape
    row_weights, column_weights = np.empty(min(4, height)), np.empty(min(4, width))
    for point in range(len(points)):
        first_row = _weigh_pixels(points[point, 0], height, row_weights)
        first_column = _weigh_pixels(points[point, 1], width, column_weights)
        value = 0.0
        for i in range(len(row_weights)):
            for k in range(len(column_weights)):
                weight = row_weights[i] * column_weights[k]
                value += weight * plane[first_row + i, first_column + k]
        values[point] = value


@njit(nogil=True, cache=True, error_model="numpy")
def _weigh_pixels(place: float, count: int, weights: FloatArray) -> int:
    """Return the first of the pixels around a place; write the weights of Lagrange's polynomial."""
    n = len(weights)
    first = min(max(math.floor(place) - 1, 0), count - n)
    for node in range(n):
        weights[node] = 1.0
        for other_node in range(n):
            if other_node != node:
                weights[node] *= (place - first - other_node) / (node - other_node)
    return first
