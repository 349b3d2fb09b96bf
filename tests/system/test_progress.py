"""Functions that run in threads, and how they report and end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial

import pytest

from napari_shadowinv._system.machine import available_threads
from napari_shadowinv._system.progress import run_in_parallel
from napari_shadowinv.errors import InversionCancelled

Step = Callable[[int], None]


def step_on(number: int, steps: int, after_step: Step) -> int:
    for _ in range(steps):
        after_step(number)
    return number**2


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_have_the_order_of_the_functions_and_the_caller_receives_each_step(
    threads: int,
) -> None:
    received: list[tuple[int, str]] = []

    def after_step(number: int) -> None:
        received.append((number, threading.current_thread().name))

    works = [partial(step_on, number, 40 - 10 * number) for number in range(4)]
    assert run_in_parallel(works, threads, after_step) == [0, 1, 4, 9]
    numbers = [number for number, _ in received]
    assert [numbers.count(number) for number in range(4)] == [40, 30, 20, 10]
    assert {name for _, name in received} == {threading.current_thread().name}
    assert run_in_parallel([], threads, after_step) == []


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
    begun, counted, all_counted = threading.Barrier(2), threading.Event(), threading.Barrier(4)

    def shares(after_step: Step) -> list[int]:
        begun.wait(10)
        beside = available_threads(4)
        counted.set()
        stop = time.monotonic() + 10
        while available_threads(4) == beside and time.monotonic() < stop:
            time.sleep(0.001)
        inner = run_in_parallel([count_beside_others] * 4, 4, after_step)
        return [beside, available_threads(4), available_threads(1), *inner]

    def count_beside_others(after_step: Step) -> int:
        share = available_threads(4)
        all_counted.wait(10)
        return share

    def end(after_step: Step) -> int:
        begun.wait(10)
        assert counted.wait(10)
        return 0

    assert run_in_parallel([shares, end], 2, lambda number: None) == [[2, 4, 1, 1, 1, 1, 1], 0]
    assert available_threads(4) == 4


def test_a_step_after_the_end_of_all_functions_is_no_request_to_stop() -> None:
    received: list[int] = []
    callbacks: list[Step] = []

    def work(after_step: Step) -> None:
        after_step(1)
        callbacks.append(after_step)

    run_in_parallel([work] * 2, 2, received.append)
    for after_step in callbacks:
        after_step(2)
    assert received == [1, 1]
