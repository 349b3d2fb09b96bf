"""From several starts to the best unknowns, coarse pixels first: `search`."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.ndimage import map_coordinates

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, product
from napari_shadowinv.fitting.descent import (
    NewtonSteps,
    between_knots,
    coarser,
    descend,
    finer,
    settle,
)
from napari_shadowinv.fitting.forward import Linear, Scene
from napari_shadowinv.fitting.parallel import OnStep, run_in_parallel
from napari_shadowinv.fitting.posterior import Posterior, Response
from napari_shadowinv.fitting.preconditioner import Preconditioner
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.poisson import border_mean

FIRST_SMOOTHNESS = np.array([50.0, 2000.0])  # λ and κ
_USUAL, _ROUGH = NewtonSteps(), NewtonSteps(is_rough=True)
COARSE_GAIN = 3.0
# With numbers that resemble fields, an error of the model far below the noise changes the field.
SPACING_WITH_NUMBERS = 0.1  # px
SPACING_OF_FINE_KNOTS = 0.075  # px, for objects that are as sharp as a pixel
SMALL_PX = 80  # shorter side of images with too few pixels for an instrument's numbers
# An object's roughness is not spread evenly, as the likeliest λ and κ assume: they would round it
# off where it is sharpest.
SMOOTHNESS_RATIO = 0.1  # of them


Stages = tuple[tuple[int, float], ...]
"""Side of a pixel, and blur in such pixels, at each stage of a descent."""


@dataclass(frozen=True)
class Start:
    """Where a descent begins, with its stages."""

    name: str
    stages: Stages
    potential: FloatArray | None = None  # px² at the pixels
    beam_held: bool = False  # whether an unknown beam is held in all stages but the last


@dataclass(frozen=True)
class Minimum:
    """Where a descent has ended, in pixels that are `bin` wide."""

    start: str
    unknowns: Unknowns
    value: float
    displacement: FloatArray  # of all fields in the first image, px of the recorded image
    bin: int = 2
    modes: SoftModes = field(default_factory=SoftModes)  # of Hessians nearby in these pixels

    def in_pixels(self, bin: int) -> Unknowns:
        """Return the unknowns in pixels `bin` wide, which is no wider than they are."""
        unknowns = self.unknowns
        for _ in range(int(np.log2(self.bin // bin))):
            unknowns = finer(unknowns)
        return unknowns

    def coarsen(self, scene: Scene) -> Scene:
        """Return a scene in the pixels of this minimum."""
        return coarser(scene, self.bin)

    def distance(self, other: Minimum) -> float:
        """Return how far another displacement is from this one, relative to it (r.m.s.)."""
        size = float(np.sqrt((self.displacement**2).mean()))
        difference = self.displacement - other.displacement
        return float(np.sqrt((difference**2).mean())) / max(size, 1e-12)


def _splines_of(scene: Scene, potential: FloatArray) -> FloatArray:
    """Return coefficients of a potential given at the recorded image's pixels, about."""
    rays = scene.rays
    lines = ((rays.knot * (np.arange(n) - 1.0) - rays.pad) * scene.bin - 0.5 for n in rays.shape)
    places = np.meshgrid(*lines, indexing="ij")
    inner = potential - border_mean(potential)
    values = map_coordinates(inner, places, order=1, mode="nearest")
    return np.asarray(values) / scene.bin**2


class _Descent(NamedTuple):
    """A start, the minimum it has reached, and the stages it still has to pass."""

    start: Start
    minimum: Minimum
    stages: Stages

    def run(
        self, scene: Scene, on_step: OnStep, steps: int = 60, spacing: float = 1 / 3
    ) -> Minimum:
        """Return the minimum at the end of the stages, with the most steps of each."""
        end = replace(self.minimum, start=self.start.name)
        for factor, blur in self.stages:
            # So wide a blur hides how far apart rays are.
            spacing_px = spacing if blur < 2 else 0.5
            now = replace(coarser(scene, factor), blur=blur, spacing=spacing_px)
            unknowns, value, _ = descend(
                now,
                Preconditioner(now).damp(end.in_pixels(factor)),
                iterations=steps,
                least_gain=COARSE_GAIN,
                after_step=partial(on_step, end.start),
            )
            end = Minimum(end.start, unknowns, value, now.displacement(unknowns), factor)
        return end


