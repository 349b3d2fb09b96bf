"""Masks over structure and beside it."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.fitting.verdict import hidden_contrast

Y, X = np.indices((64, 64))
RING = np.exp(-((np.hypot(Y - 32, X - 32) - 14) ** 2) / 2 / 2**2)[None]


def holed(middle: tuple[int, int], side: int) -> np.ndarray:
    used = np.ones((1, 64, 64), bool)
    row, column = (place - side // 2 for place in middle)
    used[0, row : row + side, column : column + side] = False
    return used


@pytest.mark.parametrize(
    ("middle", "side", "is_hidden"),
    [((32, 46), 16, True), ((32, 46), 6, False), ((10, 10), 14, False)],
    ids=["over the ring", "too small to matter", "beside it"],
)
def test_hidden_contrast_is_that_of_structure_under_holes(
    middle: tuple[int, int], side: int, is_hidden: bool
) -> None:
    assert (hidden_contrast(RING, holed(middle, side)) > 0.5) == is_hidden


def test_hidden_contrast_is_zero_without_a_mask_in_one_image() -> None:
    assert hidden_contrast(RING, np.ones((1, 64, 64), bool)) == 0
    used = np.concatenate([holed((32, 46), 16), np.ones((1, 64, 64), bool)])
    assert hidden_contrast(np.concatenate([RING, RING]), used) == 0
