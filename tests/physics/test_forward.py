"""Images of displaced sources, against maps whose image is known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import convolve1d
from shapely import LinearRing, Polygon, box

from helpers.toroid import toroid_displacement, toroid_image
from napari_shadowinv.errors import InputError, InversionCancelled
from napari_shadowinv.physics.forward import jacobian_determinant, synthetic_image
from napari_shadowinv.physics.phantoms import ellipse_pair

Array = NDArray[np.float64]


def grid(shape: tuple[int, int]) -> tuple[Array, Array]:
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    return y, x


def folding_field(shape: tuple[int, int]) -> Array:
    """Return a smooth field that folds in the middle and vanishes towards the border."""
    return ellipse_pair(shape, strength=4.0).displacement


def random_source(shape: tuple[int, int]) -> Array:
    return np.random.default_rng(1).uniform(0, 3, shape)


@pytest.mark.parametrize("rays_per_pixel", [1, 4, 7, 16, 25])
def test_flux_is_conserved_through_folds(rays_per_pixel: int) -> None:
    shape = (60, 80)
    source = random_source(shape)
    source[:8] = source[-8:] = 0
    source[:, :8] = source[:, -8:] = 0
    field = folding_field(shape)
    assert jacobian_determinant(field).min() < 0
    image = synthetic_image(field, source, rays_per_pixel=rays_per_pixel)
    assert image.min() >= 0
    assert image.sum() == pytest.approx(source.sum(), rel=1e-12)


@pytest.mark.parametrize("shift", [(0, 0), (3, -2), (0, 0.5), (-0.3, -0.45), (-1.7, 2.2)])
def test_any_shift_shares_each_pixel_by_areas(shift: tuple[float, float]) -> None:
    """The image of a shifted pixel overlaps four pixels; the part outside is lost."""
    source = random_source((8, 9))
    field = np.zeros((2, 8, 9))
    field[0], field[1] = shift
    expected = np.pad(source, 5)
    for axis, distance in enumerate(shift):
        whole_pixels = int(np.floor(distance))
        part = distance - whole_pixels
        expected = (1 - part) * np.roll(expected, whole_pixels, axis) + part * np.roll(
            expected, whole_pixels + 1, axis
        )
    np.testing.assert_allclose(synthetic_image(field, source), expected[5:-5, 5:-5], atol=1e-12)


@pytest.mark.parametrize("roughness", [0.1, 0.6, 3.0])
def test_each_pixel_gets_the_overlap_of_the_landed_tiles(roughness: float) -> None:
    """Overlaps of polygons by shapely, with tiles that fold, cross pixels and leave the image."""
    shape = (7, 9)
    source = random_source(shape)
    field = np.random.default_rng(3).normal(scale=roughness, size=(2, *shape))
    y, x = (np.arange(2 * n + 1) / 2 - 0.5 for n in shape)
    along_y = CubicSpline(np.arange(shape[0]), field, axis=1)(y)
    moved = CubicSpline(np.arange(shape[1]), along_y, axis=2)(x)
    corners = np.stack(np.meshgrid(y, x, indexing="ij")) + moved
    expected = np.zeros(shape)
    for a, b in np.ndindex(2 * shape[0], 2 * shape[1]):
        first, second = corners[:, a, b : b + 2].T
        fourth, third = corners[:, a + 1, b : b + 2].T
        triangles = [Polygon([first, second, third]), Polygon([first, third, fourth])]
        signs = [LinearRing(triangle.exterior.coords).is_ccw for triangle in triangles]
        areas = [triangles[0].area, triangles[1].area]
        # Of one density, unless a fold has turned one half of the tile over.
        shares = np.array(areas) / sum(areas) if signs[0] == signs[1] else [0.5, 0.5]
        for triangle, area, share in zip(triangles, areas, shares, strict=True):
            for i, j in np.ndindex(shape):
                overlap = triangle.intersection(box(i - 0.5, j - 0.5, i + 0.5, j + 0.5)).area
                expected[i, j] += source[a // 2, b // 2] / 4 * share * overlap / area
    image = synthetic_image(field, source, rays_per_pixel=4)
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_uniform_stretch_thins_the_image_and_ends_sharply() -> None:
    y, x = grid((40, 40))
    field = 0.5 * np.stack([y - 19.5, x - 19.5])
    np.testing.assert_allclose(synthetic_image(field), 1 / 1.5**2, rtol=1e-11)
    squeezed = synthetic_image(-field)
    np.testing.assert_allclose(squeezed[10:30, 10:30], 4, rtol=1e-11)
    assert squeezed.sum() == pytest.approx(1600, rel=1e-12)
    assert squeezed[:10].max() < 1e-9


def test_shear_and_rotation_divide_by_the_determinant() -> None:
    """Tiles that are no rectangles leave neither gaps nor ripples."""
    y, x = grid((50, 50))
    y, x = y - 24.5, x - 24.5
    field = np.stack([0.3 * y + 0.4 * x, -0.2 * y + 0.1 * x])
    determinant = 1.3 * 1.1 + 0.4 * 0.2
    image = synthetic_image(field, rays_per_pixel=9)
    np.testing.assert_allclose(image[15:35, 15:35], 1 / determinant, rtol=1e-11)


@pytest.mark.parametrize(("rays_per_pixel", "tolerance"), [(16, 0.02), (400, 0.001)])
def test_fold_of_a_parabola(rays_per_pixel: int, tolerance: float) -> None:
    """Landing at X = X₀ + k (x - c)², a flux of 2 √((X - X₀)/k) lies below X."""
    y, x = grid((4, 60))
    edge, k, center = 3.3, 0.05, 29.5
    field = np.stack([np.zeros_like(y), edge + k * (x - center) ** 2 - x])
    image = synthetic_image(field, rays_per_pixel=rays_per_pixel)
    pixel_edges = np.arange(61) - 0.5
    below = 2 * np.sqrt(np.maximum(pixel_edges - edge, 0) / k)
    expected = np.diff(np.minimum(below, 60))
    np.testing.assert_allclose(image, np.tile(expected, (4, 1)), atol=tolerance * expected.max())
    assert image.sum() == pytest.approx(240, rel=1e-12)
    assert image[:, :3].max() < 1e-9


def test_everything_on_one_point() -> None:
    y, x = grid((12, 12))
    image = synthetic_image(np.stack([7.2 - y, 3.1 - x]))
    assert image[7, 3] == pytest.approx(144, rel=1e-9)
    assert image.sum() == pytest.approx(144, rel=1e-12)


def test_cubic_displacement_is_exact_up_to_the_border() -> None:
    """The tiles' corners lie on a cubic exactly, so no flux is misplaced by interpolation."""
    y, x = grid((4, 20))
    t = (x - 9.5) / 10
    field = np.stack([np.zeros_like(y), t - 2 * t**2 + 1.5 * t**3])
    image = synthetic_image(field, rays_per_pixel=32**2)
    fine = np.linspace(-0.5, 19.5, 200_001)
    t = (fine - 9.5) / 10
    landing = fine + t - 2 * t**2 + 1.5 * t**3
    expected = np.diff(np.interp(np.arange(21) - 0.5, landing, fine))
    np.testing.assert_allclose(image[1], expected, atol=2e-5)


