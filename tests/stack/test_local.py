"""Schedulers on this machine: threads, processes, and any function of dask."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import dask
import numpy as np
import psutil  # dask needs it, too
import pytest

from helpers.slow_reading import die, hang_once
from helpers.store_content import content
from napari_shadowinv import InputError, read
from napari_shadowinv.errors import InversionCancelled, RunInterruptedError
from napari_shadowinv.io.store import DONE, FAILED
from napari_shadowinv.stack._worker import threads_here


@pytest.fixture(autouse=True)
def quick_processes(forked, monkeypatch):
    """Let processes begin with all modules; they have nothing else of this one."""
    monkeypatch.setattr(multiprocessing, "get_context", lambda method: forked)


def test_the_bytes_do_not_depend_on_the_scheduler(night, out, expected):
    with ThreadPoolExecutor(2) as pool:
        for scheduler in ("threads", "processes", pool, dask.get):
            stored = night.run(out, scheduler=scheduler, overwrite=True)
            assert list(stored.status.values) == [DONE] * 6
            assert content(out) == expected


def test_the_setting_of_dask_is_the_default(night, out):
    names = []
    with dask.config.set(scheduler="synchronous"):
        night.run(out, on_progress=lambda news: names.append(news.scheduler))
    assert set(names) == {"1 thread"}
    assert len(names) == 7  # at the start, and after each shot


def test_a_killed_worker_process_ends_the_run_with_a_sentence(night, out, expected):
    np.save(night.path(3), night.images[3])
    with pytest.raises(RunInterruptedError, match="use fewer workers, then run again to resume"):
        night.run(out, scheduler="processes", workers=1, reader=die)
    assert not (read(out).status == FAILED).any()
    night.run(out, scheduler="threads", overwrite=True)
    assert content(out) == expected


def children() -> set[int]:
    return {process.pid for process in psutil.Process().children(recursive=True)}


@pytest.mark.parametrize("scheduler", ["threads", "processes"])
def test_a_run_that_is_stopped_ends_its_shots_and_workers(night, out, scheduler):
    """Threads ask in the middle of a shot, processes are asked after each."""
    before = children()
    (night.folder / "hang.txt").write_text("shot_2")
    (night.folder / "release").touch()
    hanging = night.folder / "hanging"
    with pytest.raises(InversionCancelled, match="run again to resume"):
        night.run(out, reader=hang_once, scheduler=scheduler, should_stop=hanging.exists, workers=1)
    assert list(read(out).status.values[3:]) == [0] * 3
    assert not children() - before
    assert "shot" not in {thread.name.partition("_")[0] for thread in threading.enumerate()}


def test_shots_of_a_pool_share_the_cores():
    with ThreadPoolExecutor(1) as pool:
        counts = {pool.submit(threads_here, workers).result() for workers in (1, 10_000)}
    assert min(counts) == 1


def test_a_scheduler_elsewhere_names_the_extra_that_it_needs(night, out, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"needs distributed: .*napari-shadowinv\[cluster\]"):
        night.run(out, scheduler="tcp://127.0.0.1:9")
    assert not out.exists()
