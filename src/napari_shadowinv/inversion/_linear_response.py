"""Linear response of the field to small changes of flux: `LinearResponse`.

Around a solved transport the weights answer a change of flux linearly, by the Hessian that
Newton's step has: H δw = δS - δT, and the displacement by -½ ∇δw. A level of a few thousand sites
is enough for noise, whose displacement is mostly of long waves (its spectrum falls as 1/k²); the
contribution of finer waves, 1 / 2π of the noise's variance for each power of e, needs no solving.
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.transport.factorised import FactorisedLaplacian
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target

__all__ = ["LinearResponse"]

_RESOLUTION = 2.5  # spacing over the finest wave that a level resolves within 5 %
_MIN_ROUNDNESS = 0.3  # double area by the longest side's square; of an equilateral triangle 0.87


class LinearResponse:
    """Response of one level's solution.

    Attributes
    ----------
    level : Level
        The level, of n sites.
    spacing : float
        Distance between its sites, px.
    flux, area : ndarray, shape (n,)
        The image's flux in each cell, and its area in pixels.
    """

    def __init__(self, solution: LevelSolution, target: Target, plan: SitePlan) -> None:
        self.level, self._plan = solution.level, plan
        self.spacing = solution.level.spacing
        objective = target.objective(solution.level)
        diagram = objective.diagram(solution.weights)
        self.flux = diagram.masses
        ones = Density.from_image(np.ones(solution.level.shape), threads=solution.threads)
        self.area = PowerDiagram(objective.triangulation, ones, threads=solution.threads).masses
        ground = objective.ground(solution.weights)
        self._factors = FactorisedLaplacian(diagram.laplacian(), ground)

    def to(self, changes: FloatArray) -> FloatArray:
        """Return each triangle's displacement (t, k, 2), px, by flux changes of cells (k, n)."""
        potential = -0.5 * self._factors.solve(changes.T)
        corners, slopes = self._slopes
        return np.asarray(-np.swapaxes(potential[corners], 1, 2) @ slopes)

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

    @property
    def places(self) -> FloatArray:
        """Middles of the triangles, px of the image, shape (t, 2)."""
        corners, _ = self._slopes
        return np.asarray(self.level.sites[corners].mean(axis=1) - self._plan.margin_width)

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
        corners, edges, double = _triangles(self.level.triangulation)
        # Slivers along the border are too thin for a gradient by three values.
        longest = (edges**2).sum(axis=2).max(axis=1)
        is_round = np.abs(double) > _MIN_ROUNDNESS * longest
        corners, edges, double = corners[is_round], edges[is_round], double[is_round]
        return corners, _normals(edges) / double[:, None, None]


def _triangles(triangulation: RegularTriangulation) -> tuple[Indices, FloatArray, FloatArray]:
    """Return corners of the triangles between sites, opposite edges, and double areas."""
    corners = triangulation.vertices
    corners = corners[(corners < len(triangulation.sites)).all(axis=1)]
    points = triangulation.sites[corners]
    edges = np.roll(points, -2, axis=1) - np.roll(points, -1, axis=1)
    return corners, edges, edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]


def _normals(edges: FloatArray) -> FloatArray:
    return np.stack([-edges[..., 1], edges[..., 0]], axis=-1)


def _within(places: FloatArray, plan: SitePlan) -> BoolArray:
    """Return which places are within the image and its mask."""
    height, width = plan.source.shape
    rows, columns = np.rint(places).astype(np.int64).T
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    if plan.mask is None:
        return np.asarray(inside)
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    return np.asarray(inside & plan.mask[rows, columns])
