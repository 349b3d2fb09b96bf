"""Damage at random is noticed; `benchmarks/damage.py` does the same 500 times."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path


def test_damage_at_random_is_noticed(tmp_path, compiled):
    path = Path(__file__).parents[2] / "benchmarks" / "damage.py"
    spec = importlib.util.spec_from_file_location("damage", path)
    assert spec is not None
    assert spec.loader is not None
    damage = sys.modules["damage"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(damage)
    counts = damage.count_outcomes(24, 3, tmp_path)
    for name in ("bit of a chunk", "lost chunk", "shortened chunk", "bit of a result file"):
        assert counts[name] == {"noticed": 4}, name
