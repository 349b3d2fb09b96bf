"""Tests of one static field by a recipe: order, windows, refused input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from napari_shadowinv import FitOptions, InputError, ProtonSetup
from napari_shadowinv.options import FitChoices
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import gaussian_blob
from napari_shadowinv.pipeline import run_leave_one_out
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

SHAPE = (56, 64)
NOISE = 0.02
LENGTHS = {"source_object_distance": 0.01, "object_image_distance": 0.3, "pixel_size": 1e-5}
SETUPS = [ProtonSetup(energy=energy, **LENGTHS) for energy in (5, 7, 10, 14, 20)]
STRENGTHS = [SETUPS[0].momentum / setup.momentum for setup in SETUPS]
TRUTH = gaussian_blob(SHAPE, 40.0, 8.0, (28, 33)).displacement
FACTORS = (1.0, 1.0, 1.0, 1.25, 1.25)
HASTY = FitOptions(samples=0, max_iterations=3, spacing=0.5)
PLAIN = FitOptions(samples=0, spacing=0.2)
RECIPE = Recipe(fit=FitChoices(noise=NOISE, options=PLAIN))


def shots_of(factors: tuple[float, ...], **changes: Any) -> list[Shot]:
    noise = np.random.default_rng(5).normal(0, NOISE, (5, *SHAPE))
    return [
        Shot(synthetic_image(factor * strength * TRUTH) + plane, setup, **changes)
        for factor, strength, setup, plane in zip(factors, STRENGTHS, SETUPS, noise, strict=False)
    ]


def test_nothing_depends_on_the_order_of_images_or_on_threads() -> None:
    shots, order = shots_of(FACTORS)[1:4], [2, 0, 1]
    recipes = [
        Recipe(fit=FitChoices(noise=NOISE, options=HASTY.model_copy(update={"threads": threads})))
        for threads in (1, 2)
    ]
    calls = list(zip(recipes, (shots, [shots[k] for k in order]), strict=True))
    first, second = (run_leave_one_out(*each) for each in calls)
    assert second.explanation == first.explanation
    for name in ("predicted", "residual", "chi2", "alone", "limit", "rms", "brightness"):
        np.testing.assert_array_equal(getattr(second, name), getattr(first, name)[order])


def test_leave_one_out_refuses_too_few_or_unordered_images() -> None:
    with pytest.raises(InputError, match="received 2 images: leaving one out needs 3"):
        run_leave_one_out(RECIPE, shots_of(FACTORS)[:2])
    bare = [Shot(shot.image) for shot in shots_of(FACTORS)]
    with pytest.raises(InputError, match="neither strengths nor setups"):
        run_leave_one_out(RECIPE, bare)
