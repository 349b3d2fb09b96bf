"""Rays through spline potentials against an independent forward model and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting._ray_kernels import KNOT
from napari_shadowinv.fitting.descent import between_knots
from napari_shadowinv.fitting.rays import Pulls, RayModel, TracedBeam, at_rest
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.physics.forward import synthetic_image

SIZE = (40, 54)
WEAK, FOLDED = 8.0, 60.0


def model_of(
    size: tuple[int, int] = SIZE, *, spacing: float = 0.25, threads: int | None = None
) -> RayModel:
    return RayModel(size, pad=8, spacing=spacing, threads=threads)


def places(model: RayModel) -> tuple[FloatArray, FloatArray]:
    """Middles of the coefficients' splines, px from the middle of the first pixel."""
    y, x = (KNOT * (np.arange(n) - 1.0) - model.pad - 0.5 for n in model.shape)
    return tuple(np.meshgrid(y, x, indexing="ij"))  # type: ignore[return-value]


def wavy(model: RayModel, strength: float) -> FloatArray:
    """A smooth potential that fades at the edge."""
    y, x = places(model)
    bump = np.exp(-((y - 18) ** 2 + (x - 27) ** 2) / 2 / 7**2)
    return np.asarray(strength * bump * np.cos((y + 2 * x) / 9))


def uneven() -> FloatArray:
    y, x = np.indices(SIZE)
    return np.asarray(1 + 0.3 * np.cos(y / 9) * np.sin(x / 11))


def turned() -> FloatArray:
    """A frame that shifts, turns and stretches by little."""
    return np.array([0.3, 1.01, -0.02, -0.7, 0.03, 0.98])


def flat(pulls: Pulls) -> FloatArray:
    return np.concatenate([part.ravel() for part in pulls])


def test_a_beam_meets_nothing_and_stays_as_it_is() -> None:
    """But for the eighth that a pixel shares of the rays nearest to an edge of its."""
    model, beam = model_of(spacing=0.25), uneven()
    still = np.zeros(model.shape)
    counts = model.ray_counts(still)
    flat = model.image(TracedBeam(still, counts, model.around(np.ones(SIZE))))
    np.testing.assert_allclose(flat, 1, rtol=1e-12)
    image = model.image(TracedBeam(still, counts, model.around(beam)))
    shared = model.around(beam)
    for axis in (0, 1):
        before, after = np.roll(shared, 1, axis), np.roll(shared, -1, axis)
        shared = shared + 0.25 / 8 * (before - 2 * shared + after)
    inside = slice(model.pad, -model.pad)
    np.testing.assert_allclose(image, shared[inside, inside], rtol=1e-12)


@pytest.mark.parametrize("spacing", [1 / 3, 0.25, 0.2, 0.14, 0.1])
@pytest.mark.parametrize("stretch", [0.7, 0.93, 1.0, 1.05, 1.5, 2.6])
def test_rays_do_not_ripple(spacing: float, stretch: float) -> None:
    """Where they stretch a beam evenly and carry it along, its image stays even.

    Else data would seem to tell where a beam has been carried, and error bars would be too small.
    """
    model = RayModel((24, 24), pad=40, spacing=spacing, threads=1)
    place = KNOT * (np.arange(model.shape[1]) - 1.0) - model.pad - 12
    beam = np.ones([KNOT * n for n in model.cells])
    images, changes = [], []
    further = np.concatenate([np.tile(place, model.shape[0]), np.zeros(beam.size + 6)])
    for shift in np.linspace(0.01, 0.4, 9):
        line = shift * place + (1 - stretch) / 2 * place**2
        potential = np.tile(line, (model.shape[0], 1))
        counts = model.ray_counts(potential)
        image = stretch * model.image(TracedBeam(potential, counts, beam))
        change = stretch * (model.jacobian(TracedBeam(potential, counts, beam)) @ further)
        change = change.reshape(image.shape)
        images.append(image[6:-6, 6:-6])
        changes.append(change[6:-6, 6:-6])
    np.testing.assert_allclose(images, 1, atol=4e-3)
    assert np.std(images) < 6e-4
    assert np.std(changes) < 0.022  # per px


