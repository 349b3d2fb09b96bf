"""The examples of stacks run as they are."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from napari_shadowinv import read
from napari_shadowinv.io.store import DONE, FAILED

EXAMPLES = Path(__file__).parents[2] / "examples" / "notebooks"


def test_the_night_is_inverted_but_for_the_shot_that_was_lost(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(EXAMPLES / "stack_night.py"))
    result = read("night/night.shadowinv.zarr")
    status = result.status.values
    assert list(np.flatnonzero(status == FAILED)) == [5]
    assert (status == DONE).sum() == 15
    assert "failed: shot_5.tif" in capsys.readouterr().out
    # The plume of shot 0 was made with a peak of 14 px² on a plane of about zero.
    assert float(np.abs(names["done"].potential[0]).max()) == pytest.approx(14, rel=0.1)
    assert Path("night/night.png").read_bytes().startswith(b"\x89PNG")
