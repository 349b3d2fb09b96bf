"""Priors of beams with the shapes in which they vary."""

import pickle

import numpy as np

from napari_shadowinv import Instrument
from napari_shadowinv.options import BeamComponents, BeamPrior


def test_an_instrument_holds_the_components_on_the_way_to_a_worker():
    patterns = np.random.default_rng(0).normal(size=(2, 8, 8))
    components = BeamComponents(patterns, 4, (32, 32), 0.01, "outside")
    prior = BeamPrior(rms=0.05).with_components(components)
    instrument = pickle.loads(pickle.dumps(Instrument(gamma=0.1).with_beam(prior)))
    received = instrument.beam_of(measured=True).components
    np.testing.assert_array_equal(received.patterns, patterns)
    assert Instrument(beam_rms=prior.rms).beam_of(measured=True).components is None
