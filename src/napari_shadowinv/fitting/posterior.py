"""Uncertainty of the best unknowns by the Gauss-Newton Hessian, and the error bars from it.

- random changes that the data leave open, `Posterior`, `Sample`, `Response`
- error bars by random changes, such as those by the noise: `displacement_errors`
- by an unmeasured or inexact beam: `shifts_by_beam`, `draw_variations`
- fields that noise, beam and instrument leave possible: `sampled_potentials`

References
----------
D. J. C. MacKay, Neural Comput. 4, 415 (1992); S. Ubaru, J. Chen and Y. Saad, SIAM J. Matrix Anal.
Appl. 38, 1075 (2017); J. M. Bardsley, A. Solonen, H. Haario and M. Laine, SIAM J. Sci. Comput. 36,
A1895 (2014).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add
from typing import NamedTuple, TypeVar

import numpy as np
from scipy.fft import dctn
from scipy.ndimage import gaussian_filter

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, product, solve
from napari_shadowinv.fitting.descent import finer, settle
from napari_shadowinv.fitting.forward import Linear, Scene
from napari_shadowinv.fitting.measurements import FitData
from napari_shadowinv.fitting.parallel import run_in_parallel
from napari_shadowinv.fitting.preconditioner import Preconditioner
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.inversion.samples import Pairs, stratified_numbers
from napari_shadowinv.physics.poisson import border_mean

_T = TypeVar("_T")

_BEAM_SEED = 1


@dataclass(frozen=True)
class Sample:
    """A random change of the unknowns, and what causes it."""

    change: Unknowns
    noise: FloatArray  # (L, H, W), random changes of the data over their standard deviations
    force: Unknowns  # random derivatives of the prior


class Response(NamedTuple):
    """How well images determine n numbers of an instrument that change the response to fields."""

    changes: list[Unknowns]  # of all unknowns by each number
    numbers: FloatArray
    slopes: FloatArray  # of the misfit by the numbers
    expected: FloatArray  # slopes if the numbers are right
    curvature: FloatArray  # (n, n), of the misfit


class Posterior:
    """The Gaussian around unknowns at which a scene's objective is least.

    The `modes` are of the Hessians of this scene, from scenes of the same pixels and priors. The
    scene is `linear` near these unknowns, by default at them. `after_step` is called after each
    step, to report progress and to stop.
    """

    def __init__(
        self,
        scene: Scene,
        unknowns: Unknowns,
        rng: np.random.Generator,
        after_step: Callable[[], None] | None = None,
        modes: SoftModes | None = None,
        linear: Linear | None = None,
    ) -> None:
        self.scene, self._unknowns, self._rng = scene, unknowns, rng
        self._counts = scene.ray_counts(unknowns)
        self._linear = linear or scene.linear(unknowns, self._counts, of_held=True)
        self._scales = Preconditioner(scene)
        self._after_step = after_step or (lambda: None)
        self._modes = SoftModes() if modes is None else modes

    def reporting(self, after_step: Callable[[], None]) -> Posterior:
        """Return the same posterior with another callback after each step."""
        posterior = copy(self)
        posterior._after_step = after_step
        return posterior

    @property
    def _deviations(self) -> FloatArray:
        """Standard deviations of the noise, 0 in pixels that are not used."""
        roots = np.sqrt(self.scene.weights)
        return np.divide(1, roots, out=np.zeros_like(roots), where=roots > 0)

    def smoothness_ratios(
        self, signs: FloatArray, *, tolerance: float = 0.05, most: float = 15.0
    ) -> tuple[FloatArray, FloatArray]:
        """Return how much larger likely λ and κ are, logarithms (M, 2), and what data determine.

        Each holds as much against the field as there are coefficients that the data determine and
        it would: their number is returned, too. It follows from random `signs` (M, …) of the
        coefficients. The ratios are limited to a factor of `most`.
        """
        prior = self.scene.prior
        determined, energy = np.empty((2, *self.scene.smoothness.shape))
        for m, sign in enumerate(signs):
            each, roughness = prior.of_rough[m], prior.roughness[m]
            slope = self._unknowns.zeros()
            slope.potentials[m] = prior.root_of_smoothness(m, sign)
            solved = self._change(slope, tolerance)
            open_part = np.sqrt(roughness) * sign * dctn(solved.potentials[m], norm="ortho")
            shares = np.divide(each, roughness, out=np.zeros_like(each), where=roughness > 0)
            determined[m] = np.maximum((shares * (1 - open_part)).sum(axis=(1, 2)), 1e-3)
            waves = dctn(self._unknowns.potentials[m], norm="ortho")
            energy[m] = (each * waves**2).sum(axis=(1, 2))
        ratios = np.clip(determined / np.maximum(energy, 1e-300), 1 / most, most)
        return np.log(ratios), determined

    def draw_samples(
        self,
        count: int,
        tolerance: float | None = None,
        *,
        closely: float = 0.002,
        in_valley: float = 1e-4,
    ) -> list[Sample]:
        """Return random changes of the unknowns, as large as the data leave possible.

        Numbers of the instrument that are held are drawn first; all other unknowns respond to them.
        Of the equations, the relative residual is the `tolerance`. By default they are solved
        `closely`, as the longest waves, which noise moves most, are found last; even more so
        `in_valley`, where fields and numbers of an instrument explain an image alike.
        """
        if tolerance is None:
            tolerance = in_valley if self._scales.has_rough_numbers else closely
        spread = self.scene.spread
        # Each moves the whole field: a few samples have it spread as evenly as many.
        normal = stratified_numbers(self._rng, count, 0 if spread is None else len(spread))
        root = np.sqrt(count / max(count - 1, 1))
        draws = [self._draw(root * numbers) for numbers in normal]
        changes = self._changes([slope for _, slope in draws], tolerance)
        return [
            replace(causes, change=change.plus(causes.change))
            for (causes, _), change in zip(draws, changes, strict=True)
        ]

    def _draw(self, normal: FloatArray) -> tuple[Sample, Unknowns]:
        """Noise, the prior's force and held numbers (by `normal` ones) of a sample; their slope."""
        noise = self._rng.normal(size=self.scene.images.shape)
        numbers, residuals = self._unknowns.zeros(), noise
        if self.scene.held:
            numbers = self._draw_held(normal)
            residuals = noise - self._linear.push(numbers)
        force = self.scene.prior.draw(self._unknowns, self._rng)
        return Sample(numbers, noise, force), self._linear.pull(residuals).plus(force)

    def _changes(self, slopes: Sequence[Unknowns], tolerance: float) -> list[Unknowns]:
        """Solve for the change that undoes each slope, in threads."""
        return self._of_each(lambda posterior, slope: posterior._change(slope, tolerance), slopes)

    def _of_each(
        self, function: Callable[[Posterior, _T], Unknowns], values: Sequence[_T]
    ) -> list[Unknowns]:
        """Call a function for each value, in threads.

        The first comes before all others, which know the modes that it has found.
        """

        def alone(value: _T, after_step: Callable[[], None]) -> Unknowns:
            posterior = self.reporting(after_step)
            posterior._modes = copy(self._modes)
            return function(posterior, value)

        first = [function(self, value) for value in values[:1]]
        works = [partial(alone, value) for value in values[1:]]
        threads = available_threads(self.scene.threads)
        return first + run_in_parallel(works, threads, self._after_step)

    def solve(
        self, samples: Sequence[Sample], steps: int, least_gain: float = 0.05
    ) -> list[Sample]:
        """Return samples with the change that explains their images and prior in full.

        Each minimises the objective for images with its noise, in at most `steps` steps from its
        change to first order (randomize then optimize); the best unknowns are settled before. The
        steps end at the least gain of the objective: directions that the data barely determine gain
        ½ by one standard deviation.
        """
        if not samples:
            return []
        scene = self.scene

        def settled(posterior: Posterior, scene: Scene, start: Unknowns) -> Unknowns:
            end, *_ = settle(
                scene,
                start,
                steps=steps,
                least_gain=least_gain,
                after_step=lambda _: posterior._after_step(),
                modes=posterior._modes,
                linear=replace(self._linear, scene=scene),
            )
            return end

        base = settled(self, scene, self._unknowns)

        def change_of(posterior: Posterior, sample: Sample) -> Unknowns:
            images = scene.images + self._deviations * sample.noise
            noisy = replace(scene, images=images, force=sample.force)
            return settled(posterior, noisy, base.plus(sample.change)).plus(base, -1)

        changes = self._of_each(change_of, samples)
        return [
            replace(sample, change=change) for sample, change in zip(samples, changes, strict=True)
        ]

    def _draw_held(self, normal: FloatArray) -> Unknowns:
        scene, numbers = self.scene, self._unknowns.zeros()
        if scene.spread is not None:
            units = np.stack([unit.flat() for unit in scene.response_units()])
            return numbers.like(np.einsum("n,nx->x", scene.spread @ normal, units))
        for part in scene.imperfect.parts.values():
            if part.key in scene.held:
                block = part.of(numbers.common, numbers.separate)
                block[...] = self._rng.normal(size=block.shape)
        return numbers

    def response(
        self, pairs: int, *, tolerance: float = 0.01, refitted: float = 0.02, seed: int = 2
    ) -> Response:
        """Return how well the images determine numbers that change the response to fields.

        Fields and such numbers together are likeliest for the instrument through which the fewest
        details are fitted to the noise, and for the weakest fields. How far that shifts the
        derivative of the objective, least for all else, is found from fits to images of the
        present unknowns with fresh noise: pairs of opposite noise, which leaves out its mean.

        Derivatives are taken along a number and what responds to it, so that it matters little
        whether the rest has settled; one linear step is enough for each of these fits, to the
        tolerance `refitted`.
        """
        scene, unknowns = self.scene, self._unknowns
        rng = np.random.default_rng(seed)
        units = scene.response_units()
        changes = [
            self._change(self._linear.pull(-self._linear.push(unit)), tolerance).plus(unit)
            for unit in units
        ]
        pushed = np.stack([self._linear.push(change).ravel() for change in changes])
        numbers = np.array([product(unit.flat(), unknowns.flat()) for unit in units])

        def gradient(images: FloatArray, at: Unknowns) -> Unknowns:
            return replace(scene, images=images).value_and_gradient(at, self._counts)[1]

        def along(slope: Unknowns) -> FloatArray:
            # Their prior has the derivative that is equal to them.
            forces = np.array([product(change.flat(), slope.flat()) for change in changes])
            return np.asarray(forces - numbers)

        model, deviations = scene.model(unknowns, self._counts), self._deviations
        expected = np.zeros(len(units))
        for _ in range(pairs):
            noise = deviations * rng.normal(size=model.shape)
            for sign in (1, -1):
                images = model + sign * noise
                step = self._change(gradient(images, unknowns), refitted)
                expected += along(gradient(images, unknowns.plus(step, -1))) / (2 * pairs)
        return Response(
            changes,
            numbers=numbers,
            slopes=along(gradient(scene.images, unknowns)),
            expected=expected,
            curvature=np.einsum("ix,jx->ij", pushed, pushed),
        )

    def effects(
        self, samples: Sequence[Sample], tolerance: float = 0.02
    ) -> list[dict[str, Unknowns]]:
        """Return the change of samples by each imperfection of the instrument, and by the noise.

        Common and separate changes of the beams are one.

        With J and B the derivatives of the residuals by the fields and by the numbers θ of an
        imperfection, and H the Hessian of the fields, it causes -H⁻¹JᵀBθ; noise causes the rest.
        """
        held = self._held

        def effects_in(change: Unknowns) -> dict[str, Unknowns]:
            numbers: dict[str, Unknowns] = {}
            for part in self.scene.imperfect.parts.values():
                # A change of all beams is common, or one of each.
                key = "beam" if part.key == "beam_between" else part.key
                moved = numbers.setdefault(key, change.zeros())
                part.of(moved.common, moved.separate)[...] = part.of(change.common, change.separate)
            rest, effects = change, {}
            for key, moved in numbers.items():
                pull = self._linear.pull(-self._linear.push(moved))
                effects[key] = held._change(pull, tolerance)
                rest = rest.plus(effects[key], -1)
            return {"noise": rest, **effects}

        return [effects_in(sample.change) for sample in samples]

    def responses(
        self, rng: np.random.Generator, *, asked: bool = False, tolerance: float = 0.01
    ) -> dict[str, tuple[Unknowns, float]]:
        """Return the response to each imperfection, of smooth fields to a random one, and its size.

        If `asked`, sizes include the numbers that residuals ask for, of a fit without them.

        The response is to one standard deviation, the size the r.m.s. number that prior and images
        make likely. With the notation of `effects`, images show one by s standard deviations, where
        s² = |B|² - BᵀJH⁻¹JᵀB, and ask for g / s, with g the objective's slope along it and its
        response: so its mean is g / (1 + s²), its variance 1 / (1 + s²).
        """
        held, none = self._held, self._unknowns.zeros()
        scene, counts = self.scene, self._counts
        slope = scene.value_and_gradient(self._unknowns, counts)[1] if asked else none
        pulls, squares, slopes = {}, [], []
        for part in scene.imperfect.parts.values():
            numbers = self._unknowns.zeros()
            width = part.places.stop - part.places.start
            block = part.of(numbers.common, numbers.separate)
            block[...] = rng.normal(size=width) if width > 1 else 1.0
            pushed = self._linear.push(numbers)
            pull = self._linear.pull(-pushed)
            pulls[part.key] = pull._replace(common=none.common, separate=none.separate)
            squares.append(product(pushed.ravel(), pushed.ravel()))
            of_part = part.of(slope.common, slope.separate)
            slopes.append(float((block * of_part).sum()))
        slope = slope._replace(common=none.common, separate=none.separate)
        changes = held._changes(list(pulls.values()), tolerance)
        responses = {}
        for key, change, square, along in zip(pulls, changes, squares, slopes, strict=True):
            flat = change.flat()
            shown = max(square - product(pulls[key].flat(), flat), 0.0)
            mean = (along + product(slope.flat(), flat)) / (1 + shown)
            responses[key] = change, float(np.sqrt(mean**2 + 1 / (1 + shown)))
        return responses

    @property
    def _held(self) -> Posterior:
        """The same for an instrument that is known."""
        posterior = copy(self)
        posterior._scales, posterior._modes = self._scales.held(), SoftModes()
        return posterior

    def count_determined(self, rng: np.random.Generator, tolerance: float = 0.05) -> float:
        """Estimate how many numbers the data determine: so much of Σχ² the fit absorbs of noise."""
        slope = self._linear.pull(rng.normal(size=self.scene.images.shape))
        return product(slope.flat(), self._change(slope, tolerance).flat())

    def moved_by_beams(
        self, variations: Sequence[FloatArray], tolerance: float = 0.01
    ) -> list[Unknowns]:
        """Return the changes of the unknowns if the beams differ from their sources.

        The variations are shares of the scene's beams, (L, …), in which the images are linear.
        """
        changed = (replace(self.scene, beams=each * self.scene.beams) for each in variations)
        images = (each.model(self._unknowns, self._counts) for each in changed)
        slopes = [self._linear.pull(np.sqrt(self.scene.weights) * each) for each in images]
        return self._changes(slopes, tolerance)

    def _times(self, flat: FloatArray) -> FloatArray:
        self._after_step()
        return self._scales.hessian_times(self._linear, flat)

    def _change(self, slope: Unknowns, tolerance: float, most_steps: int = 600) -> Unknowns:
        right = self._scales.transpose_times(slope).flat()
        scaled = solve(
            self._times, right, tolerance=tolerance, iterations=most_steps, modes=self._modes
        )
        return self._scales.times(self._unknowns.like(scaled))


