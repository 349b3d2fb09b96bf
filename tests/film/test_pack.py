"""Facts about the stopping of protons: tables, Bethe's formula, and what is behind a slab."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.public_data import public_file
from helpers.srim import TABLES
from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.film import Stopping
from napari_shadowinv.film.pack import MATERIALS

TABLE = """
 Target Density =  2.0000E+00 g/cm3 = 6.0305E+22 atoms/cm3
 Stopping Units =  MeV / (mg/cm2)
   Ion        dE/dx      dE/dx     Projected  Longitudinal   Lateral
 100.00 keV   4.000E-01  1.000E-03    8453 A       973 A      1252 A
   1.00 MeV   2.000E-01  1.000E-04    1.00 um     1036 A      1370 A
  10.00 MeV   2.500E-02  1.000E-05    1.00 um     1036 A      1370 A
"""


def test_a_table_is_read_in_its_units(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    path.write_text(TABLE)
    stopping = Stopping.from_srim(path)
    assert stopping.density == 2000
    np.testing.assert_array_equal(stopping.energies, [0.1, 1, 10])
    # 1 MeV/(mg/cm²) in 2000 mg/cm³ is 2000 MeV/cm.
    np.testing.assert_allclose(stopping.losses, 2e5 * np.array([0.401, 0.2001, 0.02501]))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("MeV / (mg/cm2)", "eV / Angstrom", r"stopping in eV / Angstrom: expected SRIM's default"),
        ("Target Density", "Density", "no density, unit or rows"),
        ("10.00 MeV", " 0.50 MeV", "energies that do not increase"),
    ],
)
def test_other_tables_are_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "table.txt"
    path.write_text(TABLE.replace(old, new))
    with pytest.raises(FileFormatError, match=message):
        Stopping.from_srim(path)


@pytest.mark.parametrize("name", TABLES)
def test_the_formula_agrees_with_srim(name: str) -> None:
    table = Stopping.from_srim(public_file(TABLES[name]))
    formula = MATERIALS[name].stopping()
    energies = np.array([1.0, 2, 5, 10, 30, 70])
    ratio = (formula.loss(energies) / formula.density) / (table.loss(energies) / table.density)
    assert abs(ratio[1:] - 1).max() < 0.06
    assert abs(ratio[3:] - 1).max() < 0.04


def test_the_depth_of_a_loss_in_proportion_to_velocity() -> None:
    """dE/dx = k √E stops after 2 √E / k."""
    energies = np.geomspace(0.01, 100, 50)
    stopping = Stopping(energies, 3000 * np.sqrt(energies), 1000.0)
    probes = np.array([0.02, 1.0, 50.0])
    np.testing.assert_allclose(stopping.depth(probes), 2 * np.sqrt(probes) / 3000, rtol=1e-4)


def test_slabs_one_after_the_other_are_one_slab() -> None:
    stopping = MATERIALS["Al"].stopping()
    energies = np.array([3.0, 10.0, 40.0])
    thin = energies
    for _ in range(4):
        thin = stopping.behind(thin, 2e-5)
    np.testing.assert_allclose(thin, stopping.behind(energies, 8e-5), rtol=1e-6)


def test_protons_stop_where_they_are_said_to() -> None:
    stopping = MATERIALS["Mylar"].stopping()
    depth = float(stopping.depth(8.0))
    assert stopping.behind(8.0, 1.001 * depth) == 0
    assert 0 < stopping.behind(8.0, 0.999 * depth) < 0.5


def test_a_table_does_not_tell_of_faster_protons(tmp_path: Path) -> None:
    path = tmp_path / "table.txt"
    path.write_text(TABLE)
    with pytest.raises(InputError, match="faster than those of the stopping table"):
        Stopping.from_srim(path).behind([5.0, 12.0], 1e-5)
