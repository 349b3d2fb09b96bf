"""Independent formulae for polygons, slow and plain: shoelace sums and clipping; diagrams."""

from __future__ import annotations

import numpy as np

from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation


def power_diagram(sites, density, weights=None) -> PowerDiagram:
    triangulation = RegularTriangulation(sites, weights, region=density.region)
    return PowerDiagram(triangulation, density, with_moments=True)


def residual(level, weights, image) -> float:
    """Return the largest relative flux error of a cell of a level's sites."""
    triangulation = RegularTriangulation(level.sites, weights)
    masses = PowerDiagram(triangulation, Density.from_image(image)).masses
    return np.max(np.abs(masses - level.mass) / level.mass)


def clipped(polygon: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    """Sutherland and Hodgman: the part of a convex polygon where normal · r ≤ offset."""
    distances = polygon @ normal - offset
    if distances.max() <= 0:
        return polygon
    corners, sides = polygon.tolist(), distances.tolist()
    part = []
    for k, ((y, x), side) in enumerate(zip(corners, sides, strict=True)):
        (y_before, x_before), before = corners[k - 1], sides[k - 1]
        if side * before < 0:
            share = before / (before - side)
            part.append((y_before + (y - y_before) * share, x_before + (x - x_before) * share))
        if side <= 0:
            part.append((y, x))
    return np.array(part).reshape(-1, 2)


def rectangle(low: tuple[float, float], high: tuple[float, float]) -> np.ndarray:
    (y0, x0), (y1, x1) = low, high
    return np.array([[y0, x0], [y1, x0], [y1, x1], [y0, x1]], dtype=float)


def clipped_along(axis: int, polygon: np.ndarray, low: float, high: float) -> np.ndarray:
    normal = np.eye(2)[axis]
    if len(polygon):
        polygon = clipped(polygon, normal, high)
    if len(polygon):
        polygon = clipped(polygon, -normal, -low)
    return polygon


def clipped_to_rectangle(
    polygon: np.ndarray, low: tuple[float, float], high: tuple[float, float]
) -> np.ndarray:
    for axis in (0, 1):
        polygon = clipped_along(axis, polygon, low[axis], high[axis])
    return polygon


def shoelace(polygon: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Area, first moments and moment of inertia about the origin (paper, Eqs. 7)."""
    if len(polygon) < 3:
        return 0.0, np.zeros(2), 0.0
    starts, ends = polygon, np.roll(polygon, -1, axis=0)
    cross = starts[:, 0] * ends[:, 1] - starts[:, 1] * ends[:, 0]
    area = cross.sum() / 2
    moments = ((starts + ends) * cross[:, None]).sum(axis=0) / 6
    squares = (starts**2 + starts * ends + ends**2).sum(axis=1)
    return area, moments, float((squares * cross).sum() / 12)


def over_pixels(polygon: np.ndarray, image: np.ndarray) -> tuple[float, np.ndarray, float]:
    """Mass, first moments and inertia about the origin, pixel by pixel."""
    mass, moments, inertia = 0.0, np.zeros(2), 0.0
    if len(polygon) < 3:
        return mass, moments, inertia
    first = np.maximum(np.floor(polygon.min(axis=0) + 0.5).astype(int), 0)
    last = np.minimum(np.floor(polygon.max(axis=0) + 0.5).astype(int), np.array(image.shape) - 1)
    for i in range(first[0], last[0] + 1):
        row = clipped_along(0, polygon, i - 0.5, i + 0.5)
        for j in range(first[1], last[1] + 1):
            piece = clipped_along(1, row, j - 0.5, j + 0.5)
            area, of_piece, inertia_of_piece = shoelace(piece)
            mass += image[i, j] * area
            moments += image[i, j] * of_piece
            inertia += image[i, j] * inertia_of_piece
    return mass, moments, inertia


def power_cell(
    sites: np.ndarray,
    weights: np.ndarray,
    i: int,
    low: tuple[float, float],
    high: tuple[float, float],
) -> np.ndarray:
    """The cell of site i inside a rectangle, by cutting with every other site."""
    cell = rectangle(low, high)
    lift = (sites**2).sum(axis=1) - weights
    for j in range(len(sites)):
        if j == i or not len(cell):
            continue
        if (sites[j] == sites[i]).all():  # of duplicates the heaviest, then the first, has it all
            if (weights[j], -j) > (weights[i], -i):
                return np.empty((0, 2))
        else:
            cell = clipped(cell, 2 * (sites[j] - sites[i]), lift[j] - lift[i])
    return cell
