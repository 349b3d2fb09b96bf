"""What makes an answer wrong, and by how much; and when more sites would not make it better.

- the errors of a result: `Errors`, of which each is an `ErrorEstimate`
- found while levels are solved, and asked when there are enough: `Budget`

Between two levels, one with four times the sites of the other, the displacement changes by what the
coarser one got wrong. Changes fall by nearly the same rate from level to level, and as each is of
finer waves than the one before, their squares add.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import KDTree

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.inversion.noise import ImageNoise
from napari_shadowinv.inversion.normalise import Prepared
from napari_shadowinv.inversion.response import LinearResponse
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.transport.minimise import with_full_cells
from napari_shadowinv.transport.objective import Solution
from napari_shadowinv.transport.sites import RATIO, SitePlan
from napari_shadowinv.transport.solvers import LevelSolution, Target

__all__ = ["Budget", "ErrorEstimate", "Errors"]

_PLACES = 48  # along the longer side, where levels are compared
_USUAL_RATE, _RATES = 0.35, (0.25, 0.7)  # of the change between levels to the one before
_WHOLE = 3.0  # times the sites of the level before: a whole step
_SAFETY = 1.3
_SOLVED = 0.1  # largest residual of a level that tells anything
_SHARE_OF_NOISE, _MUCH_NOISE = 0.2, 0.8
_NOTABLE = 0.02  # of the largest error

_RESPONDING = 4500  # sites, at most, whose linear response is worked out
_NOISE_SAMPLES, _BEAM_SAMPLES, _WAVES = 16, 8, 16
_NEAR = 2.5  # site spacings


class ErrorEstimate(NamedTuple):
    """A standard error of the displacement, px."""

    rms: float  # length of the error, root mean square over the image
    at_peak: float  # of the largest displacement


@dataclass(frozen=True)
class Errors:
    """The error budget of an inversion: standard errors of the displacement, in px.

    It holds what is named here. It does not hold what a blurred image, crossing rays, or a field
    that the image's edge cuts off do.

    Attributes
    ----------
    peak, rms : float
        Largest displacement and its root mean square over the image, px, for comparison.
    discretisation : ErrorEstimate
        What more sites would change; NaN if there was no coarser level to compare with.
    noise : ErrorEstimate
        What the noise of image and source does.
    solver : ErrorEstimate
        What the flux that the solver left in wrong cells does.
    beam : ErrorEstimate or None
        What it would do if the beam differed from what was assumed as the options'
        `beam_variation` and `beam_scale` say; None if the source was measured.
    """

    peak: float
    rms: float
    discretisation: ErrorEstimate
    noise: ErrorEstimate
    solver: ErrorEstimate
    beam: ErrorEstimate | None = None

    @property
    def of_peak(self) -> dict[str, float]:
        """The errors at the peak that matter, by name, as shares of the peak."""
        least = _NOTABLE * max((one.at_peak for one in self._known.values()), default=0.0)
        if not self.peak > 0:
            return {}
        shares = {name: one.at_peak / self.peak for name, one in self._known.items()}
        return {name: share for name, share in shares.items() if share > least / self.peak}

    @property
    def _known(self) -> dict[str, ErrorEstimate]:
        found = {"noise": self.noise, "discretisation": self.discretisation, "solver": self.solver}
        return {name: one for name, one in found.items() if not math.isnan(one.rms)}

    def missed(self, accuracy: float, why: str) -> str:
        """Say so, and why, if discretisation misses an accuracy and shows beside the noise."""
        error = self.discretisation.rms
        if not error > max(accuracy * self.rms, _SHARE_OF_NOISE * self.noise.rms):
            return ""
        return (
            f"the accuracy of {100 * accuracy:.2g} % is not reached: {why}, the discretisation "
            f"error is about {_percent(error, self.rms)} of the displacement; give a larger number "
            "of sites"
        )

    def scaled(self, factor: float) -> Errors:
        """Return the same in another unit, of which a displacement of 1 px is `factor`."""
        one = {
            field.name: _times(getattr(self, field.name), factor)
            for field in dataclasses.fields(self)
        }
        return Errors(**one)

    def rows(self, options: InversionOptions) -> list[tuple[str, str]]:
        """Say in words what is not known of the displacement: names and texts."""
        told = ", ".join(
            f"{name} {_percent(one.rms, self.rms)}" for name, one in self._known.items()
        )
        told = f"{told} of the displacement (r.m.s.); blur and crossing rays are not in it"
        if math.isnan(self.discretisation.rms):
            told += "; discretisation was not estimated, as only one level was solved"
        rows = [("errors", told)]
        if self.beam is not None:
            rows.append(
                (
                    "beam",
                    f"not measured: if it varies by {100 * options.beam_variation:.2g} % (r.m.s.) "
                    f"over {options.beam_scale:.2g} of the image's shorter side, the displacement "
                    f"is off by {_percent(self.beam.rms, self.rms)} (r.m.s.), its peak by "
                    f"{_percent(self.beam.at_peak, self.peak)}",
                )
            )
        return rows

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> Errors:
        """Rebuild them from what a file holds of them."""
        told: dict[str, Any] = {
            name: ErrorEstimate(*value) if isinstance(value, list | tuple) else value
            for name, value in content.items()
        }
        return cls(**told)


class Budget:
    """Works out errors from the levels that are solved, and tells when there are enough."""

    def __init__(
        self,
        plan: SitePlan,
        prepared: Prepared,
        noise: ImageNoise,
        options: InversionOptions,
    ) -> None:
        self._plan, self._prepared = plan, prepared
        self._noise, self._options = noise, options
        self._places = _places(prepared)
        self._moves: dict[LevelSolution, FloatArray] = {}
        self._responses: dict[LevelSolution, LinearResponse] = {}
        self._by_noise: dict[LinearResponse, tuple[FloatArray, FloatArray]] = {}
        self.reason = ""

    @cached_property
    def _target(self) -> Target:
        return Target.of(self._prepared.floored_image, self._plan.margin, self._options)

    def needed(self, solutions: Sequence[LevelSolution]) -> float:
        """Return how many times as many sites are needed.

        Their error shall be within the accuracy, or small beside what noise does.
        """
        solved = _solved(solutions)
        if len(solved) < 2:
            return math.inf
        rms = float(np.sqrt(np.mean(np.sum(self._move(solved[-1]) ** 2, axis=0))))
        squares, power = self._change(solved)
        error = float(np.sqrt(squares.mean()))
        told = f"their discretisation error is about {_percent(error, rms)} of the displacement"
        allowed = self._options.accuracy * rms
        if error <= allowed:
            self.reason = f"{told}, below the accuracy of {100 * self._options.accuracy:.2g} %"
            return 0.0
        # About, in a uniform beam; where that is small enough, it need not be known better.
        noise, _ = self._noise.displacements(self._noise.typical)
        if error < _MUCH_NOISE * noise:
            response = self._response(solved)
            moves, finer = self._noisy_moves(response, solved[-1].level.spacing)
            by_noise = (moves**2).sum(axis=2).mean(axis=1) + finer
            noise = math.sqrt(float((by_noise * response.shares).sum()))
        if error < _SHARE_OF_NOISE * noise:
            self.reason = f"{told}, below a fifth of what the noise does ({_percent(noise, rms)})"
            return 0.0
        excess = error / max(allowed, _SHARE_OF_NOISE * noise)
        return float(_SAFETY * excess ** (1 / power))

    def errors(self, solutions: Sequence[LevelSolution], displacement: FloatArray) -> Errors:
        """Return the errors of the last solution, whose displacement was read out, (2, H, W)."""
        solved = _solved(solutions)
        mask = self._prepared.mask
        length = np.where(mask, np.hypot(*displacement), 0.0)
        row, column = np.unravel_index(length.argmax(), length.shape)
        peak = np.array([row, column], dtype=np.float64)
        along = displacement[:, row, column] / max(length[row, column], 1e-300)
        response = self._response(solved)
        near = _near(peak, response.places, response.spacing)

        def estimate(moves: FloatArray, finer: FloatArray | float = 0.0) -> ErrorEstimate:
            squares = (moves**2).sum(axis=2).mean(axis=1) + finer
            at_peak = ((moves * along).sum(axis=2) ** 2).mean(axis=1) + finer / 2
            return _roots((squares * response.shares).sum(), (at_peak * near).sum())

        discretisation = ErrorEstimate(math.nan, math.nan)
        if len(solved) > 1:
            squares, _ = self._change(solved)
            spacing = max(solved[-2].level.spacing, _stride(mask.shape))
            close = _near(peak, self._places.T, spacing)
            discretisation = _roots(squares.mean(), (squares * close).sum() / 2)
        return Errors(
            peak=float(length.max()),
            rms=float(np.sqrt(np.mean(length[mask] ** 2))),
            discretisation=discretisation,
            noise=estimate(*self._noisy_moves(response, solved[-1].level.spacing)),
            solver=estimate(response.to(self._left_by_solver(response, solved[-1]))),
            beam=None if self._plan.measured else estimate(response.to(self._beams(response))),
        )

    def _move(self, solution: LevelSolution) -> FloatArray:
        """Displacement at the places, shape (2, n), as it is read out."""
        if solution not in self._moves:
            places = self._places.T + self._plan.margin_width
            steps = np.concatenate([places + one for one in ((1, 0), (-1, 0), (0, 1), (0, -1))])
            down, up, right, left = np.split(solution.surface(steps), 4)
            self._moves[solution] = np.stack([up - down, left - right]) / 2
        return self._moves[solution]

    def _change(self, solved: Sequence[LevelSolution]) -> tuple[FloatArray, float]:
        """Square of the discretisation error at each place, about, and the power of its fall.

        It falls as that power of the number of sites.
        """
        times = len(solved[-1].weights) / len(solved[-2].weights)
        # With less than four times the sites, the rate is that of the levels before.
        whole = solved if times > _WHOLE or len(solved) < 3 else solved[:-1]
        moves = [self._move(one) for one in whole[-3:]]
        changes = [float(((fine - coarse) ** 2).mean()) for coarse, fine in pairwise(moves)]
        rate = _USUAL_RATE
        if len(changes) > 1 and changes[0] > 0:
            rate = float(np.clip(np.sqrt(changes[1] / changes[0]), *_RATES))
        power = -math.log(rate) / math.log(RATIO)
        last = ((self._move(solved[-1]) - self._move(solved[-2])) ** 2).sum(axis=0)
        return last / (times ** (2 * power) - 1), power

    def _response(self, solved: Sequence[LevelSolution]) -> LinearResponse:
        few = [one for one in solved if len(one.weights) <= _RESPONDING]
        solution = few[-1] if few else self._coarser(solved[-1])
        if solution not in self._responses:
            self._responses[solution] = LinearResponse(solution, self._target, self._plan)
        return self._responses[solution]

    def _coarser(self, solution: LevelSolution) -> LevelSolution:
        """The same answer with fewer sites."""
        for known in self._responses:
            return known
        levels = self._plan.levels
        few = sum(count <= _RESPONDING for count in levels.counts)
        level = levels[max(few - 1, 0)]
        objective = self._target.objective(level)
        weights, _ = with_full_cells(objective, 2 * solution.surface(level.sites))
        return LevelSolution.of_level(level, objective, Solution(weights, math.nan, 0, False))

    def _noisy_moves(
        self, response: LinearResponse, spacing: float
    ) -> tuple[FloatArray, FloatArray]:
        """Displacements by noise, and the mean square of what only sites so close feel."""
        if response not in self._by_noise:
            rng = np.random.default_rng(self._options.seed)
            mean = self._prepared.source[self._prepared.mask].mean() / self._prepared.unit
            brightness = response.flux / (response.area * mean)
            variance = self._noise.variance(brightness) * mean**2 * response.area
            drawn = np.sqrt(variance) * rng.normal(size=(_NOISE_SAMPLES, len(variance)))
            self._by_noise[response] = response.to(drawn), variance
        moves, variance = self._by_noise[response]
        return moves, response.finer(variance, spacing)

    def _beams(self, response: LinearResponse) -> FloatArray:
        """What a beam that is not what was assumed would add to the cells."""
        rng = np.random.default_rng(self._options.seed)
        mass, sites = response.level.mass, response.level.sites
        length = self._options.beam_scale * min(self._prepared.mask.shape)
        drawn = np.empty((_BEAM_SAMPLES, len(mass)))
        for sample in drawn:
            waves = rng.normal(size=(2, _WAVES)) / length
            phases = rng.uniform(0, 2 * np.pi, _WAVES)
            sample[:] = np.cos((sites @ waves + phases).astype(np.float32)).sum(axis=1)
            sample -= (mass * sample).sum() / mass.sum()
            sample *= self._options.beam_variation / np.sqrt((mass * sample**2).sum() / mass.sum())
        return mass * drawn

    def _left_by_solver(self, response: LinearResponse, solution: LevelSolution) -> FloatArray:
        """What the solver has put into wrong cells."""
        gap = solution.flux - solution.level.mass
        # Which of the few sites each of the many is near is looked up by squares.
        size = response.spacing
        height, width = (int(side / size) + 1 for side in solution.level.shape)
        middles = (np.indices((height, width)).reshape(2, -1).T + 0.5) * size - 0.5
        nearest = KDTree(response.level.sites).query(middles)[1]
        rows, columns = ((solution.level.sites + 0.5) / size).astype(np.int64).T
        group = nearest[rows * width + columns]
        return np.bincount(group, gap, len(response.flux)).astype(np.float64)[None]


def _times(value: float | ErrorEstimate | None, factor: float) -> Any:
    if isinstance(value, ErrorEstimate):
        return ErrorEstimate(factor * value.rms, factor * value.at_peak)
    return None if value is None else factor * value


def _solved(solutions: Sequence[LevelSolution]) -> list[LevelSolution]:
    """The last solution, after those of coarser levels that lead to it."""
    found = [one for one in solutions[:-1] if one.residual < _SOLVED]
    last = solutions[-1]
    return [*(one for one in found if len(one.weights) < len(last.weights)), last]


def _places(prepared: Prepared) -> FloatArray:
    """Pixels of a grid inside the image and its mask, shape (2, n)."""
    shape = prepared.mask.shape
    stride = _stride(shape)
    rows, columns = (np.arange(1 + (n - 2) % stride // 2, n - 1, stride) for n in shape)
    grid = np.array(np.meshgrid(rows, columns, indexing="ij")).reshape(2, -1)
    used = grid[:, prepared.mask[tuple(grid)]]
    return (used if used.size else grid).astype(np.float64)


def _stride(shape: tuple[int, ...]) -> int:
    return -(-max(shape) // _PLACES)


def _near(peak: FloatArray, places: FloatArray, spacing: float) -> FloatArray:
    """Weights of the places around the peak."""
    distance = np.hypot(*(places - peak).T)
    close = distance <= max(_NEAR * spacing, float(distance.min()))
    return np.asarray(close / close.sum())


def _roots(square: float, square_at_peak: float) -> ErrorEstimate:
    return ErrorEstimate(math.sqrt(square), math.sqrt(square_at_peak))


def _percent(error: float, whole: float) -> str:
    return f"{100 * error / whole:.2g} %" if whole > 0 else "0 %"
