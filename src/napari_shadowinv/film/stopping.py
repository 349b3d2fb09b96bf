"""Energy loss of protons in matter.

- by a table in SRIM's format: `Stopping.from_srim`
- by Bethe's formula, for matter of known density and composition: `Stopping.by_bethe`
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
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from napari_shadowinv._system.safety import as_file_errors, small_text
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import FileFormatError, InputError

__all__ = ["PROTON_MASS", "Stopping"]

PROTON_MASS = 938.27209  # MeV
_ELECTRON_MASS = 0.51099895  # MeV
_BETHE = 0.307075  # MeV cm²/mol
_MIN_ENERGY_MEV = 0.01
_MAX_ENERGY_MEV = 300.0
_ENERGIES = 4000
# Below, Bethe's formula is wrong: it goes on with its slope, then in proportion to the velocity.
_MIN_BETHE_MEV = 0.5
_MIN_SLOPE_MEV = 0.1
_PER_M = 100.0  # from 1/cm

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

    @classmethod
    def from_srim(cls, path: str | Path) -> Stopping:
        """Read a table of stopping and ranges as SRIM writes it, in its default units.

        Raises
        ------
        FileFormatError
            If the file is no such table, or has other units.
        """
        return _from_srim(path)

    @classmethod
    def by_bethe(cls, density: float, charge_per_mass: float, excitation: float) -> Stopping:
        """Compute losses by Bethe's formula, to about 5 % from 1 MeV and 2 % from 10 MeV on.

        Parameters
        ----------
        density : float
            In kg/m³.
        charge_per_mass : float
            Mean Z/A, in mol/g.
        excitation : float
            Mean excitation energy in eV.

        Examples
        --------
        >>> aluminium = Stopping.by_bethe(2699, 0.48181, 166)
        >>> float(aluminium.loss(10.0) / 2699 * 10)  # 33.8 MeV cm²/g by ICRU 49
        34.2...
        """
        energies = np.geomspace(_MIN_ENERGY_MEV, _MAX_ENERGY_MEV, _ENERGIES)
        fast = _mass_loss(np.maximum(energies, _MIN_BETHE_MEV), charge_per_mass, excitation)
        near = _mass_loss(_MIN_BETHE_MEV * np.array([1.0, 1.01]), charge_per_mass, excitation)
        slope = np.log(near[1] / near[0]) / np.log(1.01)
        going_on = np.minimum(np.maximum(energies, _MIN_SLOPE_MEV) / _MIN_BETHE_MEV, 1.0) ** slope
        slow = np.sqrt(np.minimum(energies / _MIN_SLOPE_MEV, 1.0))
        losses = fast * going_on * slow * (density / 1000) * _PER_M
        return cls(energies, losses, density)

    @cached_property
    def _depths(self) -> tuple[FloatArray, FloatArray]:
        """Closely spaced energies, and the range of protons at each."""
        energies = np.geomspace(self.energies[0], self.energies[-1], _ENERGIES)
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
    return np.asarray(_BETHE * charge_per_mass / squared * (0.5 * np.log(inside) - squared))


@as_file_errors
def _from_srim(path: Path) -> Stopping:
    text = small_text(path, "a table of stopping and ranges by SRIM", "latin-1")
    density, unit = _DENSITY.search(text), _STOPPING_UNIT.search(text)
    rows = [match.groups() for line in text.splitlines() if (match := _ROW.match(line))]
    if density is None or unit is None or len(rows) < 2:
        raise FileFormatError(
            f"{path} has no density, unit or rows of energies and stopping: expected a table of "
            "stopping and ranges as SRIM writes it"
        )
    if unit[1] != _MASS_UNIT:
        raise FileFormatError(
            f"{path} has stopping in {unit[1]}: expected SRIM's default, {_MASS_UNIT}; make the "
            "table again with it"
        )
    energies = np.array([float(value) * _UNITS[name] for value, name, *_ in rows])
    grams = float(density[1])
    losses = np.array([float(electrons) + float(nuclei) for *_, electrons, nuclei in rows])
    if not (np.diff(energies) > 0).all():
        raise FileFormatError(f"{path} has energies that do not increase: make the table again")
    return Stopping(energies, losses * 1000 * grams * _PER_M, 1000 * grams)
