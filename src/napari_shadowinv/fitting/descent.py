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
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import dctn, idctn

from napari_shadowinv._system.arrays import block_sums, complete_block_means
from napari_shadowinv._typing import FloatArray, IntArray
from napari_shadowinv.fitting._ray_kernels import KNOT
from napari_shadowinv.fitting.conjugate_gradients import SoftModes, product, solve
from napari_shadowinv.fitting.forward import Linear, Scene
from napari_shadowinv.fitting.unknowns import POWERS, Fiducials, Unknowns

_PAIRS = 20  # of steps and changes of the gradient that are kept
_DECREASE, _SLOPE = 1e-4, 0.9  # Wolfe's conditions
_TRIALS = 12  # steps tried along a line

Objective = Callable[[FloatArray], tuple[float, FloatArray]]


def minimise(
    objective: Objective,
    start: FloatArray,
    *,
    iterations: int,
    least_gain: float,
    after_step: Callable[[float], None] | None = None,
) -> tuple[FloatArray, float, int]:
    """Minimise by L-BFGS, starting with the identity as Hessian.

    Parameters
    ----------
    objective : callable
        Returns value and gradient.
    start : ndarray, shape (n,)
        Where to start; scaled so that the Hessian is about the identity.
    iterations : int
        Most steps.
    least_gain : float
        Ends once five steps lower the value by less.
    after_step : callable, optional
        Receives the value.

    Returns
    -------
    point : ndarray
    value : float
    steps : int
    """
    point = start
    value, gradient = objective(point)
    values = [value]
    pairs: deque[tuple[FloatArray, FloatArray, float]] = deque(maxlen=_PAIRS)
    step = 1.0
    for _ in range(iterations):
        direction = -_times_inverse_hessian(gradient, pairs)
        slope = product(direction, gradient)
        if not slope < 0:
            break
        step_taken = _step_along(objective, point, direction, value, slope, step)
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
    value: float,
    slope: float,
    step: float,
) -> tuple[float, float, FloatArray] | None:
    """A step that lowers the value enough and leaves less slope: bisection."""
    shortest, longest = 0.0, np.inf
    best = None
    for _ in range(_TRIALS):
        trial_value, gradient = objective(point + step * direction)
        if not trial_value <= value + _DECREASE * step * slope:
            longest = step
        else:
            best = step, trial_value, gradient
            if product(gradient, direction) >= _SLOPE * slope:
                return best
            shortest = step
        step = (shortest + longest) / 2 if np.isfinite(longest) else 2 * step
    return best


_DESCENTS = 3  # with fixed numbers of rays each
_FEW = 10  # steps, after which the numbers of rays still fit
_MOST_NEWTON, _MOST_SHORTENED, _SHARES_OF_STEP = 8, 2, (1.0, 0.5, 0.25)  # of Gauss and Newton
_NEWTON, _MOST_SOLVING = 0.02, 200  # how exactly each is found, and in how many steps
_NEXT_GAIN = 0.7  # of the least gain; a step gains up to twice what is expected
# Fields and numbers of an instrument that explain an image alike lie along a flat valley.
_NEWTON_IN_VALLEY, _MOST_IN_VALLEY, _GAIN_IN_VALLEY = 2e-3, 400, 0.1
# Numbers of rays are renewed after steps that gain more; other numbers change the objective by 1.
_RENEWING_GAIN = 5.0
_AS_EXPECTED = 0.2  # of a gain
_MOST_PIXELS = 2_000_000  # of all images
_SCALE, _TRANSPOSE = "nmyx,nyx->myx", "nmyx,myx->nyx"  # sums over the fields of scales


class _Coupling(NamedTuple):
    """The coupling of the `long` waves of potentials and numbers of the beams, at `places`.

    With M the scaled Hessian between both, and D that of these numbers, all other blocks being the
    identity: M as a `table` (n, M, …) and a `root` of (D - MᵀM)⁻¹.
    """

    long: tuple[Any, ...]
    places: IntArray
    table: FloatArray
    root: FloatArray


