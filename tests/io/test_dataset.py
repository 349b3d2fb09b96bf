import dataclasses
import hashlib
import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from napari_shadowinv.errors import FileFormatError, InputError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.inversion.variables import VARIABLES, setup_from_dataset
from napari_shadowinv.io import read, write
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import OpticalSetup, ProtonSetup
from napari_shadowinv.pipeline import run
from napari_shadowinv.preprocessing import Crop, LowPassFilter, MeasuredSource, Recipe
from napari_shadowinv.provenance import Provenance
from napari_shadowinv.shot import Shot

SETUPS = {
    "none": None,
    "proton": ProtonSetup.example(),
    "optical": OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=1e-5 / 3),
    "collimated": ProtonSetup(
        energy=1 / 3,
        source_object_distance=np.inf,
        object_image_distance=0.1,
        detector_pixel_size=1e-5 / 3,
        species="alpha",
    ),
}


@pytest.mark.parametrize("kind", SETUPS)
def test_file_gives_back_every_bit(tmp_path: Path, inversion: Inversion, kind: str) -> None:
    potential = inversion.potential.copy()
    potential[3, 4] = np.nan
    report = dataclasses.replace(inversion.report, residual=np.inf)
    changed = dataclasses.replace(inversion, potential=potential, report=report)
    before = changed.in_units(SETUPS[kind]).to_dataset()
    dataset = read(write(tmp_path / "shot.shadowinv", changed, setup=SETUPS[kind]))
    assert isinstance(dataset, xr.Dataset)
    again = Inversion.from_dataset(dataset)
    for name in VARIABLES:
        assert again.variable(name).dtype == changed.variable(name).dtype, name
        np.testing.assert_array_equal(again.variable(name), changed.variable(name), err_msg=name)
    for name in ("report", "options", "instrument", "errors", "provenance"):
        assert getattr(again, name) == getattr(changed, name), name
    assert setup_from_dataset(dataset) == SETUPS[kind]
    xr.testing.assert_identical(dataset.drop_attrs(deep=False), before.drop_attrs(deep=False))


def test_a_result_is_read_as_xarray_reads_it(tmp_path: Path, inversion: Inversion) -> None:
    names = xr.Variable("name", np.array(["Größe", "µm", ""], dtype=object), {"why": "nötig"})
    written = inversion.to_dataset().assign_attrs(note="grün").assign(names=names)
    path = write(tmp_path / "a.shadowinv", written)
    expected = xr.load_dataset(path, engine="h5netcdf", decode_times=False)
    again = read(path)
    xr.testing.assert_identical(again, expected)
    assert list(again["names"].values) == ["Größe", "µm", ""]


def test_every_variable_has_units_and_a_name(
    inversion: Inversion, proton_setup: ProtonSetup, optical_setup: OpticalSetup
) -> None:
    for setup in (None, proton_setup, optical_setup):
        dataset = inversion.in_units(setup).to_dataset()
        for name, variable in dataset.variables.items():
            assert variable.attrs.get("units"), name
            assert variable.attrs.get("long_name"), name
    assert dict(dataset.sizes) == {"y": 24, "x": 32, "component": 2, "site": 17}
    assert dataset["displacement"].dims == ("component", "y", "x")
    assert dataset["component"].values.tolist() == ["y", "x"]


def test_si_values_of_protons_follow_from_the_setup(
    inversion: Inversion, proton_setup: ProtonSetup
) -> None:
    dataset = inversion.in_units(proton_setup).to_dataset()
    slope = 1.5e-6 * proton_setup.magnification / 2e-2
    np.testing.assert_allclose(dataset["deflection_angle"], inversion.displacement * slope)
    np.testing.assert_allclose(dataset["potential_si"], inversion.potential * slope * 1.5e-6)
    np.testing.assert_array_equal(
        dataset["path_integrated_b"], proton_setup.path_integrated_b(inversion.displacement)
    )
    np.testing.assert_array_equal(
        dataset["path_integrated_e"], proton_setup.path_integrated_e(inversion.displacement)
    )
    np.testing.assert_allclose(dataset["x"], np.arange(32) * 1.5e-6)
    assert "x_si" not in dataset
    units = {name: dataset[name].attrs["units"] for name in ("potential_si", "path_integrated_b")}
    assert units == {"potential_si": "m", "path_integrated_b": "T m"}


def test_si_values_of_light_follow_from_the_setup(
    inversion: Inversion, optical_setup: OpticalSetup
) -> None:
    dataset = inversion.in_units(optical_setup).to_dataset()
    np.testing.assert_array_equal(
        dataset["line_integrated_density"],
        optical_setup.line_integrated_density(inversion.potential),
    )
    np.testing.assert_allclose(dataset["line_integrated_log_index"], -dataset["potential_si"])
    assert "path_integrated_b" not in dataset


