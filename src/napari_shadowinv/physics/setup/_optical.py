"""Beams of light, and the line integrals of the refractive index that deflect them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, ClassVar, Literal, Self

from numpy.typing import ArrayLike
from pydantic import Field
from scipy import constants

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup._beam import (
    BeamSetup,
    Deflector,
    SIField,
    length_text,
    positive_field,
    scale_by,
)

_USUAL_WAVELENGTHS_M = (10e-9, 20e-6)


class OpticalSetup(BeamSetup):
    """A beam of light through a transparent object, onto a detector.

    An `InputError` if a value is out of range, a name is unknown, or
    not exactly one pixel size is given. Numbers of equations are the paper's.

    Examples
    --------
    >>> setup = OpticalSetup(wavelength=810e-9, object_image_distance=0.01, pixel_size=1e-6)
    >>> setup.magnification, round(setup.critical_density * 1e-27, 2)
    (1.0, 1.7)
    """

    title: ClassVar = "light"
    beam: ClassVar = "light"
    beam_field: ClassVar = "wavelength"
    deflectors: ClassVar = (
        Deflector("plasma", "plasma", "plasma (phase ∝ λ²)"),
        Deflector("phase", "refractive index", "refractive index (phase)"),
    )
    si_fields: ClassVar = (
        *BeamSetup.si_fields,
        SIField(
            "line_integrated_log_index", "m", "Line-integrated logarithm of the refractive index"
        ),
        SIField(
            "line_integrated_density", "m⁻²", "Line-integrated electron density of a thin plasma"
        ),
    )

    kind: Literal["optical"] = Field(
        default="optical", title="Kind", description="Kind of probe: a beam of light."
    )
    source_object_distance: float = Field(
        default=math.inf,
        gt=0,
        title="Source to object (m)",
        description=(
            "Distance l from the beam source to the object, in m. Default: inf (collimated beam)."
        ),
    )
    wavelength: float = positive_field(
        "Wavelength (m)", "Vacuum wavelength of the light, in m.", most=1e-2
    )

    @property
    def probe(self) -> str:
        return f"light of {self.wavelength * 1e9:g} nm"

    def probe_doubts(self) -> Iterator[str]:
        shortest, longest = _USUAL_WAVELENGTHS_M
        if not shortest <= self.wavelength <= longest:
            yield (
                f"the wavelength is {length_text(self.wavelength)}, expected "
                f"{length_text(shortest)} to {length_text(longest)}: densities scale with its "
                "inverse square; it is given in m"
            )

    @classmethod
    def example(cls) -> Self:
        """Return the probe of the paper's plasma wave; see `phantoms.wakefield_setup`."""
        return cls(wavelength=810e-9, object_image_distance=20e-6, pixel_size=0.25e-6)

    def default_deflector(self, recorded_with: Any) -> str:
        if recorded_with.wavelength != self.wavelength:
            raise InputError(
                f"the wavelengths differ ({recorded_with.wavelength:g} and {self.wavelength:g} m) "
                "but no deflector was given: choose 'plasma' (angles scale with the wavelength "
                "squared) or 'refractive index' (angles are unchanged, apart from dispersion)"
            )
        return "refractive index"

    def angle_ratio(self, recorded_with: Any, deflector: str) -> float:
        if deflector == "refractive index":
            return 1.0
        ratio: float = recorded_with.critical_density / self.critical_density
        return ratio

    @property
    def critical_density(self) -> float:
        """Electron density n_c = ε₀ m ω² / e² in m⁻³ beyond which the light does not travel."""
        frequency = 2 * math.pi * constants.c / self.wavelength
        density: float = constants.epsilon_0 * constants.m_e * frequency**2 / constants.e**2
        return density

    def line_integrated_log_index(self, phi: ArrayLike) -> FloatArray:
        """Refractive index along the beam, ∫ln η dz = -Φ in m, from φ in px² (Eq. 2a)."""
        return -self.potential(phi)

    def normalized_potential_from_log_index(self, integral: ArrayLike) -> FloatArray:
        """Potential φ in px² of a refracting object, from ∫ln η dz in m."""
        return -self.normalized_potential(integral)

    def line_integrated_density(self, phi: ArrayLike) -> FloatArray:
        """Electron density of a thin plasma along the beam, ∫n dz = 2 n_c Φ in m⁻², from φ in px².

        To first order in n / n_c, ln η = ½ ln(1 - n/n_c) ≈ -n / (2 n_c). Eq. 12 of the paper leaves
        out the ½ that the root in Eq. 11 brings; its densities are half of these.
        """
        return 2 * self.critical_density * self.potential(phi)

    def normalized_potential_from_density(self, integral: ArrayLike) -> FloatArray:
        """Potential φ in px² of a thin plasma, from ∫n dz in m⁻²."""
        return self.normalized_potential(integral) / (2 * self.critical_density)

    def relative_density_modulation(self, phi: ArrayLike, density: float) -> FloatArray:
        """Modulation of a plasma's density, relative to its mean: ∫Δn/n₀ dz in m.

        The normalised potential φ in px² is zero where the plasma is undisturbed, with the density
        n₀ in m⁻³; an `InputError` if that is not positive and finite.
        """
        return self.line_integrated_density(phi) / _positive_density(density)

    def normalized_potential_from_modulation(
        self, modulation: ArrayLike, density: float
    ) -> FloatArray:
        """Potential φ in px² of a modulated plasma, from ∫Δn/n₀ dz in m and n₀ in m⁻³."""
        return self.normalized_potential_from_density(
            scale_by(modulation, _positive_density(density))
        )


def _positive_density(density: float) -> float:
    if not (density > 0 and math.isfinite(density)):
        raise InputError(f"density is {density:g}: it must be positive, in electrons per m³")
    return density
