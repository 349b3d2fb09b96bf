"""The linear response of many samples at once against that of each alone, step by step."""

from __future__ import annotations

from functools import reduce
from operator import add

import numpy as np
import pytest
from scipy.special import ndtr

from napari_shadowinv import InversionOptions, invert, synthetic_image
from napari_shadowinv._system.progress import Reporter
from napari_shadowinv.geometry.density import Density
from napari_shadowinv.geometry.interpolation import WIDTH, CloughTocher, with_gradients
from napari_shadowinv.geometry.power_diagram import PowerDiagram
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.inversion import samples as sampling
from napari_shadowinv.inversion.normalise import prepare
from napari_shadowinv.inversion.readout import read_dual
from napari_shadowinv.inversion.samples import (
    FullResampling,
    LinearResampling,
    Pairs,
    correct,
    noise_of,
    stratified_numbers,
)
from napari_shadowinv.physics.phantoms import toroid
from napari_shadowinv.physics.poisson import border_mean
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.transport.linear import SimilarSystems
from napari_shadowinv.transport.solvers import Target

SHAPE = (60, 60)
NOISE = 0.1
KINDS = {"closed": {}, "masked": {}, "free": {"boundary": "free"}}


@pytest.fixture(scope="module")
def image():
    clean = synthetic_image(toroid(SHAPE, ProtonSetup.example(), 97.0, 100e-6).displacement)
    return clean + NOISE * np.random.default_rng(3).normal(size=SHAPE)


@pytest.fixture(scope="module", params=KINDS)
def case(request, image):
    """Options, a plan, and what `Inversion.uncertainty` makes of them."""
    mask = None
    if request.param == "masked":
        mask = np.ones(SHAPE, bool)
        mask[20:30, 5:25] = mask[50:, 50:] = False
    options = InversionOptions(n_sites=1000, negative="clip", **KINDS[request.param])
    plan = plan_sites(np.ones(SHAPE), options, mask=mask)
    inversion = invert(image, plan=plan, options=options)
    draw, _ = noise_of(image, NOISE, None, inversion.mask)
    samples = FullResampling(plan, inversion.cells.weights, image, draw, options)
    return samples, prepare(image, plan.source, options, mask).floored_image


def alone(samples, clean, seed):
    """Potential and displacement that one sample changes, by the ways of a single inversion."""
    plan, level = samples.plan, samples.plan.levels[-1]
    objective = Target.of(clean, samples.options, plan.margin).objective(level)
    laplacian = objective.diagram(samples.start).laplacian()
    ground = objective.ground(samples.start)
    change = np.zeros(level.shape)
    plan.within(change)[:] = samples.image(seed) - clean
    gained = PowerDiagram(objective.triangulation, Density.from_image(change)).masses
    half = 0.5 * SimilarSystems().solve(laplacian, -gained, 1e-11, ground=ground)
    at_sites = with_gradients(level.triangulation, np.repeat(half[:, None], WIDTH, axis=1))
    mirrored = level.mirrored
    gradients = mirrored.sense * at_sites[mirrored.origin, 1:, 0]
    surface = CloughTocher(mirrored.triangulation, half[mirrored.origin], gradients)
    potential, displacement = (plan.within(part) for part in read_dual(surface, level.shape))
    return np.stack([potential - border_mean(potential), *displacement])


def test_moments_are_those_of_samples_read_out_one_by_one(case):
    """To rounding and the tolerance of the linear system; sampling errs by a tenth and more."""
    samples, clean = case
    seeds = np.random.SeedSequence(0).spawn(WIDTH + 3)
    response = LinearResampling(samples, 2)
    blocks = seeds[:WIDTH], seeds[WIDTH:]
    scatter = response.scatter(blocks[0], Reporter()) + response.scatter(blocks[1], Reporter())
    each = np.array([alone(samples, clean, seed) for seed in seeds])
    assert scatter.count == len(each)
    size = each.std(axis=(0, 2, 3))[:, None, None]
    np.testing.assert_allclose(scatter.mean / size, each.mean(axis=0) / size, atol=1e-7)
    np.testing.assert_allclose(scatter.std / size, each.std(axis=0, ddof=1) / size, atol=1e-7)
    np.testing.assert_allclose(response.changes(seeds[:3]) / size, each[:3] / size, atol=1e-7)


def test_a_sample_is_the_same_in_any_block(case):
    samples, _ = case
    seeds = np.random.SeedSequence(0).spawn(WIDTH)
    serial, parallel = LinearResampling(samples, 1), LinearResampling(samples, 3)
    together = serial.changes(seeds)
    np.testing.assert_array_equal(parallel.changes(seeds[5:]), together[5:])
    np.testing.assert_array_equal(
        parallel.scatter(seeds[:1], Reporter()).sums, serial.scatter(seeds[:1], Reporter()).sums
    )