def test_number_of_threads_changes_no_bit() -> None:
    field = folding_field((90, 70))
    single = synthetic_image(field, random_source((90, 70)), threads=1)
    for threads in (2, 5, None):
        parallel = synthetic_image(field, random_source((90, 70)), threads=threads)
        np.testing.assert_array_equal(single, parallel)


def test_synthetic_image_reports_each_band_and_stops_at_once() -> None:
    field, steps = folding_field((360, 70)), []
    image = synthetic_image(field, on_progress=lambda news: steps.append(news.step / news.total))
    np.testing.assert_array_equal(image, synthetic_image(field))
    assert len(steps) > 20
    assert steps == sorted(steps)
    assert (steps[0], steps[-1]) == (0, 1)
    heard: list[int] = []
    with pytest.raises(InversionCancelled):
        synthetic_image(
            field,
            on_progress=lambda news: heard.append(news.step),
            should_stop=lambda: len(heard) == 3,
        )
    assert heard == [0, 1, 2]


def test_rays_are_rounded_up_to_a_square() -> None:
    field = folding_field((40, 40))
    np.testing.assert_array_equal(
        synthetic_image(field, rays_per_pixel=10), synthetic_image(field, rays_per_pixel=16)
    )


def test_jacobian_of_polynomials_is_exact_up_to_the_border() -> None:
    y, x = grid((8, 9))
    linear = np.stack([0.2 * y + 0.3 * x, -0.1 * y + 0.5 * x])
    np.testing.assert_allclose(jacobian_determinant(linear), 1.2 * 1.5 + 0.3 * 0.1)
    quadratic = np.stack([0.05 * y**2, np.zeros_like(x)])
    np.testing.assert_allclose(jacobian_determinant(quadratic), 1 + 0.1 * y)