def test_around_continues_the_edge_and_keeps_the_image() -> None:
    model, beam = model_of(), uneven()
    around = model.around(beam)
    assert around.shape == tuple(KNOT * n for n in model.cells)
    np.testing.assert_array_equal(around[8:48, 8:62], beam)
    np.testing.assert_array_equal(around[0, 8:62], beam[0])
    np.testing.assert_array_equal(around[8:48, -1], beam[:, -1])


def test_flux_is_conserved_where_nothing_reaches_the_edge() -> None:
    model = model_of()
    y, x = places(model)
    inside = np.maximum(1 - ((y - 20) / 14) ** 2 - ((x - 26) / 18) ** 2, 0)
    potential = 15 * inside**3 * np.cos(y / 2)
    image = model.image(
        TracedBeam(potential, model.ray_counts(potential), model.around(np.ones(SIZE)))
    )
    assert image.max() > 2
    assert image.sum() == pytest.approx(image.size, rel=1e-12)


@pytest.mark.parametrize("curvature", [0.1, -0.3, 2.2])
def test_a_lens_magnifies_also_beyond_its_focus(curvature: float) -> None:
    """Splines hold a paraboloid exactly; behind it the beam is 1 / (1 - curvature)² as bright."""
    model = RayModel((24, 24), 40, spacing=0.05)
    y, x = places(model)
    bowl = curvature * ((y - 11.5) ** 2 + (x - 11.5) ** 2) / 2
    image = model.image(TracedBeam(bowl, model.ray_counts(bowl), model.around(np.ones((24, 24)))))
    np.testing.assert_allclose(image, (1 - curvature) ** -2, rtol=0.01)
    assert image.mean() == pytest.approx((1 - curvature) ** -2, rel=1e-3)
    offset = np.indices((24, 24)) - 11.5
    np.testing.assert_allclose(model.displacement(bowl), -curvature * offset, atol=1e-12)


@pytest.mark.parametrize(("strength", "tolerance"), [(WEAK, 0.01), (FOLDED, 0.08)])
def test_it_agrees_with_the_exact_deposit_of_triangles_also_where_rays_cross(
    strength: float, tolerance: float
) -> None:
    model, beam = model_of(spacing=0.1), uneven()
    potential = wavy(model, strength)
    image = model.image(TracedBeam(potential, model.ray_counts(potential), model.around(beam)))
    expected = synthetic_image(model.displacement(potential), beam, rays_per_pixel=64)
    assert (expected.max() > 4) == (strength == FOLDED)
    difference = (image - expected)[2:-2, 2:-2]
    assert np.sqrt((difference**2).mean()) < tolerance


def test_rays_that_start_beyond_the_edge_arrive() -> None:
    """A uniform shift brings the strip's flux into the image."""
    model = model_of()
    beam = np.zeros(tuple(KNOT * n for n in model.cells))
    beam[:8] = 3.0
    y, _ = places(model)
    image = model.image(TracedBeam(-5 * y, model.ray_counts(y), beam))
    np.testing.assert_allclose(image[:4], 3, rtol=1e-12)
    np.testing.assert_allclose(image[6:], 0, atol=1e-12)
    np.testing.assert_allclose(image[:6].sum(axis=0), 15, rtol=1e-12)


