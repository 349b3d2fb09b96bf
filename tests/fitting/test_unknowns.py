"""Unknowns as one array and back."""

from __future__ import annotations

import numpy as np

from napari_shadowinv.fitting.unknowns import Unknowns


def some(seed: int) -> Unknowns:
    rng = np.random.default_rng(seed)
    shapes = ((2, 4, 5), (4,), (2,), (2, 6), (2, 3))
    return Unknowns(*(rng.normal(size=shape) for shape in shapes))


def test_flat_and_like_are_inverses() -> None:
    unknowns = some(0)
    flat = unknowns.flat()
    assert flat.shape == (2 * 4 * 5 + 4 + 2 + 12 + 6,)
    for part, restored in zip(unknowns, unknowns.like(flat), strict=True):
        np.testing.assert_array_equal(part, restored)


def test_sums_are_those_of_the_parts() -> None:
    first, second = some(1), some(2)
    np.testing.assert_array_equal(first.plus(second).flat(), first.flat() + second.flat())
    np.testing.assert_array_equal(first.plus(second, -3).flat(), first.flat() - 3 * second.flat())
