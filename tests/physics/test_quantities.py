"""Setups whose numbers have units."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from napari_shadowinv import InputError, OpticalSetup, ProtonSetup
from napari_shadowinv.physics.beam import number_in_unit
from napari_shadowinv.physics.setup import setup_from_dict
from napari_shadowinv.pipeline import read_recipe

PLAIN = {
    "kind": "proton",
    "energy": 14.7,
    "source_object_distance": 1.3e-3,
    "object_image_distance": 20e-3,
    "detector_pixel_size": 24.57e-6,
}
WITH_UNITS = {
    "kind": "proton",
    "energy": "14.7 MeV",
    "source_object_distance": "1.3 mm",
    "object_image_distance": "2cm",
    "detector_pixel_size": "24.57 µm",
}


def test_setup_with_units_equals_the_one_in_si() -> None:
    assert setup_from_dict(WITH_UNITS) == setup_from_dict(PLAIN)


@pytest.mark.parametrize(
    ("text", "unit", "number"),
    [
        ("1.3 mm", "m", 1.3e-3),
        ("810nm", "m", 810e-9),
        ("24.57 um", "m", 24.57e-6),
        ("24.57 μm", "m", 24.57e-6),
        ("2.5e2 pm", "m", 250e-12),
        ("-.5 km", "m", -500.0),
        ("700 keV", "MeV", 0.7),
        ("1 GeV", "MeV", 1000.0),
        ("14.7 MeV", "MeV", 14.7),
        ("25 m", "m", 25.0),
    ],
)
def test_number_with_a_unit_is_exact(text: str, unit: str, number: float) -> None:
    assert number_in_unit(text, unit) == number


def test_energy_with_a_prefix_is_in_mev() -> None:
    assert ProtonSetup(**{**WITH_UNITS, "energy": "700 keV"}).energy == 0.7


def test_wavelength_and_collimated_beam_are_read_from_text() -> None:
    light = {"wavelength": "532 nm", "object_image_distance": "0.3", "pixel_size": "12 µm"}
    setup = OpticalSetup(**light, source_object_distance="inf")
    assert (setup.wavelength, setup.object_image_distance) == (532e-9, 0.3)
    assert math.isinf(setup.source_object_distance)


@pytest.mark.parametrize(
    ("field", "text", "says"),
    [
        ("energy", "14.7 mm", "the unit 'mm' cannot be converted to MeV"),
        ("energy", "14.7 Mev", "the unit 'Mev' cannot be converted to MeV"),
        ("object_image_distance", "2 xm", "the unit 'xm' cannot be converted to m"),
        ("object_image_distance", "two metres", "expected a number in m"),
        ("detector_pixel_size", "24,57 µm", "such as '1.3 mm'"),
        ("source_object_distance", "0 mm", "must be greater than 0"),
    ],
)
def test_wrong_unit_is_refused_in_one_sentence(field: str, text: str, says: str) -> None:
    with pytest.raises(InputError) as error:
        setup_from_dict({**WITH_UNITS, field: text}, "setup.toml")
    message = str(error.value)
    assert message.startswith(f"setup.toml: '{field}' is ")
    assert says in message
    assert "\n" not in message


def test_recipe_takes_units_in_its_setup(tmp_path: Path) -> None:
    lines = [f'{name} = "{value}"' for name, value in WITH_UNITS.items()]
    path = tmp_path / "recipe.toml"
    path.write_text("\n".join(["[setup]", *lines]), encoding="utf-8")
    assert read_recipe(path).setup == setup_from_dict(PLAIN)
