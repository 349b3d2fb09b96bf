"""How well an experiment is known: defaults of detectors and of sources of beams."""

import pytest

from napari_shadowinv import InputError, Instrument, Recipe
from napari_shadowinv.cli._flags import _option_flags, recipe_of
from napari_shadowinv.options import BEAM_SOURCES, DETECTORS, BeamPrior
from napari_shadowinv.pipeline import read_recipe, write_recipe


def test_a_detector_fills_in_what_is_not_stated():
    film = Instrument.of("film", blur=0.1)
    expected = {**DETECTORS["film"], "blur": 0.1}
    assert {name: getattr(film, name) for name in expected} == expected
    assert film.beam_rms is None


def test_a_source_of_the_beam_fills_in_the_beam():
    laser = Instrument.of(source="laser")
    usual = BeamPrior(rms=BEAM_SOURCES["laser"]["beam_rms"], length=0.1, between=0.05)
    assert laser.beam_of(measured=True) == laser.beam_of(measured=False) == usual
    stated = Instrument.of(source="laser", beam=BeamPrior(rms=0.01))
    assert (stated.beam_rms, stated.beam_length) == (0.01, 0.1)


@pytest.mark.parametrize("name", ["image-plate", "Image Plate", "image_plate"])
def test_names_are_read_in_other_spellings(name):
    assert Instrument.of(name).detector == "image plate"


def test_an_unknown_detector_is_refused_with_those_known():
    with pytest.raises(InputError, match=r"'paper'.*'film', 'image plate', 'CR-39'.*'camera'"):
        Instrument.of("paper")
    with pytest.raises(InputError, match=r"'sun'.*'TNSA', 'implosion', 'X-ray tube' or 'laser'"):
        Instrument.of(source="sun")


def test_a_stated_zero_survives_a_recipe_file(tmp_path):
    recipe = Recipe(instrument=Instrument.of("film", source="TNSA", background=0))
    path = tmp_path / "recipe.toml"
    write_recipe(path, recipe)
    assert read_recipe(path) == recipe
    assert "gamma" not in path.read_text()  # the default of film
    assert Instrument.model_validate_json(recipe.instrument.model_dump_json()) == recipe.instrument


def test_flags_replace_the_detector_of_a_recipe():
    base = Recipe(instrument=Instrument.of("film", blur=2))
    flagged = recipe_of({"detector": "CR-39", "gamma": 0.2}, base)
    assert flagged.instrument == Instrument.of("CR-39", blur=2, gamma=0.2)


def test_flags_list_the_detectors_and_the_sources_of_beams():
    kinds = dict(_option_flags(Instrument, None))
    (flag,) = kinds["detector"].annotation.__metadata__
    assert flag.metavar == "film|image plate|CR-39|scintillator|camera"
    (flag,) = kinds["beam_source"].annotation.__metadata__
    assert flag.metavar == "TNSA|implosion|X-ray tube|laser"
