"""The same scene in larger pixels, the same unknowns in smaller ones, and steps downhill."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting._ray_kernels import KNOT
from napari_shadowinv.fitting.conjugate_gradients import solve
from napari_shadowinv.fitting.descent import NewtonSteps, coarser, descend, finer, settle
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import FITTED_VARIANCE, Imperfect
from napari_shadowinv.fitting.preconditioner import Preconditioner
from napari_shadowinv.fitting.unknowns import Fiducials, Unknowns
from napari_shadowinv.instrument.shapes import beam_shapes
from napari_shadowinv.options import BeamPrior
from napari_shadowinv.physics.arrays import block_sums

SIZE, PAD = (48, 64), 16


@pytest.fixture
def scene() -> Scene:
    return Scene(
        images=np.ones((2, *SIZE)),
        weights=np.full((2, *SIZE), 400.0),
        strengths=np.array([[1.0], [0.6]]),
        beams=np.ones((2, SIZE[0] + 2 * PAD, SIZE[1] + 2 * PAD)),
        psf=[0.0, 0.0],
        smoothness=np.array([[20.0, 300.0]]),
        decay=25.0,
        pad=PAD,
        spacing=1 / 3,
        threads=1,
    )


def places(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Middles of the splines, recorded px from the image's corner."""
    rays = scene.rays
    lines = (scene.bin * (KNOT * (np.arange(n) - 1.0) - rays.pad) for n in rays.shape)
    return tuple(np.meshgrid(*lines, indexing="ij"))  # type: ignore[return-value]


def bump(scene: Scene, slope: float, width: float = 8.0) -> Unknowns:
    unknowns = scene.nothing()
    y, x = places(scene)
    unknowns.potentials[0] = (
        -slope * width**2 * np.exp(-((y - 24) ** 2 + (x - 30) ** 2) / 2 / width**2)
    )
    unknowns.potentials[0] /= scene.bin**2
    return unknowns


def with_noisy_images(scene: Scene, truth: Unknowns) -> Scene:
    images = scene.model(truth, scene.ray_counts(truth))
    noise = np.random.default_rng(6).normal(0, 0.05, images.shape)
    return replace(scene, images=images + noise)


def test_finer_pixels_change_no_potential(scene: Scene) -> None:
    """Coefficients twice as dense hold the same spline: at all points, to rounding."""
    coarse = coarser(scene, 2)
    unknowns = coarse.nothing()
    unknowns.potentials[:] = np.random.default_rng(0).normal(size=unknowns.potentials.shape)
    unknowns.frames[1] = [0.4, 1.01, -0.01, -0.3, 0.02, 0.98]
    fine = finer(unknowns)
    assert fine.potentials.shape == (1, *scene.rays.shape)
    # The middle of a coarse pixel is the corner of four fine ones: read both at knots instead.
    before = at_knots(unknowns.potentials[0])
    np.testing.assert_allclose(at_knots(fine.potentials[0])[::2, ::2], 4 * before, atol=1e-12)
    np.testing.assert_allclose(fine.frames[1], [0.8, 1.01, -0.01, -0.6, 0.02, 0.98])


def at_knots(coefficients: FloatArray) -> FloatArray:
    """A cubic spline where its pieces meet."""
    for _ in range(2):
        coefficients = (coefficients[:-2] + 4 * coefficients[1:-1] + coefficients[2:]).T / 6
    return coefficients


def test_finer_pixels_make_the_same_image(scene: Scene) -> None:
    coarse = replace(coarser(scene, 2), spacing=0.1)
    fine = replace(scene, spacing=0.2)
    unknowns = bump(coarse, 2.0)
    model = coarse.model(unknowns, coarse.ray_counts(unknowns))
    twice = finer(unknowns)
    binned_image = block_sums(fine.model(twice, fine.ray_counts(twice)), 2) / 4
    assert model.max() > 2
    np.testing.assert_allclose(model, binned_image, atol=0.03)


