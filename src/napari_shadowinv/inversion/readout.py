"""From the weights of the sites to the potential and displacement at every pixel.

- by the method of the options: `read_out`
- from the dual variables, without any integration: `read_dual` (default)
- by the paper's method, from the cells' centroids: `read_centroids`

Each returns the potential, shape (H, W), px², zero in the mean over the border; and the
displacement, shape (2, H, W), px. With a margin these cover it too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.integrate import cumulative_trapezoid

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.interpolation import BLOCK, CloughTocher
from napari_shadowinv.geometry.natural_neighbor import natural_neighbor
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.sites import Level
from napari_shadowinv.transport.solvers import LevelSolution

__all__ = ["read_centroids", "read_dual", "read_out"]

OnShare = Callable[[float], None]

_TILE = 32, BLOCK // 32  # pixels that share one walk


def read_out(
    solution: LevelSolution, options: InversionOptions, on_share: OnShare | None = None
) -> tuple[FloatArray, FloatArray]:
    """Read a solution by the options' method; `on_share` receives the progress, 0 to 1."""
    if options.readout == "centroid":
        moves, integration = solution.displacement, options.integration
        return read_centroids(solution.level, moves, options.threads, integration=integration)
    return read_dual(solution.surface, solution.level.shape, on_share)


def read_dual(
    surface: CloughTocher, shape: tuple[int, int], on_share: OnShare | None = None
) -> tuple[FloatArray, FloatArray]:
    """Read the potential from the surface through the sites, and differentiate it."""
    height, width = shape
    potential = np.empty((height, width))
    rows = np.arange(_TILE[0], dtype=np.float64)
    columns = np.arange(width, dtype=np.float64)
    # Tile by tile: neighbours in both directions lie on the same few triangles.
    cuts = np.arange(_TILE[1], width, _TILE[1])
    for top in range(0, height, _TILE[0]):
        strip = potential[top : top + _TILE[0]]
        tiles = [
            np.stack(np.meshgrid(top + rows[: len(strip)], part, indexing="ij"), axis=-1)
            for part in np.split(columns, cuts)
        ]
        values = surface(np.concatenate([tile.reshape(-1, 2) for tile in tiles]))
        ends = np.cumsum([tile[..., 0].size for tile in tiles])[:-1]
        for part, tile in zip(np.split(values, ends), np.split(strip, cuts, axis=1), strict=True):
            tile[:] = part.reshape(tile.shape)
        if on_share is not None:
            on_share((top + len(strip)) / height)
    potential -= border_mean(potential)
    # No flux crosses the border, so beyond it the potential is its mirror image.
    gradient = np.array(np.gradient(np.pad(potential, 1, mode="symmetric")))
    return potential, np.ascontiguousarray(-gradient[:, 1:-1, 1:-1])


def read_centroids(
    level: Level,
    site_displacement: FloatArray,
    threads: int | None = None,
    *,
    integration: Literal["mean", "y", "x"] = "mean",
) -> tuple[FloatArray, FloatArray]:
    """Interpolate and integrate as in the paper, section III and lines 22–26 of its algorithm."""
    shape = level.shape
    pixels = np.indices(shape, dtype=np.float64).reshape(2, -1).T
    # So that the sites' hull covers the image; it distorts the result near the corners.
    sites = level.sites.copy()
    for y in (-0.5, shape[0] - 0.5):
        for x in (-0.5, shape[1] - 0.5):
            nearest = np.argmin((level.sites[:, 0] - y) ** 2 + (level.sites[:, 1] - x) ** 2)
            sites[nearest] = y, x
    triangulation = RegularTriangulation(sites)
    displacement = natural_neighbor(triangulation, site_displacement, pixels, threads=threads)
    displacement = np.ascontiguousarray(displacement.T).reshape(2, *shape)
    potential = _integrate(displacement, integration)
    return potential - border_mean(potential), displacement


def _integrate(displacement: FloatArray, first: Literal["mean", "y", "x"]) -> FloatArray:
    """Integrate minus the displacement along one axis and then the other."""
    along_y = cumulative_trapezoid(displacement[0], axis=0, initial=0)
    along_x = cumulative_trapezoid(displacement[1], axis=1, initial=0)
    y_first = along_y[:, :1] + along_x
    x_first = along_x[:1, :] + along_y
    share = {"y": 1.0, "x": 0.0, "mean": 0.5}[first]
    potential: FloatArray = -(share * y_first + (1 - share) * x_first)
    return potential
