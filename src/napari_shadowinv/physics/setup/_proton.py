"""Beams of charged particles, and the path-integrated fields that deflect them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self, get_args

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy import constants

from napari_shadowinv._system.arrays import VECTOR, plain_array
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup._beam import (
    BeamSetup,
    Deflector,
    MainField,
    SIField,
    positive_field,
)

Species = Literal["proton", "deuteron", "triton", "helion", "alpha", "electron"]
FieldUnit = Literal["T m", "MG um"]

_TESLA_METRES = {"T m": 1.0, "MG um": 1e-4}
_ELEMENTARY_CHARGE: float = constants.e
_LIGHT_SPEED: float = constants.c
_JOULES_PER_MEV = 1e6 * _ELEMENTARY_CHARGE


@dataclass(frozen=True)
class Particle:
    """Rest mass in kg and charge in C, with its sign, of a species of beam particle."""

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


_MIN_ENERGY_MEV, _MAX_ENERGY_MEV = 1e-6, 1e5
_MAX_ION_SOURCE_DISTANCE_M = 0.1  # sources of ions are small and shine from centimetres
_USUAL_ENERGIES_MEV: dict[Species, tuple[float, float]] = {
    "proton": (0.5, 100.0),
    "deuteron": (0.5, 100.0),
    "triton": (0.5, 100.0),
    "helion": (0.5, 200.0),
    "alpha": (0.5, 200.0),
    "electron": (0.01, 3000.0),
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
    # A magnetic field is at right angles to the displacement: it has arrows of its own.
    main_field: ClassVar = MainField(
        "path_integrated_b",
        "Path-integrated field",
        "|∫B×dz|",
        ("∫By dz", "∫Bx dz"),
        arrows="∫B dz arrows",
    )
    other_fields: ClassVar = {
        "electric field": MainField(
            "path_integrated_e",
            "Path-integrated electric field",
            "|∫E dz|",
            ("∫Ey dz", "∫Ex dz"),
        )
    }

    kind: Literal["proton"] = Field(
        default="proton", title="Kind", description="Kind of probe: a beam of charged particles."
    )
    energy: float = positive_field(
        "Kinetic energy (MeV)",
        "Kinetic energy per particle (not per nucleon), in MeV.",
        most=_MAX_ENERGY_MEV,
    )
    species: Species = Field(
        default="proton",
        title="Species",
        description="Particle species; electrons are deflected the opposite way.",
    )

    @model_validator(mode="after")
    def _energy_in_range(self) -> ProtonSetup:
        if self.energy < _MIN_ENERGY_MEV:
            raise ValueError(
                f"'energy' is {self.energy:g} MeV, expected at least {_MIN_ENERGY_MEV:g} MeV: "
                "check its unit"
            )
        return self

    @property
    def probe(self) -> str:
        return f"{self.energy:g} MeV {self.species}"

    @property
    def max_source_distance(self) -> float:
        return math.inf if self.species == "electron" else _MAX_ION_SOURCE_DISTANCE_M

    def probe_doubts(self) -> Iterator[str]:
        least, most = _USUAL_ENERGIES_MEV[self.species]
        if not least <= self.energy <= most:
            yield (
                f"{self.species}s of {self.energy:g} MeV are unusual in radiography, which uses "
                f"{least:g} to {most:g} MeV: fields scale with the momentum; the energy is given "
                "in MeV"
            )

    @classmethod
    def example(cls) -> Self:
        """Return the experiment of the paper's benchmark; see `phantoms.paper_setup`."""
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
            units = ", ".join(get_args(FieldUnit))
            raise InputError(f"unit is {unit!r}: it must be one of {units}")
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
