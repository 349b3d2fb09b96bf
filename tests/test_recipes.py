"""Recipes: what forms, commands and stacks keep of an estimate or a filter."""

from __future__ import annotations

import inspect
import pickle
from typing import Any

import numpy as np
import pytest

from napari_shadowinv import filters, recipes, sources


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
            other = one.model_copy(update={name: getattr(one, name) + 1})
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
