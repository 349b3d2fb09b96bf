"""Files damaged at random end in one of two errors, soon and with little memory."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import fuzz
from napari_shadowinv.inversion import Inversion
from napari_shadowinv.io import write
from napari_shadowinv.physics.setup import ProtonSetup

# Those need an inversion, whose kernels would have to be compiled for these alone.
RESULTS = ("inversion.h5", "result.shadowinv")
STORE = "run.shadowinv.zarr"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="only Linux reports memory")


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
