"""Memory, threads and signals.

- `physical_memory`, `available_threads`, `set_default_threads`
- `in_ranges`, `run_together`, `results_of`, `begin`: work in threads
- Ctrl-C, SIGTERM and SIGHUP: `defer_interrupts`, `clear_up_when_terminated`, `handling`
"""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

_T = TypeVar("_T")
_CGROUPS = Path("/sys/fs/cgroup")
_MEMBERSHIP = Path("/proc/self/cgroup")


@cache
def physical_memory() -> int | None:
    """Return the memory in bytes that this process may use, or None where it is not reported.

    That is the machine's, or less in a container or in a job of a batch system.
    """
    try:
        installed = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
    return min([installed, *_group_limits()])


def _group_limits() -> Iterator[int]:
    """Limits of the control groups that this process is in, version 2 and 1."""
    try:
        lines = _MEMBERSHIP.read_text().splitlines()
    except (OSError, UnicodeDecodeError):
        return
    for line in lines:
        _, controllers, name = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        root, file = _CGROUPS, "memory.max"
        if controllers:
            root, file = _CGROUPS / "memory", "memory.limit_in_bytes"
        # In a container, its own group is the root of what it sees.
        group = Path(name.lstrip("/"))
        for folder in (root, *(root / part for part in (group, *group.parents))):
            with suppress(OSError, ValueError):
                yield int((folder / file).read_text())  # "max" for none


_default_threads: int | None = None


def set_default_threads(threads: int | None) -> None:
    """Set the number of threads of all later work that requests none; None for all cores."""
    global _default_threads
    _default_threads = threads


def available_threads(threads: int | None) -> int:
    """Return `threads`; where it is None the default, or the number of cores of this process.

    In a function of `results_of`: its current share of them.
    """
    threads = _default_threads if threads is None else threads
    if threads is None:  # macOS and Windows do not report the cores of a process
        affinity = getattr(os, "sched_getaffinity", None)
        threads = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(1, threads // _SIDE_BY_SIDE.get()())


# How many functions run now beside the one of this thread, itself included.
_SIDE_BY_SIDE: ContextVar[Callable[[], int]] = ContextVar("side by side", default=lambda: 1)


LIGHT_ITEMS = 1 << 14  # the smallest range of a kernel that does little with each item


def in_ranges(
    kernel: Callable[..., Any],
    n: int,
    threads: int,
    *args: Any,
    smallest: int = 4096,
    uneven: bool = False,
) -> None:
    """Call ``kernel(start, stop, *args)`` on ranges of at least `smallest` items that cover n.

    There is one range for each thread. Where items take `uneven` times there are four, so that
    a thread with light ranges takes more of them.
    """
    # The items are independent and a kernel writes only what belongs to them, so the cut cannot
    # change a result. Plain threads suffice because the kernels release the GIL; unlike numba's
    # own pool they can be used from any number of callers at once.
    most = max(1, n // smallest)
    threads = max(1, min(threads, most))
    if threads == 1:
        kernel(0, n, *args)
        return
    ranges = min(4 * threads, most) if uneven else threads
    bounds = [n * k // ranges for k in range(ranges + 1)]
    run_together([partial(kernel, *pair, *args) for pair in pairwise(bounds)], threads)


def run_together(works: Sequence[Callable[[], _T]], threads: int) -> list[_T]:
    """Call functions that release the GIL and write nothing in common, and return their results.

    Of several errors, the first function's is raised.
    """
    remaining, results = iter(enumerate(works)), dict[int, _T]()
    errors: dict[int, Exception] = {}

    def run() -> None:
        for number, work in remaining:
            try:
                results[number] = work()
            except Exception as error:
                errors[number] = error
                deque(remaining, maxlen=0)  # no other begins

    futures = [_kernel_pool().submit(run) for _ in range(min(threads, len(works)) - 1)]
    try:
        run()
    finally:
        begun = [future for future in futures if not future.cancel()]
        wait(begun)
    for future in begun:
        future.result()
    if errors:
        raise errors[min(errors)]
    return [results[number] for number in range(len(works))]


def results_of(works: Sequence[Callable[[], _T]], threads: int) -> list[_T]:
    """Call functions side by side, and return their results; their kernels share the threads.

    Those that run last have the threads of those that have ended.
    """
    around, remaining = _SIDE_BY_SIDE.get(), deque(works)

    def count() -> int:
        return max(1, min(threads, len(remaining))) * around()

    def run(work: Callable[[], _T]) -> _T:
        token = _SIDE_BY_SIDE.set(count)
        try:
            return work()
        finally:
            _SIDE_BY_SIDE.reset(token)
            remaining.pop()

    return run_together([partial(run, work) for work in works], threads)


def begin(work: Callable[[], _T], threads: int | None) -> Callable[[], _T]:
    """Call a function in a thread of its own, and return a function that waits for its result.

    With one thread available it is called when its result is asked for.
    """
    if available_threads(threads) < 2:
        return cache(work)
    pool = ThreadPoolExecutor(1, thread_name_prefix="work of shadowinv")
    future = pool.submit(work)
    pool.shutdown(wait=False)
    return future.result


@cache
def _kernel_pool() -> ThreadPoolExecutor:
    """Return the pool of kernel threads; starting a thread takes as long as a small kernel."""
    return ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="kernels of shadowinv")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_kernel_pool.cache_clear)  # threads are not copied


# Ctrl-C, and the signals of a job scheduler or a closing terminal.
ENDING_SIGNALS = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}


@contextmanager
def defer_interrupts() -> Iterator[None]:
    """Defer Ctrl-C, SIGTERM and SIGHUP to the end of a short block that must run to its end."""
    late: list[int] = []
    with handling(ENDING_SIGNALS, lambda number, frame: late.append(number)):
        yield
    for number in late[:1]:
        signal.raise_signal(number)


@contextmanager
def clear_up_when_terminated() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the process only after the block has cleared up.

    Only where they would otherwise end it at once; a program's own handlers are kept.
    """

    def leave(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    fatal = [number for number in ENDING_SIGNALS if signal.getsignal(number) is signal.SIG_DFL]
    with handling(fatal, leave):
        yield


@contextmanager
def handling(numbers: Iterable[int], handler: Callable[[int, Any], None]) -> Iterator[None]:
    """Handle signals in a block of the main thread, except ignored ones."""
    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():  # they never reach others
        for number in numbers:
            if signal.getsignal(number) not in (signal.SIG_IGN, None):
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)
