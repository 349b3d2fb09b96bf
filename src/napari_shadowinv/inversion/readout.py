"""From the weights of the sites to the potential and displacement at every pixel.

- by the method of the options: `read_out`
- from the dual variables, without any integration: `read_dual` (default), together with the cells'
  centroids where these are the pixels'; as a linear map, for many weights of one level, and for
  sums over many samples: `LinearReadout`
- by the paper's method, from the cells' centroids: `read_centroids`
- linear response of the field to small changes of flux: `LinearResponse`

Each returns the potential, shape (H, W), px², zero in the mean over the border; and the
displacement, shape (2, H, W), px. With a margin these cover it too.

Around a solved transport the weights answer a change of flux linearly, by the Hessian that
Newton's step has: H δw = δS - δT, and the displacement by -½ ∇δw. A level of a few thousand sites
is enough for noise, whose displacement is mostly of long waves (its spectrum falls as 1/k²); the
contribution of finer waves, 1 / 2π of the noise's variance for each power of e, needs no solving.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property

import numpy as np
from scipy.sparse import csr_array

from napari_shadowinv._system.machine import in_ranges
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.density import Density, side_of_squares
from napari_shadowinv.geometry.interpolation import (
    WIDTH,
    CloughTocher,
    corner_weights,
    with_gradients,
)
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.arrays import block_sums
from napari_shadowinv.physics.derivatives import first_derivative
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.linear import FactorisedLaplacian
from napari_shadowinv.transport.sites import SiteLevel, SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target


class LinearReadout:
    """Read-out of a level at the pixels of a plan's image."""

    def __init__(self, plan: SitePlan, level: SiteLevel, threads: int | None = None) -> None:
        self._triangulation = level.triangulation
        self._is_of_pixels = level.is_of_pixels
        reach = self._reach = 3 if self._is_of_pixels else 1
        # More pixels at each side; beyond the level's border the potential is its mirror image.
        beyond = [
            np.pad(np.arange(padded_size), reach, mode="symmetric")[
                plan.margin_width : plan.margin_width + size + 2 * reach
            ]
            for size, padded_size in zip(plan.source.shape, level.shape, strict=True)
        ]
        pixels = np.stack(np.meshgrid(*beyond, indexing="ij"), axis=-1)
        mirrored = level.mirrored
        queries = pixels.reshape(-1, 2).astype(np.float64)
        corners, weights = corner_weights(mirrored.triangulation, queries, threads)
        weights[..., 1:] *= mirrored.sense[corners]
        # From value and gradient at each site to the potential.
        columns = 3 * mirrored.origin[corners][..., None] + np.arange(3)
        starts = np.arange(0, columns.size + 1, columns[0].size)
        size = len(queries), 3 * len(level.sites)
        self._matrix = csr_array((weights.ravel(), columns.ravel(), starts), shape=size)
        self._shape = pixels.shape[:2]
        border = np.ones(plan.source.shape, bool)
        border[1:-1, 1:-1] = False
        is_border = np.flatnonzero(np.pad(border, reach))
        self._border_mean = csr_array(self._matrix[is_border].mean(axis=0)[None])

    def at_sites(self, weights: FloatArray) -> FloatArray:
        """Return the potential's values and gradients, (n, 3, WIDTH), for weights (n, WIDTH)."""
        # Half the weights are the potential.
        at_sites = with_gradients(self._triangulation, 0.5 * weights)
        at_sites[:, 0] -= self._border_mean @ at_sites.reshape(-1, WIDTH)
        return at_sites

    def add(
        self, values: FloatArray, sums: FloatArray, squares: FloatArray, start: int, rows: int
    ) -> None:
        """Add potential and displacement, and their squares, to sums (3, H, W) in some rows."""
        stop = min(start + rows, sums.shape[1])
        fields = self.field(values, slice(start, stop))
        sums[:, start:stop] += fields.sum(axis=-1)
        squares[:, start:stop] += (fields**2).sum(axis=-1)

    def field(self, values: FloatArray, rows: slice = slice(None)) -> FloatArray:
        """Return potential and displacement in some rows, (3, h, W, ...), of values (n, 3, ...)."""
        height, width = self._shape
        start, stop, _ = rows.indices(height - 2 * self._reach)
        matrix = self._matrix[start * width : (stop + 2 * self._reach) * width]
        numbers = values.reshape(matrix.shape[1], *values.shape[2:])
        padded = (matrix @ numbers).reshape(-1, width, *values.shape[2:])
        if self._is_of_pixels:
            potential = _softened(padded)
            down, right = first_derivative(potential, 0), first_derivative(potential, 1)
            return np.stack([potential[2:-2, 2:-2], -down[:, 2:-2], -right[2:-2]])
        slopes = np.gradient(padded, axis=(0, 1))
        return np.stack([padded, *-np.array(slopes)])[:, 1:-1, 1:-1]


