"""Error bars: how image noise affects the retrieved field.

- error bars for the potential and the displacement at every pixel: `uncertainty`
- result: `Uncertainty`
- random samples of an image with noise: `noise_of`
- inversion of each sample, by a new solution of its transport: `FullResampling`; by the linear
  response of the image's own transport: `LinearResampling`

Each sample is the image with another draw of noise, and is inverted on the same sites. The
scatter of the samples is the scatter of repeated shots of the same object (the parametric
bootstrap). The linear response of the solved transport to a small change of the image costs one
linear system with a matrix that all samples share; to solve the transport again costs a few, each
with its own.

References
----------
B. Efron and R. J. Tibshirani, *An Introduction to the Bootstrap* (Chapman & Hall, 1993),
chapter 6.
"""

from __future__ import annotations

import json
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, reduce
from operator import add
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from napari_shadowinv._system.arrays import plain_array, unpack_array, unpack_shot
from napari_shadowinv._system.machine import available_threads, physical_memory
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.interpolation import WIDTH
from napari_shadowinv.geometry.power_diagram import pixel_shares
from napari_shadowinv.inversion._invert import invert, plan_sites
from napari_shadowinv.inversion.normalise import bytes_per_pixel, flooring_for, prepare
from napari_shadowinv.inversion.readout import LinearReadout, read_out
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.physics.units import label
from napari_shadowinv.transport.linear import FactorisedLaplacian, LaplacianSolver
from napari_shadowinv.transport.minimise import TransportObjective
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target, solve

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

__all__ = [
    "Draw",
    "FullResampling",
    "LinearResampling",
    "Sample",
    "Scatter",
    "Seed",
    "Uncertainty",
    "noise_of",
    "uncertainty",
]


Draw = Callable[[np.random.Generator, float], FloatArray]
"""Returns a noisy image, with noise that a Gaussian of some standard deviation (px) correlates."""

_BLUR_REACH = 4.0  # standard deviations
_MOST_QUANTA = 1e18  # numpy draws no larger Poisson numbers


def noise_of(
    image: ArrayLike, noise: object, units_per_quantum: float | None, mask: ArrayLike | None
) -> tuple[Draw, str]:
    """Return a function that draws a noisy image, and a text that describes the noise."""
    values = np.asarray(unpack_array(image, "image")[0])
    if values.dtype.kind not in "buif":
        raise InputError(f"image has values of type {values.dtype}, expected real numbers")
    usable = np.isfinite(values)
    if mask is not None and np.shape(mask) == values.shape:
        usable &= np.asarray(mask, dtype=bool)
    values = np.where(usable, values, 0.0)
    if isinstance(noise, str):
        if noise != "poisson":
            raise InputError(
                f"noise is {noise!r}, expected 'poisson', a standard deviation or an array of them"
            )
        return _poisson(values, units_per_quantum)
    if units_per_quantum is not None:
        raise InputError(
            f"units per quantum are {units_per_quantum!r} and noise a standard deviation: "
            "they belong to Poisson noise"
        )
    return _gaussian(values, np.asarray(plain_array(noise, "noise")), usable)


def _poisson(values: FloatArray, units_per_quantum: float | None) -> tuple[Draw, str]:
    if units_per_quantum is None:
        if np.any(values != np.rint(values)):
            raise InputError(
                "image has values that are not whole numbers, so they are not counts: give the "
                "image units per detected quantum, or the noise as a standard deviation"
            )
        units_per_quantum = 1.0
    if not (np.isreal(units_per_quantum) and 0 < units_per_quantum < np.inf):
        raise InputError(
            f"units per quantum are {units_per_quantum!r}, expected a positive number: image units"
        )
    quanta = np.maximum(values, 0) / units_per_quantum
    if quanta.max(initial=0) > _MOST_QUANTA:
        raise InputError(
            f"units per quantum are {units_per_quantum:g} and the brightest pixel is "
            f"{values.max():g}: that is more than {_MOST_QUANTA:g} quanta in a pixel, expected "
            "fewer: check the unit"
        )
    # A blur leaves the counting noise of many pixels as it was.
    text = f"Poisson, {units_per_quantum:g} per quantum"
    return lambda rng, blur: units_per_quantum * rng.poisson(quanta), text


def _gaussian(values: FloatArray, sigma: AnyArray, usable: BoolArray) -> tuple[Draw, str]:
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
    return lambda rng, blur: values + deviation * _normal(rng, values.shape, blur), described


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
_MOST_FACTORISED = 300_000  # sites; their factors take 0.2 GB and two seconds
_LINEAR_TOLERANCE = 0.02
_ROWS = 64  # read out between two calls of `should_stop`


