"""Tables of shots that are inverted: each with its own energy, brightness, mask and source."""

from __future__ import annotations

import csv
import pickle
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile
import tomli_w

from helpers.command_line import done, shadowinv
from helpers.night import grouped
from napari_shadowinv import (
    InputError,
    InversionOptions,
    Recipe,
    invert,
    run,
    run_stack,
    synthetic_image,
)
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.store import DONE, FAILED, StackStore, read_stack
from napari_shadowinv.physics.beam import BeamSetup
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.pipeline import RunOptions
from napari_shadowinv.pipeline.rerun import rerun
from napari_shadowinv.pipeline.shot_table import ShotRow, shot_rows
from napari_shadowinv.preprocessing import Bin, PolynomialEstimate
from napari_shadowinv.provenance import Provenance
from napari_shadowinv.shot import Shot
from napari_shadowinv.stack._plan import describe_stack
from napari_shadowinv.stack._shots import FILES

SHAPE = (64, 64)
SETUP = ProtonSetup(
    energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
)
ENERGIES = (5.0, 14.7, 30.0)
ROWS = [f"film{k}.npy,{energy}" for k, energy in enumerate(ENERGIES)]
PEAK, SIGMA = 25.0, 100e-6  # MG µm and m
OPTIONS = InversionOptions(tolerance=1e-3)


def at(energy: float) -> ProtonSetup:
    return SETUP.model_copy(update={"energy": energy})


def beam() -> Any:
    """A beam that is brighter on one side."""
    return 1 + 0.3 * np.indices(SHAPE)[1] / SHAPE[1]


def written_setup(path: str, setup: BeamSetup) -> None:
    Path(path).write_text(tomli_w.dumps(setup.model_dump(exclude_none=True)))


def table(*rows: str, header: str = "file,energy", name: str = "pack.csv") -> Path:
    Path(name).write_text("\n".join([header, *rows]))
    return Path(name)


@pytest.fixture
def pack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: None) -> Path:
    """One toroid on three films, a table of them, and the setup."""
    monkeypatch.chdir(tmp_path)
    for number, energy in enumerate(ENERGIES):
        displacement = toroid(SHAPE, at(energy), PEAK, SIGMA).displacement
        np.save(f"film{number}.npy", synthetic_image(displacement, beam()))
    np.save("beam.npy", beam())
    written_setup("setup.toml", SETUP)
    return table(*ROWS)


def inverted(shots: Any, out: Path, **more: Any) -> Any:
    """The store of a table, made in this process."""
    arguments = {"setup": SETUP, "options": OPTIONS, "source": "beam.npy"} | more
    arguments["dtype"] = "float64"
    shots, choices = grouped(shots, arguments)
    return run_stack(shots, out, **{"scheduler": "synchronous", **choices})


def test_one_field_at_three_energies_is_one_field_in_si(pack: Path, out: Path) -> None:
    store = inverted(pack, out)
    assert store["energy"].values.tolist() == list(ENERGIES)
    assert store["energy"].attrs["units"] == "MeV"
    field = store["path_integrated_b"].values
    phantom = toroid(SHAPE, SETUP, PEAK, SIGMA)
    true = SETUP.path_integrated_b(phantom.displacement)
    strongest = np.hypot(*true).max()
    for shot_field in field:
        assert np.hypot(*(shot_field - true)).max() < 0.03 * strongest
    # In px they are as different as the momenta.
    peaks = np.hypot(*store["displacement"].values.swapaxes(0, 1)).max(axis=(1, 2))
    assert peaks[0] / peaks[2] == pytest.approx(at(30.0).momentum / at(5.0).momentum, rel=0.03)
    assert [setup_from_dataset(store.isel(shot=k)) for k in range(3)] == list(map(at, ENERGIES))