_SQUARES_PER_SPACING = 8
_RESOLUTION = 2.5  # spacing over the finest wave that a level resolves within 5 %
_DIMMEST = 1e-3  # of the mean, for a logarithm
_MIN_ROUNDNESS = 0.3  # double area by the longest side's square; of an equilateral triangle 0.87


@njit(nogil=True, cache=True)
def _add_slopes(
    corners: Indices, slopes: FloatArray, values: FloatArray, moves: FloatArray
) -> None:
    """Compute each triangle's gradients (t, k, 2) of k sets of values at the sites, (n, k)."""
    for t in range(moves.shape[0]):
        a, b, c = corners[t]
        for k in range(moves.shape[1]):
            for axis in range(2):
                moves[t, k, axis] = (
                    slopes[t, 0, axis] * values[a, k]
                    + slopes[t, 1, axis] * values[b, k]
                    + slopes[t, 2, axis] * values[c, k]
                )


class LinearResponse:
    """Response of the solution of a level of n sites, `spacing` px apart.

    The image's `flux` (n,) is that in each cell, the `area` (n,) the cell's in pixels.
    """

    def __init__(self, solution: LevelSolution, target: Target, plan: SitePlan) -> None:
        self.level, self._plan = solution.level, plan
        self.spacing = solution.level.spacing
        objective = target.objective(solution.level)
        diagram = objective.diagram(solution.weights)
        self.flux = diagram.masses
        self._triangulation, self._threads = objective.triangulation, solution.threads
        self._side = side_of_squares(solution.level.shape, self.spacing / _SQUARES_PER_SPACING)
        self.area = self._masses(np.ones(solution.level.shape), self._triangulation)
        ground = objective.ground(solution.weights)
        self._network = diagram.laplacian()
        self._factors = FactorisedLaplacian(self._network, ground)

    @property
    def sites(self) -> FloatArray:
        """Positions of the sites, px of the image, shape (n, 2)."""
        return np.asarray(self.level.sites - self._plan.margin_width)

    def diffusion(self) -> FloatArray:
        """Return the flux that cells gain where the image diffuses for a time of 1 px², (n,)."""
        # Between cells a network link carries flux by half the gradient of the weights.
        brightness = self.flux / np.maximum(self.area, 1e-300)
        dimmest = _DIMMEST * self.flux.sum() / self.area.sum()
        return np.asarray(-2 * (self._network @ np.log(np.maximum(brightness, dimmest))))

    def flux_of_source(self, changes: FloatArray) -> FloatArray:
        """Return the flux that changes of the source, (k, H, W), bring to its cells, (k, n)."""
        flux = np.empty((len(changes), len(self.flux)))
        padded = np.zeros(self.level.shape)
        for row, change in zip(flux, changes, strict=True):
            self._plan.within(padded)[:] = change
            # Without weights the cells are those of the source.
            row[:] = self._masses(padded, self.level.triangulation)
        return flux

    def flux_of_image(self, changes: FloatArray) -> FloatArray:
        """Return the flux that changes of the image, (k, H, W), bring to its cells, (k, n)."""
        flux = np.empty((len(changes), len(self.flux)))
        padded = np.zeros(self.level.shape)
        for row, change in zip(flux, changes, strict=True):
            self._plan.within(padded)[:] = change
            row[:] = self._masses(padded, self._triangulation)
        # The image is scaled to the flux of the source.
        return flux - np.outer(flux.sum(axis=1), self.flux / self.flux.sum())

    def areas(self, mask: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Return the used area of each cell in the image and in the source, pixels, (n,) each."""
        used = np.ones(self.level.shape)
        self._plan.within(used)[:] = mask
        of_source = self._masses(used, self.level.triangulation)
        return (self.area if mask.all() else self._masses(used, self._triangulation)), of_source

    def _masses(self, image: FloatArray, triangulation: RegularTriangulation) -> FloatArray:
        squares = block_sums(image, self._side)
        density = Density.from_image(squares, side=self._side, threads=self._threads)
        return PowerDiagram(triangulation, density, threads=self._threads).masses

    def to(self, changes: FloatArray) -> FloatArray:
        """Return each triangle's displacement (t, k, 2), px, by flux changes of cells (k, n)."""
        half_weights = 0.5 * self._factors.solve(changes.T)
        corners, slopes = self._slopes
        moves = np.empty((len(corners), len(changes), 2))
        _add_slopes(corners, slopes, half_weights, moves)
        return moves

    def finer(self, variance: FloatArray, spacing: float, grain: float = 0.0) -> FloatArray:
        """Return each triangle's mean square displacement, px², by waves too fine for this level.

        Only waves count that sites with this `spacing` resolve. `variance` is the variance of the
        flux in each cell, by noise that is independent between pixels, or above a `grain`, px. The
        result is negative if this level resolves finer waves than the noise has.
        """
        finest = self.spacing / _RESOLUTION
        powers = math.log(finest / max(min(finest, max(spacing, 1.0)), grain))
        of_cell = variance * self.area / self.flux**2
        corners, _ = self._slopes
        return np.asarray(of_cell[corners].mean(axis=1) * powers / (2 * np.pi))

    @cached_property
    def places(self) -> FloatArray:
        """Middles of the triangles, px of the image, shape (t, 2)."""
        first, second, third = self._slopes[0].T
        sites = self.level.sites
        middles = (sites[first] + sites[second] + sites[third]) / 3
        return np.asarray(middles - self._plan.margin_width)

    @cached_property
    def shares(self) -> FloatArray:
        """Area of each triangle as a share of the used image."""
        corners, _ = self._slopes
        a, b, c = np.moveaxis(self.level.sites[corners], 1, 0)
        double = np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
        used = _within(self.places, self._plan)
        return np.asarray(double * used / max((double * used).sum(), 1e-300))

    @cached_property
    def _slopes(self) -> tuple[Indices, FloatArray]:
        """Corners of the triangles between sites, and the gradient by each corner's value."""
        triangulation = self.level.triangulation
        corners = triangulation.vertices
        corners = corners[(corners < len(triangulation.sites)).all(axis=1)]
        points = triangulation.sites[corners]
        edges = np.roll(points, -2, axis=1) - np.roll(points, -1, axis=1)  # opposite to corners
        double = edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]
        # Slivers along the border are too thin for a gradient by three values.
        longest = (edges**2).sum(axis=2).max(axis=1)
        is_round = np.abs(double) > _MIN_ROUNDNESS * longest
        corners, edges, double = corners[is_round], edges[is_round], double[is_round]
        normals = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
        return corners, normals / double[:, None, None]


