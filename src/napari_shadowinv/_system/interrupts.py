"""Ctrl-C at a moment when it does harm: `interrupts_put_off`."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

__all__ = ["interrupts_put_off"]


@contextmanager
def interrupts_put_off() -> Iterator[None]:
    """Raise a Ctrl-C that comes in the block when the block has ended.

    For short work in the main thread that another thread would go on with, or that cannot be
    undone when it is half done. In other threads, which Ctrl-C never reaches, nothing is changed.
    """
    if threading.current_thread() is not threading.main_thread():
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
