"""Whether a first inversion will have to wait for the compiler: `is_compiled`."""

from __future__ import annotations

from pathlib import Path

__all__ = ["COMPILING", "is_compiled"]

COMPILING = "First run: compiling for this machine, once; this takes a minute or so"


def is_compiled() -> bool:
    """Return whether an earlier run has left its machine code for this one.

    Returns
    -------
    bool
        False after an installation, and where the cache (``NUMBA_CACHE_DIR``, or a folder
        beside the package) is empty.
    """
    from napari_shadowinv.geometry._flips import build

    kept = Path(build.stats.cache_path)  # type: ignore[attr-defined]
    return any(kept.glob("_flips.build-*.nbi"))
