"""A recipe applied to several images of one object: the same as doing each step by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.fit_images import of_each
from napari_shadowinv import Fit, InputError, Instrument, ProtonSetup, fit
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.io import read, write
from napari_shadowinv.options import FitChoices, FitOptions
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import run_fit
from napari_shadowinv.pipeline.fit_run import collect_fit_inputs
from napari_shadowinv.preprocessing import (
    Bin,
    Crop,
    LowPassEstimate,
    Recipe,
)
from napari_shadowinv.shot import Shot, shots_of

pytestmark = pytest.mark.usefixtures("no_causes")

SHAPE = (84, 92)
SETUPS = [
    ProtonSetup(
        energy=energy, source_object_distance=0.01, object_image_distance=0.3, pixel_size=1e-5
    )
    for energy in (14.7, 5.0)
]
RATIO = SETUPS[0].momentum / SETUPS[1].momentum
HASTY = FitOptions(samples=0, max_iterations=3, spacing=0.25, threads=1)
STEPS = (Crop(y=(4, 84), x=(0, 80)), Bin(factor=2))


@pytest.fixture(scope="module")
def images() -> list[FloatArray]:
    truth = gaussian_blob(SHAPE, 40.0, 9.0, (42, 40)).displacement
    noise = np.random.default_rng(0).normal(0, 0.02, (2, *SHAPE))
    return [synthetic_image(s * truth) + n for s, n in zip((1.0, RATIO), noise, strict=True)]


def binned(values: FloatArray) -> FloatArray:
    return np.asarray(values[4:84, :80].reshape(40, 2, 40, 2).sum(axis=(1, 3)))


def assert_same_fields(one: Fit, other: Fit) -> None:
    for first, second in zip(one.fields, other.fields, strict=True):
        np.testing.assert_array_equal(first.potential, second.potential)
        np.testing.assert_array_equal(first.displacement, second.displacement)
    np.testing.assert_array_equal(one.reprojection, other.reprojection)


def test_run_fit_equals_a_fit_of_the_prepared_images(images: list[FloatArray]) -> None:
    mask = np.ones(SHAPE, bool)
    mask[10:14, 20:24] = False
    source = np.full(SHAPE, 1.0)
    choices = FitChoices(noise=0.04, source_size=1e-5, brightness="free", options=HASTY)
    shots = [
        Shot(image, setup, source=source, mask=mask)
        for image, setup in zip(images, SETUPS, strict=True)
    ]
    result = run_fit(Recipe(steps=STEPS, fit=choices), shots)
    after = [setup.model_copy(update={"pixel_size": 2e-5}) for setup in SETUPS]
    spread = 1e-5 * (1 - 1 / SETUPS[0].magnification) / 2e-5
    by_hand = fit(
        shots_of(
            list(map(binned, images)),
            mask=binned(mask) == 4,
            setup=after,
            source=np.full((40, 40), 4.0),
            noise=0.04,
            psf=[spread, spread],
            brightness="free",
        ),
        options=HASTY,
    )
    assert_same_fields(result, by_hand)
    assert result.setups == tuple(after)
    # Kept once, because it is the same.
    assert [origin.mask for origin in result.provenance.images] == [0, 0]
    np.testing.assert_array_equal(result.provenance.masks[0].mask(), mask)


def test_a_source_is_estimated_from_each_image_after_the_steps(images: list[FloatArray]) -> None:
    recipe = Recipe(steps=STEPS, source=LowPassEstimate(width=20))
    inputs = collect_fit_inputs(recipe, [Shot(image, strength=(1.0,)) for image in images])
    expected = [LowPassEstimate(width=20).source(binned(image)) for image in images]
    np.testing.assert_allclose(of_each(inputs.shots, "source"), expected)
    assert inputs.provenance.recipe.source == LowPassEstimate(width=20)


def test_an_unknown_beam_takes_no_source_and_is_no_assumed_one(images: list[FloatArray]) -> None:
    unknown = Recipe(fit=FitChoices(beam="unknown"))
    for recipe, source in ((Recipe(), "unknown"), (unknown, None)):
        shots = [
            Shot(image, setup, source=source) for image, setup in zip(images, SETUPS, strict=True)
        ]
        inputs = collect_fit_inputs(recipe, shots)
        assert inputs.choices.beam == "unknown"
        assert all(shot.beam_unknown and shot.measured for shot in inputs.shots)
    estimated, both = LowPassEstimate(), "a source and a fit with an unknown beam"
    for recipe, shots, words in (
        (Recipe(), [Shot(images[0], source="unknown"), Shot(images[1])], "has no unknown source"),
        (unknown.model_copy(update={"source": estimated}), [images[0]], both),
        (Recipe(source=estimated), [Shot(images[0], source="unknown")], both),
    ):
        with pytest.raises(InputError, match=words):
            collect_fit_inputs(recipe, shots)


def test_fit_warns_of_broken_pixels_in_an_image(images: list[FloatArray], tmp_path: Path) -> None:
    second = images[1].copy()
    second[20, 30] = 40.0
    shots = [Shot(image, setup) for image, setup in zip((images[0], second), SETUPS, strict=True)]
    result = run_fit(Recipe(fit=FitChoices(noise=0.02, options=HASTY)), shots)
    (caution,) = (each for each in result.cautions if each.code != "verdict")
    assert caution.code == "hot-pixels"
    assert caution.text.startswith("image 2: hot pixels: 1 pixel of the image differs")
    path = write(tmp_path / "fit.shadowinv", result)
    assert Fit.from_dataset(read(path)).cautions == result.cautions


def test_a_fit_takes_the_instrument_of_its_recipe(images: list[FloatArray]) -> None:
    instrument = Instrument(background=0.05)
    choices = FitChoices(noise=0.04, options=HASTY.model_copy(update={"samples": 2}))
    shots = [
        Shot(image, setup, source=np.ones(SHAPE))
        for image, setup in zip(images, SETUPS, strict=True)
    ]
    result = run_fit(Recipe(steps=STEPS, instrument=instrument, fit=choices), shots)
    assert result.report.numbers.keys() == {"background"}
    assert result.provenance is not None
    assert result.provenance.recipe.instrument == instrument


def test_a_source_declared_as_an_estimate_has_the_error_of_one(images: list[FloatArray]) -> None:
    choices = FitChoices(noise=0.04, options=HASTY.model_copy(update={"samples": 2}))
    are_fitted: dict[bool, bool] = {}
    for measured in (True, False):
        shots = [
            Shot(image, setup, source=np.ones(SHAPE), measured=measured)
            for image, setup in zip(images, SETUPS, strict=True)
        ]
        result = run_fit(Recipe(steps=STEPS, fit=choices), shots)
        # A beam that is not fitted has an estimated error; a uniform one is exact.
        are_fitted[measured] = result.errors.beam_sensitivity is None
        assert (result.errors.shares.get("beam", 0.0) > 0) == (not measured)
        assert result.provenance is not None
        assert [image.measured for image in result.provenance.images] == 2 * [measured]
    assert are_fitted == {True: False, False: True}


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ([{"brightness": "free"}, {"brightness": 1.0}], "image 2 has no free brightness"),
        ([{"noise": np.ones(SHAPE)}], "image 1 has an array as its noise"),
        ([{"psf": np.ones(SHAPE)}], "image 1 has an array as its psf"),
        ([{"start": np.ones(SHAPE)}], "array as its start, which a result cannot repeat"),
        ([{"fiducials": [[1.0, 2.0]]}], "expected rows of y, x, dy, dx, σ in px"),
    ],
)
def test_what_a_fit_cannot_take_or_repeat_is_refused(
    images: list[FloatArray], known: list[dict[str, Any]], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        collect_fit_inputs(Recipe(), [Shot(images[k], **each) for k, each in enumerate(known)])