def draw_variations(
    scene: Scene, length: float, count: int, rng: np.random.Generator, waves: int = 60
) -> FloatArray:
    """Return random smooth fields with a mean of 0 and an r.m.s. of 1 over the image, (count, …).

    They are of the shape of a scene's beams, which reach beyond the image, and sums of `waves` that
    vary over a `length` in px of the scene.
    """
    height, width = scene.beams.shape[1:]
    inside = np.s_[scene.pad : height - scene.pad, scene.pad : width - scene.pad]
    fields = np.empty((count, height, width))
    for field in fields:
        numbers = rng.normal(size=(2, waves)) / length
        phases = rng.uniform(0, 2 * np.pi, waves)
        along_y = np.arange(height)[:, None] * numbers[0] + phases
        along_x = np.arange(width)[:, None] * numbers[1]
        # cos(a + b) of each wave, without BLAS, whose idle threads spin.
        field[:] = np.einsum("yw,xw->yx", np.cos(along_y), np.cos(along_x))
        field -= np.einsum("yw,xw->yx", np.sin(along_y), np.sin(along_x))
        field -= field[inside].mean()
        field /= np.sqrt((field[inside] ** 2).mean())
    return fields


def compare_samples(scene: Scene, linear: Sequence[Sample], solved: Sequence[Sample]) -> Pairs:
    """Return the displacements of samples to first order beside those that were solved."""
    moves, solved_moves = (
        [scene.displacement(sample.change) for sample in samples] for samples in (linear, solved)
    )
    return reduce(add, map(Pairs.of, moves, solved_moves))


