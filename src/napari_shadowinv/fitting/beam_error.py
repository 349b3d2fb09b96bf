"""The error that an unmeasured or inexact beam adds to a fit: `BeamError`, `draw_variations`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.forward import Scene

__all__ = ["BeamError", "draw_variations"]

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
