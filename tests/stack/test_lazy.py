"""`invert_stack`: lazy, independent of the scheduler, sites computed once."""

from __future__ import annotations

import threading

import dask
import dask.array as da
import numpy as np
import pytest
import xarray as xr

from napari_shadowinv import (
    FileFormatError,
    InputError,
    InversionOptions,
    Shot,
    invert,
    invert_stack,
)
from napari_shadowinv.physics.setup import OpticalSetup
from napari_shadowinv.preprocessing import UniformEstimate
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


@pytest.mark.parametrize("boundary", ["closed", "free"])
def test_each_shot_has_the_variables_of_its_own_inversion(night, optical_setup, boundary):
    options = OPTIONS.model_copy(update={"boundary": boundary})
    stack = night.lazy(options=options, setup=optical_setup)
    computed = stack.compute()
    assert computed.sizes == stack.sizes
    for index, image in enumerate(night.images):
        inversion = invert(image, source=night.source, options=options)
        alone = inversion.in_units(optical_setup).to_dataset()
        names = [k for k in alone.data_vars if boundary == "closed" or "site" not in alone[k].dims]
        assert {*names} <= set(stack.data_vars)
        for name in names:
            values = computed[name]
            values = values.isel(shot=index) if "shot" in values.dims else values
            assert values.dims == alone[name].dims
            assert values.attrs == alone[name].attrs
            np.testing.assert_array_equal(values.values, alone[name].values, err_msg=str(name))
        assert computed.flux_residual[index] == inversion.report.residual
        assert computed.iterations[index] == inversion.report.iterations
        assert bool(computed.converged[index]) is inversion.report.converged


def test_lazy_stack_without_source_has_a_uniform_beam(night):
    stack = night.lazy(source=None)
    alone = invert(night.images[2], options=OPTIONS)
    shot = stack.isel(shot=2).compute()
    np.testing.assert_allclose(shot.potential, alone.potential, atol=1e-9)
    np.testing.assert_allclose(shot.displacement, alone.displacement, atol=1e-9)
    np.testing.assert_allclose(shot.image, night.images[2] / night.images[2].mean(), rtol=1e-12)


def test_masked_pixels_do_not_count(night):
    mask = np.ones(night.source.shape, bool)
    mask[3:6, 4:9] = False
    spoilt = np.where(mask, night.images, np.nan)
    stack = night.lazy(shots=spoilt, mask=mask)
    alone = invert(night.images[1], source=night.source, mask=mask, options=OPTIONS)
    np.testing.assert_array_equal(stack.potential[1], alone.potential)
    np.testing.assert_array_equal(stack["mask"], len(spoilt) * [mask])
    uniform = night.lazy(shots=spoilt, source=None, mask=mask)
    alone = invert(night.images[1], mask=mask, options=OPTIONS)
    np.testing.assert_allclose(uniform.potential[1], alone.potential, atol=1e-9)


def test_lazy_stack_reads_only_computed_shots(night):
    from helpers.slow_reading import log_and_read

    stack = night.lazy(shots=night.glob, reader=log_and_read)
    assert night.reads == []
    stack.potential.isel(shot=slice(3, 5)).compute()
    assert sorted(night.reads) == ["shot_3", "shot_4"]


def test_all_variables_of_a_shot_come_from_one_inversion(night):
    from helpers.slow_reading import log_and_read

    stack = night.lazy(shots=night.glob, reader=log_and_read)
    dask.compute(stack.potential, stack.displacement, stack.weights, stack.converged)
    assert sorted(night.reads) == [f"shot_{i}" for i in range(6)]


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


def test_a_source_for_each_shot(night, plans_made):
    sources = np.stack([night.source * (1 + 0.1 * (i // 3) * np.eye(24, 28)) for i in range(6)])
    stack = night.lazy(source=sources)
    assert stack.sites.dims == ("shot", "site", "component")
    shots = stack[["potential", "sites", "source"]].compute(scheduler="synchronous")
    assert len(plans_made) == 2  # equal sources share their sites
    for index in (1, 4):
        alone = invert(night.images[index], source=sources[index], options=OPTIONS)
        np.testing.assert_array_equal(shots.potential[index], alone.potential)
        np.testing.assert_array_equal(shots.sites[index], alone.cells.sites)
    free = OPTIONS.model_copy(update={"boundary": "free"})
    ragged = night.lazy(source=sources, options=free)
    assert "site" not in ragged.dims
    alone = invert(night.images[4], source=sources[4], options=free)
    np.testing.assert_array_equal(ragged.potential[4], alone.potential)
    with pytest.raises(InputError, match=r"'site_flux' \(shots may differ"):
        night.lazy(source=sources, options=free, variables=["site_flux"])
    with pytest.raises(InputError, match="got 2 sources for 6 shots"):
        night.lazy(source=sources[:2])


class TestInputs:
    def test_a_glob_is_sorted_by_number(self, make_night):
        night = make_night(12)
        stack = night.lazy(shots=night.glob, source=None)
        assert list(stack.name.values) == [f"shot_{i}.npy" for i in range(12)]

    def test_xarray_keeps_its_coordinate(self, night):
        expected = night.lazy().potential[2].compute()
        shots = xr.DataArray(
            np.moveaxis(night.images, 0, -1),
            dims=("y", "x", "shot"),
            coords={"shot": [3, 1, 4, 9, 5, 2]},
        )
        for labelled in (shots, shots.to_dataset(name="image").assign(other=shots)):
            stack = night.lazy(shots=labelled)
            np.testing.assert_array_equal(stack.potential.sel(shot=4), expected)

    @pytest.mark.parametrize(
        ("shots", "words"),
        [
            ("nothing/*.tif", "no file matches nothing/"),
            ([], "empty list"),
            (np.ones((5, 6)), r"shape \(5, 6\), expected \(shot, y, x\)"),
            (7, "are a int: expected an array"),
        ],
    )
    def test_input_without_shots_is_refused(self, shots, words):
        with pytest.raises(InputError, match=words):
            invert_stack(shots)

    def test_folder_without_images_is_refused(self, tmp_path):
        with pytest.raises(FileFormatError, match="contains no image: expected a folder"):
            invert_stack(tmp_path)

    def test_files_of_which_none_can_be_read_are_refused(self, tmp_path):
        (tmp_path / "a.tif").write_bytes(b"")
        with pytest.raises(FileFormatError, match="none of 1 shots can be read"):
            invert_stack(str(tmp_path / "*.tif"))

    def test_lazy_stack_refuses_inputs_that_do_not_match(self, night):
        with pytest.raises(InputError, match=r"source has shape \(5, 6\), shots \(24, 28\)"):
            night.lazy(source=np.ones((5, 6)))
        with pytest.raises(InputError, match="choose an estimate in the recipe"):
            invert_stack(Shot(night.images, source=UniformEstimate()))
        with pytest.raises(InputError, match="has strength, brightness, expected its source"):
            invert_stack(Shot(night.images, strength=0.5, brightness=2))
        with pytest.raises(InputError, match="mask has shape"):
            night.lazy(source=None, mask=np.ones((5, 6), bool))
        with pytest.raises(InputError, match="no variable 'potental'"):
            night.lazy(variables=["potental"])
        with pytest.raises(InputError, match="needs a setup"):
            night.lazy(variables=["potential_si"])


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