@pytest.mark.parametrize("frame", [at_rest(), np.array([6.0, 0.8, 0.1, -5.0, -0.1, 1.3])])
def test_beyond_the_image_lies_what_a_larger_detector_would_see(frame: FloatArray) -> None:
    """Also by rays of the strip, of which those cells are left out that reach no pixel."""
    larger = RayModel(SIZE, 8, beyond=8)
    y, x = places(larger)
    potential = wavy(larger, FOLDED) + 90 * np.cos(y / 15) * np.sin(x / 10)
    beam = larger.around(uneven())
    counts = larger.ray_counts(potential)
    image = larger.image(TracedBeam(potential, counts, beam, frame))
    assert image.shape == larger.seen == (56, 70)
    smaller = model_of().image(TracedBeam(potential, counts, beam, frame))
    np.testing.assert_allclose(image[8:-8, 8:-8], smaller, rtol=1e-12, atol=1e-12)
    strip = larger.around(np.zeros(SIZE))
    strip[:8] = strip[-8:] = strip[:, :8] = strip[:, -8:] = 1.0
    of_strip = model_of().image(TracedBeam(potential, counts, strip, frame))
    assert of_strip.sum() > 20


def test_a_detector_shifted_by_whole_pixels_sees_the_image_shifted() -> None:
    model = model_of()
    potential, beam = wavy(model, FOLDED), model.around(uneven())
    counts = model.ray_counts(potential)
    frame = at_rest()
    frame[[0, 3]] = 2, -3
    image = model.image(TracedBeam(potential, counts, beam))
    shifted = model.image(TracedBeam(potential, counts, beam, frame))
    np.testing.assert_allclose(shifted[2:, :-3], image[:-2, 3:], atol=1e-11)


def test_a_frame_turns_about_the_middle_of_the_image() -> None:
    """A magnified detector sees a spot's distance from the middle magnified."""
    model = model_of()
    y, x = np.indices(tuple(KNOT * n for n in model.cells)) - model.pad
    beam = np.exp(-((y - 27) ** 2 + (x - 36) ** 2) / 2 / 2**2)
    still = np.zeros(model.shape)
    frame = np.array([0, 1.2, 0, 0, 0, 0.7])
    image = model.image(TracedBeam(still, model.ray_counts(still), beam, frame))
    rows, columns = np.indices(SIZE)
    middle = (image * rows).sum() / image.sum(), (image * columns).sum() / image.sum()
    assert middle[0] == pytest.approx(19.5 + 1.2 * (27 - 19.5), abs=0.01)
    assert middle[1] == pytest.approx(26.5 + 0.7 * (36 - 26.5), abs=0.01)


def test_what_is_not_wanted_of_derivatives_is_zero_and_the_rest_the_same() -> None:
    model = model_of()
    potential, beam = wavy(model, FOLDED), model.around(uneven())
    traced = TracedBeam(potential, model.ray_counts(potential), beam, turned())
    pull = np.random.default_rng(2).normal(size=SIZE)
    few = {"of_beam": False, "of_frame": False}
    jacobians = (model.jacobian(traced, **each).toarray() for each in ({}, few))
    gradients = (flat(model.gradient(traced, pull, **each))[None] for each in ({}, few))
    for (complete, less), rounding in ((jacobians, 1e-14), (gradients, 1e-12)):
        size = potential.size
        np.testing.assert_allclose(less[:, :size], complete[:, :size], rtol=1e-12, atol=rounding)
        assert complete[:, size:].any(axis=0).sum() > beam.size / 2
        assert not less[:, size:].any()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_a_potential_of_no_numbers_ends_in_no_other_memory(value: float) -> None:
    """Its rays count in no pixel, or in the wrong ones; those of other cells where they land."""
    model = model_of()
    potential, beam = wavy(model, WEAK), model.around(uneven())
    counts = model.ray_counts(potential)
    sound = model.image(TracedBeam(potential, counts, beam))
    potential[3:6, 4] = value
    image = model.image(TracedBeam(potential, counts, beam))
    assert np.isfinite(image).all()
    np.testing.assert_allclose(image[20:], sound[20:], rtol=1e-12)
    model.gradient(TracedBeam(potential, counts, beam), np.ones(SIZE))
    jacobian = model.jacobian(TracedBeam(potential, counts, beam))
    assert jacobian.indices.max() < jacobian.shape[1]


