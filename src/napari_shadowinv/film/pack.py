"""Pack of films and filters, the first to be hit at the top, and how its materials stop protons.

- its parts: `Pack`, `PackLayer`, `FilmType`, `Slab`, `Material`
- stopping by a table in SRIM's format: `Stopping.from_srim`; by that or by Bethe's formula, for
  matter of known density and composition: `Material.stopping`
- the energy behind a slab, and the range of protons: `Stopping.behind`, `Stopping.depth`

Protons slow down continuously and straight ahead; they neither straggle nor scatter. Energies are
in MeV, lengths in m.

References
----------
S. M. Seltzer and M. J. Berger, ICRU Report 49 (1993), for Bethe's formula and mean excitation
energies; J. F. Ziegler et al., Nucl. Instrum. Methods B 268, 1818 (2010), for SRIM.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field, model_validator

from napari_shadowinv._system.safety import as_file_errors, small_text
from napari_shadowinv._system.validation import CheckedModel, suggestion
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.physics.setup import ProtonSetup, setup_from_dict

PROTON_MASS = 938.27209  # MeV
_ELECTRON_MASS = 0.51099895  # MeV
_BETHE_FACTOR = 0.307075  # MeV cm²/mol

_UNITS = {"eV": 1e-6, "keV": 1e-3, "MeV": 1.0, "GeV": 1e3}
_ROW = re.compile(r"\s*([\d.]+)\s+(eV|keV|MeV|GeV)\s+([\d.]+E[+-]\d+)\s+([\d.]+E[+-]\d+)\s")
_DENSITY = re.compile(r"Target Density\s*=\s*([\d.]+E[+-]\d+)\s*g/cm3")
_STOPPING_UNIT = re.compile(r"Stopping Units\s*=\s*(\S.*?\S)\s*$", re.MULTILINE)
_MASS_UNIT = "MeV / (mg/cm2)"


@dataclass(frozen=True, eq=False)
class Stopping:
    """Energy loss of protons on their way through a material.

    Attributes
    ----------
    energies : ndarray, shape (n,)
        In MeV, increasing.
    losses : ndarray, shape (n,)
        Energy lost per length at them, in MeV/m.
    density : float
        In kg/m³.
    """

    energies: FloatArray
    losses: FloatArray
    density: float

    @staticmethod
    @as_file_errors
    def from_srim(path: Path) -> Stopping:
        """Read a table as SRIM writes it in its default units; else a `FileFormatError`."""
        text = small_text(path, "a table of stopping and ranges by SRIM", "latin-1")
        density, unit = _DENSITY.search(text), _STOPPING_UNIT.search(text)
        rows = [match.groups() for line in text.splitlines() if (match := _ROW.match(line))]
        if density is None or unit is None or len(rows) < 2:
            raise FileFormatError(
                f"{path} has no density, unit or rows of energies and stopping: expected a table "
                "of stopping and ranges as SRIM writes it"
            )
        if unit[1] != _MASS_UNIT:
            raise FileFormatError(
                f"{path} has stopping in {unit[1]}: expected SRIM's default, {_MASS_UNIT}; make "
                "the table again with it"
            )
        energies = np.array([float(value) * _UNITS[name] for value, name, *_ in rows])
        grams = float(density[1])
        losses = np.array([float(electrons) + float(nuclei) for *_, electrons, nuclei in rows])
        if not (np.diff(energies) > 0).all():
            raise FileFormatError(f"{path} has energies that do not increase: make the table again")
        return Stopping(energies, losses * 1000 * grams * 100, 1000 * grams)

    @cached_property
    def _depths(self) -> tuple[FloatArray, FloatArray]:
        """Closely spaced energies, and the range of protons at each."""
        energies = np.geomspace(self.energies[0], self.energies[-1], 4000)
        per_loss = 1 / self.loss(energies)
        steps = 0.5 * (per_loss[1:] + per_loss[:-1]) * np.diff(energies)
        # Below the first energy the loss goes as the velocity.
        first = 2 * energies[0] * per_loss[0]
        return energies, first + np.concatenate([[0.0], np.cumsum(steps)])

    def loss(self, energy: ArrayLike) -> FloatArray:
        """Return the energy lost per length, in MeV/m."""
        logarithms = np.log(np.asarray(energy, float))
        table = np.log(self.energies), np.log(self.losses)
        return np.asarray(np.exp(np.interp(logarithms, *table)))

    def depth(self, energy: ArrayLike) -> FloatArray:
        """Return the range of protons of an energy, in m."""
        energies, depths = self._depths
        return np.asarray(np.interp(np.asarray(energy, float), energies, depths, left=0.0))

    def behind(self, energy: ArrayLike, thickness: float) -> FloatArray:
        """Return the energy of protons behind a slab; 0 if they stop in it.

        Raises
        ------
        InputError
            If an energy is above the table's range.
        """
        energies = np.asarray(energy, float)
        if energies.size and energies.max() > self.energies[-1] * (1 + 1e-9):
            raise InputError(
                f"protons of {energies.max():.4g} MeV are faster than those of the stopping table, "
                f"which ends at {self.energies[-1]:.4g} MeV: give a table that goes further"
            )
        table_energies, depths = self._depths
        remaining = self.depth(energies) - thickness
        behind = np.interp(remaining, depths, table_energies)
        return np.asarray(np.where(remaining > depths[0], behind, 0.0))


def _mass_loss(energies: FloatArray, charge_per_mass: float, excitation: float) -> FloatArray:
    """Return the loss by Bethe's formula without shell and density corrections, in MeV cm²/g."""
    gamma = 1 + energies / PROTON_MASS
    squared = 1 - 1 / gamma**2
    ratio = _ELECTRON_MASS / PROTON_MASS
    most = 2 * _ELECTRON_MASS * squared * gamma**2 / (1 + 2 * gamma * ratio + ratio**2)
    inside = 2 * _ELECTRON_MASS * squared * gamma**2 * most / (1e-6 * excitation) ** 2
    return np.asarray(_BETHE_FACTOR * charge_per_mass / squared * (0.5 * np.log(inside) - squared))


