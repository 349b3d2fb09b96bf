"""The command `shadowinv plan`."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from helpers.command_line import flat, shadowinv
from napari_shadowinv.physics.phantoms import gaussian_blob

SETUP = """
kind = "proton"
energy = 14.7
source_object_distance = 1.3e-3
object_image_distance = 2e-2
pixel_size = 1.5e-6
"""
QUICK = ("--size", "64x64", "--set=plan.draws=2")


@pytest.fixture
def folder(folder: Path) -> Path:
    (folder / "setup.toml").write_text(SETUP)
    return folder


def test_a_plan_writes_a_row_for_each_draw_and_a_figure(folder):
    answer = shadowinv(
        *("plan", "toroid:peak=20,radius=9e-6", "--setup", "setup.toml", *QUICK),
        *("--set=instrument.beam_rms=0", "--counts", 3000),
    )
    assert answer.exit_code == 0, answer.output
    assert "would be determined: 2 of 2" in flat(answer.output)
    with (folder / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["draw"] for row in rows] == ["0", "1"]
    assert all(0 < float(row["error"]) < 0.05 for row in rows)
    assert (folder / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_a_plan_says_which_beam_it_assumes(folder):
    arguments = ("plan", "toroid:peak=20,radius=9e-6", "--setup", "setup.toml", *QUICK)
    text = flat(shadowinv(*arguments, "--counts", 3000).output)
    assert "its unevenness of 5 % is assumed: record a reference" in text
    stated = flat(shadowinv(*arguments, "--set=instrument.beam_rms=0.05", "--overwrite").output)
    assert "limited by beam" in stated
    assert "assumed: record" not in stated


def test_particles_are_traced_through_a_field_on_a_grid(folder, refused):
    places = np.linspace(-6e-5, 6e-5, 33)
    z, y, x = np.meshgrid(places, places, places, indexing="ij")
    bell = 8e6 * np.exp(-(x**2 + y**2 + z**2) / (2 * 1.2e-5**2))
    values = {"Bx": bell * 0, "By": -z * bell, "Bz": y * bell}  # seen along x
    magnetic = {name: (("z", "y", "x"), value, {"units": "T"}) for name, value in values.items()}
    axes = {name: (name, places, {"units": "m"}) for name in "zyx"}
    xr.Dataset(magnetic, axes).to_netcdf(folder / "cube.nc", engine="h5netcdf")
    view = ("--setup", "setup.toml", "--set=view.beam=x", "--set=view.right=y")
    answer = shadowinv(
        *("plan", "cube.nc", *view, "--set=plan.draws=2"),
        *("--set=instrument.beam_rms=0", "--counts", 100_000),
    )
    assert answer.exit_code == 0, answer.output
    assert "would be determined: 2 of 2" in flat(answer.output)
    for arguments, message in (
        (("cube.nc",), "particles through it need --setup"),
        (
            ("cube.nc", *view, "--deflector", "magnetic field"),
            "--deflector, which does not apply to cube.nc",
        ),
        (("toroid", *view), "received view.beam, view.right, which does not apply to toroid"),
    ):
        refused("plan", *arguments, "--out", "other.csv", names=message)


def test_the_object_of_a_file_is_a_displacement(folder):
    np.save(folder / "c:field.npy", gaussian_blob((64, 64), 15, 6).displacement)
    answer = shadowinv(
        *("plan", "c:field.npy", "--set=plan.draws=2"),
        *("--set=instrument.beam_rms=0", "--counts", 10_000, "--quiet"),
    )
    assert answer.exit_code == 0, answer.output
    assert answer.output == ""


def test_a_field_that_would_not_be_determined_has_an_exit_code(folder):
    arguments = ("plan", "blob:amplitude=3,sigma=6", *QUICK, "--counts", 10)
    answer = shadowinv(*arguments)
    assert answer.exit_code == 3
    assert (folder / "plan.csv").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("plan", "torroid"), "did you mean 'toroid'"),
        (("plan", "torroid:peak=1.5"), "did you mean 'toroid'"),
        (("plan", "toroid"), "particles"),
        (("plan", "blob", "--energies", "3,15"), "--energies is '3,15': it needs a setup"),
        (("plan", "toroid", "--setup", "setup.toml", "--energies", "3;15"), "separated by commas"),
        (("plan", "blob", "--size", "200"), "expected height and width"),
        (("plan", "blob", "--counts", "-1"), "--counts is -1"),
        (("plan", "blob", "--set=instrument.background=2"), "instrument.background is '2'"),
        (("plan", "blob", "--deflector", "plasma"), "does not apply to blob, a phantom"),
        (("plan", "missing.shadowinv"), "missing.shadowinv"),
        (("plan", "blob", "--out", "plan.txt"), "plan.txt cannot be written"),
    ],
)
def test_wrong_input_is_one_sentence_and_writes_nothing(refused, arguments, message):
    refused(*arguments, names=message)
