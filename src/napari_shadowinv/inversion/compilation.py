"""The compiler's work, done once after an installation.

- do it before an inversion that somebody waits for: `ensure_compiled`
- the half of it that needs no triangulation, for a second process: `compile_rest`
- how often it is waited for: `how_often`
- whether it was done: `is_compiled`; where its result is kept: `code_folder`
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop

_REST = "from napari_shadowinv.inversion.compilation import compile_rest; compile_rest()"
_NODES = 300  # enough for a multigrid


def ensure_compiled(
    on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
) -> None:
    """Compile all kernels, as else the first inversion would, unless an earlier run has."""
    if is_compiled():
        return
    from napari_shadowinv.inversion import invert

    Reporter(on_progress, should_stop)("compile", 0, None, how_often())
    y, x = np.indices((64, 64)) / 64  # enough sites for every kernel to be used
    uneven = np.exp(-4 * (y + x))
    with _rest_beside():
        invert(uneven * (1 + y * x), source=uneven, should_stop=should_stop)


@contextmanager
def _rest_beside() -> Iterator[None]:
    """Have another process compile what this one needs last, which loads what is there by then."""
    # Numba lets one thread of a process compile at a time.
    executable = Path(sys.executable or "")
    alone = available_threads(None) == 1 or not executable.stem.lower().startswith("python")
    if alone or code_folder() is None:
        yield
        return
    import numba

    found: Any = numba.config
    environment = os.environ | ({"NUMBA_CACHE_DIR": found.CACHE_DIR} if found.CACHE_DIR else {})
    helper = subprocess.Popen(
        [executable, "-c", _REST],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
    )
    try:
        yield
    finally:
        helper.terminate()  # what it has not done by now is done
        helper.wait()


def compile_rest() -> None:
    """Compile what an inversion does with a triangulation once it is there, last things first."""
    from scipy.spatial import Delaunay

    from napari_shadowinv.geometry.density import Density
    from napari_shadowinv.geometry.interpolation import CloughTocher, fit_gradients
    from napari_shadowinv.geometry.power_diagram import PowerDiagram
    from napari_shadowinv.physics.forward import synthetic_image
    from napari_shadowinv.transport.factorised import FactorisedLaplacian
    from napari_shadowinv.transport.linear import LaplacianSolver

    synthetic_image(np.zeros((2, 8, 8)), np.ones((8, 8)))
    sites = np.random.default_rng(0).uniform(0, 19, (_NODES, 2))
    ghosts = 1e3 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    points = np.concatenate([sites, ghosts])
    mesh = Delaunay(points)
    arrays = {
        "points": points,
        "weights": np.zeros(len(points)),
        "vertices": mesh.simplices.astype(np.int32),
        "neighbors": mesh.neighbors.astype(np.int32),
    }
    for array in arrays.values():
        array.flags.writeable = False  # as those of a triangulation, which is another type
    triangulation: Any = SimpleNamespace(sites=arrays["points"][:-4], **arrays)
    values = sites.sum(axis=1)
    gradients = fit_gradients(triangulation, values, np.ones_like(sites))
    CloughTocher(triangulation, values, gradients)(sites)
    density = Density.from_image(np.ones((20, 20)))
    for with_moments in (True, False):
        diagram = PowerDiagram(triangulation, density, with_moments=with_moments)
    laplacian = diagram.laplacian()
    LaplacianSolver(laplacian).solve(diagram.masses)
    FactorisedLaplacian(laplacian).solve(diagram.masses[:, None])


def how_often() -> str:
    """Return how often the compiler is waited for, in words."""
    from napari_shadowinv.geometry._kernel import is_kept

    if is_kept():
        return "once, for a minute or so"
    return "every time: set NUMBA_CACHE_DIR to a writable folder"


def is_compiled() -> bool:
    """Return whether an earlier run has left its machine code for this one."""
    kept = code_folder()
    return kept is not None and any(kept.glob("_flips.build-*.nbi"))


def code_folder() -> Path | None:
    """Return the folder of the triangulation's machine code; None where none can be kept."""
    from napari_shadowinv.geometry._flips import build
    from napari_shadowinv.geometry._kernel import is_kept

    if not is_kept():
        return None
    return Path(build.stats.cache_path)  # type: ignore[attr-defined]
