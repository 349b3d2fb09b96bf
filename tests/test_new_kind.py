"""The kind of setup of CONTRIBUTING.md runs through the whole package, of which it changes nothing.

X-rays of 8 and 12 keV are refracted by one object: angles scale with the wavelength squared.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.command_line import done
from napari_shadowinv import InputError, fit, invert, predict_image, run_stack
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.io import read, write
from napari_shadowinv.io.pradformat import check_pradformat_setup
from napari_shadowinv.options import FitChoices, FitOptions, InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import read_recipe, run_fit, write_recipe
from napari_shadowinv.pipeline.fit_run import refinement_choices, run_refinement
from napari_shadowinv.pipeline.shot_table import ShotRow, table_rows
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot, shots_of

SHAPE = (40, 44)
RATIO = (8 / 12) ** 2
FAST = InversionOptions(n_sites=100)
HASTY = FitOptions(samples=0, max_iterations=3, spacing=0.25, threads=1)


@pytest.fixture
def setups(xray_setup: Any) -> tuple[Any, Any]:
    soft = xray_setup.example()
    return soft, soft.model_copy(update={"photon_energy": 12.0})


@pytest.fixture(scope="module")
def images() -> list[FloatArray]:
    truth = gaussian_blob(SHAPE, 12.0, 6.0).displacement
    noise = np.random.default_rng(0).normal(0, 0.02, (2, *SHAPE))
    return [synthetic_image(s * truth) + n for s, n in zip((1.0, RATIO), noise, strict=True)]


@pytest.fixture
def table(setups: Any, images: list[FloatArray], tmp_path: Path, monkeypatch: Any) -> Path:
    """Both images, their table, and their setup with the energy of a photon in another unit."""
    monkeypatch.chdir(tmp_path)
    for k, image in enumerate(images):
        np.save(f"shot{k}.npy", image)
    Path("xray.toml").write_text(
        'kind = "x-ray"\nphoton_energy = "8000 eV"\nsource_object_distance = 0.1\n'
        'object_image_distance = "100 cm"\npixel_size = "1 µm"\n',
        encoding="utf-8",
    )
    path = Path("shots.csv")
    path.write_text("file, photon_energy\nshot0.npy, 8\nshot1.npy, 12\n")
    return path


def test_recipe_keeps_a_new_kind(setups, tmp_path):
    path = tmp_path / "recipe.toml"
    write_recipe(path, Recipe(setup=setups[1]))
    assert read_recipe(path).setup == setups[1]
    path.write_text('[setup]\nkind = "x-ray"\nphoton_energy = -1\n')
    with pytest.raises(InputError, match=r"'setup\.photon_energy' is -1: photon energy \(keV\)"):
        read_recipe(path)


def test_inversion_of_a_new_kind_has_its_fields(setups, images, tmp_path):
    inversion = invert(images[0], options=FAST)
    path = tmp_path / "shot.shadowinv"
    write(path, inversion, setup=setups[0])
    dataset: Any = read(path)
    density = setups[0].areal_electron_density(inversion.potential)
    np.testing.assert_allclose(dataset["areal_electron_density"], density, rtol=1e-6)
    assert dataset["areal_electron_density"].attrs["units"] == "m⁻²"
    assert "X-rays of 8 keV" in done("info", path)
    with pytest.raises(InputError, match="received kind 'x-ray'"):
        check_pradformat_setup(setups[0])


def test_projection_scales_with_the_wavelength_squared(setups):
    displacement = gaussian_blob(SHAPE, 12.0, 6.0).displacement
    image = predict_image(displacement, *setups, deflector="electron density")
    np.testing.assert_allclose(image, synthetic_image(RATIO * displacement))
    with pytest.raises(InputError, match="expected 'electron density'"):
        predict_image(displacement, *setups, deflector="magnetic field")


def test_refinement_fits_the_field_of_a_new_kind(setups, images):
    inversion = invert(images[0], options=FAST)
    choices = refinement_choices(inversion, setups[0])
    assert choices.fields == ("electrons",)
    refined = run_refinement(inversion, setups[0], choices.model_copy(update={"options": HASTY}))
    assert [field.name for field in refined.fields] == ["electrons"]


def test_fit_scales_images_by_a_new_kind(setups, images, tmp_path):
    shots = [Shot(image, setup=s) for image, s in zip(images, setups, strict=True)]
    recipe = Recipe(fit=FitChoices(options=HASTY))
    result = run_fit(recipe, shots)
    np.testing.assert_allclose(result.strengths, [[1.0], [RATIO]])
    with pytest.raises(InputError, match="expected 'electron density'"):
        fit(shots_of(images, setup=setups), fields=("B",), options=HASTY)
    path = tmp_path / "fit.shadowinv"
    write(path, result)
    assert "areal_electron_density" in read(path)


def test_table_gives_each_shot_the_quantity_of_a_new_kind(table, setups):
    recipe = Recipe(setup=setups[0], options=FAST)
    store = run_stack(table, "out.shadowinv.zarr", recipe=recipe, scheduler="synchronous")
    assert store["photon_energy"].values.tolist() == [8.0, 12.0]
    assert store["photon_energy"].attrs == {"units": "keV", "long_name": "Energy of the X-rays"}
    assert "energy" not in store
    done("export", "out.shadowinv.zarr", "--format", "csv", "--out", "shots_out.csv")
    with Path("shots_out.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["photon_energy (keV)"] for row in rows] == ["8.0", "12.0"]


def test_rows_know_a_new_kind(table):
    rows = table_rows(table)
    assert [row.beam for row in rows] == [{"photon_energy": 8.0}, {"photon_energy": 12.0}]
    assert rows[1].beam_text == "12 keV"


def test_table_without_a_kind_refuses_its_quantity(tmp_path):
    with pytest.raises(InputError, match="unknown key 'photon_energy'"):
        ShotRow(file="shot.npy", photon_energy=8.0)
    path = tmp_path / "shots.csv"
    path.write_text("file, photon_energy\nshot.npy, 8\n")
    with pytest.raises(InputError, match="has a column 'photon_energy'"):
        table_rows(path)
