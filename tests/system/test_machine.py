"""Threads that are kept for the kernels, and the memory that a process may use."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from napari_shadowinv._system import machine
from napari_shadowinv._system.machine import (
    available_threads,
    begin,
    in_ranges,
    physical_memory,
    results_of,
)


def fill(start, stop, values):
    values[start:stop] = np.arange(start, stop)


@pytest.mark.parametrize("uneven", [False, True])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_ranges_cover_everything_once(threads, uneven):
    values = np.full(1001, -1)
    in_ranges(fill, 1001, threads, values, smallest=10, uneven=uneven)
    np.testing.assert_array_equal(values, np.arange(1001))


def test_a_thread_takes_the_uneven_ranges_that_a_busy_one_leaves():
    light = []
    all_are_done = threading.Event()

    def work(start, stop):
        if start == 0:
            assert all_are_done.wait(10)
            return
        light.append(stop)
        if len(light) == 7:
            all_are_done.set()

    in_ranges(work, 80, 2, smallest=10, uneven=True)
    assert sorted(light) == [20, 30, 40, 50, 60, 70, 80]


def test_an_error_is_raised_after_all_ranges_that_have_begun_have_ended():
    both_have_begun, ended = threading.Barrier(2), []

    def work(start, stop):
        both_have_begun.wait(10)
        if start == 0:
            raise ValueError("first")
        time.sleep(0.05)
        ended.append(stop)

    with pytest.raises(ValueError, match="first"):
        in_ranges(work, 20, 2, smallest=10)
    assert ended == [20]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_come_in_the_order_of_their_functions(threads):
    assert results_of([lambda n=n: n**2 for n in range(7)], threads) == [n**2 for n in range(7)]


def test_functions_side_by_side_share_the_threads_of_their_kernels():
    both_have_begun = threading.Barrier(2)

    def count():
        both_have_begun.wait(10)
        threads = available_threads(4)
        both_have_begun.wait(10)
        return threads

    assert results_of([count, count], 2) == [2, 2]
    assert available_threads(4) == 4


@pytest.mark.parametrize("threads", [1, 2])
def test_of_several_errors_the_first_is_raised(threads):
    """Whichever comes earlier: the same input has the same message on any number of threads."""
    later = threading.Event()
    if threads == 1:
        later.set()

    def first():
        later.wait(10)
        raise ValueError("first")

    def second():
        later.set()
        raise ValueError("second")

    with pytest.raises(ValueError, match="first"):
        results_of([first, second], threads)


def test_functions_within_functions_give_the_threads_back():
    both = threading.Barrier(2)

    def threads_around():
        both.wait(10)
        inside = results_of([lambda: available_threads(4)], 1)
        outside = available_threads(4)
        both.wait(10)
        return *inside, outside

    assert results_of([threads_around] * 2, 2) == [(2, 2)] * 2


@pytest.mark.parametrize("threads", [1, 2])
def test_work_begins_in_a_thread_of_its_own_where_there_are_two(threads):
    calls = []
    wait = begin(lambda: calls.append(threading.current_thread()) or len(calls), threads)
    assert threads == 2 or not calls
    assert wait() == wait() == 1
    assert (calls == [threading.current_thread()]) == (threads == 1)

    def fail():
        raise ValueError("no image")

    wait = begin(fail, threads)
    with pytest.raises(ValueError, match="no image"):
        wait()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be copied")
def test_a_copied_process_has_threads_of_its_own():
    script = """
import os
from napari_shadowinv._system.machine import in_ranges

def work(start, stop, ends):
    ends.append(stop)

def done():
    ends = []
    in_ranges(work, 20, 2, ends, smallest=10)
    return len(ends)

assert done() == 2
child = os.fork()
if child == 0:
    os._exit(done())
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    printed = subprocess.run(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, check=True, timeout=60
    )
    assert printed.stdout.strip() == "2"


@pytest.mark.parametrize(
    ("membership", "file"),
    [
        ("0::/jobs/job_7\n", "jobs/memory.max"),
        ("0::/jobs/job_7\n", "jobs/job_7/memory.max"),
        ("0::/\n", "memory.max"),
        ("4:cpu:/x\n9:memory:/slurm/job_7\n", "memory/slurm/job_7/memory.limit_in_bytes"),
    ],
)
def test_memory_is_that_of_the_control_group(
    membership: str, file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    memory = physical_memory.__wrapped__  # it is asked for once in a process
    installed = memory()
    monkeypatch.setattr(machine, "_CGROUPS", tmp_path)
    monkeypatch.setattr(machine, "_MEMBERSHIP", tmp_path / "membership")
    assert memory() == installed or installed is None
    (tmp_path / "membership").write_text(membership)
    limit = tmp_path / file
    limit.parent.mkdir(parents=True, exist_ok=True)
    for text, expected in (("max\n", None), ("1000000\n", 1_000_000), (f"{2**62}\n", None)):
        limit.write_text(text)
        if installed is not None:
            assert memory() == (expected or installed)
