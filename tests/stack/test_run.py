"""`run_stack`: content of the store, resuming, refusing inputs that do not match."""

from __future__ import annotations

import json
import shutil
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr

from helpers.slow_reading import log_and_read
from helpers.store_content import content
from napari_shadowinv import (
    FileFormatError,
    InputError,
    Instrument,
    InversionOptions,
    read,
)
from napari_shadowinv.errors import InversionCancelled
from napari_shadowinv.inversion import compilation
from napari_shadowinv.inversion.variables import setup_from_dataset
from napari_shadowinv.io.store import DONE, FAILED, PENDING, StackStore
from napari_shadowinv.io.store_writing import ShotWriter
from napari_shadowinv.physics.setup import OpticalSetup
from napari_shadowinv.preprocessing import Bin
from napari_shadowinv.stack import FileReader

OPTIONS = InversionOptions(n_sites=100)


def stop_after(count: int):
    """Return `on_progress` and `should_stop` that end a run after a number of shots."""
    ended = []

    def note(progress):
        if progress.outcome is not None:
            ended.append(progress.outcome.index)

    return note, lambda: len(ended) >= count


def test_store_equals_the_lazy_stack(night, out, optical_setup):
    written = night.run(out, shots=night.images, setup=optical_setup)
    lazy = night.lazy(setup=optical_setup)
    assert (written.status == DONE).all()
    assert written.potential.dtype == np.float32
    assert written.potential.chunks[0] == (1,) * 6
    for name in ("potential", "displacement", "caustic"):
        np.testing.assert_allclose(written[name], lazy[name], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(written.iterations, lazy.iterations)
    np.testing.assert_array_equal(written.flux_residual, lazy.flux_residual)
    np.testing.assert_array_equal(written.image_residual, lazy.image_residual)
    assert (written.image_residual > 0).all()
    # Fields in SI units are derived from the stored variables on demand.
    for name in ("deflection_angle", "line_integrated_density"):
        assert written[name].attrs == lazy[name].attrs
        largest = float(abs(lazy[name]).max())
        np.testing.assert_allclose(written[name], lazy[name], atol=1e-6 * largest)


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


def test_stored_variables_can_be_chosen(night, out):
    names = ("weights", "sites", "site_flux", "source", "reprojection")
    written = night.run(out, shots=night.images, variables=names, dtype="float64")
    lazy = night.lazy()
    assert written.sites.dims == ("shot", "site", "component")
    assert "potential" not in written
    for name in names:
        np.testing.assert_array_equal(written[name], lazy[name])


def test_a_run_goes_on_where_it_stopped(night, out):
    note, enough = stop_after(2)
    arguments = {"reader": log_and_read}
    with pytest.raises(InversionCancelled, match="run again to resume"):
        night.run(
            out,
            **arguments,
            scheduler="synchronous",
            on_progress=note,
            should_stop=enough,
        )
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
    lazy = night.lazy()
    np.testing.assert_allclose(after.potential, lazy.potential, rtol=1e-6, atol=1e-6)


def spoil(night) -> dict[int, str]:
    """Spoil some shots; return the words of the message about each."""
    night.path(0).write_bytes(b"")
    night.path(1).write_bytes(night.path(1).read_bytes()[:999])
    np.save(night.path(2), 0 * night.images[2])
    np.save(night.path(3), np.ones((7, 9)))
    np.save(night.path(4), np.where(night.images[4] > 101, np.nan, night.images[4]))
    return {0: "is empty", 1: "incomplete", 2: "no positive pixel", 3: "(7, 9)", 4: "NaN"}


def test_bad_shots_fail_alone_and_can_be_repeated(make_night, out):
    night = make_night(8)
    words = spoil(night)
    arguments = {"source": night.source, "options": OPTIONS}
    written = night.run(out, **arguments)
    assert list(np.flatnonzero(written.status == FAILED)) == [0, 1, 2, 3, 4]
    assert list(np.flatnonzero(written.status == DONE)) == [5, 6, 7]
    store = StackStore(out)
    for index, word in words.items():
        assert word in store.report(index)["reason"]
    before = content(out, "potential")
    for index in words:
        np.save(night.path(index), night.images[index])
    assert (night.run(out, **arguments).status == FAILED).sum() == 5
    redone = night.run(out, **arguments, redo_failed=True)
    assert (redone.status == DONE).all()
    assert before.items() <= content(out, "potential").items()
    assert "reason" not in StackStore(out).report(0)


def test_each_shot_brings_its_own_source(night, out):
    sources = [night.folder / f"source_{i}.npy" for i in range(6)]
    for index, path in enumerate(sources):
        np.save(path, night.source + 5 * index * np.eye(24, 28))
    sources[2].write_bytes(b"")
    written = night.run(out, source=sources, variables=("potential", "sites"))
    assert list(np.flatnonzero(written.status == FAILED)) == [2]
    lazy = night.lazy(shots=night.images[4:5], source=np.load(sources[4]))
    np.testing.assert_allclose(written.potential[4], lazy.potential[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(written.sites[4], lazy.sites[0])


@pytest.fixture(scope="module")
def finished(any_night, tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "n.shadowinv.zarr"
    any_night.run(out)
    return out


DIFFERENT: dict[str, tuple[dict[str, Any], str]] = {
    "options": (
        {"options": InversionOptions(n_sites=50)},
        r"options \(n_sites: 100 there, 50 now\)",
    ),
    "instrument": (
        {"instrument": Instrument(gamma=0.1)},
        r"different instrument \(gamma: default there, 0.1 now\)",
    ),
    "source": ({"source": np.ones((24, 28))}, "different source image"),
    "mask": ({"mask": np.arange(24 * 28).reshape(24, 28) > 27}, "different mask image"),
    "setup": (
        {"setup": OpticalSetup(wavelength=5e-7, object_image_distance=0.3, pixel_size=1e-5)},
        "different setup",
    ),
    "variables": ({"variables": ("potential",)}, "different stored"),
}


class TestRefusals:
    @pytest.fixture(autouse=True)
    def begun(self, night, out, finished):
        """A finished store of the very same files."""
        shutil.copytree(finished, out)
        before = content(out)
        yield
        assert content(out) == before

    @pytest.mark.parametrize("name", DIFFERENT)
    def test_a_run_that_differs_is_refused(self, night, out, name):
        changes, words = DIFFERENT[name]
        with pytest.raises(InputError, match=words):
            night.run(out, **changes)

    def test_threads_and_order_are_no_difference(self, night, out):
        night.run(out, options=OPTIONS.model_copy(update={"threads": 1}))
        np.save(night.path(3), night.images[3])  # the same again, later
        paths = [night.path(index) for index in (0, 1, 3, 2, 4, 5)]
        resumed = night.run(out, shots=paths)
        assert list(resumed.name.values) == [f"shot_{index}.npy" for index in range(6)]

    def test_a_shot_that_is_gone_or_changed(self, night, out):
        np.save(night.path(3), night.images[3] + 1)
        with pytest.raises(InputError, match=r"shot 3 \(shot_3.npy\) has changed"):
            night.run(out)
        night.path(3).unlink()
        with pytest.raises(InputError, match=r"\(6 there, 5 given, without shot_3.npy"):
            night.run(out)

    def test_a_name_with_another_ending(self, night, tmp_path):
        with pytest.raises(FileFormatError, match=r"ends with \.shadowinv\.zarr"):
            night.run(tmp_path / "night.zarr")

    def test_a_folder_of_another_kind_is_not_overwritten(self, night, tmp_path):
        mine = tmp_path / "thesis.shadowinv.zarr"
        mine.mkdir()
        (mine / "chapter.txt").write_text("years of work")
        with pytest.raises(FileFormatError, match="is not a stack of shots"):
            night.run(mine, overwrite=True)
        assert (mine / "chapter.txt").read_text() == "years of work"

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"scheduler": "quick"}, "scheduler is 'quick'"),
            ({"workers": 0}, "'workers' is 0: workers must be at least 1"),
            ({"dtype": "int8"}, "must be 'float32' or 'float64'"),
        ],
    )
    def test_arguments_that_mean_nothing(self, night, tmp_path, changes, words):
        with pytest.raises(InputError, match=words):
            night.run(tmp_path / "new.shadowinv.zarr", **changes)
        assert not (tmp_path / "new.shadowinv.zarr").exists()


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