@pytest.mark.parametrize("factor", [2, 4])
def test_larger_pixels_keep_the_information_of_an_image(scene: Scene, factor: int) -> None:
    """χ² of a constant misfit, Σ misfit²/σ²: a mean of n pixels has σ²/n."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(380, 420, scene.weights.shape)
    brighter = replace(scene, images=np.full_like(scene.images, 1.07), weights=weights)
    coarse = coarser(brighter, factor)
    for each in (brighter, coarse):
        nothing = each.nothing()
        misfit = each.chi2(each.model(nothing)) * each.weights[0].size
        np.testing.assert_allclose(misfit, 0.07**2 * 400 * weights[0].size, rtol=0.01)
    assert coarse.images.shape == (2, SIZE[0] // factor, SIZE[1] // factor)
    assert coarse.bin == factor


@pytest.mark.parametrize("factor", [2, 4])
def test_larger_pixels_hold_as_much_against_a_potential(scene: Scene, factor: int) -> None:
    """Each of λ, κ, strip and fading, for one field at the knots of each."""
    none = np.zeros((1, 2))
    for smoothness, tie, decay in (
        (np.array([[1.0, 0.0]]), 0.0, np.inf),
        (np.array([[0.0, 1.0]]), 0.0, np.inf),
        (none, 30.0, np.inf),
        (none, 30.0, 3.0),
    ):
        smooth = replace(scene, smoothness=smoothness, tie=tie, decay=decay)
        scenes = smooth, coarser(smooth, factor)
        fine, coarse = (each.prior.value_and_slope(bump(each, 1.0))[0] for each in scenes)
        assert fine > 0
        assert coarse == pytest.approx(fine, rel=0.15 * factor), (smoothness, tie, decay)


def test_pixels_less_than_half_used_are_left_out(scene: Scene) -> None:
    weights = scene.weights.copy()
    weights[0, 0, 0:3] = 0  # two of the first four pixels, one of the next
    weights[0, 1, 0] = 0
    images = np.where(weights > 0, scene.images, np.nan)
    images[0, 0, 3] = 2.0
    coarse = coarser(replace(scene, images=images, weights=weights), 2)
    assert coarse.weights[0, 0, 0] == 0
    assert coarse.weights[0, 0, 1] == pytest.approx(3 * 400)
    assert coarse.images[0, 0, 1] == pytest.approx(4 / 3)
    assert coarse.weights[0, 5, 5] == pytest.approx(4 * 400)
    assert np.isfinite(coarse.images).all()


def test_point_spreads_are_narrower_in_larger_pixels(scene: Scene) -> None:
    dot = np.zeros((21, 21))
    dot[10, 10] = 1
    kernel = gaussian_filter(dot, 2.0)
    coarse = coarser(replace(scene, psf=[1.5, kernel]), 2)
    assert coarse.psf[0] == 0.75
    assert coarse.psf[1] == pytest.approx(1.0, rel=0.01)
    moved = coarser(replace(scene, psf=[1.5, np.roll(kernel, 2, axis=0)]), 2)
    assert moved.psf[1] == pytest.approx(coarse.psf[1], rel=1e-6)


def test_fiducials_are_scaled_with_the_pixels(scene: Scene) -> None:
    marks = Fiducials(np.array([[8.0, 12.0]]), np.array([[1.0, -2.0]]), np.array([0.5]))
    coarse = coarser(replace(scene, fiducials=marks), 4)
    assert coarse.fiducials is not None
    np.testing.assert_array_equal(coarse.fiducials.places, [[2, 3]])
    np.testing.assert_array_equal(coarse.fiducials.displacements, [[0.25, -0.5]])
    np.testing.assert_array_equal(coarse.fiducials.errors, [0.125])


def test_descending_finds_the_field_that_made_the_images(scene: Scene) -> None:
    truth = bump(scene, 0.6)
    images = scene.model(truth, scene.ray_counts(truth))
    values: list[float] = []
    target = replace(scene, images=images, smoothness=np.array([[1.0, 0.0]]))
    end, value, steps = descend(
        target, scene.nothing(), iterations=200, least_gain=0.05, after_step=values.append
    )
    expected = scene.rays.displacement(truth.potentials[0])
    error = scene.rays.displacement(end.potentials[0]) - expected
    assert np.linalg.norm(error) < 0.05 * np.linalg.norm(expected)
    assert len(values) == steps
    assert values[-1] == pytest.approx(value)
    at_start, _ = target.value_and_gradient(scene.nothing(), target.ray_counts(scene.nothing()))
    assert value < 0.01 * at_start


def test_settling_reaches_where_a_long_descent_ends(scene: Scene) -> None:
    truth = bump(scene, 1.5)
    target = with_noisy_images(scene, truth)
    near = truth._replace(potentials=0.99 * truth.potentials)
    before, _ = target.value_and_gradient(near, target.ray_counts(near))
    end, value, steps, ended = settle(target, near, steps=8, least_gain=0.1)
    assert ended
    assert steps < 8
    again, _ = target.value_and_gradient(end, target.ray_counts(end))
    assert value == again < before - 300
    longer, less, _ = descend(target, near, iterations=400, least_gain=1e-3)
    assert value - less < 0.5
    np.testing.assert_allclose(
        target.rays.displacement(end.potentials[0]),
        target.rays.displacement(longer.potentials[0]),
        atol=0.03,
    )


def test_a_known_jacobian_leads_to_the_same_end(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = bump(scene, 1.0)
    target = with_noisy_images(scene, truth)
    near = truth._replace(potentials=0.98 * truth.potentials)
    _, expected, *_ = settle(target, near, steps=8, least_gain=0.1)
    linear = target.linear(truth, target.ray_counts(truth))
    built: list[Scene] = []
    original = Scene.linear
    monkeypatch.setattr(Scene, "linear", lambda *given: built.append(given[0]) or original(*given))
    _, value, _, ended = settle(target, near, steps=8, least_gain=0.1, linear=linear)
    assert ended
    assert not built
    assert value == pytest.approx(expected, abs=0.5)
    # That of another field fails, and is left.
    far = truth._replace(potentials=-8 * truth.potentials)
    wrong = target.linear(far, target.ray_counts(far))
    _, value, *_ = settle(target, near, steps=8, least_gain=0.1, linear=wrong)
    assert built
    assert value == pytest.approx(expected, abs=0.5)


def test_settling_goes_on_by_descent_where_its_own_steps_fail(scene: Scene) -> None:
    """From a fold on the wrong side, steps of a linear model overshoot."""
    truth = bump(scene, 2.0)
    images = scene.model(truth, scene.ray_counts(truth))
    far = truth._replace(potentials=-2 * truth.potentials)
    target = replace(scene, images=images)
    before, _ = target.value_and_gradient(far, target.ray_counts(far))
    _, value, steps, ended = settle(target, far, steps=60, least_gain=1.0)
    assert value < before / 3
    assert steps <= 60
    assert ended == (steps < 60)


def test_a_rough_search_ends_at_a_step_that_gains_what_was_expected(scene: Scene) -> None:
    truth = bump(scene, 1.0)
    target = with_noisy_images(scene, truth)
    near = truth._replace(potentials=0.97 * truth.potentials)
    before, _ = target.value_and_gradient(near, target.ray_counts(near))
    _, least, most, _ = settle(target, near, steps=8, least_gain=1e-3)
    _, value, steps, ended = settle(
        target, near, steps=8, least_gain=1e-3, limits=NewtonSteps(is_rough=True)
    )
    assert ended
    assert steps < most
    assert value - least < 0.02 * (before - least)


def steps_of_solution(scene: Scene) -> int:
    """How many steps a linear system of a scene without an object takes."""
    scales, nothing = Preconditioner(scene), scene.nothing()
    linear, steps = scene.linear(nothing), 0

    def times(flat: FloatArray) -> FloatArray:
        nonlocal steps
        steps += 1
        return scales.hessian_times(linear, flat)

    noise = np.random.default_rng(0).normal(size=scene.images.shape)
    right = scales.transpose_times(linear.pull(noise)).flat()
    solve(times, right, tolerance=1e-4, iterations=400)
    return steps


def with_unknown_beam(scene: Scene) -> Scene:
    used = np.ones(scene.images.shape[1:])
    shapes = beam_shapes(BeamPrior(rms=0.1), used, FITTED_VARIANCE).pad(((PAD, PAD),) * 2)
    return replace(scene, imperfect=Imperfect(shapes=(shapes,)))


def test_a_beam_that_fields_can_replace_costs_few_steps(scene: Scene) -> None:
    assert steps_of_solution(with_unknown_beam(scene)) < 2.5 * steps_of_solution(scene) < 40


def test_scales_of_beams_and_fields_have_their_transpose(scene: Scene) -> None:
    unsure = with_unknown_beam(scene)
    scales, like, rng = Preconditioner(unsure), unsure.nothing(), np.random.default_rng(1)
    first, second = (like.like(rng.normal(size=like.flat().size)) for _ in range(2))
    there = scales.times(first).flat() @ second.flat()
    back = first.flat() @ scales.transpose_times(second).flat()
    assert there == pytest.approx(back, rel=1e-9)
