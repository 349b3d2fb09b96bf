"""How well an experiment is known: `Instrument`.

Each number is a standard deviation in an experimenter's units; 0 takes the quantity as exact. An
inversion and a fit propagate them into the error of the field.

- defaults of detectors and of beam sources: `DETECTORS`, `BEAM_SOURCES`; docs/uncertainty.md has
  the reason for each number
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Self

import numpy as np
from pydantic import (
    Field,
    PrivateAttr,
    model_validator,
)

from napari_shadowinv._system.validation import CheckedModel
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.options.beam_prior import (
    ASSUMED_BEAM,
    REFERENCE_BEAM,
    BeamComponents,
    BeamPrior,
    Share,
)

Detector = Literal["film", "image plate", "CR-39", "scintillator", "camera"]
BeamSource = Literal["TNSA", "implosion", "X-ray tube", "laser"]

DETECTORS: Mapping[Detector, Mapping[str, float]] = {
    "film": {"background": 0.03, "gamma": 0.03, "blur": 0.5, "registration": 1.0},
    "image plate": {"background": 0.03, "gamma": 0.02, "blur": 1.5, "registration": 1.0},
    "CR-39": {"background": 0.02, "gamma": 0.03, "blur": 0.0, "registration": 1.0},
    "scintillator": {"background": 0.05, "gamma": 0.02, "blur": 1.5, "registration": 0.2},
    "camera": {"background": 0.01, "gamma": 0.01, "blur": 0.7, "registration": 0.2},
}
"""Numbers of an `Instrument` with a detector, unless others are stated."""

BEAM_SOURCES: Mapping[BeamSource, Mapping[str, float]] = {
    "TNSA": {"beam_rms": 0.10, "beam_length": 0.25, "beam_between": 0.05, "energy": 0.05},
    "implosion": {"beam_rms": 0.05, "beam_length": 0.5, "beam_between": 0.05, "energy": 0.03},
    "X-ray tube": {"beam_rms": 0.02, "beam_length": 0.5, "beam_between": 0.02, "energy": 0.1},
    "laser": {"beam_rms": 0.05, "beam_length": 0.1, "beam_between": 0.05, "energy": 0.0},
}
"""Numbers of an `Instrument` with a source of its beam, unless others are stated."""


DEFAULT_REGISTRATION = 0.2
"""Shift in px of a recorded source that no image shows, unless another one is stated."""


class Instrument(CheckedModel, allow_inf_nan=False):
    """How well beam, detector and alignment are known, as standard deviations.

    What is not stated has the default of the detector or of the beam source. Without these it
    counts as exact, except for a beam that nobody measured (`ASSUMED_BEAM`) or that was recorded in
    another exposure (`REFERENCE_BEAM`).

    Raises
    ------
    InputError
        If a value is out of range or a name is unknown.

    Examples
    --------
    >>> instrument = Instrument(beam_rms=0.02, background=0.05)
    >>> instrument.beam_rms, instrument.beam_length
    (0.02, 0.25)
    >>> film = Instrument(detector="film", beam_source="TNSA", background=0.1)
    >>> film.beam_rms, film.gamma, film.background
    (0.1, 0.03, 0.1)
    """

    _components: BeamComponents | None = PrivateAttr(default=None)

    detector: Detector | None = Field(
        default=None, description="Kind of detector, for the numbers that are not stated."
    )
    beam_source: BeamSource | None = Field(
        default=None, description="Origin of the beam, for its numbers that are not stated."
    )
    beam_rms: float | None = Field(
        default=None,
        ge=0,
        lt=1,
        title="Beam",
        description="Relative r.m.s. difference between the true beam and the source. Default: "
        "0.005 for a recorded source (0 if it is uniform), else 0.05. If image and source differ "
        "by more where there is no object, that difference counts. 0 for a source of the same "
        "exposure.",
    )
    beam_length: float = Field(
        default=0.25,
        ge=1e-6,
        le=1,
        description="Length over which the true beam differs from the source, as a share of the "
        "image's shorter side.",
    )
    beam_between: Share = Field(
        default=0.0,
        title="Beam between energies",
        description="Relative r.m.s. difference between the beams of two energies of one shot, "
        "over the same length.",
    )
    energy: Share = Field(
        default=0.0,
        description="Relative error of the beam's energy, or of its wavelength. It scales the "
        "field in SI units, not the displacement.",
    )
    background: Share = Field(
        default=0.0,
        description="Stray light, fog or dark level left in image and source, as a share of the "
        "mean.",
    )
    gamma: Share = Field(
        default=0.0,
        description="Error of the exponent of the detector's response, which is 1 if linear.",
    )
    blur: float = Field(
        default=0.0,
        ge=0,
        le=100,
        title="Blur (px)",
        description="Point spread beyond the stated one (standard deviation in px).",
    )
    absorption: Share = Field(
        default=0.0,
        description="Relative r.m.s. variation of the transmission of the object.",
    )
    registration: float | None = Field(
        default=None,
        ge=0,
        le=1000,
        title="Registration (px)",
        description="Shift of the image relative to its source in px; rotation and scale move the "
        "corners by as much. Default: as measured in the image, at most 0.2 for a source in place. "
        "0 for a source that need not be moved.",
    )
    other_field: float = Field(
        default=0.0,
        ge=0,
        le=10,
        description="Displacement by a field that is not retrieved, such as E, as a share of the "
        "displacement by the retrieved one.",
    )
    noise_correlation: float | None = Field(
        default=None,
        ge=0,
        le=20,
        title="Noise correlation (px)",
        description="Standard deviation of the Gaussian blur that correlates the noise of "
        "neighbouring pixels, in px; 0 for white noise. Default: measured in the image.",
    )

    @model_validator(mode="after")
    def _fill_in(self) -> Self:
        """Take numbers that are not stated from the detector and the source of the beam."""
        for name, value in self.defaults.items():
            if name not in self.model_fields_set or getattr(self, name) is None:
                self.__dict__[name] = value
        return self

    @property
    def defaults(self) -> dict[str, float]:
        """Numbers of the detector and of the source of the beam, as far as they are stated."""
        of_detector = {} if self.detector is None else DETECTORS[self.detector]
        of_source = {} if self.beam_source is None else BEAM_SOURCES[self.beam_source]
        return {**of_detector, **of_source}

    @property
    def stated(self) -> dict[str, Any]:
        """Values that differ from the defaults, from which the instrument can be made again."""
        kinds = {"detector": self.detector, "beam_source": self.beam_source}
        usual = Instrument(**kinds).model_dump()
        stated = {name: kind for name, kind in kinds.items() if kind is not None}
        return stated | {
            name: value for name, value in self.model_dump().items() if value != usual[name]
        }

    @property
    def has_numbers(self) -> bool:
        """Whether anything is stated that changes an image."""
        return bool(self.stated.keys() - {"energy", "noise_correlation"})

    def with_registration(self, error: float) -> Self:
        """Return the instrument for a source in register to within an error, px; 0 if estimated."""
        return self.model_copy(update={"registration": error})

    def with_beam(self, beam: BeamPrior) -> Self:
        """Return the instrument with another beam, of the same difference between energies."""
        changed = self.model_copy(update={"beam_rms": beam.rms, "beam_length": beam.length})
        changed._components = beam.components
        return changed

    def beam_of(self, *, measured: bool, source: FloatArray | None = None) -> BeamPrior:
        """Return the prior of the beam, assumed unless stated.

        A source that was `measured` is a record of the beam; a uniform one, 0 where masked, is the
        beam itself.
        """
        default = (REFERENCE_BEAM if measured else ASSUMED_BEAM).rms
        if measured and source is not None and not np.ptp(source[source != 0]) > 0:
            default = 0.0
        rms = default if self.beam_rms is None else self.beam_rms
        beam = BeamPrior(rms=rms, length=self.beam_length, between=self.beam_between)
        return beam if self._components is None else beam.with_components(self._components)
