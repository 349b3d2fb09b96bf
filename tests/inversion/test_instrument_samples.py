"""Samples by an instrument that is not exact, against formulas and images changed here."""

from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from napari_shadowinv import InputError, Instrument, InversionOptions, invert, synthetic_image
from napari_shadowinv.instrument.effects import EFFECTS, InstrumentDraws, RecordedShot
from napari_shadowinv.inversion import Maximum, plan_sites
from napari_shadowinv.inversion import samples as sampling
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics.phantoms import gaussian_blob

SHAPE = (48, 56)
OPTIONS = InversionOptions(n_sites=1000, negative="clip")
EVERYTHING = Instrument(
    beam_rms=0.02,
    background=0.05,
    gamma=0.05,
    blur=1.0,
    absorption=0.02,
    registration=0.5,
    other_field=0.05,
)
NOISE = 0.002
EXACT: dict[str, Any] = {"beam_rms": 0.0, "registration": 0.0}


@pytest.fixture(scope="module")
def blob():
    return gaussian_blob(SHAPE, 14.0, 6.0)


@pytest.fixture(scope="module")
def source():
    white = np.random.default_rng(5).normal(size=SHAPE)
    smooth = ndimage.gaussian_filter(white, 5, mode="wrap")
    return 1 + 0.1 * smooth / smooth.std()


@pytest.fixture(scope="module")
def image(blob, source):
    return synthetic_image(blob.displacement, source)


def rms(field):
    return float(np.sqrt((field**2).mean()))


def sampled(image, source, instrument, n=60, *, mask=None, options=OPTIONS, noise=NOISE, **choices):
    """An inversion with samples of noise and instrument; of noise alone where that is None."""
    inversion = invert(image, source=source, mask=mask, options=options, instrument=instrument)
    return inversion.uncertainty(n, noise=noise, noise_only=instrument is None, **choices)


def sample(*arguments, **choices):
    return sampled(*arguments, **choices).errors.samples


def test_an_exact_instrument_leaves_the_samples_of_noise_bit_for_bit(image, source):
    plain, stated = (sample(image, source, each, n=5) for each in (None, Instrument(**EXACT)))
    for name in ("potential_mean", "potential_std", "displacement_mean", "displacement_std"):
        np.testing.assert_array_equal(getattr(plain, name), getattr(stated, name))
    assert plain.residuals == stated.residuals


@pytest.mark.parametrize("method", ["linear", "resolve"])
def test_samples_depend_on_the_seed_alone(image, source, method):
    """From the 24th on, by which linear ones are corrected."""

    def draw(threads, seed=0, n=27 if method == "linear" else 5):
        options = OPTIONS.model_copy(update={"threads": threads, "seed": seed})
        peak = {"peak": lambda potential, displacement: np.hypot(*displacement).max()}
        return sample(
            image, source, EVERYTHING, n=n, method=method, options=options, quantities=peak
        )

    serial, parallel = draw(1), draw(3)
    for name in ("potential_mean", "potential_std", "displacement_mean", "displacement_std"):
        np.testing.assert_array_equal(getattr(serial, name), getattr(parallel, name))
    samples = serial.quantities["peak"].samples
    np.testing.assert_array_equal(samples, parallel.quantities["peak"].samples)
    assert not np.allclose(draw(1, seed=1).quantities["peak"].samples, samples, rtol=1e-4)


def without(key, size, image, source):
    if key == "background":
        return image - size * image.mean(), source - size * source.mean()
    if key == "gamma":
        return image ** (1 / (1 + size)), source ** (1 / (1 + size))
    once, twice = (
        ndimage.gaussian_filter(image, width, mode="nearest") for width in (size, np.sqrt(2) * size)
    )
    return 3 * image - 3 * once + twice, source


