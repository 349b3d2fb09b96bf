"""Setups with units, and mistakes of units that are doubted or refused by name."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.beam import (
    deflection_cautions,
    geometry_text,
    number_in_unit,
    setup_cautions,
    text_in_unit,
)
from napari_shadowinv.physics.setup import SETUPS, OpticalSetup, ProtonSetup, setup_from_dict
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
        ("0.28", "m", 0.28),
        ("inf", "m", math.inf),
        ("Infinity", "m", math.inf),  # of JSON
        ("2e19 cm^-3", "m⁻³", 2e25),
        ("97 MG µm", "MG µm", 97.0),
        ("1.5 px", "px", 1.5),
        ("1 ns", "s", 1e-9),
        ("1e-3", "", 1e-3),
    ],
)
def test_number_with_a_unit_is_exact(text: str, unit: str, number: float) -> None:
    assert number_in_unit(text, unit) == number
    assert number_in_unit(text_in_unit(number, unit), unit) == number


@pytest.mark.parametrize(
    ("text", "unit"),
    [("1.3 kg", "m"), ("abc", "m"), ("2 m", ""), ("1 mm mm", "m"), ("", "m"), ("2 m", "m⁻³")],
)
def test_text_without_a_number_in_the_unit_is_refused(text: str, unit: str) -> None:
    with pytest.raises(ValueError, match="expected a number"):
        number_in_unit(text, unit)


def test_lengths_and_energies_get_the_prefix_of_their_size() -> None:
    texts = [text_in_unit(size, "m") for size in (145e-6, 0.28, 8.1e-7, 25.0, math.inf, 0.0)]
    assert texts == ["145 µm", "280 mm", "810 nm", "25 m", "inf", "0 m"]
    assert text_in_unit(14.7, "MeV") == "14.7 MeV"
    assert text_in_unit(3000, "MeV") == "3 GeV"
    assert text_in_unit(1.65e25, "m⁻³") == "1.65e+25 m⁻³"


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


SHAPE = (200, 200)
FILM = {
    "kind": "proton",
    "energy": 14.7,
    "source_object_distance": 0.01,
    "object_image_distance": 0.28,
    "pixel_size": 5e-6,
}
SCAN = {name: value for name, value in FILM.items() if name != "pixel_size"}
LIGHT = {"kind": "optical", "wavelength": 532e-9, "object_image_distance": 0.3, "pixel_size": 2e-5}

WRONG = {
    "pixel in um": ({**FILM, "pixel_size": 5.0}, "a pixel is 5 m"),
    "pixel in mm": ({**FILM, "pixel_size": 5e-3}, "a pixel is 5 mm"),
    "pixel in pm": ({**FILM, "pixel_size": 5e-9}, "a pixel is 5 nm"),
    "detector as object": ({**FILM, "pixel_size": 145e-6}, "field of view of 2.9 cm"),
    "object as detector": ({**SCAN, "detector_pixel_size": 1.5e-6}, "1.5 µm at the detector"),
    "distances in mm": (
        {**FILM, "source_object_distance": 10.0, "object_image_distance": 280.0},
        "280 m behind",
    ),
    "source in mm": ({**FILM, "source_object_distance": 10.0}, "magnification is 1.03"),
    "detector in cm": ({**FILM, "object_image_distance": 28.0}, "magnification is 2.8e+03"),
    "swapped": (
        {**FILM, "source_object_distance": 0.28, "object_image_distance": 0.01},
        "not swapped",
    ),
    "to detector": ({**FILM, "source_object_distance": 0.29}, "source to object, not to"),
    "energy in keV": ({**FILM, "energy": 14.7e3}, "protons of 14700 MeV"),
    "energy in GeV": ({**FILM, "energy": 0.0147}, "protons of 0.0147 MeV"),
    "wavelength in mm": ({**LIGHT, "wavelength": 532e-6}, "wavelength is 532 µm"),
    "light in mm": ({**LIGHT, "object_image_distance": 300.0}, "300 m behind"),
}


@pytest.mark.parametrize(("values", "words"), WRONG.values(), ids=WRONG)
def test_setup_cautions_name_a_wrong_unit(values, words):
    cautions = setup_cautions(setup_from_dict(values), SHAPE)
    assert any(words in caution.text for caution in cautions)
    assert {caution.code for caution in cautions} == {"setup"}


@pytest.mark.parametrize(
    "change",
    [
        {"energy": 14.7e6},
        {"energy": 1e-300},
        {"source_object_distance": 1e308},
        {"object_image_distance": 1e308},
        {"object_image_distance": 1e-300},
        {"pixel_size": 1e308},
        {"pixel_size": 1e-300},
    ],
    ids=str,
)
def test_setup_refuses_numbers_beyond_any_experiment(change):
    (name,) = change
    with pytest.raises(InputError, match=name) as caught:
        setup_from_dict({**FILM, **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "values",
    [
        FILM,
        {**SCAN, "detector_pixel_size": 145e-6},
        LIGHT,
        {**FILM, "source_object_distance": float("inf")},
        {**FILM, "object_image_distance": 1.3, "pixel_size": 20e-6},
        {**FILM, "species": "electron", "energy": 200.0, "source_object_distance": 0.25},
        *(model.example().model_dump() for model in SETUPS.values()),
    ],
    ids=str,
)
def test_setup_cautions_are_silent_on_real_setups(values):
    assert setup_cautions(setup_from_dict(values), SHAPE) == ()


@pytest.mark.parametrize("shape", [(100, 3000), (3000, 100)])
def test_setup_cautions_go_by_the_longer_side(shape):
    (caution,) = setup_cautions(setup_from_dict(FILM), shape)
    assert "field of view of 1.5 cm is wider than the 1 cm" in caution.text


def test_setup_cautions_doubt_a_large_pixel_once():
    cautions = setup_cautions(setup_from_dict({**SCAN, "detector_pixel_size": 0.145}))
    assert ["a pixel is" in caution.text for caution in cautions] == [True]


def test_geometry_text_shows_field_of_view_and_magnification():
    paper = ProtonSetup.example()
    assert geometry_text(paper, (100, 200)).startswith("300 × 150 µm at the object, M = 16.4, ")
    assert "pixel 1.5 µm" in geometry_text(paper)
    assert "collimated" in geometry_text(OpticalSetup.example())


def test_deflection_cautions_begin_at_three_tenths_of_a_radian():
    setup = ProtonSetup.example()
    pixels = setup.displacement(np.array([[[0.29]], [[0.0]]]))
    assert deflection_cautions(setup, pixels) == ()
    assert "small angles" in deflection_cautions(setup, 1.1 * pixels)[0].text


def test_deflection_cautions_doubt_fields_of_kilotesla_metres():
    setup = ProtonSetup(
        energy=9e4, source_object_distance=0.01, object_image_distance=0.28, pixel_size=5e-6
    )
    pixels = setup.displacement(np.array([[[0.2]], [[0.0]]]))
    assert "T m, far more" in deflection_cautions(setup, pixels)[0].text
