"""Variables of a result given to napari as they are: napari takes scale and units from them."""

import numpy as np
import pint
import pytest
from napari.components import ViewerModel

from helpers.stacks import inverted_stack
from napari import __version__ as napari_version
from napari_shadowinv import Recipe, read, write
from napari_shadowinv.physics.setup import OpticalSetup

PIXEL_M = 2e-6
SETUP = OpticalSetup(wavelength=532e-9, object_image_distance=0.3, pixel_size=PIXEL_M)
registry = pint.get_application_registry()

reads_coordinates = pytest.mark.skipif(
    tuple(map(int, napari_version.split(".")[:2])) < (0, 9),
    reason="napari takes scale and units from coordinates since 0.9",
)


@reads_coordinates
@pytest.mark.parametrize("origin", ["memory", "file", "stack"])
def test_field_in_metres_lies_over_a_layer_of_its_pixels(origin, inversion, tmp_path):
    dataset = inversion.in_units(SETUP).to_dataset()
    path = tmp_path / "shot.shadowinv"
    if origin == "file":
        write(path, dataset)
        dataset = read(path)
    if origin == "stack":
        dataset = inverted_stack(inversion.image[None], tmp_path, Recipe(setup=SETUP)).isel(shot=0)
    viewer = ViewerModel()
    size_um = PIXEL_M * 1e6
    image = viewer.add_image(inversion.image, scale=(size_um, size_um), units=("um", "um"))
    field = viewer.add_image(dataset["potential"])
    assert [str(unit) for unit in field.units] == ["meter", "meter"]
    together = viewer.layers.extent
    assert [str(unit) for unit in together.units] in (["micrometer"] * 2, ["meter"] * 2)
    to_um = (1 * together.units[-1]).to("um").magnitude
    np.testing.assert_allclose(to_um * together.world, image.extent.world, rtol=1e-9)
    np.testing.assert_allclose(1e6 * field.extent.world, image.extent.world, rtol=1e-9)


def test_units_of_a_result_are_parsed_by_pint_as_meant(inversion):
    dataset = inversion.in_units(SETUP).to_dataset()
    units = {name: registry.Unit(dataset[name].attrs["units"]) for name in dataset.variables}
    pixel = registry.Unit("pixel")
    assert units["potential"] == pixel**2
    assert units["displacement"] == pixel
    assert units["image"] == registry.Unit("1/pixel**2")
    assert units["y"] == registry.Unit("m")
    assert units["line_integrated_density"].dimensionality == {"[length]": -2}
    allowed = {"[printing_unit]", "[length]"}
    for name, unit in units.items():
        assert set(unit.dimensionality) <= allowed, name
