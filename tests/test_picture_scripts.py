"""Computations of the scripts that make the pictures of the pages."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

DOCS = Path(__file__).parents[1] / "docs"
FRAMES, SAMPLES = 5, 40


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(DOCS)
    return importlib.import_module("make_analysis_pictures")


@pytest.mark.parametrize("share", [0.68, 0.95])
def test_band_of_the_mean_of_frames_holds_flicker_and_shared_errors(
    script: ModuleType, share: float
) -> None:
    rng = np.random.default_rng(0)
    places = 4000  # each is a repetition
    flicker, shared = 1.0, 0.3
    shared_error = shared * rng.normal(size=places)
    frames = flicker * rng.normal(size=(FRAMES, places)) + shared_error
    samples = frames.mean(axis=0) + shared * rng.normal(size=(SAMPLES, places))
    mean = script.mean_of_frames(frames, [samples] * FRAMES)
    np.testing.assert_allclose(mean.value, frames.mean(axis=0))
    low, high = mean.band(share)
    assert np.mean((low <= 0) & (high >= 0)) == pytest.approx(share, abs=0.04)
