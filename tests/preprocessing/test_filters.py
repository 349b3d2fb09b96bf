from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import (
    butterworth,
    fit_polynomial,
    high_pass,
    low_pass,
    remove_background,
    remove_hot_pixels,
)
from napari_shadowinv.preprocessing.filters import LowPassFilter

SHAPE = (48, 60)
FILTERS = {
    "low pass": lambda image: low_pass(image, 3.0),
    "high pass": lambda image: high_pass(image, 3.0),
    "butterworth": lambda image: butterworth(image, 12.0),
    "background": lambda image: remove_background(image, 1),
    "hot pixels": lambda image: remove_hot_pixels(image)[0],
}


def random_image(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).uniform(1, 5, shape)


def wave(n_y, n_x, shape=SHAPE):
    """A wave that fits the mirrored image, and its wave number in rad/px."""
    y, x = (
        np.pi * n * (np.arange(side) + 0.5) / side
        for n, side in zip((n_y, n_x), shape, strict=True)
    )
    k = np.hypot(np.pi * n_y / shape[0], np.pi * n_x / shape[1])
    return np.cos(y)[:, None] * np.cos(x), float(k)


@pytest.mark.parametrize("width", [0.7, 4.0, 30.0, 1000.0])
def test_high_pass_and_low_pass_add_up_to_the_image(width):
    image = random_image()
    low = low_pass(image, width)
    np.testing.assert_allclose(high_pass(image, width, keep_mean=False) + low, image, rtol=1e-14)
    np.testing.assert_allclose(high_pass(image, width) + low - image.mean(), image, rtol=1e-13)


@pytest.mark.parametrize("numbers", [(0, 4), (5, 0), (3, 7), (20, 31)])
def test_gaussian_filters_attenuate_a_wave_by_the_textbook_factor(numbers):
    image, k = wave(*numbers)
    gain = np.exp(-((2.0 * k) ** 2) / 2)
    np.testing.assert_allclose(low_pass(image, 2.0), gain * image, atol=1e-14)
    np.testing.assert_allclose(high_pass(image, 2.0), (1 - gain) * image, atol=1e-14)


@pytest.mark.parametrize("order", [1, 2, 5, 20])
@pytest.mark.parametrize("kind", ["high", "low"])
def test_butterworth_keeps_one_over_root_two_at_the_cutoff(order, kind):
    image, k = wave(6, 9)
    filtered = butterworth(image, 2 * np.pi / k, order, kind=kind)
    np.testing.assert_allclose(filtered, image / np.sqrt(2), atol=1e-12)


def test_butterworth_falls_by_its_order_per_octave():
    slow, k = wave(2, 0)
    for order in (1, 2, 3):
        gain = butterworth(slow, 2 * np.pi / (8 * k), order)[0, 0] / slow[0, 0]
        assert gain == pytest.approx((1 + 8.0 ** (2 * order)) ** -0.5, rel=1e-9)


def test_powers_of_the_two_butterworth_filters_add_up():
    image, _ = wave(3, 4)
    high = butterworth(image, 30.0, 3)[0, 0] / image[0, 0]
    low = butterworth(image, 30.0, 3, kind="low")[0, 0] / image[0, 0]
    assert high**2 + low**2 == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize("name", ["low pass", "high pass", "butterworth", "background"])
def test_flux_is_kept(name):
    image = random_image(1)
    assert FILTERS[name](image).sum() == pytest.approx(image.sum(), rel=1e-13)


def test_high_passes_without_the_mean_have_none():
    image = random_image(2)
    assert high_pass(image, 3.0, keep_mean=False).mean() == pytest.approx(0, abs=1e-14)
    assert butterworth(image, 9.0, keep_mean=False).mean() == pytest.approx(0, abs=1e-14)


def test_the_kept_mean_does_not_keep_a_dark_spot_of_a_peaked_beam_positive():
    y, x = np.mgrid[:64, :64] - 31.5
    image = 10 * np.exp(-(y**2 + x**2) / 200) + 0.01
    image[30:33, 30:33] = 0.01
    assert high_pass(image, 3.0).min() < 0
    assert remove_background(image, 0).min() > 0


