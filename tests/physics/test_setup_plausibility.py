"""Mistakes of units are doubted or refused by name; setups of real experiments are not."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import (
    SETUPS,
    OpticalSetup,
    ProtonSetup,
    deflection_warnings,
    geometry_text,
    setup_from_dict,
    setup_warnings,
)

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
    "scan in mm": ({**SCAN, "detector_pixel_size": 0.145}, "a pixel is 5 mm"),
    "detector as object": ({**FILM, "pixel_size": 145e-6}, "field of view of 2.9 cm"),
    "object as detector": ({**SCAN, "detector_pixel_size": 1.5e-6}, "1.5 µm at the detector"),
    "distances in mm": (
        {**FILM, "source_object_distance": 10.0, "object_image_distance": 280.0},
        "280 m behind",
    ),
    "distances in cm": (
        {**FILM, "source_object_distance": 1.0, "object_image_distance": 28.0},
        "28 m behind",
    ),
    "source in mm": ({**FILM, "source_object_distance": 10.0}, "magnification is 1.03"),
    "detector in cm": ({**FILM, "object_image_distance": 28.0}, "magnification is 2.8e+03"),
    "swapped": (
        {**FILM, "source_object_distance": 0.28, "object_image_distance": 0.01},
        "not swapped",
    ),
    "to detector": ({**FILM, "source_object_distance": 0.29}, "source to object, not to"),
    "energy in keV": ({**FILM, "energy": 14.7e3}, "protons of 14700 MeV"),
    "energy times ten": ({**FILM, "energy": 147.0}, "protons of 147 MeV"),
    "energy in GeV": ({**FILM, "energy": 0.0147}, "protons of 0.0147 MeV"),
    "wavelength in mm": ({**LIGHT, "wavelength": 532e-6}, "wavelength is 532 µm"),
    "light in mm": ({**LIGHT, "object_image_distance": 300.0}, "300 m behind"),
}


@pytest.mark.parametrize(("values", "words"), WRONG.values(), ids=WRONG)
def test_setup_warnings_name_a_wrong_unit(values, words):
    cautions = setup_warnings(setup_from_dict(values), SHAPE)
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
def test_setup_warnings_are_silent_on_real_setups(values):
    assert setup_warnings(setup_from_dict(values), SHAPE) == ()


@pytest.mark.parametrize("shape", [(100, 3000), (3000, 100)])
def test_setup_warnings_go_by_the_longer_side(shape):
    (caution,) = setup_warnings(setup_from_dict(FILM), shape)
    assert "field of view of 1.5 cm is wider than the 1 cm" in caution.text


def test_geometry_text_shows_field_of_view_and_magnification():
    paper = ProtonSetup.example()
    assert geometry_text(paper, (100, 200)).startswith("300 × 150 µm at the object, M = 16.4, ")
    assert "pixel 1.5 µm" in geometry_text(paper)
    assert "collimated" in geometry_text(OpticalSetup.example())


def test_deflection_warnings_begin_at_three_tenths_of_a_radian():
    setup = ProtonSetup.example()
    pixels = setup.displacement(np.array([[[0.29]], [[0.0]]]))
    assert deflection_warnings(setup, pixels) == ()
    assert "small angles" in deflection_warnings(setup, 1.1 * pixels)[0].text


def test_deflection_warnings_doubt_fields_of_kilotesla_metres():
    setup = ProtonSetup(
        energy=9e4, source_object_distance=0.01, object_image_distance=0.28, pixel_size=5e-6
    )
    pixels = setup.displacement(np.array([[[0.2]], [[0.0]]]))
    assert "T m, far more" in deflection_warnings(setup, pixels)[0].text
