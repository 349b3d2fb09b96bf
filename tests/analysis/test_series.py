"""Time series of products, and their growth rates."""

from __future__ import annotations

import numpy as np
import pytest

from helpers.exact_fields import SETUP, field_of
from napari_shadowinv.analysis import Flux, Region, analyse, time_series
from napari_shadowinv.errors import InputError
from napari_shadowinv.inversion import invert
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
    assert series.growth_rate("rms").value == pytest.approx(RATE, rel=1e-9)
    assert series.variables["rms"].unit == "T m"
    ratio = series["peak"].value[1:] / series["peak"].value[:-1]
    np.testing.assert_allclose(ratio, np.exp(RATE * 1e-9))


def test_interval_of_a_growth_rate_holds_it():
    inside = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        results = []
        for time in TIMES:
            image = rng.poisson(150 * synthetic_image(field_at(time).displacement))
            inversion = invert(image, source=np.full(image.shape, 150.0))
            results += analyse(inversion, REGION, setup=SETUP, samples=20)
        rate = time_series(results, TIMES).growth_rate("mean")
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
        series.growth_rate("median")
