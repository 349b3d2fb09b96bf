"""Compilation of kernels, whose machine code numba keeps.

It does so in the folder ``NUMBA_CACHE_DIR``, next to the package, or in the home directory. Where
it can write to none of these, each process compiles again.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
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
        return cast(Function, numba.njit(**{**options, "cache": is_code_cached()})(function))

    return compiled


@cache
def is_code_cached() -> bool:
    """Return whether machine code is cached for later processes."""
    if _is_compiler_off():
        return False
    try:
        numba.njit(cache=True)(_empty_kernel)
    except RuntimeError:
        return False
    return True


def has_machine_code(kernel: Any) -> bool:
    """Return whether a kernel is loaded, or was cached by an earlier process as it is now."""
    if getattr(kernel, "signatures", True):  # NUMBA_DISABLE_JIT leaves plain functions
        return True
    if not is_code_cached():
        return False
    source = Path(kernel.py_func.__code__.co_filename)
    version = f"py{sys.version_info.major}{sys.version_info.minor}"
    name = f"{source.stem}.{kernel.py_func.__name__}-*.{version}*.nbi"
    build_times = (index.stat().st_mtime for index in Path(kernel.stats.cache_path).glob(name))
    return max(build_times, default=0.0) >= source.stat().st_mtime


@cache
def _is_compiler_off() -> bool:
    """Return whether NUMBA_DISABLE_JIT is set, as by debuggers and for coverage."""
    settings: Any = numba.config
    return bool(settings.DISABLE_JIT)


def _empty_kernel() -> None:
    """Do nothing: numba looks for its cache folder when it compiles this."""


def kernel_that_allocates(function: Function) -> Function:
    """Compile a kernel of the triangulation that makes arrays."""
    return njit(nogil=True, cache=True)(function)


def kernel(function: Function) -> Function:
    """Compile a kernel that makes no array, without numba's reference counting."""
    # The counting is atomic and happens whenever an array is taken from a tuple; in short
    # functions that pass a mesh along it costs twice as much as the geometry.
    return njit(nogil=True, cache=True, _nrt=False)(function)
