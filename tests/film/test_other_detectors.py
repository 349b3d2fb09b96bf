"""Facts about tracks in CR-39 and luminescence of image plates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from napari_shadowinv.errors import InputError
from napari_shadowinv.film import Luminescence, Tracks, fading, fuji_luminescence, ge_luminescence

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


BOTH = [fuji_luminescence, ge_luminescence]
SETTINGS = {"resolution": 25.0, "sensitivity": 1000.0, "latitude": 5.0}
Convert = Callable[..., Luminescence]


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("convert", BOTH)
def test_the_end_of_the_scale_is_the_same_for_both(convert: Convert, bits: int) -> None:
    psl, saturated = convert([[2**bits - 1, 2**bits - 2]], bits=bits, **SETTINGS)
    # (25/100)² · 4000/1000 · 10^(5/2)
    assert psl[0, 0] == pytest.approx(0.0625 * 4 * 10**2.5, rel=1e-14)
    np.testing.assert_array_equal(saturated, [[True, False]])


def test_the_latitude_is_the_number_of_decades_on_a_logarithmic_scale() -> None:
    scan = [[0, 13107, 26214, 65535]]  # 0, 1/5, 2/5 and all of the scale
    psl = fuji_luminescence(scan, **SETTINGS).psl
    np.testing.assert_allclose(np.log10(psl / psl[0, 0]), [[0, 1, 2, 5]], atol=1e-12)
    # In the middle of the scale the latitude cancels.
    for latitude in (4.0, 5.0):
        middle = fuji_luminescence([[127.5]], **{**SETTINGS, "latitude": latitude}, bits=8).psl
        assert middle[0, 0] == pytest.approx(0.25, rel=1e-14)


def test_gel_holds_roots() -> None:
    psl = ge_luminescence([[0, 1, 2, 100]], **SETTINGS).psl
    np.testing.assert_allclose(psl / psl[0, 1], [[0, 1, 4, 10_000]], rtol=1e-13)
    # As a script of LLNL's has it for 16 bits and latitude 5, with rounded numbers.
    luminescence = ge_luminescence([[40_000]], resolution=50, sensitivity=4000).psl[0, 0]
    assert luminescence == pytest.approx(0.000023284 * 40_000**2 / 100_000 * 0.25 * 316.2, rel=1e-4)


@pytest.mark.parametrize("convert", BOTH)
def test_the_settings_scale_it(convert: Convert) -> None:
    scan = np.arange(0, 60_000, 1000).reshape(6, 10)
    psl = convert(scan, **SETTINGS).psl
    for name, value, factor in (("sensitivity", 4000.0, 1 / 4), ("resolution", 50.0, 4.0)):
        changed = convert(scan, **{**SETTINGS, name: value}).psl
        np.testing.assert_allclose(changed, factor * psl, rtol=1e-13)


@pytest.mark.parametrize(
    ("scan", "changes", "words"),
    [
        ([[300]], {"bits": 8}, "from 300 to 300: expected 0 to 255 for 8 bits"),
        ([[-1]], {}, "expected 0 to 65535"),
        ([[np.nan]], {}, "expected 0 to 65535"),
        ([1, 2], {}, "expected \\(height, width\\)"),
        ([[]], {}, "expected \\(height, width\\)"),
        ([[1]], {"bits": 0}, "bits is 0"),
        ([[1]], {"sensitivity": 0.0}, "sensitivity is 0"),
        ([[1]], {"latitude": np.nan}, "latitude is nan"),
        ([[1]], {"resolution": np.inf}, "resolution is inf"),
    ],
)
@pytest.mark.parametrize("convert", BOTH)
def test_impossible_values_are_refused(
    convert: Convert, scan: Any, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        convert(scan, **{**SETTINGS, **changes})


@pytest.mark.parametrize(
    ("plate", "after_an_hour"), [("MS", 0.8558), ("SR", 0.4252), ("TR", 0.5008), ("MP", 0.4527)]
)
def test_fading_starts_at_one_and_falls(plate: str, after_an_hour: float) -> None:
    assert fading(0, plate) == pytest.approx(1, abs=1e-12)
    shares = [fading(minutes, plate) for minutes in (0, 1, 10, 60, 600, 4000)]
    assert (np.diff(shares) < 0).all()
    assert fading(60, plate) == pytest.approx(after_an_hour, abs=5e-5)


def test_fading_beyond_its_fit_is_refused() -> None:
    for minutes in (-1, 4001, np.nan):
        with pytest.raises(InputError, match="expected 0 to 4000"):
            fading(minutes, "TR")
    with pytest.raises(InputError, match="expected one of MS, SR, TR, MP"):
        fading(10, "ND")
