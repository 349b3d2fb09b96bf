"""Machine code of the kernels, cached from one run to the next.

- whether it is loaded or cached: `is_loaded`, `is_compiled`; its folder: `code_folder`
- how often compilation delays a run, in words: `compilation_frequency`
- load it, or compile it in two processes: `loading_kernels`
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from napari_shadowinv._system.machine import available_threads

_REST = "from napari_shadowinv.inversion.compilation import compile_rest; compile_rest()"


@contextmanager
def loading_kernels() -> Iterator[None]:
    """Load kernels where this process has none.

    Where none are cached, another process compiles those that this one needs last.
    """
    if is_loaded():
        yield
        return
    with _compiling_together():
        yield


@contextmanager
def _compiling_together() -> Iterator[None]:
    # Numba lets one thread of a process compile at a time.
    executable = Path(sys.executable or "")
    alone = available_threads(None) == 1 or not executable.stem.lower().startswith("python")
    if alone or is_compiled() or code_folder() is None:
        yield
        return
    import numba

    config: Any = numba.config
    environment = os.environ | ({"NUMBA_CACHE_DIR": config.CACHE_DIR} if config.CACHE_DIR else {})
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
        helper.terminate()  # this process has compiled the rest by now
        helper.wait()


def compilation_frequency() -> str:
    """Return how often compilation delays a run, in words."""
    from napari_shadowinv.geometry.compiler import is_code_cached

    if is_code_cached():
        return "once, for a minute or so"
    return "every time: set NUMBA_CACHE_DIR to a writable folder"


def is_compiled() -> bool:
    """Return whether the machine code is loaded, or cached by an earlier process."""
    from napari_shadowinv.geometry import flips
    from napari_shadowinv.geometry.compiler import has_machine_code

    return has_machine_code(flips.build)


def is_loaded() -> bool:
    """Return whether this process has loaded kernels of the triangulation, or compiles none."""
    from napari_shadowinv.geometry.flips import build

    # NUMBA_DISABLE_JIT leaves plain functions.
    return bool(getattr(build, "signatures", True))


def code_folder() -> Path | None:
    """Return the folder of the triangulation's machine code; None where nothing can be cached."""
    from napari_shadowinv.geometry.compiler import is_code_cached
    from napari_shadowinv.geometry.flips import build

    if not is_code_cached():
        return None
    return Path(build.stats.cache_path)  # type: ignore[attr-defined]