class Sample(NamedTuple):
    """One noisy image, inverted."""

    field: FloatArray  # potential and displacement, (3, H, W)
    solution: LevelSolution


@dataclass(frozen=True)
class FullResampling:
    """Solution of the transport of each sample on a plan's finest level, from start weights."""

    plan: SitePlan
    start: FloatArray
    draw: Callable[[np.random.Generator], FloatArray]
    options: InversionOptions

    def sample(self, seeds: list[Seed], report: Reporter) -> Sample:
        """Invert the noisy image of one seed, without caustics and other results."""
        (seed,) = seeds
        image = self.image(seed)
        plan = self.plan
        solution = solve(
            plan.levels, image, self.options, report, start=self.start, margin=plan.margin
        )[-1]
        potential, displacement = (
            plan.within(values) for values in read_out(solution, self.options)
        )
        return Sample(np.stack([potential - border_mean(potential), *displacement]), solution)

    def to_tolerance_of_noise(self, seed: Seed) -> FullResampling:
        """Loosen the tolerance to a share of the flux errors by noise."""
        # The remaining error is white, and moves the field far less than the flux that the solver
        # has moved: where a fifth remains in the worst cell, a sample's field is within 3 % of
        # its change, and the deviation of many within 0.2 %.
        level = self.plan.levels[-1]
        objective = TransportObjective(
            level.triangulation.copy(),
            level.mass,
            Density.from_image(self.image(seed)),
            threads=self.options.threads,
        )
        by_noise = objective.residual(objective.diagram(self.start))
        loosest = min(_SAMPLE_SHARE * by_noise, _LOOSEST_TOLERANCE)
        tolerance = max(loosest, self.options.tolerance)
        return replace(self, options=self.options.model_copy(update={"tolerance": tolerance}))

    def image(self, seed: Seed) -> FloatArray:
        """Draw a noisy image, as the transport sees it."""
        return self._apply_floor(self.draw(np.random.default_rng(seed)))

    @cached_property
    def _apply_floor(self) -> Callable[[FloatArray], FloatArray]:
        return flooring_for(self.plan.source, self.options, self.plan.mask)


@dataclass(frozen=True)
class Scatter:
    """Sums over samples of changes of (potential, displacement), (3, H, W)."""

    # Changes are relative to the image's field, so sums of squares lose no digits.
    count: int
    sums: FloatArray
    squares: FloatArray

    @classmethod
    def of(cls, change: FloatArray) -> Scatter:
        return cls(1, change, change**2)

    def __add__(self, other: Scatter) -> Scatter:
        return Scatter(
            self.count + other.count, self.sums + other.sums, self.squares + other.squares
        )

    @property
    def mean(self) -> FloatArray:
        return self.sums / self.count

    @property
    def std(self) -> FloatArray:
        variance = (self.squares - self.sums * self.mean) / (self.count - 1)
        return np.sqrt(np.maximum(variance, 0))


class LinearResampling:
    """Linear response of an inversion to the changes of the image in its samples."""

    def __init__(self, samples: FullResampling, image: FloatArray, threads: int | None) -> None:
        self._samples, self._image = samples, image
        plan, level = samples.plan, samples.plan.levels[-1]
        objective = Target.of(image, plan.margin, samples.options).objective(level)
        diagram = objective.diagram(samples.start)
        self._shares = pixel_shares(diagram, level.shape, threads=threads)
        self._network = diagram.laplacian(), objective.ground(samples.start)
        self._factors = None
        if len(level.sites) <= _MOST_FACTORISED:
            with suppress(RuntimeError):  # the multigrid reports it if it fails as well
                self._factors = FactorisedLaplacian(*self._network)
        self._readout = LinearReadout(plan, level, threads)
        self._solvers = threading.local()  # each has vectors of its own

    def scatter(self, seeds: list[Seed], report: Reporter) -> Scatter:
        """Sum the changes by up to `WIDTH` noisy images, in order."""
        values = self._at_sites(seeds, report)
        sums, squares = np.zeros((2, 3, *self._image.shape))
        for start in range(0, len(self._image), _ROWS):
            report("samples", 0)
            self._readout.add(values, sums, squares, start, _ROWS)
        return Scatter(len(seeds), sums, squares)

    def changes(self, seeds: list[Seed]) -> FloatArray:
        """Return changes of potential and displacement by up to `WIDTH` images, (k, 3, H, W)."""
        values = self._at_sites(seeds, Reporter())
        return np.array([self._readout.field(values[..., k]) for k in range(len(seeds))])

    def _at_sites(self, seeds: list[Seed], report: Reporter) -> FloatArray:
        plan = self._samples.plan
        change = np.zeros(plan.levels[-1].shape)
        lacking = np.zeros((self._shares.shape[0], WIDTH))
        for sample, seed in enumerate(seeds):
            report("samples", 0)
            plan.within(change)[:] = self._image - self._samples.image(seed)
            lacking[:, sample] = self._shares @ change.ravel()
        return self._readout.at_sites(self._solve(lacking, report))

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


