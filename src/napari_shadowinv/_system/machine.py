"""Memory, threads and Ctrl-C: `physical_memory`, `in_ranges`, `interrupts_put_off`."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from typing import Any


def physical_memory() -> int | None:
    """Physical memory in bytes, or None where the system does not tell."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


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
    """Call ``kernel(start, stop, *args)`` on ranges of at least `smallest` items that cover n."""
    # The items are independent and a kernel writes only what belongs to them, so the cut cannot
    # change a result. Plain threads suffice because the kernels release the GIL; unlike numba's
    # own pool they can be used from any number of callers at once.
    ranges = max(1, min(threads, n // smallest))
    bounds = [n * k // ranges for k in range(ranges + 1)]
    if ranges == 1:
        kernel(0, n, *args)
        return
    pool = _helpers()
    others = [pool.submit(kernel, bounds[k], bounds[k + 1], *args) for k in range(1, ranges)]
    try:
        kernel(bounds[0], bounds[1], *args)
    finally:
        wait(others)
    for other in others:
        other.result()


@cache
def _helpers() -> ThreadPoolExecutor:
    """Threads for the kernels, kept because to start one takes as long as a small kernel."""
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="kernels of shadowinv")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # threads are not copied


@contextmanager
def interrupts_put_off() -> Iterator[None]:
    """Put a Ctrl-C off until the end of a short block that must not be left half done."""
    if threading.current_thread() is not threading.main_thread():  # Ctrl-C never reaches those
        yield
        return
    late: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: late.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if late:
            signal.raise_signal(signal.SIGINT)