def test_threads_do_not_change_a_bit() -> None:
    alone = model_of((80, 96), threads=1)
    potential = wavy(alone, FOLDED)
    beam = alone.around(np.random.default_rng(3).uniform(0.5, 1.5, (80, 96)))
    counts, pull = alone.ray_counts(potential), np.random.default_rng(4).normal(size=(80, 96))
    assert (counts[0] * counts[1]).sum() > 100_000  # enough for threads
    traced = TracedBeam(potential, counts, beam, turned())
    image, pulls = alone.image(traced), alone.gradient(traced, pull)
    jacobian = alone.jacobian(traced)
    change = np.random.default_rng(5).normal(size=jacobian.shape[1])
    pushed, pulled = alone.push(jacobian, change), alone.pull(jacobian, pull)
    np.testing.assert_array_equal(pushed.ravel(), jacobian @ change)
    np.testing.assert_array_equal(pulled, jacobian.T @ pull.ravel())
    for threads in (2, 3):
        several = model_of((80, 96), threads=threads)
        np.testing.assert_array_equal(several.image(traced), image)
        again = several.gradient(traced, pull)
        for first, repeated in zip(pulls, again, strict=True):
            np.testing.assert_array_equal(first, repeated)
        np.testing.assert_array_equal(several.push(jacobian, change), pushed)
        repeated = several.jacobian(traced)
        np.testing.assert_array_equal(repeated.indices, jacobian.indices)
        np.testing.assert_array_equal(repeated.data, jacobian.data)


def test_displacement_is_minus_the_slope_of_the_values() -> None:
    """Differences of a smooth potential a pixel to each side, which err in the fourth order."""
    model = model_of((60, 70))
    y, x = places(model)
    potential = 40 * np.cos(y / 12) * np.sin(x / 15 + 1)
    values, displacement = model.values(potential), model.displacement(potential)
    assert values.shape == (60, 70)
    for axis in (0, 1):
        v = np.moveaxis(values, axis, 0)
        slope = (8 * (v[3:-1] - v[1:-3]) - (v[4:] - v[:-4])) / 12
        np.testing.assert_allclose(
            np.moveaxis(displacement[axis], axis, 0)[2:-2], -slope, atol=2e-3
        )


def test_knots_twice_as_dense_hold_the_same_potential_and_image() -> None:
    dense = RayModel(SIZE, 8, spacing=0.1, knot=1)
    usual = RayModel(SIZE, 8, spacing=0.1)
    potential, beam = wavy(usual, FOLDED), usual.around(uneven())
    nothing = np.zeros(0)
    held = Unknowns(potential[None], nothing, nothing, turned()[None], nothing)
    between = between_knots(held).potentials[0]
    assert between.shape == dense.shape
    assert dense.around(uneven()).shape == beam.shape
    np.testing.assert_allclose(dense.values(between), usual.values(potential), atol=1e-11)
    np.testing.assert_allclose(
        dense.displacement(between), usual.displacement(potential), atol=1e-12
    )
    images = [
        model.image(TracedBeam(each, model.ray_counts(each), beam, turned()))
        for model, each in ((usual, potential), (dense, between))
    ]
    assert images[1].sum() == pytest.approx(images[0].sum(), rel=1e-4)
    assert np.sqrt(np.square(images[1] - images[0]).mean()) < 0.02


def test_rays_land_as_densely_as_asked() -> None:
    """Neighbouring rays start 2 / n px apart and are spread by the stretch of their cell."""
    for spacing in (0.5, 0.25):
        model = model_of(spacing=spacing)
        assert (model.ray_counts(np.zeros(model.shape)) == KNOT / spacing).all()
        potential = wavy(model, FOLDED)
        counts = model.ray_counts(potential)
        assert counts.shape == (2, *model.cells)
        landed = np.indices(SIZE) + model.displacement(potential)
        inside = counts[:, 4:24, 4:31]
        for along in (0, 1):
            stretched = np.abs(np.diff(landed, axis=1 + along)).max(axis=0)
            y, x = np.indices(stretched.shape) // KNOT
            assert (KNOT / inside[along, y, x] * stretched <= 1.3 * spacing).all()