_SEEN_FROM = {
    None: "the source (assumed)",
    "source": "the source",
    "detector": "the source (scans from the detector, mirrored)",
}


def _file_field(title: str, description: str) -> Any:
    """Return the field of a file that may be missing."""
    return Field(default=None, title=title, description=description)


class Material(CheckedModel):
    """Material with its stopping of protons, by a table from SRIM or by Bethe's formula."""

    density: float | None = Field(
        default=None, gt=0, title="Density (kg/m³)", description="Where there is no table."
    )
    charge_per_mass: float | None = Field(
        default=None, gt=0, lt=1.1, title="Z/A", description="Mean, in mol/g; about 0.5."
    )
    excitation: float | None = Field(
        default=None,
        gt=0,
        title="Mean excitation energy (eV)",
        description="About 10 eV times the atomic number.",
    )
    table: Path | None = _file_field("Stopping table", "File with the stopping by SRIM.")

    @model_validator(mode="after")
    def _is_known(self) -> Material:
        formula = (self.density, self.charge_per_mass, self.excitation)
        if (self.table is None) == all(value is None for value in formula):
            raise ValueError("expected a table, or density, charge per mass and excitation")
        if self.table is None and None in formula:
            raise ValueError("expected density, charge per mass and excitation, all three")
        return self

    def stopping(self, *, slow: tuple[float, float] = (0.1, 0.5)) -> Stopping:
        """Return the stopping of protons in it.

        Bethe's formula is right to about 5 % from 1 MeV and 2 % from 10 MeV on. Below the higher of
        the energies `slow`, in MeV, it is wrong: the loss goes on with its slope, then, below the
        lower one, in proportion to the velocity.

        Examples
        --------
        >>> float(MATERIALS["Al"].stopping().loss(10.0) / 2699 * 10)  # 33.8 MeV cm²/g by ICRU 49
        34.2...
        """
        if self.table is not None:
            return Stopping.from_srim(self.table)
        assert self.density is not None
        assert self.charge_per_mass is not None
        assert self.excitation is not None
        energies = np.geomspace(0.01, 300.0, 4000)
        slowest, slower = slow
        formula = self.charge_per_mass, self.excitation
        fast = _mass_loss(np.maximum(energies, slower), *formula)
        near = _mass_loss(slower * np.array([1.0, 1.01]), *formula)
        slope = np.log(near[1] / near[0]) / np.log(1.01)
        going_on = np.minimum(np.maximum(energies, slowest) / slower, 1.0) ** slope
        velocity = np.sqrt(np.minimum(energies / slowest, 1.0))
        losses = fast * going_on * velocity * (self.density / 1000) * 100
        return Stopping(energies, losses, self.density)


