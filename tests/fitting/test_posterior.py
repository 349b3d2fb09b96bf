"""What the data leave open, against dense matrices of a tiny problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.fft import idctn

from helpers.fit_images import hessian_times
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting._ray_kernels import KNOT
from napari_shadowinv.fitting.descent import coarser, descend, settle
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.instrument import Imperfect
from napari_shadowinv.fitting.posterior import Posterior, Sample, compare_samples, draw_variations
from napari_shadowinv.fitting.search import Minimum, estimate_smoothness
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.instrument.shapes import Shapes

DRAWS = 160


def weak_scene(size: tuple[int, int], smoothness: tuple[float, float]) -> Scene:
    pad = 4
    return Scene(
        images=np.ones((2, *size)),
        weights=np.full((2, *size), 400.0),
        strengths=np.array([[1.0], [0.6]]),
        beams=np.ones((2, size[0] + 2 * pad, size[1] + 2 * pad)),
        psf=[0.0, 0.0],
        smoothness=np.array([smoothness]),
        pad=pad,
        free_brightness=True,
        free_frames=np.array([True, False, False] * 2),
        threads=1,
    )


def dense_hessian(scene: Scene, unknowns: Unknowns) -> tuple[FloatArray, FloatArray]:
    """Column by column; and which unknowns are free."""
    linear = scene.linear(unknowns, scene.ray_counts(unknowns))
    columns = [
        hessian_times(linear, unknowns.like(unit)).flat() for unit in np.eye(unknowns.flat().size)
    ]
    matrix = np.stack(columns, axis=1)
    return matrix, np.flatnonzero(np.diag(matrix))


def imperfect_scene() -> tuple[Scene, Unknowns]:
    """Two images of a lens that focuses, with a background and a blur; the fields and numbers."""
    scene = replace(
        weak_scene((20, 24), (30.0, 100.0)),
        weights=np.full((2, 20, 24), 1e4),
        psf=[1.0, 1.0],
        free_brightness=False,
        free_frames=np.zeros(6, bool),
        imperfect=Imperfect({"background": 0.1}, blur=0.5),
        held=frozenset({"blur", "background"}),
    )
    unknowns = scene.nothing()
    y, x = np.indices(scene.rays.shape)
    unknowns.potentials[0] = 12 * np.exp(-((y - 8) ** 2 + (x - 9) ** 2) / 12)
    unknowns.common[:], unknowns.separate[:] = 0.5, [[1.0], [0.7]]
    return scene, unknowns


def numbers_of(scene: Scene, unknowns: Unknowns) -> FloatArray:
    return np.array([unit.flat() @ unknowns.flat() for unit in scene.response_units()])


def test_held_numbers_are_drawn_as_uncertain_as_they_are_said_to_be() -> None:
    scene, unknowns = imperfect_scene()
    root = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [0.0, 0.1, 0.4]])
    tolerance = 4 * np.sqrt(2 / DRAWS)
    for spread, expected in ((None, np.eye(3)), (root, root @ root.T)):
        posterior = Posterior(replace(scene, spread=spread), unknowns, np.random.default_rng(0))
        draws = [numbers_of(scene, each.change) for each in posterior.draw_samples(DRAWS, 0.1)]
        scales = np.sqrt(np.diag(expected))
        difference = np.cov(np.array(draws).T) - expected
        assert np.abs(difference / np.outer(scales, scales)).max() < tolerance


def test_a_few_samples_spread_numbers_that_move_the_whole_field_as_many_do() -> None:
    scene, unknowns = imperfect_scene()
    known = replace(scene, spread=np.diag([0.3, 0.2, 0.4]))
    posterior = Posterior(known, unknowns, np.random.default_rng(0))
    draws = np.array([numbers_of(scene, each.change) for each in posterior.draw_samples(6, 0.1)])
    np.testing.assert_allclose(np.sqrt((draws**2).mean(axis=0)), [0.3, 0.2, 0.4])
    np.testing.assert_allclose(draws.mean(axis=0), 0, atol=1e-12)


def test_the_curvature_of_numbers_is_the_schur_complement_of_the_hessian() -> None:
    scene, unknowns = imperfect_scene()
    response = Posterior(scene, unknowns, np.random.default_rng(0)).response(1)
    matrix, free = dense_hessian(replace(scene, held=frozenset()), unknowns)
    numbers = [int(np.argmax(unit.flat())) for unit in scene.response_units()]
    rest = np.setdiff1d(free, numbers)
    inverse = np.linalg.pinv(matrix[np.ix_(rest, rest)], rcond=1e-12, hermitian=True)
    beside = matrix[np.ix_(numbers, rest)]
    exact = matrix[np.ix_(numbers, numbers)] - beside @ inverse @ beside.T - np.eye(len(numbers))
    np.testing.assert_allclose(response.numbers, numbers_of(scene, unknowns))
    np.testing.assert_allclose(
        response.curvature, exact, rtol=0.05, atol=0.02 * np.abs(exact).max()
    )


def test_the_expected_slopes_are_those_of_fits_at_the_true_numbers() -> None:
    """Fields that are fitted to noise, and are smoothed, make a sharper instrument likelier."""
    scene, unknowns = imperfect_scene()
    model = scene.model(unknowns, scene.ray_counts(unknowns))
    rng = np.random.default_rng(4)
    slopes, deviations = [], []
    for _ in range(24):
        shot = replace(scene, images=model + 0.01 * rng.normal(size=model.shape))
        ended, *_ = settle(shot, unknowns, steps=8, least_gain=0.01)
        response = Posterior(shot, ended, np.random.default_rng(0)).response(2)
        slopes.append([response.slopes, response.slopes - response.expected])
        deviations.append(np.sqrt(np.diag(response.curvature)))
    errors = np.mean(deviations, axis=0) / np.sqrt(len(slopes))
    plain, corrected = np.mean(slopes, axis=0) / errors
    assert abs(plain[0]) > 10
    # A fit is not certain of about as large a share as is left.
    assert abs(corrected[0]) < 0.35 * abs(plain[0])
    assert np.abs(corrected[1:]).max() < 3.5


@pytest.fixture(scope="module")
def tiny() -> tuple[Scene, Unknowns, FloatArray, FloatArray]:
    scene = weak_scene((12, 16), (30.0, 100.0))
    unknowns = scene.nothing()
    y, x = np.indices(scene.rays.shape)
    unknowns.potentials[0] = 2 * np.exp(-((y - 6) ** 2 + (x - 7) ** 2) / 6)
    return scene, unknowns, *dense_hessian(scene, unknowns)


def test_samples_have_the_inverse_hessian_as_covariance(
    tiny: tuple[Scene, Unknowns, FloatArray, FloatArray],
) -> None:
    """Along any way v, v·sample is normal with the variance v·H⁻¹v."""
    scene, unknowns, matrix, free = tiny
    posterior = Posterior(scene, unknowns, np.random.default_rng(0))
    samples = np.stack([each.change.flat() for each in posterior.draw_samples(DRAWS)])
    covariance = np.linalg.pinv(matrix[np.ix_(free, free)], rcond=1e-10, hermitian=True)
    tolerance = 4 * np.sqrt(2 / DRAWS)
    # Observables: displacements, brightness, frames; not the potential's free constant.
    size = unknowns.potentials.size
    place = np.arange(size).reshape(scene.rays.shape)
    ways = []
    for row, column in ((4, 4), (6, 7), (8, 9)):
        way = np.zeros(unknowns.flat().size)
        way[place[row, column + 1]], way[place[row, column - 1]] = 1, -1
        ways.append(way)
    ways.append(np.zeros(unknowns.flat().size))
    ways[-1][place[6, 7]], ways[-1][place[6, 8]], ways[-1][place[6, 6]] = 2, -1, -1
    for part in ("brightness", "frames"):
        like = unknowns.zeros()
        getattr(like, part)[-1, ...] = 1
        ways.append(like.flat())
    for way in ways:
        expected = way[free] @ covariance @ way[free]
        variance = ((samples @ way) ** 2).mean()
        assert variance == pytest.approx(expected, rel=tolerance)


def test_a_solved_sample_explains_its_noise_and_its_force_in_full() -> None:
    """The objective of its own images has no slope there; to first order it has."""
    scene, unknowns = imperfect_scene()
    scene = replace(scene, images=scene.model(unknowns, scene.ray_counts(unknowns)))
    unknowns, *_ = settle(scene, unknowns, steps=40, least_gain=1e-6)
    posterior = Posterior(scene, unknowns, np.random.default_rng(3))
    linear = posterior.draw_samples(4)
    solved = posterior.solve(linear, 20)
    pairs = compare_samples(scene, linear, solved)
    assert 0.01 < pairs.linearity.nonlinearity < 0.5
    assert pairs.linearity.spread_ratio == pytest.approx(1, abs=0.2)

    def gain_left(sample: Sample, change: Unknowns) -> float:
        """What a Newton step from a sample would still gain."""
        images = scene.images + sample.noise / np.sqrt(scene.weights)
        noisy = replace(scene, images=images, force=sample.force)
        there = unknowns.plus(change)
        before = noisy.value(there, noisy.ray_counts(there))
        return before - settle(noisy, there, steps=3, least_gain=1e-9)[1]

    for first, full in zip(linear, solved, strict=True):
        # Held numbers are those that were drawn.
        np.testing.assert_allclose(full.change.common, first.change.common, atol=1e-12)
        assert abs(gain_left(full, full.change)) < 0.1
        assert gain_left(full, full.change) < 0.2 * gain_left(first, first.change)


@pytest.mark.parametrize("true", [30.0, 300.0])
def test_the_likeliest_smoothness_is_that_of_the_field(true: float) -> None:
    """A field drawn from the prior, images with noise: λ comes back within a factor of two."""
    scene = replace(
        weak_scene((48, 48), (true, 0.0)),
        free_brightness=False,
        free_frames=np.zeros(6, bool),
        spacing=1 / 3,
        tie=1e-3,
    )
    rng = np.random.default_rng(5)
    truth = scene.nothing()
    roughness = scene.prior.of_rough[0].sum(axis=0)
    waves = np.divide(1, np.sqrt(roughness), out=np.zeros_like(roughness), where=roughness > 0)
    # Of the longest waves, which neither images nor λ tell much about, little.
    waves *= scene.prior.wave_numbers > (1.5 * np.pi / (KNOT * max(roughness.shape))) ** 2
    truth.potentials[0] = idctn(waves * rng.normal(size=roughness.shape), norm="ortho")
    images = scene.model(truth, scene.ray_counts(truth))
    noisy = images + rng.normal(0, 0.05, images.shape)
    # From far off; κ has no part in such a field.
    smoothness = np.array([[2000.0, 0.0]])
    unknowns = scene.nothing()
    signs = rng.choice([-1.0, 1.0], unknowns.potentials.shape)
    for _ in range(6):
        now = replace(scene, images=noisy, smoothness=smoothness)
        unknowns, _, _ = descend(now, unknowns, iterations=100, least_gain=0.5)
        ratios, _ = Posterior(now, unknowns, rng).smoothness_ratios(signs)
        smoothness = smoothness * np.exp(1.7 * ratios * [1, 0])
    assert abs(ratios[0, 0]) < 0.1
    assert 0.5 < smoothness[0, 0] / true < 2


def test_moved_by_beams_is_the_response_of_the_best_field(
    tiny: tuple[Scene, Unknowns, FloatArray, FloatArray],
) -> None:
    """Against a dense solution, with the images' change by differences."""
    scene, unknowns, matrix, free = tiny
    wave = np.cos(np.arange(scene.beams.shape[2]) / 4) * np.ones(scene.beams.shape)
    counts = scene.ray_counts(unknowns)
    brighter = replace(scene, beams=scene.beams * (1 + 0.01 * wave))
    change = brighter.model(unknowns, counts) - scene.model(unknowns, counts)
    residuals = np.sqrt(scene.weights) * change
    slope = scene.linear(unknowns, counts).pull(residuals).flat()[free]
    expected = unknowns.flat() * 0
    expected[free] = np.linalg.pinv(matrix[np.ix_(free, free)], rcond=1e-10, hermitian=True) @ slope
    posterior = Posterior(scene, unknowns, np.random.default_rng(0))
    moved = posterior.moved_by_beams([0.01 * wave])[0]
    shift, dense = (
        scene.rays.displacement(each.potentials[0]) for each in (moved, unknowns.like(expected))
    )
    assert np.abs(dense).max() > 1e-4
    assert np.abs(shift - dense).max() < 0.1 * np.abs(dense).max()