class Preconditioner:
    """Scales in which the Hessian is about the identity: Sᵀ H S ≈ 1.

    Diagonal in the cosines of the potentials, except for the coupling of two fields, and of fields
    and beams.
    """

    def __init__(self, scene: Scene) -> None:
        prior, squares = scene.prior, scene.prior.wave_numbers
        widths = [psf if isinstance(psf, float) else 0.0 for psf in scene.psf]
        variances = scene.blur**2 + np.square(widths)
        weights = np.exp(-variances[:, None, None] * squares)
        weights *= KNOT**2 * scene.weights.mean(axis=(1, 2))[:, None, None]
        # An image's change by a weak potential is its Laplacian.
        laplacian = -squares * np.sqrt(prior.power_seen)
        data = np.einsum("lyx,li,lj->yxij", weights, scene.strengths, scene.strengths)
        data *= laplacian[:, :, None, None] ** 2
        of_data = np.moveaxis(np.diagonal(data, axis1=2, axis2=3), -1, 0)
        rough = prior.roughness
        self._kept = np.divide(of_data, of_data + rough, out=np.ones_like(rough), where=rough > 0)
        of_prior = np.moveaxis(prior.of_potentials(), 0, -1)
        matrix = data + of_prior[..., None] * np.eye(of_prior.shape[-1])
        roots = np.linalg.inv(np.linalg.cholesky(matrix))
        self._potentials = np.ascontiguousarray(np.moveaxis(roots, (2, 3), (0, 1)))
        self.log_ratio = 0.5 * float(np.linalg.slogdet(matrix)[1].sum())
        self.log_ratio -= 0.5 * float(np.log(of_prior).sum())
        pixels = scene.weights.sum(axis=(1, 2))
        brightness = np.where(scene.free_brightness, 1 / np.sqrt(pixels + 1), 0.0)
        # Images have contrasts of some tenths over some pixels; stretching moves the edge by more.
        arm = max(scene.rays.size) / 4
        moved = 0.02 * pixels[:, None] * np.array([1, arm, arm, 1, arm, arm]) ** 2
        frames = np.where(scene.free_frames, 1 / np.sqrt(moved + prior.frame_weights), 0.0)
        frames[0] = 0
        common, separate = scene.number_scales()
        self._diagonals = [common, brightness, frames, separate]
        self._scene, self._weights, self._laplacian = scene, weights, laplacian

    @cached_property
    def _coupling(self) -> _Coupling:
        """How weak fields can replace beams."""
        scene, weights, laplacian = self._scene, self._weights, self._laplacian
        beams = scene.beam_cosines()
        scales, count = self.others[beams.places], beams.waves.shape[1:]
        long = np.s_[..., : count[0], : count[1]]
        own = np.diag(np.where(scales > 0, scales**2, 1.0))
        pulls = np.zeros((len(scales), scene.strengths.shape[1], *count))
        # Images whose beams have the same numbers are counted together.
        groups: dict[bytes, list[int]] = {}
        for k, seen in enumerate(beams.images.T):
            groups.setdefault(seen.tobytes(), []).append(k)
        for group in groups.values():
            waves = (scales * beams.images[:, group[0]])[:, None, None] * beams.waves
            of_fields = np.einsum("lm,lyx->myx", scene.strengths[group], weights[long][group])
            pulls += of_fields * (laplacian[long] * waves)[:, None]
            waves *= np.sqrt(weights[long][group].sum(axis=0))
            own += np.einsum("qyx,pyx->qp", waves, waves)
        table = np.einsum("nmyx,qmyx->qnyx", self._potentials[long], pulls)
        own -= np.einsum("qmyx,pmyx->qp", table, table)
        return _Coupling(long, beams.places, table, np.linalg.inv(np.linalg.cholesky(own)).T)

    def _turn(self, waves: FloatArray, others: FloatArray) -> None:
        """Turn scaled values in place: with the beams move the fields that replace them."""
        long, places, table, root = self._coupling
        others[places] = numbers = np.einsum("qp,p->q", root, others[places])
        waves[long] -= np.einsum("q,qmyx->myx", numbers, table)

    def _turn_back(self, waves: FloatArray, others: FloatArray) -> None:
        """Apply the transpose of `_turn` in place."""
        long, places, table, root = self._coupling
        numbers = others[places] - np.einsum("qmyx,myx->q", table, waves[long])
        others[places] = np.einsum("qp,q->p", root, numbers)

    def held(self) -> Preconditioner:
        """Return scales in which the numbers of an instrument do not change."""
        scales = copy(self)
        common, brightness, frames, separate = self._diagonals
        scales._diagonals = [0 * common, brightness, frames, 0 * separate]
        scales.others = np.concatenate([part.ravel() for part in scales._diagonals])
        long, places, table, root = self._coupling
        scales._coupling = _Coupling(long, places[:0], table[:0], root[:0, :0])
        return scales

    def damp(self, unknowns: Unknowns) -> Unknowns:
        """Return unknowns without the finest waves, which knots further apart leave behind."""
        waves = dctn(unknowns.potentials, axes=(1, 2), norm="ortho") * self._kept
        return unknowns._replace(potentials=idctn(waves, axes=(1, 2), norm="ortho"))

    def times(self, scaled: Unknowns) -> Unknowns:
        """Return S times scaled unknowns: their change."""
        return scaled.like(self._changed(scaled.flat(), scaled)[1])

    def _changed(self, scaled: FloatArray, like: Unknowns) -> tuple[FloatArray, FloatArray]:
        """Cosines of the potentials' change by scaled values, and the change of all values."""
        size = like.potentials.size
        flat = scaled.copy()
        waves, others = flat[:size].reshape(like.potentials.shape), flat[size:]
        self._turn(waves, others)
        waves = self._potentials_times(waves)
        flat[:size] = idctn(waves, axes=(1, 2), norm="ortho").ravel()
        others *= self.others
        return waves, flat

    def transpose_times(self, slope: Unknowns) -> Unknowns:
        """Return Sᵀ times derivatives: those with respect to scaled unknowns."""
        waves = dctn(slope.potentials, axes=(1, 2), norm="ortho")
        return slope.like(self._scaled(waves, slope.flat()))

    def _scaled(self, waves: FloatArray, flat: FloatArray) -> FloatArray:
        """Sᵀ times derivatives, by the cosines of those by potentials, in place of all."""
        waves = self._potentials_times(waves, _TRANSPOSE)
        others = flat[waves.size :]
        others *= self.others
        self._turn_back(waves, others)
        flat[: waves.size] = waves.ravel()
        return flat

    def hessian_times(self, linear: Linear, scaled: FloatArray) -> FloatArray:
        """Return Sᵀ H S times scaled unknowns, both flat, by half of the transforms of each."""
        unknowns, prior = linear.unknowns, linear.scene.prior
        waves, flat = self._changed(scaled, unknowns)
        change = unknowns.like(flat)
        slope = linear.normal_times(change)
        prior.add_ties(change.potentials, slope.potentials)
        of_data = dctn(slope.potentials, axes=(1, 2), norm="ortho")
        of_data += prior.roughness * waves
        result, size = slope.flat(), waves.size
        result[size:] += linear.weights_of_others * flat[size:]
        return self._scaled(of_data, result)

    @property
    def has_rough_numbers(self) -> bool:
        """Whether numbers of the instrument may change in scales that hardly know the fields.

        Where each image has a beam of its own, fields are replaced nearly altogether.
        """
        common, separate = (self._diagonals[place] for place in (0, 3))
        return bool(separate.any() or np.count_nonzero(common) > len(self._coupling.places))

    @cached_property
    def others(self) -> FloatArray:
        """Scales of all values but the potentials."""
        return np.concatenate([part.ravel() for part in self._diagonals])

    def _potentials_times(self, waves: FloatArray, sums: str = _SCALE) -> FloatArray:
        """Cosines of the potentials by scaled ones, or the transpose."""
        if len(waves) == 1:  # a product is faster than a sum over one field
            return np.asarray(self._potentials[0] * waves)
        return np.asarray(np.einsum(sums, self._potentials, waves))

    def log_size(self) -> float:
        """Return log |det S| plus about half the log-determinant of the prior."""
        scales = np.append(self.others, np.diag(self._coupling.root))
        return -self.log_ratio + float(np.log(scales[scales > 0]).sum())