Result = TypeVar("Result")

_CHECKED = 3  # linear samples that are solved, too
_LINEAR_ENOUGH = 0.3  # of their change
_POLL_SECONDS = 0.1
_BYTES_PER_SITE, _BYTES_PER_PIXEL = 700, 150  # measured peaks of one sample, rounded up


@dataclass(frozen=True)
class Uncertainty:
    """An inversion with its scatter due to image noise.

    Attributes
    ----------
    inversion : Inversion
        Of the image itself.
    potential_mean, potential_std : ndarray, shape (H, W)
        Mean and standard deviation of the samples' potentials, px². As each potential is zero
        in the mean over the border, the deviation refers to the difference to the border.
    displacement_mean, displacement_std : ndarray, shape (2, H, W)
        The same for the displacement, px, for each component.
    n : int
        Number of samples. The deviations themselves are known to 1 / √(2 (n - 1)): 16 % for 20.
    noise : str
        Assumed noise.
    method : {"linear", "resolve"}
        How samples were inverted.
    nonlinearity : float
        Deviation of linear samples from solved ones, as a share of the change by noise (r.m.s. over
        the image); 0 where all were solved.
    tolerance : float
        Largest relative flux error of a cell that was allowed in a sample that was solved.
    iterations, residuals, converged : tuple of int, of float, of bool
        Of each sample that was solved, which of linear ones are the first few: solver steps,
        largest relative flux error of a cell, tolerance met.
    warnings : tuple of Caution
        Reasons to doubt the deviations.
    """

    inversion: Inversion
    potential_mean: FloatArray
    potential_std: FloatArray
    displacement_mean: FloatArray
    displacement_std: FloatArray
    n: int
    noise: str
    method: str
    nonlinearity: float
    tolerance: float
    iterations: tuple[int, ...]
    residuals: tuple[float, ...]
    converged: tuple[bool, ...]
    warnings: tuple[Caution, ...]

    def to_dataset(
        self, setup: Setup | None = None, *, attributes: Mapping[str, str] | None = None
    ) -> xarray.Dataset:
        """Return the inversion and the scatter of its noisy samples as one dataset.

        Parameters
        ----------
        setup, attributes
            As of `Inversion.to_dataset`.

        Returns
        -------
        xarray.Dataset
            As of `Inversion.to_dataset`, with ``potential_mean``, ``displacement_mean`` and a
            ``…_std`` for each potential, displacement and field. The method of the samples is a
            JSON text in the attribute ``uncertainty``.
        """
        samples: tuple[str, ...] = ("n", "noise", "method", "nonlinearity", "tolerance")
        samples += ("iterations", "residuals", "converged")
        values = {name: getattr(self, name) for name in samples}
        values["warnings"] = [asdict(caution) for caution in self.warnings]
        history = json.dumps(values)
        dataset = self.inversion.to_dataset(
            setup, attributes={"uncertainty": history, **(attributes or {})}
        )
        means = {"potential": self.potential_mean, "displacement": self.displacement_mean}
        scatter = dataset_from_field(self.displacement_std, self.potential_std, setup)
        # each is its argument times a number, perhaps negative, perhaps with axes exchanged
        deviations = {str(name): np.abs(field.values) for name, field in scatter.items()}

        def statistic(name: str, quantity: str, values: FloatArray) -> tuple[Any, ...]:
            field = dataset[name]
            long_name = f"{field.attrs['long_name']}, {quantity} of noisy samples"
            return field.dims, values, label(field.attrs["units"], long_name)

        return dataset.assign(
            {f"{name}_mean": statistic(name, "mean", values) for name, values in means.items()}
            | {
                f"{name}_std": statistic(name, "standard deviation", values)
                for name, values in deviations.items()
            }
        )


