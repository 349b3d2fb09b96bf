"""Sites spread over the undisturbed beam, each standing for about the same flux.

- drop sites by rejection: `sample_sites`
- even them out: `lloyd`
- all levels of a multilevel solution, ready to use: `plan_levels`

References
----------
Paper, sections II.C and III: rejection, then weighted Lloyd relaxation.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from functools import cached_property
from threading import Event

import numpy as np
from numpy.typing import NDArray

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import BoolArray, FloatArray
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.geometry._kernel import njit
from napari_shadowinv.geometry._mesh import Indices
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.interpolation import mirrored_across_border
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation, hilbert_order
from napari_shadowinv.transport.margin import Margin

__all__ = ["Level", "SitePlan", "lloyd", "plan_levels", "sample_sites"]


COARSEST = 600  # sites with which the solver can start from zero weights
RATIO = 4  # sites of a level per site of the next coarser one

_POLL = 0.05  # seconds between two looks at work in another thread
_MIRROR_BAND = 3.0  # in site spacings: every border pixel must lie between sites


@dataclass(frozen=True)
class Mirrored:
    """Sites and the mirror images of those near the image's border, which cover the image."""

    triangulation: RegularTriangulation
    origin: Indices  # the site that each point is, or is the mirror image of
    sense: NDArray[np.int8]  # (y, x): -1 for the axes along which a point was mirrored, else 1

    @classmethod
    def from_sites(cls, sites: FloatArray, shape: tuple[int, int]) -> Mirrored:
        """Mirror the sites of an image of shape (H, W)."""
        band = _MIRROR_BAND * _spacing(shape, len(sites))
        images, origin, sense = mirrored_across_border(sites, shape, band)
        points = np.concatenate([sites, images])
        order = hilbert_order(points)
        origins = np.concatenate([np.arange(len(sites)), origin])[order]
        senses = np.concatenate([np.ones_like(sites), sense])[order]
        return cls(
            RegularTriangulation(points[order]), origins.astype(np.int32), senses.astype(np.int8)
        )


@dataclass(frozen=True)
class Level:
    """The sites of one level of the multilevel solution.

    Attributes
    ----------
    sites : ndarray, shape (n, 2)
        Positions; neighbours in the plane are near in the order, mostly.
    mass : ndarray, shape (n,)
        Flux of the source in each site's Voronoi cell, S(V_i) of the paper.
    centroids : ndarray, shape (n, 2)
        Centres of flux of the Voronoi cells; the sites themselves after many Lloyd steps.
    triangulation : RegularTriangulation
        Their Delaunay triangulation; copy it before changing weights.
    shape : tuple of int
        Shape (H, W) of the source.
    lloyd_iterations : int
        Lloyd steps that were made.
    """

    sites: FloatArray
    mass: FloatArray
    centroids: FloatArray
    triangulation: RegularTriangulation
    shape: tuple[int, int]
    lloyd_iterations: int

    @property
    def spacing(self) -> float:
        """Mean distance between neighbours, sqrt(area of the image / n), in px."""
        return _spacing(self.shape, len(self.sites))

    @cached_property
    def mirrored(self) -> Mirrored:
        """The sites with those near the border mirrored across it; made when first asked for."""
        return Mirrored.from_sites(self.sites, self.shape)

    def split(self, factor: int) -> Level:
        """Return the same sites, in px of an image whose pixels are split into factor × factor."""
        if factor == 1:
            return self
        height, width = factor * self.shape[0], factor * self.shape[1]
        sites = factor * (self.sites + 0.5) - 0.5
        region = [(-0.5, -0.5), (height - 0.5, width - 0.5)]
        return replace(
            self,
            sites=sites,
            centroids=factor * (self.centroids + 0.5) - 0.5,
            triangulation=RegularTriangulation(sites, region=region),
            shape=(height, width),
        )


@dataclass(frozen=True)
class SitePlan:
    """Everything about the sites that depends on the source alone.

    Attributes
    ----------
    source : ndarray, shape (H, W)
        The source that the sites stand for.
    levels : tuple of Level
        Coarse to fine.
    mask : ndarray of bool, shape (H, W), or None
        Where the source is known; elsewhere it only keeps the cells together.
    margin : Margin or None
        The margin around the image that the sites cover too, where the boundary is free; the
        levels' coordinates are then those of image and margin.
    unit : float
        Flux of the source that the levels' masses count as 1.
    """

    source: FloatArray
    levels: tuple[Level, ...]
    mask: BoolArray | None = None
    margin: Margin | None = None
    unit: float = 1.0

    @property
    def margin_width(self) -> int:
        """Pixels by which the levels' coordinates exceed those of the image."""
        return 0 if self.margin is None else self.margin.width

    def within(self, values: FloatArray) -> FloatArray:
        """Return the image's part of an array that covers what the levels cover."""
        return values if self.margin is None else self.margin.within(values)


