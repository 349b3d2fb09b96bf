"""Smooth random fields, and changes of beams that are sums of them."""

from dataclasses import replace

import numpy as np
import pytest

from napari_shadowinv.instrument.shapes import Shapes, random_waves


def test_a_smooth_field_has_the_correlation_of_its_length() -> None:
    """A Gaussian of the distance, less the mean over the image, which is removed."""
    length, weights = 5.0, np.ones((40, 30))
    field = Shapes.of_length("field", length, weights)
    modes = np.array([field.sum(unit) for unit in np.eye(len(field))]).reshape(len(field), -1)
    covariance = modes.T @ modes
    places = np.indices(weights.shape).reshape(2, -1).T
    squares = ((places[:, None] - places) ** 2).sum(axis=2)
    kernel = np.exp(-squares / (2 * length**2))
    centred = kernel - kernel.mean(axis=0) - kernel.mean(axis=1)[:, None] + kernel.mean()
    centred /= np.diag(centred).mean()
    assert np.diag(covariance).mean() == pytest.approx(1)
    assert np.abs(covariance - centred).max() < 0.03
    np.testing.assert_allclose(modes.mean(axis=1), 0, atol=1e-12)


def test_a_field_without_a_length_keeps_its_variance() -> None:
    """Its components are single pixels, of which most are 0 at the border."""
    field = Shapes.of_length("field", 0.05, np.ones((6, 8)), share=1 - 1e-9)
    assert sum(field.mean_squares) == pytest.approx(1)
    assert len(field) >= 47


def test_random_waves_have_the_correlation_of_their_length() -> None:
    """At places one and two lengths apart."""
    places = 7.0 * np.array([[0, 0], [1, 0], [0, 2]])
    fields = random_waves(places, 7.0, 20_000, np.random.default_rng(0))
    covariance = fields.T @ fields / len(fields)
    assert np.diag(covariance) == pytest.approx(1, abs=0.03)
    assert covariance[0, 1:] == pytest.approx(np.exp([-0.5, -2.0]), abs=0.03)


def smooth_shapes() -> tuple[Shapes, np.ndarray]:
    """Shapes with a plane and products, around images of 24 × 32 px, and the planes of all."""
    rng = np.random.default_rng(3)
    field = Shapes.of_length("beam", 12.0, rng.uniform(0.5, 1.5, (24, 32)), rms=0.1)
    around, envelope = ((4, 4), (4, 4)), rng.random((24, 32))
    fields = np.stack([field.sum(unit) for unit in np.eye(len(field))])
    beyond = np.pad(fields, ((0, 0), *around), mode="edge") * np.pad(envelope, around)
    plane = rng.random((1, 32, 40))
    shapes = replace(replace(field, envelope=envelope).pad(around), planes=plane)
    return shapes, np.concatenate([plane, beyond])


def test_products_of_functions_are_the_planes_of_a_smooth_field() -> None:
    shapes, planes = smooth_shapes()
    rng = np.random.default_rng(4)
    numbers, image = rng.normal(size=len(planes)), rng.normal(size=planes.shape[1:])
    assert len(shapes) == len(planes) > 5
    np.testing.assert_allclose(shapes.sum(numbers), np.tensordot(numbers, planes, 1), atol=1e-12)
    np.testing.assert_allclose(shapes.pull(image), np.tensordot(planes, image, 2), atol=1e-12)
    np.testing.assert_allclose(
        shapes.squares(image**2), np.tensordot(planes**2, image**2, 2), atol=1e-12
    )
    np.testing.assert_allclose(shapes.mean_squares, (planes**2).mean(axis=(1, 2)), atol=1e-12)


def test_products_of_functions_have_block_means_in_larger_pixels() -> None:
    shapes, planes = smooth_shapes()
    numbers = np.random.default_rng(5).normal(size=len(planes))
    means = np.tensordot(numbers, planes, 1).reshape(16, 2, 20, 2).mean(axis=(1, 3))
    coarse = shapes.coarsen(2).sum(numbers)
    # Fields that hardly change in a pixel, under an envelope that does.
    assert np.abs(coarse - means).max() < 0.02 * np.abs(means).max()


@pytest.mark.parametrize("seed", range(3))
def test_neither_signs_nor_rounding_of_the_algorithm_change_shapes(monkeypatch, seed) -> None:
    """Else the same seed would draw another beam with another number of threads."""
    shapes = Shapes.of_length("beam", 16.0, np.ones((64, 64)))
    rng, exactly = np.random.default_rng(seed), np.linalg.eigh

    def otherwise(matrix):
        values, vectors = exactly(matrix)
        signs = rng.choice([-1, 1], len(values))
        return values, signs * vectors * (1 + 1e-14 * rng.normal(size=vectors.shape))

    monkeypatch.setattr(np.linalg, "eigh", otherwise)
    again = Shapes.of_length("beam", 16.0, np.ones((64, 64)))
    np.testing.assert_array_equal(again.places, shapes.places)
    for mode, other in zip(shapes.modes, again.modes, strict=True):
        np.testing.assert_allclose(other, mode, atol=1e-9)
