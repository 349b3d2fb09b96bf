"""How kernels are compiled, and where their machine code is kept.

Numba keeps machine code in the folder ``NUMBA_CACHE_DIR``, beside the package, or else in the
home, and fails where none of these can be written, as for an account without a home that runs
an installation shared by many users. There it is kept in a private folder in the temporary
directory, which starts with what lies beside the package; failing that, each process compiles
anew.
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

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator; `cache` is true wherever machine code can be kept."""

    def compiled(function: Function) -> Function:
        made: Any = numba.njit(**{**options, "cache": is_kept()})(function)
        if _own_folder_is_used():
            beside_package = Path(made.py_func.__code__.co_filename).parent / "__pycache__"
            _copy_code(beside_package, Path(made.stats.cache_path))
        return cast(Function, made)

    return compiled


@cache
def is_kept() -> bool:
    """Return whether machine code is kept for later processes."""
    return _numba_finds_a_folder() or _own_folder_is_used()


@cache
def _numba_finds_a_folder() -> bool:
    try:
        numba.njit(cache=True)(_kernel_of_nothing)
    except RuntimeError:
        return False
    return True


def _kernel_of_nothing() -> None:
    """For numba to look where it would keep its machine code."""


@cache
def _own_folder_is_used() -> bool:
    """Have numba use a folder in the temporary directory, if it finds none itself."""
    if _numba_finds_a_folder():
        return False
    folder = _own_folder()
    if folder is None:
        return False
    settings: Any = numba.config
    settings.CACHE_DIR = str(folder)
    try:
        numba.njit(cache=True)(_kernel_of_nothing)
    except RuntimeError:
        settings.CACHE_DIR = ""
        return False
    return True


def _own_folder() -> Path | None:
    """Return a folder that nobody else can have put code into."""
    if not hasattr(os, "getuid"):
        return None
    with suppress(OSError):
        folder = Path(tempfile.gettempdir()) / f"napari-shadowinv-{os.getuid()}"
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        found = folder.lstat()
        is_private = not stat.S_IMODE(found.st_mode) & 0o077
        if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and is_private:
            return folder
    return None


@cache
def _copy_code(made: Path, kept: Path) -> None:
    """Start with what was compiled when the package was installed."""
    if any(kept.glob("*.nbi")):
        return
    # Numba does without what is missing.
    with suppress(OSError, shutil.Error):
        # The index of a kernel after its code, to which it refers.
        for path in sorted(made.glob("*.nb[ci]")):
            shutil.copy(path, kept)


def kernel_that_allocates(function: Function) -> Function:
    """Compile a kernel of the triangulation that makes arrays."""
    return njit(nogil=True, cache=True)(function)


def kernel(function: Function) -> Function:
    """Compile a kernel that makes no array, without numba's reference counting."""
    # The counting is atomic and happens whenever an array is taken from a tuple; in short
    # functions that pass a mesh along it costs twice as much as the geometry.
    return njit(nogil=True, cache=True, _nrt=False)(function)
