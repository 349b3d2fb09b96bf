"""`invert_stack`: lazy, independent of the scheduler, sites computed once."""

from __future__ import annotations

import threading

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr

from helpers.slow_reading import log_and_read
from napari_shadowinv import (
    InputError,
    InversionOptions,
    invert,
)
from napari_shadowinv.physics.setup import OpticalSetup
from napari_shadowinv.stack import _worker

OPTIONS = InversionOptions(n_sites=100)


@pytest.fixture(autouse=True)
def no_plans(monkeypatch):
    monkeypatch.setattr(_worker, "_entries", type(_worker._entries)())


@pytest.fixture
def plans_made(monkeypatch):
    plans = []

    def plan_sites(source, options, **more):
        plans.append(source)
        return original(source, options, **more)

    original = _worker.plan_sites
    monkeypatch.setattr(_worker, "plan_sites", plan_sites)
    return plans


def test_only_computed_shots_are_read_and_once_for_all_variables(night):
    stack = night.lazy(shots=night.glob, reader=log_and_read)
    assert night.reads == []
    part = stack.isel(shot=slice(3, 5))
    dask.compute(part.potential, part.displacement, part.weights, part.converged)
    assert sorted(night.reads) == ["shot_3", "shot_4"]


@pytest.mark.parametrize("scheduler", ["synchronous", "threads"])
def test_sites_are_made_once_for_shots_with_one_source(night, plans_made, scheduler):
    stack = night.lazy()
    stack[["potential", "sites"]].compute(scheduler=scheduler, num_workers=4)
    assert len(plans_made) == 1


def test_threads_that_ask_at_once_get_the_same_plan(night, plans_made):
    plans: list[object] = []
    start = threading.Barrier(4)

    def ask() -> None:
        start.wait()
        plans.append(_worker.SharedSites().plan(night.source, None, OPTIONS))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(plans_made) == 1
    assert all(plan is plans[0] for plan in plans)


def test_plans_depend_on_source_mask_and_options(night, plans_made):
    mask = np.ones(night.source.shape, bool)
    mask[0, 0] = False
    plan = _worker.SharedSites().plan
    for source, pixels in ((night.source, None), (night.source + 1, None), (night.source, mask)):
        for _ in range(2):
            plan(source, pixels, OPTIONS)
    plan(night.source, mask, OPTIONS.model_copy(update={"threads": 2}))
    assert len(plans_made) == 3
    plan(night.source, mask, OPTIONS.model_copy(update={"seed": 1}))
    assert len(plans_made) == 4


def test_the_result_does_not_depend_on_scheduler_chunks_or_order(night):
    def potential(shots: object) -> xr.DataArray:
        return night.lazy(shots=shots).potential

    expected = potential(night.images).compute(scheduler="synchronous").values
    chunked = da.from_array(night.images, chunks=(4, 10, 28))
    np.testing.assert_array_equal(potential(chunked).compute(scheduler="threads"), expected)
    backwards = potential(night.images[::-1]).compute(num_workers=3)
    np.testing.assert_array_equal(backwards[::-1], expected)
    rechunked = potential(night.images).chunk(shot=3)
    np.testing.assert_array_equal(rechunked, expected)


def test_the_graph_holds_the_source_once(night):
    stack = night.lazy()
    graph = dict(stack.potential.data.__dask_graph__())
    tasks = [key for key in graph if str(key).startswith("task-")]
    assert len(tasks) == 1
    inverted = [key for key in graph if str(key).startswith("('invert-shot-")]
    assert len(inverted) == len(night.images)


def test_equal_sources_share_their_sites(night, plans_made):
    sources = np.stack([night.source * (1 + 0.1 * (i // 3) * np.eye(24, 28)) for i in range(6)])
    stack = night.lazy(source=sources)
    assert stack.sites.dims == ("shot", "site", "component")
    stack[["potential", "sites", "source"]].compute(scheduler="synchronous")
    assert len(plans_made) == 2
    free = OPTIONS.model_copy(update={"boundary": "free"})
    assert "site" not in night.lazy(source=sources, options=free).dims


def test_a_glob_is_sorted_by_number(make_night):
    night = make_night(12)
    stack = night.lazy(shots=night.glob, source=None)
    assert list(stack.name.values) == [f"shot_{i}.npy" for i in range(12)]


def test_xarray_keeps_its_coordinate(any_night):
    expected = any_night.lazy().potential[2].compute()
    axes = {"dims": ("y", "x", "shot"), "coords": {"shot": [3, 1, 4, 9, 5, 2]}}
    shots = xr.DataArray(np.moveaxis(any_night.images, 0, -1), **axes)
    for labelled in (shots, shots.to_dataset(name="image").assign(other=shots)):
        stack = any_night.lazy(shots=labelled)
        np.testing.assert_array_equal(stack.potential.sel(shot=4), expected)


def test_a_bad_shot_is_named_when_it_is_computed(night):
    night.images[3] = 0
    stack = night.lazy()
    stack.potential.isel(shot=2).compute()
    with pytest.raises(InputError, match="shot 3: image has no positive pixel"):
        stack.potential.compute()


def test_lazy_stack_computes_only_requested_variables(night):
    setup = OpticalSetup(wavelength=5e-7, object_image_distance=0.3, pixel_size=1e-5)
    stack = night.lazy(source=None, setup=setup, variables=["potential_si"])
    quality = {"converged", "flux_residual", "image_residual", "iterations"}
    quality |= {"verdict", "cautions", "total_error", "limited_by"}
    quality |= {"noise_error", "discretisation_error"}
    assert set(stack.data_vars) == {"potential_si", *quality}
    alone = invert(night.images[0], options=OPTIONS)
    np.testing.assert_allclose(stack.potential_si[0], setup.potential(alone.potential), rtol=1e-9)


@pytest.mark.parametrize(
    ("workers", "cores", "threads"), [(1, 8, 8), (2, 8, 4), (3, 8, 2), (8, 8, 1), (16, 8, 1)]
)
def test_all_shots_at_once_never_have_more_threads_than_cores(monkeypatch, workers, cores, threads):
    monkeypatch.setattr(_worker, "available_threads", lambda _: cores)
    assert _worker.threads_here(workers) == threads
    counts = []
    with dask.config.set(num_workers=workers):
        ask = threading.Thread(target=lambda: counts.append(_worker.threads_here()))
        ask.start()
        ask.join()
    assert counts == [threads]
