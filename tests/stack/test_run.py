"""`run_stack`: content of the store, resuming, refusing inputs that do not match."""

from __future__ import annotations

import json

import numpy as np
import pytest
import xarray as xr

from helpers.slow_reading import log_and_read
from helpers.store_content import content
from napari_shadowinv import (
    InversionOptions,
    invert,
    read,
)
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion import compilation
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.io.store_writing import ShotWriter
from napari_shadowinv.preprocessing import PolynomialEstimate

OPTIONS = InversionOptions(n_sites=100)


def stop_after(count: int):
    """Return `on_progress` and `should_stop` that end a run after a number of shots."""
    ended = []

    def note(progress):
        if progress.outcome is not None:
            ended.append(progress.outcome.index)

    return note, lambda: len(ended) >= count


def test_fields_in_si_units_are_derived_from_what_is_stored(any_night, out, optical_setup):
    written = any_night.run(out, shots=any_night.images, setup=optical_setup)
    assert written.potential.dtype == np.float32
    for index in range(6):
        inversion = invert(any_night.images[index], source=any_night.source, options=OPTIONS)
        alone = inversion.in_units(optical_setup).to_dataset()
        for name in ("deflection_angle", "line_integrated_density"):
            assert written[name].attrs == alone[name].attrs
            largest = float(abs(alone[name]).max())
            np.testing.assert_allclose(written[name][index], alone[name], atol=1e-6 * largest)


def test_read_opens_it_and_so_does_plain_xarray(night, out, recwarn):
    night.run(out, shots=night.images)
    dataset = read(out)
    assert isinstance(dataset, xr.Dataset)
    assert dataset.potential.attrs["units"] == "pixel**2"
    assert json.loads(dataset.attrs["options"])["n_sites"] == 100
    plain = xr.open_zarr(out)
    assert list(plain.status.values) == [DONE] * 6
    assert plain.status.attrs["flag_meanings"] == "pending done failed damaged"
    np.testing.assert_array_equal(plain.potential, dataset.potential)
    assert not [w for w in recwarn if "zarr" in str(w.message).lower()]


def test_a_run_goes_on_where_it_stopped(night, out, expected):
    note, enough = stop_after(2)
    arguments = {"reader": log_and_read}
    stopping = {"scheduler": "synchronous", "on_progress": note, "should_stop": enough}
    with pytest.raises(InversionCancelled, match="run again to resume"):
        night.run(out, **arguments, **stopping)
    before = read(out)
    done = np.flatnonzero(before.status == DONE)
    assert 2 <= len(done) < 6
    pending = before.isel(shot=before.status.values == PENDING)
    assert np.isnan(pending.potential.values).all()
    first = content(out)
    reads = len(night.reads)
    progress = []
    after = night.run(out, **arguments, on_progress=progress.append)
    assert (after.status == DONE).all()
    assert (progress[0].done, progress[0].total) == (len(done), 6)
    # Finished shots are neither read nor written again.
    assert not {f"shot_{i}" for i in done} & set(night.reads[reads:])
    assert first.items() <= content(out).items()
    assert content(out) == expected


def test_bad_shots_fail_alone_and_can_be_repeated(make_night, out):
    night = make_night(8)
    words = {0: "is empty", 1: "incomplete", 2: "no positive pixel", 3: "(7, 9)", 4: "NaN"}
    night.path(0).write_bytes(b"")
    night.path(1).write_bytes(night.path(1).read_bytes()[:999])
    np.save(night.path(2), 0 * night.images[2])
    np.save(night.path(3), np.ones((7, 9)))
    np.save(night.path(4), np.where(night.images[4] > 101, np.nan, night.images[4]))
    written = night.run(out)
    assert list(written.status) == [FAILED] * 5 + [DONE] * 3
    store = StackStore(out)
    for index, word in words.items():
        assert word in store.report(index)["reason"]
    before = content(out, "potential")
    for index in words:
        np.save(night.path(index), night.images[index])
    assert (night.run(out).status == FAILED).sum() == 5
    redone = night.run(out, redo_failed=True)
    assert (redone.status == DONE).all()
    assert before.items() <= content(out, "potential").items()
    assert "reason" not in StackStore(out).report(0)


def test_a_source_that_cannot_be_estimated_fails_its_shot_alone(night, out):
    night.images[3] = 0
    written = night.run(out, shots=night.images, source=PolynomialEstimate(degree=1))
    assert list(np.flatnonzero(written.status == FAILED)) == [3]
    text = 'estimated from each shot: {"method":"polynomial","degree":1}'
    assert written.attrs["source_image"] == text


def test_the_first_run_ever_compiles_before_its_shots(night, out, monkeypatch):
    progress = []
    monkeypatch.setattr(compilation, "is_compiled", lambda: False)
    night.run(out, scheduler="synchronous", on_progress=progress.append)
    assert "minute" in progress[0].stage
    assert progress[0].scheduler == ""
    assert not any(news.stage for news in progress[1:])
    assert progress[-1].done == 6
    with pytest.raises(InversionCancelled):
        night.run(out, overwrite=True, should_stop=lambda: True)
    assert (read(out).status == DONE).all()


def test_overwriting_begins_anew_and_an_old_writer_writes_nothing(night, out):
    night.run(out, shots=night.images)
    old = ShotWriter.of(StackStore(out))
    few = InversionOptions(n_sites=60)
    written = night.run(out, shots=night.images[:2], options=few, overwrite=True)
    assert written.sizes["shot"] == 2
    assert [path.name for path in out.parent.glob(".*")] == []
    before = content(out)
    with pytest.raises(OSError, match="is not the store the run started with"):
        old.write(0, {"potential": np.zeros(night.source.shape)}, {})
    assert content(out) == before
