"""Fields from images that were made without the package, by exact formulae of the fields."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers.fit_images import Displacement, bump, counted, distance, noisy, on_pixels, together
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InputError
from napari_shadowinv.facts import Verdict
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.fitting.measurements import strengths_of
from napari_shadowinv.options import FitOptions
from napari_shadowinv.physics.beam import displacement_from_potential
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.plotting import fit_figure
from napari_shadowinv.shot import Shot, shots_of

SIZE = (48, 56)
STRENGTHS = [1, 0.6]
NOISE = 0.03
PLAIN = FitOptions(samples=0, max_iterations=30, spacing=0.25, threads=1)
HASTY = FitOptions(samples=0, max_iterations=5, spacing=0.25, threads=1)
RING_AND_SPOT = together(bump(3.2, 4.5, (20, 32)), bump(-1.6, 5, (30, 19)))
"""Rays cross around a ring, and behind a spot."""
WEAK = bump(0.4, 8, (22, 29))


def images_of(displacement: Displacement, **changes: Any) -> list[FloatArray]:
    return [
        counted(lambda y, x: strength * displacement(y, x), SIZE, **changes)  # noqa: B023
        for strength in STRENGTHS
    ]


@pytest.fixture(scope="module")
def folded_shots() -> list[FloatArray]:
    return images_of(RING_AND_SPOT)


@pytest.fixture(scope="module")
def found(folded_shots: list[FloatArray]) -> Fit:
    return fit(
        shots_of(noisy(folded_shots, NOISE), strength=STRENGTHS, source=np.ones(SIZE), noise=NOISE),
        options=FitOptions(samples=4, threads=1),
    )


def test_sampled_potentials_spread_as_far_as_the_total_error(found: Fit) -> None:
    images = noisy([counted(WEAK, SIZE)], NOISE)
    assumed = fit(
        shots_of(images, strength=[1], noise=NOISE), options=FitOptions(samples=12, threads=1)
    )
    errors = assumed.errors
    assert errors is not None
    assert errors.beam_sensitivity is not None
    parts = errors.shares
    assert parts["beam"] > 2 * parts["noise"] > 0
    assert np.linalg.norm(list(parts.values())) == pytest.approx(errors.share)
    assert errors.causes[0] == "beam assumed, 5 %"
    assert sorted(errors.causes)[:2] == ["assumed background, 5 %", "assumed gamma, 0.05"]
    for result in (found, assumed):
        (field,) = result.fields
        assert field.samples is not None
        moves = [displacement_from_potential(change) for change in np.float64(field.samples)]
        spread = np.sqrt((np.stack(moves) ** 2).mean(axis=0).mean())
        expected = np.sqrt((np.square(field.errors.per_pixel)).mean())
        assert spread == pytest.approx(expected, rel=0.2)
        (restored,) = Fit.from_dataset(result.to_dataset()).fields
        assert_array_equal(restored.samples, field.samples)


def test_two_energies_tell_a_field_whose_rays_cross(found: Fit) -> None:
    (field,) = found.fields
    assert distance(field.displacement, on_pixels(RING_AND_SPOT, SIZE)) < 0.03
    assert found.folded > 0.05
    assert found.verdict is Verdict.DETERMINED
    assert "2 images" in found.explanation
    assert (found.chi2 > 0.85).all()
    assert (found.chi2 < 1.15).all()


def test_the_error_bars_are_as_large_as_the_error(found: Fit) -> None:
    (field,) = found.fields
    assert field.errors.per_pixel is not None
    error = field.displacement - on_pixels(RING_AND_SPOT, SIZE)
    deviation = np.sqrt((field.errors.per_pixel**2).mean())
    assert 1 / 3 < deviation / np.sqrt((error**2).mean()) < 3
    size = np.sqrt((field.displacement**2).mean())
    assert found.total_error == pytest.approx(deviation / size)


def test_a_folded_ring_as_narrow_as_a_few_pixels_is_determined() -> None:
    """Of 5 px, by 10⁴ counts a pixel: finer than splines with a knot every 2 px can be."""
    side = 36

    def outward(y: FloatArray, x: FloatArray) -> FloatArray:
        v, u = y - (side - 1) / 2, x - (side - 1) / 2
        radius = np.hypot(v, u) + 1e-9
        return 4 * np.exp(-4 * np.log(2) * ((radius - 10) / 5) ** 2) * np.stack([v, u]) / radius

    rng, shots = np.random.default_rng(5), []
    for strength in STRENGTHS:
        image = counted(lambda y, x: strength * outward(y, x), (side, side), rays=60, margin=4)  # noqa: B023
        counts = rng.poisson(1e4 * image).astype(float)
        source = np.full(image.shape, 1e4)
        shots.append(Shot(counts, source=source, strength=strength, noise="poisson"))
    result = fit(shots, options=FitOptions(threads=1))
    truth = on_pixels(outward, (side, side))
    (field,) = result.fields
    assert result.folded > 0.05
    assert result.verdict is Verdict.DETERMINED
    assert distance(field.displacement, truth) < 0.012
    assert field.errors.per_pixel is not None
    ring = np.hypot(*truth) > 0.2
    ratio = ((field.displacement - truth) / field.errors.per_pixel)[:, ring]
    assert 0.5 < np.sqrt(np.square(ratio).mean()) < 1.4


def test_the_parts_of_a_result_belong_together(found: Fit, folded_shots: list[FloatArray]) -> None:
    (field,) = found.fields
    data = noisy(folded_shots, NOISE)
    np.testing.assert_allclose(found.images, data, rtol=1e-12)
    np.testing.assert_allclose(found.residual, data - found.reprojection, atol=1e-12)
    np.testing.assert_allclose(found.chi2, (found.residual**2).mean(axis=(1, 2)) / NOISE**2)
    np.testing.assert_allclose(found.noise, NOISE)
    squares = np.nanmean(found.normalised_residual**2, axis=(1, 2))
    np.testing.assert_allclose(squares, found.chi2)
    assert found.mask.all()
    slope = np.stack(np.gradient(field.potential))[:, 5:-5, 5:-5]
    assert distance(-slope, field.displacement[:, 5:-5, 5:-5]) < 0.06
    border = np.ones(field.potential.shape, bool)
    border[1:-1, 1:-1] = False
    assert field.potential[border].mean() == pytest.approx(0, abs=1e-9)
    best, *solutions = found.basins
    assert best.distance == 0
    assert all(best.objective <= solution.objective for solution in solutions)
    np.testing.assert_allclose(found.strengths, [[1], [0.6]])
    assert found.report.seconds.keys() >= {"starts", "smoothness", "full size", "samples"}


def test_strong_rays_first_or_weak_ones_makes_no_difference(
    found: Fit, folded_shots: list[FloatArray]
) -> None:
    """The field is that of the first image."""
    turned = fit(
        shots_of(noisy(folded_shots, NOISE)[::-1], strength=[0.6, 1], noise=NOISE), options=PLAIN
    )
    forwards, backwards = found.fields[0].displacement, turned.fields[0].displacement / 0.6
    assert distance(backwards, forwards) < 0.04


@pytest.mark.parametrize("noise", ["proportional", "pixels"])
def test_the_drawn_residual_is_as_even_as_the_noise(noise: str) -> None:
    """The variance is 1 in the dark and in the bright half, as far as so many pixels show it."""
    beam = 400 * np.exp(np.linspace(-1.5, 1.5, SIZE[1])) * np.ones(SIZE)  # 20 times as bright
    clean = np.stack(images_of(WEAK, beam=lambda y, x: 400 * np.exp(3 * x / (SIZE[1] - 1) - 1.5)))
    rng = np.random.default_rng(5)
    deviations = {"proportional": 0.05 * clean, "pixels": 0.01 * clean**1.2}[noise]
    images = clean + deviations * rng.normal(size=clean.shape)
    stated: Any = deviations if noise == "pixels" else noise
    result = fit(shots_of(images, strength=STRENGTHS, source=beam, noise=stated), options=PLAIN)
    assert result.noise is not None
    assert result.noise.shape == images.shape
    panels = [axes for axes in fit_figure(result).axes if "Residual" in axes.get_title(loc="left")]
    assert len(panels) == 2
    middle = SIZE[1] // 2
    for panel in panels:
        drawn = np.asarray(panel.images[0].get_array())
        for half in (drawn[:, :middle], drawn[:, middle:]):
            assert half.var() == pytest.approx(1, abs=4 * np.sqrt(2 / half.size))


def uneven_beam(y: FloatArray, x: FloatArray, share: float = 0.2) -> FloatArray:
    return np.asarray(1 + share * np.cos(y / 15) * np.sin(x / 18))


def test_two_energies_correct_an_assumed_beam() -> None:
    beam = partial(uneven_beam, share=0.1)
    result = fit(
        shots_of(
            noisy(images_of(RING_AND_SPOT, beam=beam), NOISE), strength=STRENGTHS, noise=NOISE
        ),
        options=FitOptions(samples=2, threads=1),
    )
    assert distance(result.fields[0].displacement, on_pixels(RING_AND_SPOT, SIZE)) < 0.05
    assert result.errors.shares.keys() == {"noise", "beam", "background", "gamma"}
    assert result.errors.beam_sensitivity is None
    error = result.source / beam(*np.indices(SIZE).astype(float)) - 1
    assert error.std() < 0.015


def test_three_energies_tell_a_magnetic_field_from_an_electric_one() -> None:
    magnetic, electric = bump(1.2, 6, (22, 32)), bump(-0.8, 5.5, (28, 23))
    lengths = {"source_object_distance": 0.01, "object_image_distance": 0.2, "pixel_size": 1e-6}
    setups = [ProtonSetup(energy=energy, **lengths) for energy in (5, 14.7, 40)]
    images = [
        counted(lambda y, x: b * magnetic(y, x) + e * electric(y, x), SIZE)  # noqa: B023
        for b, e in strengths_of(setups, ("B", "E"))
    ]
    shots = shots_of(noisy(images, 0.02), setup=setups, source=np.ones(SIZE), noise=0.02)
    result = fit(shots, fields=("B", "E"), options=PLAIN)
    assert [field.name for field in result.fields] == ["B", "E"]
    assert distance(result.fields[0].displacement, on_pixels(magnetic, SIZE)) < 0.06
    assert distance(result.fields[1].displacement, on_pixels(electric, SIZE)) < 0.12
    assert result.setups == tuple(setups)


def test_one_image_does_not_tell_an_unknown_beam_from_the_field() -> None:
    image = noisy([counted(WEAK, SIZE)], 0.02)
    options = HASTY.model_copy(update={"ambiguous": True})
    result = fit(shots_of(image, source="unknown", noise=0.02), options=options)
    assert result.verdict is Verdict.AMBIGUOUS
    assert result.chi2[0] < 1.3


def test_an_object_that_has_moved_between_the_images_is_told(
    folded_shots: list[FloatArray],
) -> None:
    moved = counted(lambda y, x: 0.6 * RING_AND_SPOT(y - 3, x), SIZE)
    result = fit(
        shots_of(noisy([folded_shots[0], moved], NOISE), strength=STRENGTHS, noise=NOISE),
        options=HASTY,
    )
    assert result.verdict is Verdict.MISFIT
    assert "image 2" in result.explanation
    assert result.chi2[1] > 2


def test_a_start_at_the_truth_is_taken() -> None:
    image = noisy([counted(WEAK, SIZE)], 0.02)
    y, x = np.indices(SIZE) - np.array([22, 29])[:, None, None]
    truth = 0.4 * 8**2 * np.exp(-(y**2 + x**2) / 2 / 8**2)
    result = fit(Shot(image[0], start=truth, noise=0.02), options=PLAIN)
    assert distance(result.fields[0].displacement, on_pixels(WEAK, SIZE)) < 0.04
    assert result.verdict is Verdict.DETERMINED
    assert result.folded == 0
    for wrong in (truth[1:], np.full(SIZE, np.nan)):
        with pytest.raises(InputError, match="start has shape"):
            fit(Shot(image[0], start=wrong, noise=0.02), options=PLAIN)


def test_a_mask_of_all_images_is_the_mask_of_each() -> None:
    hole = np.zeros(SIZE, bool)
    hole[30:38, 5:12] = True
    shots = np.array(images_of(WEAK))
    shots[:, hole] = 1e6
    by_all = fit(shots_of(shots, strength=STRENGTHS, noise=NOISE, mask=~hole), options=HASTY)
    by_each = fit(
        [
            Shot(s, strength=k, mask=~hole, noise=NOISE)
            for s, k in zip(shots, STRENGTHS, strict=True)
        ],
        options=HASTY,
    )
    assert_array_equal(by_all.mask, np.broadcast_to(~hole, shots.shape))
    assert_array_equal(by_all.fields[0].potential, by_each.fields[0].potential)
    truth = on_pixels(WEAK, SIZE)
    assert distance(by_all.fields[0].displacement, truth) < 0.1


@pytest.mark.usefixtures("no_causes")
def test_a_fit_that_runs_out_of_steps_says_so() -> None:
    image = noisy([counted(bump(1.2, 8, (22, 29)), SIZE)], 0.004)[0]
    for steps in (1, 100):
        options = FitOptions(samples=0, max_iterations=steps, threads=1)
        result = fit(shots_of(image, noise=0.004), options=options)
        assert result.report.converged == (steps == 100)
        assert result.report.converged or result.report.iterations == steps


def test_a_shot_without_the_object_is_one_more_image() -> None:
    """Its strength is zero: an image of the beam."""
    images = noisy([counted(WEAK, SIZE), np.ones(SIZE)], 0.02)
    result = fit(shots_of(images, strength=[1, 0], noise=0.02), options=PLAIN)
    assert distance(result.fields[0].displacement, on_pixels(WEAK, SIZE)) < 0.04
    assert result.verdict is Verdict.DETERMINED


@pytest.mark.usefixtures("no_causes")
@pytest.mark.parametrize(
    ("size", "middle", "boundary"),
    # 61 px are filled to 64, all on the right.
    [(SIZE, (0, 30), "fading"), (SIZE, (0, 30), "free"), ((40, 61), (20, 60), "fading")],
)
def test_an_object_that_the_edge_cuts_is_told(
    size: tuple[int, int], middle: tuple[int, int], boundary: Any
) -> None:
    """A converged answer that explains both images, and is off by a quarter and more."""
    cut = bump(0.7, 8, middle)
    images = [counted(lambda y, x: s * cut(y, x), size) for s in (1, 0.7)]  # noqa: B023
    options = FitOptions(samples=2, spacing=0.25, boundary=boundary)
    shots = shots_of(noisy(images, 0.02), strength=[1, 0.7], source=np.ones(size), noise=0.02)
    result = fit(shots, options=options)
    assert result.chi2.max() < 1.3
    assert result.verdict is Verdict.EDGE
    assert "larger field of view" in result.explanation


def test_an_unknown_beam_does_not_hide_a_strong_field() -> None:
    """Of 14.7 and 3 MeV; the beam has to be held until the field is found."""
    size = (64, 64)

    def beam(y: FloatArray, x: FloatArray) -> FloatArray:
        v, u = y / 32 - 1, x / 32 - 1
        return np.exp(0.25 * np.sin(1.9 * u + 0.4) * np.cos(1.4 * v - 0.5) + 0.12 * u)

    ring = bump(2.3, 7, (29, 33))
    strengths = [1, 2.23]
    images = [counted(lambda y, x: s * ring(y, x), size, beam=beam) for s in strengths]  # noqa: B023
    counts = [np.random.default_rng(k).poisson(400 * image) for k, image in enumerate(images)]
    result = fit(
        shots_of(counts, strength=strengths, source="unknown", noise="poisson"), options=PLAIN
    )
    assert result.verdict is Verdict.DETERMINED
    assert distance(result.fields[0].displacement, on_pixels(ring, size)) < 0.02
    source, shape = result.source[0], beam(*np.indices(size).astype(float))
    assert (source / source.mean() / shape * shape.mean()).std() < 0.02


def test_nothing_is_taken_twice() -> None:
    first, second = noisy([counted(WEAK, SIZE), counted(WEAK, SIZE)], 0.02)
    with pytest.raises(InputError, match="image 1 and image 3 are the same"):
        fit(shots_of([first, second, 3 * first], strength=[1, 0.9, 0.8]), options=PLAIN)
    with pytest.raises(InputError, match="the source is image 2 itself"):
        fit(shots_of([first, second], strength=[1, 0.9], source=second), options=PLAIN)
