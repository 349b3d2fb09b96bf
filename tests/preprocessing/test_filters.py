from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    ButterworthFilter,
    HighPassFilter,
    HotPixelFilter,
    LowPassEstimate,
    LowPassFilter,
    PolynomialEstimate,
    Rotate,
    pixels,
)

SHAPE = (48, 60)
FILTERS = {
    "low pass": LowPassFilter(width=3).filter_image,
    "high pass": HighPassFilter(width=3).filter_image,
    "butterworth": ButterworthFilter(cutoff=12).filter_image,
    "background": BackgroundFilter(degree=1).filter_image,
    "hot pixels": HotPixelFilter().filter_image,
}


def random_image(seed=0, shape=SHAPE):
    return np.random.default_rng(seed).uniform(1, 5, shape)


ANY = random_image()


def wave(n_y, n_x, shape=SHAPE):
    """A wave that fits the mirrored image, and its wave number in rad/px."""
    y, x = (
        np.pi * n * (np.arange(side) + 0.5) / side
        for n, side in zip((n_y, n_x), shape, strict=True)
    )
    k = np.hypot(np.pi * n_y / shape[0], np.pi * n_x / shape[1])
    return np.cos(y)[:, None] * np.cos(x), float(k)


@pytest.mark.parametrize("numbers", [(0, 4), (5, 0), (3, 7), (20, 31)])
def test_gaussian_filters_attenuate_a_wave_by_the_textbook_factor(numbers):
    image, k = wave(*numbers)
    gain = np.exp(-((2.0 * k) ** 2) / 2)
    np.testing.assert_allclose(
        LowPassFilter(width=2.0).filter_image(image), gain * image, atol=1e-14
    )
    np.testing.assert_allclose(
        HighPassFilter(width=2.0).filter_image(image), (1 - gain) * image, atol=1e-14
    )


@pytest.mark.parametrize("order", [1, 2, 5, 20])
@pytest.mark.parametrize("kind", ["high", "low"])
def test_butterworth_keeps_one_over_root_two_at_the_cutoff(order, kind):
    image, k = wave(6, 9)
    filtered = ButterworthFilter(cutoff=2 * np.pi / k, order=order, kind=kind).filter_image(image)
    np.testing.assert_allclose(filtered, image / np.sqrt(2), atol=1e-12)


def test_butterworth_falls_by_its_order_per_octave():
    slow, k = wave(2, 0)
    for order in (1, 2, 3):
        gain = (
            ButterworthFilter(cutoff=2 * np.pi / (8 * k), order=order).filter_image(slow)[0, 0]
            / slow[0, 0]
        )
        assert gain == pytest.approx((1 + 8.0 ** (2 * order)) ** -0.5, rel=1e-9)


@pytest.mark.parametrize("name", ["low pass", "high pass", "butterworth", "background"])
def test_flux_is_kept(name):
    image = random_image(1)
    assert FILTERS[name](image).sum() == pytest.approx(image.sum(), rel=1e-13)


def test_the_kept_mean_does_not_keep_a_dark_spot_of_a_peaked_beam_positive():
    y, x = np.mgrid[:64, :64] - 31.5
    image = 10 * np.exp(-(y**2 + x**2) / 200) + 0.01
    image[30:33, 30:33] = 0.01
    assert HighPassFilter(width=3.0).filter_image(image).min() < 0
    assert BackgroundFilter(degree=0).filter_image(image).min() > 0


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


def fit_polynomial(image, degree, mask=None):
    usable = np.ones(image.shape, bool) if mask is None else mask
    return pixels.fit_polynomial(image, usable, degree, Reporter())


def remove_hot_pixels(image):
    """The image after the filter, and its hot and its dead pixels."""
    clean = HotPixelFilter().filter_image(image)
    return clean, clean < image, clean > image


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
    flat = BackgroundFilter(degree=2).filter_image(beam * modulation)
    np.testing.assert_allclose(flat / flat.mean(), modulation, atol=2e-3)


def test_subtracting_serves_a_potential_that_changes_sign():
    potential, _ = wave(10, 12)
    tilt = np.linspace(-3, 3, SHAPE[1])
    flat = BackgroundFilter(degree=1, kind="subtract").filter_image(potential + tilt)
    np.testing.assert_allclose(flat, potential, atol=0.02)
    with pytest.raises(InputError, match="the kind 'subtract'"):
        BackgroundFilter(degree=1).filter_image(potential + tilt)


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


def test_a_million_sound_pixels_raise_no_false_alarm():
    rng = np.random.default_rng(7)
    _, hot, dead = remove_hot_pixels(rng.normal(3000, 30, (1000, 1000)))
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


WRONG_VALUES = [
    (LowPassFilter, {"width": 0}), (HighPassFilter, {"width": np.nan}),
    (ButterworthFilter, {"cutoff": -3}), (ButterworthFilter, {"cutoff": 2}),
    (ButterworthFilter, {"order": 0}), (ButterworthFilter, {"order": 21}),
    (ButterworthFilter, {"kind": "band"}), (BackgroundFilter, {"degree": 2.5}),
    (BackgroundFilter, {"degree": 11}), (BackgroundFilter, {"kind": "add"}),
    (HotPixelFilter, {"threshold": 0}), (Rotate, {"angle": 17}),
    (PolynomialEstimate, {"degree": -1}), (LowPassEstimate, {"width": 0}),
]  # fmt: skip


@pytest.mark.parametrize(("choice", "values"), WRONG_VALUES)
def test_values_out_of_range_are_refused(choice, values):
    ((name, value),) = values.items()
    with pytest.raises(InputError, match=f"'{name}' is {value!r}"):
        choice(**values)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: BackgroundFilter().filter_image(ANY, np.ones(SHAPE)), "float64, expected bool"),
        (lambda: BackgroundFilter().filter_image(ANY, np.ones((3, 3), bool)), r"shape \(3, 3\)"),
        (
            lambda: BackgroundFilter().filter_image(ANY, np.zeros(SHAPE, bool)),
            "mask leaves 0 of .* pixels usable",
        ),
        (lambda: fit_polynomial(ANY[:2, :2], 2), "6 coefficients"),
    ],
)
def test_masks_and_numbers_that_make_no_sense_are_refused(call, words):
    with pytest.raises(InputError, match=words):
        call()
