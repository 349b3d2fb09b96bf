"""What filters and estimated sources leave of an uneven beam, and take from an object."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from napari_shadowinv import Inversion
from napari_shadowinv._typing import FloatArray
from napari_shadowinv.facts import Verdict
from napari_shadowinv.pipeline import run
from napari_shadowinv.preprocessing import Recipe
from napari_shadowinv.shot import Shot

SIDE, RAYS = 96, 4  # rays along a pixel
Y, X = np.indices((SIDE, SIDE), dtype=float)
HIGH_PASS: dict[str, Any] = {"steps": [{"step": "high-pass", "width": 20}]}
BACKGROUND: dict[str, Any] = {"steps": [{"step": "background"}]}
POLYNOMIAL: dict[str, Any] = {"source": {"method": "polynomial"}}


def ring() -> FloatArray:
    y, x = (Y - 50) / 14, (X - 45) / 14
    return 2 * np.exp((1 - y**2 - x**2) / 2) * np.stack([y, x])


def shot(beam: FloatArray, seed: int = 3) -> FloatArray:
    """Count rays one by one where they land."""
    along = (np.arange(SIDE * RAYS) + 0.5) / RAYS - 0.5
    starts = np.stack(np.meshgrid(along, along, indexing="ij"))
    moves = np.stack([map_coordinates(each, starts, mode="nearest") for each in ring()])
    rows, columns = np.rint(starts + moves).astype(int).clip(0, SIDE - 1)
    light = map_coordinates(beam, starts, order=1, mode="nearest") / RAYS**2
    image = np.bincount((rows * SIDE + columns).ravel(), light.ravel(), SIDE**2)
    return np.random.default_rng(seed).poisson(2000 * image.reshape(SIDE, SIDE)).astype(float)


def told_over_true(inversion: Inversion) -> float:
    error = inversion.displacement - ring()
    assert inversion.errors is not None
    return inversion.errors.share / float(np.sqrt((error**2).mean() / (ring() ** 2).mean()))


@pytest.mark.parametrize("recipe", [HIGH_PASS, BACKGROUND])
def test_what_is_taken_from_an_object_in_an_exact_beam_is_in_the_total(recipe: Any) -> None:
    image = shot(np.ones((SIDE, SIDE)))
    found = run(Recipe(**recipe, instrument={"beam_rms": 0.0}), image)
    assert 0.6 < told_over_true(found) < 1.7
    assert found.limited_by is not None
    assert found.limited_by.startswith("filters ")


def test_a_flat_reference_does_not_excuse_a_filter() -> None:
    recorded = Shot(shot(np.ones((SIDE, SIDE))), source=np.ones((SIDE, SIDE)))
    found = run(Recipe(**HIGH_PASS), recorded)
    assert 0.6 < told_over_true(found) < 1.7
    assert found.errors is not None
    assert found.errors.beam_basis == "filtered"  # it is the beam itself
    assert "weaker filters" in found.errors.measure_next(0.01)


def test_a_stated_error_of_an_estimated_source_stays_as_stated() -> None:
    image, stated = shot(np.ones((SIDE, SIDE))), {"beam_rms": 0.02}
    errors = run(Recipe(**POLYNOMIAL, instrument=stated), image).errors
    assert errors is not None
    assert (errors.beam_basis, errors.beam_variation) == ("stated", 0.02)


@pytest.mark.parametrize("recipe", [BACKGROUND, POLYNOMIAL])
def test_a_beam_that_is_removed_leaves_a_smaller_error(recipe: Any) -> None:
    image = shot(1 + 0.2 * (Y / SIDE - 0.5) - 0.3 * (X / SIDE - 0.5) ** 2)
    errors = [run(Recipe(**each), image).errors for each in ({}, recipe)]
    assert all(each is not None and each.beam is not None for each in errors)
    assert errors[1].beam.rms < 0.6 * errors[0].beam.rms
    assert errors[1].beam_basis == "assumed"


def test_what_removes_nothing_leaves_the_assumed_beam() -> None:
    image = shot(np.ones((SIDE, SIDE)))
    wide: dict[str, Any] = {"steps": [{"step": "high-pass", "width": 200}]}
    plain, filtered = (run(Recipe(**each), image) for each in ({}, wide))
    assert plain.verdict is filtered.verdict is Verdict.CONDITIONAL
    assert filtered.errors is not None
    assert plain.errors is not None
    assert filtered.errors.share == pytest.approx(plain.errors.share, rel=0.3)