def errors_by_part(
    scene: Scene,
    posterior: Posterior,
    samples: Sequence[Sample],
    size: tuple[int, int],
    most: int = 3,
) -> dict[str, FloatArray]:
    """Return standard deviations of each field's displacement by noise and by imperfections.

    From `most` samples at most, of which each costs a solution for an imperfection.
    """
    if not scene.imperfect.parts:
        return {}
    effects = posterior.effects(samples[:most])
    return {
        key: displacement_errors(scene, [each[key] for each in effects], size)
        for key in (effects[0] if effects else ())
    }


def displacement_errors(
    scene: Scene,
    changes: Sequence[Unknowns],
    size: tuple[int, int],
    width: float = 4.0,
) -> FloatArray:
    """Return the r.m.s. displacement of each field by changes, smoothed over a width in px."""
    height, across = size
    squares = np.zeros((scene.strengths.shape[1], 2, *scene.rays.size))
    for change in changes:
        squares += scene.displacement(_in_pixels_of(scene, change)) ** 2
    smooth = gaussian_filter(squares / len(changes), (0, 0, width, width))
    return np.asarray(np.sqrt(smooth[..., :height, :across]))


@dataclass(frozen=True)
class BeamShifts:
    """Standard deviations of each field's displacement by its beam in px, (M, 2, H, W)."""

    by_percent: FloatArray  # for beams that vary by 1 %
    errors: FloatArray  # for beams that vary as far as is stated or assumed
    changes: tuple[Unknowns, ...] = ()  # add up to `errors`, times independent normal numbers


