"""Computations of the scripts that make the pictures of the pages."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
PLACES = 2000  # repetitions
SAMPLES = 100


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("make_analysis_pictures")


@pytest.mark.parametrize(("count", "shared"), [(3, 0.0), (11, 0.6)])
def test_band_of_the_mean_of_frames_holds_flicker_and_shared_errors(
    script: ModuleType, count: int, shared: float
) -> None:
    rng = np.random.default_rng(0)
    error = shared * rng.normal(size=PLACES)
    frames = rng.normal(size=(count, PLACES)) + error
    samples = frames.mean(axis=0) + shared * rng.normal(size=(SAMPLES, PLACES))
    mean = script.mean_of_frames(frames, [samples] * count)
    np.testing.assert_allclose(mean.value, frames.mean(axis=0))
    for share in (0.68, 0.95):
        low, high = mean.band(share)
        assert np.mean((low <= 0) & (high >= 0)) == pytest.approx(share, abs=0.03)