def uncertainty(
    image: ArrayLike,
    n: int = 200,
    *,
    source: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    noise: Literal["poisson"] | float | ArrayLike = "poisson",
    units_per_quantum: float | None = None,
    method: Literal["linear", "resolve"] = "linear",
    options: InversionOptions | None = None,
    plan: SitePlan | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Uncertainty:
    """Estimate the uncertainty of potential and displacement due to image noise.

    Each sample is the image with fresh noise on top, inverted like the image. All share the image's
    own noise, so their scatter is the effect of one dose of noise: the standard deviation that
    shots of the same object would show. It is no distance from the truth: it does not include
    errors without noise (an unknown source, an object at the edge, folds behind caustics).

    Parameters
    ----------
    image : array_like, shape (H, W)
        The shot, as it was recorded: before filters, which correlate and weaken its noise.
    n : int
        Number of samples, at least two.
    source, mask, options, plan, on_progress, should_stop
        As of `invert`. Random numbers come from the options' `seed`; samples are worked on side
        by side in its `threads`, as far as memory has room, which does not change the result.
    noise : "poisson" or float or array_like of shape (H, W)
        ``"poisson"``: each pixel counts quanta (photons, protons), whose number scatters by
        its square root. Else the standard deviation of Gaussian noise, in the image's units.
        Gaussian noise is correlated between pixels as measured in the image.
        Samples that it drives below zero are clipped there, whatever `options.negative` says of
        the image.
    units_per_quantum : float, optional
        Of Poisson noise only: the image's units that one detected quantum makes; a pixel of
        value v then scatters by √(units_per_quantum · v). Default: 1 for an image of
        whole numbers, which are taken as counts; any other image needs it.
    method : {"linear", "resolve"}
        ``"linear"``: by the linear response of the transport, which a few samples that are solved
        as well check. ``"resolve"``: solve the transport of each sample, which takes many times as
        long; for caustics and strong noise.

    Returns
    -------
    Uncertainty

    Raises
    ------
    InputError
        If the image cannot be inverted, or `n`, `noise`, `units_per_quantum` or `method` make no
        sense.
    InversionCancelled
        If `should_stop` returned true.

    Examples
    --------
    >>> counts = np.random.default_rng(0).poisson(400, (24, 24))
    >>> result = uncertainty(counts, n=4)
    >>> result.potential_std.shape, result.n, result.converged
    ((24, 24), 4, (True, True, True))
    """
    options = as_model(InversionOptions, options, "options")
    check_instance(plan, SitePlan, "plan")
    if not isinstance(n, int | np.integer) or isinstance(n, bool) or n < 2:
        raise InputError(f"n is {n!r}, expected a whole number of samples, at least 2")
    if method not in ("linear", "resolve"):
        raise InputError(f"method is {method!r}, expected 'linear' or 'resolve'")
    if plan is None:
        image, source, mask = unpack_shot(image, source, mask)
    check_memory(np.shape(image), bytes_per_pixel(options), "an inversion")
    draw_noise, noise_text = noise_of(
        image, noise, units_per_quantum, mask if plan is None else plan.mask
    )
    if plan is None:
        beam = prepare(image, source, options, mask).source
        plan = plan_sites(
            beam,
            options,
            mask=mask,
            measured=source is not None,
            on_progress=on_progress,
            should_stop=should_stop,
        )
        source = mask = None
    inversion = invert(
        image,
        source=source,
        mask=mask,
        options=options,
        plan=plan,
        on_progress=on_progress,
        should_stop=should_stop,
    )
    seeds = np.random.SeedSequence(options.seed).spawn(int(n))
    workers = _workers(options, len(inversion.sites), inversion.image.size)
    # The threads are shared out among the samples; what noise drives below zero is clipped.
    threads = max(1, available_threads(options.threads) // workers)
    clipping = options.model_copy(update={"threads": threads, "negative": "clip"})
    levels = plan.levels.up_to(len(inversion.weights))
    correlation = 0.0 if inversion.errors is None else inversion.errors.noise_correlation
    if correlation and not isinstance(noise, str):
        noise_text += f", correlated over {correlation:.2g} px"
    resampling = FullResampling(
        replace(plan, levels=levels),
        inversion.weights,
        lambda rng: draw_noise(rng, correlation),
        clipping,
    )
    resampling = resampling.to_tolerance_of_noise(seeds[0])
    report = Reporter(on_progress, should_stop)
    image_fields = np.stack([inversion.potential, *inversion.displacement])
    outcomes: list[tuple[int, float, bool]] = []

    def solve_samples(seeds: list[Seed], report: Reporter) -> Iterator[FloatArray]:
        for sample in _in_order(resampling.sample, [[seed] for seed in seeds], workers, report):
            solution = sample.solution  # large, so not stored
            outcomes.append((solution.iterations, solution.residual, solution.converged))
            yield sample.field - image_fields

    off = 0.0
    if method == "resolve":
        scatter = reduce(add, map(Scatter.of, solve_samples(seeds, report)))
    else:
        quietly = Reporter(None, should_stop)
        checked = np.array(list(solve_samples(seeds[:_CHECKED], quietly)))
        clean = prepare(image, plan.source, clipping, plan.mask).floored_image
        response = _in_thread(lambda: LinearResampling(resampling, clean, options.threads), quietly)
        linear = _in_thread(lambda: response.changes(seeds[:_CHECKED]), quietly)
        off = _relative_length(linear[:, 1:] - checked[:, 1:], checked[:, 1:])
        del checked, linear
        blocks = [seeds[start : start + WIDTH] for start in range(0, len(seeds), WIDTH)]
        scatter = reduce(add, _in_order(response.scatter, blocks, workers, report))
    mean, std = image_fields + scatter.mean, scatter.std
    warnings = inversion.report.warnings
    if off > _LINEAR_ENOUGH:
        text = (
            f"the response to noise is not linear: samples that were solved differ by "
            f"{off:.0%} of what the noise changes; use the method 'resolve'"
        )
        warnings = (Caution("samples", text), *warnings)
    iterations, residuals, converged = zip(*outcomes, strict=True)
    if failed := converged.count(False):
        text = (
            f"{failed} of {len(converged)} samples that were solved did not converge: the "
            "deviations are unreliable where the samples scatter most"
        )
        warnings = (Caution("samples", text), *warnings)
    return Uncertainty(
        inversion=inversion,
        potential_mean=mean[0],
        potential_std=std[0],
        displacement_mean=mean[1:],
        displacement_std=std[1:],
        n=int(n),
        noise=noise_text,
        method=method,
        nonlinearity=off,
        tolerance=resampling.options.tolerance,
        iterations=iterations,
        residuals=residuals,
        converged=converged,
        warnings=warnings,
    )


def _relative_length(part: FloatArray, reference: FloatArray) -> float:
    """Return the length of one vector relative to another."""
    length = float(np.linalg.norm(reference))
    return float(np.linalg.norm(part)) / length if length > 0 else 0.0


def _workers(options: InversionOptions, n_sites: int, n_pixels: int) -> int:
    """Return the number of parallel samples: one a thread, within half of the memory."""
    threads = available_threads(options.threads)
    memory = physical_memory()
    if memory is None:
        return threads
    needed = n_sites * _BYTES_PER_SITE + n_pixels * _BYTES_PER_PIXEL
    return max(1, min(threads, memory // 2 // needed))


def _in_thread(work: Callable[[], Result], report: Reporter) -> Result:
    """Work in another thread, and abandon it if this one is asked to stop."""
    pool = ThreadPoolExecutor(1)
    try:
        future = pool.submit(work)
        while not wait([future], timeout=_POLL_SECONDS).done:
            report("samples", 0)
        return future.result()
    finally:
        pool.shutdown(wait=False)


def _in_order(
    work: Callable[[list[Seed], Reporter], Result],
    blocks: list[list[Seed]],
    workers: int,
    report: Reporter,
) -> Iterator[Result]:
    """Work on a few blocks of seeds at once and yield their results in the order of the seeds."""
    # Only this thread reports and asks whether to stop: callbacks are called from no other.
    abandoned = Event()
    waiting: deque[Future[Result]] = deque()
    sizes = deque(map(len, blocks))
    done, total = 0, sum(sizes)
    with ThreadPoolExecutor(workers) as pool:
        try:
            for number, block in enumerate(blocks):
                waiting.append(pool.submit(work, block, Reporter(None, abandoned.is_set)))
                # One more is queued than the workers can start.
                while len(waiting) > (workers if number + 1 < len(blocks) else 0):
                    while not wait([waiting[0]], timeout=_POLL_SECONDS).done:
                        report("samples", done, total)
                    yield waiting.popleft().result()
                    done += sizes.popleft()
                    report("samples", done, total)
        finally:
            abandoned.set()
