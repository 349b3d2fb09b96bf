"""Beams predicted from around an object, against beams that are drawn here."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv import InputError, Instrument, Recipe
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.pipeline import run
from napari_shadowinv.preprocessing import Radiograph, kriged_source
from napari_shadowinv.preprocessing.kriging import kriged_beam

SIDE = 128
Y, X = np.indices((SIDE, SIDE)) / SIDE - 0.5
BARE = np.hypot(Y, X) > 0.25


def beam(length, rng, rms=0.05):
    """Return a positive random beam with a correlation of its logarithm of exp(-r²/2 length²)."""
    white = rng.normal(size=[3 * SIDE] * 2)
    field = gaussian_filter(white, length * SIDE / np.sqrt(2), mode="wrap")
    return np.exp(rms * (field / field.std())[SIDE : 2 * SIDE, SIDE : 2 * SIDE])


def hidden(image):
    """Return an image whose object has no likeness to the beam."""
    return np.where(BARE, image, 1e4)


@pytest.mark.parametrize("length", [0.1, 0.2])
def test_the_beam_behind_an_object_is_within_the_conditional_variance(length):
    """The rings of errors in units of their deviation, over 16 beams with counts."""
    ratios, lengths = [], []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        true = beam(length, rng)
        source, prior = kriged_beam(hidden(rng.poisson(300 * true)), BARE)
        block = prior.components.block
        errors = np.log(source / true)[::block, ::block]
        errors -= np.log(source / true)[BARE].mean()
        deviations = np.sqrt((prior.components.patterns**2).sum(axis=0))
        ratios.append((errors / deviations)[~BARE[::block, ::block]])
        lengths.append(prior.length)
    ratio = np.abs(np.concatenate(ratios))
    assert 0.58 < (ratio < 1).mean() < 0.85
    assert 0.88 < (ratio < 2).mean() <= 1.0
    assert np.median(lengths) == pytest.approx(length, rel=0.35)


def test_pixels_under_the_mask_do_not_count():
    image = np.random.default_rng(0).poisson(300 * beam(0.25, np.random.default_rng(1)))
    first = kriged_source(np.where(BARE, image, 0), BARE)
    second = kriged_source(hidden(image), BARE)
    np.testing.assert_array_equal(first, second)
    assert first[BARE].mean() == pytest.approx(image[BARE].mean())


def test_an_even_beam_has_hardly_an_error():
    image = np.random.default_rng(0).poisson(300, size=(SIDE, SIDE))
    source, prior = kriged_beam(image, BARE)
    assert prior.rms < 0.003
    np.testing.assert_allclose(source, 300, rtol=0.01)


def test_the_variance_is_largest_behind_the_object():
    image = np.random.default_rng(0).poisson(300 * beam(0.1, np.random.default_rng(1)))
    _, prior = kriged_beam(image, BARE)
    variance = (prior.components.patterns**2).sum(axis=0)
    bare = BARE[:: prior.components.block, :: prior.components.block]
    assert variance[~bare].mean() > 10 * variance[bare].mean()


def test_an_image_without_bare_pixels_is_refused():
    mask = np.zeros((SIDE, SIDE), bool)
    mask[:8] = True
    with pytest.raises(InputError, match=r"7% of the image is free of the object, too little"):
        kriged_source(np.ones((SIDE, SIDE)), mask)


def shot_of_a_blob():
    blob = phantoms.gaussian_blob((SIDE, SIDE), 0.002 * SIDE**2, 0.06 * SIDE)
    rng = np.random.default_rng(3)
    image = rng.poisson(1000 * synthetic_image(blob.displacement, beam(0.25, rng)))
    return Radiograph(image.astype(float), source_mask=BARE), blob.displacement


def test_an_inversion_takes_the_conditional_variance_as_the_error_of_its_beam():
    shot, displacement = shot_of_a_blob()
    result = run(Recipe(source={"method": "kriged"}, options={"n_sites": 2500}), shot)
    assert result.errors.beam_basis == "outside"
    assert any("measured outside the object" in part for part in result.errors.parts)
    error = np.sqrt(((result.displacement - displacement) ** 2).sum(axis=0).mean())
    assert error < 2 * result.errors.total.rms < 0.5 * result.errors.rms
    uniform = run(Recipe(options={"n_sites": 2500}), Radiograph(shot.image))
    assert np.square(uniform.displacement - displacement).mean() > 4 * error**2


def test_a_stated_beam_replaces_the_conditional_variance():
    shot, _ = shot_of_a_blob()
    recipe = Recipe(
        source={"method": "kriged"},
        options={"n_sites": 500},
        instrument=Instrument(beam_rms=0.02, gamma=0.1),
    )
    result = run(recipe, shot)
    assert (result.errors.beam_basis, result.errors.beam_variation) == ("stated", 0.02)
    of_source = recipe.model_copy(update={"instrument": Instrument.of(source="TNSA", gamma=0.1)})
    assert run(of_source, shot).errors.beam_basis == "outside"
    assert run(of_source, shot).instrument.gamma == 0.1


def test_kriging_needs_a_mask():
    with pytest.raises(InputError, match=r"without a source mask"):
        run(Recipe(source={"method": "kriged"}), np.ones((32, 32)))
