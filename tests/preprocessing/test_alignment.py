"""Sources that are shifted against their image."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from helpers.shifted_pair import shifted_pair
from napari_shadowinv import InputError, Instrument, invert
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import opposite_pair, toroid
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.preprocessing import measure_shift, move, register_source

SIDE = 96
Y, X = np.indices((200, 200)) / 200
SMOOTH = 100 * np.exp(-((Y - 0.45) ** 2 + (X - 0.55) ** 2) / 0.5)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.4, 0.3), (2.3, -1.6), (11.2, -7.5)])
def test_the_shift_is_right_within_its_error(shift):
    image, source = shifted_pair(shift)
    measured = measure_shift(image, source)
    assert measured.error.max() < 0.1
    assert (np.abs(measured.value - shift) < 3 * measured.error).all()
    assert measured.is_significant.any() == any(shift)
    again = measure_shift(image, move(source, measured.significant))
    assert not again.is_significant.any()


def test_masked_pixels_do_not_count():
    image, source = shifted_pair((2.3, -1.6))
    image[:20] = 5000
    mask = np.ones(image.shape, bool)
    mask[:22] = False
    measured = measure_shift(image, source, mask)
    np.testing.assert_allclose(measured.value, (2.3, -1.6), atol=0.15)


def test_noise_shows_no_shift():
    image, source = shifted_pair((2.3, -1.6), contrast=0.0)
    assert measure_shift(image, source).error.min() > 1
    assert measure_shift(image, np.ones(image.shape)).error.min() > 100
    with pytest.raises(InputError, match=r"source has shape \(120, 149\), the image \(120, 150\)"):
        measure_shift(image, source[:, 1:])


def test_a_source_of_noise_stays_and_a_mesh_below_the_noise_is_registered():
    rng = np.random.default_rng(0)
    mesh = 100 * (1 + 0.1 * np.sin(Y * 200 * np.pi / 4.5) * np.sin(X * 200 * np.pi / 4.5))
    image, source = (rng.poisson(plane).astype(float) for plane in (mesh[2:], mesh[:-2]))
    usable = np.ones(image.shape, bool)
    moved = register_source(image, source, usable, Instrument(registration=1.0))
    assert moved.source is not source
    assert moved.error < 0.1
    noise = rng.poisson(np.full(image.shape, 100.0)).astype(float)
    stays = register_source(image, noise, usable, Instrument(registration=1.0))
    assert stays.source is noise
    assert stays.error == 1.0


def test_an_object_at_the_borders_does_not_move_a_uniform_source():
    image = synthetic_image(opposite_pair((200, 200), ProtonSetup.example()).displacement)
    for seed in range(15):
        noise = 0.003 * np.random.default_rng(seed).normal(size=(2, 200, 200))
        shift = measure_shift(image + noise[0], 1 + noise[1] / 3)
        assert not shift.is_significant.any()


@pytest.mark.parametrize("peak", [97.0, 194.0])
def test_a_shift_of_a_faint_smooth_beam_is_seen_above_the_noise(peak):
    clean = synthetic_image(
        toroid(SMOOTH.shape, ProtonSetup.example(), peak, 30e-6).displacement, SMOOTH
    )
    rng = np.random.default_rng(0)
    image, source = (rng.poisson(plane).astype(float) for plane in (clean, SMOOTH))
    measured = measure_shift(image[5:], source[:-5])
    assert (np.abs(measured.value - (-5, 0)) < 3 * measured.error).all()
    assert measured.is_significant[0]
    assert not measure_shift(image, source).is_significant.any()


def test_a_beam_that_merely_differs_is_not_moved_far():
    for seed in range(1000, 1006):
        rng = np.random.default_rng(seed)
        change = gaussian_filter(rng.normal(size=SMOOTH.shape), 35)
        changed = SMOOTH * (1 + 0.005 * (change - change.mean()) / change.std())
        image, source = (rng.poisson(plane).astype(float) for plane in (changed, SMOOTH))
        assert not measure_shift(image, source).is_significant.any()


def falling_beam(y, x):
    middle = (SIDE - 1) / 2
    return np.exp(-((y - middle) ** 2 + (x - middle) ** 2) / (2 * 48.0**2))


def ring(y, x):
    """Displacement of rays that a ring drives outwards."""
    down, across = y - 46.0, x - 49.0
    radius = np.hypot(down, across) + 1e-9
    size = 3.0 * np.exp(-0.5 * ((radius - 20) / 6) ** 2) * np.tanh(radius / 2) / radius
    return size * down, size * across


def pair(shift, seed):
    """Count rays of a beam that falls off, with a ring, and of a reference that lies elsewhere."""
    rng = np.random.default_rng(seed)
    places = (np.arange(-48, (SIDE + 12) * 4) + 0.5) / 4 - 0.5
    y, x = np.meshgrid(places, places, indexing="ij")
    down, across = ring(y, x)
    ends = [(along + 0.5).ravel() for along in (y + down, x + across)]
    image, *_ = np.histogram2d(
        *ends, SIDE, [[0, SIDE], [0, SIDE]], weights=falling_beam(y, x).ravel() / 16
    )
    pixels = np.indices((SIDE, SIDE), dtype=float)
    source = falling_beam(pixels[0] - shift[0], pixels[1] - shift[1])
    return rng.poisson(3000 * image).astype(float), rng.poisson(12000 * source).astype(float)


def error_of(inversion):
    pixels = np.indices((SIDE, SIDE), dtype=float)
    truth = np.array(ring(*pixels))
    return float(np.linalg.norm(inversion.displacement - truth) / np.linalg.norm(truth))


def test_a_reference_out_of_register_is_moved_and_what_is_left_is_an_error():
    image, source = pair((2.0, -1.0), seed=1)
    stated_in_place = invert(image, source=source, instrument=Instrument(registration=0))
    assert error_of(stated_in_place) > 0.4
    inversion = invert(image, source=source)
    assert error_of(inversion) < 2 * inversion.errors.share < 0.4
    assert "register" in [caution.code for caution in inversion.report.cautions]
    assert any(name.startswith("registration") for name in inversion.errors.parts)


def test_a_reference_in_place_stays_and_a_shift_that_cannot_be_seen_is_an_error():
    image, source = pair((0.0, 0.0), seed=2)
    usable = np.ones(image.shape, bool)
    kept = register_source(image, source, usable, Instrument())
    assert kept.source is source
    assert kept.caution is None
    faint = 12000 + 0.001 * source
    assert register_source(image, faint, usable, Instrument()).error == pytest.approx(0.2, rel=0.1)
    stated = register_source(image, faint, usable, Instrument(registration=1.0))
    assert stated.error == pytest.approx(1.0, rel=0.3)