def test_a_row_is_inverted_as_alone(pack: Path, out: Path) -> None:
    usable = np.random.default_rng(4).random(SHAPE) > 0.02
    np.save("mask.npy", usable.astype(np.uint8))
    np.save("other.npy", beam()[:, ::-1])
    header = "file,energy,brightness,mask,source"
    rows = ("film0.npy,5,1.25,mask.npy,", "film1.npy,,,,other.npy")
    free = InversionOptions(tolerance=1e-3, boundary="free", flux="known")
    recipe = Recipe(steps=(Bin(factor=2),), setup=SETUP, options=free)
    pack = table(*rows, header=header)
    store = run_stack(Shot(pack, source=beam()), out, recipe, run=RunOptions(dtype="float64"))
    alone = run(
        recipe.model_copy(update={"setup": at(5.0)}),
        Shot(np.load("film0.npy") / 1.25, source=beam(), mask=usable),
    )
    second = run(recipe, Shot("film1.npy", source="other.npy"))
    for k, expected in enumerate((alone, second)):
        np.testing.assert_array_equal(store["displacement"][k], expected.displacement)
        in_si = expected.to_dataset()["path_integrated_b"]
        np.testing.assert_allclose(store["path_integrated_b"][k], in_si, rtol=1e-12)
        provenance = Provenance.of(StackStore(out).report(k))
        assert provenance.setup == expected.setup
        assert provenance.recipe.setup == at((5.0, 14.7)[k])
        assert provenance.image.file == f"film{k}.npy"
    assert provenance.image.source.file == "other.npy"
    first = StackStore(out).report(0)["provenance"]
    assert first["images"][0]["brightness"] == 1.25
    assert first["masks"][0]["file"] == "mask.npy"
    Path("mask.npy").unlink()
    shot = read_stack(out).isel(shot=0)
    np.testing.assert_array_equal(shot["input_mask_0"], usable)
    assert rerun(shot, source="beam.npy").is_identical


def test_images_of_uniform_beams_are_relative_to_their_mean(pack: Path, out: Path) -> None:
    usable = np.ones(SHAPE)
    usable[:4] = 0
    np.save("mask.npy", usable)
    pack = table("film0.npy,", "film1.npy,mask.npy", header="file,mask")
    store = inverted(pack, out, source=None, setup=None, variables=("image", "displacement"))
    files = run_stack(
        ["film0.npy"],
        out.with_name("f.shadowinv.zarr"),
        Recipe(options=OPTIONS),
        run=RunOptions(variables=("image",)),
    )
    np.testing.assert_allclose(store["image"][0], files["image"][0], rtol=1e-6)
    assert float(store["image"][1].values[4:].mean()) == pytest.approx(1, rel=1e-9)
    assert "setup" not in store
    alone = invert(np.load("film1.npy"), mask=usable > 0, options=OPTIONS)
    np.testing.assert_allclose(store["displacement"][1], alone.displacement, atol=1e-9)


def test_the_source_of_rows_without_one_may_be_estimated(pack: Path, out: Path) -> None:
    estimate = PolynomialEstimate(degree=1)
    store = inverted(pack, out, source=estimate, variables=("source",))
    alone = run(Recipe(source=estimate, setup=SETUP, options=OPTIONS), "film1.npy")
    np.testing.assert_array_equal(store["source"][1], alone.source)


def test_what_changed_in_a_table_is_noticed(pack: Path, out: Path) -> None:
    inverted(pack, out)
    table("film0.npy,5", "film1.npy,14.7", "film2.npy,31")
    with pytest.raises(InputError, match=r"shot 2 \(film2.npy\) has changed since .* row"):
        inverted(pack, out)
    table(*ROWS)
    nearer = SETUP.model_copy(update={"object_image_distance": 0.2})
    with pytest.raises(InputError, match=r"shot 0 \(film0.npy\) .* or its setup"):
        inverted(pack, out, setup=nearer)
    with pytest.raises(InputError, match="different table of shots"):
        inverted([f"film{k}.npy" for k in range(3)], out)
    np.save("film1.npy", beam())
    with pytest.raises(InputError, match=r"shot 1 \(film1.npy\) has changed"):
        inverted(pack, out)