def test_too_many_sites_for_factors_are_left_to_the_multigrid(monkeypatch, image):
    options = InversionOptions(n_sites=1000, negative="clip")
    inversion = invert(image, options=options)
    factorised = inversion.uncertainty(WIDTH + 2, noise=NOISE).errors.samples
    monkeypatch.setattr(sampling, "_MOST_FACTORISED", 0)
    iterative = inversion.uncertainty(WIDTH + 2, noise=NOISE).errors.samples
    assert not np.array_equal(iterative.potential_std, factorised.potential_std)
    for name in ("potential_std", "displacement_std"):
        bars, exact_bars = getattr(iterative, name), getattr(factorised, name)
        # a residual of 2 % was allowed
        assert np.linalg.norm(bars - exact_bars) < 0.02 * np.linalg.norm(exact_bars)


def pairs_of(linear, solved):
    return reduce(add, map(Pairs.of, linear, solved))


def test_samples_that_are_related_by_a_line_are_corrected_to_it():
    """Whatever the few that are solved: shift, factor, and the corrected samples are exact."""
    linear = np.random.default_rng(0).normal(size=(100, 5))
    slope, level = np.array([0.5, 1.0, 2.0, 0.9, 1.2]), np.array([3.0, 0.0, -1.0, 2.0, 0.5])
    pairs = pairs_of(linear[:12], (slope * linear + level)[:12])
    np.testing.assert_allclose(pairs.factor, slope)
    solved = slope * linear + level
    np.testing.assert_allclose(correct(linear, solved[:12]), solved)
    assert pairs_of(linear[:5], (slope * linear)[:5]).factor == pytest.approx(1)


def test_skewed_samples_are_corrected_to_their_quantiles():
    """One number that acts with its square, too; where the rest is noise, samples stay normal."""
    numbers = stratified_numbers(np.random.default_rng(3), 200, 2)
    noise = np.random.default_rng(4).normal(size=(24, 2))
    solved = numbers[:24] + np.array([0.2, 0.0]) * numbers[:24] ** 2 + np.array([0, 0.3]) * noise
    low, high = np.quantile(correct(numbers, solved), [0.025, 0.975], axis=0)
    middle = (low + high) / 2
    assert middle[0] == pytest.approx(0.2 * 1.96**2, rel=0.2)
    assert abs(middle[1] - (solved - numbers[:24])[:, 1].mean()) < 0.2


@pytest.mark.parametrize("n", [2, 60])
def test_each_number_has_a_sample_in_each_part_of_its_values(n):
    numbers = stratified_numbers(np.random.default_rng(0), n, 5)
    parts = np.sort(ndtr(numbers) * n - 0.5, axis=0)
    assert np.abs(parts - np.arange(n)[:, None]).max() < 1
    np.testing.assert_allclose(numbers.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(numbers.std(axis=0, ddof=1), 1)


def test_chance_does_not_correct_a_deviation():
    """Unrelated samples of one distribution: the ratio of 24 scatters by 20 %, the factor not."""
    rng = np.random.default_rng(1)
    linear, solved = rng.normal(size=(2, 24, 4000))
    pairs = pairs_of(linear, solved)
    ratios = np.log(solved.std(axis=0) / linear.std(axis=0))
    assert ratios.std() == pytest.approx(0.2, rel=0.1)
    assert np.log(pairs.factor).std() < 0.5 * ratios.std()
    np.testing.assert_allclose(pairs.shift, (solved - linear).mean(axis=0), atol=1e-12)


def test_values_that_are_no_numbers_stay_as_they_are():
    linear = np.random.default_rng(2).normal(size=(30, 2))
    linear[3, 0] = np.nan
    corrected = correct(linear, 2 * linear[:10])
    np.testing.assert_array_equal(corrected[:, 0], linear[:, 0])
    np.testing.assert_allclose(corrected[:, 1], 2 * linear[:, 1])


def test_the_comparison_of_pairs_is_that_of_all_their_samples():
    rng = np.random.default_rng(3)
    linear = rng.normal(size=(9, 3, 4))
    solved = 1.1 * linear + 0.2 + 0.1 * rng.normal(size=(9, 3, 4))
    pairs, length = pairs_of(linear, solved), np.linalg.norm
    linearity = pairs.linearity
    assert linearity.nonlinearity == pytest.approx(length(linear - solved) / length(solved))
    assert linearity.spread_ratio == pytest.approx(length(solved) / length(linear))
    spread = length(solved - solved.mean(axis=0)) / np.sqrt(8)
    assert linearity.mean_shift == pytest.approx(length((linear - solved).mean(axis=0)) / spread)
    assert pairs.part(np.s_[1:]).count == 9
    np.testing.assert_array_equal(pairs.part(np.s_[1:]).shift, pairs.shift[1:])
