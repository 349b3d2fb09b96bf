"""Recipes: what forms, commands and stacks keep of an estimate or a filter."""

from __future__ import annotations

import inspect
import pickle
from typing import Any

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.phantoms import paper_setup
from napari_shadowinv.preprocessing import filters, recipes, sources


@pytest.mark.parametrize(
    ("recipe", "function"),
    [
        (recipes.PolynomialEstimate, sources.polynomial_source),
        (recipes.TotalVariationEstimate, sources.total_variation_source),
        (recipes.InterpolatedEstimate, sources.interpolated_source),
        (recipes.BackgroundFilter, filters.remove_background),
        (recipes.HotPixelFilter, filters.remove_hot_pixels),
    ],
)
def test_defaults_are_those_of_the_function(recipe: Any, function: Any) -> None:
    parameters = inspect.signature(function).parameters
    for name, field in recipe.model_fields.items():
        if parameters[name].default is not inspect.Parameter.empty:
            assert field.default == parameters[name].default, name


@pytest.mark.parametrize("recipe", [*recipes.ESTIMATES.values(), *recipes.FILTERS.values()])
def test_a_recipe_names_its_function_and_tells_choices_apart(recipe: Any) -> None:
    home = sources if issubclass(recipe, recipes.Estimate) else filters
    taken = inspect.signature(getattr(home, recipe.function)).parameters
    assert recipe.model_fields.keys() <= taken.keys()
    one = recipe()
    assert pickle.loads(pickle.dumps(one)) == one
    assert one.described.startswith(recipe.title)
    for name in recipe.model_fields:
        if name != "kind":
            other = one.model_copy(update={name: (getattr(one, name) or 0) + 1})
            assert other.described != one.described


@pytest.mark.parametrize("junk", [np.nan, -1e6, 1e6])
@pytest.mark.parametrize("recipe", recipes.FILTERS.values())
def test_filters_do_not_see_masked_pixels(recipe: Any, junk: float) -> None:
    rng = np.random.default_rng(0)
    image = 100 + rng.normal(size=(40, 50))
    usable = np.ones(image.shape, bool)
    usable[20:24, 30:37] = False
    expected = recipe().filtered(image, usable)
    spoilt = np.where(usable, image, junk)
    np.testing.assert_array_equal(recipe().filtered(spoilt, usable)[usable], expected[usable])


NEAR = paper_setup().model_copy(update={"pixel_size": 6.5e-6})


def test_an_isotropic_estimate_is_the_function_in_its_experiment() -> None:
    image = 1 + np.random.default_rng(0).random((30, 40))
    whole = recipes.IsotropicEstimate().placed(NEAR, image.shape)
    expected = sources.isotropic_source(image, NEAR)
    np.testing.assert_array_equal(whole.source(image, None), expected)
    assert pickle.loads(pickle.dumps(whole)) == whole
    # Another experiment is another estimate, also for what keeps the last one.
    other = NEAR.model_copy(update={"source_object_distance": 2.6e-3})
    assert recipes.IsotropicEstimate().placed(other, image.shape) != whole
    # Of a part, with the axis in the middle of the whole.
    part = (
        recipes.IsotropicEstimate()
        .placed(NEAR, image.shape, (10, 4))
        .source(expected[10:22, 4:25], None)
    )
    np.testing.assert_allclose(part, expected[10:22, 4:25], rtol=1e-12)
    # With pixels merged.
    chosen = recipes.IsotropicEstimate(centre_y=3, centre_x=21).placed(NEAR, image.shape)
    blocks = chosen.source(image, None).reshape(15, 2, 20, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(chosen.coarser(2).source(blocks, None), blocks, rtol=1e-9)


def test_an_isotropic_estimate_needs_the_setup_of_a_point_source() -> None:
    isotropic = recipes.IsotropicEstimate()
    with pytest.raises(InputError, match="'isotropic' without a setup"):
        isotropic.placed(None, (4, 4))
    with pytest.raises(InputError, match="'isotropic' without a setup"):
        isotropic.source(np.ones((4, 4)), None)
    collimated = NEAR.model_copy(update={"source_object_distance": np.inf})
    with pytest.raises(InputError, match="collimated beam"):
        isotropic.placed(collimated, (4, 4))