@pytest.mark.parametrize("name", FILTERS)
def test_filters_ignore_units_and_leave_their_input_alone(name):
    image = random_image(3)
    original = image.copy()
    np.testing.assert_allclose(FILTERS[name](1e6 * image), 1e6 * FILTERS[name](image), rtol=1e-9)
    np.testing.assert_array_equal(image, original)


@pytest.mark.parametrize("name", FILTERS)
def test_filters_know_no_direction(name):
    image = random_image(4)
    expected = FILTERS[name](image)
    np.testing.assert_allclose(FILTERS[name](image.T).T, expected, rtol=1e-9)
    np.testing.assert_allclose(FILTERS[name](image[::-1])[::-1], expected, rtol=1e-9)


def test_a_polynomial_of_each_degree_is_fitted_exactly():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 20
    for degree in range(5):
        image = 3 + y**degree - 2 * x**degree + (y * x) ** (degree // 2)
        np.testing.assert_allclose(fit_polynomial(image, degree), image, atol=1e-9)


def test_an_object_on_a_twentieth_of_the_image_hardly_moves_the_fit():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    beam = 50 + 0.5 * x + 0.3 * y
    image = rng.normal(beam, 1.0)
    image[10:22, 30:42] *= 3
    least_squares_error = abs(_plain_fit(image) - beam).max()
    error = abs(fit_polynomial(image, 1) - beam).max()
    assert error < 0.5
    assert error < least_squares_error / 20


def _plain_fit(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    terms = np.stack([np.ones(image.size), y.ravel(), x.ravel()], axis=1)
    return (terms @ np.linalg.lstsq(terms, image.ravel(), rcond=None)[0]).reshape(image.shape)


def test_dividing_by_the_background_returns_the_modulation():
    modulation = 1 + 0.05 * wave(12, 14)[0]
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 60
    beam = 300 * (2 + x - y**2)
    flat = remove_background(beam * modulation, 2)
    np.testing.assert_allclose(flat / flat.mean(), modulation, atol=2e-3)


def test_subtracting_serves_a_potential_that_changes_sign():
    potential, _ = wave(10, 12)
    tilt = np.linspace(-3, 3, SHAPE[1])
    flat = remove_background(potential + tilt, 1, kind="subtract")
    np.testing.assert_allclose(flat, potential, atol=0.02)
    with pytest.raises(InputError, match="the kind 'subtract'"):
        remove_background(potential + tilt, 1)


def test_the_background_ignores_masked_pixels():
    image = random_image(6)
    mask = np.ones(SHAPE, dtype=bool)
    mask[5:30, 10:50] = False
    changed_image = np.where(mask, image, 1e4 * image)
    np.testing.assert_array_equal(
        fit_polynomial(image, 2, mask=mask), fit_polynomial(changed_image, 2, mask=mask)
    )


def broken(image, hot, dead, bright):
    image = image.copy()
    image[tuple(np.transpose(hot))] = bright
    image[tuple(np.transpose(dead))] = 0
    return image


HOT = [(0, 0), (1, 58), (47, 59), (0, 30), (20, 20), (20, 21), (33, 7)]
DEAD = [(47, 0), (10, 59), (25, 40), (26, 41)]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", ["gaussian", "poisson"])
def test_exactly_the_broken_pixels_are_found(noise, seed):
    rng = np.random.default_rng(seed)
    beam = np.linspace(500, 1000, SHAPE[1]) * np.ones((SHAPE[0], 1))
    sound = rng.poisson(beam).astype(float) if noise == "poisson" else rng.normal(beam, 10.0)
    image = broken(sound, HOT, DEAD, 4000)
    clean, hot, dead = remove_hot_pixels(image)
    assert set(map(tuple, np.argwhere(hot).tolist())) == set(HOT)
    assert set(map(tuple, np.argwhere(dead).tolist())) == set(DEAD)
    untouched = ~(hot | dead)
    np.testing.assert_array_equal(clean[untouched], image[untouched])
    assert abs(clean - beam)[~untouched].max() < 0.2 * beam.max()


@pytest.mark.parametrize("level", [1.0, 30.0, 1000.0])
def test_a_million_sound_pixels_raise_no_false_alarm(level):
    rng = np.random.default_rng(7)
    _, hot, dead = remove_hot_pixels(rng.normal(100 * level, level, (1000, 1000)))
    assert not hot.any()
    assert not dead.any()


def test_poisson_noise_that_grows_with_brightness_raises_no_false_alarm():
    beam = np.linspace(50, 5000, 400) * np.ones((400, 1))
    _, hot, dead = remove_hot_pixels(np.random.default_rng(8).poisson(beam))
    assert not hot.any()
    assert not dead.any()


def test_a_fault_in_the_dark_is_found_beside_noise_in_the_bright():
    rng = np.random.default_rng(9)
    beam = np.where(np.arange(100) < 50, 50.0, 10_000.0) * np.ones((100, 1))
    image = rng.poisson(beam).astype(float)
    image[40, 20] = 150  # 14 deviations of its surroundings, 1 of the bright half
    _, hot, dead = remove_hot_pixels(image)
    assert np.argwhere(hot).tolist() == [[40, 20]]
    assert not dead.any()


def test_a_caustic_is_no_row_of_hot_pixels():
    y, x = np.mgrid[:60, :60]
    fold = 100 + 3000 * np.exp(-((np.hypot(y - 30, x - 30) - 18) ** 2) / 8)
    _, hot, dead = remove_hot_pixels(np.random.default_rng(10).poisson(fold))
    assert not hot.any()
    assert not dead.any()


def test_a_larger_neighbourhood_finds_a_larger_cluster():
    image = np.random.default_rng(11).normal(100, 2, (40, 40))
    image[20:22, 10:12] = 300
    cluster = image > 200
    assert not remove_hot_pixels(image, size=3)[1].any()
    np.testing.assert_array_equal(remove_hot_pixels(image, size=5)[1], cluster)


def test_an_image_without_noise_shows_its_hot_pixel():
    image = np.full((20, 20), 7.0)
    image[4, 5] = 8.0
    clean, hot, _ = remove_hot_pixels(image)
    assert np.argwhere(hot).tolist() == [[4, 5]]
    np.testing.assert_array_equal(clean, 7.0)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full((5, 5), np.nan), "25 usable pixels that are NaN"),
        (np.ones(5), r"shape \(5,\)"),
        (np.ones((2, 5, 5)), r"shape \(2, 5, 5\)"),
        (np.ones((0, 5)), r"shape \(0, 5\)"),
        (np.ones((5, 5), dtype=complex), "complex128"),
    ],
)
def test_arrays_that_are_no_images_are_refused(name, image, words):
    with pytest.raises(InputError, match=words):
        FILTERS[name](image)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda image: low_pass(image, 0), "width is 0"),
        (lambda image: high_pass(image, np.nan), "width is nan"),
        (lambda image: butterworth(image, -3), "cutoff is -3"),
        (lambda image: butterworth(image, 2), "cutoff is 2"),
        (lambda image: butterworth(image, 3, 0), "order is 0"),
        (lambda image: butterworth(image, 3, 21), "order is 21"),
        (lambda image: butterworth(image, 3, kind="band"), "kind is 'band'"),
        (lambda image: remove_background(image, 2.5), "degree is 2.5"),
        (lambda image: remove_background(image, 11), "from 0 to 10"),
        (lambda image: remove_background(image, kind="add"), "kind is 'add'"),
        (lambda image: remove_background(image, mask=np.ones(SHAPE)), "float64, expected bool"),
        (lambda image: remove_background(image, mask=np.ones((3, 3), bool)), r"shape \(3, 3\)"),
        (
            lambda image: remove_background(image, mask=np.zeros(SHAPE, bool)),
            "mask leaves 0 of .* pixels usable",
        ),
        (lambda image: fit_polynomial(image[:2, :2], 2), "6 coefficients"),
        (lambda image: remove_hot_pixels(image, threshold=0), "threshold is 0"),
        (lambda image: remove_hot_pixels(image, size=4), "odd"),
        (lambda image: remove_hot_pixels(image, size=1), "at least 3"),
    ],
)
def test_options_that_make_no_sense_are_refused(call, words):
    with pytest.raises(InputError, match=words):
        call(random_image())


def test_a_function_with_further_keywords_receives_the_mask():
    """One that does not name it takes it, too, as ``**options``."""
    mask, received = np.ones((4, 4), bool), {}

    def record(image, **options):
        received.update(options)
        return image

    LowPassFilter(width=2.0).call(record, np.ones((4, 4)), mask=mask, should_stop=None)
    assert received == {"width": 2.0, "mask": mask, "should_stop": None}
