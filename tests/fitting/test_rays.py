"""Rays through spline potentials against an independent forward model and finite differences."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.rays import KNOT, RayModel
from napari_shadowinv.physics.forward import synthetic_image

SHAPE = (40, 53)
PAD = 8


def places(model: RayModel) -> tuple[FloatArray, FloatArray]:
    """Where the coefficients' splines have their middles, in px from the image's corner."""
    y, x = (KNOT * (np.arange(n, dtype=float) - 1) - model.pad for n in model.shape)
    return np.meshgrid(y, x, indexing="ij")


def wavy(model: RayModel, strength: float) -> FloatArray:
    """A smooth potential that fades at the edge."""
    y, x = places(model)
    bump = np.exp(-((y - 18) ** 2 + (x - 27) ** 2) / 2 / 7**2)
    return strength * bump * np.cos((y + 2 * x) / 9)


@pytest.fixture
def model() -> RayModel:
    y, x = np.indices(SHAPE)
    return RayModel(1 + 0.3 * np.cos(y / 9) * np.sin(x / 11), PAD)


def test_nothing_in_the_way_changes_nothing(model: RayModel) -> None:
    flat = RayModel(np.ones(SHAPE), PAD)
    still = np.zeros(model.shape)
    np.testing.assert_allclose(flat.image(still, flat.ray_counts(still)), 1, rtol=1e-12)
    # A beam that varies is blurred within a pixel, by a third of one.
    image = model.image(still, model.ray_counts(still))
    np.testing.assert_allclose(image[1:-1, 1:-1], model.source[1:-1, 1:-1], rtol=2e-3)


@pytest.mark.parametrize("curvature", [0.1, -0.3, 2.2])
def test_a_lens_magnifies_also_beyond_its_focus(curvature: float) -> None:
    """Splines hold a paraboloid exactly; behind it the beam is 1 / (1 - curvature)² as bright."""
    model = RayModel(np.ones((24, 24)), 40)
    y, x = places(model)
    bowl = curvature * ((y - 12) ** 2 + (x - 12) ** 2) / 2
    image = model.image(bowl, model.ray_counts(bowl, 0.05))
    np.testing.assert_allclose(image, (1 - curvature) ** -2, rtol=2e-3)
    offset = np.indices((24, 24)) - 11.5
    np.testing.assert_allclose(model.displacement(bowl), -curvature * offset, atol=1e-12)


@pytest.mark.parametrize("strength", [8.0, 60.0])
def test_it_agrees_with_the_exact_deposit_of_triangles_also_where_rays_cross(
    model: RayModel, strength: float
) -> None:
    potential = wavy(model, strength)
    image = model.image(potential, model.ray_counts(potential, 0.1))
    expected = synthetic_image(model.displacement(potential), model.source)
    folded = expected.max() > 4
    assert folded == (strength > 20)
    # The triangles bend at pixels only.
    difference = (image - expected)[2:-2, 2:-2]
    assert np.sqrt((difference**2).mean()) < (0.08 if folded else 0.01)


def test_flux_is_conserved_where_nothing_reaches_the_edge() -> None:
    model = RayModel(np.ones(SHAPE), PAD)
    y, x = places(model)
    inside = np.maximum(1 - ((y - 20) / 14) ** 2 - ((x - 26) / 18) ** 2, 0)
    potential = 15 * inside**3 * np.cos(y / 2)
    image = model.image(potential, model.ray_counts(potential))
    assert image.max() > 2
    assert image.sum() == pytest.approx(image.size, rel=1e-12)


@pytest.mark.parametrize("strength", [8.0, 60.0])
def test_the_gradient_is_that_of_the_image(model: RayModel, strength: float) -> None:
    rng = np.random.default_rng(0)
    potential, pull = wavy(model, strength), rng.normal(size=SHAPE)
    counts = model.ray_counts(potential, 0.4)
    gradient = model.gradient(potential, counts, pull)
    step = 1e-6
    for _ in range(3):
        way = rng.normal(size=model.shape)
        ahead, behind = (model.image(potential + s * way, counts) for s in (step, -step))
        slope = (pull * (ahead - behind)).sum() / (2 * step)
        assert (gradient * way).sum() == pytest.approx(slope, rel=1e-5)


def test_rays_land_as_densely_as_asked(model: RayModel) -> None:
    """Neighbouring rays start 2 / n px apart and are spread by the stretch of their cell."""
    potential = wavy(model, 60)
    for spacing in (0.5, 0.2):
        counts = model.ray_counts(potential, spacing)
        assert counts.shape == model.cells
        landed = np.indices(SHAPE) + model.displacement(potential)
        apart = max(np.abs(np.diff(landed, axis=axis)).max() for axis in (1, 2))
        inner = counts[PAD // KNOT : -PAD // KNOT, PAD // KNOT : -PAD // KNOT]
        assert KNOT / inner.max() * apart <= spacing * KNOT
    assert (model.ray_counts(np.zeros(model.shape), 0.25) == KNOT / 0.25).all()


def test_threads_do_not_change_a_bit(model: RayModel) -> None:
    potential = wavy(model, 60)
    counts = model.ray_counts(potential)
    pull = np.random.default_rng(1).normal(size=SHAPE)
    alone = RayModel(model.source, PAD, threads=1)
    for threads in (2, 3):
        several = RayModel(model.source, PAD, threads=threads)
        np.testing.assert_array_equal(
            several.image(potential, counts), alone.image(potential, counts)
        )
        np.testing.assert_array_equal(
            several.gradient(potential, counts, pull), alone.gradient(potential, counts, pull)
        )