def test_a_table_grows_and_a_row_is_mended(pack: Path, out: Path) -> None:
    table("film0.npy,5")
    inverted(pack, out)
    np.save("mask.npy", np.ones((8, 8)))
    table("film0.npy,5,", "film1.npy,7,mask.npy", header="file,energy,mask")
    assert inverted(pack, out)["status"].values.tolist() == [DONE, FAILED]
    np.save("usable.npy", np.ones(SHAPE))
    table("film0.npy,5,", "film1.npy,14.7,usable.npy", header="file,energy,mask")
    store = inverted(pack, out, redo_failed=True)
    assert store["status"].values.tolist() == [DONE, DONE]
    assert setup_from_dataset(store.isel(shot=1)) == at(14.7)
    assert store["energy"].values.tolist() == [5.0, 14.7]


def test_excluded_rows_are_left_out_by_stacks_and_fits(pack: Path, out: Path) -> None:
    rows = ("film0.npy,5,", "gone.npy,9,yes", "film1.npy,14.7,no", "film2.npy,30,1")
    store = inverted(table(*rows, header="file,energy,exclude"), out)
    assert store["name"].values.tolist() == ["film0.npy", "film1.npy"]
    assert store["energy"].values.tolist() == [5.0, 14.7]
    rows = ("film1.npy,14.7,", "gone.npy,9,true", "film2.npy,30,", "film0.npy,5,yes")
    pack = table(*rows, header="file,energy,exclude")
    assert [row.file.name for row in shot_rows([pack])] == ["film1.npy", "film2.npy"]


def test_columns_for_fits_give_a_warning(pack: Path, out: Path) -> None:
    pack = table("film1.npy,14.7,1,poisson", header="file,energy,psf,noise")
    inverted(pack, out)
    (warning,) = StackStore(out).report(0)["warnings"]
    assert warning["text"] == (
        "the row has psf, noise, which only fits use: fit the image to use it"
    )


def test_one_shot_fails_where_its_files_do(pack: Path, out: Path) -> None:
    np.save("small.npy", np.ones((8, 9)))
    np.save("mask.npy", np.ones((8, 8)))
    rows = ("film0.npy,5,", "small.npy,5,", "film1.npy,14.7,mask.npy", "gone.npy,5,")
    pack = table(*rows, "film2.npy,30,no_mask.npy", header="file,energy,mask")
    store = inverted(pack, out)
    assert store["status"].values.tolist() == [DONE, FAILED, FAILED, FAILED, FAILED]
    reasons = [report.get("reason", "") for report in StackStore(out).reports()]
    assert "image has shape (8, 9), expected (64, 64)" in reasons[1]
    assert "mask.npy: mask has shape (8, 8), image (64, 64): they must match" in reasons[2]
    assert "gone.npy" in reasons[3]
    assert "no_mask.npy" in reasons[4]
    assert np.isnan(store["path_integrated_b"][1]).all()


def test_a_store_has_the_units_of_one_kind_of_beam(pack: Path, out: Path) -> None:
    light = OpticalSetup(wavelength=810e-9, object_image_distance=0.01, pixel_size=1e-6)
    written_setup("light.toml", light)
    pack = table("film1.npy,setup.toml", "film2.npy,light.toml", header="file,setup")
    store = inverted(pack, out, setup=None)
    assert store["status"].values.tolist() == [DONE, FAILED]
    reason = StackStore(out).report(1)["reason"]
    assert reason.startswith("it has a setup of kind 'optical', and the first row of its table")


