"""Public data for tests: from a folder next to the project, or downloaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pooch
import pytest

from napari_shadowinv._typing import FloatArray
from napari_shadowinv.io.public_images import PUBLIC_FILES, fetch_public_file

SHARED_DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
CACHE = Path(pooch.os_cache("napari-shadowinv"))

# px/(G cm) by the constants in the example's notes: q/(m c v), lengths in cm, 10 µm pixels.
_DONUT_SHIFT = 4.803e-10 / (1.67e-24 * 3e10 * 5.24e9) * 20 / (21.4 / 1.4) / 1e-3

_failures: list[str] = []


def public_names(folder: str, suffix: str = "") -> list[str]:
    """Return the names of the public files in a folder, such as `rcf`."""
    names = (name for name in PUBLIC_FILES if name.startswith(f"{folder}/"))
    return [name for name in names if name.endswith(suffix)]


def public_file(name: str) -> Path:
    """Return the path of a public file; skip the test if it is neither here nor downloadable."""
    if (SHARED_DATA / name).is_file():
        return SHARED_DATA / name
    # Without a network, wait for one timeout only.
    if _failures and not (CACHE / name).is_file():
        pytest.skip(_failures[0])
    try:
        return fetch_public_file(name, cache=CACHE)
    except OSError as error:
        _failures.append(str(error))
        pytest.skip(str(error))


def load_donut() -> tuple[FloatArray, FloatArray]:
    """Return counts and true displacement (px) of the example of PROBLEM."""
    folder = SHARED_DATA / "donut"
    if folder.is_dir():
        return np.load(folder / "intensity.npy"), np.load(folder / "displacement.npy")
    # The files are [x, y].
    image, b_x, b_y = (
        np.loadtxt(public_file(f"donut/{name}.dat"), delimiter=",").T
        for name in ("flux", "Bxpath", "Bypath")
    )
    return image, _DONUT_SHIFT * np.stack([-b_x, b_y])
