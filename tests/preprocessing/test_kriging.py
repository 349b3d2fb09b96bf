"""Beams predicted from around an object, against beams that are drawn here."""

from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from helpers.fit_images import bump, counted
from napari_shadowinv import InputError, Instrument, InversionOptions, Recipe, invert
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.pipeline import run
from napari_shadowinv.preprocessing import KrigedEstimate, PolynomialEstimate, UniformEstimate
from napari_shadowinv.preprocessing.kriging import kriged_prior
from napari_shadowinv.shot import Shot

SIDE, MARGIN = 128, 17
Y, X = np.indices((SIDE, SIDE)) / SIDE - 0.5
BARE = np.hypot(Y, X) > 0.25


def beam(length, rng, rms=0.05):
    """Return a positive random beam with a correlation of its logarithm of exp(-r²/2 length²)."""
    white = rng.normal(size=[3 * SIDE] * 2)
    field = gaussian_filter(white, length * SIDE / np.sqrt(2), mode="wrap")
    return np.exp(rms * (field / field.std())[SIDE : 2 * SIDE, SIDE : 2 * SIDE])


def predict(image, bare):
    """Return the beam behind an object, and the prior of its error."""
    source = KrigedEstimate().source(image, bare, on_caution=lambda _: None)
    return source, kriged_prior(image, bare)


