"""Fits of images with blur, dead pixels, shifts, unknown brightness and counts, any shape."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from helpers.fit_images import bump, counted, distance, noisy, on_pixels, together
from napari_shadowinv._system.progress import Progress
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.facts import Verdict
from napari_shadowinv.fitting import Fit, fit
from napari_shadowinv.fitting.rays import RayModel
from napari_shadowinv.options import FitOptions, Instrument
from napari_shadowinv.shot import Shot, shots_of

SIZE = (48, 56)
STRENGTHS = [1, 0.6]
NOISE = 0.03
STAGES = ("from near", "transport", "smoothness", "full size", "samples")
RING = bump(3.0, 5.5, (23, 29), tall=1.2)


def shot(number: int, size: tuple[int, int] = SIZE, **changes: Any) -> FloatArray:
    return counted(lambda y, x: STRENGTHS[number] * RING(y, x), size, **changes)


@pytest.fixture(scope="module")
def shots() -> list[FloatArray]:
    return [shot(0), shot(1)]


def fitted(images: Any, align: Any = "none", threads: int = 1, **keywords: Any) -> Fit:
    options = FitOptions(samples=0, max_iterations=30, spacing=0.25, threads=threads, align=align)
    known = {"strength": STRENGTHS, "noise": NOISE} | keywords
    return fit(shots_of(images, **known), options=options)


def error(result: Fit) -> float:
    (field,) = result.fields
    height, width = field.potential.shape
    return distance(field.displacement, on_pixels(RING, (height, width)))


@pytest.mark.usefixtures("no_causes")
def test_a_known_point_spread_is_undone() -> None:
    images = noisy([shot(0, blur=1.5), shot(1, blur=1.5)], NOISE)
    result = fitted(images, psf=1.5)
    assert error(result) < 0.05
    assert (result.chi2 < 1.2).all()
    assert result.verdict is Verdict.DETERMINED
    told_nothing = fitted(images, psf=0.0)
    assert error(told_nothing) > 2 * error(result)


def test_a_blur_that_was_not_told_is_noticed() -> None:
    """It would pass for a weaker field, with a perfect χ²; one image is enough to see it."""
    size = (64, 64)
    ring = bump(1.9, 8, (32, 32))
    for blur in (0.0, 2.0):
        image = noisy([counted(ring, size, blur=blur)], 0.02)[0]
        keywords = {"strength": None, "noise": 0.02, "source": np.ones(size)}
        blind = fitted(image, psf=0.0, **keywords)
        aware = fitted(image, psf=blur, **keywords) if blur else blind
        assert blind.chi2.max() < 1.1
        assert (blind.verdict is Verdict.MISFIT) == (blur > 0)
        assert ("give the point spread" in blind.explanation) == (blur > 0)
        assert aware.verdict is Verdict.DETERMINED
        truth = on_pixels(ring, size)
        assert distance(aware.fields[0].displacement, truth) < 0.03


@pytest.fixture(scope="module")
def unfolded() -> list[FloatArray]:
    """Two sharp images of a ring without bright lines."""
    ring = bump(0.8, 8, (31.5, 31.5))
    return [counted(lambda y, x, a=a: a * ring(y, x), (64, 64), rays=40) for a in STRENGTHS]


def test_a_dark_level_shows_in_the_noise_of_counts(unfolded: list[FloatArray]) -> None:
    counts = np.random.default_rng(1).poisson(1000 * np.stack(unfolded)).astype(float)
    for offset, threads in ((0.0, 1), (120.0, 2)):
        source = np.full((64, 64), 1000.0 + offset)
        result = fitted(counts + offset, source=source, noise="poisson", threads=threads)
        assert result.report.pattern < 5
        assert (result.verdict is Verdict.UNCERTAIN) == (offset > 0)
        assert ("dark level" in result.explanation) == (offset > 0)


def test_one_folded_image_does_not_pass_for_an_answer() -> None:
    """The field is 20 % wrong, and explains the image to the noise."""
    size = (64, 64)
    ring = bump(4.0, 8, (32, 32))
    image = noisy([counted(ring, size, blur=1.5)], 0.05)[0]
    keywords = {"strength": None, "noise": 0.05, "source": np.ones(size)}
    result = fitted(image, psf=1.5, **keywords)
    assert result.chi2.max() < 1.1
    assert result.verdict is Verdict.AMBIGUOUS


def test_dead_pixels_are_left_out(shots: list[FloatArray]) -> None:
    images = noisy(shots, NOISE)
    mask = np.random.default_rng(3).random(images.shape) > 0.05
    mask[:, 30:34, 10:20] = False
    images[~mask] = np.nan
    result = fitted(images, mask=mask)
    assert error(result) < 0.06
    np.testing.assert_array_equal(result.mask, mask)
    assert not result.residual[~mask].any()
    assert np.isfinite(result.reprojection).all()
    used = [(plane[use] ** 2).mean() for plane, use in zip(result.residual, mask, strict=True)]
    np.testing.assert_allclose(result.chi2, np.array(used) / NOISE**2)


def test_a_shifted_image_is_brought_back(shots: list[FloatArray]) -> None:
    frame = (1.2, 1, 0, -2.0, 0, 1)
    result = fitted(noisy([shots[0], shot(1, frame=frame)], NOISE), align="shift")
    np.testing.assert_allclose(result.frames[1], frame, atol=0.1)
    np.testing.assert_array_equal(result.frames[0], [0, 1, 0, 0, 0, 1])
    assert error(result) < 0.04


@pytest.mark.usefixtures("no_causes")
def test_a_turned_and_magnified_image_is_brought_back() -> None:
    """Two objects apart tell how one image is turned, which a round one does not."""
    pair = together(bump(3.0, 4.5, (18, 36)), bump(-1.4, 5, (31, 17)))
    frame = (0.5, 1.03, 0.03, -0.6, -0.02, 0.97)
    images = [
        counted(pair, SIZE),
        counted(lambda y, x: 0.6 * pair(y, x), SIZE, frame=frame),
    ]
    result = fitted(noisy(images, NOISE), align="affine")
    np.testing.assert_allclose(result.frames[1][[0, 3]], [0.5, -0.6], atol=0.1)
    np.testing.assert_allclose(
        result.frames[1][[1, 2, 4, 5]], [1.03, 0.03, -0.02, 0.97], atol=0.015
    )
    assert distance(result.fields[0].displacement, on_pixels(pair, SIZE)) < 0.05


def test_unknown_gains_are_found(shots: list[FloatArray]) -> None:
    images = noisy([shots[0], 1.2 * shots[1]], NOISE)
    source = np.ones(SIZE)
    result = fitted(images, brightness="free", source=source)
    assert result.brightness[1] / result.brightness[0] == pytest.approx(1.2, rel=0.005)
    assert error(result) < 0.04
    np.testing.assert_allclose(result.source, result.brightness[:, None, None] * np.ones(SIZE))
    aware = fitted(images, brightness=[1, 1.2], source=source)
    assert error(aware) < 0.04


def test_counts_are_weighted_by_what_is_expected(shots: list[FloatArray]) -> None:
    rng = np.random.default_rng(5)
    counts = [rng.poisson(400 * plane) for plane in shots]
    result = fitted(counts, noise="poisson")
    assert error(result) < 0.03
    np.testing.assert_allclose(result.chi2, 1, atol=0.12)
    # In the units of what was counted.
    assert result.reprojection.mean() == pytest.approx(np.mean(counts), rel=0.02)


@pytest.mark.usefixtures("no_causes")
def test_answers_to_few_counts_are_compared_by_what_is_expected() -> None:
    """As if the noise had been given; dim pixels count too much if weighted by their counts."""
    size = (64, 64)
    strong = bump(6.0, 6, (31, 31))
    counts = np.random.default_rng(5).poisson(30 * counted(strong, size))
    options = FitOptions(samples=0, max_iterations=20, spacing=0.25, smoothness=200, ambiguous=True)
    source = np.full(size, 30)
    result = fit(shots_of(counts, source=source, noise="poisson"), options=options)
    noise = np.sqrt(np.maximum(result.reprojection[0], 1))
    by_deviation = fit(shots_of(counts, source=source, noise=noise), options=options)
    assert result.basins[0].objective == pytest.approx(by_deviation.basins[0].objective, rel=0.03)


def test_units_of_the_images_do_not_matter(shots: list[FloatArray]) -> None:
    """Not even by rounding, if one is a power of two of the other."""
    images = noisy(shots, NOISE)
    options = FitOptions(samples=0, max_iterations=5, spacing=0.25, threads=1)
    first, second = (
        fit(shots_of(unit * images, strength=STRENGTHS, noise=unit * NOISE), options=options)
        for unit in (1, 1024)
    )
    np.testing.assert_array_equal(first.fields[0].displacement, second.fields[0].displacement)
    np.testing.assert_array_equal(first.chi2, second.chi2)
    np.testing.assert_array_equal(1024 * first.reprojection, second.reprojection)


def test_noise_that_nobody_tells_is_found_in_the_images(shots: list[FloatArray]) -> None:
    """Folds of an object that fills the image look like some of it."""
    result = fitted(noisy(shots, NOISE), noise=None)
    assert (result.chi2 > 0.6).all()
    assert (result.chi2 < 1.2).all()
    assert error(result) < 0.03


def test_fiducials_hold_the_field_where_noise_does_not() -> None:
    """A mesh of 25 crossings, known to 0.03 px, against an image with 30 % noise."""
    weak = bump(0.4, 7, (23, 29))
    image = noisy([counted(weak, SIZE)], 0.3)
    truth = on_pixels(weak, SIZE)
    rows, columns = np.meshgrid([7, 15, 23, 31, 39], [13, 21, 29, 37, 45], indexing="ij")
    places = rows.ravel(), columns.ravel()
    displaced = truth[:, *places] + np.random.default_rng(6).normal(0, 0.03, (2, 25))
    fiducials = np.column_stack([*places, *displaced, np.full(25, 0.03)])
    options = FitOptions(samples=0, max_iterations=30, spacing=0.25, threads=1)
    fields = [
        fit(Shot(image[0], fiducials=table, noise=0.3), options=options).fields[0].displacement
        for table in (None, fiducials)
    ]
    missed = [np.sqrt(((field[:, *places] - displaced) ** 2).mean()) for field in fields]
    assert missed[1] < 0.06 < missed[0]
    assert distance(fields[1], truth) < 0.5 * distance(fields[0], truth)


@pytest.mark.parametrize(
    "instrument",
    [None, Instrument(beam_rms=0.0, beam_between=0.05, beam_length=1.0)],
    ids=["exact", "own beams"],
)
def test_neither_threads_nor_a_second_time_change_a_bit(instrument: Instrument | None) -> None:
    ring = bump(1.5, 4.5, (15, 19))
    shots = [counted(lambda y, x, a=a: a * ring(y, x), (32, 40)) for a in STRENGTHS]
    images = noisy(shots, NOISE)
    runs = []
    for threads in (1, 3):
        options = FitOptions(samples=2, max_iterations=5, spacing=0.25, threads=threads, seed=3)
        listed = shots_of(images, strength=STRENGTHS, noise=NOISE)
        runs.append(fit(listed, instrument=instrument, options=options))
    first, second = runs
    facts = {fact.title: fact.text for fact in first.facts}
    assert ("beam between energies" in facts.get("Instrument", "")) == (instrument is not None)
    np.testing.assert_array_equal(first.fields[0].displacement, second.fields[0].displacement)
    assert first.fields[0].errors.per_pixel is not None
    np.testing.assert_array_equal(
        first.fields[0].errors.per_pixel, second.fields[0].errors.per_pixel
    )
    np.testing.assert_array_equal(first.reprojection, second.reprojection)
    assert first.errors.sensitivities == second.errors.sensitivities
    assert first.explanation == second.explanation


@pytest.mark.parametrize("stage", STAGES)
def test_each_stage_of_a_fit_ends_soon_after_it_is_asked(
    shots: list[FloatArray], stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    reached: list[str] = []
    traced: list[int] = []
    trace = RayModel.image

    def count(*args: Any, **keywords: Any) -> Any:
        if stage in reached:
            traced.append(1)
        return trace(*args, **keywords)

    monkeypatch.setattr(RayModel, "image", count)
    options = FitOptions(samples=2, max_iterations=10, spacing=0.25, threads=1)
    with pytest.raises(InversionCancelled):
        fit(
            shots_of(noisy(shots, NOISE), strength=STRENGTHS, noise=NOISE),
            options=options,
            on_progress=lambda news: reached.append(news.message),
            should_stop=lambda: stage in reached,
        )
    assert reached[-1] == stage
    assert len(traced) <= 8 * len(shots)  # a line search of the step under way


def test_each_step_is_told_with_its_stage_and_objective() -> None:
    reports: list[Progress] = []
    image = noisy([counted(bump(0.4, 7, (23, 29)), SIZE)], NOISE)
    options = FitOptions(samples=2, max_iterations=10, spacing=0.25, threads=1)
    fit(shots_of(image, noise=NOISE), options=options, on_progress=reports.append)
    for stage in STAGES:
        objectives = [news.objective for news in reports if news.message == stage]
        assert objectives
        assert all(isinstance(value, float) for value in objectives)
    descent = next(news for news in reports if news.message == "smoothness")
    assert descent.text == f"stage 2 of 3, smoothness, objective {descent.objective:.6g}"
    assert not any("nan" in news.text for news in reports)
    stages = [news.step for news in reports if news.stage == "fit"]  # the bar never goes back
    assert stages == sorted(stages)
    assert set(stages) == {0, 1, 2}
