"""Fits with one more unknown, compared with the fit itself.

- the cause of a pattern in the residuals: `name_cause`
- whether the images are blurred by more than was given: `gain_by_blur`
- how likely a model makes the images: `log_evidence`
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from zlib import crc32

import numpy as np

from napari_shadowinv.fitting.descent import coarser
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.measurements import strengths_of
from napari_shadowinv.fitting.posterior import Posterior
from napari_shadowinv.fitting.search import HELD, MIDDLE, MIDDLE_SPACING, Found, OnStep, settled
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.setup import Setup

__all__ = ["gain_by_blur", "log_evidence", "name_cause"]

_WIDER_PX, _MUCH_WIDER_PX = (
    1.5,
    3.0,
)  # images that are blurred by 1 px or more are then explained better
# A free beam lowers Σχ² by at most 19 where the beam was right, by 584 and more where it was off.
_MIN_GAIN = 60.0
_AS_LIKELY = 0.7  # of the largest gain
# Of the excess of Σχ² over the number of pixels; a cause that explains less is doubtful.
_MIN_EXPLAINED_SHARE = 0.5
_BEAM_MODES, _FINE_BEAM_MODES = 8, 20
_BEAM_SPREAD = 0.3
_SHIFT = np.array([True, False, False] * 2)
_STEPS = 12
_PEDESTALS = 0.09, 0.17  # of each image's mean: dark levels of 10 and 20 % of the beam


@dataclass(frozen=True)
class _Rival:
    """A scene with one more unknown, the start of its search, and the cause that it stands for."""

    scene: Scene
    unknowns: Unknowns
    free_numbers: int
    cause: str


def name_cause(
    scene: Scene,
    best: Found,
    names: Sequence[str],
    setups: Sequence[Setup] | None,
    on_step: OnStep,
) -> str:
    """Return the likeliest reason why a fit leaves a pattern, as a clause; "" if none is likely.

    Each rival frees or changes one assumption, and is fitted from the best unknowns in pixels of
    two. The one that lowers Σχ² most, beyond one for each of its numbers, is named.

    Parameters
    ----------
    scene, best
        The fit that leaves a pattern, in pixels of two.
    names : sequence of str
        The fields.
    setups : sequence of Setup, optional
        The experiment of each image.
    on_step : callable
        Receives the stage and the objective.
    """
    pixels = replace(coarser(scene, MIDDLE), spacing=MIDDLE_SPACING)
    misfit = pixels.chi2(best.unknowns, pixels.ray_counts(best.unknowns)) - 1
    excess = float((misfit * (pixels.weights > 0).sum(axis=(1, 2))).sum())
    gains = []
    for rival in _rivals(scene, best, names, setups):
        start = Found(best.start, rival.unknowns, best.value, best.displacement)
        end = settled(rival.scene, start, on_step, "rivals", steps=_STEPS)
        gains.append((2 * (best.value - end.value) - rival.free_numbers, rival.cause))
    gains.sort(reverse=True)
    if not gains or gains[0][0] < _MIN_GAIN:
        return ""
    largest = gains[0][0]
    is_doubtful = largest < _MIN_EXPLAINED_SHARE * excess
    least = _MIN_GAIN if is_doubtful else _AS_LIKELY * largest
    # Two rivals may have the same cause.
    likely = dict.fromkeys(cause for gain, cause in gains if gain >= least)
    falls = f"Σχ² falls by {largest:.0f}"
    if is_doubtful:
        falls += f", of an excess of {excess:.0f}: something else is wrong, too"
    return f"{', or '.join(list(likely)[:2])} ({falls})"


def gain_by_blur(scene: Scene, best: Found, on_step: OnStep) -> float:
    """Return by how much a wider point spread lowers the objective; kernels stay."""
    return best.value - settled(_wider(scene, _WIDER_PX), best, on_step, "point spread").value


def log_evidence(
    scene: Scene, best: Found, names: Sequence[str], options: FitOptions, on_step: OnStep
) -> float:
    """Return the log evidence at the likeliest λ and κ, where it depends least on their accuracy.

    Parameters
    ----------
    scene, best
        The fit, in pixels of two.
    names : sequence of str
        The fields, whose random probes are the same for all models.
    options : FitOptions
        Its seed, and whether the smoothness was given.
    on_step : callable
        Receives the stage and the objective.
    """
    if options.smoothness is None:
        scene = replace(scene, smoothness=scene.smoothness / HELD)
    ended = settled(scene, best, on_step, "evidence", least_gain=0.1)
    middle = replace(coarser(scene, MIDDLE), spacing=MIDDLE_SPACING)
    chances = [np.random.default_rng([options.seed, crc32(name.encode())]) for name in names]
    report = partial(on_step, "evidence", ended.value)
    posterior = Posterior(middle, ended.unknowns, chances[0], report)
    return posterior.log_evidence(chances)


def _rivals(
    scene: Scene, best: Found, names: Sequence[str], setups: Sequence[Setup] | None
) -> Iterator[_Rival]:
    several = len(scene.images) > 1
    if several:
        yield from _with_free_beam(scene, best)
    if several and not scene.free_frames.any():
        shifted = replace(scene, free_frames=_SHIFT)
        cause = (
            "the images are not in register: a shift between them explains them better; align "
            "them (align='shift', --align shift)"
        )
        yield _Rival(shifted, best.unknowns, 2 * (len(scene.images) - 1), cause)
    if several and not scene.free_brightness:
        cause = (
            "the brightness of an image differs from its source's: a factor for each image "
            "explains them better; free the brightness (brightness='free', --brightness free)"
        )
        yield _Rival(replace(scene, free_brightness=True), best.unknowns, len(scene.images), cause)
    if several and setups and set(names) == {"B"}:
        yield from _with_electric_field(scene, best, setups)
    cause = "the images are blurred by more than the point spread that was given (psf, --psf)"
    for width in (_WIDER_PX, _MUCH_WIDER_PX):
        yield _Rival(_wider(scene, width), best.unknowns, 0, cause)
    cause = (
        "a constant lies under the images: with less of it they are explained better; subtract "
        "the detector's dark level"
    )
    for pedestal in _PEDESTALS:
        yield _Rival(_without_pedestal(scene, pedestal), best.unknowns, 0, cause)


def _with_free_beam(scene: Scene, best: Found) -> Iterator[_Rival]:
    """Beams that differ from the assumed one on long waves, or also on the object's scale."""
    advice = "give a reference of this shot, or fit the beam (source='unknown', --source unknown)"
    causes = {
        _BEAM_MODES: f"the beam differs from its source, smoothly over the image; {advice}",
        _FINE_BEAM_MODES: (
            "the object absorbs or scatters, or the beam has finer structure than its source; "
            "give a reference of this shot, or images in which the object absorbs less"
        ),
    }
    for modes, cause in causes.items():
        if modes <= scene.beam_modes:
            continue
        beam = np.zeros((modes, modes))
        old = scene.beam_modes
        beam[:old, :old] = best.unknowns.beam
        freed = replace(scene, beam_modes=modes, beam_spread=_BEAM_SPREAD, free_brightness=True)
        free_numbers = int((freed.prior.beam_weights > 0).sum())
        yield _Rival(freed, best.unknowns._replace(beam=beam), free_numbers, cause)


