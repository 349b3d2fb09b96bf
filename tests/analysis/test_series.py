"""Time series of products, and their growth rates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import (
    Contrast,
    Flux,
    LineProfile,
    Region,
    analyse,
    analyse_shots,
    growth_rate,
    time_series,
)
from napari_shadowinv.analysis.series import shot_times
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import invert
from napari_shadowinv.inversion.error_bars import Quantity
from napari_shadowinv.inversion.result import RetrievedField
from napari_shadowinv.inversion.variables import dataset_from_field
from napari_shadowinv.physics.forward import synthetic_image
from napari_shadowinv.physics.phantoms import toroid

REGION = Region(center=(15.5, 15.5), radius=10)
RATE = 2e8  # 1/s
TIMES = 1e-9 * np.arange(3)


def field_at(time: float):
    return toroid((32, 32), SETUP, 20 * np.exp(RATE * time), 6e-6)


def test_growth_rate_of_an_exponential_is_exact():
    results = [analyse(field_of(field_at(time)), REGION)[0] for time in TIMES]
    series = time_series(results, TIMES)
    assert growth_rate(series, "rms").value == pytest.approx(RATE, rel=1e-9)
    assert series.variables["rms"].unit == "T m"
    ratio = series["peak"].value[1:] / series["peak"].value[:-1]
    np.testing.assert_allclose(ratio, np.exp(RATE * 1e-9))


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
    assert growth_rate(series, "rms").value == pytest.approx(RATE, rel=1e-9)
    assert series["rms"].value.shape == (3,)
    (by_shot,) = analyse_shots(stack_of(TIMES), REGION)
    assert growth_rate(by_shot, "rms").value == pytest.approx(RATE * 1e-9, rel=1e-9)


def test_band_of_a_growth_rate_follows_from_the_scatter_of_the_shots():
    inside, times = [], 1e-9 * np.arange(6)
    (exact,) = analyse_shots(stack_of(times), REGION, times)
    for seed in range(200):
        scatter = np.exp(0.05 * np.random.default_rng(seed).normal(size=6))
        values = Quantity(exact["rms"].value * scatter, np.zeros((0, 6)))
        series = replace(exact, quantities={"rms": values})
        low, high = growth_rate(series, "rms").band(0.68)
        inside.append(low <= RATE <= high)
    assert np.mean(inside) == pytest.approx(0.68, abs=0.1)


def test_wrong_stacks_and_times_are_refused():
    stack = stack_of(TIMES)
    for wrong, times, message in (
        (stack.isel(shot=0), None, "no stack of shots"),
        (stack, [0.0, 1.0], "one for each of 3 shots"),
        (stack_of(TIMES[:2], gap=0), None, "1 of 2 shots have a field"),
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


def test_growth_in_pixels_is_that_of_the_field_and_not_of_places():
    fields = [field_at(time) for time in TIMES]
    data = [dataset_from_field(each.displacement, each.potential, None) for each in fields]
    series = time_series([analyse(RetrievedField(each), REGION)[0] for each in data], TIMES)
    keys = {fact.key for fact in series.facts}
    assert {"growth_mean", "growth_peak", "growth_rms"} <= keys
    assert not {"growth_centroid_y", "growth_centroid_x"} & keys
    assert series.variables["rms"].unit == series.variables["centroid_y"].unit == "pixel"
    assert ("centroid_y", "centroid_x") in series.curve_groups


def test_times_follow_from_the_time_between_two_shots():
    assert shot_times([2.0], [0, 2, 5], "--times") == [0, 4, 10]
    assert shot_times([1.0, 3.0], [0, 2], "--times") == [1, 3]
    with pytest.raises(InputError, match="--times, expected the time between two shots in s"):
        shot_times([1.0, 3.0], [0, 1, 2], "--times")


def test_interval_of_a_growth_rate_holds_it():
    inside = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        results = []
        for time in TIMES:
            image = rng.poisson(150 * synthetic_image(field_at(time).displacement))
            inversion = invert(image, source=np.full(image.shape, 150.0))
            results += analyse(inversion, REGION, setup=SETUP, samples=20)
        rate = growth_rate(time_series(results, TIMES), "mean")
        low, high = rate.band(0.95)
        inside.append(low <= RATE <= high)
        assert 0 < rate.std < 0.3 * RATE
    assert sum(inside) >= 3


def test_shots_that_do_not_belong_together_are_refused():
    first, second = (analyse(field_of(field_at(time)), REGION)[0] for time in TIMES[:2])
    (flux,) = analyse(field_of(field_at(0)), Flux(path=[(5, 5), (9, 9)]))
    for results, times, message in (
        ([first], [0.0], "at least two shots"),
        ([first, second], [0.0], "a time for each"),
        ([first, second], [1.0, 1.0], "do not increase"),
        ([first, flux], [0.0, 1.0], "different products"),
    ):
        with pytest.raises(InputError, match=message):
            time_series(results, times)
    series = time_series([first, second], TIMES[:2])
    with pytest.raises(InputError, match="expected one of mean, peak"):
        growth_rate(series, "median")
