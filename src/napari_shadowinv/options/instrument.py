"""How well an experiment is known: `Instrument`, with the `BeamPrior` of its beam.

Each number is a standard deviation in an experimenter's units; 0 takes the quantity as exact. An
inversion and a fit propagate them into the error of the field.
"""

from __future__ import annotations

from typing import Any

from pydantic import ConfigDict, Field, model_validator

from napari_shadowinv._system.validation import CheckedModel

__all__ = ["ASSUMED_BEAM", "BeamPrior", "Instrument"]

_CONFIG = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BeamPrior(CheckedModel):
    """Expected difference between the true beam and the source of an image.

    Attributes
    ----------
    rms : float
        Relative r.m.s. difference.
    length : float
        Length over which it varies, as a share of the image's shorter side.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    model_config = _CONFIG

    rms: float = Field(default=0.0, ge=0, lt=1)
    length: float = Field(default=0.25, gt=0, le=1)


ASSUMED_BEAM = BeamPrior(rms=0.05, length=0.25)
"""Prior of a beam that nobody measured, unless another one is stated."""


class Instrument(CheckedModel):
    """How well beam, detector and alignment are known, as standard deviations.

    What is not stated counts as exact, except for a beam that nobody measured: `ASSUMED_BEAM`. The
    beam may be given as `beam`, a `BeamPrior`, in place of its numbers.

    Raises
    ------
    InputError
        If a value is out of range or a name is unknown.

    Examples
    --------
    >>> instrument = Instrument(beam=BeamPrior(rms=0.02), background=0.05)
    >>> instrument.beam_rms, instrument.beam_length
    (0.02, 0.25)
    """

    model_config = _CONFIG

    beam_rms: float | None = Field(
        default=None,
        ge=0,
        lt=1,
        title="Beam",
        description=(
            "Relative r.m.s. difference between the true beam and the source. Default: 0 for a "
            "recorded source, else 0.05. If image and source differ by more where there is no "
            "object, that difference counts."
        ),
    )
    beam_length: float = Field(
        default=0.25,
        gt=0,
        le=1,
        title="Beam length",
        description=(
            "Length over which the true beam differs from the source, as a share of the image's "
            "shorter side."
        ),
    )
    background: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        title="Background",
        description=(
            "Stray light, fog or dark level left in image and source, as a share of the mean."
        ),
    )
    gamma: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        title="Gamma",
        description="Error of the exponent of the detector's response, which is 1 if linear.",
    )
    blur: float = Field(
        default=0.0,
        ge=0,
        le=100,
        title="Blur (px)",
        description="Point spread beyond the stated one (standard deviation in px).",
    )
    absorption: float = Field(
        default=0.0,
        ge=0,
        lt=1,
        title="Absorption",
        description="Relative r.m.s. variation of the transmission of the object.",
    )
    registration: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        title="Registration (px)",
        description=(
            "Shift of the image relative to its source in px; rotation and scale move the corners "
            "by as much."
        ),
    )
    other_field: float = Field(
        default=0.0,
        ge=0,
        le=10,
        title="Other field",
        description=(
            "Displacement by a field that is not retrieved, such as E, as a share of the "
            "displacement by the retrieved one."
        ),
    )

    @model_validator(mode="before")
    @classmethod
    def _expand_beam(cls, values: Any) -> Any:
        if not isinstance(values, dict) or "beam" not in values:
            return values
        numbers = {name: value for name, value in values.items() if name != "beam"}
        if twice := {"beam_rms", "beam_length"} & numbers.keys():
            raise ValueError(f"received beam and {min(twice)}, expected one of them")
        if not isinstance(values["beam"], BeamPrior | dict):
            raise ValueError(f"beam is {values['beam']!r}, expected a BeamPrior")
        beam = BeamPrior.model_validate(values["beam"])
        return {**numbers, "beam_rms": beam.rms, "beam_length": beam.length}

    def beam_of(self, *, measured: bool) -> BeamPrior:
        """Return the prior of the beam, assumed unless stated.

        Parameters
        ----------
        measured : bool
            Whether the source was recorded.
        """
        default = 0.0 if measured else ASSUMED_BEAM.rms
        rms = default if self.beam_rms is None else self.beam_rms
        return BeamPrior(rms=rms, length=self.beam_length)