def _with_electric_field(scene: Scene, best: Found, setups: Sequence[Setup]) -> Iterator[_Rival]:
    strengths = strengths_of(setups, ("B", "E"), len(setups))
    strengths = strengths / strengths[0]
    if np.linalg.matrix_rank(strengths, tol=0.02) < 2:
        return
    both = replace(scene, strengths=strengths, smoothness=np.tile(scene.smoothness, (2, 1)))
    potentials = np.concatenate([best.unknowns.potentials, 0 * best.unknowns.potentials])
    # Of an added field the smoothness lets through about as many numbers as waves of 16 px.
    free_numbers = scene.images[0].size // 64
    cause = (
        "an electric field deflects beside the magnetic one; fit both (fields=('B', 'E'), "
        "--fields B,E)"
    )
    yield _Rival(both, best.unknowns._replace(potentials=potentials), free_numbers, cause)


def _wider(scene: Scene, added: float) -> Scene:
    widths = [
        float(np.hypot(width, added)) if isinstance(width, float) else width for width in scene.psf
    ]
    return replace(scene, psf=widths)


def _without_pedestal(scene: Scene, pedestal: float) -> Scene:
    """The images less a constant, brought back to their mean; so is their noise."""
    share = 1 - pedestal
    means = scene.images.sum(axis=(1, 2)) / np.maximum((scene.images != 0).sum(axis=(1, 2)), 1)
    images = (scene.images - pedestal * means[:, None, None]) / share
    return replace(scene, images=images, weights=scene.weights * share**2)
