"""Error bars: how image noise affects the retrieved field.

- error bars for the potential and the displacement at every pixel: `uncertainty`
- result: `Uncertainty`

Each sample is the image with another draw of noise, and is inverted on the same sites: by the
linear response of the image's own transport, or by solving the transport anew from its weights. The
scatter of the samples is the scatter of repeated shots of the same object (the parametric
bootstrap).

References
----------
B. Efron and R. J. Tibshirani, *An Introduction to the Bootstrap* (Chapman & Hall, 1993),
chapter 6.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass, replace
from functools import reduce
from operator import add
from threading import Event
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.arrays import unpack_shot
from napari_shadowinv._system.machine import available_threads, physical_memory
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop
from napari_shadowinv._system.safety import check_memory
from napari_shadowinv._system.validation import as_model, check_instance
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.geometry.linear_surface import WIDTH
from napari_shadowinv.inversion._invert import invert, plan_sites
from napari_shadowinv.inversion._noise_samples import noise_of
from napari_shadowinv.inversion._sampling import FullResampling, LinearResampling, Scatter, Seed
from napari_shadowinv.inversion.normalise import bytes_per_pixel, prepare
from napari_shadowinv.inversion.result import Inversion
from napari_shadowinv.inversion.variables import dataset_from_field, label
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.transport.sites import SitePlan

if TYPE_CHECKING:
    import xarray

    from napari_shadowinv.physics.setup import Setup

__all__ = ["Uncertainty", "uncertainty"]

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

    def solved(seeds: list[Seed], report: Reporter) -> Iterator[FloatArray]:
        for sample in _in_order(resampling.sample, [[seed] for seed in seeds], workers, report):
            solution = sample.solution  # large, so not stored
            outcomes.append((solution.iterations, solution.residual, solution.converged))
            yield sample.field - image_fields

    off = 0.0
    if method == "resolve":
        scatter = reduce(add, map(Scatter.of, solved(seeds, report)))
    else:
        quietly = Reporter(None, should_stop)
        checked = np.array(list(solved(seeds[:_CHECKED], quietly)))
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
            f"{off:.0%} of what the noise changes; use method='resolve'"
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