def _within(places: FloatArray, plan: SitePlan) -> BoolArray:
    """Return which places are within the image and its mask."""
    height, width = plan.source.shape
    rows, columns = np.rint(places).astype(np.int64).T
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    if plan.mask is None:
        return np.asarray(inside)
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    return np.asarray(inside & plan.mask[rows, columns])


OnShare = Callable[[float], None]

_MIN_PIXELS_PER_THREAD = 1 << 15


def read_out(
    solution: LevelSolution, options: InversionOptions, on_share: OnShare | None = None
) -> tuple[FloatArray, FloatArray]:
    """Read a solution by the options' method; `on_share` receives the progress, 0 to 1."""
    if options.readout == "centroid":
        return read_centroids(solution.level, solution.displacement)
    fields = read_dual(solution.surface, solution.level.shape, on_share)
    return _at_middles(fields[0], solution) if solution.level.is_of_pixels else fields


def _at_middles(potential: FloatArray, solution: LevelSolution) -> tuple[FloatArray, FloatArray]:
    """Return potential and displacement at the middles of pixels that are the cells of the source.

    The dual variables of sites 1 px apart are those of a potential less 1/24 of its Laplacian, and
    the cells' centroids move by the mean of the displacement over a pixel, which adds as much.
    Half of each is the displacement.
    """
    level = solution.level
    padded = np.pad(potential, 2, mode="symmetric")  # no flux crosses the border
    slopes = first_derivative(padded, 0)[:, 2:-2], first_derivative(padded, 1)[2:-2]
    displacement = -np.array(slopes)
    rows, columns = np.rint(level.sites.T).astype(np.int64)
    displacement[:, rows, columns] += solution.displacement.T
    displacement[:, rows, columns] /= 2
    potential = _softened(padded[1:-1, 1:-1])
    return potential - border_mean(potential), displacement


