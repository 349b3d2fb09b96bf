"""Steps towards the best unknowns.

- by L-BFGS: `descend`; by Gauss and Newton, where it is near: `settle`
- larger and smaller pixels: `coarser`, `finer`
- minimisation of functions of flat arrays: `minimise`

References
----------
D. C. Liu and J. Nocedal, Math. Prog. 45, 503 (1989).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting._ray_kernels import KNOT
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, product, solve
from napari_shadowinv.fitting.forward import Linear, Scene
from napari_shadowinv.fitting.preconditioner import Preconditioner
from napari_shadowinv.fitting.unknowns import POWERS, Fiducials, Unknowns
from napari_shadowinv.physics.arrays import block_sums, complete_block_means

Objective = Callable[[FloatArray], tuple[float, FloatArray]]


def minimise(
    objective: Objective,
    start: FloatArray,
    *,
    iterations: int,
    least_gain: float,
    after_step: Callable[[float], None] | None = None,
    kept: int = 20,
) -> tuple[FloatArray, float, int]:
    """Minimise by L-BFGS, starting with the identity as Hessian; return point, value and steps.

    The objective returns value and gradient; the start, (n,), is scaled so that the Hessian is
    about the identity. Steps end once five lower the value by less than `least_gain`; `after_step`
    receives the value. The last pairs of steps and changes of the gradient are `kept`.
    """
    point = start
    value, gradient = objective(point)
    values = [value]
    pairs: deque[tuple[FloatArray, FloatArray, float]] = deque(maxlen=kept)
    step = 1.0
    for _ in range(iterations):
        direction = -_times_inverse_hessian(gradient, pairs)
        slope = product(direction, gradient)
        if not slope < 0:
            break
        step_taken = _step_along(objective, point, direction, (value, slope), step)
        if step_taken is None:
            if not pairs:
                break
            pairs.clear()
            continue
        share, value, after = step_taken
        moved, turned = share * direction, after - gradient
        if (curvature := product(moved, turned)) > 0:
            pairs.append((moved, turned, curvature))
        point, gradient, step = point + moved, after, 1.0
        values.append(value)
        if after_step is not None:
            after_step(value)
        if len(values) > 5 and values[-6] - value < least_gain:
            break
    return point, value, len(values) - 1


def _times_inverse_hessian(
    gradient: FloatArray, pairs: deque[tuple[FloatArray, FloatArray, float]]
) -> FloatArray:
    """The two loops over the pairs."""
    result = gradient.copy()
    shares = []
    for moved, turned, curvature in reversed(pairs):
        share = product(moved, result) / curvature
        shares.append(share)
        result -= share * turned
    if pairs:
        _, turned, curvature = pairs[-1]
        result *= curvature / product(turned, turned)
    for (moved, turned, curvature), share in zip(pairs, reversed(shares), strict=True):
        result += (share - product(turned, result) / curvature) * moved
    return result


def _step_along(
    objective: Objective,
    point: FloatArray,
    direction: FloatArray,
    here: tuple[float, float],
    step: float,
    *,
    trials: int = 12,
    decrease: float = 1e-4,
    remaining: float = 0.9,
) -> tuple[float, float, FloatArray] | None:
    """A step from `here`, a value and a slope, to less of both, as Wolfe has it: bisection."""
    shortest, longest = 0.0, np.inf
    best, (value, slope) = None, here
    for _ in range(trials):
        trial_value, gradient = objective(point + step * direction)
        if not trial_value <= value + decrease * step * slope:
            longest = step
        else:
            best = step, trial_value, gradient
            if product(gradient, direction) >= remaining * slope:
                return best
            shortest = step
        step = (shortest + longest) / 2 if np.isfinite(longest) else 2 * step
    return best


@dataclass(frozen=True)
class NewtonSteps:
    """How steps of Gauss and Newton are found and when they end, as chosen by benchmarks/fit.py.

    Fields and numbers of an instrument that explain an image alike lie along a flat valley.
    """

    is_rough: bool = False  # whether a step that gains what it was expected to is the last
    most: int = 8
    most_shortened: int = 2
    shares: tuple[float, ...] = (1.0, 0.5, 0.25)  # of a step that are tried
    solved: tuple[float, int] = (0.02, 200)  # how exactly each is found, and in how many steps
    solved_in_valley: tuple[float, int] = (2e-3, 400)
    gain_in_valley: float = 0.1  # of the least gain
    next_gain: float = 0.7  # of the least gain; a step gains up to twice what is expected
    # Numbers of rays are renewed after steps that gain more; others change the objective by 1.
    renewing_gain: float = 5.0
    as_expected: float = 0.2  # of a gain
    most_pixels: int = 2_000_000  # of all images; Jacobians of more would fill the memory


def descend(
    scene: Scene,
    start: Unknowns,
    *,
    iterations: int,
    least_gain: float,
    after_step: Callable[[float], None] | None = None,
    descents: int = 3,
    few: int = 10,
) -> tuple[Unknowns, float, int]:
    """Minimise a scene's objective; return the unknowns, the objective, and the number of steps.

    The numbers of rays are renewed between `descents`, of which there are 3 at most; after `few`
    steps they still fit. Steps end where five lower the objective by less than `least_gain`; chance
    changes it by about 1. `after_step` receives the objective.
    """
    scales = Preconditioner(scene)
    unknowns, steps, value = start, 0, np.inf
    for _ in range(descents):
        counts, base = scene.ray_counts(unknowns), unknowns

        def objective(flat: FloatArray) -> tuple[float, FloatArray]:
            shifted = base.plus(scales.times(base.like(flat)))  # noqa: B023
            value, slope = scene.value_and_gradient(shifted, counts)  # noqa: B023
            return value, scales.transpose_times(slope).flat()

        flat, value, taken = minimise(
            objective,
            np.zeros(base.flat().size),
            iterations=iterations - steps,
            least_gain=least_gain,
            after_step=after_step,
        )
        unknowns = base.plus(scales.times(base.like(flat)))
        steps += taken
        if steps >= iterations or taken < few:
            break
    return unknowns, value, steps


def settle(
    scene: Scene,
    start: Unknowns,
    *,
    steps: int,
    least_gain: float,
    after_step: Callable[[float], None] | None = None,
    modes: SoftModes | None = None,
    linear: Linear | None = None,
    limits: NewtonSteps = NewtonSteps(),
) -> tuple[Unknowns, float, int, bool]:
    """Minimise a scene's objective from nearby: Gauss-Newton steps, and a descent if they fail.

    They also converge in directions that are barely determined, where a descent would end early.
    They end where one step, or five of a descent, lower the objective by less than `least_gain`, or
    the next would.

    The `modes` are of the Hessians of this scene, from scenes of the same pixels and priors. A
    scene that is `linear` near the start serves for all steps while these succeed. Returns the
    unknowns; the objective, of a rough end by the numbers of rays of its start; the number of
    steps; and whether steps were left.
    """
    scales = Preconditioner(scene)
    # Scales of numbers that fields may replace, and of frames, are rough.
    is_scaled = not (scales.has_rough_numbers or scene.free_frames.any())
    solved = limits.solved_in_valley if scales.has_rough_numbers else limits.solved
    if scene.has_free_numbers:
        least_gain *= limits.gain_in_valley
    modes = SoftModes() if modes is None else modes
    now = start
    counts = scene.ray_counts(now)
    value, slope = scene.value_and_gradient(now, counts)
    newton = min(limits.most, steps) if scene.images.size <= limits.most_pixels else 0
    taken = shortened = 0

    def newton_step(here: Linear, down: FloatArray) -> FloatArray:
        def times(flat: FloatArray) -> FloatArray:
            if after_step is not None:
                after_step(value)
            return scales.hessian_times(here, flat)

        return solve(times, down, tolerance=solved[0], iterations=solved[1], modes=modes)

    while taken < newton and shortened < limits.most_shortened:
        down = -scales.transpose_times(slope).flat()
        is_new = linear is None
        linear = linear or scene.linear(now, counts)
        step = newton_step(linear, down)
        expected_gain = product(down, step) / 2
        change = scales.times(now.like(step))
        for share in limits.shares:
            trial = now.plus(change, share)
            trial_value, trial_slope = scene.value_and_gradient(trial, counts)
            if trial_value < value:
                break
        else:
            if is_new:
                break
            linear = None
            continue
        taken, shortened = taken + 1, shortened + (share < 1)
        gain = value - trial_value
        now, value, slope = trial, trial_value, trial_slope
        is_as_expected = abs(gain - expected_gain) < limits.as_expected * expected_gain
        if limits.is_rough and is_as_expected:
            return now, value, taken, True
        # What the next step would gain is about the preconditioned square of the slope.
        after = scales.transpose_times(slope).flat()
        next_gain = product(after, modes.precondition(after)) / 2
        if gain < least_gain or (next_gain < limits.next_gain * least_gain and is_scaled):
            return now, scene.value(now), taken, True
        # Where little is left to gain, Jacobians from nearby serve.
        if share < 1 or (is_new and next_gain > limits.renewing_gain):
            linear = None
        if gain > limits.renewing_gain:
            counts = scene.ray_counts(now)
            value, slope = scene.value_and_gradient(now, counts)
    remaining_steps = steps - taken
    if remaining_steps > 0:
        now, value, more = descend(
            scene, now, iterations=remaining_steps, least_gain=least_gain, after_step=after_step
        )
        taken += more
    return now, value, taken, taken < steps


def coarser(scene: Scene, factor: int) -> Scene:
    """Return the same scene in larger pixels, those less than half used left out."""
    if factor == 1:
        return scene
    used = scene.weights > 0
    count = block_sums(used.astype(np.float64), factor)
    images = block_sums(np.where(used, scene.images, 0), factor) / np.maximum(count, 1)
    variances = np.divide(1, scene.weights, out=np.zeros_like(scene.weights), where=used)
    variance = block_sums(variances, factor) / np.maximum(count, 1) ** 2
    weights = np.divide(
        1, variance, out=np.zeros_like(variance), where=(count >= factor**2 / 2) & (variance > 0)
    )
    fiducials = scene.fiducials
    in_pixels = np.array([float(factor) ** (6 - 2 * power) for power in POWERS])
    return replace(
        scene,
        images=images,
        weights=weights,
        beams=complete_block_means(scene.beams, factor),
        psf=[_narrower(width, factor) for width in scene.psf],
        # What is held against a potential is the same in all pixels.
        smoothness=scene.smoothness * in_pixels,
        tie=scene.tie * factor**4,
        decay=scene.decay / factor,
        pad=scene.pad // factor,
        fiducials=None if fiducials is None else Fiducials(*(part / factor for part in fiducials)),
        imperfect=scene.imperfect.coarsen(factor),
        bin=scene.bin * factor,
        knot=KNOT,
    )


def _narrower(width: float | FloatArray, factor: int) -> float:
    """A point spread in larger pixels: a Gaussian with the same variance."""
    if isinstance(width, float):
        return width / factor
    total = width.sum()
    variance = 0.0
    for axis in (0, 1):
        line = width.sum(axis=1 - axis) / total
        place = np.arange(len(line)) - (line * np.arange(len(line))).sum()
        variance += float((line * place**2).sum()) / 2
    return float(np.sqrt(max(variance, 0.0)) / factor)


def finer(unknowns: Unknowns) -> Unknowns:
    """Return the same unknowns in pixels half as wide, with knots twice as dense: no change."""
    frames = unknowns.frames.copy()
    frames[:, [0, 3]] *= 2
    unknowns = between_knots(unknowns)
    return unknowns._replace(potentials=4 * unknowns.potentials, frames=frames)


def between_knots(unknowns: Unknowns) -> Unknowns:
    """Return the same unknowns with knots twice as dense: no change."""
    potentials = unknowns.potentials
    for axis in (1, 2):
        old = np.moveaxis(potentials, axis, 0)
        new = np.empty((2 * len(old) - 3, *old.shape[1:]))
        new[0::2] = (old[:-1] + old[1:]) / 2
        new[1::2] = (old[:-2] + 6 * old[1:-1] + old[2:]) / 8
        potentials = np.moveaxis(new, 0, axis)
    return unknowns._replace(potentials=np.ascontiguousarray(potentials))
