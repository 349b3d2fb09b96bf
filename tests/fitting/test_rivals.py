"""Causes of a misfit, for images whose only imperfection is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.descent import coarser, finer
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.pattern import name_cause
from napari_shadowinv.fitting.search import Minimum, settle_minimum

SIDE, PAD, NOISE = 64, 16, 0.05


def tell(stage: str, objective: float) -> None:
    """Hear nothing."""


@pytest.fixture(scope="module")
def shifted() -> tuple[Scene, Minimum]:
    """Two images of a blob, the second shifted by a pixel, and the best field."""
    scene = Scene(
        images=np.ones((2, SIDE, SIDE)),
        weights=np.full((2, SIDE, SIDE), NOISE**-2),
        strengths=np.array([[1.0], [0.7]]),
        beams=np.ones((2, SIDE + 2 * PAD, SIDE + 2 * PAD)),
        psf=[0.0, 0.0],
        smoothness=np.array([[10.0, 100.0]]),
        pad=PAD,
        threads=1,
    )
    truth = coarser(scene, 2).nothing()
    y, x = np.indices(truth.potentials.shape[1:])
    middle = (len(y) - 1) / 2
    truth.potentials[0] = 8 * np.exp(-((y - middle) ** 2 + (x - middle) ** 2) / 2 / 2.5**2)
    fine = finer(truth)
    images = scene.model(fine, scene.ray_counts(fine))
    images[1] = np.roll(images[1], 1, axis=1)
    images += NOISE * np.random.default_rng(1).normal(size=images.shape)
    scene = replace(scene, images=images)
    start = Minimum("truth", truth, np.inf, np.zeros((1, 2, SIDE // 2, SIDE // 2)))
    return scene, settle_minimum(scene, start, tell)


def stripes(strength: float) -> FloatArray:
    """Stripes that no field, beam or blur makes: one sign in each image."""
    waves = strength * (-1.0) ** (np.arange(SIDE) // 2)
    return np.stack([np.tile(waves, (SIDE, 1)), -np.tile(waves, (SIDE, 1))])


def test_name_cause_finds_a_shift(shifted: tuple[Scene, Minimum]) -> None:
    cause = name_cause(*shifted, ["B"], None, tell)
    assert cause.startswith("the images are not in register")
    assert "something else" not in cause


def test_name_cause_says_what_it_leaves_unexplained(shifted: tuple[Scene, Minimum]) -> None:
    scene, best = shifted
    striped = replace(scene, images=scene.images + stripes(0.1))
    found = settle_minimum(striped, best, tell)
    cause = name_cause(striped, found, ["B"], None, tell)
    assert "in register" in cause
    assert "something else is wrong, too" in cause
