"""Recipes: what forms, commands and stacks keep of an estimate or a filter."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest

from napari_shadowinv import preprocessing
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.setup import ProtonSetup


@pytest.mark.parametrize(
    "recipe", [*preprocessing.ESTIMATES.values(), *preprocessing.STEPS.values()]
)
def test_a_choice_describes_its_values(recipe: Any) -> None:
    choice = recipe()
    assert pickle.loads(pickle.dumps(choice)) == choice
    assert choice.summary.startswith(recipe.title)
    for name, value in choice.values().items():
        if isinstance(value, (int, float)):
            changed_choice = choice.model_copy(update={name: value + 1})
            assert changed_choice.summary != choice.summary


@pytest.mark.parametrize("junk", [np.nan, -1e6, 1e6])
@pytest.mark.parametrize("recipe", preprocessing.FILTERS.values())
def test_filters_do_not_see_masked_pixels(recipe: Any, junk: float) -> None:
    rng = np.random.default_rng(0)
    image = 100 + rng.normal(size=(40, 50))
    usable = np.ones(image.shape, bool)
    usable[20:24, 30:37] = False
    expected = recipe().filter_image(image, usable)
    spoilt = np.where(usable, image, junk)
    np.testing.assert_array_equal(recipe().filter_image(spoilt, usable)[usable], expected[usable])


NEAR = ProtonSetup.example().model_copy(update={"pixel_size": 6.5e-6})


def test_an_isotropic_estimate_is_that_of_its_experiment() -> None:
    image = 1 + np.random.default_rng(0).random((30, 40))
    estimate = preprocessing.IsotropicEstimate().adapt_to(NEAR, image.shape)
    expected = estimate.source(image)
    assert pickle.loads(pickle.dumps(estimate)) == estimate
    # Another experiment is another estimate, also for what keeps the last one.
    nearer_setup = NEAR.model_copy(update={"source_object_distance": 2.6e-3})
    assert preprocessing.IsotropicEstimate().adapt_to(nearer_setup, image.shape) != estimate
    # Of a part, with the axis in the middle of the whole.
    shifted = np.array([[1.0, 0, 10], [0, 1, 4], [0, 0, 1]])
    part = (
        preprocessing.IsotropicEstimate()
        .adapt_to(NEAR, image.shape, shifted)
        .source(expected[10:22, 4:25], None)
    )
    np.testing.assert_allclose(part, expected[10:22, 4:25], rtol=1e-12)


def test_an_isotropic_estimate_needs_the_setup_of_a_point_source() -> None:
    isotropic = preprocessing.IsotropicEstimate()
    with pytest.raises(InputError, match="'isotropic' and no setup"):
        isotropic.adapt_to(None, (4, 4))
    with pytest.raises(InputError, match="'isotropic' and no setup"):
        isotropic.source(np.ones((4, 4)), None)
    collimated = NEAR.model_copy(update={"source_object_distance": np.inf})
    with pytest.raises(InputError, match="collimated beam"):
        isotropic.adapt_to(collimated, (4, 4))
