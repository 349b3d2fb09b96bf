"""Compilation of kernels, and the folder that caches their machine code.

Numba caches machine code in the folder ``NUMBA_CACHE_DIR``, next to the package, or in the home
directory. It fails if it can write to none of these, for example under an account without a home
that runs a shared installation. Then a private folder in the temporary directory is used, which
starts as a copy of the code next to the package. Failing that, each process compiles again.
"""

from __future__ import annotations

import os
import shutil
import stat
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator; `cache` is true wherever machine code can be cached."""

    def compiled(function: Function) -> Function:
        if _is_compiler_off():
            # Plain Python warns where the hashes of machine code wrap around.
            return np.errstate(over="ignore")(function)
        dispatcher: Any = numba.njit(**{**options, "cache": is_code_cached()})(function)
        if _uses_private_folder():
            beside_package = Path(dispatcher.py_func.__code__.co_filename).parent / "__pycache__"
            _copy_code(beside_package, Path(dispatcher.stats.cache_path))
        return cast(Function, dispatcher)

    return compiled


@cache
def is_code_cached() -> bool:
    """Return whether machine code is cached for later processes."""
    return not _is_compiler_off() and (_numba_can_cache() or _uses_private_folder())


@cache
def _is_compiler_off() -> bool:
    """Return whether NUMBA_DISABLE_JIT is set, as by debuggers and for coverage."""
    settings: Any = numba.config
    return bool(settings.DISABLE_JIT)


@cache
def _numba_can_cache() -> bool:
    try:
        numba.njit(cache=True)(_empty_kernel)
    except RuntimeError:
        return False
    return True


def _empty_kernel() -> None:
    """Do nothing: numba looks for its cache folder when it compiles this."""


@cache
def _uses_private_folder() -> bool:
    """Make numba use a folder in the temporary directory if it has none of its own."""
    if _numba_can_cache():
        return False
    folder = _private_folder()
    if folder is None:
        return False
    settings: Any = numba.config
    settings.CACHE_DIR = str(folder)
    try:
        numba.njit(cache=True)(_empty_kernel)
    except RuntimeError:
        settings.CACHE_DIR = ""
        return False
    return True


def _private_folder() -> Path | None:
    """Return a folder that nobody else can have put code into."""
    if not hasattr(os, "getuid"):
        return None
    with suppress(OSError):
        folder = Path(tempfile.gettempdir()) / f"napari-shadowinv-{os.getuid()}"
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.lstat()
        is_private = not stat.S_IMODE(status.st_mode) & 0o077
        if stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and is_private:
            return folder
    return None


@cache
def _copy_code(installed: Path, cache_folder: Path) -> None:
    """Copy the code that was compiled when the package was installed."""
    if any(cache_folder.glob("*.nbi")):
        return
    # Missing files only cost numba another compilation.
    with suppress(OSError, shutil.Error):
        # The index of a kernel after its code, to which it refers.
        for path in sorted(installed.glob("*.nb[ci]")):
            shutil.copy(path, cache_folder)


def kernel_that_allocates(function: Function) -> Function:
    """Compile a kernel of the triangulation that makes arrays."""
    return njit(nogil=True, cache=True)(function)


def kernel(function: Function) -> Function:
    """Compile a kernel that makes no array, without numba's reference counting."""
    # The counting is atomic and happens whenever an array is taken from a tuple; in short
    # functions that pass a mesh along it costs twice as much as the geometry.
    return njit(nogil=True, cache=True, _nrt=False)(function)
