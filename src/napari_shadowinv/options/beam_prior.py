"""How far the true beam may be from the source of an image: `BeamPrior`.

- of a beam that nobody measured: `ASSUMED_BEAM`; that was recorded in another exposure:
  `REFERENCE_BEAM`
- shapes in which it varies, and the rest: `BeamComponents`
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import Field, PrivateAttr

from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import FloatArray

Share = Annotated[float, Field(ge=0, lt=1)]


@dataclass(frozen=True, eq=False)
class BeamComponents:
    """Shapes in which a beam varies relative to its mean, known block by block.

    The basis is their origin: 'outside' for an image outside its object; 'assumed' or
    'stated' for the remains after filters and a source estimate; 'filtered' for the part that they
    take from an object in an exact beam.
    """

    patterns: FloatArray  # (k, h, w), relative, by one standard deviation of each, means of blocks
    block: int  # side of a square block, px
    shape: tuple[int, int]  # of the image
    rest: float  # relative r.m.s. of what they leave, with the length of the prior
    basis: Literal["outside", "assumed", "stated", "filtered"]


class BeamPrior(CheckedModel, allow_inf_nan=False):
    """Expected difference between the true beam and the source of an image.

    Attributes
    ----------
    rms : float
        Relative r.m.s. difference.
    length : float
        Length over which it varies, as a share of the image's shorter side.
    between : float
        Relative r.m.s. difference of the beams of two energies of one shot.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    rms: Share = 0.0
    length: float = Field(default=0.25, ge=1e-6, le=1)
    between: Share = 0.0
    _components: BeamComponents | None = PrivateAttr(default=None)

    @property
    def components(self) -> BeamComponents | None:
        """Shapes in which the beam varies; None for random waves of a length."""
        return self._components

    def with_components(self, components: BeamComponents) -> Self:
        """Return the prior of a beam that varies in certain shapes."""
        prior = self.model_copy()
        prior._components = components
        return prior


ASSUMED_BEAM = BeamPrior(rms=0.05, length=0.25)
"""Prior of a beam that nobody measured, unless another one is stated."""

REFERENCE_BEAM = BeamPrior(rms=0.005, length=0.25)
"""Prior of a beam whose source was recorded in another exposure, unless another one is stated."""

UNKNOWN_BEAM_RMS = 0.15
"""Relative r.m.s. variation of a beam that is called unknown, unless another one is stated."""