def test_the_command_inverts_a_table(pack: Path, out: Path) -> None:
    flags = ("--setup", "setup.toml", "--source", "beam.npy", "--set=options.tolerance=1e-3")
    arguments = ("batch", "pack.csv", *flags, "--out", out, "--scheduler", "threads")
    done(*arguments, "--quiet")
    done("export", out, "--format", "pradformat", "--out", "h5")
    for index, energy in enumerate(ENERGIES):
        with h5py.File(f"h5/{index:04d}_film{index}.h5") as file:
            assert file.attrs["spec_energy"] == pytest.approx(1e6 * energy)
            provenance = Provenance.of(file.attrs)
        assert provenance.image.file == f"film{index}.npy"
        assert provenance.recipe.setup == at(energy)
    done("export", out, "--format", "csv", "--out", "t.csv")
    with Path("t.csv").open(encoding="utf-8") as file:
        assert [float(row["energy (MeV)"]) for row in csv.DictReader(file)] == list(ENERGIES)
    assert "nothing to do" in shadowinv(*arguments, "--resume").stdout


def test_films_at_their_own_distance_have_pixels_of_their_own(pack: Path, out: Path) -> None:
    far = SETUP.model_copy(update={"object_image_distance": 0.6})
    written_setup("far.toml", far)
    pack = table("film1.npy,14.7,", "film2.npy,30,far.toml", header="file,energy,setup")
    inverted(pack, out)
    done("export", out, "--format", "tiff", "--out", "tiff", "--variables", "potential")
    sizes = []
    for path in sorted(Path("tiff").iterdir()):
        with tifffile.TiffFile(path) as file:
            number, per = file.pages[0].tags["XResolution"].value
            sizes.append(per / number)
    ratio = SETUP.object_pixel_size / far.object_pixel_size
    assert sizes[0] / sizes[1] == pytest.approx(ratio, rel=1e-3)
    done("movie", out, "-o", "movie.gif")


def test_rows_may_be_given_in_python(pack: Path, out: Path) -> None:
    rows = [ShotRow(file=Path("film1.npy")), ShotRow(file=Path("film2.npy"), energy=30.0)]
    store = inverted([*rows, ShotRow(file=Path("gone.npy"), exclude=True)], out)
    assert store["energy"].values.tolist() == [14.7, 30.0]


class Elsewhere(ThreadPoolExecutor):
    """Workers that receive and return what a process would: pickled bytes."""

    def submit(self, function: Any, /, *args: Any, **keywords: Any) -> Any:
        work = pickle.dumps(partial(function, *args, **keywords))
        return super().submit(lambda: pickle.loads(pickle.dumps(pickle.loads(work)())))


def test_worker_processes_receive_all_of_a_row(pack: Path, out: Path) -> None:
    np.save("mask.npy", np.ones(SHAPE))
    pack = table("film0.npy,5,mask.npy", "film2.npy,30,", header="file,energy,mask")
    here = inverted(pack, out, source=beam())
    with Elsewhere(1) as pool:
        there = inverted(pack, out.with_name("b.shadowinv.zarr"), source=beam(), scheduler=pool)
    assert there["status"].values.tolist() == [DONE, DONE]
    for name in ("displacement", "path_integrated_b"):
        np.testing.assert_array_equal(there[name], here[name])


def test_masks_of_a_shot_and_of_all_hold_both_but_for_a_file() -> None:
    """The rule of a shot and its recipe."""
    common, own = np.ones((2, *SHAPE), bool), np.ones((2, *SHAPE), bool)
    common[0, :3], common[1, 20:40, 20:40], own[:, :, :5] = False, False, False
    recipe = Recipe(options=OPTIONS, source=PolynomialEstimate())
    images = np.ones((3, *SHAPE))
    shots = Shot(images, mask=common[0], source_mask=common[1])
    task = describe_stack(shots, recipe, FILES, RunOptions()).task
    joined = task.completed(Shot(images[0], mask=own[0], source_mask=own[1]))
    np.testing.assert_array_equal(joined.mask, common[0] & own[0])
    np.testing.assert_array_equal(joined.source_mask, common[1] & own[1])
    of_file = task.completed(Shot(images[0], mask=Path("mask.png")))
    assert of_file.mask == Path("mask.png")
    np.testing.assert_array_equal(of_file.source_mask, common[1])
