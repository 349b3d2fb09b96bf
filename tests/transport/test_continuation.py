from __future__ import annotations

import re

import numpy as np
import pytest

from helpers.polygons import residual
from napari_shadowinv import InversionOptions, invert
from napari_shadowinv.geometry.density import Density, split_pixels
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.geometry.triangulation import RegularTriangulation
from napari_shadowinv.physics.forward import jacobian_determinant
from napari_shadowinv.transport.minimise import blur_image
from napari_shadowinv.transport.sites import plan_levels
from napari_shadowinv.transport.solvers import Target, solve

SIDE = 64
MIDDLE = (SIDE - 1) / 2
Y, X = np.indices((SIDE, SIDE), dtype=np.float64)
FLOOR = 1e-3
UNIFORM = np.ones((SIDE, SIDE))


def near(row, column, radius):
    return (np.hypot(Y - row, X - column) < radius).astype(np.float64)


def raised(image):
    """Raise the dark pixels to the floor and bring the mean to 1."""
    image = np.maximum(image / image.mean(), FLOOR)
    return image / image.mean()


def one_pixel():
    image = np.zeros((SIDE, SIDE))
    image[SIDE // 2, SIDE // 2] = 1
    return image


def corner():
    image = np.zeros((SIDE, SIDE))
    image[:6, :6] = 1
    return image


def salt():
    image = np.ones(SIDE**2)
    chosen = np.random.default_rng(5).choice(image.size, image.size // 100, replace=False)
    image[chosen] = 1e4
    return image.reshape(SIDE, SIDE)


def line():
    image = np.zeros((SIDE, SIDE))
    image[SIDE // 2] = 1
    return image


DISC = near(MIDDLE, MIDDLE, 16)
STEP = np.where(X < MIDDLE, 1e-6, 1.0)
LEFT, RIGHT = near(MIDDLE, 16, 8), near(MIDDLE, 48, 8)
HARD = {
    "disc": (DISC, UNIFORM),
    "ring": (near(MIDDLE, MIDDLE, 22) - DISC, UNIFORM),
    "step": (STEP, UNIFORM),
    "step reversed": (STEP, STEP[:, ::-1]),
    "corner": (corner(), UNIFORM),
    "swapped islands": (RIGHT, LEFT),
    "salt": (salt(), UNIFORM),
    "one bright pixel": (one_pixel(), UNIFORM),
    "a single line": (line(), UNIFORM),
}


def planned(source, n_sites=2000):
    return plan_levels(source / source.mean(), n_sites, lloyd_iterations=5)


def residual_when_blurred(level, weights, image, width, parts=8):
    """The blur of a piecewise-constant image, not of its pixels' values."""
    blur = blur_image(split_pixels(image, parts), parts * width)
    return residual(level.split(parts), parts**2 * weights, blur)


def smooth_image():
    image = 0.3 + np.exp(-(((Y - 25) / 9) ** 2) - ((X - 33) / 8) ** 2)
    return image / image.mean()


@pytest.mark.parametrize("width", [0.01, 0.5, 12.0, 50.0])
def test_blurring_keeps_flux_and_sign_at_any_width(width):
    image = raised(one_pixel())
    spread = blur_image(image, width)
    assert spread.sum() == pytest.approx(image.sum(), rel=1e-12)
    assert spread.min() > 0
    assert image.min() * (1 - 1e-12) <= spread.min() < spread.max() <= image.max() * (1 + 1e-12)


def test_blurring_twice_adds_variances():
    image = raised(salt())
    np.testing.assert_allclose(
        blur_image(blur_image(image, 3.0), 4.0), blur_image(image, 5.0), rtol=1e-10, atol=0
    )


def test_wide_blur_of_means_equals_narrower_blurs():
    image = 0.1 + np.random.default_rng(3).random((210, 331)) ** 8
    image[40:90, 200:260] *= 5
    narrow = blur_image(blur_image(blur_image(image, 24.0), 24.0), 30.0)
    wide = blur_image(image, np.sqrt(24.0**2 + 24.0**2 + 30.0**2))
    np.testing.assert_allclose(wide, narrow, rtol=0.01)
    assert np.ptp(narrow) > 0.1 * narrow.mean()


@pytest.mark.parametrize("name", HARD)
def test_images_with_jumps_are_solved(name):
    image, source = HARD[name]
    plan = planned(source)
    level = plan.levels[-1]
    answer = solve(plan.levels, Target.of(raised(image), InversionOptions(tolerance=1e-3)))[-1]
    assert answer.converged, answer.reason
    assert residual(level, answer.weights, raised(image)) <= 1e-3


@pytest.mark.parametrize("parts", [2, 3, 8])
def test_cells_hold_the_same_of_split_pixels(parts):
    level = planned(UNIFORM).levels[0]
    weights = np.random.default_rng(3).normal(0, 2, len(level.sites))
    smaller = level.split(parts)
    unsplit = PowerDiagram(
        RegularTriangulation(level.sites, weights), Density.from_image(smooth_image())
    )
    split = PowerDiagram(
        RegularTriangulation(smaller.sites, parts**2 * weights),
        Density.from_image(split_pixels(smooth_image(), parts)),
    )
    np.testing.assert_allclose(split.masses, unsplit.masses, rtol=1e-9, atol=1e-12)
    assert smaller.spacing == pytest.approx(parts * level.spacing)


@pytest.mark.parametrize("image", [line(), one_pixel()], ids=["line", "pixel"])
def test_structure_thinner_than_a_cell_takes_few_steps(image):
    """Each row of cells that passes a pixel's edge took some steps where pixels were not split."""
    plan = planned(UNIFORM, SIDE**2)
    answer = solve(plan.levels, Target.of(raised(image), InversionOptions()))[-1]
    assert answer.converged
    assert answer.iterations < 60


def test_stages_agree():
    plan = planned(UNIFORM)
    single, multi = (
        solve(
            plan.levels, Target.of(smooth_image(), InversionOptions(tolerance=1e-6, stages=stages))
        )[-1]
        for stages in ("single", "multi")
    )
    assert single.converged
    assert multi.converged
    np.testing.assert_allclose(single.weights, multi.weights, rtol=0, atol=1e-4)


@pytest.mark.parametrize("stages", ["single", "multi"])
def test_an_unsolved_image_leaves_the_solution_of_a_blurred_one(stages):
    plan = planned(UNIFORM)
    image = raised(one_pixel())
    options = InversionOptions(stages=stages, max_iterations=27)
    answer = solve(plan.levels, Target.of(image, options))[-1]
    assert not answer.converged
    assert "all 27 iterations" in answer.reason
    blur = re.search(r"blurred by (\S+) px", answer.reason)
    level = plan.levels[-1]
    widths = np.linspace(0.9, 1.1, 21) * float(blur[1])
    assert min(residual_when_blurred(level, answer.weights, image, w) for w in widths) < 0.3
    assert residual(level, answer.weights, image) == pytest.approx(answer.residual, rel=1e-6)


def test_unconverged_solution_beats_a_blurred_one():
    """No solver gets below rounding: the tolerance asked for is out of reach."""
    plan = planned(UNIFORM, 500)
    answer = solve(plan.levels, Target.of(smooth_image(), InversionOptions(tolerance=1e-16)))[-1]
    assert not answer.converged
    assert answer.residual < 1e-11
    assert "blurred" not in answer.reason


@pytest.mark.parametrize("most", [1, 7])
def test_no_level_takes_more_steps_than_allowed(most):
    plan = planned(UNIFORM)
    for stages in ("single", "multi"):
        options = InversionOptions(max_iterations=most, stages=stages)
        answers = solve(plan.levels, Target.of(raised(salt()), options))
        assert max(answer.iterations for answer in answers) <= most
        assert f"all {most} iterations" in answers[-1].reason


def test_steps_on_a_stalled_level_are_reported():
    """The coarser levels' start does not lead to a disc: the finest one is tried twice."""
    plan = planned(UNIFORM)
    answers = solve(plan.levels, Target.of(raised(DISC), InversionOptions()))
    assert [len(answer.weights) for answer in answers] == [500, 2000, 2000]
    assert answers[1].residual > 0.1
    assert answers[1].iterations > 0
    assert answers[2].converged


def test_an_island_is_displaced_as_a_whole():
    inversion = invert(RIGHT, source=LEFT, options=InversionOptions(n_sites=2000))
    inside = near(MIDDLE, 16, 6) > 0
    assert inversion.report.converged
    np.testing.assert_allclose(inversion.displacement[0][inside], 0, atol=0.1)
    np.testing.assert_allclose(inversion.displacement[1][inside], 32, atol=0.1)


def test_square_on_a_disc_stays_symmetric_and_shrinks_evenly():
    # Recorded, and lit where the image is black: no round window.
    source = 1 + 1e-6 * DISC
    inversion = invert(DISC, source=source, options=InversionOptions(n_sites=4096))
    inner = slice(2, -2)  # at the edge the potential is extrapolated
    potential = inversion.potential[inner, inner]
    assert inversion.report.converged
    for symmetric in (np.rot90(potential), potential[::-1], potential.T):
        np.testing.assert_allclose(symmetric, potential, rtol=0, atol=2e-3 * np.ptp(potential))
    shrinkage = jacobian_determinant(inversion.displacement)[8:-8, 8:-8]
    expected = 1 / raised(DISC).max()
    assert shrinkage.mean() == pytest.approx(expected, rel=0.02)
    assert np.median(shrinkage) == pytest.approx(expected, rel=0.01)


def test_threads_do_not_change_the_way_to_a_sharp_image():
    plan = planned(UNIFORM, 12_000)
    single, parallel = (
        solve(
            plan.levels[-1:],
            Target.of(raised(np.maximum(DISC, 0.1)), InversionOptions(threads=threads)),
        )[-1]
        for threads in (1, 2)
    )
    assert single.converged
    assert single.iterations == parallel.iterations
    np.testing.assert_array_equal(single.weights, parallel.weights)