def test_overwriting_begins_anew(night, out):
    night.run(out, shots=night.images)
    few = InversionOptions(n_sites=60)
    written = night.run(out, shots=night.images[:2], options=few, overwrite=True)
    assert written.sizes["shot"] == 2
    assert [path.name for path in out.parent.glob(".*")] == []


def test_a_writer_of_a_store_that_was_replaced_writes_nothing(night, out):
    night.run(out, shots=night.images)
    old = ShotWriter.of(StackStore(out))
    night.run(out, shots=night.images, overwrite=True)
    before = content(out)
    with pytest.raises(OSError, match="is not the store the run started with"):
        old.write(0, {"potential": np.zeros(night.source.shape)}, {})
    assert content(out) == before


def test_store_with_truncated_names_is_refused(night, out):
    night.run(out, shots=night.images)
    (out / "name" / "c" / "0").write_bytes(b"")
    with pytest.raises(FileFormatError, match="is damaged"):
        read(out)


def test_a_run_with_another_reader_or_channel_is_refused(night, out):
    night.run(out, reader=log_and_read)
    chosen = partial(log_and_read, loud=True)
    for other in ({}, {"reader": chosen}, {"reader": FileReader(channel="red")}):
        with pytest.raises(InputError, match="different reader"):
            night.run(out, **other)


def test_fields_of_binned_shots_have_the_units_of_binned_pixels(night, out, optical_setup):
    arguments = {"source": night.source, "options": OPTIONS, "setup": optical_setup}
    arguments["filters"] = (Bin(factor=2),)
    written = night.run(out, shots=night.images[:1], **arguments, dtype="float64")
    lazy = night.lazy(shots=night.images[:1], **arguments)
    angle = lazy["deflection_angle"].values
    np.testing.assert_allclose(written["deflection_angle"], angle, rtol=1e-12)
    assert setup_from_dataset(written).object_pixel_size == 2 * optical_setup.object_pixel_size