def search(
    scene: Scene,
    starts: Sequence[Start],
    on_step: OnStep,
    *,
    stiffness: float = 3.0,
    most: int = 3,
) -> list[Minimum]:
    """Descend from each start to pixels of two; return the distinct minima, best first.

    Starts without a field share their first stage if it is the same. After the stage before the
    last, the best go on, `most` at most. Until λ and κ are estimated, they are `stiffness` times
    the first ones.
    """
    rough = replace(
        scene, smoothness=stiffness * np.tile(FIRST_SMOOTHNESS, (len(scene.smoothness), 1))
    )

    def begin(start: Start) -> Minimum:
        first = coarser(rough, start.stages[0][0])
        unknowns = first.nothing()
        if start.potential is not None:
            unknowns.potentials[0] = _splines_of(first, start.potential)
        return Minimum(start.name, unknowns, np.inf, first.displacement(unknowns), first.bin)

    without_field = [start for start in starts if start.potential is None]
    firsts = {(start.stages[0], start.beam_held): start for start in without_field}
    descents = [_Descent(start, begin(start), start.stages[:1]) for start in firsts.values()]
    shared = dict(zip(firsts, _descend_together(rough, descents, on_step), strict=True))
    descents = []
    for start in starts:
        if start.potential is None:
            minimum = shared[start.stages[0], start.beam_held]
            descents.append(_Descent(start, minimum, start.stages[1:-1]))
        else:
            descents.append(_Descent(start, begin(start), start.stages[:-1]))
    halfway: dict[object, list[Minimum]] = {}
    for start, minimum in zip(starts, _descend_together(rough, descents, on_step), strict=True):
        # A start with one stage has no rivals yet.
        stage = start.stages[-2] if len(start.stages) > 1 else start.name
        halfway.setdefault(stage, []).append(minimum)
    by_name = {start.name: start for start in starts}
    descents = [
        _Descent(replace(by_name[end.start], beam_held=False), end, starts[0].stages[-1:])
        for rivals in halfway.values()
        for end in (_distinct_minima(rivals)[:most] if len(rivals) > 1 else rivals)
    ]
    return _distinct_minima(_descend_together(rough, descents, on_step))


def _descend_together(scene: Scene, descents: Sequence[_Descent], on_step: OnStep) -> list[Minimum]:
    held = replace(scene, held=scene.held | {"beam"})
    works = [partial(each.run, held if each.start.beam_held else scene) for each in descents]
    return run_in_parallel(works, available_threads(scene.threads), on_step)


def _distinct_minima(
    minima: list[Minimum], differing: float = 0.03, hopeless: float = 3.0
) -> list[Minimum]:
    """Those that differ by a share, and are not hopeless times the best, best first."""
    distinct: list[Minimum] = []
    for candidate in sorted(minima, key=lambda each: each.value):
        if all(better.distance(candidate) > differing for better in distinct):
            distinct.append(candidate)
    return [candidate for candidate in distinct if candidate.value < hopeless * distinct[0].value]


def in_recorded_pixels(scene: Scene, minimum: Minimum) -> Minimum:
    """Return a minimum of a scene in the pixels of the recorded images."""
    if minimum.bin == 1:
        return minimum
    # Without waves that larger pixels left behind.
    unknowns = Preconditioner(scene).damp(minimum.in_pixels(1))
    return Minimum(minimum.start, unknowns, minimum.value, scene.displacement(unknowns), 1)


def with_finer_knots(
    scene: Scene,
    end: Minimum,
    rng: np.random.Generator,
    on_step: OnStep,
    *,
    explained: float = 1.2,
) -> tuple[Scene, Minimum]:
    """Return the scene with knots as fine as the images determine, its λ and κ, and the minimum.

    What finer knots do not explain to a χ² of `explained` is no structure of the field, and what
    the edge of the image cuts passes for structure: both keep their knots.
    """
    if scene.knot == 1 or not (_fades(end.displacement) and _determines_finest(scene)):
        return scene, end
    minimum = settle_minimum(scene, in_recorded_pixels(scene, end), on_step)
    finer = replace(scene, knot=1, spacing=SPACING_OF_FINE_KNOTS)
    dense = replace(minimum, unknowns=between_knots(minimum.unknowns), modes=SoftModes())
    dense = settle_minimum(finer, dense, on_step)
    if finer.chi2(finer.model(dense.unknowns)).max() > explained:
        return scene, end
    smoothness, dense = _likely_smoothness(finer, dense, rng, on_step)
    finer = replace(finer, smoothness=SMOOTHNESS_RATIO * smoothness)
    return finer, settle_minimum(finer, dense, on_step)


def _fades(displacement: FloatArray, share: float = 0.5) -> bool:
    """Whether displacements, (M, 2, H, W), are below a share of their largest along the border."""
    size = np.hypot(displacement[:, 0], displacement[:, 1])
    border = max(float(size[:, [0, -1]].max()), float(size[..., [0, -1]].max()))
    return border <= share * float(size.max())


def _determines_finest(scene: Scene, share: float = 0.5) -> bool:
    """Whether images rather than the prior determine the finest waves between the knots."""
    return float(Preconditioner(scene).determined[:, -1, 0].max()) > share


