"""Stores exported for other programs: openPMD."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.command_line import flat, shadowinv
from napari_shadowinv import ProtonSetup, read

SETUP = ProtonSetup(
    energy=14.7, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
)


@pytest.fixture(scope="module")
def store(tmp_path_factory, any_night) -> Path:
    path = tmp_path_factory.mktemp("export") / "night.shadowinv.zarr"
    any_night.run(path, shots=any_night.images[:3], setup=SETUP, scheduler="synchronous")
    return path


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_openpmd_has_a_file_for_each_shot_in_si_units(store):
    result = shadowinv("export", store, "--format", "openpmd", "--shots", "0,2", "--out", "day")
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in Path("day").iterdir()) == ["day_000000.h5", "day_000002.h5"]
    stored = read(store)
    with h5py.File("day/day_000002.h5") as file:
        assert file.attrs["openPMD"] == b"1.1.0"
        assert file.attrs["iterationFormat"] == b"day_%06T.h5"
        meshes = file["data/2/meshes"]
        fields = {field.name for field in SETUP.si_fields}
        assert set(meshes) == fields & set(map(str, stored.data_vars))
        field = meshes["path_integrated_b"]
        for component in ("y", "x"):
            expected = stored.path_integrated_b.sel(component=component)[2]
            np.testing.assert_array_equal(field[component], expected)
            assert field[component].attrs["unitSI"] == 1
        np.testing.assert_array_equal(field.attrs["unitDimension"], [1, 1, -2, -1, 0, 0, 0])
        np.testing.assert_array_equal(field.attrs["gridSpacing"], [SETUP.object_pixel_size] * 2)
        assert list(field.attrs["axisLabels"]) == [b"y", b"x"]
    image = read("day/day_000002.h5::/data/2/meshes/potential_si").image
    np.testing.assert_array_equal(image, stored.potential_si[2])


def test_openpmd_needs_a_setup(any_night, tmp_path):
    path = tmp_path / "pixels.shadowinv.zarr"
    any_night.run(path, shots=any_night.images[:1], scheduler="synchronous")
    result = shadowinv("export", path, "--format", "openpmd", "--out", "day")
    assert result.exit_code == 2
    assert "openPMD holds fields in SI units, received no setup" in flat(result.output)
    assert not Path("day").exists()
