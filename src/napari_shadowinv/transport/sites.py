"""Sites spread over the undisturbed beam, each standing for about the same flux.

- drop sites by rejection: `sample_sites`
- even them out: `lloyd`
- all levels of a multilevel solution, ready to use: `plan_levels`
- the beam in a margin around the image, where the boundary is free: `Margin`; flux that crosses
  each side of the image: `edge_flux`

With a free boundary, flux may cross the image's edge. The sites then also cover a margin around the
image, in which the beam is assumed to continue undisturbed. The flux that arrives in the margin is
not measured, so it is not prescribed: where the potential φ of the deflection does not vanish, the
flux S (1 + φ / ℓ²) arrives instead of S (`napari_shadowinv.transport.minimise.OpenObjective`). In
the linear limit, Δφ = φ / ℓ²: beyond the edge the potential decays over the decay length ℓ. Both
limits are simple: ℓ → 0 means φ = 0 at the edge, where flux leaves and enters at no more than the
cost of its transport; ℓ → ∞ is a margin filled with the source. In between, the potential
continues smoothly across the edge.

References
----------
Paper, sections II.C and III: rejection, then weighted Lloyd relaxation (lines 6–10 of its
algorithm); for the sequence of positions H. Niederreiter, *Random Number Generation and
Quasi-Monte Carlo Methods* (SIAM, 1992), chapter 3.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterator, MutableMapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from threading import Event, Lock
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.density import Density, split_pixels
from napari_shadowinv.geometry.interpolation import with_mirror_images
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangle_mesh import Indices
from napari_shadowinv.geometry.triangulation import RegularTriangulation, hilbert_order
from napari_shadowinv.physics.edge import SIDES


@dataclass(frozen=True)
class Margin:
    """The beam in an image and in a margin around it."""

    beam: FloatArray  # (H + 2 m, W + 2 m): the source with its margin
    width: int  # pixels m on each side

    @classmethod
    def around(cls, source: FloatArray, width: int, mask: BoolArray | None = None) -> Margin:
        """Continue a source by its nearest positive pixel, of those in the mask if there is one."""
        usable = source > 0 if mask is None else mask & (source > 0)
        rows, columns = distance_transform_edt(
            np.pad(~usable, width, constant_values=True),
            return_distances=False,
            return_indices=True,
        )
        beam = np.pad(source, width)[rows, columns]
        margin = cls(beam, width)
        margin.within(beam)[:] = source
        return margin

    def split(self, factor: int) -> Margin:
        """Return the same beam for pixels that are split into factor × factor."""
        return Margin(split_pixels(self.beam, factor), factor * self.width)

    def within(self, values: FloatArray) -> FloatArray:
        """Return the part of an array that belongs to the image; its last axes are y and x."""
        m = self.width
        return values[..., m:-m, m:-m]

    def parts(self, source: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return a source of the image, and the beam of the margin, each alone in the whole."""
        image_part = np.zeros_like(self.beam)
        self.within(image_part)[:] = source
        return image_part, np.where(self.beyond, self.beam, 0)

    @cached_property
    def beyond(self) -> BoolArray:
        """True in the margin, shape (H + 2 m, W + 2 m)."""
        beyond = np.ones(self.beam.shape, bool)
        self.within(beyond)[:] = False
        return beyond

    def edge_distance(self, points: AnyArray) -> FloatArray:
        """Return how far inside top, bottom, left, right points (y, x) lie, px, shape (..., 4)."""
        first = self.width - 0.5
        last = np.array(self.beam.shape) - 1 - first
        both = np.stack([points - first, last - points], axis=-1)
        return both.reshape(*points.shape[:-1], 4)


