"""Error bars: how image noise and an instrument that is not exact affect the retrieved field.

- error bars for the potential and the displacement at every pixel: `uncertainty`
- result: `Uncertainty`, with a `Quantity` for each number that is derived from the field

Each sample is the image with another draw of noise, inverted on the same sites. The scatter of the
samples is the scatter of repeated shots of the same object (the parametric bootstrap). Where an
instrument is stated, its imperfections are drawn and removed from image and source: that is where
the truth may be, and the sample is its mirror image about the inversion. The linear response of the
solved transport to a small change of the image costs one linear system with a matrix that all
samples share; to solve the transport again costs a few, each with its own. An instrument's
imperfections are larger than noise, so with them the first 24 linear samples are solved as well,
and correct the mean, the deviation and the skewness of all (control variates).

References
----------
B. Efron and R. J. Tibshirani, *An Introduction to the Bootstrap* (Chapman & Hall, 1993),
chapter 6; C. Lemieux, *Monte Carlo and Quasi-Monte Carlo Sampling* (Springer, 2009), chapter 4, for
the correction of cheap samples by a few that are solved, and chapter 5 for Latin hypercubes.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, field, replace
from functools import partial, reduce
from itertools import chain, islice
from operator import add
from statistics import NormalDist
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import stdtrit

from napari_shadowinv._system.arrays import unpack_array, unpack_shot
from napari_shadowinv._system.machine import available_threads, physical_memory
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Summarised, percent, to_figures
from napari_shadowinv.geometry.interpolation import WIDTH
from napari_shadowinv.instrument.effects import InstrumentDraws, RecordedShot
from napari_shadowinv.inversion._invert import invert, plan_sites
from napari_shadowinv.inversion.normalise import bytes_per_pixel, prepare
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.inversion.samples import (
    FullResampling,
    LinearResampling,
    Pairs,
    Scatter,
    Seed,
    correct,
    noise_of,
    stratified_numbers,
)
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.options import BeamPrior, Instrument, InversionOptions
from napari_shadowinv.physics.edge import edge_changes
from napari_shadowinv.physics.setup import Setup
from napari_shadowinv.physics.significance import PixelErrors
from napari_shadowinv.physics.units import label
from napari_shadowinv.transport.sites import SitePlan

if TYPE_CHECKING:
    import xarray

Result = TypeVar("Result")

_CHECKED, _SOLVED = 3, 3 * WIDTH  # linear samples that are solved, too; with an instrument
_LINEAR_ENOUGH, _CORRECTABLE = 0.3, 0.6  # of their change
_MAX_BEAM_RMS = 0.9
_ENOUGH_FOR_QUANTILES = 40
_POLL_SECONDS = 0.1
_BYTES_PER_SITE, _BYTES_PER_PIXEL = 700, 150  # measured peaks of one sample, rounded up


QuantityOf = Callable[[FloatArray, FloatArray], ArrayLike]
Quantities = Mapping[str, QuantityOf] | Callable[[FloatArray], Mapping[str, QuantityOf]]


# Of a maximum of many equal values: its mean grows as the deviation of the noise, which samples,
# with the noise of the inversion and their own, have √2 times.
_BIAS_OF_MAXIMUM = 1 / (np.sqrt(2) - 1)
# The share of it that is uncertain; bands of one, two and many equal values hold 59 to 87 and 92 to
# 96 % of the truths.
_UNSURE_BIAS = 0.5


@dataclass(frozen=True)
class Maximum:
    """A function of potential and displacement that returns a maximum over places, such as a peak.

    Its bands take a stronger bias by noise into account (`Quantity.bias`).
    """

    measure: QuantityOf

    def __call__(self, potential: FloatArray, displacement: FloatArray) -> ArrayLike:
        return self.measure(potential, displacement)


@dataclass(frozen=True)
class Quantity:
    """A number, or an array of them, that is derived from the field.

    Attributes
    ----------
    value : ndarray
        Of the inversion.
    samples : ndarray, shape (n, ...)
        Of each sample.
    is_maximum : bool
        Whether it is a maximum over places.
    """

    value: FloatArray
    samples: FloatArray
    is_maximum: bool = False

    @property
    def std(self) -> FloatArray:
        """Standard deviation of the samples, of a maximum with half of its bias."""
        deviation = self.samples.std(axis=0, ddof=1)
        return np.asarray(np.hypot(deviation, _UNSURE_BIAS * self.bias * self.is_maximum))

    @property
    def bias(self) -> FloatArray:
        """Mean of the samples less the value, which noise and instrument add on average.

        Of a maximum 2.4 times as much: noise picks the largest of many nearly equal values, as
        around a ring, but the inversion, from which samples start, has one maximum by its noise.
        """
        added = np.asarray(self.samples.mean(axis=0) - self.value)
        return _BIAS_OF_MAXIMUM * added if self.is_maximum else added

    def band(self, share: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Return the lower and the upper end of the interval with a share of probability.

        Samples stray from the inversion as the inversion does from the truth, so the samples'
        interval is mirrored at the value (the basic bootstrap). It corrects a bias, such
        as that of a maximum, which noise raises. With fewer than 40 samples, as in a fit,
        it is Student's interval for the next sample, which takes their spread as normal.

        Raises
        ------
        InputError
            If the share is not between 0 and 1.
        """
        tails = (1 + _checked_share(share)) / 2, (1 - share) / 2
        count = len(self.samples)
        if 1 < count < _ENOUGH_FOR_QUANTILES:
            middle = self.value - self.bias
            width = stdtrit(count - 1, tails[0]) * np.sqrt(1 + 1 / count) * self.std
            return np.asarray(middle - width), np.asarray(middle + width)
        mirrored = self.mirrored()
        low, high = np.quantile(mirrored, tails[::-1], axis=0, method="weibull")
        return np.asarray(low), np.asarray(high)

    def mirrored(self) -> FloatArray:
        """Return values that are as likely as the true one, shape (n, ...).

        Samples mirrored at the value; of a maximum about the value less its bias.
        """
        if not self.is_maximum:
            return np.asarray(2 * self.value - self.samples)
        about_mean = self.samples - self.samples.mean(axis=0)
        spread = np.maximum(self.samples.std(axis=0, ddof=1), np.finfo(np.float64).tiny)
        return np.asarray(self.value - self.bias - self.std / spread * about_mean)


