"""Error bars of a fit, drawn around its best unknowns.

- by the noise: `errors_by_noise`
- by an unmeasured or inexact beam: `shifts_by_beam`, `BeamError`, `draw_variations`
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.descent import finer
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.measurements import Measured
from napari_shadowinv.fitting.posterior import Posterior, Sample
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.inversion.budget import ASSUMED_VARIATION
from napari_shadowinv.options import FitOptions

__all__ = [
    "BeamError",
    "BeamShifts",
    "draw_variations",
    "errors_by_noise",
    "largest_share",
    "shifts_by_beam",
]


_WAVES = 60


@dataclass(frozen=True)
class BeamError:
    """Response of a fit's displacement to a beam that differs from its source.

    Attributes
    ----------
    sensitivity : float
        R.m.s. change of the displacement, as a share of it, if the beam differs by 1 % (r.m.s.).
    variation : float
        R.m.s. difference that the total error takes into account.
    share : float
        R.m.s. error of the displacement, as a share of it, by beams that differ that far and are
        compatible with the images.
    scale : float
        Distance over which the beam varies, in shorter sides of the image.
    assumed : bool
        Whether nobody measured the beam.
    """

    sensitivity: float
    variation: float
    share: float
    scale: float
    assumed: bool

    @property
    def name(self) -> str:
        """The name of an error that includes the beam's, such as "beam assumed, 5 %"."""
        origin = "assumed" if self.assumed else "stated"
        return f"beam {origin}, {100 * self.variation:.2g} %" if self.variation else "noise"

    @property
    def text(self) -> str:
        """The response in a sentence."""
        beam = "the beam was assumed to be the source or uniform: " if self.assumed else ""
        sentence = (
            f"{beam}a beam that differs by 1 % (r.m.s.) over {self.scale:.2g} of the image's "
            f"shorter side would move the displacement by {self.sensitivity:.1%} (r.m.s.)"
        )
        if self.variation:
            sentence += (
                f"; of beams that differ by {100 * self.variation:.2g} % the images leave "
                f"{self.share:.1%} open"
            )
        return sentence


def draw_variations(
    scene: Scene, length: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Return random smooth fields with a mean of 0 and an r.m.s. of 1 over the image.

    Parameters
    ----------
    scene : Scene
        Its beams, of the shape (L, …), reach beyond the image.
    length : float
        Distance over which the fields vary, px of the scene.
    count : int
        Number of fields.
    rng : numpy.random.Generator
        For the waves.

    Returns
    -------
    ndarray, shape (count, …)
    """
    height, width = scene.beams.shape[1:]
    inside = np.s_[scene.pad : height - scene.pad, scene.pad : width - scene.pad]
    fields = np.empty((count, height, width))
    for field in fields:
        waves = rng.normal(size=(2, _WAVES)) / length
        phases = rng.uniform(0, 2 * np.pi, _WAVES)
        along_y = np.arange(height)[:, None] * waves[0] + phases
        along_x = np.arange(width)[:, None] * waves[1]
        # cos(a + b) of each wave, without BLAS, whose idle threads spin.
        field[:] = np.einsum("yw,xw->yx", np.cos(along_y), np.cos(along_x))
        field -= np.einsum("yw,xw->yx", np.sin(along_y), np.sin(along_x))
        field -= field[inside].mean()
        field /= np.sqrt((field[inside] ** 2).mean())
    return fields


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
