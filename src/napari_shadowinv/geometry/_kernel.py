"""How the kernels of the triangulation are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

__all__ = ["kernel", "kernel_that_allocates"]

Function = TypeVar("Function", bound=Callable[..., Any])


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
    return cast(Function, njit(nogil=True, cache=True)(function))


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
    compiled = njit(nogil=True, cache=True, _nrt=False)(function)  # type: ignore[call-overload]
    return cast(Function, compiled)