def test_draw_variations_have_unit_rms_inside_and_the_length() -> None:
    scene, length = weak_scene((48, 64), (1.0, 1.0)), 8.0
    scene = replace(scene, pad=20, beams=np.ones((2, 88, 104)))
    fields = draw_variations(scene, length, 40, np.random.default_rng(1))
    assert fields.shape == (40, 88, 104)
    inside = fields[:, 20:-20, 20:-20]
    np.testing.assert_allclose(inside.mean(axis=(1, 2)), 0, atol=1e-12)
    np.testing.assert_allclose(inside.std(axis=(1, 2)), 1)
    # Waves with normal components of deviation 1/length have slopes of that r.m.s.
    for axis in (1, 2):
        slope = np.sqrt((np.gradient(inside, axis=axis) ** 2).mean())
        assert slope == pytest.approx(1 / length, rel=0.1)


def test_numbers_that_begin_far_away_end_within_their_errors() -> None:
    """A search with smooth fields can carry a background many deviations away."""
    scene, truth = imperfect_scene()
    model = scene.model(truth, scene.ray_counts(truth))
    noise = 0.01 * np.random.default_rng(5).normal(size=model.shape)
    shot = replace(scene, images=model + noise, held=frozenset())
    far = truth._replace(separate=np.full((2, 1), -9.0))
    rng = np.random.default_rng(0)
    start = Minimum("far", far, np.inf, np.zeros((1, 2, 20, 24)), 1)
    settled, end = estimate_smoothness(shot, start, rng, lambda *_: None)
    assert settled.held == {"blur", "background"}
    assert settled.spread is not None
    off = np.linalg.solve(
        settled.spread, numbers_of(scene, end.unknowns) - numbers_of(scene, truth)
    )
    assert np.abs(off).max() < 3


