"""Facts about tracks in CR-39."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.film import Tracks

SIDE = 1e-3


def tracks_at(y: np.ndarray, x: np.ndarray, size: tuple[float, float] = (SIDE, SIDE)) -> Tracks:
    ones = np.ones(len(y))
    return Tracks(y, x, ones, ones, ones, size)


def test_every_track_is_counted_where_it_lies() -> None:
    y, x = np.random.default_rng(0).random((2, 5000)) * SIDE
    counts, error, side = tracks_at(y, x).image(50.0)
    expected = np.histogram2d(y, x, bins=20, range=[(0, SIDE), (0, SIDE)])[0]
    np.testing.assert_array_equal(counts, expected)
    assert (counts.sum(), side) == (5000, 50.0)
    np.testing.assert_array_equal(error, np.sqrt(expected))


def test_tracks_on_the_edges_count_and_an_empty_bin_has_the_error_of_one_track() -> None:
    y, x = np.array([0.0, SIDE, SIDE]), np.array([0.0, SIDE, 0.0])
    counts, error, _ = tracks_at(y, x).image(250.0)
    assert counts.shape == (4, 4)
    assert counts[0, 0] == counts[3, 3] == counts[3, 0] == 1
    np.testing.assert_array_equal(error, 1.0)


def test_incomplete_bins_at_the_edge_are_cut_off() -> None:
    y, x = np.full(2, 0.1e-3), np.array([0.1e-3, 0.95e-3])
    counts, _, _ = tracks_at(y, x).image(300.0)
    assert (counts.shape, counts.sum()) == ((3, 3), 1)


@pytest.mark.parametrize(
    ("number", "size", "expected"),
    [
        (20_000, (SIDE, SIDE), 50.0),  # 400 bins with 50 each
        (3_000_000, (SIDE, 3 * SIDE), 10.0),  # 300 along the longer side
        (19_999, (SIDE, SIDE), 1e3 / 19),  # a whole number of bins
        (3, (SIDE, SIDE), 500.0),  # two along the shorter one, at least
    ],
)
def test_the_usual_bin(number: int, size: tuple[float, float], expected: float) -> None:
    nowhere = np.zeros(number)
    counts, _, side = tracks_at(nowhere, nowhere, size).image()
    assert side == pytest.approx(expected)
    assert min(counts.shape) >= 2
    assert max(counts.shape) <= 300


@pytest.mark.parametrize("side", [0.0, -1.0, np.nan, np.inf, 501.0, 1e-3])
def test_impossible_bins_are_refused(side: float) -> None:
    with pytest.raises(InputError, match=r"bin is .* expected at most"):
        tracks_at(np.zeros(9), np.zeros(9)).image(side)