def _softened(dual: FloatArray) -> FloatArray:
    """Return the potential of dual variables in all pixels, without the outermost."""
    around = dual[:-2, 1:-1] + dual[2:, 1:-1] + dual[1:-1, :-2] + dual[1:-1, 2:]
    return np.asarray(dual[1:-1, 1:-1] * (1 - 4 / 24) + around / 24)


def read_dual(
    surface: CloughTocher, shape: tuple[int, int], on_share: OnShare | None = None
) -> tuple[FloatArray, FloatArray]:
    """Read the potential from the surface through the sites, and differentiate it."""
    potential = surface.at_pixels(shape, on_share)
    potential -= border_mean(potential)
    displacement = np.empty((2, *shape))
    rows = max(1, _MIN_PIXELS_PER_THREAD // shape[1])
    in_ranges(_differentiate, shape[0], surface.threads, potential, displacement, smallest=rows)
    return potential, displacement


@njit(nogil=True, cache=True)
def _differentiate(start: int, stop: int, potential: FloatArray, displacement: FloatArray) -> None:
    """Compute minus the gradient by central differences in rows `start` to `stop`."""
    # No flux crosses the border, so beyond it the potential is its mirror image.
    height, width = potential.shape
    for y in range(start, stop):
        above, below = max(y - 1, 0), min(y + 1, height - 1)
        for x in range(width):
            displacement[0, y, x] = 0.5 * (potential[above, x] - potential[below, x])
            before, after = max(x - 1, 0), min(x + 1, width - 1)
            displacement[1, y, x] = 0.5 * (potential[y, before] - potential[y, after])


def read_centroids(
    level: SiteLevel, site_displacement: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Interpolate and integrate, as in the paper, section III and lines 22–26 of its algorithm.

    The interpolation is linear between three sites, the paper's is by natural neighbours; with a
    site a pixel the displacements of both differ by 0.6 % at most.
    """
    from scipy.integrate import cumulative_trapezoid  # slow to import
    from scipy.interpolate import LinearNDInterpolator

    shape = level.shape
    # So that the sites' hull covers the image; it distorts the result near the corners.
    sites = level.sites.copy()
    for y in (-0.5, shape[0] - 0.5):
        for x in (-0.5, shape[1] - 0.5):
            nearest = np.argmin((level.sites[:, 0] - y) ** 2 + (level.sites[:, 1] - x) ** 2)
            sites[nearest] = y, x
    pixels = np.moveaxis(np.indices(shape, dtype=np.float64), 0, -1)
    displacement = np.moveaxis(LinearNDInterpolator(sites, site_displacement)(pixels), -1, 0)
    displacement = np.ascontiguousarray(displacement)
    along_y = cumulative_trapezoid(displacement[0], axis=0, initial=0)
    along_x = cumulative_trapezoid(displacement[1], axis=1, initial=0)
    y_first, x_first = along_y[:, :1] + along_x, along_x[:1] + along_y
    potential: FloatArray = -(y_first + x_first) / 2
    return potential - border_mean(potential), displacement