def error_ratios(source, true, prior, bare=BARE):
    """Return errors of a beam behind an object in units of their deviation, in the blocks."""
    middles = np.s_[prior.components.block // 2 :: prior.components.block]
    behind = ~bare[middles, middles]
    height, width = behind.shape
    deviations = np.sqrt((prior.components.patterns**2).sum(axis=0))[:height, :width]
    return (log_error(source, true, bare)[middles, middles] / deviations)[behind]


def log_error(source, true, bare=BARE):
    """Return the error of the logarithm of a beam, without that of its brightness."""
    error = np.log(source / true)
    return error - error[bare].mean()


def hidden(image):
    """Return an image whose object has no likeness to the beam."""
    return np.where(BARE, image, 1e4)


def test_pixels_under_the_mask_do_not_count():
    image = np.random.default_rng(0).poisson(300 * beam(0.25, np.random.default_rng(1)))
    first = KrigedEstimate().source(np.where(BARE, image, 0), BARE)
    second = KrigedEstimate().source(hidden(image), BARE)
    np.testing.assert_array_equal(first, second)
    assert first[BARE].mean() == pytest.approx(image[BARE].mean())


def test_an_even_beam_has_hardly_an_error():
    image = np.random.default_rng(0).poisson(300, size=(SIDE, SIDE))
    source, prior = predict(image, BARE)
    assert prior.rms < 0.003
    np.testing.assert_allclose(source, 300, rtol=0.01)


def test_the_variance_is_largest_behind_the_object():
    image = np.random.default_rng(0).poisson(300 * beam(0.1, np.random.default_rng(1)))
    prior = kriged_prior(image, BARE)
    variance = (prior.components.patterns**2).sum(axis=0)
    bare = BARE[:: prior.components.block, :: prior.components.block]
    assert variance[~bare].mean() > 10 * variance[bare].mean()


def test_an_image_without_bare_pixels_is_refused():
    mask = np.zeros((SIDE, SIDE), bool)
    with pytest.raises(InputError, match=r"^mask leaves 0 of .* pixels usable"):
        KrigedEstimate().source(np.ones((SIDE, SIDE)), mask)
    with pytest.raises(InputError, match=r"^the mask hides no pixel, so the object would be"):
        KrigedEstimate().source(np.ones((SIDE, SIDE)), ~mask)
    mask[:8] = True
    with pytest.raises(InputError, match=r"% of the image is free of the object, too little"):
        KrigedEstimate().source(np.ones((SIDE, SIDE)), mask)


def random_waves(rng, length, rms):
    """Return a beam of 48 plane waves with a correlation of exp(-r²/2 length²)."""
    numbers = rng.normal(size=(48, 2)) / (length * SIDE)
    phases = rng.uniform(0, 2 * np.pi, 48)
    # Between pixels by cubic splines: the waves are tens of pixels long.
    pixels = np.arange(-MARGIN, SIDE + MARGIN)
    of_y, of_x = (np.exp(1j * np.outer(pixels, along)) for along in numbers.T)
    waves = ((of_y * np.exp(1j * phases)) @ of_x.T).real / np.sqrt(24)
    coefficients = spline_filter(waves)

    def brightness(y, x):
        places = np.stack([y, x]) + MARGIN
        return 1 + rms * map_coordinates(coefficients, places, prefilter=False, mode="nearest")

    return brightness


@cache
def traced_shot(seed, width=0.06, rms=0.03):
    """Return counts of traced rays around an object, and its beam."""
    rng = np.random.default_rng(seed)
    brightness = random_waves(rng, 0.25, rms)
    middle = (SIDE / 2, SIDE / 2)
    flux = counted(bump(0.6, width * SIDE, middle), (SIDE, SIDE), beam=brightness, rays=4)
    return rng.poisson(1000 * flux).astype(float), brightness(*np.indices((SIDE, SIDE)))


def test_random_waves_behind_a_traced_object_are_predicted_within_their_error():
    """Random waves of 3 % over a quarter of the image, behind a quarter of its area."""
    bare = np.hypot(Y, X) > 0.28
    errors = {"uniform": [], "polynomial": [], "kriged": []}
    ratios, lengths = [], []
    for seed in range(16):
        image, true = traced_shot(seed)
        source, prior = predict(image, bare)
        sources = {
            "uniform": UniformEstimate().source(image),
            "polynomial": PolynomialEstimate().source(image, bare),
            "kriged": source,
        }
        for name, estimate in sources.items():
            errors[name].append(np.sqrt((log_error(estimate, true, bare)[~bare] ** 2).mean()))
        ratios.append(error_ratios(source, true, prior, bare))
        lengths.append(prior.length)
    rms = {name: np.sqrt(np.mean(np.square(each))) for name, each in errors.items()}
    assert rms["kriged"] < 0.3 * rms["polynomial"] < 0.3 * rms["uniform"]
    assert max(errors["kriged"]) < 0.5 * max(errors["polynomial"])
    ratio = np.abs(np.concatenate(ratios))
    assert 0.55 < (ratio < 1).mean() < 0.8
    assert 0.85 < (ratio < 2).mean() < 0.99
    assert np.sqrt((ratio**2).mean()) < 1.3
    assert np.median(lengths) == pytest.approx(0.25, rel=0.15)


PROFILES = {
    "spot": np.exp(-8 * (Y**2 + X**2)),
    "tilt": 1 + 0.6 * Y,
    "cubic": 1 + 0.3 * Y + 0.4 * X**3,
}


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("noise", [0.0, 1e-4, 0.01])
def test_a_smooth_profile_is_continued_under_the_mask(profile, noise):
    """Also one that falls to a fiftieth, without noise or with it."""
    true = PROFILES[profile]
    image = true * (1 + noise * np.random.default_rng(0).normal(size=true.shape))
    cautions = []
    source = KrigedEstimate().source(hidden(image), BARE, on_caution=cautions.append)
    assert np.abs(log_error(source, true)[~BARE]).max() < 3e-3
    assert not cautions


def test_waves_on_a_spot_are_predicted_as_those_on_an_even_beam():
    ratios, errors = [], {"spot": [], "even": []}
    for seed in range(6):
        rng = np.random.default_rng(seed)
        waves = random_waves(rng, 0.25, 0.03)(*np.indices((SIDE, SIDE)))
        for name, profile in (("spot", np.exp(-4 * (Y**2 + X**2))), ("even", 1.0)):
            true = profile * waves
            source, prior = predict(hidden(rng.poisson(1000 * true)), BARE)
            errors[name].append((log_error(source, true)[~BARE] ** 2).mean())
            ratios.append(error_ratios(source, true, prior))
    assert np.mean(errors["spot"]) < 2 * np.mean(errors["even"])
    assert np.square(np.concatenate(ratios)).mean() == pytest.approx(1, abs=0.35)


@pytest.mark.parametrize("length", [0.13, 0.35])
def test_the_error_of_a_prediction_has_its_size_at_any_length(length):
    """R.m.s. of error over deviation; 1.5 if the compared lengths lie too far apart."""
    ratios, lengths = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        true = random_waves(rng, length, 0.03)(*np.indices((SIDE, SIDE)))
        source, prior = predict(hidden(rng.poisson(1000 * true)), BARE)
        ratios.append(error_ratios(source, true, prior))
        lengths.append(prior.length)
    rms = np.sqrt(np.square(np.concatenate(ratios)).mean())
    assert 0.85 < rms < 1.3
    assert np.median(lengths) == pytest.approx(length, rel=0.35)


@pytest.mark.parametrize("width", [0.06, 0.09])
def test_a_mask_that_leaves_a_halo_is_named(width):
    """At its rim the object changes the image by less than 1e-4, or by 2 %."""
    bare = np.hypot(Y, X) > 0.28
    warned = []
    for seed in range(4):
        image, _ = traced_shot(seed, width)
        cautions = []
        KrigedEstimate().source(image, bare, on_caution=cautions.append)
        warned.append([caution.code for caution in cautions])
        assert all("may not cover the object with its halo" in each.text for each in cautions)
    assert warned == 4 * ([["source"]] if width == 0.09 else [[]])


def test_an_image_of_the_beam_alone_leaves_its_prediction_as_it_is():
    """No false alarm in 16 beams of any length."""
    for seed in range(16):
        rng = np.random.default_rng(seed)
        true = random_waves(rng, (0.15, 0.25, 0.5, 1.0)[seed % 4], 0.03)(*np.indices((SIDE, SIDE)))
        cautions = []
        KrigedEstimate().source(rng.poisson(1000 * true), BARE, on_caution=cautions.append)
        assert not cautions
    KrigedEstimate().source(np.ones((SIDE, SIDE)), BARE, on_caution=cautions.append)
    assert not cautions


def test_the_report_names_a_mask_that_leaves_a_halo():
    image, _ = traced_shot(0, 0.09)
    recipe = Recipe(source={"method": "kriged"}, options={"n_sites": 300})
    result = run(recipe, Shot(image, source_mask=np.hypot(Y, X) > 0.28))
    assert any("next to the source mask" in each.text for each in result.report.cautions)


@pytest.mark.parametrize("rms", [0.0, 0.03])
def test_random_waves_are_seen_around_a_traced_object(rms):
    """With a recorded source that is even; without waves there is nothing to see."""
    variations, deviations = [], []
    for seed in range(6):
        image, true = traced_shot(seed, rms=rms)
        source = np.full(image.shape, 1000.0)
        errors = invert(image, source=source, options=InversionOptions(n_sites=300)).errors
        assert (errors.beam is None) == (rms == 0)
        variations.append(errors.beam_variation)
        deviations.append((true / true.mean()).std())
        assert variations[-1] == pytest.approx(deviations[-1], rel=0.4)
    assert np.mean(variations) == pytest.approx(np.mean(deviations), rel=0.15)


def shot_of_a_blob():
    blob = phantoms.gaussian_blob((SIDE, SIDE), 0.002 * SIDE**2, 0.06 * SIDE)
    rng = np.random.default_rng(3)
    image = rng.poisson(1000 * synthetic_image(blob.displacement, beam(0.25, rng)))
    return Shot(image.astype(float), source_mask=BARE), blob.displacement


def test_an_inversion_takes_the_conditional_variance_as_the_error_of_its_beam():
    shot, displacement = shot_of_a_blob()
    result = run(Recipe(source={"method": "kriged"}, options={"n_sites": 2500}), shot)
    assert result.errors.beam_basis == "outside"
    assert any("measured outside the object" in part for part in result.errors.parts)
    error = np.sqrt(((result.displacement - displacement) ** 2).sum(axis=0).mean())
    assert error < 2 * result.errors.total.rms < 0.5 * result.errors.rms
    uniform = run(Recipe(options={"n_sites": 2500}), Shot(shot.image))
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
    of_source = recipe.model_copy(update={"instrument": Instrument(beam_source="TNSA", gamma=0.1)})
    assert run(of_source, shot).errors.beam_basis == "outside"
    assert run(of_source, shot).instrument.gamma == 0.1


def test_kriging_needs_a_mask():
    with pytest.raises(InputError, match=r"without a source mask"):
        run(Recipe(source={"method": "kriged"}), np.ones((32, 32)))
