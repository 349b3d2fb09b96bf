"""Files damaged at random end in one of two errors, soon and with little memory."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io import write
from napari_shadowinv.physics.setup import ProtonSetup

FUZZ = Path(__file__).parents[2] / "benchmarks" / "fuzz.py"
# Those need an inversion, whose kernels would have to be compiled for these alone.
RESULTS = ("inversion.h5", "result.shadowinv")
STORE = "run.shadowinv.zarr"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux reports memory")


def load() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz", FUZZ)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fuzz"] = module
    spec.loader.exec_module(module)
    return module


fuzz = load()


@pytest.fixture(scope="module")
def reader() -> Iterator[Any]:
    process = fuzz.Reader()
    yield process
    process.close()


@pytest.mark.parametrize("name", [name for name in fuzz.FORMATS if name != STORE])
def test_damage_at_random(
    tmp_path: Path, name: str, reader: Any, inversion: Inversion, proton_setup: ProtonSetup
) -> None:
    good = tmp_path / "good" / name
    good.parent.mkdir()
    if name in RESULTS:
        write(good, inversion, setup=proton_setup)
    else:
        fuzz.FORMATS[name](good)
    tally = fuzz.fuzz(name, 30, 1, tmp_path, reader, good)
    assert tally.failures == []
    assert tally.files == 30
    assert tally.refused >= 3
