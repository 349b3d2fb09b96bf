"""One experiment by each face: Python, a command, a stack and a file give one result."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import imageio.v3 as iio
import numpy as np
import pytest
import tifffile

from helpers.command_line import done
from helpers.results import provenance_in
from napari_shadowinv import InputError, InversionOptions, ProtonSetup, read, run, write
from napari_shadowinv.io.files import sha256
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import rerun
from napari_shadowinv.pipeline.files import command_of
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    Bin,
    Crop,
    HotPixelFilter,
    LowPassFilter,
    MeasuredSource,
    PolynomialEstimate,
    Recipe,
)

pytestmark = pytest.mark.usefixtures("blank_pages")

SHAPE = (24, 32)
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
)
FEW = InversionOptions(n_sites=100)
FREE = InversionOptions(n_sites=100, boundary="free", margin=5, flux="known", seed=4)


class Case(NamedTuple):
    """A recipe for Python, what a command needs for the same, and words that describe it.

    The first are also in the description of a store.
    """

    recipe: dict[str, Any]
    flags: str
    words: tuple[str, ...] = ()
    image: str = "shot.npy"


CASES = {
    # A flag wins over the recipe, and a key over both.
    "files": Case(
        {
            "source": MeasuredSource(file=Path("beam.tif")),
            "setup": SETUP,
            "options": InversionOptions(n_sites=200, tolerance=0.01, accuracy=0.2),
        },
        "--source beam.tif --setup setup.toml --recipe r.toml --set=options.n_sites=200"
        " --accuracy 0.1 --set=options.accuracy=0.2",
    ),
    # By the place of each in the order of all, not by that of their flags.
    "steps": Case(
        {
            "steps": (
                *(HotPixelFilter(threshold=6), Bin(factor=2)),
                *(BackgroundFilter(degree=1), LowPassFilter(width=1.5)),
            ),
            "options": FEW,
        },
        "--step='low-pass 1.5' --step='background degree=1' --step='hot-pixels 6' --bin 2",
        ("low-pass (smooth), width 1.5", "1 hot and 0 dead pixels replaced"),
    ),
    "masks and an estimate": Case(
        {
            "steps": (Crop(x=(2, None)), Bin(factor=2)),
            "source": PolynomialEstimate(degree=1),
            "mask": Path("usable.png"),
            "source_mask": Path("bare.png"),
            "setup": SETUP,
            "options": FEW,
        },
        "--mask usable.png --set=source_mask=bare.png --setup setup.toml --bin 2"
        " --step='crop x=2:' --source-from 'polynomial degree=1'",
        (f"source {PolynomialEstimate(degree=1).summary}", "beam assumed"),
    ),
    "arrays of HDF5": Case(
        {"source": MeasuredSource(file=Path("run.h5::day/beam")), "options": FREE},
        "--source run.h5::day/beam --boundary free --set=options.margin=5"
        " --set=options.flux=known --set=options.seed=4",
        ("seed = 4", "n_sites = 100"),
        image="run.h5::day/shot",
    ),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with an image of a broken pixel, whose beam is not even, and files."""
    monkeypatch.chdir(tmp_path)
    beam = np.tile(np.linspace(90, 110, SHAPE[1]), (SHAPE[0], 1))
    image = synthetic_image(gaussian_blob(SHAPE, 6.0, 4.0, (10, 18)).displacement, beam)
    image += np.random.default_rng(0).normal(size=SHAPE)
    image[7, 9] = 400
    np.save("shot.npy", image)
    tifffile.imwrite("beam.tif", beam.astype(np.float32))
    with h5py.File("run.h5", "w") as file:
        file["day/shot"], file["day/beam"] = image, beam
    usable, bare = np.ones((2, *SHAPE), np.uint8)
    usable[3, 4:6], bare[4:17, 8:28] = 0, 0
    iio.imwrite("usable.png", usable)
    iio.imwrite("bare.png", bare)
    lengths = SETUP.model_dump(exclude_none=True).items()
    text = "\n".join(f"{name} = {value!r}" for name, value in lengths).replace("'", '"')
    Path("setup.toml").write_text(text)
    Path("r.toml").write_text("[options]\ntolerance = 0.01\nn_sites = 50\n")
    return tmp_path


def assert_same(result: Any, expected: Any) -> None:
    assert set(result.data_vars) == set(expected.data_vars)
    for name in expected.data_vars:
        np.testing.assert_array_equal(result[name], expected[name], err_msg=str(name))


