"""Error bars of a fit, drawn around its best unknowns: `errors_by_noise`, `shifts_by_beam`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.beam_error import draw_variations
from napari_shadowinv.fitting.descent import finer
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.measurements import Measured
from napari_shadowinv.fitting.posterior import Posterior, Sample
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.inversion.budget import ASSUMED_VARIATION
from napari_shadowinv.options import FitOptions

__all__ = ["BeamShifts", "errors_by_noise", "largest_share", "shifts_by_beam"]

_BEAM_SAMPLES, _OPEN_BEAM_SAMPLES, _BEAM_SEED = 2, 3, 1
_SMOOTHED_ERRORS = 4.0  # px


def errors_by_noise(
    scene: Scene, samples: Sequence[Sample], size: tuple[int, int]
) -> FloatArray | None:
    """Return the standard deviation of each field's displacement in px, (M, 2, H, W)."""
    if not samples:
        return None
    changes = [sample.change for sample in samples]
    return _spread(scene, changes, size, _SMOOTHED_ERRORS)


def _spread(
    scene: Scene, changes: Sequence[Unknowns], size: tuple[int, int], width: float
) -> FloatArray:
    """Root of the mean square of the displacements, smoothed over a width in px."""
    height, across = size
    squares = np.zeros((scene.strengths.shape[1], 2, *scene.rays.size))
    for change in changes:
        potentials = finer(change).potentials
        squares += np.stack([scene.rays.displacement(p) for p in potentials]) ** 2
    smooth = gaussian_filter(squares / len(changes), (0, 0, width, width))
    return np.asarray(np.sqrt(smooth[..., :height, :across]))


@dataclass(frozen=True)
class BeamShifts:
    """Standard deviations of each field's displacement by its beam in px, (M, 2, H, W).

    `by_percent` is for beams that vary by 1 %. `errors` is for beams that vary by `variation`, as
    far as the images do not exclude them.
    """

    variation: float
    by_percent: FloatArray
    errors: FloatArray


def shifts_by_beam(
    given: Measured,
    scene: Scene,
    posterior: Posterior,
    samples: Sequence[Sample],
    options: FitOptions,
) -> BeamShifts | None:
    """Return the effect of beams that differ from their sources; None if beams are fitted.

    `samples` are the posterior's.
    """
    if not samples or scene.beam_modes:
        return None
    variation = options.beam_variation
    if variation is None:
        variation = ASSUMED_VARIATION if given.assumed else 0.0
    middle = posterior.scene
    rng = np.random.default_rng([options.seed, _BEAM_SEED])
    length = options.beam_scale * min(given.size)
    count = 1 if given.common else len(scene.images)
    variations = [
        np.broadcast_to(
            draw_variations(middle, length / middle.bin, count, rng), middle.beams.shape
        )
        for _ in range(_BEAM_SAMPLES)
    ]
    changes = [posterior.moved_by_beams(0.01 * each) for each in variations]
    by_percent = _spread(scene, changes, given.size, length / 3)
    if not variation:
        return BeamShifts(variation, by_percent, 0 * by_percent)
    if not given.common:
        return BeamShifts(variation, by_percent, 100 * variation * by_percent)
    # Several images exclude most of the beams that would move the field far.
    changes = posterior.open_beams(variation, samples[:_OPEN_BEAM_SAMPLES], rng)
    return BeamShifts(variation, by_percent, _spread(scene, changes, given.size, length / 3))


def largest_share(errors: FloatArray, displacements: FloatArray) -> float:
    """Return the largest of all fields' r.m.s. error over r.m.s. displacement."""
    size = np.maximum((displacements**2).mean(axis=(1, 2, 3)), 1e-12)
    return float(np.sqrt(((errors**2).mean(axis=(1, 2, 3)) / size).max()))