def _material(density: float, charge_per_mass: float, excitation: float) -> Material:
    return Material(density=density, charge_per_mass=charge_per_mass, excitation=excitation)


# Densities, Z/A and excitation energies of elements and polymers: ICRU Report 49. Density and
# composition of active layers are from their maker, their excitation follows from Bragg's rule.
MATERIALS = {
    "Al": _material(2699, 0.48181, 166.0),
    "Fe": _material(7874, 0.46557, 286.0),
    "Cu": _material(8960, 0.45636, 322.0),
    "Ta": _material(16654, 0.40343, 718.0),
    "Ti": _material(4540, 0.45961, 233.0),
    "Au": _material(19320, 0.40108, 790.0),
    "Mylar": _material(1400, 0.52037, 78.7),
    "polyester": _material(1350, 0.52037, 78.7),
    "polystyrene": _material(1060, 0.53768, 68.7),
    "Kapton": _material(1420, 0.51264, 79.6),
    "CR-39": _material(1310, 0.52697, 73.1),
    "EBT active": _material(1200, 0.5450, 69.6),
    "HD active": _material(1080, 0.5453, 66.6),
}


class Slab(CheckedModel):
    """Layer of one material, also from a text such as ``13 um Al``."""

    material: str
    thickness: float = Field(gt=0, le=0.1, title="Thickness (m)")

    @model_validator(mode="before")
    @classmethod
    def _from_text(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        parts = _SLAB.match(value.strip())
        if parts is None:
            raise ValueError("expected thickness, unit (um or mm) and material, such as 13 um Al")
        micrometres = float(parts["number"]) * (1000 if parts["unit"] == "mm" else 1)
        return {"material": parts["material"], "thickness": micrometres * 1e-6}


_SLAB = re.compile(r"(?P<number>\d+\.?\d*)\s*(?P<unit>um|µm|μm|mm)\s+(?P<material>\S.*)")


def _split_slabs(value: Any) -> Any:
    """Split a text with slabs separated by semicolons."""
    return [part for part in value.split(";") if part.strip()] if isinstance(value, str) else value


def _from_digits(value: Any) -> Any:
    return int(value) if isinstance(value, str) and value.isdecimal() else value


Slabs = Annotated[tuple[Slab, ...], BeforeValidator(_split_slabs)]


class FilmType(CheckedModel):
    """Type of film: its layers in the order in which protons cross them, and its calibration."""

    before: Slabs = Field(default=(), description="In front of the active layer.")
    active: Slab = Field(title="Active layer", description="Such as 12 um HD active.")
    behind: Slabs = Field(default=(), description="Behind the active layer.")
    calibration: Path | None = _file_field("Calibration", "Table (.csv) of doses and pixels.")
    unexposed: Path | None = _file_field("Unexposed film", "Scan of a film that saw nothing.")
    dose_range: tuple[float, float] = Field(
        default=(0.0, np.inf),
        title="Range of doses (Gy)",
        description="Rows of the calibration to use; tables are often continued by extrapolation.",
    )


def _slab(material: str, micrometres: float) -> Slab:
    return Slab(material=material, thickness=micrometres * 1e-6)


_EBT_BASE = (_slab("polyester", 125),)
# As Ashland describes them.
FILM_TYPES = {
    "HDV2": FilmType(active=_slab("HD active", 12), behind=(_slab("polyester", 97),)),
    "EBT3": FilmType(before=_EBT_BASE, active=_slab("EBT active", 28), behind=_EBT_BASE),
    "MDV3": FilmType(before=_EBT_BASE, active=_slab("EBT active", 10), behind=_EBT_BASE),
}


class PackLayer(CheckedModel):
    """Film of the pack, and the filters in front of it."""

    film: str = Field(description="Its type.")
    filters: Slabs = Field(default=(), description="In front of it, such as 13 um Al; 25 um Fe.")
    file: Path | None = _file_field("Scan", "Its file; otherwise it is one of the pack's scan.")
    turned: Annotated[Literal[0, 180], BeforeValidator(_from_digits)] = Field(
        default=0, title="Turned (°)", description="180 if it was scanned upside down."
    )
    mirrored: bool = Field(default=False, description="Whether it was scanned with its back down.")
    mask: Path | None = _file_field(
        "Mask", "Image of the upright film's shape, 0 at unusable pixels."
    )
    exclude: bool = Field(default=False, description="Whether its scan is useless.")


class Pack(CheckedModel):
    """Films and filters, the first in front, with their types and materials.

    A type or material of the pack replaces the built-in one of its name; a type inherits the fields
    that it leaves out from the built-in one.
    """

    layers: tuple[PackLayer, ...] = Field(
        min_length=1, description="Films and the filters in front of each."
    )
    films: Mapping[str, FilmType] = Field(
        default_factory=dict, description="By type: layers, calibration."
    )
    materials: Mapping[str, Material] = Field(
        default_factory=dict, description="How filters and films stop protons."
    )
    setup: Mapping[str, Any] | None = Field(
        default=None,
        description="Distances, that of the image to the first film. The scans give the size of "
        "pixels, the pack the energies.",
    )
    scan: Path | None = _file_field(
        "Scan", "One scan with the films of all layers without a file, row by row."
    )
    corners: Path | None = _file_field(
        "Corners", "Table (.csv) of films on their scans, by number: film, y1, x1, … y4, x4."
    )
    fiducials: Path | None = _file_field(
        "Fiducials",
        "Table (.csv) of marks through the whole pack on the films' scans: film, name, y, x.",
    )
    axis: tuple[float, float] | None = Field(
        default=None,
        title="Axis (px)",
        description="Where the normal of the films through the source meets the first film, y and "
        "x from its top left corner when upright; deeper films are magnified about it. Default: "
        "the film's middle.",
    )
    pixel_size: float | None = Field(
        default=None,
        gt=0,
        le=0.01,
        title="Pixel size of the scans (m)",
        description="Default: as their files say.",
    )
    seen_from: Literal["source", "detector"] | None = Field(
        default=None,
        title="Films seen from",
        description="Side from which the upright films are seen: source, as the beam does, or "
        "detector, which mirrors them and reverses the sign of B. Default: source, with a warning.",
    )
    rim: int = Field(
        default=6,
        ge=0,
        title="Rim (px)",
        description="What does not count along the edges of the films: cut, bent or burnt.",
    )
    align: Literal["images", "edges"] = Field(
        default="images",
        description="By shared structure, or by edges alone; not used where there are fiducials.",
    )

    @model_validator(mode="before")
    @classmethod
    def _complete_types(cls, values: Any) -> Any:
        films = values.get("films") if isinstance(values, Mapping) else None
        if not isinstance(films, Mapping):
            return values
        complete = {
            name: {**FILM_TYPES[name].model_dump(), **film}
            if name in FILM_TYPES and isinstance(film, Mapping)
            else film
            for name, film in films.items()
        }
        return {**values, "films": complete}

    @model_validator(mode="after")
    def _has_all_parts(self) -> Pack:
        for number, layer in enumerate(self.layers, 1):
            _check_known(layer.film, self.film_types, f"layer {number} is a film of type", "films")
            for slab in self._slabs(layer):
                _check_known(slab.material, self._all_materials, f"layer {number} has", "materials")
        if self.setup is not None and "energy" in self.setup:
            raise ValueError("the setup has an energy: leave it out, films see one each")
        if self.setup is not None:
            self.setups(np.ones(len(self.layers)), 1e-4)
        elif self.axis is not None:
            raise ValueError("axis is given and no setup: without it magnifications are not known")
        return self

    @property
    def film_types(self) -> dict[str, FilmType]:
        """Types of films by name, built-in ones and the pack's."""
        return FILM_TYPES | dict(self.films)

    @property
    def _all_materials(self) -> dict[str, Material]:
        return MATERIALS | dict(self.materials)

    def _slabs(self, layer: PackLayer) -> tuple[Slab, ...]:
        film = self.film(layer)
        return (*layer.filters, *film.before, film.active, *film.behind)

    @property
    def files(self) -> list[Path]:
        """All files that the pack refers to."""
        files: list[Path | None] = [self.scan, self.corners, self.fiducials]
        files += [file for layer in self.layers for file in (layer.file, layer.mask)]
        for film in self.films.values():
            files += [film.calibration, film.unexposed]
        files += [material.table for material in self.materials.values()]
        return [file for file in files if file is not None]

    def film(self, layer: PackLayer) -> FilmType:
        """Return the type of a layer's film."""
        return self.film_types[layer.film]

    @property
    def seen_from_text(self) -> str:
        """Side from which the upright films are seen, in words."""
        return _SEEN_FROM[self.seen_from]

    def is_mirrored(self, layer: PackLayer) -> bool:
        """Return whether the scan of a layer is mirrored against the view from the source."""
        return layer.mirrored != (self.seen_from == "detector")

    def setups(self, energies: ArrayLike, pixel_size: float | None) -> tuple[ProtonSetup, ...]:
        """Return the setup of each layer, on common pixels at the object; empty without a setup.

        Parameters
        ----------
        energies : array_like, shape (n,)
            In MeV.
        pixel_size : float or None
            Of the scans in m, where the setup has no pixel size of the first film.
        """
        if self.setup is None:
            return ()
        size = {} if pixel_size is None else {"detector_pixel_size": pixel_size}
        size = {} if "pixel_size" in self.setup else size
        values = {"kind": "proton", **size, **self.setup}
        in_mev = np.asarray(energies, np.float64)
        if values["kind"] != "proton" or values.get("species", "proton") != "proton":
            raise InputError("the pack's setup is not one of protons, whose stopping is known")
        first = setup_from_dict({**values, "energy": float(in_mev[0])}, "setup")
        assert isinstance(first, ProtonSetup)
        common = {"pixel_size": first.object_pixel_size, "detector_pixel_size": None}
        setups = []
        for energy, depth in zip(in_mev, self.depths(), strict=True):
            distance = first.object_image_distance + float(depth)
            changes = {**common, "energy": float(energy), "object_image_distance": distance}
            setups.append(first.model_copy(update=changes))
        return tuple(setups)

    def depths(self) -> FloatArray:
        """Return the distance of each film's active layer from the first film's, in m."""
        surface, middles = 0.0, []
        for layer in self.layers:
            film = self.film(layer)
            surface += sum(slab.thickness for slab in (*layer.filters, *film.before))
            middles.append(surface + film.active.thickness / 2)
            surface += sum(slab.thickness for slab in (film.active, *film.behind))
        return np.array(middles) - middles[0]

    def stoppings(self) -> dict[str, Stopping]:
        """Return the stopping of protons in each material of the pack."""
        names = {slab.material for layer in self.layers for slab in self._slabs(layer)}
        return {name: self._all_materials[name].stopping() for name in sorted(names)}


def _check_known(name: str, choices: Mapping[str, Any], who: str, table: str) -> None:
    if name not in choices:
        raise ValueError(
            f"{who} '{name}', which has no entry under [{table}]: {suggestion(name, choices)}"
        )
