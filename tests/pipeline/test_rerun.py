"""Results of every kind are repeated from their files, bit for bit."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import chdir
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from helpers.fit_images import without_causes
from napari_shadowinv import FitOptions, InputError, InversionOptions, ProtonSetup, rerun, run_stack
from napari_shadowinv.errors import FileFormatError, InversionCancelled
from napari_shadowinv.film_doses import FilmDoses
from napari_shadowinv.io import read_dataset, write
from napari_shadowinv.io.store import read_stack
from napari_shadowinv.options import FitChoices
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import (
    read_pack,
    run,
    run_film,
    run_fit,
    write_layers,
)
from napari_shadowinv.pipeline.fit_run import read_row_images, refinement_choices, run_refinement
from napari_shadowinv.pipeline.rerun import provenance_of
from napari_shadowinv.pipeline.shot_table import shot_rows
from napari_shadowinv.preprocessing import Crop, Dark, LowPassFilter, PolynomialEstimate, Recipe
from napari_shadowinv.provenance import Provenance
from napari_shadowinv.shot import Shot
from simulated_pack import simulate

SHAPE = (40, 48)
LENGTHS = {"source_object_distance": 0.01, "object_image_distance": 0.3, "pixel_size": 1e-5}
SETUPS = [ProtonSetup(energy=energy, **LENGTHS) for energy in (8, 12, 20)]
HASTY = FitOptions(samples=2, max_iterations=3, spacing=0.5)
PLAIN = FitOptions(samples=0, max_iterations=1, spacing=0.5, smoothness=10.0)
STEPS = (Dark(level=Path("dark.npy")), Crop(y=(1, 39)))
NOISE = 100.0  # so much that a few steps explain the images, and no cause of a misfit is sought
FIT = Recipe(steps=STEPS, fit=FitChoices(noise=NOISE, options=HASTY))


@dataclass(frozen=True)
class Example:
    """A result of some kind, and one of the images that it was made from."""

    result: Any
    image: Path
    is_quick: bool = True

    @property
    def dataset(self) -> Any:
        return read_dataset(self.result) if isinstance(self.result, Path) else self.result


def record(folder: Path) -> list[Path]:
    """Write images of one object at three energies, with source, mask and dark frame."""
    rng = np.random.default_rng(1)
    field = gaussian_blob(SHAPE, 2.0, 5.0, (19, 25)).displacement
    beam = 1000 + np.arange(SHAPE[1]) + np.zeros(SHAPE)
    paths = [folder / f"{setup.energy:g}.npy" for setup in SETUPS]
    for path, setup in zip(paths, SETUPS, strict=True):
        image = synthetic_image(SETUPS[0].momentum / setup.momentum * field, beam)
        np.save(path, 7 + image + rng.normal(0, NOISE, SHAPE))
    np.save(folder / "beam.npy", 7 + beam)
    np.save(folder / "dark.npy", np.full(SHAPE, 7.0))
    tifffile.imwrite(folder / "mask.tif", (rng.random(SHAPE) > 0.02).astype(np.uint8))
    return paths


def fit_shots(paths: list[Path]) -> list[Shot]:
    source, mask = Path("beam.npy"), Path("mask.tif")
    return [
        Shot(path, setup, source=source, mask=mask)
        for path, setup in zip(paths, SETUPS, strict=False)
    ]


def inversion(folder: Path) -> Example:
    """Masks of random pixels are kept whole beside it."""
    paths = record(folder)
    mask, bare = np.random.default_rng(0).random((2, *SHAPE)) > 0.1
    bare[8:12, 8:14] = False
    options = InversionOptions(n_sites=150, boundary="free", seed=3)
    steps = (*STEPS, LowPassFilter(width=0.6))
    source = PolynomialEstimate(degree=1)
    recipe = Recipe(steps=steps, source=source, setup=SETUPS[0], options=options)
    result = run(recipe, Shot(paths[0], mask=mask, source_mask=bare))
    return Example(write(Path("a.shadowinv"), result), paths[0])


def fit(folder: Path) -> Example:
    paths = record(folder)[:2]
    first, *others = fit_shots(paths)
    shots = [replace(first, fiducials=[[5.0, 6.0, 0.1, 0.2, 0.5]]), *others]
    return Example(write(Path("a.shadowinv"), run_fit(FIT, shots)), paths[1])


def fit_of_arrays(folder: Path) -> Example:
    """With an estimated source, free brightness, masks, and more marks than fit an attribute."""
    rng, paths = np.random.default_rng(2), record(folder)[:2]
    known: dict[str, Any] = {"source": "beam.npy", "measured": False, "brightness": "free"}
    known |= {"noise": NOISE, "psf": 0.5}
    first, *others = (
        Shot(path, setup, mask=rng.random(SHAPE) > 0.1, **known)
        for path, setup in zip(paths, SETUPS, strict=False)
    )
    rows = np.column_stack([rng.uniform(0, 30, (2000, 2)), np.zeros((2000, 2)), np.full(2000, 9.0)])
    recipe = Recipe(steps=STEPS, fit=FitChoices(options=HASTY))
    result = run_fit(recipe, [replace(first, fiducials=rows), *others])
    assert result.provenance is not None
    assert result.provenance.recipe.fit.brightness == "free"
    np.testing.assert_array_equal(result.provenance.fiducial_rows, rows)
    return Example(write(Path("a.shadowinv"), result), paths[1], is_quick=False)


def refinement(folder: Path) -> Example:
    paths = record(folder)
    recipe = Recipe(steps=STEPS, setup=SETUPS[0], options=InversionOptions(n_sites=150))
    start = run(recipe, paths[0])
    choices = refinement_choices(start, start.setup, psf=0.5).model_copy(update={"options": HASTY})
    return Example(
        write(Path("a.shadowinv"), run_refinement(start, start.setup, choices)), paths[0]
    )


def film_pack(folder: Path) -> Example:
    truth = simulate(folder, layers=3, shape=(60, 80), seed=2, b_peak=0.2, e_peak=0.0, strata=4)
    doses = run_film(read_pack(truth.pack))
    return Example(write(Path("pack.shadowinv"), doses), folder / "film_02.tif")


def film_layers(folder: Path) -> Example:
    doses = FilmDoses.from_dataset(film_pack(folder).dataset)
    table = write_layers(doses, folder)[-1]
    steps = (Crop(y=(14, 46), x=(20, 60)),)
    recipe = Recipe(steps=steps, fit=FitChoices(options=PLAIN))
    _, middle, _ = shot_rows([table])
    result = run_fit(recipe, read_row_images([middle], recipe))
    return Example(write(Path("a.shadowinv"), result), folder / "layer_02.tif", is_quick=False)


def shot_of_stack(folder: Path) -> Example:
    paths = record(folder)
    options = InversionOptions(n_sites=150)
    recipe = Recipe(steps=STEPS, mask=Path("mask.tif"), setup=SETUPS[0], options=options)
    run = {"dtype": "float64"}
    run_stack(
        Shot(paths, source="beam.npy"), "a.shadowinv.zarr", recipe, scheduler="synchronous", run=run
    )
    return Example(read_stack(Path("a.shadowinv.zarr")).isel(shot=1).load(), paths[1])


KINDS = (inversion, fit, fit_of_arrays, refinement, film_pack, film_layers, shot_of_stack)


@pytest.fixture(scope="module")
def example(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Example]:
    """A result in its folder, which is the current one; a test that changes its files is last."""
    make: Callable[[Path], Example] = request.param
    with chdir(tmp_path_factory.mktemp(make.__name__)), without_causes():
        yield make(Path.cwd())


every_kind = pytest.mark.parametrize("example", KINDS, indirect=True, ids=lambda f: f.__name__)


@every_kind
def test_a_file_elsewhere_is_asked_for(example: Example) -> None:
    dataset, foreign = example.dataset, "../private/shot.npy"
    provenance = json.loads(provenance_of(dataset).to_json())
    for part in (provenance, provenance.get("start", {})):
        for image in part.get("images", []):
            image["file"] = foreign
    if "pack" in provenance:
        provenance["pack"]["layers"][0]["file"] = foreign
    dataset = dataset.drop_vars("report", errors="ignore")
    harmful = dataset.assign_attrs(provenance=json.dumps(provenance))
    with pytest.raises(InputError, match=f"names .* {foreign}, which is in another folder"):
        rerun(harmful)
    with pytest.raises(FileFormatError, match=r"shot.npy"):
        rerun(harmful, other_folders=True)


@pytest.mark.parametrize(
    "part", [{"mask": "FILE"}, {"source": {"method": "measured", "file": "FILE"}}]
)
def test_a_file_of_a_recipe_elsewhere_is_asked_for(tmp_path: Path, part: Any) -> None:
    foreign = str(tmp_path / "private.npy")
    for name in ("private", "shot"):
        np.save(tmp_path / f"{name}.npy", np.random.default_rng(0).poisson(100, (16, 16)))
    (tmp_path / "mine").mkdir()
    with chdir(tmp_path / "mine"):
        Path("shot.npy").hardlink_to(tmp_path / "shot.npy")
        dataset = run(Recipe(), "shot.npy").to_dataset()
        provenance = json.loads(dataset.attrs["provenance"])
        provenance["recipe"] |= json.loads(json.dumps(part).replace("FILE", foreign))
        with pytest.raises(InputError, match=f"{foreign}, which is in another folder"):
            rerun(dataset.assign_attrs(provenance=json.dumps(provenance)))


@every_kind
def test_a_result_is_repeated_bit_for_bit(example: Example, tmp_path: Path) -> None:
    before, provenance = example.dataset, provenance_of(example.dataset)
    stages: list[Any] = []
    again = rerun(example.result, on_progress=stages.append)
    assert again.changes == ()
    assert again.is_identical
    assert stages
    # A store has a report of each shot, too, in several columns.
    names = [name for name in before.data_vars if before[name].ndim]
    assert len(names) > 2
    for name in names:
        values = again.dataset[name].values
        if before[name].dtype.kind == "f":
            values = values.astype(before[name].dtype)
        np.testing.assert_array_equal(before[name], values, str(name))
    after = provenance_of(again.dataset)
    # A store has no notes of each shot.
    assert after == provenance or after.with_image(notes=()) == provenance
    # And once more from the file of the repeated result.
    written = write(tmp_path / "again.shadowinv", again.dataset)
    assert Provenance.of(read_dataset(written).attrs) == after

    # The image differs now.
    if example.image.suffix == ".npy":
        np.save(example.image, np.load(example.image) * np.linspace(1, 1.1, SHAPE[1]))
    else:
        pixels = tifffile.imread(example.image)
        tifffile.imwrite(example.image, pixels[::-1].copy(), resolution=(300, 300))
    name = example.image.name
    if example.is_quick:
        changed = rerun(example.result)
        assert any(f"{name} differs from the {name} used" in text for text in changed.changes)
        assert "differ" in changed.difference
    with pytest.raises(InversionCancelled):
        rerun(example.result, should_stop=lambda: True)

    # It is no longer there.
    example.image.unlink()
    with pytest.raises(FileFormatError, match=f"{name} does not exist"):
        rerun(example.result)


def test_arrays_of_one_file_are_found_again(tmp_path: Path) -> None:
    with chdir(tmp_path):
        images = np.stack([np.load(path) for path in record(tmp_path)])
        rejected = np.zeros(SHAPE, np.uint32)
        rejected[20, 10:14] = 1
        with h5py.File("run.h5", "w") as file:
            file["entry/data"], file["entry/pixel_mask"] = images, rejected
            file["beam"], file["dark"] = np.load("beam.npy"), np.load("dark.npy")
            file["usable"] = tifffile.imread("mask.tif")
        recipe = Recipe(
            steps=(Dark(level=Path("run.h5::/dark")),),
            mask=Path("run.h5::/usable"),
            setup=SETUPS[0],
            options=InversionOptions(n_sites=150),
        )
        first = run(recipe, Shot("run.h5::/entry/data[1]", source="run.h5::/beam"))
        again = rerun(write(Path("a.shadowinv"), first))
    assert not first.mask[rejected != 0].any()
    assert again.changes == ()
    assert again.is_identical


def test_what_was_no_file_is_asked_for(tmp_path: Path) -> None:
    path = record(tmp_path)[0]
    first = run(Recipe(options=InversionOptions(n_sites=150)), np.load(path))
    written = write(tmp_path / "a.shadowinv", first)
    with pytest.raises(FileFormatError, match="was not made from a file: name the file"):
        rerun(written)
    again = rerun(written, path)
    assert again.is_identical
    assert "was not a file before" in again.changes[0]
