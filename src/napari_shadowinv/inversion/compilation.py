"""The compiler's work, done once after an installation.

- do it before an inversion that somebody waits for: `ensure_compiled`
- whether it was done: `is_compiled`; where its result is kept: `code_folder`
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from napari_shadowinv._system.progress import OnProgress, Reporter, ShouldStop

__all__ = ["code_folder", "ensure_compiled", "is_compiled"]

_SIDE = 64  # enough sites for every kernel to be used


def ensure_compiled(
    on_progress: OnProgress | None = None, should_stop: ShouldStop | None = None
) -> None:
    """Compile all kernels, unless an earlier run has; they are kept for later ones.

    Without it the first inversion does the same, in the middle of its stages.

    Parameters
    ----------
    on_progress : callable, optional
        Told of the stage ``"compile"``, where there is something to compile.
    should_stop : callable, optional
        Asked between kernels; a true answer cancels.

    Raises
    ------
    InversionCancelled
        If `should_stop` returned true.
    """
    if is_compiled():
        return
    from napari_shadowinv.geometry._kernel import is_kept
    from napari_shadowinv.inversion import invert

    how_often = (
        "once, for a minute or so"
        if is_kept()
        else "every time: set NUMBA_CACHE_DIR to a writable folder"
    )
    Reporter(on_progress, should_stop)("compile", 0, None, how_often)
    y, x = np.indices((_SIDE, _SIDE)) / _SIDE
    uneven = np.exp(-4 * (y + x))
    invert(uneven * (1 + y * x), source=uneven, should_stop=should_stop)


def is_compiled() -> bool:
    """Return whether an earlier run has left its machine code for this one.

    It has not after an installation, where the cache (``NUMBA_CACHE_DIR``, or a folder beside the
    package) is empty, or where nothing can be kept.
    """
    kept = code_folder()
    return kept is not None and any(kept.glob("_flips.build-*.nbi"))


def code_folder() -> Path | None:
    """Return the folder of the triangulation's machine code; None where none can be kept."""
    from napari_shadowinv.geometry._flips import build
    from napari_shadowinv.geometry._kernel import is_kept

    if not is_kept():
        return None
    return Path(build.stats.cache_path)  # type: ignore[attr-defined]