def estimate_smoothness(
    scene: Scene,
    end: Minimum,
    rng: np.random.Generator,
    on_step: OnStep,
    *,
    is_near: bool = False,
    most_pixels: int = 300_000,
) -> tuple[Scene, Minimum]:
    """Find λ and κ, unless they are given, and the unknowns that belong to them.

    Numbers of an instrument that change the response to fields are found, too, and held. That is in
    recorded pixels where these matter, unless all images have more than `most_pixels`.
    """
    is_fixed = bool(scene.smoothness.any())
    smoothness = scene.smoothness
    if not is_fixed:
        smoothness = np.tile(FIRST_SMOOTHNESS, (len(smoothness), 1))
    response = scene.imperfect.of_response
    scene = replace(scene, smoothness=smoothness, held=scene.held | response)
    end = _with_likely_numbers(scene, end)
    if is_fixed:
        end = settle_minimum(scene, end, on_step)
        if not scene.imperfect.resembles_fields:
            return scene, end
    else:
        # How rough a field is hardly depends on numbers that all images share.
        shared = {part.key for part in scene.imperfect.parts.values() if part.is_common}
        free, scene = scene.held, replace(scene, held=scene.held | shared)
        end = settle_minimum(scene, end, on_step, limits=_ROUGH)
        smoothness, end = _likely_smoothness(scene, end, rng, on_step)
        scene = replace(scene, smoothness=SMOOTHNESS_RATIO * smoothness, held=free)
    if scene.imperfect.resembles_fields and not is_near:
        scene = replace(scene, spacing=SPACING_WITH_NUMBERS)
        if scene.images.size <= most_pixels:
            # In larger pixels fine structure is lost by which a blur differs from a smooth object,
            # and which a field that replaces the beams would move.
            end = in_recorded_pixels(scene, end)
    # In pixels of two, the last gain costs little.
    least_gain, rounds = (COARSE_GAIN, 2) if is_near else (0.5, 8)
    end = settle_minimum(scene, end, on_step, least_gain=least_gain)
    if not response:
        return scene, end
    return _settle_response(scene, end, rng, on_step, rounds=rounds, least_gain=least_gain)


def _likely_smoothness(
    scene: Scene,
    end: Minimum,
    rng: np.random.Generator,
    on_step: OnStep,
    *,
    rounds: int = 8,
    settled: float = 0.05,
    slope: float = 0.6,
    slopes: tuple[float, float] = (0.4, 3.0),
) -> tuple[FloatArray, Minimum]:
    """Return λ and κ nearer to the likeliest, and the minimum that moves with them.

    They have `settled` where their logarithms change by less, weighted with what they determine.
    How fast the ratios to the likeliest fall with them, about the `slope`, follows from two rounds,
    within the limits of `slopes`. The minimum moves so little that the scene to first order serves
    in all rounds; so do the random signs, for rounds that can be compared.
    """
    linear = end.coarsen(scene).linear(end.unknowns)
    signs = rng.choice([-1.0, 1.0], end.unknowns.potentials.shape)
    falls = np.full(scene.smoothness.shape, slope)
    before, step = np.zeros_like(falls), np.zeros_like(falls)
    for _ in range(rounds):
        linear = replace(linear, scene=end.coarsen(scene))
        report = partial(on_step, "smoothness", end.value)
        posterior = Posterior(linear.scene, end.unknowns, rng, report, end.modes, linear)
        ratios, determined = posterior.smoothness_ratios(signs)
        np.divide(before - ratios, step, out=falls, where=step != 0)
        before, step = ratios, ratios / np.clip(falls, *slopes)
        smoothness = scene.smoothness * np.exp(step)
        weights = determined / determined.sum(axis=1, keepdims=True)
        if (np.abs(step) * weights).sum(axis=1).max() < settled:
            break
        scene = replace(scene, smoothness=smoothness)
        end = settle_minimum(scene, end, on_step, linear=linear, limits=_ROUGH)
    return smoothness, end


def _with_likely_numbers(scene: Scene, end: Minimum, most: float = 1.0) -> Minimum:
    """Move numbers of the response, which a search with smooth fields carries far away, nearer."""
    unknowns = end.unknowns
    for unit in coarser(scene, end.bin).response_units():
        number = product(unit.flat(), unknowns.flat())
        shift = float(np.clip(number, -most, most)) - number
        unknowns = unknowns.plus(unit, shift)
    return replace(end, unknowns=unknowns)


