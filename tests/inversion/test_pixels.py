"""Inversions with a site in each pixel and slopes inside the pixels."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from napari_shadowinv.analysis._field_samples import sampled_fields
from napari_shadowinv.inversion import invert, plan_sites
from napari_shadowinv.options import InversionOptions
from napari_shadowinv.physics import phantoms
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.poisson import counting_error
from napari_shadowinv.physics.setup import ProtonSetup

SHAPE = (24, 60)
EXACT = InversionOptions(accuracy=0.001)


def wave(x):
    """A displacement along x that is zero at the borders, -0.5 and 59.5."""
    share = (x + 0.5) / SHAPE[1]
    return 5 * np.sin(np.pi * share) ** 2 * np.sin(2 * np.pi * share)


def beam(x):
    """The flux of a beam up to x."""
    return x + 0.4 * SHAPE[1] / (2 * np.pi) * np.sin(2 * np.pi * (x + 0.5) / SHAPE[1])


def shot(flux=lambda x: x):
    """Exact source and image of rays that move by `wave`, one after the other in each row."""
    borders = np.arange(SHAPE[1] + 1) - 0.5
    starts = [brentq(lambda x, end=end: x + wave(x) - end, -1, SHAPE[1]) for end in borders]
    rows = np.diff(flux(borders)), np.diff(flux(np.array(starts)))
    return [np.tile(row, (SHAPE[0], 1)) for row in rows]


def error(inversion):
    truth = np.tile(wave(np.arange(SHAPE[1])), (SHAPE[0], 1))
    return np.hypot(inversion.displacement[0], inversion.displacement[1] - truth).max() / 5


@pytest.mark.parametrize("flux", [lambda x: x, beam])
def test_a_field_known_exactly_is_found_at_the_middles_of_pixels(flux):
    source, image = shot(flux)
    inversion = invert(image, source=source, options=EXACT)
    assert inversion.cells.are_pixels
    constant = invert(image, source=source, options=InversionOptions(n_sites=4 * image.size))
    assert error(inversion) < 0.004
    assert error(inversion) < error(constant) / 3


def test_a_smooth_beam_that_is_not_deflected_gives_no_field():
    source, _ = shot(beam)
    image = 2 * source * (1 + 1e-5 * np.random.default_rng(0).uniform(-1, 1, SHAPE))
    options = EXACT.model_copy(update={"tolerance": 1e-7})
    inversion = invert(image, source=source, options=options, instrument={"beam_rms": 0})
    assert np.abs(inversion.displacement).max() < 1e-4


def test_the_error_falls_at_least_with_the_square_of_the_pixel():
    def landing(start):
        return start + 0.08 * np.sin(np.pi * start) ** 2 * np.sin(2 * np.pi * start)

    def off(pixels):
        borders, middles = np.arange(pixels + 1) / pixels, (np.arange(pixels) + 0.5) / pixels
        starts = [brentq(lambda x, end=end: landing(x) - end, -0.1, 1.1) for end in borders]
        image = np.tile(pixels * np.diff(starts), (16, 1))
        options = InversionOptions(accuracy=1e-4, tolerance=1e-6)
        inversion = invert(image, options=options)
        assert inversion.cells.are_pixels
        return np.abs(inversion.displacement[1] / pixels + middles - landing(middles)).max()

    assert off(128) < off(64) / 4


def test_a_beam_that_jumps_keeps_sites_as_dense_as_it_is_bright():
    source, image = shot()
    source[:, ::2] *= 0.5
    assert plan_sites(source).pixels is None
    assert not invert(image, source=source, options=EXACT).cells.are_pixels


def test_noise_that_hides_the_slopes_keeps_pixels_constant():
    _, image = shot()
    noisy = image + 0.3 * np.random.default_rng(0).normal(size=SHAPE)
    options = InversionOptions(negative="clip")
    assert not invert(noisy, options=options).cells.are_pixels


@pytest.mark.parametrize(
    ("make", "size"), [(phantoms.toroid, 97.0), (phantoms.cosine_toroid, 40.0)]
)
def test_the_error_stated_is_within_twice_the_true_one(make, size):
    """Within a factor of two, for a smooth field and for one with a kink at its rim."""
    setup = ProtonSetup.example()
    setup = setup.model_copy(update={"pixel_size": 2 * setup.pixel_size})
    truth = make((100, 100), setup, size, 30e-6).displacement
    image = synthetic_image(truth)
    inversion = invert(image, source=np.ones(image.shape), options=EXACT)
    assert inversion.cells.are_pixels
    true_error = np.sqrt(((inversion.displacement - truth) ** 2).sum(axis=0).mean())
    assert 0.5 < true_error / inversion.errors.discretisation.rms < 2


def test_the_limit_by_counts_is_the_scatter_of_inversions():
    """The scatter of inversions of all pixels, by independent counts of a weak object."""
    blob, counts = phantoms.gaussian_blob((48, 48), 4.0, 7.0), 2000.0
    rng, image = np.random.default_rng(1), synthetic_image(blob.displacement)
    options = InversionOptions(accuracy=1e-9, noise_level=1e-9)
    shots = [rng.poisson(counts * image) / counts for _ in range(20)]
    inversions = [invert(shot, source=np.ones(shot.shape), options=options) for shot in shots]
    assert inversions[0].cells.are_pixels
    scatter = np.std([inversion.displacement for inversion in inversions], axis=0, ddof=1)
    noise_error = np.sqrt((scatter**2).sum(axis=0).mean())
    assert noise_error == pytest.approx(counting_error((48, 48), counts), rel=0.08)
    limit = invert(shots[0], source=np.ones(image.shape)).errors.by_counts.rms
    assert limit == pytest.approx(noise_error, rel=0.15)


def test_products_take_the_field_as_it_is():
    _, image = shot()
    inversion = invert(image, options=EXACT)
    (field,) = sampled_fields(inversion, None, None, None)
    fields = inversion.potential, inversion.displacement
    for points in (field.at_points(*fields), field.within_pixels()):
        for values, expected in zip(points, fields, strict=True):
            np.testing.assert_array_equal(values, expected)


def test_a_similar_shot_starts_from_the_cells_of_pixels():
    source, image = shot()
    before = invert(image, source=source, options=EXACT)
    again = invert(image, source=source, options=EXACT, start=before)
    assert again.report.iterations == 0
    np.testing.assert_allclose(again.displacement, before.displacement, atol=1e-9)
