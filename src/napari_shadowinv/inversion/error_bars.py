"""Error bars: how image noise affects the retrieved field.

- error bars for the potential and the displacement at every pixel: `uncertainty`
- result: `Uncertainty`

The noise is added to the image once more, again and again, and each such sample is inverted
on the same sites, from the weights of the image itself. The scatter of the samples is the
scatter that repeated shots of the same object would have (the parametric bootstrap).

References
----------
B. Efron and R. J. Tibshirani, *An Introduction to the Bootstrap* (Chapman & Hall, 1993),
chapter 6; B. P. Welford, Technometrics 4, 419 (1962), for the running sums.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.machine import available_threads, physical_memory
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._typing import AnyArray, BoolArray, FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.inversion._invert import invert, plan_sites
from napari_shadowinv.inversion.labels import dataset_from_field, label
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.inversion.readout import read_out
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.transport.objective import TransportObjective
from napari_shadowinv.transport.sites import SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, solve

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

__all__ = ["Uncertainty", "uncertainty"]

Draw = Callable[[np.random.Generator], FloatArray]

_SAMPLE_SHARE = 0.2  # of the noise's flux errors that a sample may leave unsolved
_LOOSEST_TOLERANCE = 0.1
_MOST_QUANTA = 1e18  # numpy draws no larger Poisson numbers
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
        in the mean over the border, the deviation is that of the difference to the border.
    displacement_mean, displacement_std : ndarray, shape (2, H, W)
        The same of the displacement, px, for each component.
    n : int
        Number of samples. The deviations themselves are known to 1 / √(2 (n - 1)): 16 % for 20.
    noise : str
        The noise that was assumed.
    tolerance : float
        Largest relative flux error of a cell that was allowed in a sample.
    iterations, residuals, converged : tuple of int, of float, of bool
        Of each sample: solver steps, largest relative flux error of a cell, tolerance met.
    warnings : tuple of str
        Reasons to doubt the deviations.
    """

    inversion: Inversion
    potential_mean: FloatArray
    potential_std: FloatArray
    displacement_mean: FloatArray
    displacement_std: FloatArray
    n: int
    noise: str
    tolerance: float
    iterations: tuple[int, ...]
    residuals: tuple[float, ...]
    converged: tuple[bool, ...]
    warnings: tuple[str, ...]

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
            ``…_std`` beside each potential, displacement and field. How the samples were made is
            a JSON text in the attribute ``uncertainty``.
        """
        samples = ("n", "noise", "tolerance", "iterations", "residuals", "converged", "warnings")
        history = json.dumps({name: getattr(self, name) for name in samples})
        dataset = self.inversion.to_dataset(
            setup, attributes={"uncertainty": history, **(attributes or {})}
        )
        means = {"potential": self.potential_mean, "displacement": self.displacement_mean}
        scatter = dataset_from_field(self.displacement_std, self.potential_std, setup)
        # each is its argument times a number, perhaps negative, perhaps with axes exchanged
        deviations = {str(name): np.abs(field.values) for name, field in scatter.items()}

        def beside(name: str, what: str, values: FloatArray) -> tuple[Any, ...]:
            field = dataset[name]
            long_name = f"{field.attrs['long_name']}, {what} of noisy samples"
            return field.dims, values, label(field.attrs["units"], long_name)

        return dataset.assign(
            {f"{name}_mean": beside(name, "mean", values) for name, values in means.items()}
            | {
                f"{name}_std": beside(name, "standard deviation", values)
                for name, values in deviations.items()
            }
        )


def uncertainty(
    image: ArrayLike,
    n: int = 20,
    *,
    source: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    noise: Literal["poisson"] | float | ArrayLike = "poisson",
    gain: float | None = None,
    options: InversionOptions | None = None,
    plan: SitePlan | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Uncertainty:
    """Estimate the uncertainty of potential and displacement due to image noise.

    Each sample is the image with fresh noise on top, inverted like the image. All have the
    image's own noise in common, so their scatter is that of one dose of noise: the standard
    deviation that shots of the same object would show. It is no distance from the truth: what a
    retrieval gets wrong without noise (an unknown source, an object at the edge, folds behind
    caustics) is not in it.

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
        Noise is taken as independent from pixel to pixel. Samples that it drives below zero are
        clipped there, whatever `options.negative` says of the image.
    gain : float, optional
        Of Poisson noise only: the image's units that one detected quantum makes; a pixel of
        value v then scatters by √(gain · v). Default: 1 for an image of whole numbers, which are
        taken as counts; any other image needs it.

    Returns
    -------
    Uncertainty

    Raises
    ------
    InputError
        If the image cannot be inverted, or `n`, `noise` or `gain` make no sense with it.
    InversionCancelled
        If `should_stop` returned true.

    Examples
    --------
    >>> counts = np.random.default_rng(0).poisson(400, (24, 24))
    >>> found = uncertainty(counts, n=4)
    >>> found.potential_std.shape, found.converged
    ((24, 24), (True, True, True, True))
    """
    options = options or InversionOptions()
    if not isinstance(n, int | np.integer) or isinstance(n, bool) or n < 2:
        raise InputError(f"n is {n!r}, expected a whole number of samples, at least 2")
    draw, described = _noise_of(image, noise, gain, mask if plan is None else plan.mask)
    if plan is None:
        beam = prepare(image, source, options, mask).source
        plan = plan_sites(
            beam, options, mask=mask, on_progress=on_progress, should_stop=should_stop
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
    sampling = _Sampling(plan, inversion.weights, draw, clipping)
    sampling = sampling.to_tolerance_of_noise(seeds[0])
    potential, displacement = _RunningMoments(), _RunningMoments()
    solutions: list[LevelSolution] = []

    def keep(sample: _Sample) -> None:
        potential.add(sample.potential)
        displacement.add(sample.displacement)
        solutions.append(sample.solution)

    _in_order(sampling.sample, seeds, workers, keep, Reporter(on_progress, should_stop))
    warnings = inversion.report.warnings
    if failed := sum(not solution.converged for solution in solutions):
        warnings = (
            f"{failed} of {len(solutions)} samples did not converge: the deviations are "
            "unreliable where the samples scatter most",
            *warnings,
        )
    return Uncertainty(
        inversion=inversion,
        potential_mean=potential.mean,
        potential_std=potential.std,
        displacement_mean=displacement.mean,
        displacement_std=displacement.std,
        n=int(n),
        noise=described,
        tolerance=sampling.options.tolerance,
        iterations=tuple(solution.iterations for solution in solutions),
        residuals=tuple(solution.residual for solution in solutions),
        converged=tuple(solution.converged for solution in solutions),
        warnings=warnings,
    )


class _Sample(NamedTuple):
    """One noisy image, inverted."""

    potential: FloatArray
    displacement: FloatArray
    solution: LevelSolution


@dataclass(frozen=True)
class _Sampling:
    """Everything that the samples share."""

    plan: SitePlan
    start: FloatArray
    draw: Draw
    options: InversionOptions

    def sample(self, seed: np.random.SeedSequence, report: Reporter) -> _Sample:
        """Invert one noisy image, without what the image alone needs (re-projection, caustics)."""
        image = self._image(seed)
        plan = self.plan
        solution = solve(
            plan.levels, image, self.options, report, start=self.start, margin=plan.margin
        )[-1]
        potential, displacement = (
            plan.within(values) for values in read_out(plan, solution, self.options)
        )
        return _Sample(potential - border_mean(potential), displacement, solution)

    def to_tolerance_of_noise(self, seed: np.random.SeedSequence) -> _Sampling:
        """Ask of the solver no more than what matters beside the flux errors that noise makes."""
        # What it leaves unsolved is white, and moves the field far less than the flux that it
        # did move: where a fifth is left in the worst cell, a sample's field is within 3 % of
        # its change, and the deviation of many within 0.2 %.
        level = self.plan.levels[-1]
        objective = TransportObjective(
            level.triangulation.copy(),
            level.mass,
            Density.from_image(self._image(seed)),
            threads=self.options.threads,
        )
        by_noise = objective.residual(objective.diagram(self.start))
        loosest = min(_SAMPLE_SHARE * by_noise, _LOOSEST_TOLERANCE)
        tolerance = max(loosest, self.options.tolerance)
        return replace(self, options=self.options.model_copy(update={"tolerance": tolerance}))

    def _image(self, seed: np.random.SeedSequence) -> FloatArray:
        noisy = self.draw(np.random.default_rng(seed))
        return prepare(noisy, self.plan.source, self.options, self.plan.mask).floored_image


class _RunningMoments:
    """Mean and standard deviation of arrays that are not kept."""

    def __init__(self) -> None:
        self._count = 0
        self.mean = self._squares = np.zeros(())

    def add(self, values: FloatArray) -> None:
        self._count += 1
        before = values - self.mean
        self.mean = self.mean + before / self._count
        self._squares = self._squares + before * (values - self.mean)

    @property
    def std(self) -> FloatArray:
        return np.asarray(np.sqrt(self._squares / (self._count - 1)))


def _noise_of(
    image: ArrayLike, noise: object, gain: float | None, mask: ArrayLike | None
) -> tuple[Draw, str]:
    """Return what draws a noisy image, and what to call it; the image itself is checked later."""
    values = np.asarray(image)
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
        return _poisson(values, gain)
    if gain is not None:
        raise InputError(
            f"gain is {gain!r} and noise a standard deviation: gain belongs to noise='poisson'"
        )
    return _gaussian(values, np.asarray(noise), usable)


def _poisson(values: FloatArray, gain: float | None) -> tuple[Draw, str]:
    if gain is None:
        if np.any(values != np.rint(values)):
            raise InputError(
                "image has values that are not whole numbers, so they are not counts: give the "
                "gain (image units per detected quantum), or the noise as a standard deviation"
            )
        gain = 1.0
    if not (np.isreal(gain) and 0 < gain < np.inf):
        raise InputError(f"gain is {gain!r}, expected a positive number: image units")
    quanta = np.maximum(values, 0) / gain
    if quanta.max(initial=0) > _MOST_QUANTA:
        raise InputError(
            f"gain is {gain:g} and the brightest pixel {values.max():g}: that is more than "
            f"{_MOST_QUANTA:g} quanta in a pixel, expected fewer: check the unit of the gain"
        )
    return lambda rng: gain * rng.poisson(quanta), f"Poisson, gain {gain:g}"


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
    return lambda rng: values + deviation * rng.normal(size=values.shape), described


def _workers(options: InversionOptions, n_sites: int, n_pixels: int) -> int:
    """Samples to work on at once: one a thread, as far as they fit in half of the memory."""
    threads = available_threads(options.threads)
    memory = physical_memory()
    if memory is None:
        return threads
    needed = n_sites * _BYTES_PER_SITE + n_pixels * _BYTES_PER_PIXEL
    return max(1, min(threads, memory // 2 // needed))


def _in_order(
    work: Callable[[np.random.SeedSequence, Reporter], _Sample],
    seeds: list[np.random.SeedSequence],
    workers: int,
    keep: Callable[[_Sample], None],
    report: Reporter,
) -> None:
    """Work on a few seeds at once and hand over the samples in the order of the seeds."""
    # Only this thread reports and asks whether to stop: what listens need not expect others.
    abandoned = Event()
    waiting: deque[Future[_Sample]] = deque()
    done = 0

    def keep_first() -> None:
        nonlocal done
        while not wait([waiting[0]], timeout=_POLL_SECONDS).done:
            report("samples", done, len(seeds))
        keep(waiting.popleft().result())
        done += 1
        report("samples", done, len(seeds))

    with ThreadPoolExecutor(workers) as pool:
        try:
            for seed in seeds:
                waiting.append(pool.submit(work, seed, Reporter(None, abandoned.is_set)))
                if len(waiting) > workers:  # one more is ready to be begun
                    keep_first()
            while waiting:
                keep_first()
        finally:
            abandoned.set()
