"""Functions that run in threads, and how they report and end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial

import pytest

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.fitting.parallel import run_in_parallel

Step = Callable[[int], None]


def step_on(number: int, steps: int, after_step: Step) -> int:
    for _ in range(steps):
        after_step(number)
    return number**2


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_have_the_order_of_the_functions_and_each_step_is_reported(threads: int) -> None:
    received: list[int] = []
    works = [partial(step_on, number, 40 - 10 * number) for number in range(4)]
    assert run_in_parallel(works, threads, received.append) == [0, 1, 4, 9]
    assert [received.count(number) for number in range(4)] == [40, 30, 20, 10]
    assert run_in_parallel([], threads, received.append) == []


def test_a_request_to_stop_ends_all_functions_at_their_next_step() -> None:
    running = threading.Barrier(2)
    ended = []

    def work(after_step: Step) -> None:
        running.wait()
        try:
            while True:
                after_step(1)
                time.sleep(0.001)
        finally:
            ended.append(1)

    def stop(number: int) -> None:
        raise InversionCancelled("stopped on request during fit")

    with pytest.raises(InversionCancelled, match="during fit"):
        run_in_parallel([work, work], 2, stop)
    assert len(ended) == 2


def test_the_first_failure_is_raised_not_those_that_follow_from_it() -> None:
    running = threading.Barrier(2)

    def fail(after_step: Step) -> None:
        running.wait()
        raise ValueError("no field")

    def go_on(after_step: Step) -> None:
        running.wait()
        while True:
            after_step(1)
            time.sleep(0.001)

    with pytest.raises(ValueError, match="no field"):
        run_in_parallel([go_on, fail], 2, lambda number: None)


def test_cores_are_divided_between_functions_that_still_run() -> None:
    begun, counted, all_counted = threading.Barrier(2), threading.Event(), threading.Barrier(2)

    def shares(after_step: Step) -> list[int]:
        begun.wait(10)
        beside = available_threads(4)
        counted.set()
        stop = time.monotonic() + 10
        while available_threads(4) == beside and time.monotonic() < stop:
            time.sleep(0.001)
        inner = run_in_parallel([count_beside_others] * 2, 4, after_step)
        return [beside, available_threads(4), available_threads(1), *inner]

    def count_beside_others(after_step: Step) -> int:
        share = available_threads(4)
        all_counted.wait(10)
        return share

    def end(after_step: Step) -> int:
        begun.wait(10)
        assert counted.wait(10)
        return 0

    assert run_in_parallel([shares, end], 2, lambda number: None) == [[2, 4, 1, 2, 2], 0]
    assert available_threads(4) == 4
