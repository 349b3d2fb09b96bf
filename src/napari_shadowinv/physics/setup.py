"""The experiment's geometry and probe, and what they make of a displacement.

- describe an experiment: `ProtonSetup`, `OpticalSetup`; either of them: `Setup`
- get it back from a file's content: `setup_from_dict`
- convert pixels to SI and back: `BeamSetup.deflection_angle`, `BeamSetup.displacement`,
  `BeamSetup.potential`, `BeamSetup.normalized_potential`
- from a potential in SI to a displacement in pixels: `BeamSetup.displacement_from_potential`
- path-integrated fields of particles: `ProtonSetup.path_integrated_b`,
  `ProtonSetup.path_integrated_e`; back: `ProtonSetup.displacement_from_path_integrated_b`,
  `ProtonSetup.displacement_from_path_integrated_e`
- line integrals of light: `OpticalSetup.line_integrated_log_index`,
  `OpticalSetup.line_integrated_density`, `OpticalSetup.relative_density_modulation`; back:
  `OpticalSetup.normalized_potential_from_log_index`,
  `OpticalSetup.normalized_potential_from_density`,
  `OpticalSetup.normalized_potential_from_modulation`
- the same object in another experiment: `napari_shadowinv.physics.projection`

Displacements d and potentials φ are in pixels of the object plane, px and px². With the
pixel's side p, the distance L from object to detector and the magnification M, the
deflection angle is a = d p M / L and the potential Φ = φ p² M / L, so that a = -∇Φ where
d = -∇φ (Eq. 1 of the paper). Vectors are in axis order (y, x), with x to the right, y down
and the beam into the screen: a right-handed frame.

A potential is known up to a constant: only its gradient deflects. Whatever is
proportional to it (∫ln η dz, ∫n dz) has the same freedom, and is relative to the
place where the potential is zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_serializer, model_validator
from scipy import constants

from napari_shadowinv.errors import InputError
from napari_shadowinv.validation import nearest, validated

__all__ = [
    "SPECIES",
    "BeamSetup",
    "FieldUnit",
    "OpticalSetup",
    "Particle",
    "ProtonSetup",
    "Setup",
    "Species",
    "setup_from_dict",
]

FloatArray = NDArray[np.float64]

Species = Literal["proton", "deuteron", "triton", "helion", "alpha", "electron"]
FieldUnit = Literal["T m", "MG um"]

_TESLA_METRES = {"T m": 1.0, "MG um": 1e-4}
_ELECTRON_MASS: float = constants.m_e
_ELEMENTARY_CHARGE: float = constants.e
_LIGHT_SPEED: float = constants.c
_VACUUM_PERMITTIVITY: float = constants.epsilon_0
_JOULES_PER_MEV = 1e6 * _ELEMENTARY_CHARGE


@dataclass(frozen=True)
class Particle:
    """A species of beam particle.

    Attributes
    ----------
    mass : float
        Rest mass in kg.
    charge : float
        Charge in C, with its sign.
    """

    mass: float
    charge: float


def _particle(name: str, charge_number: int) -> Particle:
    return Particle(
        constants.physical_constants[f"{name} mass"][0], charge_number * _ELEMENTARY_CHARGE
    )


SPECIES: dict[Species, Particle] = {
    "proton": _particle("proton", 1),
    "deuteron": _particle("deuteron", 1),
    "triton": _particle("triton", 1),
    "helion": _particle("helion", 2),
    "alpha": _particle("alpha particle", 2),
    "electron": _particle("electron", -1),
}


class BeamSetup(BaseModel):
    """Geometry that every probe has: distances, pixels, magnification.

    Made only as a `ProtonSetup` or an `OpticalSetup`. A dump holds no None and takes
    inf, so it can be written as TOML or JSON and read back.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", ser_json_inf_nan="strings")

    kind: str = Field(title="Kind", description="Kind of probe: 'proton' or 'optical'.")
    source_object_distance: float = Field(
        gt=0,
        title="Source to object (m)",
        description="Distance l from the beam's source to the object, in m; inf if collimated.",
    )
    object_image_distance: float = Field(
        gt=0,
        allow_inf_nan=False,
        title="Object to image (m)",
        description="Distance L from the object to the detector, in m.",
    )
    pixel_size: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Pixel size at the object (m)",
        description=(
            "Side of a pixel in the object plane, in m. Give this or the detector's pixel size."
        ),
    )
    detector_pixel_size: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        title="Pixel size at the detector (m)",
        description=(
            "Side of a pixel in the detector plane, in m; the magnification makes it the "
            "object plane's. Give this or the pixel size at the object."
        ),
    )

    @model_validator(mode="after")
    def _one_pixel_size(self) -> BeamSetup:
        given = [self.pixel_size is not None, self.detector_pixel_size is not None]
        if sum(given) != 1:
            received = "both" if all(given) else "neither"
            raise ValueError(
                "give either 'pixel_size' (m, in the object plane) or 'detector_pixel_size' "
                f"(m, in the detector plane), received {received}"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_none(self, dump: Callable[[BeamSetup], dict[str, Any]]) -> dict[str, Any]:
        return {name: value for name, value in dump(self).items() if value is not None}

    @property
    def magnification(self) -> float:
        """Magnification M = 1 + L / l of the object on the detector; 1 if collimated.

        References
        ----------
        Kasim et al., arXiv:1607.04179, text after Eq. 3.
        """
        return 1 + self.object_image_distance / self.source_object_distance

    @property
    def collimated(self) -> bool:
        """Whether the beam is parallel before the object."""
        return math.isinf(self.source_object_distance)

    @property
    def object_pixel_size(self) -> float:
        """Side p of a pixel in the object plane in m, whichever pixel size was given."""
        if self.pixel_size is not None:
            return self.pixel_size
        assert self.detector_pixel_size is not None
        return self.detector_pixel_size / self.magnification

    @property
    def _angle_per_pixel(self) -> float:
        return self.object_pixel_size * self.magnification / self.object_image_distance

    def deflection_angle(self, displacement: ArrayLike) -> FloatArray:
        """Angle a = d p M / L by which rays are deflected.

        Parameters
        ----------
        displacement : array_like
            Displacement d in px of the object plane.

        Returns
        -------
        ndarray, of the same shape
            Angle in rad.

        References
        ----------
        Kasim et al., arXiv:1607.04179, Eq. 3.
        """
        return _scaled(displacement, self._angle_per_pixel)

    def displacement(self, angle: ArrayLike) -> FloatArray:
        """Displacement d = a L / (p M); the inverse of `deflection_angle`.

        Parameters
        ----------
        angle : array_like
            Deflection angle a in rad.

        Returns
        -------
        ndarray, of the same shape
            Displacement in px of the object plane.
        """
        return _scaled(angle, 1 / self._angle_per_pixel)

    def potential(self, phi: ArrayLike) -> FloatArray:
        """Deflection potential in SI units, Φ = φ p² M / L, with a = -∇Φ.

        Parameters
        ----------
        phi : array_like
            Normalised potential φ in px².

        Returns
        -------
        ndarray, of the same shape
            Potential Φ in m (rad m).

        References
        ----------
        Kasim et al., arXiv:1607.04179, Eq. 1.
        """
        return _scaled(phi, self.object_pixel_size * self._angle_per_pixel)

    def normalized_potential(self, potential: ArrayLike) -> FloatArray:
        """Potential in pixels, φ = Φ L / (p² M); the inverse of `potential`.

        Parameters
        ----------
        potential : array_like
            Potential Φ in m.

        Returns
        -------
        ndarray, of the same shape
            Normalised potential in px².
        """
        return _scaled(potential, 1 / (self.object_pixel_size * self._angle_per_pixel))

    def displacement_from_potential(self, potential: ArrayLike) -> FloatArray:
        """Displacement in pixels of a potential in SI units, d = -∇φ.

        Parameters
        ----------
        potential : array_like, shape (H, W)
            Potential Φ in m at the centres of this setup's pixels.

        Returns
        -------
        ndarray, shape (2, H, W)
            Displacement in px of the object plane, axis order (y, x), by differences that
            are of second order up to the border.

        Raises
        ------
        InputError
            If the potential is no plane or too small to have a gradient.
        """
        plane = self.normalized_potential(potential)
        if plane.ndim != 2 or min(plane.shape) < 3:
            raise InputError(
                f"potential has shape {plane.shape}: expected (height, width), 3 pixels at least"
            )
        return -np.stack([np.gradient(plane, axis=axis, edge_order=2) for axis in (0, 1)])


class ProtonSetup(BeamSetup):
    """A beam of charged particles through an object, onto a film or a plate.

    Raises
    ------
    pydantic.ValidationError
        (a `ValueError`) if a value is out of range, a name is unknown, or not exactly one
        pixel size is given.

    References
    ----------
    Kasim et al., arXiv:1607.04179, Section IV A.

    Examples
    --------
    >>> setup = ProtonSetup(
    ...     energy=14.7,
    ...     source_object_distance=1.3e-3,
    ...     object_image_distance=2e-2,
    ...     pixel_size=1.5e-6,
    ... )
    >>> setup.magnification
    16.38
    """

    kind: Literal["proton"] = Field(
        default="proton", title="Kind", description="Kind of probe: a beam of charged particles."
    )
    energy: float = Field(
        gt=0,
        allow_inf_nan=False,
        title="Kinetic energy (MeV)",
        description="Kinetic energy of a particle (all its nucleons together), in MeV.",
    )
    species: Species = Field(
        default="proton", title="Species", description="Kind of the beam's particles."
    )

    @property
    def particle(self) -> Particle:
        """Mass and charge of the beam's particles."""
        return SPECIES[self.species]

    @property
    def momentum(self) -> float:
        """Momentum in kg m/s: p c = √(T² + 2 T m c²).

        The paper's √(2 m W) is its limit for small energies, 0.4 % less at 14.7 MeV.
        """
        energy = self.energy * _JOULES_PER_MEV
        rest_energy = self.particle.mass * _LIGHT_SPEED**2
        return math.sqrt(energy**2 + 2 * energy * rest_energy) / _LIGHT_SPEED

    @property
    def velocity(self) -> float:
        """Velocity in m/s: v = p c² / (T + m c²)."""
        rest_energy = self.particle.mass * _LIGHT_SPEED**2
        return self.momentum * _LIGHT_SPEED**2 / (self.energy * _JOULES_PER_MEV + rest_energy)

    def path_integrated_b(self, displacement: ArrayLike, unit: FieldUnit = "T m") -> FloatArray:
        """Magnetic field integrated along the beam, if it alone deflects.

        From a = -(q/p) ∫B × dz: in components a_x = -(q/p) ∫B_y dz and
        a_y = (q/p) ∫B_x dz. The component along the beam does not deflect.

        Parameters
        ----------
        displacement : array_like, shape (2, ...)
            Displacement in px, axis order (y, x).
        unit : {"T m", "MG um"}, default "T m"
            Unit of the result; 1 MG µm is 1e-4 T m.

        Returns
        -------
        ndarray, of the same shape
            (∫B_y dz, ∫B_x dz): components in axis order (y, x).

        Raises
        ------
        InputError
            If the displacement has not two components, or the unit is unknown.

        References
        ----------
        Kasim et al., arXiv:1607.04179, Section IV A (the deflection angle, there with the
        non-relativistic momentum √(2 m W)).
        """
        angle_y, angle_x = self.deflection_angle(_vector("displacement", displacement))
        rigidity = self.momentum / self.particle.charge / _tesla_metres(unit)
        return np.stack([-angle_x * rigidity, angle_y * rigidity])

    def displacement_from_path_integrated_b(
        self, field: ArrayLike, unit: FieldUnit = "T m"
    ) -> FloatArray:
        """Displacement by a magnetic field; the inverse of `path_integrated_b`.

        Parameters
        ----------
        field : array_like, shape (2, ...)
            (∫B_y dz, ∫B_x dz).
        unit : {"T m", "MG um"}, default "T m"
            Unit of the field.

        Returns
        -------
        ndarray, of the same shape
            Displacement in px of the object plane, axis order (y, x).

        Raises
        ------
        InputError
            If the field has not two components, or the unit is unknown.
        """
        field_y, field_x = _vector("field", field)
        rigidity = self.momentum / self.particle.charge / _tesla_metres(unit)
        return self.displacement(np.stack([field_x / rigidity, -field_y / rigidity]))

    def path_integrated_e(self, displacement: ArrayLike) -> FloatArray:
        """Electric field integrated along the beam, if it alone deflects.

        From a = q ∫E dz / (p v), the relativistic form of the paper's q / (2 W).

        Parameters
        ----------
        displacement : array_like, shape (2, ...)
            Displacement in px, axis order (y, x).

        Returns
        -------
        ndarray, of the same shape
            (∫E_y dz, ∫E_x dz) in V.

        Raises
        ------
        InputError
            If the displacement has not two components.

        References
        ----------
        Kasim et al., arXiv:1607.04179, Eq. 2b.
        """
        angle = self.deflection_angle(_vector("displacement", displacement))
        return angle * (self.momentum * self.velocity / self.particle.charge)

    def displacement_from_path_integrated_e(self, field: ArrayLike) -> FloatArray:
        """Displacement by an electric field; the inverse of `path_integrated_e`.

        Parameters
        ----------
        field : array_like, shape (2, ...)
            (∫E_y dz, ∫E_x dz) in V.

        Returns
        -------
        ndarray, of the same shape
            Displacement in px of the object plane, axis order (y, x).

        Raises
        ------
        InputError
            If the field has not two components.
        """
        volts = _vector("field", field)
        return self.displacement(volts * (self.particle.charge / (self.momentum * self.velocity)))


class OpticalSetup(BeamSetup):
    """A beam of light through a transparent object, onto a detector.

    Raises
    ------
    pydantic.ValidationError
        (a `ValueError`) if a value is out of range, a name is unknown, or not exactly one
        pixel size is given.

    References
    ----------
    Kasim et al., arXiv:1607.04179, Sections II A and V.

    Examples
    --------
    >>> setup = OpticalSetup(wavelength=810e-9, object_image_distance=0.01, pixel_size=1e-6)
    >>> setup.magnification
    1.0
    >>> round(setup.critical_density * 1e-27, 2)
    1.7
    """

    kind: Literal["optical"] = Field(
        default="optical", title="Kind", description="Kind of probe: a beam of light."
    )
    source_object_distance: float = Field(
        default=math.inf,
        gt=0,
        title="Source to object (m)",
        description=(
            "Distance l from the beam's source to the object, in m. "
            "Default: inf, a collimated beam."
        ),
    )
    wavelength: float = Field(
        gt=0,
        allow_inf_nan=False,
        title="Wavelength (m)",
        description="Wavelength of the light in vacuum, in m.",
    )

    @property
    def critical_density(self) -> float:
        """Electron density n_c = ε₀ m ω² / e² in m⁻³ beyond which the light does not travel."""
        frequency = 2 * math.pi * _LIGHT_SPEED / self.wavelength
        return _VACUUM_PERMITTIVITY * _ELECTRON_MASS * frequency**2 / _ELEMENTARY_CHARGE**2

    def line_integrated_log_index(self, phi: ArrayLike) -> FloatArray:
        """Logarithm of the refractive index integrated along the beam: ∫ln η dz = -Φ.

        Parameters
        ----------
        phi : array_like
            Normalised potential φ in px².

        Returns
        -------
        ndarray, of the same shape
            ∫ln η dz in m, relative to where the potential is zero.

        References
        ----------
        Kasim et al., arXiv:1607.04179, Eq. 2a.
        """
        return -self.potential(phi)

    def normalized_potential_from_log_index(self, integral: ArrayLike) -> FloatArray:
        """Potential φ of a refracting object; the inverse of `line_integrated_log_index`.

        Parameters
        ----------
        integral : array_like
            ∫ln η dz in m.

        Returns
        -------
        ndarray, of the same shape
            Normalised potential in px².
        """
        return -self.normalized_potential(integral)

    def line_integrated_density(self, phi: ArrayLike) -> FloatArray:
        """Electron density of a thin plasma integrated along the beam: ∫n dz = 2 n_c Φ.

        To first order in n / n_c, ln η = ½ ln(1 - n/n_c) ≈ -n / (2 n_c).

        Parameters
        ----------
        phi : array_like
            Normalised potential φ in px².

        Returns
        -------
        ndarray, of the same shape
            ∫n dz in m⁻², relative to where the potential is zero.

        Notes
        -----
        Eq. 12 of the paper leaves out the ½ that the root in Eq. 11 brings; its
        densities are half of these.

        References
        ----------
        Kasim et al., arXiv:1607.04179, Eqs. 2a, 11 and 12.
        """
        return 2 * self.critical_density * self.potential(phi)

    def normalized_potential_from_density(self, integral: ArrayLike) -> FloatArray:
        """Potential φ of a thin plasma; the inverse of `line_integrated_density`.

        Parameters
        ----------
        integral : array_like
            ∫n dz in m⁻².

        Returns
        -------
        ndarray, of the same shape
            Normalised potential in px².
        """
        return self.normalized_potential(integral) / (2 * self.critical_density)

    def relative_density_modulation(self, phi: ArrayLike, density: float) -> FloatArray:
        """Modulation of a plasma's density, relative to its mean: ∫Δn/n₀ dz.

        Parameters
        ----------
        phi : array_like
            Normalised potential φ in px², zero where the plasma is undisturbed.
        density : float
            Density n₀ of the undisturbed plasma in m⁻³.

        Returns
        -------
        ndarray, of the same shape
            ∫Δn/n₀ dz in m.

        Raises
        ------
        InputError
            If the density is not positive and finite.

        References
        ----------
        Kasim et al., arXiv:1607.04179, Section V; see `line_integrated_density` for the
        factor of 2.
        """
        return self.line_integrated_density(phi) / _positive_density(density)

    def normalized_potential_from_modulation(
        self, modulation: ArrayLike, density: float
    ) -> FloatArray:
        """Potential φ of a modulated plasma; the inverse of `relative_density_modulation`.

        Parameters
        ----------
        modulation : array_like
            ∫Δn/n₀ dz in m.
        density : float
            Density n₀ of the undisturbed plasma in m⁻³.

        Returns
        -------
        ndarray, of the same shape
            Normalised potential in px².

        Raises
        ------
        InputError
            If the density is not positive and finite.
        """
        return self.normalized_potential_from_density(
            _scaled(modulation, _positive_density(density))
        )


Setup = Annotated[ProtonSetup | OpticalSetup, Field(discriminator="kind")]

_KINDS: dict[str, type[ProtonSetup | OpticalSetup]] = {
    "proton": ProtonSetup,
    "optical": OpticalSetup,
}


def setup_from_dict(mapping: Mapping[str, Any], where: str = "setup") -> ProtonSetup | OpticalSetup:
    """Make the right setup from what a file holds.

    Parameters
    ----------
    mapping : mapping of str to object
        The fields, with ``kind`` "proton" or "optical".
    where : str, optional
        Where the mapping comes from; an error's message begins with it.

    Returns
    -------
    ProtonSetup or OpticalSetup
        As `kind` says.

    Raises
    ------
    InputError
        If a key is unknown or missing or a value cannot be used; the message names it.

    Examples
    --------
    >>> setup_from_dict(
    ...     {
    ...         "kind": "optical",
    ...         "wavelength": 810e-9,
    ...         "object_image_distance": 0.01,
    ...         "pixel_size": 1e-6,
    ...     }
    ... ).collimated
    True
    """
    if not isinstance(mapping, Mapping):
        raise InputError(f"{where}: received a {type(mapping).__name__}, expected keys with values")
    kind = mapping.get("kind")
    if kind is None:
        raise InputError(f"{where}: 'kind' is missing, it must be 'proton' or 'optical'")
    if not isinstance(kind, str) or kind not in _KINDS:
        match = nearest(str(kind), list(_KINDS))
        hint = f", did you mean '{match}'?" if match else ""
        raise InputError(f"{where}: 'kind' is {kind!r}, it must be 'proton' or 'optical'{hint}")
    return validated(_KINDS[kind], mapping, where)


def _scaled(values: ArrayLike, factor: float) -> FloatArray:
    product: FloatArray = np.asarray(values, dtype=np.float64) * factor
    return product


def _vector(name: str, values: ArrayLike) -> FloatArray:
    field = np.asarray(values, dtype=np.float64)
    if field.ndim == 0 or field.shape[0] != 2:
        raise InputError(
            f"{name} has shape {field.shape}: expected (2, ...), the y component first"
        )
    return field


def _positive_density(density: float) -> float:
    if not (density > 0 and math.isfinite(density)):
        raise InputError(f"density is {density:g}: it must be positive, in electrons per m³")
    return density


def _tesla_metres(unit: str) -> float:
    if unit not in _TESLA_METRES:
        raise InputError(f"unit is {unit!r}: it must be one of {', '.join(get_args(FieldUnit))}")
    return _TESLA_METRES[unit]