@pytest.mark.parametrize(("key", "size"), [("background", 0.02), ("gamma", 0.02), ("blur", 1.0)])
def test_the_effect_of_a_single_number_is_the_change_of_the_field(
    image, source, key, size, monkeypatch
):
    """Its standard deviation is the change without one of it; a blur's √2 times, by its square."""
    monkeypatch.setattr(sampling, "_LEAST_PAIRS", np.inf)  # deviations stay as they are
    stated = Instrument(**{key: size}, **EXACT)
    result = sample(image, source, stated, n=400)
    moved, beam = without(key, size, image, source)
    other = invert(moved, source=beam, options=OPTIONS)
    change = other.displacement - result.displacement
    width = np.sqrt(2) if key == "blur" else 1.0
    assert rms(result.displacement_std) == pytest.approx(width * rms(change), rel=0.1)
    mean = result.displacement_mean - result.displacement
    expected = -change if key == "blur" else 0 * change
    assert rms(mean - expected) < 0.15 * rms(change)


def test_linear_samples_add_a_pattern_times_its_number_to_those_of_noise(
    image, source, monkeypatch
):
    """The same noise, of opposite sign: the sum has one pattern, and normal factors."""
    monkeypatch.setattr(sampling, "_LEAST_PAIRS", np.inf)  # deviations stay as they are
    move = {"move": lambda potential, displacement: displacement}
    with_noise, with_both = (
        sample(image, source, stated, n=200, quantities=move).quantities["move"].samples
        for stated in (None, Instrument(background=0.02, **EXACT))
    )
    added = (with_both + with_noise).reshape(200, -1)
    added -= added.mean(axis=0)  # solved samples shift all alike
    strengths, sizes, _ = np.linalg.svd(added, full_matrices=False)
    assert sizes[1] < 1e-9 * sizes[0]
    numbers = strengths[:, 0] * np.sqrt(200)
    below = (np.abs(numbers) < numbers.std()).mean()
    assert below == pytest.approx(0.683, abs=0.1)


@pytest.mark.parametrize("key", ["background", "gamma"])
def test_a_band_is_that_of_the_fields_without_what_may_be_in_the_image(key):
    """A weak field is as strong as the contrast, of which a share b of background takes b away."""
    image = synthetic_image(gaussian_blob(SHAPE, 1.0, 6.0).displacement)
    slope = {"slope": lambda potential, displacement: displacement[0, 30, 28]}
    stated = Instrument(beam_rms=0.0, **{key: 0.1})
    result = sample(image, np.ones(SHAPE), stated, noise=1e-5, quantities=slope, n=120)
    low, high = result.quantities["slope"].band(0.95)
    factors = np.sort([low, high]) / result.quantities["slope"].value
    assert factors == pytest.approx([1 / 1.196, 1 / 0.804], rel=0.03)


def test_another_field_scales_every_sample(image, source):
    result = sample(image, source, Instrument(other_field=0.1, **EXACT), n=400)
    length = rms(result.displacement)
    assert rms(result.displacement_std) == pytest.approx(0.1 * length, rel=0.1)


def test_a_beams_error_is_that_of_inversions_with_other_beams(image, source):
    """Beams of random waves, drawn here."""
    result = sample(image, source, Instrument(beam_rms=0.01), n=200)
    plan = plan_sites(source, OPTIONS)
    here = invert(image, plan=plan, options=OPTIONS)
    rng, indices, fields = np.random.default_rng(1), np.indices(SHAPE), []
    for _ in range(24):
        waves = rng.normal(size=(40, 2)) / (0.25 * min(SHAPE))
        phases = rng.uniform(0, 2 * np.pi, 40)[:, None, None]
        wave = np.cos(np.tensordot(waves, indices, 1) + phases).sum(axis=0)
        wave = (wave - wave.mean()) / np.sqrt(20)
        beam = source * (1 + 0.01 * wave / np.sqrt(_share_within()))
        fields.append(invert(image, source=beam, options=OPTIONS).displacement)
    scatter = np.sqrt(((np.array(fields) - here.displacement) ** 2).mean(axis=0))
    assert rms(result.displacement_std) == pytest.approx(rms(scatter), rel=0.2)


def _share_within():
    """Variance of random waves that their mean over the image leaves."""
    places = [np.arange(side) for side in SHAPE]
    along = [np.exp(-((p[:, None] - p) ** 2) / 2 / (0.25 * min(SHAPE)) ** 2).mean() for p in places]
    return 1 - along[0] * along[1]


