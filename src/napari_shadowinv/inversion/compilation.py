"""The compiler's work, done once after an installation.

- do it before an inversion that somebody waits for: `ensure_compiled`
- how often it is waited for: `how_often`
- whether it was done: `is_compiled`; where its result is kept: `code_folder`
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop


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
    invert(uneven * (1 + y * x), source=uneven, should_stop=should_stop)


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