@pytest.mark.parametrize("stated", [{"gamma": 0.1}, {"background": 0.1}])
def test_bright_lines_do_not_move_numbers_of_a_detector(stated: dict[str, float]) -> None:
    """Rays far apart would smear the lines, which passes for less contrast."""
    noise, size = 0.02, (40, 40)
    scene = replace(
        weak_scene(size, (1.0, 1.0)),
        weights=np.full((2, *size), noise**-2),
        free_brightness=False,
        free_frames=np.zeros(6, bool),
        imperfect=Imperfect(stated),
    )
    truth = scene.nothing()
    y, x = np.indices(scene.rays.shape)
    truth.potentials[0] = -20 * np.exp(-((y - 12) ** 2 + (x - 12.5) ** 2) / 2 / 2.6**2)
    shot = replace(scene, images=replace(scene, spacing=0.05).model(truth))
    start = Minimum("truth", truth, np.inf, scene.displacement(truth), 1)
    settled, end = estimate_smoothness(shot, start, np.random.default_rng(0), lambda *_: None)
    assert settled.spread is not None
    off = np.linalg.solve(settled.spread, numbers_of(scene, end.unknowns))
    assert np.abs(off).max() < 1


@pytest.mark.parametrize("is_common", [True, False])
def test_beams_of_their_own_are_told_from_fields_by_the_finest_structure(is_common: bool) -> None:
    """In pixels of two, a broad lens moves an object whose structure would show it."""
    scene, _ = imperfect_scene()
    line = np.cos(np.arange(scene.beams.shape[1]) / 9)
    planes = 0.05 * np.multiply.outer(line, np.ones(scene.beams.shape[2]))[None]
    key = "beam" if is_common else "beam_between"
    beams = Shapes.of_planes(key, planes, is_common=is_common)
    scene = replace(scene, imperfect=Imperfect(shapes=(beams,)), held=frozenset())
    coarse = coarser(scene, 2)
    start = Minimum("far", coarse.nothing(), np.inf, coarse.displacement(coarse.nothing()))
    _, end = estimate_smoothness(scene, start, np.random.default_rng(0), lambda *_: None)
    assert end.bin == (2 if is_common else 1)