def test_attributes_contain_recipe_and_origins(tmp_path: Path, proton_setup: ProtonSetup) -> None:
    image = 100 * synthetic_image(gaussian_blob((24, 32), 6.0, 4.0).displacement)
    np.save(tmp_path / "shot.npy", image)
    np.save(tmp_path / "beam.npy", np.full_like(image, 100))
    dead = np.ones(image.shape, bool)
    dead[2, 3] = False
    recipe = Recipe(
        steps=(Crop(x=(2, None)), LowPassFilter(width=0.5)),
        setup=proton_setup,
        options=InversionOptions(n_sites=300),
    )
    inversion = run(recipe, Shot(tmp_path / "shot.npy", source=tmp_path / "beam.npy", mask=dead))
    dataset = inversion.to_dataset()
    provenance = Provenance.of(dataset.attrs, dataset.variables)
    assert provenance == inversion.provenance == Inversion.from_dataset(dataset).provenance
    assert provenance is not None
    assert provenance.recipe == recipe.model_copy(update={"source": MeasuredSource()})
    for origin, name in ((provenance.image, "shot.npy"), (provenance.image.source, "beam.npy")):
        assert origin is not None
        digest = hashlib.sha256((tmp_path / name).read_bytes()).hexdigest()
        assert (origin.file, origin.sha256) == (name, digest)
    (mask,) = provenance.masks
    np.testing.assert_array_equal(mask.mask(), dead)
    assert provenance.setup == proton_setup
    assert "path_integrated_b" in dataset
    assert json.loads(dataset.attrs["options"])["n_sites"] == 300
    # A text of another version, or none, is no error.
    for text in ("{}", "nonsense", '{"version": "9", "recipe": {"steps": [{"step": "dance"}]}}'):
        again = Inversion.from_dataset(dataset.assign_attrs(provenance=text))
        assert again.provenance is None


def test_dataset_of_something_else_is_refused() -> None:
    with pytest.raises(InputError, match=r"'potential'.*'options', 'instrument', 'report'"):
        Inversion.from_dataset(xr.Dataset())


@pytest.mark.parametrize(
    ("entry", "value", "reason"),
    [
        ("levels", None, r"\(levels: Field required\)"),
        ("cautions", None, r"\('cautions' is missing\)"),
        ("iterations", "many", r"\(iterations: Input should be a valid integer"),
    ],
)
def test_a_damaged_report_is_refused_by_its_entry(
    inversion: Inversion, entry: str, value: object, reason: str
) -> None:
    dataset = inversion.to_dataset()
    report = {**json.loads(dataset.attrs["report"]), entry: value}
    if value is None:
        del report[entry]
    dataset.attrs["report"] = json.dumps(report)
    with pytest.raises(InputError, match=reason):
        Inversion.from_dataset(dataset)


def test_every_dataset_of_a_result_has_fletcher32(tmp_path, inversion, proton_setup):
    path = write(tmp_path / "a.shadowinv", inversion, setup=proton_setup)
    with h5py.File(path) as file:
        numbers = {name: item for name, item in file.items() if item.dtype.kind in "fiu"}
        stored = {name: item for name, item in numbers.items() if item.chunks}
        assert {"potential", "displacement", "weights", "caustic", "y"} <= stored.keys()
        for name, item in stored.items():
            assert item.fletcher32, name
            assert item.dtype.kind != "f" or np.isnan(item.fillvalue), name


def test_flipped_bits_of_a_result_are_refused(tmp_path, inversion, proton_setup):
    path = write(tmp_path / "a.shadowinv", inversion, setup=proton_setup)
    content = path.read_bytes()
    places = np.random.default_rng(5).integers(0, 8 * len(content) - 8 * 81, 40)
    for place in [*places, 8 * content.index(b'"energy"') + 2]:
        damaged = bytearray(content)
        damaged[place // 8] ^= 1 << (place % 8)
        path.write_bytes(damaged)
        with pytest.raises(FileFormatError):
            read(path)


def test_result_changed_by_another_program_is_read(tmp_path, inversion):
    path = write(tmp_path / "a.shadowinv", inversion)
    before = read(path)
    path.write_bytes(path.read_bytes()[:-81])  # without its checksum
    assert read(path).identical(before)
    write(path, inversion, overwrite=True)
    with h5py.File(path, "r+") as file:
        file.attrs["note"] = "mine"
    assert read(path).attrs["note"] == "mine"
