"""Shots of one source share their sites, and those in work the cores."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from helpers.night import OPTIONS
from napari_shadowinv.stack import _worker


@pytest.fixture
def plans_made(monkeypatch):
    plans = []

    def plan_sites(source, options, **more):
        plans.append(source)
        return original(source, options, **more)

    original = _worker.plan_sites
    monkeypatch.setattr(_worker, "plan_sites", plan_sites)
    monkeypatch.setattr(_worker, "_entries", type(_worker._entries)())
    return plans


def test_shots_of_one_source_share_their_sites(any_night, plans_made, out):
    stored = any_night.run(out, workers=4, variables=["sites"])
    assert stored.sites.dims == ("shot", "site", "component")
    assert len(plans_made) == 1


def test_threads_that_ask_at_once_get_the_same_plan(any_night, plans_made):
    plans: list[object] = []
    start = threading.Barrier(4)

    def ask() -> None:
        start.wait()
        plans.append(_worker.SharedSites().plan(any_night.source, None, OPTIONS))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(plans_made) == 1
    assert all(plan is plans[0] for plan in plans)


def test_plans_depend_on_source_mask_and_options(any_night, plans_made):
    source, plan = any_night.source, _worker.SharedSites().plan
    mask = np.ones(source.shape, bool)
    mask[0, 0] = False
    for beam, pixels in ((source, None), (source + 1, None), (source, mask)):
        for _ in range(2):
            plan(beam, pixels, OPTIONS)
    plan(source, mask, OPTIONS.model_copy(update={"threads": 2}))
    assert len(plans_made) == 3
    plan(source, mask, OPTIONS.model_copy(update={"seed": 1}))
    assert len(plans_made) == 4


@pytest.mark.parametrize(
    ("workers", "threads"), [(1, 8), (2, 4), (3, 2), (8, 1), (16, 1), (None, 1)]
)
def test_all_shots_at_once_never_have_more_threads_than_cores(monkeypatch, workers, threads):
    monkeypatch.setattr(_worker, "available_threads", lambda _: 8)
    assert _worker.threads_here(workers) == threads