def shifts_by_beam(
    data: FitData,
    scene: Scene,
    posterior: Posterior,
    samples: Sequence[Sample],
    least: int = 3,
) -> BeamShifts | None:
    """Return the effect of beams that differ from their sources; None if beams are fitted.

    Half as many beams are drawn as there are `samples` of the posterior, or the `least`.
    """
    if not samples or scene.imperfect.parts:
        return None
    variation = data.beam.rms
    middle = posterior.scene
    rng = np.random.default_rng([data.options.seed, _BEAM_SEED])
    length = data.beam.length * min(data.size)
    count = 1 if data.common else len(scene.images)
    variations = [
        np.broadcast_to(
            draw_variations(middle, length / middle.bin, count, rng), middle.beams.shape
        )
        for _ in range(max(least, len(samples) // 2))
    ]
    changes = posterior.moved_by_beams([0.01 * each for each in variations])
    by_percent = displacement_errors(scene, changes, data.size, length / 3)
    if not variation:
        return BeamShifts(by_percent, 0 * by_percent)
    scale = 100 * variation
    each = scale / np.sqrt(len(changes))
    scaled = tuple(change.zeros().plus(change, each) for change in changes)
    return BeamShifts(by_percent, scale * by_percent, scaled)


def sampled_potentials(
    scene: Scene,
    samples: Sequence[Sample],
    shifts: Sequence[Unknowns],
    size: tuple[int, int],
    seed: int,
) -> FloatArray:
    """Return random changes of each field's potential that its total error allows, (M, n, H, W).

    They are in px², in single precision, with a mean over the border of 0, one for each of n
    samples of the posterior. Changes by unfitted numbers are random combinations, by the seed, of
    `shifts`: independent changes of one standard deviation each. The scene is in recorded pixels;
    images have the `size`.
    """
    changes = [potentials_of(scene, sample.change, size) for sample in samples]
    if shifts:
        moves = np.stack([potentials_of(scene, shift, size) for shift in shifts])
        draws = np.random.default_rng([seed, _BEAM_SEED]).normal(size=(len(samples), len(shifts)))
        draws /= np.sqrt((draws**2).mean(axis=0))  # of few samples it would differ by chance
        changes = [
            change + np.einsum("s,smyx->myx", drawn, moves)
            for change, drawn in zip(changes, draws, strict=True)
        ]
    return np.stack(changes, axis=1).astype(np.float32)


def _in_pixels_of(scene: Scene, change: Unknowns) -> Unknowns:
    is_same = change.potentials.shape[1:] == scene.rays.shape
    return change if is_same else finer(change)


def potentials_of(scene: Scene, change: Unknowns, size: tuple[int, int]) -> FloatArray:
    """Return each field's potential at the pixels of an image, px², (M, H, W)."""
    height, width = size
    potentials = _in_pixels_of(scene, change).potentials
    planes = [scene.rays.values(each)[:height, :width] for each in potentials]
    return np.stack([plane - border_mean(plane) for plane in planes])


def shares_of(errors: FloatArray, displacements: FloatArray) -> FloatArray:
    """Return each field's r.m.s. error over its r.m.s. displacement, (M,)."""
    size = np.maximum((displacements**2).mean(axis=(1, 2, 3)), 1e-12)
    return np.asarray(np.sqrt((errors**2).mean(axis=(1, 2, 3)) / size))
