"""Runs of an inversion: steps, estimates of the source, previews and their cache."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from napari_shadowinv import InversionOptions
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.physics.setup import ProtonSetup
from napari_shadowinv.pipeline import Cache, run
from napari_shadowinv.pipeline.inversion_run import PREVIEW_SITES
from napari_shadowinv.preprocessing import (
    Crop,
    Estimate,
    GaussianEstimate,
    HighPassFilter,
    IsotropicEstimate,
    LowPassEstimate,
    LowPassFilter,
    Recipe,
    UniformEstimate,
)
from napari_shadowinv.shot import Shot

FEW = InversionOptions(n_sites=500)
Array = np.ndarray[Any, Any]


@pytest.fixture(scope="module")
def shot() -> Array:
    """An off-centre blob in an even beam, in counts, that no edge cuts."""
    blob = gaussian_blob((48, 60), 15.0, 6.0, (22.0, 33.0))
    return 300 * synthetic_image(blob.displacement)


def test_a_crop_gives_the_field_of_the_cropped_image(shot: Array) -> None:
    rows, columns = slice(4, 44), slice(10, 58)
    crop = Crop(y=(rows.start, rows.stop), x=(columns.start, columns.stop))
    cropped = run(Recipe(steps=(crop,), options=FEW), shot)
    alone = run(Recipe(options=FEW), shot[rows, columns])
    np.testing.assert_array_equal(cropped.displacement, alone.displacement)


def test_a_preview_starts_from_the_one_before_and_a_run_does_not() -> None:
    shot = synthetic_image(gaussian_blob((48, 60), 45.0, 8.0).displacement)
    cache = Cache()

    def inverted(width: float, preview: bool, cache: Cache = cache) -> Inversion:
        recipe = Recipe(steps=(LowPassFilter(width=width),), options=FEW)
        return run(recipe, shot, cache=cache, preview=preview)

    inverted(1.0, preview=True)
    warm, cold = inverted(1.2, preview=True), inverted(1.2, preview=False)
    assert inverted(1.2, preview=True).report.iterations < cold.report.iterations
    assert warm.report.residual <= FEW.tolerance
    np.testing.assert_allclose(warm.displacement, cold.displacement, atol=0.01)
    # The same whatever was tried before.
    alone = inverted(1.2, preview=False, cache=Cache())
    # But for the last digit of the uniform source, which another filter rounds otherwise.
    np.testing.assert_allclose(cold.displacement, alone.displacement, atol=1e-11)
    assert cold.report.iterations == alone.report.iterations
    plan = cache.plan(2 + np.eye(*shot.shape), None, FEW)
    assert cache.last_inversion(plan) is None


def test_a_flat_source_is_no_other_after_the_image_is_flattened(shot: Array) -> None:
    recipe = Recipe(steps=(HighPassFilter(width=9.0),), options=FEW)
    fields = [run(recipe, Shot(shot, source=beam)) for beam in (None, 3 * np.ones(shot.shape))]
    np.testing.assert_allclose(fields[0].displacement, fields[1].displacement, atol=1e-9)
    assert fields[1].errors.beam.rms > 0  # the filter takes from the object


def test_a_uniform_source_is_planned_once_whatever_the_filter(shot: Array) -> None:
    cache = Cache()
    for width in (1.0, 1.5, 2.0):
        run(Recipe(steps=(LowPassFilter(width=width),), options=FEW), shot, cache=cache)
    assert cache.hits == 2
    report = run(Recipe(source=LowPassEstimate(), options=FEW), shot).report
    assert set(report.seconds) == {"source", "prepare", "sites", "transport", "read-out", "errors"}
    assert report.seconds["sites"] > 0
    assert not report.cautions


def test_doubts_of_a_source_are_in_the_report(shot: Array) -> None:
    near = ProtonSetup.example().model_copy(update={"pixel_size": 2e-5})

    def warnings(source: Estimate, image: Shot | Array = shot) -> str:
        recipe = Recipe(source=source, options=FEW, setup=near)
        return str(run(recipe, image).report.cautions)

    assert "choose the source 'isotropic'" in warnings(UniformEstimate())
    assert "isotropic" not in warnings(IsotropicEstimate())
    y, x = np.mgrid[: shot.shape[0], : shot.shape[1]]
    beam = 100 * np.exp(-((y - 24) ** 2 + (x - 30) ** 2) / 2 / 8**2) + 1
    hidden = np.hypot(y - 24, x - 30) > 10
    doubted = warnings(GaussianEstimate(), Shot(beam * shot, mask=hidden))
    assert "the Gaussian beam rises to" in doubted


def test_the_axis_of_an_isotropic_source_is_in_the_middle_of_the_whole_image(shot: Array) -> None:
    near = ProtonSetup.example().model_copy(update={"pixel_size": 2e-5})
    crop = slice(20, 40), slice(5, 35)
    recipe = Recipe(
        steps=(Crop(y=(20, 40), x=(5, 35)),), source=IsotropicEstimate(), options=FEW, setup=near
    )
    recorded = IsotropicEstimate().adapt_to(near, shot.shape)
    expected = recorded.source(np.ones(shot.shape))[crop]
    for preview in (False, True):
        source = run(recipe, shot, preview=preview).source
        np.testing.assert_allclose(source / source.mean(), expected / expected.mean())


def test_a_preview_has_few_sites(shot: Array) -> None:
    many = np.tile(shot, (2, 2))
    assert many.size > PREVIEW_SITES
    assert run(Recipe(), many, preview=True).report.n_sites == PREVIEW_SITES
    assert run(Recipe(options=FEW), many, preview=True).report.n_sites == 500
