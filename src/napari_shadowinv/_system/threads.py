"""Kernels on several threads, with results that do not depend on how many.

A kernel gets a range ``start, stop`` of independent items and writes only what
belongs to them, so the cut into ranges cannot change a result. Plain threads are
enough because the kernels release the GIL; unlike numba's own thread pool they can be
used from any number of callers at once.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


def available_threads(threads: int | None) -> int:
    """Return `threads`, or the number of cores this process may use where it is None."""
    if threads is not None:
        return threads
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on macOS or Windows
        return os.cpu_count() or 1


def in_ranges(
    kernel: Callable[..., Any], n: int, threads: int, *args: Any, smallest: int = 4096
) -> None:
    """Call ``kernel(start, stop, *args)`` on ranges that cover ``0 … n``, in parallel.

    A range has no fewer items than `smallest`, the number that is worth a thread.
    """
    ranges = max(1, min(threads, n // smallest))
    bounds = [n * k // ranges for k in range(ranges + 1)]
    if ranges == 1:
        kernel(0, n, *args)
        return
    with ThreadPoolExecutor(ranges - 1) as pool:
        others = [pool.submit(kernel, bounds[k], bounds[k + 1], *args) for k in range(1, ranges)]
        kernel(bounds[0], bounds[1], *args)
        for other in others:
            other.result()