def test_linear_samples_are_near_the_solved_ones(image, source):
    inversion = sampled(image, source, EVERYTHING, n=24)
    linear = inversion.errors.samples
    solved = sample(image, source, EVERYTHING, n=24, method="resolve")
    assert inversion.errors.causes[0] == "noise"
    assert len(inversion.errors.causes) == 8
    ratio = rms(linear.displacement_std) / rms(solved.displacement_std)
    assert ratio == pytest.approx(1, abs=0.1)
    assert linear.linearity.spread_ratio == pytest.approx(1, abs=0.1)
    assert linear.linearity.mean_shift < 0.2
    assert not any(caution.code == "samples" for caution in inversion.cautions)


def test_solved_samples_correct_mean_and_deviation(image, source, monkeypatch):
    """Of the same draws: 24 of 160 that are solved bring all nearer to all that are solved."""
    stated = Instrument(blur=2.0)
    peak = {"peak": lambda potential, displacement: np.hypot(*displacement).max()}

    def draw(method, pairs=8):
        monkeypatch.setattr(sampling, "_LEAST_PAIRS", pairs)
        return sample(image, source, stated, n=160, quantities=peak, method=method)

    linear, unscaled, solved = draw("linear"), draw("linear", np.inf), draw("resolve")

    def error(result):
        return rms(np.log(result.displacement_std / solved.displacement_std))

    # Where chance explains the ratio of 24 pairs, deviations stay within a tenth.
    assert error(linear) < max(0.3 * error(unscaled), 0.1)
    shift = rms(linear.displacement_mean - solved.displacement_mean)
    # So does a small difference of the means.
    assert shift < max(0.5 * linear.linearity.mean_shift, 0.05) * rms(solved.displacement_std)
    peaks = [each.quantities["peak"] for each in (linear, unscaled, solved)]
    of_linear, of_unscaled, of_solved = (np.log(each.samples.std()) for each in peaks)
    assert abs(of_linear - of_solved) < max(0.5 * abs(of_unscaled - of_solved), 0.1)


def test_a_dark_level_above_the_darkest_pixels_leaves_them_dark(image, source):
    """Of 27 draws of a level of 30 % some are more than the source has in places."""
    dim = source - 0.9 * source.min()
    result = sample(image, dim, Instrument(background=0.3), n=27, method="resolve")
    assert np.isfinite(result.displacement_std).all()
    assert all(np.isfinite(result.residuals))


def test_an_instrument_too_uncertain_for_a_linear_answer_is_reported(image, source):
    result = sampled(image, source, Instrument(background=0.4), n=24)
    assert [caution.code for caution in result.cautions].count("samples") == 1
    assert result.errors.samples.linearity.nonlinearity > 0.6


@pytest.mark.parametrize("kind", ["masked", "free"])
def test_linear_samples_follow_a_mask_and_a_margin(image, source, kind):
    mask, options = None, OPTIONS
    if kind == "masked":
        mask = np.ones(SHAPE, bool)
        mask[:6, :20] = mask[20:24, 4:9] = False
    else:
        options = OPTIONS.model_copy(update={"boundary": "free"})
    stated = Instrument(beam_rms=0.01, background=0.02, gamma=0.02, blur=0.5, registration=0.2)
    result = sample(image, source, stated, n=8, mask=mask, options=options)
    assert result.linearity.spread_ratio == pytest.approx(1, abs=0.1)
    assert result.linearity.nonlinearity < 0.3
    assert all(result.converged)


def test_the_order_of_the_imperfections_is_that_of_light_and_detector(image, source, blob):
    """A dark level was added after the response; a blur has spread what the object absorbs."""
    mask = np.ones(SHAPE, bool)
    shot = RecordedShot(image=image, source=source, displacement=blob.displacement, mask=mask)
    draws = InstrumentDraws(shot, EVERYTHING, BeamPrior(rms=0.02))
    assert [name.split(",")[0] for name in draws.names] == [
        "other field",
        "beam",
        *reversed([each.key for each in EFFECTS]),
    ]
    both = InstrumentDraws(shot, Instrument(background=0.1, gamma=0.1), BeamPrior(rms=0.0))
    light = image - 0.1 * image.mean()
    expected = light ** (1 / 1.1)
    expected *= light.mean() / expected.mean()
    np.testing.assert_allclose(both.shot(np.ones(3)).image, expected)


