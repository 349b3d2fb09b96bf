from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_shadowinv.inversion.readout import read_centroids, read_dual
from napari_shadowinv.transport.sites import plan_levels
from napari_shadowinv.transport.solvers import LevelSolution

SHAPE = (40, 50)


@pytest.fixture(scope="module")
def level():
    return plan_levels(np.ones(SHAPE), 1500, lloyd_iterations=20).levels[-1]


def standing_wave(points):
    """A potential that is level across the borders, as that of a closed image must be."""
    y, x = ((points + 0.5) / SHAPE).T
    return 10 * np.cos(2 * np.pi * y) * np.cos(np.pi * x)


def gradient(points):
    step = 1e-5
    return np.column_stack(
        [
            (standing_wave(points + shift) - standing_wave(points - shift)) / (2 * step)
            for shift in step * np.eye(2)
        ]
    )


def surface_of(level):
    solution = LevelSolution(
        2 * standing_wave(level.sites),
        0.0,
        0,
        True,
        level=level,
        threads=None,
        flux=level.mass,
        displacement=-gradient(level.sites),
    )
    return solution.surface


def test_the_potential_is_half_the_weights_up_to_the_border(level):
    potential, displacement = read_dual(surface_of(level), SHAPE)
    pixels = np.indices(SHAPE).reshape(2, -1).T.astype(float)
    expected = standing_wave(pixels).reshape(SHAPE)
    difference = potential - expected
    assert np.ptp(difference) < 0.0025 * np.ptp(expected)
    true = -gradient(pixels).T.reshape(2, *SHAPE)
    np.testing.assert_allclose(displacement, true, atol=0.03)


def test_a_constant_displacement_integrates_to_a_plane(level):
    drift = np.tile([0.5, -0.25], (len(level.sites), 1))
    potential, displacement = read_centroids(level, drift)
    y, x = np.indices(SHAPE)
    plane = -0.5 * y + 0.25 * x
    np.testing.assert_allclose(potential - potential.mean(), plane - plane.mean(), atol=1e-9)
    np.testing.assert_allclose(displacement[0], 0.5, atol=1e-12)
    np.testing.assert_allclose(displacement[1], -0.25, atol=1e-12)


def test_reading_tile_by_tile_is_reading_pixel_by_pixel(level):
    larger = replace(level, shape=(300, 90))
    surface = surface_of(larger)
    shares = []
    potential, _ = read_dual(surface, larger.shape, on_share=shares.append)
    assert shares == [128 / 300, 256 / 300, 1.0]
    pixels = np.indices(larger.shape, dtype=float).reshape(2, -1).T
    each = surface(pixels).reshape(larger.shape)
    difference = potential - each
    np.testing.assert_allclose(difference, difference[0, 0], atol=1e-11)
