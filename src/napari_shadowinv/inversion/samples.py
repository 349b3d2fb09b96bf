"""Random samples of an inversion: images with noise, by an instrument that is not exact.

- random images with noise: `noise_of`
- inversion of each sample, by a new solution of its transport: `FullResampling`; by the linear
  response of the image's own transport: `LinearResampling`
- sums over samples: `Scatter`
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from operator import add

import numpy as np
from scipy import ndimage
from scipy.special import ndtri

from napari_shadowinv._system.machine import physical_memory
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import to_figures
from napari_shadowinv.geometry.compiler import njit
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.interpolation import WIDTH
from napari_shadowinv.geometry.power_diagram import PowerDiagram, pixel_shares
from napari_shadowinv.instrument.effects import InstrumentDraws
from napari_shadowinv.inversion.error_bars import Linearity
from napari_shadowinv.inversion.normalise import flooring_for
from napari_shadowinv.inversion.plans import SpreadBeam, plan_on
from napari_shadowinv.inversion.readout import LinearReadout, read_out
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.arrays import plain_array
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.linear import FactorisedLaplacian, LaplacianSolver
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target, solve

Draw = Callable[[np.random.Generator], FloatArray]
"""Returns a noisy image."""

_BLUR_REACH = 4.0  # standard deviations
_MOST_QUANTA = 1e18  # numpy draws no larger Poisson numbers


def noise_of(
    image: FloatArray,
    noise: object,
    units_per_quantum: float | None,
    usable: BoolArray,
    blur: float = 0.0,
) -> tuple[Draw, str]:
    """Return a function that draws a noisy image, and a text that describes the noise.

    Gaussian noise is correlated as by a Gaussian `blur`, px.
    """
    if isinstance(noise, str):
        if noise != "poisson":
            raise InputError(
                f"noise is {noise!r}, expected 'poisson', a standard deviation or an array of them"
            )
        return _poisson(image, units_per_quantum)
    if units_per_quantum is not None:
        raise InputError(
            f"options state {units_per_quantum:g} units per quantum and noise is a standard "
            "deviation, expected one of them: units per quantum imply Poisson noise"
        )
    return _gaussian(image, np.asarray(plain_array(noise, "noise")), usable, blur)


def _poisson(values: FloatArray, units_per_quantum: float | None) -> tuple[Draw, str]:
    if units_per_quantum is None:
        if np.any(values != np.rint(values)):
            raise InputError(
                "image has values that are not whole numbers, so they are not counts: give the "
                "image units per detected quantum, or the noise as a standard deviation"
            )
        units_per_quantum = 1.0
    quanta = np.maximum(values, 0) / units_per_quantum
    if quanta.max(initial=0) > _MOST_QUANTA:
        raise InputError(
            f"units per quantum are {units_per_quantum:g} and the brightest pixel is "
            f"{values.max():g}: that is more than {_MOST_QUANTA:g} quanta in a pixel, expected "
            "fewer: check the unit"
        )
    text = f"Poisson, {units_per_quantum:g} per quantum"
    return lambda rng: units_per_quantum * rng.poisson(quanta), text


def _gaussian(
    values: FloatArray, sigma: AnyArray, usable: BoolArray, blur: float
) -> tuple[Draw, str]:
    if sigma.dtype.kind not in "uif":
        raise InputError(
            f"noise has values of type {sigma.dtype}, expected 'poisson', a standard deviation "
            "or an array of them"
        )
    if sigma.ndim > 0 and sigma.shape != values.shape:
        raise InputError(
            f"noise has shape {sigma.shape}, image {values.shape}: they must match, or give one "
            "number for all pixels"
        )
    deviation = np.where(usable, sigma, 0.0)
    if not (np.isfinite(deviation).all() and (deviation >= 0).all() and deviation.any()):
        raise InputError(
            "noise is zero everywhere, or somewhere negative or not finite: expected standard "
            "deviations in the image's units"
        )
    described = f"Gaussian, {sigma:g}" if sigma.ndim == 0 else "Gaussian, pixel by pixel"
    if blur:
        described += f", correlated over {to_figures(blur)} px"
    return lambda rng: values + deviation * _normal(rng, values.shape, blur), described


def _normal(rng: np.random.Generator, shape: tuple[int, ...], blur: float) -> FloatArray:
    """Normal noise of deviation 1, correlated as by a Gaussian blur (px)."""
    if not blur > 0:
        return rng.normal(size=shape)
    reach = math.ceil(_BLUR_REACH * blur)
    kernel = np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * blur**2))
    kernel /= np.sqrt((kernel**2).sum())
    noise: FloatArray = rng.normal(size=[side + 2 * reach for side in shape])
    for axis in (0, 1):
        noise = ndimage.correlate1d(noise, kernel, axis)
    return noise[reach:-reach, reach:-reach]


Seed = np.random.SeedSequence

_SAMPLE_SHARE = 0.2  # of the noise's flux errors that a sample may leave unsolved
_LOOSEST_TOLERANCE = 0.1
_MOST_FACTORISED = 1_100_000  # sites; their factors take 0.9 GB and half a minute
_BYTES_FACTORISED = 1_300  # a site, at most, while they are factorised
_LINEAR_TOLERANCE = 0.02
_ROWS = 64  # read out between two calls of `should_stop`


Measure = Callable[[FloatArray, Seed], dict[str, FloatArray]]
"""Returns quantities of a sample's change of potential and displacement, (3, H, W), by its seed."""


