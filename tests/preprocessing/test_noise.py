"""The order of pixels by their values."""

from __future__ import annotations

import numpy as np
import pytest

from napari_shadowinv.preprocessing.noise import order_by_value


@pytest.mark.parametrize("scale", [1e-290, 1.0, 1e290])
def test_order_by_value_sorts_at_any_scale(scale: float) -> None:
    values = scale * np.random.default_rng(3).integers(-5, 50, 3000)
    order = order_by_value(values)
    assert np.array_equal(order, np.argsort(values, kind="stable"))
    assert np.array_equal(order_by_value(np.full(7, scale)), np.arange(7))
