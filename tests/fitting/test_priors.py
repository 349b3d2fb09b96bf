"""What is held against unknowns: values, slopes, Hessian and random slopes of one form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting._ray_kernels import KNOT
from napari_shadowinv.fitting.rays import RayModel, at_rest
from napari_shadowinv.fitting.unknowns import Fiducials, Prior, Unknowns

SIZE, PAD = (24, 32), 8
DRAWS = 3000


@pytest.fixture
def prior() -> Prior:
    return Prior(
        rays=RayModel(SIZE, PAD),
        strengths=np.array([1.0, 0.5]),
        smoothness=np.array([[3.0, 20.0], [5.0, 1.0]]),
        tie=2.0,
        decay=15.0,
        fiducials=Fiducials(
            np.array([[9.3, 11.2], [20.0, 30.5]]),
            np.array([[0.3, -0.2], [1.0, 0.4]]),
            np.array([0.1, 0.3]),
        ),
        bin=2,
    )


def nothing(prior: Prior) -> Unknowns:
    shape = len(prior.smoothness), *prior.rays.shape
    return Unknowns(
        potentials=np.zeros(shape),
        common=np.zeros(2),
        brightness=np.zeros(3),
        frames=np.tile(at_rest(), (3, 1)),
        separate=np.zeros((3, 1)),
    )


def random(prior: Prior, seed: int) -> Unknowns:
    like = nothing(prior)
    return like.like(np.random.default_rng(seed).normal(size=like.flat().size))


def along(first: Unknowns, second: Unknowns) -> float:
    return float(first.flat() @ second.flat())


def places(prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Middles of the splines, px from the image's corner."""
    y, x = (KNOT * (np.arange(n) - 1.0) - PAD for n in prior.rays.shape)
    return tuple(np.meshgrid(y, x, indexing="ij"))  # type: ignore[return-value]


def test_random_slopes_have_the_hessian_as_covariance(prior: Prior) -> None:
    """Along any way v, v·slope is normal with the variance v·Hv: mean square to 3 / √draws."""
    like, rng = nothing(prior), np.random.default_rng(6)
    ways = [random(prior, seed) for seed in (7, 8)]
    y, x = places(prior)
    for field in (0, 1):  # a bump, and a wave that only the strip holds
        ways.append(like.zeros())
        ways[-1].potentials[field] = np.exp(-((y - 12) ** 2 + (x - 16) ** 2) / 50)
        ways.append(like.zeros())
        ways[-1].potentials[field] = np.cos(x / 30)
    ways.append(like.zeros()._replace(common=random(prior, 9).common))
    ways.append(like.zeros()._replace(frames=random(prior, 9).frames))
    samples = np.stack([prior.draw(like, rng).flat() for _ in range(DRAWS)])
    table = samples @ np.stack([way.flat() for way in ways]).T
    variances = np.array([along(way, prior.times(way)) for way in ways])
    tolerance = 4 * np.sqrt(2 / DRAWS)
    np.testing.assert_allclose((table**2).mean(axis=0) / variances, 1, atol=tolerance)
    np.testing.assert_allclose(table.mean(axis=0) / np.sqrt(variances), 0, atol=tolerance)
    mixed = along(ways[0], prior.times(ways[2])) / np.sqrt(variances[0] * variances[2])
    covariance = (table[:, 0] * table[:, 2]).mean() / np.sqrt(variances[0] * variances[2])
    assert covariance == pytest.approx(mixed, abs=tolerance)