@pytest.mark.parametrize("name", CASES)
def test_a_command_and_a_stack_give_the_result_of_python(folder: Path, name: str) -> None:
    case = CASES[name]
    sites = f"--set=options.n_sites={case.recipe['options'].n_sites}"
    flags = ["--quiet", sites, *shlex.split(case.flags)]
    expected = run(Recipe(**case.recipe), case.image)
    dataset, provenance = expected.to_dataset(), expected.provenance

    assert (
        done("invert", case.image, *flags, "--out", "a.shadowinv", "--save-recipe", "s.toml") == ""
    )
    assert_same(read("a.shadowinv"), dataset)
    assert provenance_in("a.shadowinv") == provenance
    (file, _, _), digest = case.image.partition("::"), provenance.image.sha256
    assert (provenance.image.file, digest, provenance.image.shape) == (file, sha256(file), SHAPE)
    of_image = {"source", "mask", "source_mask"}
    chosen = Recipe(**case.recipe).model_dump(exclude=of_image)
    assert provenance.recipe.model_dump(exclude=of_image) == chosen
    described = done("info", "a.shadowinv")
    assert [words for words in case.words if words not in described] == []

    command, _, *words = shlex.split(command_of(Recipe(**case.recipe), case.image))
    assert command == "shadowinv"
    done("invert", *words, "--out", "d.shadowinv")
    assert_same(read("d.shadowinv"), dataset)
    assert provenance_in("d.shadowinv").model_dump(exclude={"recipe"}) == provenance.model_dump(
        exclude={"recipe"}
    )
    assert provenance_in("d.shadowinv").recipe.model_dump(exclude=of_image) == chosen

    # By its saved recipe, in which a flag overrides what it names, and by its result.
    again = ("--recipe", "s.toml", "--out", "b.shadowinv")
    done("invert", case.image, *again)
    assert_same(read("b.shadowinv"), dataset)
    assert provenance_in("b.shadowinv") == provenance
    done("invert", case.image, *again, "--bin", 3, "--overwrite")
    binned = [step for step in provenance_in("b.shadowinv").recipe.steps if isinstance(step, Bin)]
    assert binned == [Bin(factor=3)]
    repeated = rerun("a.shadowinv")
    assert (repeated.is_identical, repeated.changes) == (True, ())

    done("batch", case.image, *flags, "--out", "c.shadowinv.zarr", "--scheduler", "threads")
    store = read("c.shadowinv.zarr")
    for variable in ("potential", "displacement"):
        stored = dataset[variable].astype(np.float32)
        np.testing.assert_allclose(store[variable][0], stored, rtol=1e-6, atol=1e-6)
    assert provenance_in(store).recipe == provenance.recipe
    described = done("info", "c.shadowinv.zarr")
    assert all(words in described for words in case.words[:1])


def test_masks_of_a_result_are_those_of_its_run_and_damage_is_noticed(folder: Path) -> None:
    """Whatever the files say later."""
    recipe = Recipe(**CASES["masks and an estimate"].recipe)
    result = run(recipe, "shot.npy")
    write("a.shadowinv", result)
    used = iio.imread("usable.png")[:, 2:].reshape(12, 2, 15, 2).all(axis=(1, 3))
    np.testing.assert_array_equal(result.mask, used)
    assert result.provenance.setup.object_pixel_size == 2 * SETUP.object_pixel_size
    assert result.provenance.image.notes[-1] == "binned 2 × 2"
    saved = read("a.shadowinv")
    for origin, name in zip(provenance_in(saved).masks, ("usable.png", "bare.png"), strict=True):
        assert (origin.file, origin.sha256) == (name, sha256(name))
        np.testing.assert_array_equal(origin.mask(), iio.imread(name) > 0)
        Path(name).unlink()
    assert rerun("a.shadowinv").is_identical
    name = "input_mask_0"
    wrong = provenance_in(saved).model_dump(mode="json")
    wrong["masks"][0]["checksum"] = "nonsense"
    for bad in (
        saved.assign_attrs(provenance=json.dumps(wrong)),
        saved.drop_vars(name),
        saved.assign({name: ~saved[name]}),
        saved.drop_vars(name).assign({name: ("name", ["nonsense"])}),
    ):
        with pytest.raises(InputError, match="the mask stored in the result is damaged"):
            rerun(bad)
