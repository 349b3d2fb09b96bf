"""The error budget of an inversion, and the number of sites that it needs.

- its computation from the solved levels, and the number of sites still needed: `Budget`
- add a quantity: one entry of `FLUX_ERRORS`

Between two levels, one with four times the sites of the other, the displacement changes by the
error of the coarser one. Changes fall by nearly the same rate from level to level, and as each is
of finer waves than the one before, their squares add.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from itertools import pairwise

import numpy as np
from scipy.ndimage import (
    binary_dilation,
    correlate1d,
    gaussian_filter,
    map_coordinates,
    maximum_filter,
    minimum_filter,
)
from scipy.spatial import KDTree

from napari_shadowinv._system.machine import begin
from napari_shadowinv._typing import BoolArray, FloatArray, IntArray
from napari_shadowinv.facts import percent
from napari_shadowinv.instrument.effects import EFFECTS, SolvedShot, motions
from napari_shadowinv.instrument.shapes import random_waves
from napari_shadowinv.inversion.error_budget import (
    SHARE_OF_NOISE,
    ErrorBudget,
    ErrorEstimate,
    root_of,
    share_of,
)
from napari_shadowinv.inversion.noise import ImageNoise, beam_difference
from napari_shadowinv.inversion.normalise import Prepared, lit_pixels
from napari_shadowinv.inversion.readout import LinearResponse
from napari_shadowinv.options import BeamComponents, BeamPrior, Instrument, InversionOptions
from napari_shadowinv.physics.arrays import block_means
from napari_shadowinv.physics.edge import edge_changes, edge_sides
from napari_shadowinv.transport.minimise import Solution, with_full_cells
from napari_shadowinv.transport.sites import RATIO, SiteLevel, SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target

_AROUND = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])  # px
_PLACES = 48  # along the longer side, where levels are compared
_USUAL_RATE, _RATES = 0.35, (0.25, 0.7)  # of the change between levels to the one before
_MIN_STEP = 3.0  # times the sites of the level before, for a full step
_SAFETY = 1.3
_MAX_RESIDUAL = 0.1  # of a level, for its error to be estimated
_MAX_SHARE_OF_NOISE = 0.8  # above it, an estimate of the noise suffices
_MAX_BEAM_DEVIATIONS = 3.0  # of a beam from its measured prior

_MAX_RESPONSE_SITES = 4500  # of a level whose linear response is computed
_NOISE_SAMPLES, _BEAM_SAMPLES = 16, 8
_NEAR = 2.5  # site spacings
_LEAST_NOISE = 0.1  # of the mean square, where correlation takes waves away

_EDGE_PLACES = 200  # along the shorter side at most, where the error by the edge is computed

# Of the noise: what slopes in the pixels change. Sites in all pixels raise the noise by 3 to 6 %.
_LEAST_GAIN = 0.35

# Slopes in a pixel from the means of five, of fourth order, less those of three.
_FOURTH_LESS_SECOND = np.array([5, -34, 0, 34, -5]) / 48 - np.array([0, -1, 0, 1, 0]) / 2
_AT_JUMPS = 3.0  # times this change: how far light is away from its place in a pixel

_TESTED_VARIATION = 0.01  # of a beam, r.m.s.


def discretisation_share(times: float, rate: float = _USUAL_RATE) -> float:
    """Return the discretisation error of a solution, as a share of its last change.

    `times` is the ratio of the numbers of sites, finer to coarser solution, above 1; `rate` the
    ratio of the changes by two successive fourfold increases of the number of sites.
    """
    return float((times ** (2 * _power_of(rate)) - 1) ** -0.5)


def _power_of(rate: float) -> float:
    """Return the power of the number of sites with which changes fall."""
    return -math.log(rate) / math.log(RATIO)


@dataclass(frozen=True, eq=False)
class _Estimator:
    """Errors in all and at the peak, of movements at the places of a linear response."""

    shares: FloatArray  # of each place in the total
    near: FloatArray  # weights of the places near the peak
    along: FloatArray  # direction of the displacement there

    @classmethod
    def of(
        cls, response: LinearResponse, lit: BoolArray, peak: FloatArray, along: FloatArray
    ) -> _Estimator:
        # No ray starts behind an obstacle: the field there is in no total.
        places = (
            np.clip(np.rint(p), 0, n - 1) for p, n in zip(response.places.T, lit.shape, strict=True)
        )
        shares = response.shares * lit[tuple(place.astype(np.int64) for place in places)]
        near = _near(peak, response.places, response.spacing)
        return cls(shares / shares.sum(), near, along)

    def __call__(self, moves: FloatArray, finer: FloatArray | None = None) -> ErrorEstimate:
        """Return the root mean squares, with mean squares of structure finer than the sites."""
        close = np.flatnonzero(self.near)
        finer = np.zeros(len(self.near)) if finer is None else finer
        squares = _with_finer(_mean_square(moves), finer)
        at_peak = ((moves[close] @ self.along) ** 2).mean(axis=1)
        at_peak = _with_finer(at_peak, finer[close] / 2)
        return root_of((squares * self.shares).sum(), (at_peak * self.near[close]).sum())


class Budget:
    """Computation of errors from the levels solved so far."""

    def __init__(
        self,
        plan: SitePlan,
        prepared: Prepared,
        noise: Callable[[], ImageNoise],
        options: InversionOptions,
        instrument: Instrument,
        *,
        is_shift_assumed: bool = False,
    ) -> None:
        self._plan, self._prepared = plan, prepared
        self._is_shift_assumed = is_shift_assumed
        self._noise, self.options = noise, options
        self.instrument = instrument if plan.measured else instrument.with_registration(0.0)
        self._places = _places(prepared)
        self._moves: dict[LevelSolution, FloatArray] = {}
        self._responses: dict[LevelSolution, Callable[[], LinearResponse]] = {}
        self._by_noise: dict[LinearResponse, tuple[FloatArray, FloatArray]] = {}
        self.reason = ""

    @cached_property
    def target(self) -> Target:
        """The image that the transport solves."""
        return Target.of(self._prepared.floored_image, self.options, self._plan.margin)

    def free_target(self, solutions: Sequence[LevelSolution]) -> None:
        """Compute the linear response, which needs the target, and free the target's memory."""
        self._response(_usable_levels(solutions))
        vars(self).pop("target", None)

    def needed(self, solutions: Sequence[LevelSolution]) -> float:
        """Return the factor by which more sites are needed.

        Their error must be within the accuracy, or small against the error by noise.
        """
        last = solutions[-1]
        is_usable, count = last.residual < _MAX_RESIDUAL, len(last.weights)
        if is_usable and count <= _MAX_RESPONSE_SITES < RATIO * count:
            self._begin_response(last, self.options.threads)  # beside the next level
        solved = _usable_levels(solutions)
        if len(solved) < 2:
            return math.inf
        rms = self._rms(solved[-1])
        squares, power = self._change(solved)
        error = float(np.sqrt(squares.mean()))
        share = share_of(error, rms)
        text = f"their discretisation error is about {share}{' of the displacement' * (rms > 0)}"
        allowed = self.options.accuracy * rms
        if self.resolves_pixels and self._by_pixels[0] > allowed:
            self.reason = ""
            return math.inf
        if error <= allowed:
            self.reason = f"{text}, below the accuracy of {100 * self.options.accuracy:g} %"
            return 0.0
        # An estimate for a uniform beam; the exact value is needed only where this is large.
        image_noise = self._noise()
        noise, _ = image_noise.displacements(image_noise.typical)
        if not self._is_noise_known:
            noise = 0.0
        if error < _MAX_SHARE_OF_NOISE * noise:
            response = self._response(solved)
            moves, finer = self._noisy_moves(response, solved[-1].level.spacing)
            by_noise = _with_finer(_mean_square(moves), finer)
            noise = math.sqrt(float((by_noise * response.shares).sum()))
        if error < SHARE_OF_NOISE * noise:
            self.reason = f"{text}, below a fifth of what the noise does ({share_of(noise, rms)})"
            return 0.0
        excess = error / max(allowed, SHARE_OF_NOISE * noise)
        return float(_SAFETY * excess ** (1 / power))

    def _rms(self, solution: LevelSolution) -> float:
        return float(np.sqrt(np.mean(np.sum(self._move(solution) ** 2, axis=0))))

    @cached_property
    def _by_pixels(self) -> tuple[float, float]:
        """Error of a field that takes pixels as constant, and an estimate of that by noise, px.

        The first blurs the light by 1/6 px², and moves it by 1/12 of its logarithm's slope;
        differences over two pixels blur the field about as much.
        """
        light = self._prepared.floored_image
        light = light / light.mean()
        squares = sum((light * slope**2).mean() for slope in np.gradient(np.log(light)))
        variance = float((self._noise().variance(light) / light).mean())
        noise, _ = self._noise().displacements(math.sqrt(variance))
        return math.sqrt(max(float(squares) - variance, 0.0)) / 6, noise

    @cached_property
    def _is_noise_known(self) -> bool:
        """Whether noise is a reason for fewer sites than the accuracy needs.

        For more than the default accuracy it is none if structure hides it: a bound is known alone.
        """
        is_usual = self.options.accuracy >= InversionOptions().accuracy
        return is_usual or not self._noise().is_bound

    @cached_property
    def resolves_pixels(self) -> bool:
        """Whether there is a level with a site in each pixel, and noise does not hide its gain."""
        if self._plan.pixels is None:
            return False
        gain, noise = self._by_pixels
        return not self._is_noise_known or gain > _LEAST_GAIN * noise

    def errors(
        self, solutions: Sequence[LevelSolution], potential: FloatArray, displacement: FloatArray
    ) -> ErrorBudget:
        """Return the errors of the last solution with its potential and displacement, (2, H, W)."""
        solved = _usable_levels(solutions)
        mask = self._prepared.mask
        variation, basis = self._beam_variation
        lit = lit_pixels(self._prepared.source, mask, self.options)
        length = np.where(lit, np.hypot(*displacement), 0.0)
        row, column = np.unravel_index(length.argmax(), length.shape)
        peak = np.array([row, column], dtype=np.float64)
        along = displacement[:, row, column] / max(length[row, column], 1e-300)
        response = self._response(solved)
        estimate = _Estimator.of(response, lit, peak, along)
        discretisation = None
        if len(solved) > 1:
            places, spacing = self._places, max(solved[-2].level.spacing, _stride(mask.shape))
            if solved[-1].level.is_of_pixels:
                places, squares = self._gap_in_pixels(solved[-1], displacement)
            else:
                squares, _ = self._change(solved)
            weights = _near(peak, places.T, spacing)
            discretisation = root_of(squares.mean(), (squares * weights).sum() / 2)
        lengths = ErrorEstimate(float(np.sqrt(np.mean(length[lit] ** 2))), float(length.max()))
        effects, sensitivities, sizes, assumed = self._by_effects(response, displacement, estimate)
        doubt = self._prepared.doubt
        if doubt is not None:
            effects["masked pixels"] = estimate(
                response.to(response.flux_of_image(doubt[None] / self._prepared.unit))
            )
        if not (lit | self._prepared.gaps).all():
            beside = _beside_dark(length, lit | self._prepared.gaps, solved[-1].level.spacing)
            effects["edges of dark areas"] = ErrorEstimate(
                float(np.sqrt(np.mean(beside[lit] ** 2))), float(beside[row, column])
            )
        if share := self.instrument.other_field:
            name = f"other field, {percent(share)}"
            effects[name], sizes[name] = lengths.times(share), share
        for cause, flux_errors in FLUX_ERRORS.items():
            samples = flux_errors(response, solved[-1], self.options)
            if samples is not None:
                effects[cause] = estimate(response.to(samples))
        by_percent = estimate(
            _TESTED_VARIATION * response.to(_unit_beams(response.level, *self._beam_waves))
        )
        beam = by_percent.times(variation / _TESTED_VARIATION) if variation else None
        components = self._beam.components
        if components is not None and basis == components.basis:
            beam = estimate(response.to(self._beams_of(response, components)))
        edge, sides = _error_by_edge(potential, displacement, mask, np.array([row, column]))
        return ErrorBudget(
            peak=lengths.at_peak,
            rms=lengths.rms,
            discretisation=discretisation,
            noise=estimate(*self._noisy_moves(response, solved[-1].level.spacing)),
            by_counts=estimate(*self._noisy_moves(response, 1.0)),
            effects=effects,
            edge=edge,
            sides=sides,
            beam=beam,
            beam_sensitivity=by_percent,
            sensitivities=sensitivities,
            sizes=sizes,
            beam_variation=variation,
            beam_scale=self._beam.length,
            beam_basis=basis,
            noise_correlation=self._noise().correlation_length,
            noise_is_bound=self._noise().is_bound,
            assumed=assumed,
        )

    def _by_effects(
        self, response: LinearResponse, displacement: FloatArray, estimate: _Estimator
    ) -> tuple[
        dict[str, ErrorEstimate], dict[str, ErrorEstimate], dict[str, float], tuple[str, ...]
    ]:
        """Return stated effects, sensitivities, sizes, all by name, and which were assumed."""
        prepared = self._prepared.in_units()
        shot = SolvedShot(
            displacement=displacement,
            source=prepared.source,
            mask=prepared.lit,
            sites=response.sites,
            fluxes=(response.flux, response.level.mass),
            areas=response.areas(prepared.lit),
            diffused=response.diffusion(),
            flux_of_source=response.flux_of_source,
            seed=self.options.seed,
        )
        effects: dict[str, ErrorEstimate] = {}
        sensitivities: dict[str, ErrorEstimate] = {}
        sizes: dict[str, float] = {}
        assumed: tuple[str, ...] = ()
        tests: list[tuple[dict[str, ErrorEstimate], str, FloatArray]] = []
        for each in EFFECTS:
            stated = each.stated(self.instrument)
            for size, errors in ((each.tested, sensitivities), (stated, effects)):
                if size:
                    tests.append((errors, each.name(size), each.pattern(shot, size)))
            if stated:
                sizes[each.name(stated)] = stated
                if each.key == "registration" and self._is_shift_assumed:
                    assumed = (each.name(stated),)
        # All at once, because the solver needs as long for one as for several.
        moves = response.to(np.concatenate([pattern for *_, pattern in tests]))
        ends = np.cumsum([len(pattern) for *_, pattern in tests])
        for (errors, name, _), part in zip(tests, np.split(moves, ends[:-1], axis=1), strict=True):
            errors[name] = estimate(part)
        return effects, sensitivities, sizes, assumed

    @cached_property
    def beam_difference(self) -> float:
        """Relative r.m.s. difference of image and source outside the object.

        Without what the stated registration of the source explains.
        """
        prepared, patterns = self._prepared.in_units(), None
        if self.instrument.registration:
            source = np.where(prepared.mask, prepared.source, prepared.source[prepared.mask].mean())
            patterns = self.instrument.registration * motions(source)
        return beam_difference(prepared, self._noise(), patterns)

    @cached_property
    def _beam_variation(self) -> tuple[float, str]:
        """Relative difference of beam and source, and its origin."""
        observed = self.beam_difference
        if (components := self._beam.components) is not None:
            # Where their r.m.s. was measured, a larger difference may be chance.
            most = _MAX_BEAM_DEVIATIONS if components.basis == "outside" else 1.0
            is_within = observed <= most * self._beam.rms
            return (self._beam.rms, components.basis) if is_within else (observed, "seen")
        if observed > self._beam.rms:
            return observed, "seen"
        if self.instrument.beam_rms is not None:
            return self._beam.rms, "stated"
        return self._beam.rms, "reference" if self._plan.measured else "assumed"

    @cached_property
    def _beam(self) -> BeamPrior:
        measured = self._plan.measured
        return self.instrument.beam_of(measured=measured, source=self._prepared.source)

    def _move(self, solution: LevelSolution) -> FloatArray:
        """Return the displacement at the places, shape (2, n), as in the read-out."""
        if solution not in self._moves:
            places = self._places.T + self._plan.margin_width
            around = (places[:, None] + _AROUND).reshape(-1, 2)
            y_high, y_low, x_high, x_low = solution.surface(around).reshape(-1, len(_AROUND)).T
            self._moves[solution] = np.stack([y_low - y_high, x_low - x_high]) / 2
        return self._moves[solution]

    def _change(self, solved: Sequence[LevelSolution]) -> tuple[FloatArray, float]:
        """Estimate squared discretisation errors, and the power of the site count they follow."""
        times = len(solved[-1].weights) / len(solved[-2].weights)
        # With less than four times the sites, the rate of the levels before is used.
        full_steps = solved if times > _MIN_STEP or len(solved) < 3 else solved[:-1]
        moves = [self._move(solution) for solution in full_steps[-3:]]
        changes = [float(((fine - coarse) ** 2).mean()) for coarse, fine in pairwise(moves)]
        rate = _USUAL_RATE
        if len(changes) > 1 and changes[0] > 0:
            rate = float(np.clip(np.sqrt(changes[1] / changes[0]), *_RATES))
        last = ((self._move(solved[-1]) - self._move(solved[-2])) ** 2).sum(axis=0)
        return last * discretisation_share(times, rate) ** 2, _power_of(rate)

    def _gap_in_pixels(
        self, solution: LevelSolution, displacement: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Estimate squared discretisation errors where each pixel is a cell; return their places.

        The displacement is the mean of two, by the potential and by the cells' centroids: half of
        their difference is about its error in smooth images. At jumps it is that of the light's
        place in a pixel: some times the change of it from slopes of second to fourth order.
        """
        sites = solution.level.sites - self._plan.margin_width
        inside = ((sites > -0.5) & (sites < np.array(self._prepared.mask.shape) - 0.5)).all(axis=1)
        rows, columns = np.rint(sites[inside].T).astype(np.int64)
        gap = solution.displacement[inside].T - displacement[:, rows, columns]
        light = self._prepared.floored_image
        changes = (
            np.abs(correlate1d(light, _FOURTH_LESS_SECOND, axis)[rows, columns]) for axis in (0, 1)
        )
        moved = sum(change**2 for change in changes) / light[rows, columns] ** 2
        return np.stack([rows, columns]), (gap**2).sum(axis=0) + (_AT_JUMPS / 12) ** 2 * moved

    def _response(self, solved: Sequence[LevelSolution]) -> LinearResponse:
        few = [candidate for candidate in solved if len(candidate.weights) <= _MAX_RESPONSE_SITES]
        return self._begin_response(few[-1] if few else self._coarser(solved[-1]), 1)()

    def _begin_response(
        self, solution: LevelSolution, threads: int | None
    ) -> Callable[[], LinearResponse]:
        """Begin to compute a response, if that has not begun; return a function that waits for it.

        With one thread it is computed when it is waited for.
        """
        if solution not in self._responses:
            work = partial(LinearResponse, solution, self.target, self._plan)
            self._responses[solution] = begin(work, threads)
        return self._responses[solution]

    def _coarser(self, solution: LevelSolution) -> LevelSolution:
        for earlier in self._responses:
            return earlier
        levels = self._plan.levels
        few = sum(count <= _MAX_RESPONSE_SITES for count in levels.counts)
        level = levels[max(few - 1, 0)]
        objective = self.target.objective(level)
        weights, _ = with_full_cells(objective, 2 * solution.surface(level.sites))
        return LevelSolution.of_level(level, objective, Solution(weights, math.nan, 0, False))

    def _noisy_moves(
        self, response: LinearResponse, spacing: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacements by noise, and the mean square that only this spacing resolves."""
        if response not in self._by_noise:
            rng = np.random.default_rng(self.options.seed)
            mean = self._prepared.source[self._prepared.mask].mean() / self._prepared.unit
            brightness = response.flux / (response.area * mean)
            variance = self._noise().variance(brightness) * mean**2 * response.area
            variance *= self._noise().clumping
            noise = np.sqrt(variance) * rng.normal(size=(_NOISE_SAMPLES, len(variance)))
            self._by_noise[response] = response.to(noise), variance
        moves, variance = self._by_noise[response]
        return moves, response.finer(variance, spacing, self._noise().grain)

    @property
    def _beam_waves(self) -> tuple[float, int]:
        """Length of the waves of another beam, px, and their seed."""
        return self._beam.length * min(self._prepared.mask.shape), self.options.seed

    def _beams_of(self, response: LinearResponse, components: BeamComponents) -> FloatArray:
        """Return the flux that cells gain from beams that vary in certain shapes."""
        level, block = response.level, components.block
        mass = level.mass
        places = (response.sites.T + 0.5) / block - 0.5
        width = max(response.spacing / block, 1.0) / 3  # a cell is a mean
        smooth = [gaussian_filter(pattern, width) for pattern in components.patterns]
        shapes = [mass * map_coordinates(p, places, order=1, mode="nearest") for p in smooth]
        waves = components.rest * _unit_beams(level, *self._beam_waves)
        samples = np.sqrt(len(shapes) + len(waves)) * np.stack(
            [*shapes, *waves / np.sqrt(len(waves))]
        )
        return np.asarray(samples - samples.sum(axis=1, keepdims=True) * mass / mass.sum())


@lru_cache(maxsize=4)
def _unit_beams(level: SiteLevel, length: float, seed: int) -> FloatArray:
    """Return the flux that cells gain from random beams of r.m.s. 1, shape (k, n)."""
    mass = level.mass
    samples = random_waves(level.sites, length, _BEAM_SAMPLES, np.random.default_rng(seed))
    for sample in samples:
        sample -= (mass * sample).sum() / mass.sum()
        sample /= np.sqrt((mass * sample**2).sum() / mass.sum())
    return np.asarray(mass * samples)


@lru_cache(maxsize=4)
def _nearest_sites(level: SiteLevel) -> tuple[IntArray, int]:
    """Return the nearest site of squares as wide as the spacing, and how many make a row."""
    height, width = (int(side / level.spacing) + 1 for side in level.shape)
    middles = (np.indices((height, width)).reshape(2, -1).T + 0.5) * level.spacing - 0.5
    return np.asarray(KDTree(level.sites).query(middles)[1]), width


def _solver_gap(
    response: LinearResponse, solution: LevelSolution, options: InversionOptions
) -> FloatArray:
    gap = solution.flux - solution.level.mass
    # The nearest of the few sites is looked up by squares.
    nearest, width = _nearest_sites(response.level)
    rows, columns = ((solution.level.sites + 0.5) / response.spacing).astype(np.int64).T
    group = nearest[rows * width + columns]
    return np.bincount(group, gap, len(response.flux)).astype(np.float64)[None]


def _error_by_edge(
    potential: FloatArray, displacement: FloatArray, mask: BoolArray, peak: IntArray
) -> tuple[ErrorEstimate, tuple[str, ...]]:
    """Return the error of a field by what may lie beyond the edge, and the sides it comes from."""
    step = -(-min(mask.shape) // _EDGE_PLACES)
    plane, down, right, used = (
        block_means(values, step) for values in (potential, *displacement, mask)
    )
    changes = edge_changes(plane, np.array([down, right]), step)[:, 1:]
    squares = used * np.einsum("kcyx,kcyx->yx", changes, changes)
    row, column = peak // step
    along = displacement[:, *peak] / max(float(np.hypot(*displacement[:, *peak])), 1e-300)
    at_peak = ((changes[:, :, row, column] @ along) ** 2).sum()
    return root_of(squares.mean() / used.mean(), at_peak), edge_sides(squares)


FluxErrors = Callable[[LinearResponse, LevelSolution, InversionOptions], FloatArray | None]

FLUX_ERRORS: dict[str, FluxErrors] = {"solver": _solver_gap}
"""Causes of flux errors, with functions that return them in each cell of a response.

A function takes the response, of n cells, the solution of the finest level and the options. It
returns k independent samples of the error, shape (k, n), or None if the options exclude it. Each
sample sums to about 0: the total flux of the image is scaled to that of the source.
"""


def _beside_dark(length: FloatArray, lit: BoolArray, spacing: float) -> FloatArray:
    """Return the error of a field beside pixels from which no ray starts, (H, W), px.

    Sites there lie on both sides of the edge, so that the field is that of a place up to their
    spacing away: half of its range over as far.
    """
    reach = max(round(spacing), 1)
    square = np.ones((2 * reach + 1, 2 * reach + 1), bool)
    highest = maximum_filter(np.where(lit, length, -np.inf), footprint=square)
    lowest = minimum_filter(np.where(lit, length, np.inf), footprint=square)
    return np.where(binary_dilation(~lit, square) & lit, (highest - lowest) / 2, 0.0)


def _mean_square(moves: FloatArray) -> FloatArray:
    """Return the mean square length over the samples, (t, k, 2), at each triangle."""
    return np.asarray(np.einsum("tkc,tkc->t", moves, moves) / moves.shape[1])


def _with_finer(squares: FloatArray, finer: FloatArray) -> FloatArray:
    """Add the mean squares of finer waves, which are negative where noise lacks waves."""
    return np.asarray(np.maximum(squares + finer, _LEAST_NOISE * squares))


def _usable_levels(solutions: Sequence[LevelSolution]) -> list[LevelSolution]:
    """Return the last solution, after the coarser ones that lead to it."""
    coarser = [solution for solution in solutions[:-1] if solution.residual < _MAX_RESIDUAL]
    last = solutions[-1]
    return [*(solution for solution in coarser if len(solution.weights) < len(last.weights)), last]


def _places(prepared: Prepared) -> FloatArray:
    """Return pixels of a grid inside the image and its mask, shape (2, n)."""
    shape = prepared.mask.shape
    stride = _stride(shape)
    rows, columns = (np.arange(1 + (n - 2) % stride // 2, n - 1, stride) for n in shape)
    grid = np.array(np.meshgrid(rows, columns, indexing="ij")).reshape(2, -1)
    used = grid[:, prepared.mask[tuple(grid)]]
    return (used if used.size else grid).astype(np.float64)


def _stride(shape: tuple[int, ...]) -> int:
    return -(-max(shape) // _PLACES)


def _near(peak: FloatArray, places: FloatArray, spacing: float) -> FloatArray:
    distance = np.hypot(*(places - peak).T)
    close = distance <= max(_NEAR * spacing, float(distance.min()))
    return np.asarray(close / close.sum())
