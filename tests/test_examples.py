"""Every script of examples/ runs as a user would run it, and finds what it should."""

from __future__ import annotations

import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest
import xarray as xr

from helpers.command_line import run_line
from helpers.pages import ROOT, text_of
from helpers.public_data import load_donut, public_file
from napari_shadowinv import read
from napari_shadowinv.inversion.variables import setup_from_dataset

# Those for napari are tested with it.
SCRIPTS = sorted(
    path.stem for path in (ROOT / "examples").glob("*.py") if not path.stem.startswith("napari_")
)

Run = Callable[..., dict[str, Any]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a script with fewer pixels, and return its variables."""
    monkeypatch.chdir(tmp_path)

    def run_it(name: str, *arguments: object) -> dict[str, Any]:
        words = [f"{name}.py", *map(str, arguments), "--small", "--out", str(tmp_path)]
        monkeypatch.setattr(sys, "argv", words)
        names = runpy.run_path(str(ROOT / "examples" / f"{name}.py"), run_name="__main__")
        picture = iio.imread(tmp_path / f"{name}.png")
        assert picture.shape[0] > 300
        assert picture.shape[1] > 1000
        assert np.ptp(picture) == 255
        return names

    return run_it


def test_donut_beats_the_linear_inversion(run: Run, tmp_path: Path) -> None:
    for name, data in zip(("intensity", "displacement"), load_donut(), strict=True):
        np.save(tmp_path / f"{name}.npy", data)
    names = run("donut", tmp_path)
    errors = names["errors"]
    assert errors["Retrieved"] < 0.05
    assert errors["Linear (Poisson)"] > 0.5
    peak = {name: field.max() for name, field in names["strength"].items()}
    assert peak["Retrieved"] == pytest.approx(peak["True"], rel=0.03)
    saved = read(tmp_path / "donut.shadowinv")
    assert isinstance(saved, xr.Dataset)
    assert setup_from_dataset(saved) == names["setup"]


def test_caustic_errs_only_where_rays_share_their_places(run: Run) -> None:
    names = run("caustic")
    inside, outside = names["errors"].values()
    assert 0.1 < inside < 0.25
    assert outside < 0.01
    assert names["found_field"].max() == pytest.approx(290, rel=0.08)
    assert 0.25 < names["shared"].mean() < 0.4
    # What is marked lies inside.
    caustic = names["inversion"].caustic
    assert 0 < caustic.sum() < names["shared"].sum()
    assert (caustic & ~names["shared"]).sum() < 0.02 * caustic.sum()


def test_below_caustics_the_same_script_finds_the_field(run: Run) -> None:
    names = run("caustic", "--peak", 97)
    assert not names["shared"].any()
    assert not names["inversion"].caustic.any()
    assert max(names["errors"].values()) < 0.01


def test_wakefield_gives_density_and_wavelength(run: Run) -> None:
    names = run("wakefield")
    assert names["wavelength"] == pytest.approx(8.22e-6, rel=0.01)
    assert names["error"] < 0.15
    assert names["error"] < 0.5 * names["raw_error"]
    # ∫Δn/n₀ dz in m, see `phantoms.wakefield`.
    assert names["found"].max() == pytest.approx(9.2e-6, rel=0.06)
    assert names["found"].min() == pytest.approx(names["true"].min(), rel=0.06)


def test_prediction_for_another_energy_and_the_command_line_agree(run: Run) -> None:
    names = run("project_other_energy")
    assert names["errors"]["magnetic"] < 0.1
    assert names["errors"]["electric"] > 0.5
    assert names["predicted"].shape == (80, 80)
    run_line("forward 14.7MeV.shadowinv --setup 3MeV.toml --out low.npy")
    np.testing.assert_allclose(np.load("low.npy"), names["predicted"], rtol=1e-9, atol=1e-12)


def test_burner_strip_explains_every_frame(run: Run, burner: list[Path]) -> None:
    names = run("burner_strip", burner[0].parent)
    assert len(names["inversions"]) == len(names["files"]) == 11
    assert all(inversion.report.converged for inversion in names["inversions"])
    np.testing.assert_allclose(np.diff(names["seconds"]), 0.1, atol=0.02)
    for before, after, strength in zip(
        names["modulation"], names["unexplained"], names["strengths"], strict=True
    ):
        assert after < before / 2.5
        assert 3 < strength.max() < 8
        # The plume does not reach the lower left corner.
        assert strength[-10:, :10].max() < 0.2 * strength.max()


def test_film_layers_give_dose_and_displacement(run: Run) -> None:
    needed = ["HDV2.tif", "HDV2_3_calibration.csv", *(f"RCF_18{letter}.tif" for letter in "HIJKL")]
    paths = [public_file(f"rcf/{name}") for name in needed]
    names = run("rcf_layers", paths[0].parent)
    means = [float(image.mean()) for image in names["doses"].values()]
    # Fewer protons have more energy.
    assert means[:4] == sorted(means[:4], reverse=True)
    assert means[4] < means[1]
    for layer, inversion in names["inversions"].items():
        assert inversion.report.converged
        assert names["outside"][layer] < 0.01
        # The guess has the dose of the film, and the answer explains what it leaves out.
        np.testing.assert_allclose(inversion.source.sum(), names["doses"][layer].sum())
        missing = np.std(inversion.image - inversion.source)
        assert np.std(inversion.residual) < 0.35 * missing


def test_traced_fields_are_found_again(run: Run) -> None:
    rows = run("traced_fields")["rows"]
    limits = {"bubble": 0.05, "rod of current": 0.06, "turbulence": 0.1}
    for name, (traced, _, truth, _, error, (current, true)) in rows.items():
        assert error < limits[name]
        assert traced.thin_screen_error < 0.03
        largest = np.hypot(*truth).max()  # px
        assert largest > 1
        if name != "turbulence":
            assert current == pytest.approx(true, rel=0.03)
    # ∮ (∫B dz) · dl / µ0 of a rod, exactly, at the radius of the circle.
    radius, width = 1.2e-4, 8e-5
    depth = np.trapezoid(1 / (1 + (np.linspace(-6e-4, 6e-4, 97) / 5e-4) ** 16), dx=1.25e-5)
    exact = 2 * np.pi * radius**2 * 6 / width * np.exp(-(radius**2) / (2 * width**2)) * depth
    assert abs(rows["rod of current"][5][1]) == pytest.approx(exact / (4e-7 * np.pi), rel=0.02)


def test_every_script_is_in_the_gallery_with_its_picture() -> None:
    text = text_of("docs/gallery.md")
    assert set(re.findall(r"python examples/(\w+)\.py", text)) == set(SCRIPTS)
    for name in SCRIPTS:
        picture = ROOT / "docs" / "pictures" / f"{name}.png"
        assert f"pictures/{name}.png" in text
        assert picture.stat().st_size < 400_000
