"""Likeliest cause of a misfit: rivals of a fit are compared by their evidence, `compare_rivals`.

A rival frees one more quantity. It is fitted from the best unknowns, and its log evidence is that
of Laplace: by how much the objective falls, less log(s / σ) for each of its numbers, of which the
prior has the standard deviation s and the images leave σ open, about (`log_shrinkage`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv.fitting.conjugate_gradients import SoftModes
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import FITTED_VARIANCE, Imperfect
from napari_shadowinv.fitting.measurements import FitData, strengths_of
from napari_shadowinv.fitting.parallel import OnStep, run_in_parallel
from napari_shadowinv.fitting.preconditioner import Preconditioner
from napari_shadowinv.fitting.search import (
    FIRST_SMOOTHNESS,
    SMOOTHNESS_RATIO,
    Minimum,
    in_recorded_pixels,
    settle_minimum,
)
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.instrument.effects import Absorption, LitObject
from napari_shadowinv.instrument.shapes import Shapes, beam_shapes, shapes_between
from napari_shadowinv.options import UNKNOWN_BEAM_RMS, BeamPrior
from napari_shadowinv.physics.setup import Setup

_CAUSES = {
    "beam": "a beam that differs from its source: record a reference, or fit the beam as unknown",
    "beam_between": "beams that differ between energies: state by how much",
    "absorption": "absorption or scattering by the object: state by how much",
    "shift": "a shift between the images: align them by a shift",
    "scale": "a turn or another scale of an image: align the images, affine",
    "brightness": "brightness that differs from the source's: free the brightness",
    "energy": "energies that differ from those stated: check them",
    "electric field": "an electric field beside the magnetic one: fit both, B and E",
    "blur": "blur beyond the point spread: give the point spread, or source size and resolution",
    "background": "a dark level: subtract it from the images",
    "gamma": "a response that is not linear: linearise the images",
}
_ALIGNED = {"shift": np.array([True, False, False] * 2), "scale": np.ones(6, bool)}


@dataclass(frozen=True)
class Rival:
    """A scene that frees some quantities, of which the last is its cause, and where it starts."""

    frees: tuple[str, ...]
    scene: Scene
    unknowns: Unknowns
    tried: int = 0  # numbers that are not fitted, but tried

    def descend(self, start: Minimum, on_step: OnStep) -> Minimum:
        """Return the minimum near a start."""
        return settle_minimum(self.scene, start, on_step, "rivals", least_gain=1.0)

    def log_evidence(self, start: Minimum, on_step: OnStep) -> float:
        """Return the log evidence in recorded pixels, but for a constant."""
        # In larger pixels the model itself is off, which the most flexible rival explains best.
        end = self.descend(in_recorded_pixels(self.scene, start), on_step)
        scene = end.coarsen(self.scene)
        tried = self.tried * float(np.log(np.count_nonzero(scene.weights))) / 2
        return -end.value - log_shrinkage(scene, end.unknowns) - tried


def log_shrinkage(scene: Scene, unknowns: Unknowns) -> float:
    """Return the sum of log(s / σ) of all numbers, and of potentials after the first, about."""
    scales = Preconditioner(scene)
    ratios = scales.others * np.sqrt(scene.prior.flat_weights(unknowns))
    total = -float(np.log(ratios[ratios > 0]).sum())
    for m in range(1, scene.strengths.shape[1]):
        field = replace(
            scene,
            strengths=scene.strengths[:, m : m + 1],
            smoothness=scene.smoothness[m : m + 1],
            imperfect=Imperfect(),
        )
        total += Preconditioner(field).log_ratio
    return total


@dataclass(frozen=True)
class Comparison:
    """Log evidence of rivals less the fit's, by the quantities that they free."""

    gains: dict[tuple[str, ...], float]

    def cause(self, decisive: float = 10.0, share: float = 0.03) -> str:
        """Return the likeliest cause as a clause; "" if none wins by a `decisive` log evidence.

        It has to win by a `share` of its gain, too: so inexact are descents and model. Of rivals
        that are about as likely, one wins if all others free its quantities, too.
        """
        most = max(self.gains.values())
        least = most - max(decisive, share * most)
        likely = [frees for frees, gain in self.gains.items() if gain > least]
        simple = [frees for frees in likely if all(set(frees) <= set(rival) for rival in likely)]
        if most < decisive or not simple:
            return ""
        return f"{_CAUSES[simple[0][-1]]} (log evidence +{self.gains[simple[0]]:.0f})"

    @property
    def tried(self) -> str:
        """All causes that were looked for, the likeliest first."""
        ranked = sorted(self.gains, key=lambda frees: -self.gains[frees])
        return ", ".join(_CAUSES[frees[-1]].partition(":")[0] for frees in ranked)