def _settle_response(
    scene: Scene,
    end: Minimum,
    rng: np.random.Generator,
    on_step: OnStep,
    *,
    rounds: int,
    least_gain: float,
    pairs: int = 2,
    settled: float = 0.05,
) -> tuple[Scene, Minimum]:
    """Find the numbers that change the response to fields, and how uncertain they are.

    They follow from `pairs` of opposite noise. They have `settled` where the square of their
    distance in standard deviations is less.
    """
    turns, before = 1, None
    for _ in range(rounds):
        response = posterior_of(scene, end, rng, on_step).response(pairs)
        mean, precision = _mean_of_numbers(response)
        remaining = np.maximum(mean, scene.least_numbers()) - response.numbers
        # Steps that turn back hover about their end: their mean is nearer to it.
        turns += before is not None and bool(remaining @ precision @ before < 0)
        step = remaining / max(turns, float(np.abs(remaining).max()))
        is_settled = step @ precision @ step < settled
        before = remaining
        unknowns = end.unknowns
        for each, share in zip(response.changes, step, strict=True):
            unknowns = unknowns.plus(each, float(share))
        end = replace(end, unknowns=unknowns)
        end = settle_minimum(scene, end, on_step, least_gain=least_gain)
        if is_settled:
            break
    # Numbers that have not settled are at least as uncertain as they would still have moved.
    covariance = np.linalg.inv(precision) + np.outer(remaining, remaining)
    return replace(scene, spread=np.asarray(np.linalg.cholesky(covariance))), end


def _mean_of_numbers(response: Response, unsure: float = 0.25) -> tuple[FloatArray, FloatArray]:
    """The likeliest numbers of an instrument, and the inverse of their covariance.

    A share of the expected slopes is `unsure`: objects whose fields are smoothed twice show it to a
    fifth.
    """
    unit = np.eye(len(response.numbers))
    curvature = response.curvature + 1e-9 * (1 + np.trace(response.curvature)) * unit
    slopes = unsure * response.expected
    weights = curvature @ np.linalg.inv(curvature + np.outer(slopes, slopes))
    pull = curvature @ response.numbers - (response.slopes - response.expected)
    precision = unit + weights @ curvature
    return np.linalg.solve(precision, weights @ pull), precision


def posterior_of(
    scene: Scene, end: Minimum, rng: np.random.Generator, on_step: OnStep, stage: str = "smoothness"
) -> Posterior:
    """Return the Gaussian around a minimum of a scene, in its pixels."""
    report, middle = partial(on_step, stage, end.value), end.coarsen(scene)
    linear = middle.linear(end.unknowns)
    return Posterior(middle, end.unknowns, rng, report, end.modes, linear)


def settle_minimum(
    scene: Scene,
    minimum: Minimum,
    on_step: OnStep,
    name: str = "smoothness",
    least_gain: float = COARSE_GAIN,
    *,
    linear: Linear | None = None,
    limits: NewtonSteps = _USUAL,
    steps: int = 40,
) -> Minimum:
    """Return where a descent ends with other λ and κ, in the minimum's pixels, without blur."""
    middle = minimum.coarsen(scene)
    unknowns, value, _, _ = settle(
        middle,
        minimum.unknowns,
        steps=steps,
        least_gain=least_gain,
        after_step=lambda now: on_step(name, now),
        modes=minimum.modes,
        linear=replace(linear, scene=middle) if linear else None,
        limits=limits,
    )
    return replace(
        minimum, unknowns=unknowns, value=value, displacement=middle.displacement(unknowns)
    )


class FineMinimum(NamedTuple):
    """Where a descent in recorded pixels has ended."""

    scene: Scene
    unknowns: Unknowns
    seen: FloatArray  # (L, H', W'), images of the model
    objective: float
    iterations: int
    converged: bool  # within the allowed steps


def refine_minimum(
    scene: Scene,
    minimum: Minimum,
    options: FitOptions,
    on_step: OnStep,
    *,
    is_near: bool = False,
    spacings: Sequence[float] = (0.2, 0.14),
    explained: float = 1.05,
    least_gain: float = 2.0,
) -> FineMinimum:
    """Descend with the pixels as recorded, with rays as dense as the data need.

    The first of the `spacings`, px, is dense enough for images that it explains to a χ² of
    `explained`.
    """
    minimum, steps = in_recorded_pixels(scene, minimum), 0
    unknowns, modes = minimum.unknowns, copy(minimum.modes)  # others use them at the same time
    is_delicate = scene.imperfect.resembles_fields and not is_near
    usual = [scene.spacing] if is_delicate or scene.knot == 1 else list(spacings)
    denser = usual if options.spacing is None else [options.spacing]
    most = -(-options.max_iterations // len(denser))
    scene = replace(scene, spacing=denser.pop(0))
    while True:
        unknowns, value, taken, ended = settle(
            scene,
            unknowns,
            steps=min(most, options.max_iterations - steps),
            least_gain=least_gain,
            after_step=lambda now: on_step("full size", now),
            modes=modes,
        )
        steps += taken
        seen = scene.model(unknowns)
        is_explained = not denser or scene.chi2(seen).max() < explained
        if steps >= options.max_iterations or (ended and is_explained):
            return FineMinimum(scene, unknowns, seen, value, steps, ended)
        if not is_explained:
            scene = replace(scene, spacing=denser.pop(0))
