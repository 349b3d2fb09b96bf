"""The linear inversion is right where modulations are weak, and only there."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair, toroid
from napari_shadowinv.physics.poisson import (
    border_mean,
    counting_error,
    poisson_invert,
    potential_from_displacement,
)
from napari_shadowinv.physics.setup import ProtonSetup


def test_weak_asymmetric_object_is_recovered_in_place() -> None:
    phantom = ellipse_pair((90, 130), strength=0.01)
    potential = poisson_invert(synthetic_image(phantom.displacement, rays_per_pixel=64))
    truth = phantom.potential - border_mean(phantom.potential)
    np.testing.assert_allclose(potential, truth, atol=5e-3 * np.ptp(truth))
    assert border_mean(potential) == pytest.approx(0, abs=1e-12)


def test_neither_the_exposure_nor_a_uniform_source_matters() -> None:
    image = synthetic_image(ellipse_pair((40, 50), 0.5).displacement)
    recorded = poisson_invert(500 * image, source=np.full((40, 50), 7.0))
    np.testing.assert_allclose(recorded, poisson_invert(image), atol=1e-10)


@pytest.mark.parametrize(("peak", "lowest", "highest"), [(1, -0.01, 0), (10, -0.05, -0.02)])
def test_peak_field_is_underestimated_more_as_it_grows(
    peak: float, lowest: float, highest: float
) -> None:
    """As in Fig. 6(b) of the paper; the toroid at 10 MG µm comes out 3.5 % low."""
    phantom = toroid((200, 200), ProtonSetup.example(), peak, 30e-6)
    gradient = np.gradient(poisson_invert(synthetic_image(phantom.displacement)))
    error = np.hypot(*gradient).max() / np.hypot(*phantom.displacement).max() - 1
    assert lowest < error < highest


def test_no_flux_crosses_the_border() -> None:
    image = np.random.default_rng(0).uniform(0.9, 1.1, (40, 30))
    potential = poisson_invert(image)
    mirrored = poisson_invert(np.block([[image, image[:, ::-1]], [image[::-1], image[::-1, ::-1]]]))
    difference = mirrored[:40, :30] - potential
    np.testing.assert_allclose(difference, difference[0, 0], atol=1e-12)


def test_an_undisturbed_beam_has_no_potential() -> None:
    source = np.random.default_rng(0).uniform(1, 5, (20, 30))
    np.testing.assert_allclose(poisson_invert(3 * source, source=source), 0, atol=1e-12)


def test_counts_scatter_a_weak_field_by_what_is_told() -> None:
    rng, shape, counts = np.random.default_rng(0), (48, 40), 200.0
    squares = []
    for _ in range(60):
        image = rng.poisson(counts, shape) / counts
        change = image / image.mean() - 1
        # ∫ |∇φ|² = -∫ φ ∇²φ if no flux crosses the border.
        squares.append(-(poisson_invert(image) * change).mean())
    assert counting_error(shape, counts) == pytest.approx(np.mean(squares) ** 0.5, rel=0.03)


def test_poisson_inversion_refuses_wrong_input() -> None:
    image = np.ones((4, 5))
    with pytest.raises(InputError, match=r"image has shape \(4,\)"):
        poisson_invert(np.ones(4))
    with pytest.raises(InputError, match="image has a total flux of 0"):
        poisson_invert(0 * image)
    with pytest.raises(InputError, match="image has 20 values that are NaN"):
        poisson_invert(image * np.nan)
    with pytest.raises(InputError, match=r"source has shape \(5, 4\), image \(4, 5\)"):
        poisson_invert(image, source=image.T)
    with pytest.raises(InputError, match="source has 20 pixels that are zero or negative"):
        poisson_invert(image, source=0 * image)
    with pytest.raises(InputError, match=r"potential has shape \(4,\)"):
        border_mean(np.ones(4))


def test_potential_of_a_displacement_has_it_as_its_gradient():
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:30, :41] / 10
    potential = np.sin(y) * np.cos(2 * x) + 3 * x * y
    slopes = np.stack([np.cos(y) * np.cos(2 * x) + 3 * x, -2 * np.sin(y) * np.sin(2 * x) + 3 * y])
    result = potential_from_displacement(-slopes / 10)
    gap = result - potential
    assert np.ptp(gap) < 2e-3 * np.ptp(potential)
    assert border_mean(result) == pytest.approx(0, abs=1e-12)
    noisy = potential_from_displacement(-slopes / 10 + 1e-3 * rng.normal(size=slopes.shape))
    assert np.abs(noisy - result).max() < 0.02
