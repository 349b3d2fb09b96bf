"""How kernels are compiled, and where their machine code is kept.

- compile a kernel of the triangulation: `kernel`, `kernel_that_allocates`
- compile another: `njit`, numba's own but for where machine code is kept
- whether it is kept at all: `is_kept`

Numba keeps machine code in the folder ``NUMBA_CACHE_DIR``, beside the package, or else in the
home, and fails where none of these can be written. An installation for many users, run by an
account without a home, is such a case. Then it is kept in a folder of this user in the temporary
directory, which begins with what lies beside the package; and if that cannot be, compiled anew
by each process.
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

__all__ = ["is_kept", "kernel", "kernel_that_allocates", "njit"]

Function = TypeVar("Function", bound=Callable[..., Any])


def njit(**options: Any) -> Callable[[Function], Function]:
    """Return numba's decorator, which keeps the machine code where that is possible.

    Parameters
    ----------
    **options
        Those of `numba.njit`; `cache` is true wherever it can be.

    Returns
    -------
    callable
        The decorator; what it returns is typed as it was written.
    """

    def compiled(function: Function) -> Function:
        made: Any = numba.njit(**{**options, "cache": is_kept()})(function)
        if _own_folder_is_used():
            _begin_with_what_is_there(made)
        return cast(Function, made)

    return compiled


@cache
def is_kept() -> bool:
    """Return whether machine code is kept for later processes.

    Returns
    -------
    bool
        False where there is no folder that could be written.
    """
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
    """A folder that nobody else can have put code into."""
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


def _begin_with_what_is_there(compiled: Any) -> None:
    """Take what was compiled beside the package when it was installed."""
    made = Path(compiled.py_func.__code__.co_filename).parent / "__pycache__"
    _copy_code(made, Path(compiled.stats.cache_path))


@cache
def _copy_code(made: Path, kept: Path) -> None:
    if any(kept.glob("*.nbi")):
        return
    # Numba does without what is missing.
    with suppress(OSError, shutil.Error):
        # The index of a kernel after its code, which it tells of.
        for path in sorted(made.glob("*.nb[ci]")):
            shutil.copy(path, kept)


def kernel_that_allocates(function: Function) -> Function:
    """Compile for threads, and keep the machine code between runs.

    Parameters
    ----------
    function : callable
        What to compile.

    Returns
    -------
    callable
        The compiled function, typed as it was written.
    """
    return njit(nogil=True, cache=True)(function)


def kernel(function: Function) -> Function:
    """Compile likewise, but without numba's reference counting; must not make an array.

    The counting is atomic and happens each time that an array is taken from a tuple; in short
    functions that pass a mesh along it costs twice as much as the geometry.

    Parameters
    ----------
    function : callable
        What to compile.

    Returns
    -------
    callable
        The compiled function, typed as it was written.
    """
    return njit(nogil=True, cache=True, _nrt=False)(function)
