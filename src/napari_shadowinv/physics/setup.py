"""The experiment's geometry and probe, and the fields that follow from a displacement.

- describe an experiment: `ProtonSetup`, `OpticalSetup`; any of them: `Setup`, by kind `SETUPS`
- causes of deflections and quantities of beams, of all kinds: `deflector_titles`,
  `beam_quantities`
- get it back from a file's content: `setup_from_dict`; with larger pixels: `bin_setup`
- convert pixels to SI and back: methods of `BeamSetup`; path-integrated fields: of `ProtonSetup`;
  line integrals of the refractive index or the density: of `OpticalSetup`
- the base class of all kinds, and whether numbers are plausible: `napari_shadowinv.physics.beam`
- the same object in another experiment: `napari_shadowinv.physics.projection`

Conversions take an array_like of any shape and return an ndarray of float64 of the same
shape; vectors, in axis order (y, x), lie along the first axis. With x to the right, y down and
the beam into the screen the frame is right-handed.

Displacements d and potentials φ are in pixels of the object plane, px and px². With the
pixel's side p, the distance L from object to detector and the magnification M, the
deflection angle is a = d p M / L and the potential Φ = φ p² M / L, so that a = -∇Φ where
d = -∇φ (Eq. 1 of the paper, Kasim et al., arXiv:1607.04179).

A potential is determined up to a constant: only its gradient deflects. Quantities that are
proportional to it (∫ln η dz, ∫n dz) are relative to the place where the potential is zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field, SerializeAsAny, ValidationError, model_validator
from pydantic_core import PydanticKnownError
from scipy import constants

from napari_shadowinv._system.validation import CombinationError, nearest, validate
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.arrays import VECTOR, plain_array
from napari_shadowinv.physics.beam import (
    BeamQuantity,
    BeamSetup,
    Deflector,
    MainField,
    SIField,
    length_text,
    number_field,
)

Species = Literal["proton", "deuteron", "triton", "helion", "alpha", "electron"]
FieldUnit = Literal["T m", "MG um"]

_TESLA_METRES = {"T m": 1.0, "MG um": 1e-4}
_ELEMENTARY_CHARGE: float = constants.e
_LIGHT_SPEED: float = constants.c
_JOULES_PER_MEV = 1e6 * _ELEMENTARY_CHARGE


@dataclass(frozen=True)
class Particle:
    """Particle of a beam."""

    mass: float  # at rest, kg
    charge: float  # with its sign, C
    usual_energies: tuple[float, float]  # in radiography, MeV


def _particle(name: str, charge_number: int, least: float, most: float) -> Particle:
    mass = constants.physical_constants[f"{name} mass"][0]
    return Particle(mass, charge_number * _ELEMENTARY_CHARGE, (least, most))


SPECIES: dict[Species, Particle] = {
    "proton": _particle("proton", 1, 0.5, 100.0),
    "deuteron": _particle("deuteron", 1, 0.5, 100.0),
    "triton": _particle("triton", 1, 0.5, 100.0),
    "helion": _particle("helion", 2, 0.5, 200.0),
    "alpha": _particle("alpha particle", 2, 0.5, 200.0),
    "electron": _particle("electron", -1, 0.01, 3000.0),
}


class ProtonSetup(BeamSetup):
    """A beam of charged particles through an object, onto a film or a plate.

    An `InputError` if a value is out of range, a name is unknown, or
    not exactly one pixel size is given.

    Examples
    --------
    >>> lengths = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2}
    >>> ProtonSetup(energy=14.7, pixel_size=1.5e-6, **lengths).magnification
    16.38
    """

    title: ClassVar = "particles (protons, …)"
    beam: ClassVar = "particles"
    beam_field: ClassVar = "energy"
    deflectors: ClassVar = (
        Deflector("B", "magnetic field", "magnetic field (B)"),
        Deflector("E", "electric field", "electric field (E)"),
    )
    in_pradformat: ClassVar = True
    projects: ClassVar = True
    si_fields: ClassVar = (
        *BeamSetup.si_fields,
        *(
            SIField(
                f"path_integrated_{symbol}",
                unit,
                f"Path-integrated {kind} field, assuming purely {kind} deflection",
                is_vector=True,
                deflector=symbol.upper(),
            )
            for symbol, unit, kind in (("b", "T m", "magnetic"), ("e", "V", "electric"))
        ),
    )
    main_field: ClassVar = MainField(
        "path_integrated_b",
        "Path-integrated field",
        "|∫B×dz|",
        ("∫By dz", "∫Bx dz"),
    )
    other_fields: ClassVar = {
        "electric field": MainField(
            "path_integrated_e", "Path-integrated electric field", "|∫E dz|", ("∫Ey dz", "∫Ex dz")
        )
    }

    kind: Literal["proton"] = Field(
        default="proton", description="Kind of probe: a beam of charged particles."
    )
    energy: float = number_field(
        "Kinetic energy (MeV)",
        "Kinetic energy per particle (not per nucleon), in MeV.",
        gt=0,
        le=1e5,
    )
    species: Species = Field(
        default="proton", description="Particle species; electrons are deflected the opposite way."
    )

    @model_validator(mode="after")
    def _energy_in_range(self) -> ProtonSetup:
        if self.energy < 1e-6:
            raise CombinationError(
                f"{{energy}} is {self.energy:g} MeV, expected at least 1e-06 MeV: check its unit"
            )
        return self

    @property
    def probe(self) -> str:
        return f"{self.energy:g} MeV {self.species}"

    @property
    def max_source_distance(self) -> float:
        # Sources of ions are small and shine from centimetres.
        return math.inf if self.species == "electron" else 0.1

    def probe_doubts(self) -> Iterator[str]:
        least, most = self.particle.usual_energies
        if not least <= self.energy <= most:
            yield (
                f"{self.species}s of {self.energy:g} MeV are unusual in radiography, which uses "
                f"{least:g} to {most:g} MeV: fields scale with the momentum; the energy is given "
                "in MeV"
            )

    @classmethod
    def example(cls) -> Self:
        """Return the experiment of the paper's benchmark (Section IV A).

        At 1.5 µm in the object plane, 200 pixels are ten times the toroid's σ of 30 µm.
        """
        lengths = {"source_object_distance": 1.3e-3, "object_image_distance": 2e-2}
        return cls(energy=14.7, pixel_size=1.5e-6, **lengths)

    def default_deflector(self, recorded_with: Any) -> str:
        return "magnetic field"

    def angle_ratio(self, recorded_with: Any, deflector: str) -> float:
        ratio: float = self.particle.charge / recorded_with.particle.charge
        ratio *= recorded_with.momentum / self.momentum
        if deflector == "electric field":
            ratio = ratio * recorded_with.velocity / self.velocity
        return ratio

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

    @property
    def time_of_flight(self) -> float:
        """Time in s from the source to the object; inf if the beam is collimated."""
        return self.source_object_distance / self.velocity

    def _rigidity(self, unit: FieldUnit) -> float:
        """Magnetic field, integrated along the beam, that deflects by 1 rad: p / q."""
        if unit not in _TESLA_METRES:
            raise InputError(f"unit is {unit!r}: it must be one of {', '.join(_TESLA_METRES)}")
        return self.momentum / self.particle.charge / _TESLA_METRES[unit]

    @property
    def _electric_rigidity(self) -> float:
        """Electric field, integrated along the beam, that deflects by 1 rad: p v / q, in V."""
        return self.momentum * self.velocity / self.particle.charge

    def path_integrated_b(self, displacement: ArrayLike, unit: FieldUnit = "T m") -> FloatArray:
        """Magnetic field integrated along the beam, if it alone deflects.

        From a = -(q/p) ∫B × dz: in components a_x = -(q/p) ∫B_y dz and
        a_y = (q/p) ∫B_x dz (the paper, Section IV A, with the momentum √(2 m W)). The component
        along the beam does not deflect.

        Parameters
        ----------
        displacement : array_like, shape (2, ...)
            Displacement in px; an `InputError` if it has not two components.
        unit : {"T m", "MG um"}, default "T m"
            Unit of the result; 1 MG µm is 1e-4 T m.

        Returns
        -------
        ndarray, of the same shape
            (∫B_y dz, ∫B_x dz).
        """
        angle_y, angle_x = self.deflection_angle(_vector("displacement", displacement))
        rigidity = self._rigidity(unit)
        return np.stack([-angle_x * rigidity, angle_y * rigidity])

    def displacement_from_path_integrated_b(
        self, field: ArrayLike, unit: FieldUnit = "T m"
    ) -> FloatArray:
        """Displacement in px by (∫B_y dz, ∫B_x dz); the inverse of `path_integrated_b`."""
        field_y, field_x = _vector("field", field)
        rigidity = self._rigidity(unit)
        return self.displacement(np.stack([field_x / rigidity, -field_y / rigidity]))

    def path_integrated_e(self, displacement: ArrayLike) -> FloatArray:
        """Electric field integrated along the beam, (∫E_y dz, ∫E_x dz) in V, if it alone deflects.

        From a = q ∫E dz / (p v), the relativistic form of the paper's q / (2 W) in Eq. 2b. An
        `InputError` if the displacement, in px, has not two components.
        """
        angle = self.deflection_angle(_vector("displacement", displacement))
        return angle * self._electric_rigidity

    def displacement_from_path_integrated_e(self, field: ArrayLike) -> FloatArray:
        """Displacement in px by (∫E_y dz, ∫E_x dz) in V; the inverse of `path_integrated_e`."""
        volts = _vector("field", field)
        return self.displacement(volts / self._electric_rigidity)


def _vector(name: str, values: ArrayLike) -> FloatArray:
    field = np.asarray(plain_array(values, name, VECTOR), dtype=np.float64)
    if field.ndim == 0 or field.shape[0] != 2:
        raise InputError(
            f"{name} has shape {field.shape}: expected (2, ...), the y component first"
        )
    return field


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
        default="optical", description="Kind of probe: a beam of light."
    )
    source_object_distance: float = Field(
        default=math.inf,
        gt=0,
        title="Source to object (m)",
        description="Distance l from the beam source to the object, in m. Default: inf (collimated "
        "beam).",
    )
    wavelength: float = number_field(
        "Wavelength (m)", "Vacuum wavelength of the light, in m.", gt=0, le=1e-2
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
        """Return the probe of the paper's plasma wave, which is collimated (Section V).

        The paper gives neither distance nor pixel; further behind than 20 µm, diffraction at a wave
        of 8 µm would no longer be small.
        """
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
        return float(recorded_with.critical_density / self.critical_density)

    @property
    def critical_density(self) -> float:
        """Electron density n_c = ε₀ m ω² / e² in m⁻³ beyond which the light does not travel."""
        frequency = 2 * math.pi * constants.c / self.wavelength
        return float(constants.epsilon_0 * constants.m_e * frequency**2 / constants.e**2)

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

    def relative_density_modulation(self, phi: ArrayLike, density: float) -> FloatArray:
        """Modulation of a plasma's density, relative to its mean: ∫Δn/n₀ dz in m.

        The normalised potential φ in px² is zero where the plasma is undisturbed, with the density
        n₀ in m⁻³; an `InputError` if that is not positive and finite.
        """
        if not (density > 0 and math.isfinite(density)):
            raise InputError(f"density is {density:g}: it must be positive, in electrons per m³")
        return self.line_integrated_density(phi) / density


SETUPS: dict[str, type[BeamSetup]] = {
    model.model_fields["kind"].default: model for model in (ProtonSetup, OpticalSetup)
}
"""The kinds of setup by name. A further kind is added here, and nowhere else."""


def _as_kind(value: Any) -> Any:
    """Turn a mapping into the setup of its kind; pydantic reports its errors as of a union."""
    if not isinstance(value, Mapping):
        return value
    kind = value.get("kind")
    if kind is None:
        raise PydanticKnownError("union_tag_not_found", {"discriminator": "'kind'"})
    if not isinstance(kind, str) or kind not in SETUPS:
        tags = ", ".join(map(repr, SETUPS))
        context = {"discriminator": "'kind'", "tag": str(kind), "expected_tags": tags}
        raise PydanticKnownError("union_tag_invalid", context)
    try:
        return SETUPS[kind].model_validate(value)
    except ValidationError as error:
        details: list[Any] = [
            {**detail, "loc": (kind, *detail["loc"])} for detail in error.errors(include_url=False)
        ]
        raise ValidationError.from_exception_data(kind, details) from None


Setup = Annotated[SerializeAsAny[BeamSetup], BeforeValidator(_as_kind)]
"""Setup of any kind in `SETUPS`, as the field of a model."""


def deflector_titles() -> dict[str, str]:
    """Return the titles of all causes of a deflection, by the keys that a fit takes."""
    return {
        deflector.key: deflector.title for kind in SETUPS.values() for deflector in kind.deflectors
    }


def beam_quantities() -> dict[str, BeamQuantity]:
    """Return the quantities that differ between beams, by name, for all kinds of setup."""
    quantities = (kind.beam_quantity() for kind in SETUPS.values())
    return {quantity.name: quantity for quantity in quantities}


def setup_from_dict(mapping: Mapping[str, Any], where: str = "setup") -> Setup:
    """Create a setup of the right kind from the content of a file.

    Parameters
    ----------
    mapping : mapping of str to object
        The fields, with a ``kind`` of `SETUPS`, such as "proton" (and a ``species``, for
        electrons or other ions) or "optical".
    where : str, optional
        Where the mapping comes from; an error's message begins with it.

    Raises
    ------
    InputError
        If a key is unknown or missing or a value cannot be used; the message names it.

    Examples
    --------
    >>> light = {"wavelength": 810e-9, "object_image_distance": 0.01, "pixel_size": 1e-6}
    >>> setup_from_dict({"kind": "optical", **light}).is_collimated
    True
    """
    if not isinstance(mapping, Mapping):
        raise InputError(
            f"{where}: received a {type(mapping).__name__}, expected a table of keys and values"
        )
    kind = mapping.get("kind")
    if isinstance(kind, str) and kind in SETUPS:
        return validate(SETUPS[kind], mapping, where)
    received = "is missing" if kind is None else f"is {kind!r}"
    other_kinds = " or ".join(repr(name) for name in SETUPS if name != "proton")
    raise InputError(
        f"{where}: 'kind' {received}, it must be 'proton' (any charged particles, named by "
        f"'species': {', '.join(SPECIES)}) or {other_kinds}{_suggest_kind(kind)}"
    )


def bin_setup(setup: Setup, factor: int) -> Setup:
    """Return the setup of an image whose pixels were summed in blocks of side `factor`."""
    values = setup.model_dump()
    for name in ("pixel_size", "detector_pixel_size"):
        if values.get(name) is not None:
            values[name] *= factor
    return type(setup)(**values)


def _suggest_kind(kind: Any) -> str:
    match = None if kind is None else nearest(str(kind), [*SETUPS, *SPECIES])
    if match is None or match in SETUPS:
        return f"; did you mean '{match}'?" if match else ""
    return f'; for this beam give kind = "proton" and species = "{match}"'
