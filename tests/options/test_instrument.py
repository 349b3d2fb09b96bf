"""How well an experiment is known: defaults of detectors and of sources of beams."""

import pytest

from napari_shadowinv import InputError, Instrument
from napari_shadowinv.cli._flags import instrument_keys
from napari_shadowinv.cli._settings import INVERSION_SECTIONS, settings_of
from napari_shadowinv.options import BEAM_SOURCES, DETECTORS, BeamPrior


def test_a_detector_fills_in_what_is_not_stated():
    film = Instrument(detector="film", blur=0.1)
    expected = {**DETECTORS["film"], "blur": 0.1}
    assert {name: getattr(film, name) for name in expected} == expected
    assert film.beam_rms is None


def test_a_source_of_the_beam_fills_in_the_beam():
    laser = Instrument(beam_source="laser")
    usual = BeamPrior(rms=BEAM_SOURCES["laser"]["beam_rms"], length=0.1, between=0.05)
    assert laser.beam_of(measured=True) == laser.beam_of(measured=False) == usual
    stated = Instrument(beam_source="laser", beam_rms=0.01)
    assert (stated.beam_rms, stated.beam_length) == (0.01, 0.1)


def test_an_unknown_detector_is_refused_with_those_known():
    with pytest.raises(InputError, match=r"'paper'.*'film', 'image plate', 'CR-39'.*'camera'"):
        Instrument(detector="paper")
    with pytest.raises(InputError, match=r"'sun'.*'TNSA', 'implosion', 'X-ray tube' or 'laser'"):
        Instrument(beam_source="sun")


def test_flags_replace_the_detector_of_a_recipe():
    stated = settings_of(["instrument.gamma=0.2"], INVERSION_SECTIONS, instrument_keys("CR-39"))
    film = Instrument(detector="film", blur=2)
    assert stated.change("instrument", film) == Instrument(detector="CR-39", blur=2, gamma=0.2)


@pytest.mark.parametrize("text", ["image plate,X-ray tube", "X-ray tube, image plate"])
def test_a_detector_and_a_beam_are_named_in_any_order(text):
    stated = settings_of([], INVERSION_SECTIONS, instrument_keys(text))
    expected = Instrument(detector="image plate", beam_source="X-ray tube")
    assert stated.change("instrument", Instrument()) == expected
