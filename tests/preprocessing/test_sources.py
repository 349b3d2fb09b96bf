from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv._system.progress import Reporter
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.inversion import invert
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.preprocessing import (
    BackgroundFilter,
    GaussianEstimate,
    HotPixelFilter,
    IsotropicEstimate,
    LowPassEstimate,
    PolynomialEstimate,
    UniformEstimate,
    uniform_cautions,
)
from napari_shadowinv.preprocessing.estimates import point_distance
from napari_shadowinv.preprocessing.pixels import with_filled_part

SHAPE = (48, 60)
# 200 px from the source to the detector.
NEAR = ProtonSetup.example().model_copy(update={"pixel_size": 6.5e-6})
SOURCES = {
    "uniform": UniformEstimate().source,
    "gaussian": GaussianEstimate().source,
    "polynomial": PolynomialEstimate().source,
    "low pass": LowPassEstimate(width=6).source,
}
ALL = pytest.mark.parametrize("estimate", SOURCES.values(), ids=SOURCES.keys())


def gaussian_beam(shape=SHAPE, *, centre=(0.45, 0.55), widths=(0.3, 0.4), tilt=0.3, constant=0.0):
    y, x = (np.arange(side) - share * side for side, share in zip(shape, centre, strict=True))
    y, x = y[:, None] / (widths[0] * shape[0]), x / (widths[1] * shape[1])
    return 1000 * np.exp(-0.5 * (y**2 + x**2 + tilt * x * y)) + constant