def test_synthetic_image_refuses_wrong_input() -> None:
    good = np.zeros((2, 6, 7))
    bad = good.copy()
    bad[0, 1, 1] = np.nan
    with pytest.raises(InputError, match=r"shape \(6, 7\): expected \(2, height, width\)"):
        synthetic_image(good[0])
    with pytest.raises(InputError, match="at least 4"):
        synthetic_image(np.zeros((2, 3, 9)))
    with pytest.raises(InputError, match="displacement has 1 values that are NaN"):
        jacobian_determinant(bad)
    with pytest.raises(InputError, match=r"source has shape \(7, 6\)"):
        synthetic_image(good, np.ones((7, 6)))
    with pytest.raises(InputError, match="source has 42 negative pixels"):
        synthetic_image(good, -np.ones((6, 7)))
    with pytest.raises(InputError, match="source is zero everywhere"):
        synthetic_image(good, np.zeros((6, 7)))
    with pytest.raises(InputError, match="source has 42 values that are NaN"):
        synthetic_image(good, np.full((6, 7), np.inf))
    with pytest.raises(InputError, match="rays per pixel are 0"):
        synthetic_image(good, rays_per_pixel=0)
    with pytest.raises(InputError, match="threads is 0"):
        synthetic_image(good, threads=0)


def blurred_by_one_pixel(image: Array) -> Array:
    """Blur as bilinear deposit does: by the variance of one more pixel, 1/12."""
    kernel = [1 / 24, 22 / 24, 1 / 24]
    result: Array = convolve1d(convolve1d(image, kernel, axis=0), kernel, axis=1)
    return result


def test_independent_forward_model_agrees() -> None:
    difference = blurred_by_one_pixel(synthetic_image(toroid_displacement(97))) - toroid_image(97)
    assert np.abs(difference).max() < 2e-3
    assert difference.std() < 2e-4


def test_independent_forward_model_agrees_at_caustics() -> None:
    """Where the blur hides the caustic's shape, blocks of pixels still hold the same flux."""
    image = blurred_by_one_pixel(synthetic_image(toroid_displacement(194)))
    difference = (image - toroid_image(194)).reshape(20, 10, 20, 10).mean(axis=(1, 3))
    assert np.abs(difference).max() < 0.02


@pytest.mark.parametrize("far", [1e3, 1e12, 1e30, -1e30])
def test_rays_may_land_further_away_than_whole_numbers_reach(far: float) -> None:
    displacement = np.zeros((2, 12, 12))
    displacement[0] = far * np.arange(-6, 6)
    landed = synthetic_image(displacement).sum()
    # Of each row, a width of 12 / far lands in the image.
    if far == 1e3:
        assert landed == pytest.approx(144 / far)
    assert 0 <= landed < 144
    displacement[:] = far
    assert synthetic_image(displacement).sum() == 0
