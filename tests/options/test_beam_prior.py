"""Priors of beams from shots without an object, against beams that are drawn here."""

import pickle

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv import InputError, Instrument, InversionOptions, invert
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image

SIDE = 160
Y, X = np.indices((SIDE, SIDE)) / SIDE - 0.5


def unit(pattern):
    return (pattern - pattern.mean()) / pattern.std()


TILT, BOWL = unit(Y + 0.5 * X), unit(Y**2 + X**2)


def tilted(count, rng, counts=None):
    """Return beams with a random tilt of 4 % and bowl of 2 %, of random flux."""
    beams = []
    for _ in range(count):
        beam = 1 + 0.04 * rng.normal() * TILT + 0.02 * rng.normal() * BOWL
        beam *= rng.uniform(0.5, 2)
        beams.append(beam if counts is None else rng.poisson(counts * beam))
    return beams


def smooth(length, rng):
    """Return a random field of unit variance with a correlation of exp(-r²/2 length²)."""
    white = rng.normal(size=[3 * SIDE] * 2)
    field = gaussian_filter(white, length / np.sqrt(2), mode="wrap")
    return (field / field.std())[SIDE : 2 * SIDE, SIDE : 2 * SIDE]


@pytest.mark.parametrize(("counts", "noise"), [(None, 0.03), (500, 0.2)])
def test_components_of_references_are_the_shapes_they_are_made_of(counts, noise):
    prior = BeamPrior.from_references(tilted(40, np.random.default_rng(1), counts))
    patterns = prior.components.patterns
    assert len(patterns) == 2
    shapes = np.stack([TILT.ravel(), BOWL.ravel()])
    block = prior.components.block
    for pattern, rms in zip(patterns, (0.04, 0.02), strict=True):
        fine = np.kron(pattern, np.ones((block, block)))[:SIDE, :SIDE].ravel()
        weights, *_ = np.linalg.lstsq(shapes.T, fine, rcond=None)
        assert np.std(fine - weights @ shapes) < noise * rms
        assert np.std(fine) == pytest.approx(rms, rel=0.3)
    assert prior.components.rest < 0.2 * prior.rms
    assert prior.rms == pytest.approx(np.hypot(0.04, 0.02), rel=0.2)


@pytest.mark.parametrize("length", [0.06, 0.12])
def test_length_and_rms_of_random_beams_are_recovered(length):
    rng = np.random.default_rng(2)
    beams = [rng.poisson(400 * (1 + 0.03 * smooth(length * SIDE, rng))) for _ in range(12)]
    prior = BeamPrior.from_references(beams)
    assert prior.length == pytest.approx(length, rel=0.2)
    assert prior.rms == pytest.approx(0.03, rel=0.15)
    # Few references of many shapes: most of a new one is beyond them.
    assert prior.components.rest > 0.5 * prior.rms


def test_two_references_have_no_shapes_but_an_rms():
    rng = np.random.default_rng(3)
    beams = [1 + 0.03 * smooth(0.1 * SIDE, rng) for _ in range(2)]
    prior = BeamPrior.from_references(beams)
    assert len(prior.components.patterns) == 0
    assert prior.components.rest == prior.rms > 0.01


def test_references_of_one_beam_vary_by_nothing_but_noise():
    rng = np.random.default_rng(4)
    prior = BeamPrior.from_references([rng.poisson(200 * (2 + Y)) for _ in range(6)])
    assert prior.rms < 0.005
    np.testing.assert_allclose(prior.mean, (2 + Y) / 2, rtol=0.2)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        ([np.ones((8, 8))], "got 1 references, expected at least two"),
        ([np.ones((8, 8)), np.ones((9, 8))], r"reference 2 has shape \(9, 8\), the first \(8, 8\)"),
        ([np.ones((8, 8)), np.zeros((8, 8))], "reference 2 has a mean of 0"),
        ([np.ones((8, 8)), np.full((8, 8), np.nan)], "reference 2 has 64 values that are NaN"),
        ([np.ones((8, 8, 3))], "reference 1 has shape"),
    ],
)
def test_references_that_are_no_beams_are_refused(images, message):
    with pytest.raises(InputError, match=message):
        BeamPrior.from_references(images)


def test_a_prior_of_another_shape_is_refused():
    prior = BeamPrior.from_references(tilted(3, np.random.default_rng(0)))
    with pytest.raises(InputError, match=r"shape \(160, 160\), the image has \(32, 32\)"):
        invert(np.ones((32, 32)), instrument=Instrument(beam=prior))


def test_an_instrument_holds_the_components_on_the_way_to_a_worker():
    prior = BeamPrior.from_references(tilted(5, np.random.default_rng(0)))
    instrument = pickle.loads(pickle.dumps(Instrument(beam=prior, gamma=0.1)))
    received = instrument.beam_of(measured=True).components
    np.testing.assert_array_equal(received.patterns, prior.components.patterns)
    assert Instrument(beam_rms=prior.rms).beam_of(measured=True).components is None


def test_the_error_by_references_is_that_of_inversions_with_other_beams():
    """Beams vary in one shape: the error is its effect, not that of waves in all directions."""
    rng = np.random.default_rng(5)
    beams = [1 + a * TILT for a in 0.02 * rng.normal(size=12)]
    prior = BeamPrior.from_references(beams)
    blob = phantoms.gaussian_blob((SIDE, SIDE), 0.006 * SIDE**2, 0.1 * SIDE)
    options = InversionOptions(n_sites=2500)
    images = [synthetic_image(blob.displacement, beam / beam.mean()) for beam in beams]
    still = synthetic_image(blob.displacement, prior.mean)
    result = invert(still, source=prior.mean, options=options, instrument={"beam": prior})
    moved = [
        invert(image, source=prior.mean, options=options).displacement - result.displacement
        for image in images
    ]
    expected = np.sqrt(np.mean([np.square(move).sum(axis=0).mean() for move in moved]))
    assert result.errors.beam_basis == "references"
    assert result.errors.beam.rms == pytest.approx(expected, rel=0.2)
    waves = invert(still, source=prior.mean, options=options, instrument={"beam_rms": prior.rms})
    assert waves.errors.beam.rms < 0.8 * expected
