"""Preparation of an inversion: consistent masks and cautions."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.cautions import Caution
from napari_shadowinv.errors import InputError
from napari_shadowinv.preprocessing import (
    Estimate,
    KrigedEstimate,
    PolynomialEstimate,
    Recipe,
    estimate_source,
)
from napari_shadowinv.shot import Shot

SHAPE = (120, 160)


def outside(radius: float, centre: tuple[float, float] = (60, 80)) -> np.ndarray:
    """A mask that hides a disc."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return np.hypot(y - centre[0], x - centre[1]) > radius


def check(estimate: Estimate, mask: np.ndarray | None, source_mask: np.ndarray | None) -> None:
    """Check a recipe with an estimate against a shot with masks."""
    shot = Shot(np.ones(SHAPE), mask=mask, source_mask=source_mask)
    Recipe(source=estimate).check(shot)


OBJECT = outside(25)
DEAD = outside(9, (20, 20)) & outside(4, (100, 150))
FILM = ~outside(75)  # round, and with much beyond it
SMALL = outside(3, (40, 70))
STRAY = outside(1, (5, 5))  # a slip of the brush


@pytest.mark.parametrize(
    ("mask", "source_mask"),
    [
        (OBJECT, OBJECT),
        (OBJECT & DEAD, OBJECT),
        (OBJECT & DEAD, OBJECT & DEAD),
        (outside(24), OBJECT),  # drawn by hand, or binned
        (outside(25, (61, 80)), OBJECT),
        (SMALL & FILM, SMALL),
        (OBJECT, OBJECT & STRAY),
    ],
)
def test_a_mask_that_hides_the_object_too_is_refused(
    mask: np.ndarray, source_mask: np.ndarray
) -> None:
    for estimate in (PolynomialEstimate(), KrigedEstimate()):
        with pytest.raises(InputError, match="the object would be excluded from the inversion"):
            check(estimate, mask, source_mask)


@pytest.mark.parametrize(
    ("mask", "source_mask"),
    [
        (None, OBJECT),
        (DEAD, OBJECT),
        (DEAD, OBJECT & DEAD),
        (FILM, OBJECT & FILM),
        (FILM, SMALL & FILM),  # little of what is hidden is the object
        (outside(15), OBJECT),  # its opaque core
        (OBJECT, None),
    ],
)
def test_masks_that_share_dead_pixels_are_fine(
    mask: np.ndarray | None, source_mask: np.ndarray | None
) -> None:
    check(PolynomialEstimate(), mask, source_mask)


def test_filled_in_pixels_must_be_inverted() -> None:
    with pytest.raises(InputError, match="without a source mask"):
        check(KrigedEstimate(), OBJECT, None)


def test_a_source_dark_behind_the_source_mask_is_reported() -> None:
    """A straight line that falls from 120 to 21 where it is seen, and below zero where not."""
    x = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    for image, count in ((np.maximum(120.0 - x, 15), 1), (np.full(SHAPE, 100.0), 0)):
        cautions: list[Caution] = []
        estimate = PolynomialEstimate(degree=1)
        shot = Shot(image, mask=DEAD, source_mask=x < 100)
        estimate_source(estimate, shot, on_caution=cautions.append)
        assert len(cautions) == count
        # Nor where nothing of it is inverted.
        estimate_source(estimate, Shot(image, mask=x < 100))