def test_a_source_that_nobody_measured_is_off_as_in_the_budget(blob):
    image = synthetic_image(blob.displacement)
    noise_alone = sampled(image, None, None, n=20).errors
    errors = sampled(image, None, Instrument()).errors
    assert noise_alone.causes == ("noise",)
    assert errors.causes == ("noise", "beam, 5 %")
    assert rms(errors.per_pixel) > 10 * rms(noise_alone.per_pixel)


def test_the_band_of_a_quantity_mirrors_its_samples():
    """Where samples are 2 higher than the value on average, the value is 2 too high."""
    samples = 7.0 + np.random.default_rng(0).normal(size=100_000)
    quantity = Quantity(np.asarray(5.0), samples)
    low, high = quantity.band(0.95)
    assert (low, high) == (pytest.approx(3 - 1.96, abs=0.03), pytest.approx(3 + 1.96, abs=0.03))
    assert quantity.bias == pytest.approx(2, abs=0.02)
    assert quantity.std == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("count", [20, 200])
@pytest.mark.parametrize("top", ["flat", "two", "sharp"])
def test_bands_of_a_maximum_hold_the_truth(top, count):
    """The noise of the estimate, and that of samples about it, is normal, as large everywhere."""
    rng, held, biases = np.random.default_rng(7), [], []
    truth = {"flat": np.ones(60), "two": np.repeat([1.0, -9.0], [2, 58])}.get(
        top, -(np.linspace(-3, 3, 61) ** 2)
    )
    for _ in range(600):
        estimate = truth + 0.1 * rng.normal(size=truth.size)
        samples = (estimate + 0.1 * rng.normal(size=(count, truth.size))).max(axis=1)
        quantity = Quantity(np.asarray(estimate.max()), samples, is_maximum=True)
        ends = [quantity.band(share) for share in (0.68, 0.95)]
        held.append([low < truth.max() < high for low, high in ends])
        biases.append((quantity.value - quantity.bias - truth.max()) / 0.1)
    shares = np.mean(held, axis=0)
    assert 0.54 < shares[0] < 0.9
    assert 0.9 < shares[1] < 0.98
    # A maximum of 60 equal values is 2.3 deviations too high, that of two 0.6.
    assert abs(np.mean(biases)) < 0.45
    assert Maximum(np.hypot)(3.0, 4.0) == 5


@pytest.mark.parametrize("count", [4, 12, 60])
def test_bands_of_few_samples_hold_their_share_of_truths(count):
    """The error of the value and those of the samples are drawn from one normal distribution."""
    draws = np.random.default_rng(1).normal(size=(count + 1, 20_000))
    quantity = Quantity(draws[0], draws[0] + draws[1:])
    for share in (0.68, 0.95):
        low, high = quantity.band(share)
        assert ((low < 0) & (high > 0)).mean() == pytest.approx(share, abs=0.01)


def test_quantities_are_numbers_and_lines_of_each_sample(image, source):
    result = sample(
        image,
        source,
        EVERYTHING,
        n=20,
        quantities={
            "line": lambda potential, displacement: displacement[:, 20],
            "potential": lambda potential, displacement: potential,
        },
    )
    line, potential = (result.quantities[name] for name in ("line", "potential"))
    np.testing.assert_array_equal(line.value, result.displacement[:, 20])
    # Skewness adds little to the deviations.
    np.testing.assert_allclose(line.std, result.displacement_std[:, 20], rtol=0.02)
    np.testing.assert_allclose(potential.std, result.potential_std, rtol=0.02)
    low, high = result.band(0.95)
    middle = 2 * result.displacement - result.displacement_mean
    np.testing.assert_allclose((low + high) / 2, middle)
    np.testing.assert_allclose((high - low) / 2, 1.96 * result.displacement_std, rtol=1e-3)
    narrow, wide = (np.ptp(result.potential_band(share), axis=0) for share in (0.68, 0.95))
    assert (narrow < wide).all()


def test_quantities_that_are_no_functions_are_refused(image):
    with pytest.raises(InputError, match="expected a dictionary of functions"):
        sample(image, None, None, n=2, quantities={"peak": 3})


def test_a_band_needs_a_share():
    with pytest.raises(InputError, match="share is 95, expected a number between 0 and 1"):
        Quantity(np.asarray(0.0), np.zeros(3)).band(95)
