"""Causes of a misfit, for images whose only imperfection is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.fitting.descent import coarser, finer
from napari_shadowinv.fitting.forward import Scene
from napari_shadowinv.fitting.measurements import FitData, collect_data
from napari_shadowinv.fitting.rivals import Comparison, compare_rivals
from napari_shadowinv.fitting.search import Minimum, settle_minimum
from napari_shadowinv.fitting.unknowns import Unknowns
from napari_shadowinv.options import FitOptions
from napari_shadowinv.shot import shots_of

SIDE, NOISE, STRENGTHS = 40, 0.03, (1.0, 0.6)


def tell(stage: str, objective: float) -> None:
    """Hear nothing."""


def given(images: FloatArray) -> FitData:
    return collect_data(
        shots_of(
            images, strength=STRENGTHS[: len(images)], source=np.ones((SIDE, SIDE)), noise=NOISE
        ),
        options=FitOptions(smoothness=0.05, threads=1),
    )


def blob(scene: Scene) -> Unknowns:
    """A blob, in pixels of two."""
    truth = coarser(scene, 2).nothing()
    y, x = np.indices(truth.potentials.shape[1:])
    middle = (len(y) - 1) / 2
    truth.potentials[0] = 4 * np.exp(-((y - middle) ** 2 + (x - middle) ** 2) / 2 / 1.4**2)
    return truth


def images_of_blob() -> FloatArray:
    noise = NOISE * np.random.default_rng(1).normal(size=(2, SIDE, SIDE))
    scene = given(1 + noise).scene
    return scene.model(finer(blob(scene))) + noise


def settled(images: FloatArray) -> tuple[FitData, Scene, Minimum]:
    data = given(images)
    empty = np.zeros((1, 2, SIDE // 2, SIDE // 2))
    start = Minimum("truth", blob(data.scene), np.inf, empty)
    return data, data.scene, settle_minimum(data.scene, start, tell)


def test_compare_rivals_names_a_shift_between_images() -> None:
    images = images_of_blob()
    images[1] = np.roll(images[1], 1, axis=1)
    cause = compare_rivals(*settled(images), tell).cause()
    assert cause.startswith("a shift between the images")


def test_compare_rivals_names_nothing_where_nothing_is_wrong() -> None:
    assert compare_rivals(*settled(images_of_blob()), tell).cause() == ""


@pytest.mark.parametrize(
    ("gains", "cause"),
    [
        ({("blur",): 9.0, ("shift",): 2.0}, ""),  # the fit itself is as likely
        ({("blur",): 40.0, ("shift",): 35.0}, ""),
        ({("blur",): 40.0, ("shift",): 25.0}, "blur"),
        ({("shift", "scale"): 44.0, ("shift",): 40.0}, "a shift"),  # a scale is not needed
        ({("shift", "scale"): 60.0, ("shift",): 40.0}, "a turn"),
        ({("blur",): 1000.0, ("shift",): 975.0}, ""),  # beyond the accuracy of a descent
    ],
)
def test_cause_wins_clearly_or_is_the_simplest(
    gains: dict[tuple[str, ...], float], cause: str
) -> None:
    named = Comparison(gains).cause()
    assert named.startswith(cause)
    assert bool(named) == bool(cause)


def test_tried_lists_the_likeliest_first() -> None:
    tried = Comparison({("shift",): 3.0, ("blur",): 5.0}).tried
    assert tried == "blur beyond the point spread, a shift between the images"


def test_a_wider_beam_starts_as_the_narrower_one() -> None:
    """Numbers are in standard deviations: their shape stays in that of another prior."""
    data = collect_data(
        shots_of(images_of_blob(), strength=STRENGTHS, noise=NOISE), options=FitOptions(threads=1)
    )
    imperfect = data.scene.imperfect
    assert imperfect.keys == {"beam"}
    unknowns = data.scene.nothing()
    unknowns.common[:] = np.random.default_rng(3).normal(size=unknowns.common.size)
    shapes = (replace(imperfect.shapes[0], key="beam"),)
    wide = replace(imperfect, shapes=shapes, responses={"background": 0.1})
    adapted = wide.adapt(unknowns, imperfect)
    before, after = (
        each.shape_changes(numbers.common, numbers.separate)
        for each, numbers in ((imperfect, unknowns), (wide, adapted))
    )
    np.testing.assert_allclose(after, before)
    assert adapted.separate.shape == (2, 1)