@njit(nogil=True, cache=True)
def _accepted(source: FloatArray, shift: FloatArray, sites: FloatArray) -> None:
    """Throw points of an even sequence at the source; keep them by its brightness."""
    # The positions are the Kronecker sequence of the real root of x³ = x + 1, which leaves
    # fewer gaps and clumps than independent random points; the golden ratio's decides
    # what to keep.
    root = 1.3247179572447460
    golden = 1.6180339887498949
    height, width = source.shape
    brightest = source.max()
    kept = number = 0
    while kept < len(sites):
        number += 1
        u = (shift[0] + number / root) % 1.0
        v = (shift[1] + number / root**2) % 1.0
        threshold = (shift[2] + number / golden) % 1.0
        y = u * height
        x = v * width
        if threshold * brightest < source[min(int(y), height - 1), min(int(x), width - 1)]:
            sites[kept, 0] = y - 0.5
            sites[kept, 1] = x - 0.5
            kept += 1


def sample_sites(source: FloatArray, n_sites: int, seed: int = 0) -> FloatArray:
    """Deploy sites on the source by rejection: bright places keep more of them.

    The seed shifts the sequence of positions. They come in the order of a Hilbert curve.

    References
    ----------
    Paper, section II.C; for the sequence H. Niederreiter, *Random Number Generation and
    Quasi-Monte Carlo Methods* (SIAM, 1992), chapter 3.
    """
    sites = np.empty((n_sites, 2))
    shift = np.random.default_rng(seed).random(3)
    _accepted(np.ascontiguousarray(source, dtype=np.float64), shift, sites)
    return np.ascontiguousarray(sites[hilbert_order(sites)])


def lloyd(
    triangulation: RegularTriangulation,
    source: Density,
    *,
    iterations: int,
    tolerance: float = 0.0,
    threads: int | None = None,
    report: Callable[[int, int], None] | None = None,
) -> tuple[PowerDiagram, int]:
    """Move each site to the centroid of its Voronoi cell, again and again.

    The triangulation, without weights, is moved along with the sites. The steps end when the
    root mean square distance of sites from centroids is below the tolerance, in units of the
    mean spacing of the sites. The report is told before each step how many were made, and the
    number of sites. Returns the diagram with moments, and the steps that were made.

    References
    ----------
    Paper, section II.C, and lines 6–10 of its algorithm.
    """
    near = tolerance * _spacing(source.shape, len(triangulation.sites))
    step = 0
    while True:
        if report is not None:
            report(step, len(triangulation.sites))
        diagram = PowerDiagram(triangulation, source, with_moments=True, threads=threads)
        centroids = diagram.centroids
        away = np.sqrt(((centroids - triangulation.sites) ** 2).sum(axis=1).mean())
        if step == iterations or away < near:
            return diagram, step
        del diagram  # before the next one is made: they are large
        triangulation.move(centroids)
        step += 1


def _spacing(shape: tuple[int, int], n: int) -> float:
    return float(np.sqrt(shape[0] * shape[1] / n))


def plan_levels(
    source: FloatArray,
    n_sites: int,
    *,
    lloyd_iterations: int,
    lloyd_tolerance: float = 0.0,
    seed: int = 0,
    threads: int | None = None,
    report: Reporter | None = None,
) -> SitePlan:
    """Spread the sites of all levels over a source; the finest has `n_sites`, each other a quarter.

    The report is told of each step of the finest level, with one thread of all levels.
    """
    density = Density.from_image(source)
    counts = [n_sites]
    while counts[-1] > COARSEST:
        counts.append(max(4, counts[-1] // RATIO))

    def level(count: int, tell: Callable[[int, int], None]) -> Level:
        triangulation = RegularTriangulation(
            sample_sites(source, count, seed), region=density.region
        )
        diagram, steps = lloyd(
            triangulation,
            density,
            iterations=lloyd_iterations,
            tolerance=lloyd_tolerance,
            threads=threads,
            report=tell,
        )
        sites, masses, centroids = triangulation.sites, diagram.masses, diagram.centroids
        return Level(sites, masses, centroids, triangulation, density.shape, steps)

    def tell(step: int, count: int) -> None:
        if report is not None:
            report("sites", step, lloyd_iterations, f"{count:,} sites, Lloyd relaxation")

    if available_threads(threads) == 1:
        return SitePlan(source, tuple(level(count, tell) for count in reversed(counts)))
    abandoned = Event()

    def give_up(step: int, count: int) -> None:
        if abandoned.is_set():
            raise InversionCancelled("the finest level was abandoned")

    # beside the finest level, which takes three times as long; this thread alone reports
    with ThreadPoolExecutor(1) as pool:
        others = pool.submit(lambda: [level(count, give_up) for count in counts[:0:-1]])
        try:
            finest = level(n_sites, tell)
            while not wait([others], timeout=_POLL).done:
                tell(lloyd_iterations, n_sites)
        except BaseException:
            abandoned.set()
            raise
        return SitePlan(source, (*others.result(), finest))
