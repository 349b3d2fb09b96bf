"""The command `shadowinv plan`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from helpers.command_line import done, flat, shadowinv
from napari_shadowinv import invert, synthetic_image, write
from napari_shadowinv.physics.phantoms import gaussian_blob

SETUP = """
kind = "proton"
energy = 14.7
source_object_distance = 1.3e-3
object_image_distance = 2e-2
pixel_size = 1.5e-6
"""
QUICK = ("--size", "64x64", "--set=plan.draws=2")
TOROID = ("plan", "toroid:peak=20,radius=9e-6", "--setup", "setup.toml", *QUICK, "--counts", 3000)


@pytest.fixture
def folder(folder: Path) -> Path:
    (folder / "setup.toml").write_text(SETUP)
    return folder


def test_a_plan_writes_a_row_for_each_draw_and_a_figure(folder):
    assert "would be determined: 2 of 2" in done(*TOROID, "--set=instrument.beam_rms=0")
    with (folder / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["draw"] for row in rows] == ["0", "1"]
    assert all(0 < float(row["error"]) < 0.05 for row in rows)
    assert (folder / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_a_plan_says_which_beam_it_assumes(folder):
    assumed = flat(shadowinv(*TOROID).output)
    assert "its unevenness of 5 % is assumed: record a reference" in assumed
    stated = flat(shadowinv(*TOROID, "--set=instrument.beam_rms=0.05", "--overwrite").output)
    assert "limited by beam" in stated
    assert "assumed: record" not in stated


def test_particles_are_traced_through_a_field_on_a_grid(folder):
    places = np.linspace(-6e-5, 6e-5, 33)
    z, y, x = np.meshgrid(places, places, places, indexing="ij")
    bell = 8e6 * np.exp(-(x**2 + y**2 + z**2) / (2 * 1.2e-5**2))
    values = {"Bx": bell * 0, "By": -z * bell, "Bz": y * bell}  # seen along x
    magnetic = {name: (("z", "y", "x"), value, {"units": "T"}) for name, value in values.items()}
    axes = {name: (name, places, {"units": "m"}) for name in "zyx"}
    xr.Dataset(magnetic, axes).to_netcdf(folder / "cube.nc", engine="h5netcdf")
    view = ("--setup", "setup.toml", "--set=view.beam=x", "--set=view.right=y")
    exact = ("--set=plan.draws=2", "--set=instrument.beam_rms=0", "--counts", 100_000)
    assert "would be determined: 2 of 2" in done("plan", "cube.nc", *view, *exact)


def test_the_object_of_a_file_is_that_of_a_result(folder):
    write("c:field.shadowinv", invert(synthetic_image(gaussian_blob((64, 64), 15, 6).displacement)))
    exact = ("--set=plan.draws=2", "--set=instrument.beam_rms=0", "--counts", 10_000)
    assert done("plan", "c:field.shadowinv", *exact, "--quiet") == ""


def test_a_field_that_would_not_be_determined_has_an_exit_code(folder):
    done("plan", "blob:amplitude=3,sigma=6", *QUICK, "--counts", 10, code=3)
    assert (folder / "plan.csv").exists()
