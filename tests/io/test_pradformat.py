import dataclasses
from pathlib import Path

import h5py
import numpy as np
import pytest

from helpers.public_data import public_file
from napari_shadowinv.errors import FileFormatError
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io import read, read_shot, write
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.provenance import ImageOrigin, Provenance

IMAGE = np.arange(20.0).reshape(4, 5)
ATTRIBUTES = {
    "object_type": "radiograph",
    "radiograph_type": "simple",
    "pradformat_version": "0.2.0",
    "scale_factor": 1.0,
    "pixel_width": 3.1e-4,
    "source_object_dist": 0.01,
    "object_image_dist": 0.3,
    "spec_name": "p+",
    "spec_energy": 14.7e6,
}


def radiograph_file(path: Path, **changes: object) -> Path:
    with h5py.File(path, "w") as file:
        file["image"] = IMAGE
        for name, value in {**ATTRIBUTES, **changes}.items():
            if value is not None:
                file.attrs[name] = value
    return path


def test_complete_radiograph_brings_its_setup(tmp_path: Path) -> None:
    radiograph = read_shot(radiograph_file(tmp_path / "shot.h5"))
    np.testing.assert_array_equal(radiograph.image, IMAGE)
    assert radiograph.setup == ProtonSetup(
        energy=14.7,
        species="proton",
        source_object_distance=0.01,
        object_image_distance=0.3,
        detector_pixel_size=3.1e-4,
    )
    assert radiograph.setup.object_pixel_size == pytest.approx(1e-5)


@pytest.mark.parametrize(
    "changes", [{"spec_energy": None}, {"spec_name": "Au 79+"}, {"source_object_dist": None}]
)
def test_an_incomplete_radiograph_keeps_its_geometry(
    tmp_path: Path, changes: dict[str, object]
) -> None:
    radiograph = read_shot(radiograph_file(tmp_path / "shot.h5", **changes))
    assert radiograph.setup is None
    assert radiograph.metadata["geometry"]["detector_pixel_size"] == 3.1e-4
    assert radiograph.metadata["geometry"]["object_image_distance"] == 0.3


@pytest.mark.parametrize(
    ("name", "side", "width", "mean"),
    [
        ("gaussian_charge_blob_mu_0p5_veryhighres_lowres.h5", 50, 1.2e-3, 54),
        ("gaussian_charge_cylinder_mu_0p5_highres.h5", 150, 0.5333e-3, 10.6),
    ],
)
def test_published_examples(name: str, side: int, width: float, mean: float) -> None:
    radiograph = read_shot(public_file(f"pradformat/{name}"))
    geometry = radiograph.metadata["geometry"]
    assert radiograph.image.shape == (side, side)
    assert radiograph.image.mean() == pytest.approx(mean, rel=0.01)
    assert geometry["detector_pixel_size"] == pytest.approx(width, rel=1e-3)
    assert geometry["source_object_distance"] == 0.01
    assert geometry["object_image_distance"] == 0.3
    # The files do not tell the energy, so they tell no field either.
    assert radiograph.setup is None


def written(path: Path, inversion: Inversion, setup: ProtonSetup) -> Path:
    provenance = Provenance(kind="inversion", images=(ImageOrigin(file="shot.tif"),))
    return write(path, dataclasses.replace(inversion, provenance=provenance), setup=setup)


def test_inversion_follows_the_format(
    tmp_path: Path, inversion: Inversion, proton_setup: ProtonSetup
) -> None:
    path = written(tmp_path / "shot.h5", inversion, proton_setup)
    with h5py.File(path) as file:
        attributes = dict(file.attrs)
        phi, first, second = (file[name][()] for name in ("phi", "defl_ax1", "defl_ax2"))
    assert attributes["object_type"] == "inversion"
    assert attributes["inversion_type"] == "simple"
    assert attributes["dr"] == 1.5e-6
    assert attributes["spec_name"] == "p+"
    assert attributes["spec_energy"] == 14.7e6
    assert attributes["spec_mass"] == pytest.approx(1.67262e-27, rel=1e-5)
    assert attributes["spec_charge"] == pytest.approx(1.602177e-19, rel=1e-6)
    assert attributes["source_object_dist"] == 1.3e-3
    assert attributes["object_image_dist"] == 2e-2
    assert attributes["radiograph_filename"] == "shot.tif"
    assert Provenance.of(attributes).image.file == "shot.tif"
    # In this format the angle is the gradient of phi, without a minus.
    slopes = np.gradient(phi, attributes["dr"])
    for slope, angle in zip(slopes, (first, second), strict=True):
        middle = (slice(2, -2), slice(2, -2))
        np.testing.assert_allclose(slope[middle], angle[middle], atol=0.1 * np.abs(angle).max())


def test_an_inversion_is_not_read_back(
    tmp_path: Path, inversion: Inversion, proton_setup: ProtonSetup
) -> None:
    path = written(tmp_path / "shot.h5", inversion, proton_setup)
    with pytest.raises(FileFormatError, match=r"only written here.*\.shadowinv"):
        read(path)
