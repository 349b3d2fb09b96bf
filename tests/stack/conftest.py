"""A few small shots with their source, in memory and as files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.forked import forking
from helpers.night import OPTIONS, grouped, make_shots
from helpers.store_content import content
from napari_shadowinv import invert, run_stack
from napari_shadowinv.inversion import plan_sites
from napari_shadowinv.stack import watch


@dataclass(frozen=True)
class Night:
    """Shots with a source, in memory and as files."""

    images: np.ndarray
    source: np.ndarray
    folder: Path

    @property
    def glob(self) -> str:
        return str(self.folder / "shot_*.npy")

    def run(self, out: Path, **changes):
        """Invert its files into a store; choices of `run_stack` may differ."""
        choices = {"shots": self.glob, "source": self.source, "options": OPTIONS, **changes}
        shots, arguments = grouped(choices.pop("shots"), choices)
        return run_stack(shots, out, **arguments)

    def path(self, index: int) -> Path:
        return self.folder / f"shot_{index}.npy"

    @property
    def reads(self) -> list[str]:
        log = self.folder / "reads.txt"
        return log.read_text().split() if log.exists() else []


@pytest.fixture(scope="session")
def compiled() -> None:
    """Compile the kernels of an inversion once, and not in each worker."""
    images, source = make_shots(1)
    plan = plan_sites(source, OPTIONS)
    first = invert(images[0], plan=plan, options=OPTIONS)
    invert(images[0], plan=plan, options=OPTIONS, start=first)


@pytest.fixture(scope="session")
def forked() -> Iterator[Any]:
    """The context of processes that have all modules when they begin."""
    with forking() as context:
        yield context


def written_night(count: int, folder: Path) -> Night:
    images, source = make_shots(count)
    folder.mkdir()
    for index, image in enumerate(images):
        np.save(folder / f"shot_{index}.npy", image)
    return Night(images, source, folder)


@pytest.fixture
def make_night(tmp_path, compiled):
    return lambda count: written_night(count, tmp_path / "shots")


@pytest.fixture(scope="session")
def any_night(tmp_path_factory, compiled) -> Night:
    """One that no test may change."""
    return written_night(6, tmp_path_factory.mktemp("any") / "shots")


@pytest.fixture(scope="session")
def expected(any_night, tmp_path_factory) -> dict[str, bytes]:
    """The content of the store of its shots, made at once and without any fault."""
    store = tmp_path_factory.mktemp("expected") / "expected.shadowinv.zarr"
    any_night.run(store, scheduler="synchronous")
    return content(store)


@pytest.fixture
def night(make_night) -> Night:
    return make_night(6)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "night.shadowinv.zarr"


@pytest.fixture
def folder(tmp_path: Path, compiled: None) -> Path:
    (tmp_path / "live").mkdir()
    return tmp_path / "live"


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look often into watched folders, and end at once when asked to."""
    monkeypatch.setattr(watch, "POLL_S", 0.02)