def compare_rivals(
    data: FitData,
    scene: Scene,
    best: Minimum,
    on_step: OnStep,
    *,
    only: str = "",
    hopeless: float = 3.0,
    behind: float = 10.0,
) -> Comparison:
    """Compare a fit with rivals that free one quantity each, or `only` one cause.

    A rival is left out beyond `hopeless` times the least objective in larger pixels. Where a number
    is tried, the objective in larger pixels may be above the fit's by `behind`: on images with and
    without blur a rival that was worse there was worse in recorded pixels.
    """
    # A field that hides a flaw is rougher than any that rivals need.
    least = SMOOTHNESS_RATIO**2 * FIRST_SMOOTHNESS
    scene = replace(scene, smoothness=np.maximum(scene.smoothness, least))
    rivals = [Rival((), scene, best.unknowns), *_rivals(data, scene, best)]
    rivals = [each for each in rivals if not only or each.frees in ((), (only,))]
    threads = available_threads(scene.threads)

    def start(rival: Rival) -> Minimum:
        return replace(best, unknowns=rival.unknowns, modes=SoftModes())

    works: list[Any] = [partial(each.descend, start(each)) for each in rivals]
    ends = run_in_parallel(works, threads, on_step)
    limit = hopeless * min(end.value for end in ends)
    pairs = list(zip(rivals, ends, strict=True))
    most = {0: limit, 1: min(limit, ends[0].value + behind)}
    hopeful = [(rival, end) for rival, end in pairs[1:] if end.value <= most[rival.tried]]
    gains = {rival.frees: -np.inf for rival in rivals[1:]}
    if not hopeful:
        return Comparison(gains)
    works = [partial(rival.log_evidence, end) for rival, end in [pairs[0], *hopeful]]
    usual, *values = run_in_parallel(works, threads, on_step)
    for (rival, end), value in zip(hopeful, values, strict=True):
        # A sharp field follows blurred images in recorded pixels, but not in larger ones.
        in_larger = ends[0].value - end.value if rival.tried else 0.0
        gains[rival.frees] = max(value - usual + in_larger, gains[rival.frees])
    return Comparison(gains)


def transmission_of(data: FitData, minimum: Minimum, rms: float) -> Shapes:
    """Return the unknown transmission of the object that was found."""
    height, width = data.size
    blocks = np.ones((1, minimum.bin, minimum.bin))
    displacement = np.kron(minimum.displacement.sum(axis=0), blocks)[:, :height, :width]
    used = np.asarray((data.scene.weights[:, :height, :width] > 0).any(axis=0))
    lit = LitObject(displacement=displacement, source=used.astype(np.float64), mask=used)
    return Absorption().shapes(lit, rms, FITTED_VARIANCE).pad(data.around)


def _rivals(data: FitData, scene: Scene, best: Minimum) -> Iterator[Rival]:
    for width in (1.5, 3.0):  # px
        widths = [
            float(np.hypot(psf, width)) if isinstance(psf, float) else psf for psf in scene.psf
        ]
        blurred = replace(scene, psf=widths)
        yield Rival(("blur",), blurred, best.unknowns, tried=1)
    yield from _with_imperfections(data, scene, best)
    if data.single:
        return
    for key, free in _ALIGNED.items():
        if (free & ~scene.free_frames).any():
            frees = tuple(_ALIGNED)[: list(_ALIGNED).index(key) + 1]
            yield Rival(frees, replace(scene, free_frames=free), best.unknowns)
    if not scene.free_brightness:
        yield Rival(("brightness",), replace(scene, free_brightness=True), best.unknowns)
    if data.setups and data.fields == ("B",):
        yield from _with_electric_field(scene, best, data.setups)


def _with_imperfections(data: FitData, scene: Scene, best: Minimum) -> Iterator[Rival]:
    imperfect = scene.imperfect
    used = np.asarray((data.scene.weights > 0).any(axis=0))[: data.size[0], : data.size[1]]

    def rival(frees: tuple[str, ...], wider: Imperfect) -> Rival:
        is_free = scene.free_brightness or "brightness" in frees
        freed = replace(scene, imperfect=wider, free_brightness=is_free, held=frozenset())
        return Rival(frees, freed, wider.adapt(best.unknowns, imperfect))

    def with_shapes(frees: tuple[str, ...], shapes: Shapes) -> Rival:
        others = tuple(each for each in imperfect.shapes if each.key != shapes.key)
        return rival(frees, replace(imperfect, shapes=(*others, shapes)))

    priors = {"background": 0.2} if data.single else {"background": 0.2, "gamma": 0.3}
    for key, size in priors.items():
        if key not in imperfect.keys:
            responses = {**imperfect.responses, key: size}
            yield rival(("brightness", key), replace(imperfect, responses=responses))
    if data.single:
        return
    if imperfect.other_strengths is None:
        # A trend of the displacement with the energy.
        sizes = np.abs(scene.strengths)
        trend = np.log(np.where(sizes > 0, sizes, 1.0)) * scene.strengths
        yield rival(("energy",), replace(imperfect, other_strengths=0.3 * trend))
    wide = BeamPrior(rms=UNKNOWN_BEAM_RMS, length=data.beam.length, between=0.1)
    if not data.unknown:
        shapes = beam_shapes(wide, used, FITTED_VARIANCE).pad(data.around)
        yield with_shapes(("brightness", "beam"), shapes)
    between = shapes_between(wide, used, FITTED_VARIANCE).pad(data.around)
    yield with_shapes(("brightness", "beam", "beam_between"), between)
    if "absorption" not in imperfect.keys:
        yield with_shapes(("brightness", "absorption"), transmission_of(data, best, 0.3))


def _with_electric_field(scene: Scene, best: Minimum, setups: Sequence[Setup]) -> Iterator[Rival]:
    strengths = strengths_of(setups, ("B", "E"))
    strengths = strengths / strengths[0]
    if np.linalg.matrix_rank(strengths, tol=0.02) < 2:
        return
    smoothness = np.append(scene.smoothness, FIRST_SMOOTHNESS[None], axis=0)
    both = replace(scene, strengths=strengths, smoothness=smoothness)
    potentials = np.concatenate([best.unknowns.potentials, 0 * best.unknowns.potentials])
    yield Rival(("energy", "electric field"), both, best.unknowns._replace(potentials=potentials))