def ripples(shape, amplitude):
    """Modulation without a mean, too fine to be taken for the beam."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return 1 + amplitude * np.cos(2 * np.pi * y / 8) * np.cos(2 * np.pi * x / 10)


@pytest.fixture
def shot():
    return np.random.default_rng(0).poisson(gaussian_beam() * ripples(SHAPE, 0.2) / 5)


@pytest.fixture
def mask():
    mask = np.ones(SHAPE, dtype=bool)
    mask[15:27, 20:35] = False
    mask[40:, :5] = False
    return mask


@ALL
def test_flux_is_kept_and_the_beam_is_positive(estimate, shot):
    beam = estimate(shot)
    assert beam.shape == shot.shape
    assert beam.sum() == pytest.approx(shot.sum(), rel=1e-12)
    assert beam.min() > 0


@ALL
def test_masked_pixels_may_hold_anything(estimate, shot, mask):
    expected = estimate(shot, mask=mask)
    assert expected[mask].sum() == pytest.approx(shot[mask].sum(), rel=1e-12)
    assert expected.min() > 0
    for junk in (np.nan, np.inf, -1e9, 1e9):
        changed = np.where(mask, shot, junk)
        np.testing.assert_array_equal(estimate(changed, mask=mask), expected)


@ALL
def test_the_answer_scales_with_the_units(estimate, shot):
    for unit in (1e-9, 1e9):
        np.testing.assert_allclose(estimate(unit * shot), unit * estimate(shot), rtol=1e-5)


@ALL
def test_noise_below_zero_does_not_make_a_beam_negative(estimate):
    shot = np.random.default_rng(1).normal(gaussian_beam(widths=(0.08, 0.1)), 20.0)
    assert shot.min() < 0
    beam = estimate(shot)
    assert beam.min() > 0
    assert beam.sum() == pytest.approx(shot.sum(), rel=1e-12)


@ALL
def test_a_flat_image_is_its_own_source(estimate, mask):
    np.testing.assert_allclose(estimate(np.full(SHAPE, 7.0), mask=mask), 7.0, rtol=1e-3)


@ALL
def test_the_input_is_left_alone(estimate, shot, mask):
    shot_copy, mask_copy = shot.copy(), mask.copy()
    estimate(shot, mask=mask)
    np.testing.assert_array_equal(shot, shot_copy)
    np.testing.assert_array_equal(mask, mask_copy)


@pytest.mark.parametrize("amplitude", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("constant", [0.0, 100.0])
def test_a_modulated_gaussian_beam_is_found_within_a_percent(amplitude, constant):
    beam = gaussian_beam((80, 100), constant=constant)
    source = GaussianEstimate().source(beam * ripples(beam.shape, amplitude))
    np.testing.assert_allclose(source, beam, rtol=0.01)


def test_the_gaussian_beam_is_found_behind_a_mask_and_off_the_image():
    beam = gaussian_beam((60, 80), centre=(-0.05, 0.9), widths=(0.6, 0.5))
    mask = np.ones(beam.shape, dtype=bool)
    mask[20:45, 25:60] = False
    np.testing.assert_allclose(GaussianEstimate().source(beam, mask), beam, rtol=1e-3)


def test_a_large_image_gives_the_gaussian_of_a_small_one():
    beam = gaussian_beam((601, 807), constant=50.0)
    np.testing.assert_allclose(GaussianEstimate().source(beam), beam, rtol=1e-3)


def test_a_ramp_is_a_polynomial_that_is_held_at_the_floor():
    ramp = 5 + np.add.outer(0.1 * np.arange(SHAPE[0]), -0.05 * np.arange(SHAPE[1]))
    np.testing.assert_allclose(PolynomialEstimate(degree=1).source(ramp), ramp, rtol=1e-12)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spot = 100 * np.exp(-((y - 10) ** 2 + (x - 10) ** 2) / 100)
    beam = PolynomialEstimate(degree=1).source(spot)
    assert 0 < beam.min() < 2e-3 * beam.mean()


def test_blurring_weighs_by_the_gaussian():
    impulse = np.full(SHAPE, 1.0)
    impulse[20, 30] += 1000
    beam = LowPassEstimate(width=3.0).source(impulse) - 1
    assert beam[20, 33] / beam[20, 30] == pytest.approx(np.exp(-0.5), rel=1e-3)


def test_blurring_under_a_mask_keeps_a_flat_beam_flat_far_from_any_usable_pixel():
    mask = np.zeros((60, 200), dtype=bool)
    mask[:, :10] = True
    np.testing.assert_allclose(
        LowPassEstimate(width=2.0).source(np.full(mask.shape, 3.0), mask), 3.0
    )


def gap(shape, radius):
    y, x = (np.arange(side) - 0.5 * side for side in shape)
    return np.hypot(y[:, None], x) > radius


@pytest.mark.parametrize(
    ("beam", "radius", "tolerance"),
    [
        (gaussian_beam((97, 131)), 14, 0.03),
        (5 + np.add.outer(0.1 * np.arange(64), 0.05 * np.arange(80)), 10, 5e-3),
    ],
)
def test_filled_in_pixels_continue_slope_and_curvature(beam, radius, tolerance):
    mask = gap(beam.shape, radius)
    filled = with_filled_part(np.where(mask, beam, 0), mask, Reporter())
    np.testing.assert_allclose(filled[mask], np.maximum(beam, 1e-3 * beam.mean())[mask], rtol=1e-2)
    assert abs(filled / beam - 1)[~mask].max() < tolerance


def error_of(inversion, truth):
    """Root mean square displacement error over that of the truth, where the beam is bright."""
    bright = inversion.source > 0.2 * inversion.source.max()
    miss = inversion.displacement - truth
    return float(np.sqrt((miss[:, bright] ** 2).mean() / (truth[:, bright] ** 2).mean()))


def test_a_gaussian_source_makes_the_inversion_right_where_a_uniform_one_makes_it_wrong():
    """Measured: displacement errors of 0.12 and 6.2 of the truth; 0.05 with the true beam."""
    shape = (72, 90)
    beam = gaussian_beam(shape, constant=40.0)
    truth = gaussian_blob(shape, 40.0, 5.0, (30.0, 50.0)).displacement
    shot = np.random.default_rng(3).poisson(synthetic_image(truth, beam))
    options = InversionOptions(n_sites=4000)
    errors = {
        name: error_of(invert(shot, source=SOURCES[name](shot), options=options), truth)
        for name in ("gaussian", "uniform")
    }
    assert errors["gaussian"] < 0.15
    assert errors["uniform"] > 40 * errors["gaussian"]


@ALL
@pytest.mark.parametrize(
    ("image", "mask", "words"),
    [
        (np.full((5, 5), np.nan), None, "25 usable pixels that are NaN"),
        (np.ones(5), None, r"shape \(5,\)"),
        (np.ones((5, 5, 3)), None, r"shape \(5, 5, 3\)"),
        (np.zeros((5, 5)), None, "flux of 0"),
        (np.full((5, 5), -1.0), None, "flux of -25"),
        (np.ones(SHAPE), np.ones((5, 6), bool), r"mask has shape \(5, 6\), image \(48, 60\)"),
        (np.ones(SHAPE), np.zeros(SHAPE, bool), "mask leaves 0 of .* pixels usable"),
        (np.ones(SHAPE), np.ones(SHAPE), "float64, expected booleans"),
    ],
)
def test_images_without_a_beam_and_wrong_masks_are_refused(estimate, image, mask, words):
    with pytest.raises(InputError, match=words):
        estimate(image, mask=mask)


class Stop:
    """Asks to stop at a certain look; counts the looks."""

    def __init__(self, at: float = np.inf) -> None:
        self.at, self.looks = at, 0

    def __call__(self) -> bool:
        self.looks += 1
        return self.looks >= self.at


# The looks are those of each iteration, row of squares, or degree of a polynomial.
@pytest.mark.parametrize(
    ("work", "min_looks"),
    [
        (lambda image, _, stop: GaussianEstimate().source(image, None, stop), 8),
        (lambda image, _, stop: PolynomialEstimate(degree=10).source(image, None, stop), 5),
        (LowPassEstimate(width=200).source, 2),
        (lambda image, _, stop: BackgroundFilter(degree=10).filter_image(image, None, stop), 5),
        (lambda image, _, stop: HotPixelFilter().filter_image(image, None, stop), 4),
    ],
    ids=["gaussian", "polynomial", "low pass", "background", "hot pixels"],
)  # fmt: skip
def test_work_ends_at_the_look_that_asks_to_stop(work, min_looks):
    shape = (128, 128)
    rng = np.random.default_rng(0)
    image = gaussian_beam(shape, constant=200.0) * ripples(shape, 0.3) + rng.normal(0, 5, shape)
    never = Stop()
    work(image, gap(shape, 25), never)
    assert never.looks >= min_looks
    for at in {1, never.looks // 2, never.looks}:
        stop = Stop(at)
        with pytest.raises(InversionCancelled):
            work(image, gap(shape, 25), stop)
        assert stop.looks == at


def isotropic_beam(shape, setup, matrix=None):
    return IsotropicEstimate().adapt_to(setup, shape, matrix).source(np.ones(shape))


def test_the_isotropic_source_equals_rays_in_all_directions():
    shape, centre, rays = (60, 90), (35.0, 20.0), 2_000_000
    shift = [(side - 1) / 2 - place for side, place in zip(shape, centre, strict=True)]
    beam = isotropic_beam(shape, NEAR, np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]]))
    assert beam.max() > 1.15 * beam.min()
    rng = np.random.default_rng(0)
    cosine = rng.uniform(0.9, 1, rays)  # the corner is 21 degrees from the axis
    off_axis = point_distance(NEAR) * np.sqrt(1 / cosine**2 - 1)
    angle = rng.uniform(0, 2 * np.pi, rays)
    y, x = centre[0] + off_axis * np.sin(angle), centre[1] + off_axis * np.cos(angle)
    edges = [np.arange(-0.5, side) for side in shape]
    counts = np.histogram2d(y, x, edges)[0]
    expected = beam * counts.sum() / beam.sum()
    # The deviation of this number is 0.02 where the counts are Poisson's.
    assert ((counts - expected) ** 2 / expected).mean() == pytest.approx(1, abs=0.06)
    assert ((counts - counts.mean()) ** 2 / counts.mean()).mean() > 1.15


@pytest.mark.parametrize("pixels_to_the_point", [50.0, 1e4, 1e6])
def test_an_isotropic_beam_is_the_mean_of_the_fluence_over_each_pixel(pixels_to_the_point):
    setup = NEAR.model_copy(
        update={"pixel_size": NEAR.source_object_distance / pixels_to_the_point}
    )
    source = isotropic_beam((30, 40), setup)
    places, shares = np.polynomial.legendre.leggauss(4)
    y, x = (((np.arange(side) - (side - 1) / 2)[:, None] + places / 2).ravel() for side in (30, 40))
    fluence = (1 + (y[:, None] ** 2 + x**2) / pixels_to_the_point**2) ** -1.5
    expected = np.einsum("iajb,a,b", fluence.reshape(30, 4, 40, 4), shares, shares)
    np.testing.assert_allclose(source, expected / expected.mean(), rtol=1e-8)


def test_the_flux_of_an_isotropic_beam_is_that_of_the_pixels_that_are_seen(shot, mask):
    beam = IsotropicEstimate().adapt_to(NEAR, SHAPE).source(np.where(mask, shot, np.nan), mask)
    assert beam[mask].sum() == pytest.approx(shot[mask].sum(), rel=1e-12)


def test_a_point_source_makes_a_weak_object_wrong_unless_it_is_taken_for_one():
    """Measured: displacement errors of 0.34 and 0.01."""
    shape = (60, 60)
    truth = gaussian_blob(shape, 20.0, 9.0).displacement
    shot = synthetic_image(truth, isotropic_beam(shape, NEAR))
    options = InversionOptions(n_sites=2000)
    miss = [
        invert(shot, source=source, options=options).displacement - truth
        for source in (None, IsotropicEstimate().adapt_to(NEAR, shot.shape).source(shot))
    ]
    uniform, isotropic = (float(np.sqrt((d**2).mean() / (truth**2).mean())) for d in miss)
    assert uniform > 0.2
    assert isotropic < 0.02


def test_a_wide_image_of_a_point_source_is_warned_of():
    """The fluence in the corner, r from the middle, falls by 1.5 (r / distance)² if little."""
    for side, warned in ((22, False), (26, True)):  # by 0.8 and 1.2 %
        cautions = uniform_cautions(NEAR, (side, side), (side, side), np.eye(3))
        assert bool(cautions) == warned
    assert "'isotropic'" in cautions[0].text
    # A part of an image, far from the axis.
    beside = np.array([[1.0, 0, -90], [0, 1, 0], [0, 0, 1]])
    assert uniform_cautions(NEAR, (20, 20), (20, 20), beside)
    assert not uniform_cautions(NEAR, (20, 20), (20, 20), np.eye(3))
    assert uniform_cautions(None, (500, 500), (500, 500), np.eye(3)) == ()
    collimated = NEAR.model_copy(update={"source_object_distance": np.inf})
    assert uniform_cautions(collimated, (500, 500), (500, 500), np.eye(3)) == ()


@pytest.fixture(scope="module")
def hidden_middle():
    """A flat beam whose object's rim alone is seen: a Gaussian in the gap fits it best."""
    shape = (100, 100)
    y, x = np.mgrid[:100, :100]
    mask = np.hypot(y - 49.5, x - 49.5) > 36
    return synthetic_image(gaussian_blob(shape, 75.0, 7.5).displacement), mask