def _checked_share(share: float) -> float:
    if not 0 < share < 1:
        raise InputError(f"share is {share!r}, expected a number between 0 and 1, such as 0.95")
    return share


@dataclass(frozen=True, repr=False)
class Uncertainty(Summarised):
    """An inversion with its scatter due to image noise, and to its instrument if stated.

    Attributes
    ----------
    inversion : Inversion
        Of the image itself, with `displacement_std` as its pixel errors.
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
        Deviation of linear samples from solved ones, as a share of the change (r.m.s. over the
        image); 0 where all were solved.
    spread_ratio : float
        Size of the changes in those solved samples relative to the linear ones (r.m.s.); 1 where
        all were solved. With an instrument, means and deviations are corrected by it.
    mean_shift : float
        Difference of their means, relative to the r.m.s. standard deviation; 0 where all were
        solved. With an instrument, means are corrected by it.
    imperfections : tuple of str
        What adds to the noise: what is drawn of the instrument, such as "background, 5 %", and
        "edge".
    quantities : dict of str to Quantity
        Numbers derived from the field, by their names.
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
    spread_ratio: float
    mean_shift: float
    imperfections: tuple[str, ...]
    quantities: dict[str, Quantity]
    tolerance: float
    iterations: tuple[int, ...]
    residuals: tuple[float, ...]
    converged: tuple[bool, ...]
    warnings: tuple[Caution, ...]

    def _summary(self) -> list[str]:
        drawn = ", ".join((self.noise, *self.imperfections))
        shown = str(self.inversion.headline), f"{self.n} samples, {self.method}: {drawn}"
        return [*shown, *(caution.text for caution in self.warnings)]

    def _picture(self) -> FloatArray:
        return np.where(self.inversion.mask, np.hypot(*self.displacement_std), np.nan)

    def band(self, share: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Return the displacement's lower and upper end at every pixel, (2, H, W) each, px.

        The interval of normal errors with a share of probability around the inversion less its
        bias.

        Raises
        ------
        InputError
            If the share is not between 0 and 1.
        """
        field = self.inversion.displacement
        return _band(field, self.displacement_mean, self.displacement_std, share)

    def potential_band(self, share: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Return the same for the potential, (H, W) each, px²."""
        return _band(self.inversion.potential, self.potential_mean, self.potential_std, share)

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
        names: tuple[str, ...] = ("n", "noise", "method", "nonlinearity", "tolerance")
        names += ("spread_ratio", "mean_shift", "imperfections")
        names += ("iterations", "residuals", "converged")
        values: dict[str, Any] = {name: getattr(self, name) for name in names}
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


def _band(
    value: FloatArray, mean: FloatArray, std: FloatArray, share: float
) -> tuple[FloatArray, FloatArray]:
    middle, width = 2 * value - mean, NormalDist().inv_cdf((1 + _checked_share(share)) / 2) * std
    return middle - width, middle + width


def uncertainty(
    image: ArrayLike,
    n: int = 200,
    *,
    source: ArrayLike | None = None,
    mask: ArrayLike | None = None,
    noise: Literal["poisson"] | float | ArrayLike = "poisson",
    method: Literal["linear", "resolve"] = "linear",
    options: InversionOptions | None = None,
    instrument: Instrument | None = None,
    quantities: Quantities | None = None,
    plan: SitePlan | None = None,
    on_progress: OnProgress | None = None,
    should_stop: ShouldStop | None = None,
) -> Uncertainty:
    """Estimate the uncertainty of potential and displacement due to noise and instrument.

    Each sample is the image with fresh noise on top, inverted like the image. All share the image's
    own noise, so their scatter is the effect of one dose of noise: the standard deviation that
    shots of the same object would show. With an instrument, each sample also draws its
    imperfections (beam, background, gamma, blur, absorption, registration, another field) and is
    the mirror image, about the inversion, of the field without them. Where the object goes on
    beyond the edge, what may lie there is added.
    Other errors are not included (folds behind caustics).

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
        its square root: a pixel of value v by √(u · v), with the options' `units_per_quantum` u.
        Default of u: 1 for an image of whole numbers, which are taken as counts; any other
        image needs it. Else the standard deviation of Gaussian noise, in the image's units.
        Gaussian noise is correlated between pixels as measured in the image.
        Samples that it drives below zero are clipped there, whatever `options.negative` says of
        the image.
    method : {"linear", "resolve"}
        ``"linear"``: by the linear response of the transport. Three samples that are solved as well
        check it; with an instrument, 24 correct the mean and the deviation. ``"resolve"``: solve
        the transport of each sample, which takes many times as long; for caustics and strong noise.
    instrument : Instrument, optional
        How well beam, detector and alignment are known. If it states no beam, a source that was not
        recorded is taken to be off as in the error budget. Default: samples draw noise alone.
    quantities : dict of str to callable, or callable, optional
        Numbers whose error bars are needed: functions of potential, (H, W), and displacement,
        (2, H, W), that return a number or an array: a line profile, the mean of a region, an
        integral, a peak. Several threads may call them at once. A function that returns the
        dictionary is called with the changes of the potential in a few samples, (k, H, W), from
        which it may choose a smoothing. Of a maximum give a `Maximum`.

    Returns
    -------
    Uncertainty

    Raises
    ------
    InputError
        If the image cannot be inverted, or `n`, `noise`, `method`, `instrument` or `quantities`
        make no sense.
    InversionCancelled
        If `should_stop` returned true.

    Examples
    --------
    >>> counts = np.random.default_rng(0).poisson(400, (24, 24))
    >>> result = uncertainty(counts, n=4)
    >>> result.potential_std.shape, result.n, result.converged
    ((24, 24), 4, (True, True, True))
    >>> peak = {"peak": Maximum(lambda potential, displacement: np.hypot(*displacement).max())}
    >>> result = uncertainty(counts, n=20, instrument={"blur": 1.0}, quantities=peak)
    >>> result.imperfections
    ('beam, 5 %', 'blur, 1 px')
    >>> low, high = result.quantities["peak"].band(0.95)
    >>> bool(low < high)
    True
    """
    options = as_model(InversionOptions, options, "options")
    if instrument is not None:
        instrument = as_model(Instrument, instrument, "instrument")
    check_instance(plan, SitePlan, "plan")
    choose = _quantity_choice(quantities)
    if not isinstance(n, int | np.integer) or isinstance(n, bool) or n < 2:
        raise InputError(f"n is {n!r}, expected a whole number of samples, at least 2")
    if method not in ("linear", "resolve"):
        raise InputError(f"method is {method!r}, expected 'linear' or 'resolve'")
    if plan is None:
        image, source, mask = unpack_shot(image, source, mask)
    check_memory(np.shape(image), bytes_per_pixel(options), "an inversion")
    draw_noise, noise_text = noise_of(
        image, noise, options.units_per_quantum, mask if plan is None else plan.mask
    )
    callbacks: Any = {"on_progress": on_progress, "should_stop": should_stop}
    if plan is None:
        beam, measured = prepare(image, source, options, mask).source, source is not None
        plan = plan_sites(beam, options, mask=mask, measured=measured, **callbacks)
        source = mask = None
    inversion = invert(
        image,
        source=source,
        mask=mask,
        options=options,
        instrument=instrument,
        plan=plan,
        **callbacks,
    )
    if not np.array_equal(inversion.source, plan.source):  # it was moved
        plan = plan_sites(inversion.source, options, mask=plan.mask)
    correlation = _correlation_of(inversion, noise)
    if correlation and not isinstance(noise, str):
        noise_text += f", correlated over {to_figures(correlation)} px"
    seeds = np.random.SeedSequence(options.seed).spawn(int(n))
    draws = None if instrument is None else _draws(image, inversion, plan)
    resampling = _resampling(
        inversion, plan, lambda rng: draw_noise(rng, correlation), options, draws, seeds
    )
    sampler = _Sampler(
        resampling,
        np.stack([inversion.potential, *inversion.displacement]),
        _changes_by_edge(inversion),
        _workers(options, len(inversion.cells.sites), inversion.image.size),
        options,
        choose if quantities else None,
    )
    report = Reporter(on_progress, should_stop)
    if method == "resolve":
        samples = sampler.resolve(seeds, report)
    else:
        clean = prepare(image, plan.source, resampling.options, plan.mask).floored_image
        samples = sampler.respond(seeds, clean, report, Reporter(None, should_stop))
    return _summarised(inversion, samples, sampler, noise_text, method)


def _correlation_of(inversion: Inversion, noise: Any) -> float:
    """Return the width over which noise is drawn correlated, px."""
    errors = inversion.errors
    # Structure that hides the noise does not correlate noise that is stated.
    is_known = errors is not None and not (errors.noise_is_bound and np.ndim(noise) == 0)
    return errors.noise_correlation if errors is not None and is_known else 0.0


def _resampling(
    inversion: Inversion,
    plan: SitePlan,
    draw_noise: Callable[[np.random.Generator], FloatArray],
    options: InversionOptions,
    draws: InstrumentDraws | None,
    seeds: list[Seed],
) -> FullResampling:
    """Return the solver of samples with their draws of noise and instrument."""
    workers = _workers(options, len(inversion.cells.sites), inversion.image.size)
    # The threads are shared out among the samples; what noise drives below zero is clipped.
    threads = max(1, available_threads(options.threads) // workers)
    clipping = options.model_copy(update={"threads": threads, "negative": "clip"})
    plan = replace(plan, levels=plan.levels.up_to(len(inversion.cells.weights)))
    resampling = FullResampling(plan, inversion.cells.weights, draw_noise, clipping)
    resampling = resampling.to_tolerance_of_noise(seeds[0])
    if draws is None:
        return resampling
    rng = np.random.default_rng([options.seed, *b"instrument"])
    numbers = stratified_numbers(rng, len(seeds), draws.count)
    return replace(resampling, instrument=draws, numbers=numbers)


class _Samples(NamedTuple):
    """The scatter of samples, and linear ones beside those that were solved."""

    scatter: Scatter
    pairs: Pairs | None
    of_solved: list[dict[str, FloatArray]]
    solutions: list[tuple[int, float, bool]]  # iterations, residual, converged


@dataclass
class _Sampler:
    """Draws samples, and measures the quantities, which are chosen by the first of them."""

    resampling: FullResampling
    fields: FloatArray  # potential and displacement of the inversion, (3, H, W)
    by_edge: FloatArray  # (k, 3, H, W)
    workers: int
    options: InversionOptions
    choose: Callable[[FloatArray], Mapping[str, QuantityOf]] | None
    functions: Mapping[str, QuantityOf] = field(default_factory=dict)

    def measure(self, change: FloatArray, seed: Seed) -> dict[str, FloatArray]:
        """Return the quantities of a sample, with objects beyond the edge."""
        rng = np.random.default_rng([self.options.seed, *b"edge", *seed.spawn_key])
        beyond = np.tensordot(rng.normal(size=len(self.by_edge)), self.by_edge, 1)
        return _measure(self.functions, self.fields, change + beyond)

    @property
    def asked(self) -> Callable[[FloatArray, Seed], dict[str, FloatArray]] | None:
        """Function that measures the quantities; None if there are none."""
        return None if self.choose is None else self.measure

    def _choose(self, changes: FloatArray) -> None:
        if self.choose is not None and not self.functions:
            self.functions = dict(self.choose(changes))

    def _solve(
        self, seeds: list[Seed], report: Reporter, solutions: list[tuple[int, float, bool]]
    ) -> Iterator[FloatArray]:
        # Without imperfections that it may have, the image shows where the truth may be.
        sign = 1 if self.resampling.instrument is None else -1
        blocks = [[seed] for seed in seeds]
        for fields, solution in _in_order(self.resampling.sample, blocks, self.workers, report):
            solutions.append((solution.iterations, solution.residual, solution.converged))
            yield sign * (fields - self.fields)

    def resolve(self, seeds: list[Seed], report: Reporter) -> _Samples:
        """Solve all samples."""
        solutions: list[tuple[int, float, bool]] = []
        head = list(self._solve(seeds[:_CHECKED], report, solutions))
        self._choose(np.array([change[0] for change in head]))
        changes = chain(head, self._solve(seeds[_CHECKED:], report, solutions))
        asked = self.asked
        parts = (
            Scatter.of(change, asked and asked(change, seed))
            for change, seed in zip(changes, seeds, strict=True)
        )
        return _Samples(reduce(add, parts), None, [], solutions)

    def respond(
        self, seeds: list[Seed], clean: FloatArray, report: Reporter, quietly: Reporter
    ) -> _Samples:
        """Take the linear response of all samples, and solve the first for comparison."""
        is_noise_alone = self.resampling.instrument is None
        response = _in_thread(
            lambda: LinearResampling(self.resampling, clean, self.options.threads, self.asked),
            quietly,
        )
        checked = seeds[: _CHECKED if is_noise_alone else _SOLVED]
        solutions: list[tuple[int, float, bool]] = []
        solved = self._solve(checked, quietly if is_noise_alone else report, solutions)
        pairs, of_solved = None, []
        for block in _blocks(checked):
            linear = _in_thread(partial(response.changes, block), quietly)
            self._choose(linear[:, 0])
            for seed, pair in zip(
                block, map(Pairs.of, linear, islice(solved, len(block))), strict=True
            ):
                pairs = pair if pairs is None else pairs + pair
                if self.asked is not None and not is_noise_alone:
                    of_solved.append(self.measure(pair.solved, seed))
        parts = _in_order(response.scatter, _blocks(seeds), self.workers, report)
        return _Samples(reduce(add, parts), pairs, of_solved, solutions)


def _summarised(
    inversion: Inversion,
    samples: _Samples,
    sampler: _Sampler,
    noise_text: str,
    method: Literal["linear", "resolve"],
) -> Uncertainty:
    """Return the answer of samples; linear ones of an instrument are corrected by those solved."""
    scatter, pairs, draws = samples.scatter, samples.pairs, sampler.resampling.instrument
    mean, std, of_samples = scatter.mean, scatter.std, _joined(scatter.quantities)
    check = {"nonlinearity": 0.0, "spread_ratio": 1.0, "mean_shift": 0.0}
    if pairs is not None:
        check = {name: getattr(pairs.part(np.s_[1:]), name) for name in check}
    if draws is not None and pairs is not None:
        mean, std = mean + pairs.shift, std * pairs.factor
        for name, exact in _joined(samples.of_solved).items():
            of_samples[name] = correct(of_samples[name], exact.astype(np.float64))
    mean = sampler.fields + mean
    std = np.sqrt(std**2 + (sampler.by_edge**2).sum(axis=0))
    values = _measure(sampler.functions, sampler.fields, np.zeros_like(sampler.fields))
    edge = ("edge",) * bool(len(sampler.by_edge))
    names = (*(() if draws is None else draws.names), *edge)
    iterations, residuals, converged = zip(*samples.solutions, strict=True)
    return Uncertainty(
        inversion=replace(inversion, pixel_errors=PixelErrors(std[1:], ("noise", *names))),
        potential_mean=mean[0],
        potential_std=std[0],
        displacement_mean=mean[1:],
        displacement_std=std[1:],
        n=scatter.count,
        noise=noise_text,
        method=method,
        **check,
        imperfections=names,
        quantities={
            name: Quantity(value, of_samples[name], isinstance(sampler.functions[name], Maximum))
            for name, value in values.items()
        },
        tolerance=sampler.resampling.options.tolerance,
        iterations=iterations,
        residuals=residuals,
        converged=converged,
        warnings=_doubts(inversion, check["nonlinearity"], converged, draws is not None),
    )


def _doubts(
    inversion: Inversion, nonlinearity: float, converged: Sequence[bool], has_instrument: bool
) -> tuple[Caution, ...]:
    warnings = inversion.report.warnings
    # With an instrument, samples are corrected for what is not linear, as far as that is small.
    if nonlinearity > (_CORRECTABLE if has_instrument else _LINEAR_ENOUGH):
        cause = "noise and instrument" if has_instrument else "noise"
        text = (
            f"the response to {cause} is not linear: samples that were solved differ by "
            f"{percent(nonlinearity)} of what these change; use the method 'resolve'"
        )
        warnings = (Caution("samples", text), *warnings)
    if failed := converged.count(False):
        text = (
            f"{failed} of {len(converged)} samples that were solved did not converge: the "
            "deviations are unreliable where the samples scatter most"
        )
        warnings = (Caution("samples", text), *warnings)
    return warnings


def _quantity_choice(
    quantities: Quantities | None,
) -> Callable[[FloatArray], Mapping[str, QuantityOf]]:
    """Return a function that chooses the quantities by changes of the potential."""
    if callable(quantities):
        return quantities
    functions = {} if quantities is None else quantities
    if not isinstance(functions, Mapping) or not all(map(callable, functions.values())):
        raise InputError(
            f"quantities is {quantities!r}, expected a dictionary of functions of potential and "
            "displacement"
        )
    return lambda _: functions


def _measure(
    quantities: Mapping[str, QuantityOf], fields: FloatArray, change: FloatArray
) -> dict[str, FloatArray]:
    """Return the quantities of fields with a change, (potential, displacement) each."""
    potential, *displacement = fields + change
    moves = np.array(displacement)
    return {name: np.asarray(of(potential, moves)) for name, of in quantities.items()}


def _changes_by_edge(inversion: Inversion) -> FloatArray:
    """Return `edge_changes` of the size in the error budget, (k, 3, H, W); k is 0 without."""
    part = None if inversion.errors is None else inversion.errors.parts.get("edge")
    if part is None:
        return np.empty((0, 3, *inversion.mask.shape))
    changes = edge_changes(inversion.potential, inversion.displacement)
    squares = (changes[:, 1:, inversion.mask] ** 2).sum(axis=(0, 1)).mean()
    return np.asarray(changes * part.rms / np.sqrt(squares))


def _draws(image: ArrayLike, inversion: Inversion, plan: SitePlan) -> InstrumentDraws | None:
    """Return the imperfections to be drawn; None if the instrument is exact."""
    mask, instrument = inversion.mask, inversion.instrument
    if not plan.measured:
        instrument = instrument.without_reference()
    beam = instrument.beam_of(measured=plan.measured, source=inversion.source)
    errors = inversion.errors
    if errors is not None and errors.beam_variation != beam.rms:  # more was seen
        beam = BeamPrior(rms=min(errors.beam_variation, _MAX_BEAM_RMS), length=beam.length)
    shot = RecordedShot(
        image=np.where(mask, unpack_array(image, "image")[0], 0.0),
        source=inversion.source,
        displacement=inversion.displacement,
        mask=mask,
    )
    draws = InstrumentDraws(shot, instrument, beam)
    return draws if draws.names else None


def _joined(samples: Sequence[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return each quantity of all samples, (n, ...)."""
    names = samples[0] if samples else {}
    return {name: np.array([sample[name] for sample in samples]) for name in names}


def _blocks(seeds: list[Seed]) -> list[list[Seed]]:
    return [seeds[start : start + WIDTH] for start in range(0, len(seeds), WIDTH)]


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
