"""Random samples of an inversion by its noise and its instrument.

- what is drawn: noise, `noise_draw`; the instrument, `instrument_draws`; objects beyond the edge,
  `assumed_changes`
- draw and invert samples, and sum them up: `Sampler`

Each sample is the image with another draw of noise, inverted on the same sites. The scatter of the
samples is the scatter of repeated shots of the same object (the parametric bootstrap). The
imperfections of an instrument are drawn and removed from image and source: that is where the truth
may be, and the sample is its mirror image about the inversion. The linear response of the solved
transport to a small change of the image costs one linear system with a matrix that all samples
share; to solve the transport again costs a few, each with its own. An instrument's imperfections
are larger than noise, so with them the first 24 linear samples are solved as well, and correct the
mean, the deviation and the skewness of all (control variates).

References
----------
B. Efron and R. J. Tibshirani, *An Introduction to the Bootstrap* (Chapman & Hall, 1993),
chapter 6; C. Lemieux, *Monte Carlo and Quasi-Monte Carlo Sampling* (Springer, 2009), chapter 4, for
the correction of cheap samples by a few that are solved, and chapter 5 for Latin hypercubes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from itertools import chain, islice
from operator import add
from threading import Event
from typing import Any, NamedTuple, TypeVar

import numpy as np

from napari_shadowinv._system.machine import available_threads, physical_memory
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry.interpolation import WIDTH
from napari_shadowinv.instrument.effects import InstrumentDraws, RecordedShot
from napari_shadowinv.inversion.error_bars import (
    CORRECTED_LINEARITY,
    NOISE_LINEARITY,
    ErrorSamples,
    Maximum,
    Quantities,
    Quantity,
    QuantityOf,
)
from napari_shadowinv.inversion.error_budget import ErrorBudget
from napari_shadowinv.inversion.noise import ImageNoise
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.inversion.samples import (
    Draw,
    FullResampling,
    LinearResampling,
    Pairs,
    Scatter,
    Seed,
    correct,
    noise_of,
    stratified_numbers,
)
from napari_shadowinv.options import BeamPrior, Instrument, InversionOptions
from napari_shadowinv.physics.edge import edge_changes
from napari_shadowinv.physics.poisson import poisson_invert

Result = TypeVar("Result")

_CHECKED, _SOLVED = 3, 3 * WIDTH  # linear samples that are solved, too; with an instrument
_MAX_BEAM_RMS = 0.9
_POLL_SECONDS = 0.1
_BYTES_PER_SITE, _BYTES_PER_PIXEL = 700, 150  # measured peaks of one sample, rounded up


class _Samples(NamedTuple):
    """The scatter of samples, and linear ones beside those that were solved."""

    scatter: Scatter
    pairs: Pairs | None
    of_solved: list[dict[str, FloatArray]]
    solutions: list[tuple[int, float, bool]]  # iterations, residual, converged


@dataclass
class Sampler:
    """Draws samples, and measures the quantities, which are chosen by the first of them."""

    resampling: FullResampling
    fields: FloatArray  # potential and displacement of the inversion, (3, H, W)
    # Changes of the fields by what is assumed of the edge and of gaps, (k, 3, H, W) each.
    assumed: Mapping[str, FloatArray]
    seeds: list[Seed]
    workers: int
    threads: int | None
    choose: Callable[[FloatArray], Mapping[str, QuantityOf]] | None
    functions: Mapping[str, QuantityOf] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        resampling: FullResampling,
        n: int,
        fields: FloatArray,
        assumed: Mapping[str, FloatArray],
        quantities: Quantities | None,
    ) -> Sampler:
        """Share the threads among `n` samples, draw their instruments, and choose a tolerance."""
        options = resampling.options
        workers = _workers(options, len(resampling.start), resampling.recorded.size)
        # What noise drives below zero is clipped.
        threads = max(1, available_threads(options.threads) // workers)
        clipping = options.model_copy(update={"threads": threads, "negative": "clip"})
        seeds = np.random.SeedSequence(options.seed).spawn(n)
        resampling = replace(resampling, options=clipping).to_tolerance_of_noise(seeds[0])
        if resampling.instrument is not None:
            rng = np.random.default_rng([options.seed, *b"instrument"])
            numbers = stratified_numbers(rng, n, resampling.instrument.count)
            resampling = replace(resampling, numbers=numbers)
        choose = None if quantities is None else _quantity_choice(quantities)
        return cls(resampling, fields, assumed, seeds, workers, options.threads, choose)

    def measure(self, change: FloatArray, seed: Seed) -> dict[str, FloatArray]:
        """Return the quantities of a sample, with objects beyond the edge and in gaps."""
        rng = np.random.default_rng([self.resampling.options.seed, *b"edge", *seed.spawn_key])
        for changes in self.assumed.values():
            change = change + np.tensordot(rng.normal(size=len(changes)), changes, 1)
        return _measure(self.functions, self.fields, change)

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

    def resolve(self, report: Reporter) -> _Samples:
        """Solve all samples."""
        seeds = self.seeds
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

    def respond(self, report: Reporter) -> _Samples:
        """Take the linear response of all samples, and solve the first for comparison."""
        seeds, quietly = self.seeds, Reporter(None, report.should_stop)
        is_noise_alone = self.resampling.instrument is None
        response = _in_thread(
            lambda: LinearResampling(self.resampling, self.threads, self.asked),
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

    def draw(self, method: str, noise: str, report: Reporter) -> ErrorSamples:
        """Draw and invert the samples of some noise; linear ones are corrected by those solved."""
        samples = self.resolve(report) if method == "resolve" else self.respond(report)
        scatter, pairs = samples.scatter, samples.pairs
        mean, std, of_samples = scatter.mean, scatter.std, _joined(scatter.quantities)
        if self.resampling.instrument is not None and pairs is not None:
            mean, std = mean + pairs.shift, std * pairs.factor
            for name, exact in _joined(samples.of_solved).items():
                of_samples[name] = correct(of_samples[name], exact.astype(np.float64))
        mean = self.fields + mean
        squares = sum((changes**2).sum(axis=0) for changes in self.assumed.values())
        std = np.sqrt(std**2 + squares)
        values = _measure(self.functions, self.fields, np.zeros_like(self.fields))
        iterations, residuals, converged = zip(*samples.solutions, strict=True)
        return ErrorSamples(
            potential=self.fields[0],
            displacement=self.fields[1:],
            potential_mean=mean[0],
            potential_std=std[0],
            displacement_mean=mean[1:],
            displacement_std=std[1:],
            n=scatter.count,
            noise=noise,
            method=method,
            linearity=None if pairs is None else pairs.part(np.s_[1:]).linearity,
            tolerance=self.resampling.options.tolerance,
            iterations=iterations,
            residuals=residuals,
            converged=converged,
            quantities={
                name: Quantity(value, of_samples[name], isinstance(self.functions[name], Maximum))
                for name, value in values.items()
            },
        )

    @property
    def causes(self) -> tuple[str, ...]:
        """Causes of the scatter: the noise, parts of the instrument that are drawn, the edge."""
        draws = self.resampling.instrument
        return (
            "noise",
            *(() if draws is None else draws.names),
            *self.assumed,
        )

    def cautions(self, samples: ErrorSamples) -> Iterator[Caution]:
        """Yield the reasons to doubt the samples."""
        if failed := samples.converged.count(False):
            text = (
                f"{failed} of {len(samples.converged)} samples that were solved did not converge: "
                "the deviations are unreliable where the samples scatter most"
            )
            yield Caution("samples", text)
        check, cause = CORRECTED_LINEARITY, "noise and instrument"
        if self.resampling.instrument is None:
            check, cause = NOISE_LINEARITY, "noise"
        if samples.linearity is not None:
            caution = samples.linearity.caution(check, cause, "use the method 'resolve'")
            yield from [] if caution is None else [caution]


def check_choices(n: Any, method: Any) -> None:
    """Refuse a number of samples, or a method, that is none."""
    if not isinstance(n, int | np.integer) or isinstance(n, bool) or n < 2:
        raise InputError(f"n is {n!r}, expected a whole number of samples, at least 2")
    if method not in ("linear", "resolve"):
        raise InputError(f"method is {method!r}, expected 'linear' or 'resolve'")


def noise_draw(
    shot: RecordedShot,
    noise: Any,
    errors: ErrorBudget,
    options: InversionOptions,
    correlation: float | None,
) -> tuple[Draw, str]:
    """Return a function that draws a noisy image, and a text that describes the noise.

    Noise of None is as in the error budget: counting noise if the options state units per
    quantum, else the deviation in each pixel, as `ImageNoise` estimates it for a stated
    `correlation`, px, or None. Gaussian noise is correlated as in the budget.
    """
    if noise is None and options.units_per_quantum is not None:
        noise = "poisson"
    if noise is None:
        prepared = prepare(shot.image, shot.source, options, shot.mask)
        of_image = ImageNoise(prepared.in_units(), options, correlation)
        mean = shot.source[shot.mask].mean()
        deviation = mean * np.sqrt(of_image.variance(prepared.image / mean))
        noise = prepared.flux_scale * np.maximum(deviation, 1e-9 * float(prepared.image.max()))
    # Structure that hides the noise does not correlate noise that is stated.
    is_hidden = errors.noise_is_bound and np.ndim(noise) == 0
    width = 0.0 if is_hidden else errors.noise_correlation
    return noise_of(shot.image, noise, options.units_per_quantum, shot.mask, width)


def assumed_changes(
    errors: ErrorBudget, fields: FloatArray, shot: RecordedShot, options: InversionOptions
) -> dict[str, FloatArray]:
    """Return changes of the fields by what is assumed, (k, 3, H, W) each, by parts of the budget.

    Of the edge they are `edge_changes`; of gaps in the mask the linear inversion of how far two
    continuations differ. Their size is that in the budget.
    """
    changes = {}
    if "edge" in errors.parts:
        changes["edge"] = edge_changes(fields[0], fields[1:])
    prepared = prepare(shot.image, shot.source, options, shot.mask)
    if prepared.doubt is not None and "masked pixels" in errors.parts:
        mean = prepared.source[shot.mask].mean()
        beam = np.where(prepared.lit, np.maximum(prepared.source, options.floor * mean), mean)
        potential = poisson_invert(np.maximum(beam + prepared.doubt, 0.0), source=beam)
        changes["masked pixels"] = np.stack([potential, *-np.array(np.gradient(potential))])[None]
    for name, each in changes.items():
        rms = np.sqrt((each[:, 1:, shot.mask] ** 2).sum(axis=(0, 1)).mean())
        changes[name] = each * errors.parts[name].rms / max(rms, 1e-300)
    return changes


def instrument_draws(
    shot: RecordedShot, instrument: Instrument, errors: ErrorBudget, *, measured: bool
) -> InstrumentDraws | None:
    """Return the imperfections to be drawn; None if the instrument is exact."""
    if not measured:
        instrument = instrument.with_registration(0.0)
    beam = instrument.beam_of(measured=measured, source=shot.source)
    if errors.beam_variation != beam.rms:  # more was seen
        beam = BeamPrior(rms=min(errors.beam_variation, _MAX_BEAM_RMS), length=beam.length)
    draws = InstrumentDraws(shot, instrument, beam)
    return draws if draws.names else None


def _quantity_choice(
    quantities: Quantities,
) -> Callable[[FloatArray], Mapping[str, QuantityOf]]:
    if callable(quantities):
        return quantities
    if not isinstance(quantities, Mapping) or not all(map(callable, quantities.values())):
        raise InputError(
            f"quantities is {quantities!r}, expected a dictionary of functions of potential and "
            "displacement"
        )
    return lambda _: quantities


def _measure(
    quantities: Mapping[str, QuantityOf], fields: FloatArray, change: FloatArray
) -> dict[str, FloatArray]:
    """Return the quantities of fields with a change, (potential, displacement) each."""
    potential, *displacement = fields + change
    moves = np.array(displacement)
    return {name: np.asarray(of(potential, moves)) for name, of in quantities.items()}


def _joined(samples: Sequence[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return each quantity of all samples, (n, ...)."""
    names = samples[0] if samples else {}
    return {name: np.array([sample[name] for sample in samples]) for name in names}


def _blocks(seeds: list[Seed]) -> list[list[Seed]]:
    return [seeds[start : start + WIDTH] for start in range(0, len(seeds), WIDTH)]


def _workers(options: InversionOptions, n_sites: int, n_pixels: int) -> int:
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
