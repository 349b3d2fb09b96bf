"""From the weights of the sites to the potential and displacement at every pixel.

- by the way that the options name: `read_out`
- from the dual variables, without any integration: `read_dual` (default)
- the paper's way, from the cells' centroids: `read_centroids`
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.integrate import cumulative_trapezoid

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.geometry.interpolation import BLOCK
from napari_shadowinv.geometry.natural_neighbor import natural_neighbor
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.sites import Level, SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, potential_surface

__all__ = ["read_centroids", "read_dual", "read_out"]

OnShare = Callable[[float], None]

_PART = 64 * BLOCK  # pixels


def read_out(
    plan: SitePlan,
    solution: LevelSolution,
    options: InversionOptions,
    on_share: OnShare | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Potential and displacement at the pixels, by the read-out that the options name.

    Parameters
    ----------
    plan : SitePlan
        The sites; with a margin, the result covers it too.
    solution : LevelSolution
        Of the plan's finest level.
    options : InversionOptions
        Its `readout`, `integration` and `threads` are used.
    on_share : callable, optional
        Receives the share of the pixels that are read, from 0 to 1; what it raises ends the work.

    Returns
    -------
    potential : ndarray, shape (H, W)
        px².
    displacement : ndarray, shape (2, H, W)
        px.
    """
    level, moves = plan.levels[-1], solution.displacement
    if options.readout == "centroid":
        return read_centroids(level, moves, options.threads, integration=options.integration)
    return read_dual(level, solution.weights, moves, options.threads, on_share)


def read_dual(
    level: Level,
    weights: FloatArray,
    site_displacement: FloatArray,
    threads: int | None = None,
    on_share: OnShare | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Read the potential off the weights: at a site it is half the weight.

    Parameters
    ----------
    level : Level
        The sites.
    weights : ndarray, shape (n,)
        Weights, px².
    site_displacement : ndarray, shape (n, 2)
        Displacement of each site, px; see `LevelSolution`.
    threads : int, optional
        Default: all cores.
    on_share : callable, optional
        See `read_out`.

    Returns
    -------
    potential : ndarray, shape (H, W)
        px², zero in the mean over the border.
    displacement : ndarray, shape (2, H, W)
        Minus its gradient by central differences, px; beyond the border, which no flux
        crosses, the potential is taken as its mirror image.
    """
    surface = potential_surface(level, weights, site_displacement, threads=threads)
    potential = np.empty(level.shape)
    count = potential.size
    # Whole blocks of the surface's queries, so that the parts change nothing.
    for first in range(0, count, _PART):
        part = np.arange(first, min(first + _PART, count))
        rows, columns = np.divmod(part.astype(np.float64), level.shape[1])
        potential.ravel()[part[0] : part[-1] + 1] = surface(np.column_stack([rows, columns]))[0]
        if on_share is not None:
            on_share((first + len(part)) / count)
    potential -= border_mean(potential)
    gradient = np.array(np.gradient(np.pad(potential, 1, mode="symmetric")))
    return potential, np.ascontiguousarray(-gradient[:, 1:-1, 1:-1])


def read_centroids(
    level: Level,
    site_displacement: FloatArray,
    threads: int | None = None,
    *,
    integration: Literal["mean", "y", "x"] = "mean",
) -> tuple[FloatArray, FloatArray]:
    """Interpolate the centroids' displacements and integrate them, as the paper does.

    The sites nearest to the corners are moved there, so that the sites' hull covers the
    image; this distorts the result near the corners.

    Parameters
    ----------
    level, site_displacement, threads
        See `read_dual`.
    integration : {"mean", "y", "x"}
        Integrate first along y and then along x, first along x, or take the mean of both.

    Returns
    -------
    potential, displacement
        As of `read_dual`, but the displacement is the natural-neighbour interpolation of that of
        the sites.

    References
    ----------
    Paper, section III and lines 22–26 of its algorithm.
    """
    shape = level.shape
    pixels = np.indices(shape, dtype=np.float64).reshape(2, -1).T
    triangulation = RegularTriangulation(_moved_to_corners(level.sites, shape))
    displacement = natural_neighbor(triangulation, site_displacement, pixels, threads=threads)
    displacement = np.ascontiguousarray(displacement.T).reshape(2, *shape)
    potential = _integrated(displacement, integration)
    return potential - border_mean(potential), displacement


def _moved_to_corners(sites: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Move the site nearest to each corner of the image to it."""
    moved = sites.copy()
    for y in (-0.5, shape[0] - 0.5):
        for x in (-0.5, shape[1] - 0.5):
            nearest = np.argmin((sites[:, 0] - y) ** 2 + (sites[:, 1] - x) ** 2)
            moved[nearest] = y, x
    return moved


def _integrated(displacement: FloatArray, first: Literal["mean", "y", "x"]) -> FloatArray:
    """Integrate minus the displacement along one axis and then the other."""
    along_y = cumulative_trapezoid(displacement[0], axis=0, initial=0)
    along_x = cumulative_trapezoid(displacement[1], axis=1, initial=0)
    y_first = along_y[:, :1] + along_x
    x_first = along_x[:1, :] + along_y
    share = {"y": 1.0, "x": 0.0, "mean": 0.5}[first]
    potential: FloatArray = -(share * y_first + (1 - share) * x_first)
    return potential