def test_a_gaussian_that_hides_behind_the_mask_is_refused(hidden_middle):
    with pytest.raises(InputError, match="under the mask, while the image is"):
        GaussianEstimate().source(*hidden_middle)


def test_a_gaussian_that_rises_behind_the_mask_is_reported():
    beam = gaussian_beam((60, 80), centre=(0.5, 0.5), widths=(0.2, 0.2))
    y, x = np.mgrid[:60, :80]
    cautions = []
    for radius in (5, 18):
        mask = np.hypot(y - 30, x - 40) > radius
        source = GaussianEstimate().source(beam, mask, on_caution=cautions.append)
        np.testing.assert_allclose(source, beam, rtol=1e-2, atol=2)
    assert len(cautions) == 1
    assert "rises to" in cautions[0].text


def test_an_estimate_that_runs_away_behind_the_mask_is_refused():
    shot = np.tile(np.exp(np.arange(60) / 8), (60, 1))
    mask = np.ones(shot.shape, bool)
    mask[:, 25:] = False
    with pytest.raises(InputError, match="under the mask, while the image is"):
        PolynomialEstimate(degree=6).source(shot, mask)
    brightest = shot[mask].max()
    assert 1.5 * brightest < PolynomialEstimate(degree=1).source(shot, mask).max() < 10 * brightest
