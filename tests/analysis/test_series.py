"""Time series of products."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import (
    Contrast,
    LineProfile,
    Region,
    analyse,
    analyse_shots,
)
from napari_shadowinv.analysis.series import shot_times
from napari_shadowinv.errors import InputError
from napari_shadowinv.physics.phantoms import toroid

REGION = Region(center=(15.5, 15.5), radius=10)
RATE = 2e8  # 1/s
TIMES = 1e-9 * np.arange(3)


def field_at(time: float):
    return toroid((32, 32), SETUP, 20 * np.exp(RATE * time), 6e-6)


def stack_of(times, gap: int | None = None) -> xr.Dataset:
    """Return exact fields along an axis of shots, without that of one."""
    stack = xr.concat([field_of(field_at(time)).dataset for time in times], "shot")
    if gap is not None:
        stack["displacement"][gap] = np.nan
    return stack.assign_attrs(field_of(field_at(0)).dataset.attrs)


def test_each_shot_of_a_stack_with_a_field_is_measured():
    times = 1e-9 * np.array([0.0, 1.0, 1.5, 3.0])
    (series,) = analyse_shots(stack_of(times, gap=1), REGION, times)
    np.testing.assert_allclose(series.coordinates["time"].values, times[[0, 2, 3]])
    (last,) = analyse(field_of(field_at(times[3])), REGION)
    assert series["rms"].value[-1] == pytest.approx(float(last["rms"].value), rel=1e-12)
    assert series["rms"].value.shape == (3,)
    (by_shot,) = analyse_shots(stack_of(TIMES), REGION)
    np.testing.assert_array_equal(by_shot.coordinates["shot"].values, [0, 1, 2])


def test_wrong_stacks_and_times_are_refused():
    stack = stack_of(TIMES)
    for wrong, times, message in (
        (stack.isel(shot=0), None, "no stack of shots"),
        (stack, [0.0, 1.0], "one for each of 3 shots"),
        (stack_of(TIMES[:2], gap=0), None, "1 of 2 shots have a field"),
        (stack, [0.0, 1.0, 1.0], "do not increase"),
    ):
        with pytest.raises(InputError, match=message):
            analyse_shots(wrong, REGION, times)


def test_product_without_a_number_is_refused_after_one_shot():
    measured = []
    with pytest.raises(InputError, match="profile along a line has no single number to follow"):
        analyse_shots(
            stack_of(TIMES),
            LineProfile(path=[(2, 2), (9, 9)]),
            on_progress=lambda progress: measured.append(progress.step),
        )
    assert measured == [0]


def test_series_states_numbers_in_their_units():
    contrast, region = (analyse_shots(stack_of(TIMES), each)[0] for each in (Contrast(), REGION))
    first, last = contrast["mu"].value[[0, -1]]
    assert contrast.facts[0].text == f"{first:.4g} to {last:.4g}, first to last shot"
    texts = {fact.key: fact.text for fact in region.facts}
    first, last = 1e6 * region["centroid_y"].value[[0, -1]]
    assert texts["centroid_y"] == f"{first:.4g} to {last:.4g} µm, first to last shot"


def test_times_follow_from_the_time_between_two_shots():
    assert shot_times([2.0], [0, 2, 5], "--times") == [0, 4, 10]
    assert shot_times([1.0, 3.0], [0, 2], "--times") == [1, 3]
    with pytest.raises(InputError, match="--times, expected the time between two shots in s"):
        shot_times([1.0, 3.0], [0, 1, 2], "--times")