@pytest.mark.parametrize(("which", "power"), [(0, 4), (1, 6)])
def test_smoothness_holds_the_squared_derivatives_of_a_cosine(which: int, power: int) -> None:
    """½ λ ∫ |k⁴ a cos(kx)|², half of that on average, for λ; k⁶ for κ."""
    smoothness = np.zeros((1, 2))
    smoothness[0, which] = 7.0
    prior = Prior(rays=RayModel(SIZE, PAD), strengths=np.ones(1), smoothness=smoothness, tie=0.0)
    rows, columns = prior.rays.shape
    like = nothing(prior)
    wave = np.pi * 5 / (columns * KNOT)
    like.potentials[0] = 0.3 * np.cos(wave * KNOT * (np.arange(columns) + 0.5))
    value, _ = prior.value_and_slope(like)
    area = rows * columns * KNOT**2
    assert value == pytest.approx(7 / 2 * area * (0.3 * wave**power) ** 2 / 2, rel=1e-9)


def test_the_strip_ties_the_potential_and_the_image_does_not() -> None:
    prior = Prior(
        rays=RayModel(SIZE, PAD),
        strengths=np.ones(1),
        smoothness=np.zeros((1, 2)),
        tie=2.0,
        decay=15.0,
    )
    y, x = places(prior)
    inside, outside = nothing(prior), nothing(prior)
    inside.potentials[0] = np.maximum(0, 1 - ((y - 12) ** 2 + (x - 16) ** 2) / 60)
    assert prior.value_and_slope(inside)[0] == 0
    outside.potentials[0] = y < 0
    steps, count = len(x[0]), (y < 0).sum()
    expected = 2.0 / 2 * (steps + count * (KNOT / 15) ** 2)
    assert prior.value_and_slope(outside)[0] == pytest.approx(expected, rel=1e-12)


def test_gains_frames_and_numbers_are_held_with_their_spreads(prior: Prior) -> None:
    """A shift by 5 recorded px, a stretch by 5 %, a brightness of e cost ½ each."""
    free = replace(prior, fiducials=None)
    for number, change in ((0, 5 / 2), (3, 5 / 2), (1, 0.05), (5, 0.05)):
        moved = nothing(prior)
        moved.frames[1, number] += change
        assert free.value_and_slope(moved)[0] == pytest.approx(0.5)
    spread = replace(free, shift_spread=0.2)
    moved = nothing(prior)
    moved.frames[1, 0] += 0.2 / 2
    assert spread.value_and_slope(moved)[0] == pytest.approx(0.5)
    brighter = nothing(prior)
    brighter.brightness[2] = 1
    assert free.value_and_slope(brighter)[0] == pytest.approx(0.5)
    uneven = nothing(prior)
    uneven.common[1] = 1
    assert free.value_and_slope(uneven)[0] == pytest.approx(0.5)


def test_fiducials_cost_what_the_displacement_misses_them_by(prior: Prior) -> None:
    """Splines hold a paraboloid exactly; the first image sees both fields at their strengths."""
    y, x = places(prior)
    fiducials = prior.fiducials
    assert fiducials is not None
    bowl = nothing(prior)
    bowl.potentials[0] = 0.05 * y**2 + 0.02 * y * x - 0.03 * x**2
    bowl.potentials[1] = 0.4 * x
    v, u = fiducials.places.T
    moved = -np.stack([0.1 * v + 0.02 * u, 0.02 * v - 0.06 * u + 0.5 * 0.4], axis=1)
    missed = (moved - fiducials.displacements) / fiducials.errors[:, None]
    with_them, without = (
        each.value_and_slope(bowl)[0] for each in (prior, replace(prior, fiducials=None))
    )
    assert with_them - without == pytest.approx((missed**2).sum() / 2, rel=1e-9)


def test_images_that_are_hardly_shifted_are_hardly_turned(prior: Prior) -> None:
    """By a turn of one standard deviation, halfway to their sides, they move as by a shift."""
    near, far = (replace(prior, shift_spread=spread) for spread in (0.05, 5.0))
    shift, turn = 1 / np.sqrt(near.frame_weights[:2])
    assert shift == pytest.approx(0.05 / prior.bin)
    assert turn * max(SIZE) / 4 == pytest.approx(shift)
    assert 1 / np.sqrt(far.frame_weights[1]) == pytest.approx(0.05)