def edge_flux(
    left_behind: FloatArray, arrived: FloatArray, margin: Margin
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the flux that left and entered the image at each side, relative to its source's flux.

    The image's part of the source has landed as `left_behind`, the margin's as `arrived`.
    """
    pixels = np.moveaxis(np.indices(margin.beam.shape), 0, -1)
    nearest = margin.edge_distance(pixels).argmin(axis=-1)
    total = margin.within(margin.beam).sum()

    def by_side(flux: FloatArray) -> dict[str, float]:
        shares = np.bincount(nearest.ravel(), flux.ravel(), minlength=4) / total
        return dict(zip(SIDES, shares.tolist(), strict=True))

    return by_side(np.where(margin.beyond, left_behind, 0)), by_side(
        np.where(margin.beyond, 0, arrived)
    )


RATIO = 4  # sites of a level per site of the next coarser one


def are_middles(sites: FloatArray) -> bool:
    """Return whether sites are the middles of pixels."""
    return bool((sites == np.rint(sites)).all())


@dataclass(frozen=True)
class Mirrored:
    """Sites and the mirror images of those near the image's border, which cover the image."""

    triangulation: RegularTriangulation
    origin: Indices  # the site that each point is, or is the mirror image of
    sense: NDArray[np.int8]  # (y, x): -1 for the axes along which a point was mirrored, else 1


@dataclass(frozen=True, eq=False)
class SiteLevel:
    """The n sites of one level of the multilevel solution."""

    sites: FloatArray  # (n, 2); neighbours in the plane are near in the order, mostly
    mass: FloatArray  # (n,): flux of the source in each Voronoi cell, S(V_i) of the paper
    centroids: FloatArray  # (n, 2): centres of that flux; the sites after many Lloyd steps
    triangulation: RegularTriangulation  # Delaunay's; copy it before changing weights
    shape: tuple[int, int]  # (H, W) of the source
    lloyd_iterations: int

    @classmethod
    def of(
        cls, triangulation: RegularTriangulation, source: Density, threads: int | None = None
    ) -> SiteLevel:
        """Return the level of a triangulation's sites, as they are, over a source."""
        if are_middles(triangulation.sites):
            source = source.resolved(threads)
        diagram = PowerDiagram(triangulation, source, with_moments=True, threads=threads)
        masses, centroids = diagram.masses, diagram.centroids
        return cls(triangulation.sites, masses, centroids, triangulation, source.shape, 0)

    @property
    def spacing(self) -> float:
        """Mean distance between neighbours, sqrt(area of the image / n), in px."""
        return _spacing(self.shape, len(self.sites))

    @cached_property
    def is_of_pixels(self) -> bool:
        """Whether the sites are the middles of pixels, whose cells of the source are the pixels."""
        return are_middles(self.sites)

    @cached_property
    def mirrored(self) -> Mirrored:
        """The sites with those near the border mirrored across it."""
        # Every border pixel must lie between sites.
        points, origin, sense = with_mirror_images(self.sites, self.shape, 3.0 * self.spacing)
        return Mirrored(
            self.triangulation.with_more(points[len(self.sites) :]),
            origin.astype(np.int32),
            sense.astype(np.int8),
        )

    def split(self, factor: int) -> SiteLevel:
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


class Levels(Sequence[SiteLevel]):
    """Levels, coarse to fine, each computed on first use; a slice shares them.

    >>> levels = plan_levels(np.ones((60, 60)), 3600, lloyd_iterations=2).levels
    >>> levels.counts, len(levels[1].sites), [len(level.sites) for level in levels[:2]]
    ((225, 900, 3600), 900, [225, 900])
    """

    def __init__(
        self,
        counts: tuple[int, ...],
        make: Callable[[int, Reporter], SiteLevel],
        slots: MutableMapping[int, _Slot] | None = None,
        report: Reporter | None = None,
    ) -> None:
        self.counts = counts
        self._make = make
        self._slots: MutableMapping[int, _Slot] = {} if slots is None else slots
        self._report = report or Reporter()

    @property
    def is_complete(self) -> bool:
        """Whether only the levels of `counts` are available."""
        return self._make is _refuse_level

    def __len__(self) -> int:
        return len(self.counts)

    @overload
    def __getitem__(self, number: int) -> SiteLevel: ...

    @overload
    def __getitem__(self, number: slice) -> Levels: ...

    def __getitem__(self, number: int | slice) -> SiteLevel | Levels:
        if isinstance(number, slice):
            return Levels(self.counts[number], self._make, self._slots, self._report)
        return self.at(self.counts[number])

    def at(self, count: int) -> SiteLevel:
        """Return the level with `count` sites."""
        slot = self._slots.setdefault(count, _Slot())
        while not slot.lock.acquire(timeout=0.05):
            self._report("sites", 0, None, f"{count:,} sites")
        try:
            if slot.level is None:
                slot.level = self._make(count, self._report)
            return slot.level
        finally:
            slot.lock.release()

    def up_to(self, count: int) -> Levels:
        """Return the levels with fewer than `count` sites, and the level with `count`."""
        counts = (*(level_count for level_count in self.counts if level_count < count), count)
        return Levels(counts, self._make, self._slots, self._report)

    def ending_in_pixels(
        self, source: FloatArray, pixels: BoolArray, threads: int | None = None
    ) -> Levels:
        """Return the coarser levels, and one with a site in the middle of each of some pixels.

        Source and pixels have the shape (H, W).
        """
        n_sites = int(np.count_nonzero(pixels))

        def make(count: int, report: Reporter) -> SiteLevel:
            if count < n_sites:
                return self._make(count, report)
            middles = np.argwhere(pixels).astype(np.float64)
            sites = np.ascontiguousarray(middles[hilbert_order(middles)])
            beam = Density.from_image(source, threads=threads)
            return SiteLevel.of(RegularTriangulation(sites, region=beam.region), beam, threads)

        counts = (*(count for count in self.counts if count < n_sites), n_sites)
        return Levels(counts, make, ChainMap({n_sites: _Slot()}, self._slots), self._report)

    def with_reporter(self, report: Reporter | None) -> Levels:
        """Return the same levels with another report for those still to be computed."""
        return Levels(self.counts, self._make, self._slots, report)

    def compute_all(self, threads: int | None = None) -> Levels:
        """Compute all levels; the result offers no others and no longer refers to the source."""
        with self.in_background(threads) as begin:
            # In parallel with the finest level, which takes three times as long as all others.
            begin(self.counts[:-1])
            for count in reversed(self.counts):
                self.at(count)
        return Levels(self.counts, _refuse_level, self._slots)

    @contextmanager
    def in_background(
        self, threads: int | None = None
    ) -> Iterator[Callable[[Sequence[int]], None]]:
        """Yield a function that starts to compute levels, by their counts, in another thread.

        Levels that are not finished at the end of the block are abandoned. After the levels, it
        mirrors the sites of the last one, which a solution of it needs at its end.
        """
        if available_threads(threads) == 1:
            yield lambda counts: None
            return
        abandoned = Event()
        quiet = self.with_reporter(Reporter(None, abandoned.is_set))
        pool = ThreadPoolExecutor(1)

        def begin(counts: Sequence[int]) -> None:
            for count in counts:
                if count not in self._slots:
                    self._report("sites", 0, None, f"{count:,} sites")
                    pool.submit(quiet.at, count)
            if counts:
                pool.submit(lambda: quiet.at(counts[-1]).mirrored)

        try:
            yield begin
        finally:
            abandoned.set()
            pool.shutdown(cancel_futures=True)


def _refuse_level(count: int, report: Reporter) -> SiteLevel:
    raise LookupError(f"there is no level of {count:,} sites")


@dataclass
class _Slot:
    """A level, computed or in preparation."""

    lock: Any = field(default_factory=Lock, repr=False)
    level: SiteLevel | None = None


@dataclass(frozen=True, eq=False)
class SitePlan:
    """Sites of a source on all levels, which do not depend on the image."""

    source: FloatArray  # (H, W)
    levels: Levels
    mask: BoolArray | None = None  # where the source is known; elsewhere it keeps cells together
    # Where the boundary is free, the sites cover it too, and the levels' coordinates are its.
    margin: Margin | None = None
    unit: float = 1.0  # flux of the source that the levels' masses count as 1
    measured: bool = True  # whether the source was recorded; else it is an estimate
    pixels: Levels | None = None  # up to one with a site in each lit pixel, if the source is smooth

    @property
    def margin_width(self) -> int:
        """Offset in px of the levels' coordinates relative to the image's."""
        return 0 if self.margin is None else self.margin.width

    def within(self, values: FloatArray) -> FloatArray:
        """Return the image's part of an array that covers image and margin."""
        return values if self.margin is None else self.margin.within(values)


@njit(nogil=True, cache=True)
def _reject_by_brightness(source: FloatArray, shift: FloatArray, sites: FloatArray) -> None:
    """Throw points of an even sequence at the source; keep them by its brightness."""
    # The positions are the Kronecker sequence of the real root of x³ = x + 1, which leaves
    # fewer gaps and clumps than independent random points; the golden ratio's decides
    # which ones to keep.
    root = 1.3247179572447460
    golden = 1.6180339887498949
    height, width = source.shape
    brightest = source.max()
    accepted = number = 0
    while accepted < len(sites):
        number += 1
        u = (shift[0] + number / root) % 1.0
        v = (shift[1] + number / root**2) % 1.0
        threshold = (shift[2] + number / golden) % 1.0
        y = u * height
        x = v * width
        if threshold * brightest < source[min(int(y), height - 1), min(int(x), width - 1)]:
            sites[accepted, 0] = y - 0.5
            sites[accepted, 1] = x - 0.5
            accepted += 1


def sample_sites(source: FloatArray, n_sites: int, seed: int = 0) -> FloatArray:
    """Deploy sites by rejection, in Hilbert order; the seed shifts the sequence of positions."""
    sites = np.empty((n_sites, 2))
    shift = np.random.default_rng(seed).random(3)
    _reject_by_brightness(np.ascontiguousarray(source, dtype=np.float64), shift, sites)
    return np.ascontiguousarray(sites[hilbert_order(sites)])


def lloyd(
    triangulation: RegularTriangulation,
    source: Density,
    *,
    iterations: int,
    tolerance: float = 0.0,
    threads: int | None = None,
    report: Callable[[int], None] | None = None,
) -> tuple[PowerDiagram, int]:
    """Move each site repeatedly to the centroid of its Voronoi cell.

    The triangulation, without weights, moves with the sites, until their r.m.s. distance from the
    centroids is below the tolerance, in units of their mean spacing. `report` receives the
    number of steps. Returns the diagram with moments, and the number of steps.
    """
    near = tolerance * _spacing(source.shape, len(triangulation.sites))
    step = 0
    while True:
        if report is not None:
            report(step)
        diagram = PowerDiagram(triangulation, source, with_moments=True, threads=threads)
        sites, centroids = triangulation.sites, diagram.centroids
        # A site stays where there is light: in the dark its cell may lose all of it, and have a
        # centroid of nothing but rounding errors.
        last = np.array(source.image.shape) - 1
        is_lit = np.all((centroids > -0.5) & (centroids < last + 0.5), axis=1)
        places = np.clip(np.rint(centroids), 0, last).astype(np.int64)
        is_lit &= source.image[tuple(places.T)] > 0
        centroids = np.where(np.expand_dims(is_lit, 1), centroids, sites)
        moves = centroids - sites
        away = np.sqrt(np.einsum("na,na->", moves, moves) / len(moves))
        if step == iterations or away < near:
            return diagram, step
        del diagram, moves  # before the next one is made: they are large
        triangulation.move(centroids, threads=available_threads(threads))
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
    coarsest: int = 600,
) -> SitePlan:
    """Plan levels over a source; the finest has `n_sites`, others a quarter of the next.

    The solver can start from zero weights with as many sites as the `coarsest`, or fewer.
    """
    counts = [n_sites]
    while counts[-1] > coarsest:
        counts.append(max(4, counts[-1] // RATIO))

    @lru_cache(maxsize=1)
    def density() -> Density:
        return Density.from_image(source, threads=threads)

    def level(count: int, report: Reporter) -> SiteLevel:
        beam = density()

        def on_step(step: int) -> None:
            report("sites", step, lloyd_iterations, f"{count:,} sites, Lloyd relaxation")

        sites = sample_sites(source, count, seed)
        triangulation = RegularTriangulation(sites, region=beam.region, alive=partial(on_step, 0))
        diagram, steps = lloyd(
            triangulation,
            beam,
            iterations=lloyd_iterations,
            tolerance=lloyd_tolerance,
            threads=threads,
            report=on_step,
        )
        if count == n_sites:
            density.cache_clear()  # it is large, and others are seldom made after the finest
        sites, masses, centroids = triangulation.sites, diagram.masses, diagram.centroids
        triangulation.forget()
        return SiteLevel(sites, masses, centroids, triangulation, beam.shape, steps)

    return SitePlan(source, Levels(tuple(reversed(counts)), level))
