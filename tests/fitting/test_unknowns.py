"""Unknowns as one array and back."""

from __future__ import annotations

import numpy as np

from napari_shadowinv.fitting.unknowns import Unknowns


def some(seed: int) -> Unknowns:
    rng = np.random.default_rng(seed)
    return Unknowns(*(rng.normal(size=shape) for shape in ((2, 4, 5), (3, 3), (2,), (2, 6))))


def test_flat_and_like_are_inverses() -> None:
    unknowns = some(0)
    flat = unknowns.flat()
    assert flat.shape == (2 * 4 * 5 + 9 + 2 + 12,)
    for one, other in zip(unknowns, unknowns.like(flat), strict=True):
        np.testing.assert_array_equal(one, other)


def test_sums_are_those_of_the_parts() -> None:
    one, other = some(1), some(2)
    np.testing.assert_array_equal(one.plus(other).flat(), one.flat() + other.flat())
    np.testing.assert_array_equal(one.plus(one.zeros()).flat(), one.flat())
