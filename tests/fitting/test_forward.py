"""A scene's objective and its derivatives, with everything switched on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from helpers.fit_images import hessian_times
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.forward import Scene, blurred
from napari_shadowinv.fitting.instrument import EXACT, Imperfect
from napari_shadowinv.fitting.rays import at_rest
from napari_shadowinv.fitting.unknowns import Fiducials, Unknowns
from napari_shadowinv.instrument.shapes import Shapes

SIZE, PAD = (32, 40), 8
KERNEL = np.array([[0.0, 0.1, 0.0], [0.2, 0.4, 0.1], [0.0, 0.15, 0.05]])


def waves(shape: tuple[int, int], phase: float) -> FloatArray:
    y, x = np.indices(shape)
    return np.asarray(np.cos(y / 5 + phase) * np.sin(x / 7 - phase))


@pytest.fixture(params=[2, 1], ids=["knots every 2 px", "knots every px"])
def scene(request: pytest.FixtureRequest) -> Scene:
    """Two images by two fields, with all that may be unknown."""
    rng = np.random.default_rng(0)
    weights = rng.uniform(100, 900, (2, *SIZE))
    weights[:, 10:14, 20:30] = 0
    beams = 1 + 0.2 * np.stack(
        [waves((SIZE[0] + 2 * PAD, SIZE[1] + 2 * PAD), phase) for phase in (0, 1)]
    )
    return Scene(
        images=rng.uniform(0.5, 1.5, (2, *SIZE)),
        weights=weights,
        strengths=np.array([[1.0, 1.0], [0.6, 0.35]]),
        beams=beams,
        psf=[0.8, KERNEL],
        smoothness=np.array([[3.0, 20.0], [5.0, 1.0]]),
        decay=20.0,
        pad=PAD,
        free_brightness=True,
        free_frames=np.ones(6, bool),
        fiducials=Fiducials(
            np.array([[9.3, 11.2], [20.0, 30.5]]),
            np.array([[0.3, -0.2], [1.0, 0.4]]),
            np.array([0.1, 0.3]),
        ),
        blur=0.7,
        spacing=1 / 3,
        knot=request.param,
        threads=1,
        imperfect=Imperfect(
            {"gamma": 0.1, "background": 0.05},
            blur=0.5,
            other_strengths=0.2 * np.array([[1.0, 1.0], [0.8, 0.5]]),
            shapes=(
                Shapes.of_planes("beam", 0.1 * beams),
                Shapes.of_planes("between", 0.05 * beams[::-1], is_common=False),
            ),
        ),
    )


def some(scene: Scene) -> Unknowns:
    """An object, a beam, brightness and frames."""
    unknowns = scene.nothing()
    y, x = (scene.knot * (np.arange(n) - 1.0) - PAD for n in scene.rays.shape)
    bump = np.exp(-((y[:, None] - 14) ** 2 + (x - 22) ** 2) / 2 / 5**2)
    unknowns.potentials[0] = -18 * bump
    unknowns.potentials[1] = 9 * bump * np.cos(x / 3)
    unknowns.common[:] = 0.5, 0.6, -0.4, 0.7, 0.3
    unknowns.separate[:] = [[0.5, -0.6, 0.4], [-0.3, 0.7, 0.2]]
    unknowns.brightness[:] = 0.1, -0.2
    unknowns.frames[1] = [0.4, 1.01, -0.01, -0.3, 0.02, 0.98]
    return unknowns


def random_like(unknowns: Unknowns, seed: int) -> Unknowns:
    rng = np.random.default_rng(seed)
    change = unknowns.like(rng.normal(size=unknowns.flat().size))
    # Turns move rays at the edge by many pixels.
    return change._replace(frames=change.frames / 20)


def along(first: Unknowns, second: Unknowns) -> float:
    return float(first.flat() @ second.flat())


def only(part: str, change: Unknowns) -> Unknowns:
    return change if part == "all" else change.zeros()._replace(**{part: getattr(change, part)})


@pytest.mark.parametrize(
    "part", ["potentials", "brightness", "frames", "common", "separate", "all"]
)
@pytest.mark.parametrize("force", [False, True], ids=["plain", "forced"])
def test_the_gradient_is_that_of_the_value(scene: Scene, part: str, force: bool) -> None:
    unknowns = some(scene)
    if force:
        scene = replace(scene, force=random_like(unknowns, 2))
    counts = scene.ray_counts(unknowns)
    _, slope = scene.value_and_gradient(unknowns, counts)
    change = random_like(unknowns, 1)
    # Of the first image the frame is fixed.
    change.frames[0] = 0
    change = only(part, change)
    step = 1e-6
    ahead, behind = (
        scene.value_and_gradient(unknowns.plus(change, s), counts)[0] for s in (step, -step)
    )
    assert along(slope, change) == pytest.approx((ahead - behind) / 2 / step, rel=1e-4)


def test_the_value_is_half_of_what_the_residuals_and_the_prior_add_up_to(scene: Scene) -> None:
    sharp = replace(scene, blur=0.0)
    unknowns = some(sharp)
    counts = sharp.ray_counts(unknowns)
    misfit = (sharp.model(unknowns, counts) - sharp.images) ** 2 * sharp.weights
    value, _ = sharp.value_and_gradient(unknowns, counts)
    prior, _ = sharp.prior.value_and_slope(unknowns)
    assert value == pytest.approx(misfit.sum() / 2 + prior, rel=1e-12)
    used = (sharp.weights > 0).sum(axis=(1, 2))
    chi2 = sharp.chi2(sharp.model(unknowns, counts))
    np.testing.assert_allclose(chi2, misfit.sum(axis=(1, 2)) / used)


def test_what_is_not_free_has_no_slope(scene: Scene) -> None:
    fixed = replace(
        scene,
        free_brightness=False,
        free_frames=np.array([True, False, False] * 2),
        fiducials=None,
    )
    unknowns = some(fixed)
    _, slope = fixed.value_and_gradient(unknowns, fixed.ray_counts(unknowns))
    assert not slope.brightness.any()
    assert not slope.frames[0].any()
    np.testing.assert_array_equal(slope.frames[1] != 0, fixed.free_frames)


def test_masked_pixels_do_not_matter(scene: Scene) -> None:
    unknowns = some(scene)
    counts = scene.ray_counts(unknowns)
    spoilt = replace(scene, images=np.where(scene.weights > 0, scene.images, 1e6))
    value, slope = scene.value_and_gradient(unknowns, counts)
    spoilt_value, slope_there = spoilt.value_and_gradient(unknowns, counts)
    assert spoilt_value == value
    np.testing.assert_array_equal(slope_there.flat(), slope.flat())
    assert scene.value(unknowns, counts) == value


def test_pushed_is_the_change_of_residuals(scene: Scene) -> None:
    unknowns = some(scene)
    counts = scene.ray_counts(unknowns)
    change = random_like(unknowns, 2)
    change.frames[0] = 0
    step = 1e-6
    ahead, behind = (scene.model(unknowns.plus(change, s), counts) for s in (step, -step))
    expected = np.sqrt(scene.weights) * (ahead - behind) / (2 * step)
    pushed = scene.linear(unknowns, counts).push(change)
    assert np.abs(pushed - expected).max() < 1e-4 * np.abs(expected).max()


def test_pulled_is_the_transpose_of_pushed(scene: Scene) -> None:
    unknowns = some(scene)
    counts = scene.ray_counts(unknowns)
    change = random_like(unknowns, 3)
    change.frames[0] = 0
    residuals = np.random.default_rng(4).normal(size=scene.images.shape)
    pushed = scene.linear(unknowns, counts).push(change) * residuals
    pulled = scene.linear(unknowns, counts).pull(residuals)
    assert abs(pushed.sum() - along(pulled, change)) < 1e-12 * np.abs(pushed).sum()


@pytest.mark.parametrize("everything", [True, False])
@pytest.mark.parametrize("threads", [1, 2])
def test_normal_products_of_sharp_images_are_pulled_pushes(
    scene: Scene, everything: bool, threads: int
) -> None:
    """With all that may be unknown, and with the fields alone."""
    sharp = replace(
        scene, psf=[0.0, 0.0], imperfect=replace(scene.imperfect, blur=0.0), threads=threads
    )
    if not everything:
        fixed = {"free_brightness": False, "free_frames": np.zeros(6, bool)}
        sharp = replace(sharp, **fixed, imperfect=EXACT)
    assert sharp.rays.seen == SIZE
    unknowns = sharp.nothing()
    unknowns.potentials[:] = some(scene).potentials
    unknowns = unknowns.plus(random_like(unknowns, 6), 0.1)
    unknowns.frames[0] = at_rest()
    linear = sharp.linear(unknowns, sharp.ray_counts(unknowns))
    change = sharp._only_free(random_like(unknowns, 7))
    expected = linear.pull(linear.push(change)).flat()
    largest = np.abs(expected).max()
    assert largest > 0
    np.testing.assert_allclose(linear.normal_times(change).flat(), expected, atol=1e-11 * largest)


def test_the_hessian_is_the_change_of_the_gradient_where_images_are_explained(
    scene: Scene,
) -> None:
    sharp = replace(scene, blur=0.0)
    unknowns = some(sharp)
    counts = sharp.ray_counts(unknowns)
    explained = replace(sharp, images=sharp.model(unknowns, counts))
    change = sharp._only_free(random_like(unknowns, 7))
    change.frames[0] = 0
    step = 1e-6
    (_, ahead), (_, behind) = (
        explained.value_and_gradient(unknowns.plus(change, s), counts) for s in (step, -step)
    )
    expected = (ahead.flat() - behind.flat()) / (2 * step)
    product = hessian_times(explained.linear(unknowns, counts), change).flat()
    assert np.abs(product - expected).max() < 1e-4 * np.abs(expected).max()


def test_an_image_is_made_by_the_sum_of_the_fields_at_its_strengths(scene: Scene) -> None:
    unknowns = some(scene)
    first, second = unknowns.potentials
    exact = replace(scene, imperfect=EXACT)
    np.testing.assert_allclose(
        exact.potentials(unknowns), [first + second, 0.6 * first + 0.35 * second]
    )
    # Another field adds 0.4 standard deviations of 20 % and of its shares of them, reversed.
    np.testing.assert_allclose(
        scene.potentials(unknowns),
        [0.92 * (first + second), 0.536 * first + 0.31 * second],
    )


def test_gains_and_beam_multiply_the_image(scene: Scene) -> None:
    unknowns = scene.nothing()
    counts = scene.ray_counts(unknowns)
    plain = scene.model(unknowns, counts)
    unknowns.brightness[1] = np.log(1.5)
    images = replace(scene, beams=1.2 * scene.beams).model(unknowns, counts)
    np.testing.assert_allclose(images[0], 1.2 * plain[0], rtol=1e-12)
    np.testing.assert_allclose(images[1], 1.8 * plain[1], rtol=1e-12)


def test_a_kernel_of_a_gaussian_spreads_as_the_gaussian(scene: Scene) -> None:
    place = np.arange(-5, 6)
    line = np.exp(-(place**2) / 2 / 1.2**2)
    kernel = np.outer(line, line) / line.sum() ** 2
    unknowns = some(scene)
    counts = scene.ray_counts(unknowns)
    gaussian, by_kernel = (
        replace(scene, psf=[psf, psf]).model(unknowns, counts) for psf in (1.2, kernel)
    )
    np.testing.assert_allclose(by_kernel, gaussian, atol=1e-4)


def test_a_kernel_is_the_image_of_a_point(scene: Scene) -> None:
    """Not its mirror image."""
    beams = np.zeros_like(scene.beams)
    beams[:, PAD + 15, PAD + 20] = 1.0
    dot = replace(scene, beams=beams, spacing=0.1)
    nothing = dot.nothing()
    image = dot.model(nothing, dot.ray_counts(nothing))[1]
    np.testing.assert_allclose(image[14:17, 19:22], KERNEL, atol=0.02)


def test_blur_keeps_the_sum_and_has_the_width() -> None:
    dot = np.zeros((41, 41))
    dot[20, 20] = 1
    spread = blurred(dot, 2.0)
    offset = np.arange(41) - 20
    assert spread.sum() == pytest.approx(1)
    assert (spread.sum(axis=0) * offset**2).sum() == pytest.approx(4, rel=0.02)
    assert blurred(dot, 0.0) is dot
