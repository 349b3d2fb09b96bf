"""Ctrl-C at a moment when it does harm."""

from __future__ import annotations

import signal
import threading

import pytest

from napari_shadowinv._system.machine import defer_interrupts

pytestmark = pytest.mark.usefixtures("usual_ctrl_c")


def test_ctrl_c_waits_for_the_end_of_the_block() -> None:
    before = signal.getsignal(signal.SIGINT)
    done = []

    def work(number: int | None) -> None:
        with defer_interrupts():
            assert signal.getsignal(signal.SIGINT) is not before
            if number is not None:
                signal.raise_signal(number)
            done.append(number)

    work(None)
    with pytest.raises(KeyboardInterrupt):
        work(signal.SIGINT)
    assert done == [None, signal.SIGINT]
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_leave_signals_alone() -> None:
    handlers = []

    def look() -> None:
        with defer_interrupts():
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]