def descend(
    scene: Scene,
    start: Unknowns,
    *,
    iterations: int,
    least_gain: float,
    after_step: Callable[[float], None] | None = None,
) -> tuple[Unknowns, float, int]:
    """Minimise a scene's objective; the numbers of rays are renewed between descents.

    Parameters
    ----------
    scene, start
        The images and the starting point.
    iterations : int
        Most steps.
    least_gain : float
        Ends where five steps lower the objective by less; chance changes it by about 1.
    after_step : callable, optional
        Receives the objective after each step.

    Returns
    -------
    unknowns : Unknowns
    value : float
        The objective.
    steps : int
    """
    scales = Preconditioner(scene)
    unknowns, steps, value = start, 0, np.inf
    for _ in range(_DESCENTS):
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
        if steps >= iterations or taken < _FEW:
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
    is_rough: bool = False,
) -> tuple[Unknowns, float, int, bool]:
    """Minimise a scene's objective from nearby: Gauss-Newton steps, and a descent if they fail.

    They also converge in directions that are barely determined, where a descent would end early.

    Parameters
    ----------
    scene, start, after_step
        As for `descend`.
    steps : int
        Most steps.
    least_gain : float
        Ends where one step, or five of a descent, lower the objective by less, or the next would.
    modes : SoftModes, optional
        Of the Hessians of this scene, from scenes of the same pixels and priors.
    linear : Linear, optional
        The scene to first order near the start: used for all steps while these succeed.
    is_rough : bool, default False
        Whether a Gauss-Newton step that gains what it was expected to is the last.

    Returns
    -------
    unknowns : Unknowns
    value : float
        The objective.
    steps : int
    ended : bool
        Whether steps were left.
    """
    tolerance, solving = _NEWTON, _MOST_SOLVING
    scales = Preconditioner(scene)
    # Scales of numbers that fields may replace, and of frames, are rough.
    is_scaled = not (scales.has_rough_numbers or scene.free_frames.any())
    if scales.has_rough_numbers:
        tolerance, solving = _NEWTON_IN_VALLEY, _MOST_IN_VALLEY
    if scene.has_free_numbers:
        least_gain *= _GAIN_IN_VALLEY
    modes = SoftModes() if modes is None else modes
    now = start
    counts = scene.ray_counts(now)
    value, slope = scene.value_and_gradient(now, counts)
    # Jacobians of many pixels would fill the memory.
    newton = min(_MOST_NEWTON, steps) if scene.images.size <= _MOST_PIXELS else 0
    taken = shortened = 0

    def newton_step(here: Linear, down: FloatArray) -> FloatArray:
        def times(flat: FloatArray) -> FloatArray:
            if after_step is not None:
                after_step(value)
            return scales.hessian_times(here, flat)

        return solve(times, down, tolerance=tolerance, iterations=solving, modes=modes)

    while taken < newton and shortened < _MOST_SHORTENED:
        down = -scales.transpose_times(slope).flat()
        is_new = linear is None
        linear = linear or scene.linear(now, counts)
        step = newton_step(linear, down)
        expected_gain = product(down, step) / 2
        change = scales.times(now.like(step))
        for share in _SHARES_OF_STEP:
            trial = now.plus(now.like(share * change.flat()))
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
        is_as_expected = abs(gain - expected_gain) < _AS_EXPECTED * expected_gain
        if is_rough and is_as_expected:
            return now, scene.value(now), taken, True
        # What the next step would gain is about the preconditioned square of the slope.
        after = scales.transpose_times(slope).flat()
        next_gain = product(after, modes.precondition(after)) / 2
        if gain < least_gain or (next_gain < _NEXT_GAIN * least_gain and is_scaled):
            return now, scene.value(now), taken, True
        # Where little is left to gain, Jacobians from nearby serve.
        if share < 1 or (is_new and next_gain > _RENEWING_GAIN):
            linear = None
        if gain > _RENEWING_GAIN:
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
    return replace(
        scene,
        images=images,
        weights=weights,
        beams=complete_block_means(scene.beams, factor),
        psf=[_narrower(width, factor) for width in scene.psf],
        # What is held against a potential is the same in all pixels.
        smoothness=scene.smoothness * smoothness_in_pixels(factor),
        tie=scene.tie * factor**4,
        decay=scene.decay / factor,
        pad=scene.pad // factor,
        fiducials=None if fiducials is None else Fiducials(*(part / factor for part in fiducials)),
        imperfect=scene.imperfect.coarsen(factor),
        bin=scene.bin * factor,
    )


def smoothness_in_pixels(factor: int) -> FloatArray:
    """Return the factors of λ and κ in larger pixels."""
    return np.array([float(factor) ** (6 - 2 * power) for power in POWERS])


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
    potentials = unknowns.potentials
    for axis in (1, 2):
        old = np.moveaxis(potentials, axis, 0)
        new = np.empty((2 * len(old) - 3, *old.shape[1:]))
        new[0::2] = (old[:-1] + old[1:]) / 2
        new[1::2] = (old[:-2] + 6 * old[1:-1] + old[2:]) / 8
        potentials = np.moveaxis(new, 0, axis)
    frames = unknowns.frames.copy()
    frames[:, [0, 3]] *= 2
    return unknowns._replace(potentials=4 * potentials, frames=frames)