@dataclass(frozen=True)
class FullResampling:
    """Solution of the transport of each sample on a plan's finest level, from start weights."""

    plan: SitePlan
    start: FloatArray
    recorded: FloatArray  # the image
    draw: Draw
    options: InversionOptions
    instrument: InstrumentDraws | None = None
    numbers: FloatArray = field(default_factory=lambda: np.empty((0, 0)))  # of all samples

    def sample(self, seeds: list[Seed], report: Reporter) -> tuple[FloatArray, LevelSolution]:
        """Return potential and displacement of the noisy image of one seed, (3, H, W)."""
        (seed,) = seeds
        plan, image, scale = self._changed(seed)
        target = Target.of(image, self.options, plan.margin)
        solution = solve(plan.levels, target, report, start=self.start)[-1]
        potential, displacement = (
            plan.within(values) for values in read_out(solution, self.options)
        )
        field = np.stack([potential - border_mean(potential), *displacement])
        return scale * field, solution

    def _changed(self, seed: Seed) -> tuple[SitePlan, FloatArray, float]:
        """Return plan and image of a sample, and the scale of its field."""
        if self.instrument is None:
            return self.plan, self.image(seed), 1.0
        noisy, numbers = self.random(seed)
        shot = self.instrument.shot(numbers)
        plan = plan_on(
            self.plan.levels[-1].triangulation,
            shot.source,
            self.plan.mask,
            self.options,
            measured=self.plan.measured,
        )
        # Light is counted after it was changed, so the noise stays as it is.
        image = self.flooring(plan.source)(shot.image + (noisy - self.recorded))
        return plan, image, 1 + float(self.instrument.scale(numbers))

    def to_tolerance_of_noise(self, seed: Seed) -> FullResampling:
        """Loosen the tolerance to a share of the flux errors by noise."""
        # The remaining error is white, and moves the field far less than the flux that the solver
        # has moved: where a fifth remains in the worst cell, a sample's field is within 3 % of
        # its change, and the deviation of many within 0.2 %.
        level = self.plan.levels[-1]
        target = Target.of(self.image(seed), self.options, self.plan.margin)
        objective = target.objective(level)
        by_noise = objective.residual(objective.diagram(self.start))
        loosest = min(_SAMPLE_SHARE * by_noise, _LOOSEST_TOLERANCE)
        tolerance = max(loosest, self.options.tolerance)
        return replace(self, options=self.options.model_copy(update={"tolerance": tolerance}))

    def image(self, seed: Seed) -> FloatArray:
        """Draw a noisy image, as the transport sees it."""
        noisy, _ = self.random(seed)
        return self.apply_floor(noisy)

    def random(self, seed: Seed) -> tuple[FloatArray, FloatArray]:
        """Draw a noisy image, as recorded, and return the numbers of the instrument."""
        noisy = self.draw(np.random.default_rng(seed))
        return noisy, self.numbers[seed.spawn_key[-1]] if self.numbers.size else np.empty(0)

    @cached_property
    def apply_floor(self) -> Callable[[FloatArray], FloatArray]:
        """Function from a recorded image to what the transport sees of it."""
        return self.flooring(self.plan.source)

    def flooring(self, source: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return that function for another source."""
        return flooring_for(source, self.options, self.plan.mask)


@dataclass(frozen=True)
class Scatter:
    """Sums over samples of changes of (potential, displacement), (3, H, W)."""

    # Changes are relative to the image's field, so sums of squares lose no digits.
    count: int
    sums: FloatArray
    squares: FloatArray
    quantities: tuple[dict[str, FloatArray], ...] = ()  # of each sample

    @classmethod
    def of(cls, change: FloatArray, quantities: dict[str, FloatArray] | None = None) -> Scatter:
        return cls(1, change, change**2, () if quantities is None else (quantities,))

    def __add__(self, other: Scatter) -> Scatter:
        return Scatter(*map(add, vars(self).values(), vars(other).values()))

    @property
    def mean(self) -> FloatArray:
        return self.sums / self.count

    @property
    def std(self) -> FloatArray:
        variance = (self.squares - self.sums * self.mean) / (self.count - 1)
        return np.sqrt(np.maximum(variance, 0))


_LEAST_PAIRS = 8  # below, their deviations are too uncertain to correct any
_CHANCE = 2.0  # a correction counts as far as its square exceeds so many times its variance


@dataclass(frozen=True)
class Pairs:
    """Sums over samples that are known twice: by linear response, and solved.

    Both of a pair have the same noise and instrument, so few of them show how the distributions
    differ: the correction of means has the error of the differences alone.
    """

    count: int
    linear: FloatArray
    solved: FloatArray
    products: FloatArray  # linear², solved², and of both: (3, ...)

    @classmethod
    def of(cls, linear: FloatArray, solved: FloatArray) -> Pairs:
        """Return one pair of samples, of any shape."""
        return cls(1, linear, solved, np.stack([linear**2, solved**2, linear * solved]))

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(*map(add, vars(self).values(), vars(other).values()))

    @property
    def shift(self) -> FloatArray:
        """Difference of the means, solved less linear."""
        return (self.solved - self.linear) / self.count

    @property
    def factor(self) -> FloatArray:
        """Ratio of the deviations, solved over linear; 1 where chance explains it.

        The logarithm of the ratio of two deviations with a correlation ρ scatters by
        √((1 - ρ²) / (n - 1)); it is shrunk as by James and Stein.
        """
        if self.count < _LEAST_PAIRS:
            return np.ones_like(self.linear)
        outer = self.linear**2, self.solved**2, self.linear * self.solved
        of_linear, of_solved, of_both = self.products - np.stack(outer) / self.count
        usable = (of_linear > 0) & (of_solved > 0)
        squares = np.where(usable, of_linear * of_solved, 1.0)
        logarithm = np.log(np.where(usable, of_solved / np.where(usable, of_linear, 1.0), 1.0)) / 2
        unexplained = np.clip(1 - of_both**2 / squares, 0, 1)
        chance = _CHANCE * unexplained / (self.count - 1)
        kept = 1 - np.minimum(1.0, chance / np.maximum(logarithm**2, 1e-300))
        return np.asarray(np.exp(logarithm * np.where(usable, kept, 0.0)))

    def part(self, numbers: slice) -> Pairs:
        """Return the pairs of some of the values along the first axis."""
        linear, solved = self.linear[numbers], self.solved[numbers]
        return Pairs(self.count, linear, solved, self.products[:, numbers])

    @property
    def linearity(self) -> Linearity:
        """How far linear samples are from solved ones."""
        linear, solved, both = (float(each.sum()) for each in self.products)
        gap = math.sqrt(max(linear + solved - 2 * both, 0.0) / solved) if solved > 0 else 0.0
        ratio = math.sqrt(solved / linear) if linear > 0 else 0.0
        squares = float(solved - (self.solved**2).sum() / self.count)
        spread = math.sqrt(max(squares, 0.0) / max(self.count - 1, 1))
        shift = float(np.linalg.norm(self.shift)) / spread if spread > 0 else 0.0
        return Linearity(gap, ratio, shift)


def correct(samples: FloatArray, solved: FloatArray) -> FloatArray:
    """Return linear samples, (n, ...), with mean, deviation and skewness as of solved ones.

    The first samples are those that are solved. Values that are not numbers stay as they are.
    """
    head, kind = np.s_[: len(solved)], samples.dtype
    linear, tiny = samples[head].astype(np.float64), np.finfo(kind).tiny
    pairs = reduce(add, map(Pairs.of, linear, solved))
    middle, deviation = pairs.linear / pairs.count, np.maximum(linear.std(axis=0), tiny)
    moved = samples - middle.astype(kind)
    bent = moved / deviation.astype(kind)
    bent *= bent - (bent[head] ** 3).mean(axis=0)
    moved *= pairs.factor.astype(kind)
    moved += (middle + pairs.shift).astype(kind)
    bent *= _curvature(bent[head], solved - moved[head]).astype(kind)
    bent += moved - bent.mean(axis=0)
    for values in (moved, bent):
        samples = np.where(np.isfinite(values), values, samples)
    return samples


def _curvature(basis: FloatArray, rest: FloatArray) -> FloatArray:
    """Return the strength of a parabola in what is left of samples; 0 where chance explains it."""
    basis = basis - basis.mean(axis=0)
    squares = np.maximum((basis**2).sum(axis=0), 1e-300)
    strength = (basis * rest).sum(axis=0) / squares
    left = ((rest - strength * basis) ** 2).sum(axis=0) / max(len(rest) - 3, 1)
    chance = _CHANCE * left / squares / np.maximum(strength**2, 1e-300)
    return np.asarray(strength * (1 - np.minimum(1.0, chance)) * (len(rest) >= _LEAST_PAIRS))


def stratified_numbers(rng: np.random.Generator, n: int, count: int) -> FloatArray:
    """Return n samples of `count` normal numbers, each with one sample in each n-th of its values.

    One number that moves the whole field is so spread as evenly as many (Latin hypercube). Each has
    mean 0 and standard deviation 1.
    """
    strata = rng.permuted(np.tile(np.arange(n), (count, 1)), axis=1).T
    numbers = np.asarray(ndtri((strata + rng.uniform(size=strata.shape)) / n))
    return (numbers - numbers.mean(axis=0)) / numbers.std(axis=0, ddof=1) if n > 1 else numbers


@njit(nogil=True, cache=True)
def _subtract_product(factors: FloatArray, strengths: FloatArray, values: FloatArray) -> None:
    """Subtract the product of (n, k) and (`WIDTH`, k) from values (n, `WIDTH`) in this thread."""
    by_number = np.ascontiguousarray(strengths.T)
    row = np.empty(WIDTH)
    for i in range(factors.shape[0]):
        for s in range(WIDTH):
            row[s] = values[i, s]
        for k in range(factors.shape[1]):
            factor = factors[i, k]
            for s in range(WIDTH):
                row[s] -= factor * by_number[k, s]
        for s in range(WIDTH):
            values[i, s] = row[s]


class LinearResampling:
    """Linear response of an inversion to the changes of the image in its samples."""

    def __init__(
        self,
        samples: FullResampling,
        threads: int | None,
        measure: Measure | None = None,
    ) -> None:
        self._samples, self._measure = samples, measure
        self._image = image = samples.apply_floor(samples.recorded)
        plan, level = samples.plan, samples.plan.levels[-1]
        objective = Target.of(image, samples.options, plan.margin).objective(level)
        diagram = objective.diagram(samples.start)
        self._shares = pixel_shares(diagram, level.shape, threads=threads)
        self._network = diagram.laplacian(), objective.ground(samples.start)
        self._factors = None
        memory = physical_memory()
        is_room = memory is None or len(level.sites) <= memory // 2 // _BYTES_FACTORISED
        if is_room and len(level.sites) <= _MOST_FACTORISED:
            with suppress(RuntimeError):  # the multigrid reports it if it fails as well
                laplacian, ground = self._network
                self._factors = FactorisedLaplacian(laplacian, ground)
        self._readout = LinearReadout(plan, level, threads)
        self._solvers = threading.local()  # each has vectors of its own
        self._gains = None if samples.instrument is None else self._flux_gains(threads)

    def scatter(self, seeds: list[Seed], report: Reporter) -> Scatter:
        """Sum the changes by up to `WIDTH` noisy images, in order."""
        values = self._at_sites(seeds, report)
        sums, squares = np.zeros((2, 3, *self._image.shape))
        for start in range(0, len(self._image), _ROWS):
            report("samples", 0)
            self._readout.add(values, sums, squares, start, _ROWS)
        quantities: tuple[dict[str, FloatArray], ...] = ()
        if self._measure is not None:
            quantities = tuple(map(self._measure, self._fields(values, len(seeds)), seeds))
        return Scatter(len(seeds), sums, squares, quantities)

    def changes(self, seeds: list[Seed]) -> FloatArray:
        """Return changes of potential and displacement by up to `WIDTH` images, (k, 3, H, W)."""
        return np.array(list(self._fields(self._at_sites(seeds, Reporter()), len(seeds))))

    def _fields(self, values: FloatArray, count: int) -> Iterator[FloatArray]:
        return (self._readout.field(values[..., k]) for k in range(count))

    def _at_sites(self, seeds: list[Seed], report: Reporter) -> FloatArray:
        plan, instrument = self._samples.plan, self._samples.instrument
        change = np.zeros(plan.levels[-1].shape)
        lacking = np.zeros((self._shares.shape[0], WIDTH))
        numbers = np.zeros((WIDTH, 0 if instrument is None else instrument.count))
        for sample, seed in enumerate(seeds):
            report("samples", 0)
            noisy, numbers[sample] = self._samples.random(seed)
            plan.within(change)[:] = self._image - self._samples.apply_floor(noisy)
            lacking[:, sample] = self._shares @ change.ravel()
        if instrument is None or self._gains is None:
            return self._readout.at_sites(self._solve(lacking, report))
        strengths = np.where(instrument.is_even, numbers**2, numbers)
        _subtract_product(self._gains, strengths, lacking)
        weights = self._solve(lacking, report)
        weights += self._samples.start[:, None] * instrument.scale(numbers)
        return self._readout.at_sites(-weights)

    def _flux_gains(self, threads: int | None) -> FloatArray:
        """Return the flux that cells gain by each number of the instrument, (n, count)."""
        # What the source gains, cells lack.
        samples, plan, level = self._samples, self._samples.plan, self._samples.plan.levels[-1]
        assert samples.instrument is not None
        options, recorded = samples.options, samples.instrument.recorded
        beam = SpreadBeam.of(plan.source, plan.mask, options).values
        density = Density.from_image(beam, threads=threads)
        diagram = PowerDiagram(level.triangulation, density, threads=threads)
        shares_of_source = pixel_shares(diagram, level.shape, threads=threads)
        gains = np.zeros((len(level.sites), samples.instrument.count))
        for place, step, shot in samples.instrument.steps():
            source = shot.source * (plan.source.sum() / shot.source.sum())
            changed_beam, unit, _ = SpreadBeam.of(source, plan.mask, options)
            of_source = changed_beam * (unit / plan.unit) - beam
            of_image = of_source.copy()  # in a margin
            inner = plan.within(of_image)
            inner[:] = 0.0
            if shot.image is not recorded.image:
                floored = samples.flooring(source)(shot.image)
                inner[:] = floored * (unit / plan.unit) - self._image
            gain = self._shares @ of_image.ravel() - shares_of_source @ of_source.ravel()
            gains[:, place] = gain / step
        return gains

    def _solve(self, right: FloatArray, report: Reporter) -> FloatArray:
        if self._factors is not None:
            return self._factors.solve(right)
        if not hasattr(self._solvers, "multigrid"):
            self._solvers.multigrid = LaplacianSolver(*self._network)
        weights = np.zeros_like(right)
        for sample in np.flatnonzero(right.any(axis=0)):
            report("samples", 0)
            weights[:, sample], _, _ = self._solvers.multigrid.solve(
                right[:, sample].copy(), _LINEAR_TOLERANCE
            )
        return weights
